"""Shadow volumes by z-fail: what lies behind a sample counts, caps included (Bilodeau and Songy 1999; Carmack 2000)."""

from __future__ import annotations

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.stencil import stencil_mask


def z_fail(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows of sides and of both caps, the farther at infinity: right wherever the camera stands."""
    return stencil_mask(frame, plan, by_failing=True)
