"""Shadow volumes by z-pass: what stands between the eye and a sample counts (Heidmann 1991)."""

from __future__ import annotations

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.stencil import stencil_mask


def z_pass(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows of sides alone. Without `plan.around_eye` it is wrong where the camera stands in a volume.

    A volume's cap at its caster is not drawn: no sample that the eye sees lies behind it, if all casters are seen.
    """
    return stencil_mask(frame, plan, by_failing=False)
