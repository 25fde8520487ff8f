"""Techniques by name: which cast shadows, the groups that stand for several, and what is compared by default."""

from __future__ import annotations

from collections.abc import Sequence

from vtfs.input_error import InputError
from vtfs.parameters import TECHNIQUES

SHADOW_NAMES = ("z_pass", "z_fail", "ptsv", "cluster_hierarchy", "shadow_rays", "brute_force")
"""Those that find which samples lie in the shadow of which light, and then shade by light lists."""

STENCIL_NAMES = ("z_pass", "z_fail")
"""Those that cannot cast by alpha-masked and blended triangles: a stencil cannot tell surfaces apart."""

SHADOW_REFERENCES = ("shadow_rays", "brute_force")
"""What the others are checked against; they run on the host."""

TECHNIQUE_GROUPS: dict[str, tuple[str, ...]] = {
    "all": tuple(name for name in TECHNIQUES if name not in SHADOW_NAMES),
    "shadows": tuple(name for name in SHADOW_NAMES if name not in SHADOW_REFERENCES),
}
"""Names that stand for several techniques wherever several can be named."""

TUNED_TECHNIQUES = ("forward", "tiled_deferred", "volume_tiled_bvh")
"""What a search compares unless the user says otherwise. Nothing is rasterised here, so that techniques which differ
in their passes over the geometry run the same programs: `tiled_forward_prez` those of `tiled_deferred`,
`clustered_forward` and `clustered_deferred` those of `volume_tiled_bvh`."""


def named_techniques(names: Sequence[str]) -> tuple[str, ...]:
    """Techniques by their own names or those of groups: each once, in the order of the names.

    **Raises:** `InputError` for an unknown name, or none.
    """
    members = [TECHNIQUE_GROUPS.get(name, (name,)) for name in names]
    found = tuple(dict.fromkeys(name for group in members for name in group))
    for name in found or ("",):
        require_technique(name)
    return found


def require_technique(name: str) -> None:
    """**Raises:** `InputError` where it is the name of no single technique."""
    if name in TECHNIQUE_GROUPS:
        members = ", ".join(TECHNIQUE_GROUPS[name])
        raise InputError(f"technique `{name}`: is a group, and one technique is needed; choose from {members}.")
    if name not in TECHNIQUES:
        raise InputError(f"technique `{name}`: unknown; choose from {', '.join(TECHNIQUES)}.")


def casts_shadows(techniques: Sequence[str]) -> bool:
    """Do the techniques cast shadows?

    **Raises:** `InputError` where some do and others do not, and for references, which run on the host.
    """
    casting = [name for name in techniques if name in SHADOW_NAMES]
    references = [name for name in casting if name in SHADOW_REFERENCES]
    if references:
        raise InputError(
            f"--techniques {references[0]}: is what others are checked against and is not timed; leave it out."
        )
    if casting and len(casting) < len(techniques):
        other = next(name for name in techniques if name not in casting)
        raise InputError(
            f"--techniques {casting[0]},{other}: one casts shadows, the other does not, so that their times cannot be "
            "compared; tune one kind at a time."
        )
    return bool(casting)
