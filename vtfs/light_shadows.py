"""Which samples each light's shadow takes its light from, as shading reads it."""

from __future__ import annotations

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.gbuffer import LayerTable

MAX_SHADOW_LIGHTS = 32
"""Lights of a frame that cast shadows: one bit of a word each."""


class ShadowSlots(eqx.Module):
    """Which light has which bit.

    - `slot`: of each light with a place; -1: it casts no shadow.
    - `sun_row`: of each directional light the direction toward it in view space and its colour. They have the first
      slots, in order.
    """

    slot: Int[Array, " lights"]
    sun_row: Float[Array, "suns 6"]
    n_slots: int = eqx.field(static=True)


class LightShadows(eqx.Module):
    """Shadows of up to 32 lights on the runs of a frame.

    - `shadowed`: a word for each sample.
    - `overflowed`: a mask does not hold all shadows; such a result is thrown away, never used.
    """

    slots: ShadowSlots
    shadowed: UInt32[Array, "runs 32"]
    overflowed: Bool[Array, ""]

    def of_runs(self, run: Int[Array, " n"]) -> LightShadows:
        """Of some runs only."""
        return LightShadows(self.slots, self.shadowed[run], self.overflowed)

    def lit(self, light: Int[Array, " runs"]) -> Bool[Array, "runs 32"]:
        """Samples that are not in the shadow of one light for each run; of the first runs, if fewer are given."""
        slot = self.slots.slot[light][:, None]
        bit = self.shadowed[: light.shape[0]] >> jnp.maximum(slot, 0).astype(jnp.uint32)
        return (slot < 0) | (bit & 1 == 0)

    def sun_lit(self, sun: Int[Array, ""]) -> Bool[Array, "runs 32"]:
        """Samples that are not in the shadow of one directional light."""
        return self.shadowed >> sun.astype(jnp.uint32) & 1 == 0


class CastMask(eqx.Module):
    """Samples of one view that lie in the shadow of one light; `overflowed`: it does not hold them all."""

    shadowed: Bool[Array, "visible_runs 32"]
    overflowed: Bool[Array, ""]


def shadow_bits(masks: list[CastMask], slots: ShadowSlots, layers: LayerTable) -> LightShadows:
    """Masks of all lights on each view, as words of all runs.

    **Arguments:**

    - `masks`: of the solid samples one for each slot, then of each transparent layer.
    """

    def words(view: int) -> UInt32[Array, "visible_runs 32"]:
        own = masks[view * slots.n_slots : (view + 1) * slots.n_slots]
        bits = [mask.shadowed.astype(jnp.uint32) << jnp.uint32(k) for k, mask in enumerate(own)]
        return functools.reduce(jnp.bitwise_or, bits)

    transparent = jnp.zeros(layers.opacity.shape, jnp.uint32)
    for layer in range(len(masks) // slots.n_slots - 1):
        run = layers.run[layer]
        transparent = transparent.at[jnp.where(run >= 0, run, transparent.shape[0])].set(words(layer + 1), mode="drop")
    overflowed = jnp.stack([mask.overflowed for mask in masks]).any()
    return LightShadows(slots, jnp.concatenate([words(0), transparent]), overflowed)
