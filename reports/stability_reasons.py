"""Why methods fail where they do: what is known of the mechanisms, one sentence each.

A sentence is shown only where a run measured the failure that it explains.
"""

from __future__ import annotations

from vtfs.stability.record import Kind

# Part of a method's name, or empty for any; ladder, or empty for any; the first that fits is taken.
_SHADOW = (
    ("textbook", "camera_inside", "Counts polygons before the sample, and forgets the volumes that the eye is in."),
    ("saturating", "camera_inside", "The stencil is full of the volumes around the eye before the first polygon."),
    ("saturating", "nested", "What is added beyond 255 is lost, and what is taken away later is not."),
    ("wrapping", "", "256 volumes count as none."),
    ("24-bit depth", "", "A nearer near plane leaves the depth buffer fewer steps where things are."),
    ("1 mm", "", "A bias in metres is too much for a small scene, and less than rounding in a large one."),
    ("world in float32", "offset", "Far from the origin float32 steps grow larger than the bias and the details."),
    ("world in float32", "degenerate", "Rounding moves the light out of the plane of triangles that it lies in."),
    ("world in float32", "", "Rounding of the world's coordinates opens cracks and moves thin shadows."),
    ("shadow_rays", "degenerate", "A ray that ends on the light ends on a triangle that the light lies on or beside."),
    ("shadow_rays", "t_junctions", "A vertex on a neighbour's edge leaves a crack as wide as a rounding."),
    ("float32", "degenerate", "Products of huge coordinates overflow float32."),
    ("float32", "aim", "Rounding puts samples near a vertex outside of all triangles that meet there."),
    ("", "aim", "Within float64 rounding of a vertex the signs of the planes that meet there no longer agree."),
    ("", "t_junctions", "A vertex on a neighbour's edge leaves a crack as wide as a rounding."),
    ("z_", "edge_on", "Of a volume thinner than a rounding one side is counted and the other is not."),
    ("z_", "light_to_plane", "Of a volume thinner than a rounding one side is counted and the other is not."),
    ("float32", "edge_on", "The three planes of a triangle seen edge-on nearly coincide in float32."),
    ("float32", "light_to_plane", "The three planes of a triangle seen edge-on nearly coincide in float32."),
)  # fmt: skip
_LIGHT = (
    ("at most", "", "A list of fixed length drops the lights that do not fit."),
    ("float32", "offset", "A light's position, rounded in world space, moves farther than it reaches beyond a sample."),
)


def reason(kind: Kind, method: str, ladder: str) -> str:
    """The sentence for a failure; says so where none is known."""
    for part, where, sentence in _SHADOW if kind == "shadow" else _LIGHT:
        if part in method and where in ("", ladder):
            return sentence
    return "No reason is known: a finding to look into."
