"""Which samples each light's shadow takes its light from, as shading reads it."""

from __future__ import annotations

import functools
from collections.abc import Callable

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
    - `transmittance`: what alpha casters leave of each slot's light: one channel, or red, green and blue; none where
      none cast.
    - `overflowed`: a mask does not hold all shadows; such a result is thrown away, never used.
    """

    slots: ShadowSlots
    shadowed: UInt32[Array, "runs 32"]
    transmittance: tuple[Float[Array, "slots runs 32"], ...]
    overflowed: Bool[Array, ""]

    def of_runs(self, run: Int[Array, " n"]) -> LightShadows:
        """Of some runs only."""
        transmittance = tuple(channel[:, run] for channel in self.transmittance)
        return LightShadows(self.slots, self.shadowed[run], transmittance, self.overflowed)

    def lit(self, light: Int[Array, " runs"]) -> Bool[Array, "runs 32"]:
        """Samples that are not in the shadow of one light for each run; of the first runs, if fewer are given."""
        slot = self.slots.slot[light][:, None]
        bit = self.shadowed[: light.shape[0]] >> jnp.maximum(slot, 0).astype(jnp.uint32)
        return (slot < 0) | (bit & 1 == 0)

    def left_of(
        self, light: Int[Array, " runs"], colour: tuple[Float[Array, "runs 32"], ...]
    ) -> tuple[Float[Array, "runs 32"], ...]:
        """What alpha casters leave of the colour that one light for each run adds; runs as of `lit`."""
        slot, run = self.slots.slot[light], jnp.arange(light.shape[0])
        left = [channel[jnp.maximum(slot, 0), run] for channel in self.transmittance]
        return _stopped([jnp.where((slot < 0)[:, None], 1, channel) for channel in left], colour)

    def sun_left(
        self, sun: Int[Array, ""], colour: tuple[Float[Array, "runs 32"], ...]
    ) -> tuple[Float[Array, "runs 32"], ...]:
        """What they leave of the colour that one directional light adds."""
        return _stopped([channel[sun] for channel in self.transmittance], colour)

    def sun_lit(self, sun: Int[Array, ""]) -> Bool[Array, "runs 32"]:
        """Samples that are not in the shadow of one directional light."""
        return self.shadowed >> sun.astype(jnp.uint32) & 1 == 0


def _stopped(left: list[Array], colour: tuple[Float[Array, "runs 32"], ...]) -> tuple[Float[Array, "runs 32"], ...]:
    if not left:
        return colour
    return tuple(c * channel for c, channel in zip(colour, left if len(left) == 3 else 3 * left, strict=True))


class CastMask(eqx.Module):
    """The shadow of one light on one view.

    - `shadowed`: samples in the shadow of opaque casters; `overflowed`: not all are found.
    - `transmittance`: what alpha casters leave, as in `LightShadows`.
    """

    shadowed: Bool[Array, "visible_runs 32"]
    overflowed: Bool[Array, ""]
    transmittance: tuple[Float[Array, "visible_runs 32"], ...] = ()


def shadow_bits(masks: list[CastMask], slots: ShadowSlots, layers: LayerTable) -> LightShadows:
    """Masks of all lights on each view, as words of all runs.

    **Arguments:**

    - `masks`: of the solid samples one for each slot, then of each transparent layer.
    """

    def words(view: int) -> UInt32[Array, "visible_runs 32"]:
        own = masks[view * slots.n_slots : (view + 1) * slots.n_slots]
        bits = [mask.shadowed.astype(jnp.uint32) << jnp.uint32(k) for k, mask in enumerate(own)]
        return functools.reduce(jnp.bitwise_or, bits)

    def on_all_runs(of_view: Callable[[int], Array]) -> Array:
        solid = of_view(0)
        transparent = jnp.zeros(layers.opacity.shape, solid.dtype)
        for layer in range(len(masks) // slots.n_slots - 1):
            run = layers.run[layer]
            own = of_view(layer + 1)
            transparent = transparent.at[jnp.where(run >= 0, run, transparent.shape[0])].set(own, mode="drop")
        return jnp.concatenate([solid, transparent])

    def channel(c: int) -> Float[Array, "slots runs 32"]:
        of_slot = [
            on_all_runs(lambda view, k=k: masks[view * slots.n_slots + k].transmittance[c])
            for k in range(slots.n_slots)
        ]
        return jnp.stack(of_slot)

    transmittance = tuple(channel(c) for c in range(len(masks[0].transmittance)))
    overflowed = jnp.stack([mask.overflowed for mask in masks]).any()
    return LightShadows(slots, on_all_runs(words), transmittance, overflowed)
