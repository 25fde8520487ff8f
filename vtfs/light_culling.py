"""Which lights may reach a cluster: the test of one light against one cluster, at the leaves of every assignment."""

from __future__ import annotations

from typing import Literal

import jax
from jaxtyping import Array, Bool, Int

from vtfs.bounds import (
    Aabb,
    Cone,
    Sphere,
    box_of_sphere,
    boxes_meet,
    sphere_meets_box,
    sphere_meets_cone,
    sphere_of_box,
)
from vtfs.cell_shapes import section_rows, sphere_meets_planes, sphere_meets_screen_rect, sphere_meets_section
from vtfs.clusters import Clusters
from vtfs.normal_cones import may_face

Cull = Literal["screen_rect", "planes", "box", "frustum"]
LeafTest = Literal["sphere", "box"]


def needs_sections(cull: Cull) -> bool:
    """Does the test read `Clusters.section`?"""
    return cull != "box"


def may_reach(
    light: Sphere, cone: Cone | None, clusters: Clusters, row: Int[Array, " rows"], cull: Cull, leaf_test: LeafTest
) -> Bool[Array, "rows candidates"]:
    """May a light reach a sample of a cluster? Errs on the side of reaching.

    **Arguments:**

    - `light`, `cone`: `[rows, candidates]` each; no cone where lights shine everywhere.
    - `row`: the cluster of each row.
    - `cull`: what the sphere is tested against; `leaf_test` `box`: the light's box against the cluster's instead.

    Spots are also tested by their cones, and all lights by the clusters' cones of normals, where there are any.
    """
    box = box_rows(clusters.box, row)
    if leaf_test == "box":
        meets = boxes_meet(box_of_sphere(light), box)
    elif cull == "box":
        meets = sphere_meets_box(light, box)
    else:
        assert clusters.section is not None, f"cull={cull} needs clusters with sections"
        section = section_rows(clusters.section, row)
        if cull == "screen_rect":
            meets = sphere_meets_screen_rect(light, section)
        elif cull == "planes":
            meets = sphere_meets_planes(light, section)
        else:
            # The box of the samples may cut off corners of the section around it.
            meets = sphere_meets_section(light, section) & sphere_meets_box(light, box)
    if cone is None and clusters.cones is None:
        return meets
    around = sphere_of_box(box)
    if cone is not None:
        meets &= sphere_meets_cone(around, light, cone)
    if clusters.cones is not None:
        meets &= may_face(jax.tree.map(lambda c: c[row][:, None], clusters.cones), around, light)
    return meets


def box_rows(box: Aabb, row) -> Aabb:
    """Some boxes as a column, to broadcast against each one's candidates."""
    return Aabb(
        box.low_x_m[row][:, None],
        box.low_y_m[row][:, None],
        box.low_z_m[row][:, None],
        box.high_x_m[row][:, None],
        box.high_y_m[row][:, None],
        box.high_z_m[row][:, None],
    )
