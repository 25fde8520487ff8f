"""Powers of highlights, as the compiler makes them: XLA simplifies what eager evaluation does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vtfs.fast_power import power

N = 4096
SMALLEST = float(np.finfo(np.float32).tiny)
compiled = jax.jit(power)


def check(base, exponent, result=None):
    """Within 1e-5 where the exact value is above 1e-6, and below 2e-6 where it is below: as the docstring says."""
    base, exponent = np.broadcast_arrays(np.float32(base), np.float32(exponent))
    result = np.asarray(compiled(base, exponent) if result is None else result, np.float64)
    exact = base.astype(np.float64) ** exponent.astype(np.float64)
    large = exact > 1e-6
    assert (np.abs(result - exact)[large] <= 1e-5 * exact[large]).all()
    assert ((result >= 0) & (result < 2e-6))[~large].all()


@given(
    seed=st.integers(0, 2**32 - 1),
    nearness=st.sampled_from([1.0, 1e-2, 1e-4, 1e-6]),
    longest=st.sampled_from([1.0, 64.0, 2048.0]),
)
@settings(max_examples=60, deadline=None)
def test_powers_are_within_their_bound(seed, nearness, longest):
    """Highlights are near 1, by any power of ten."""
    rng = np.random.default_rng(seed)
    base = np.clip(1 - nearness * rng.random(N), SMALLEST, 1)
    check(base, longest * rng.random(N))


@given(base=st.floats(SMALLEST, 1, width=32), exponent=st.floats(0, 2048, width=32))
@example(base=1.0, exponent=2048.0)
@example(base=SMALLEST, exponent=1.0)
@example(base=SMALLEST, exponent=2048.0)
@example(base=SMALLEST, exponent=0.0)
@example(base=float(np.nextafter(np.float32(1), np.float32(0))), exponent=2048.0)
@example(base=float(np.float32(np.sqrt(0.5))), exponent=39.0)  # where the mantissa's range ends
@example(base=float(np.nextafter(np.float32(np.sqrt(0.5)), np.float32(0))), exponent=39.0)
@example(base=0.5, exponent=19.0)  # whole exponents of two: nothing is left for the second polynomial
@settings(deadline=None)
def test_any_base_and_exponent(base, exponent):
    check(np.full(N, base), np.full(N, exponent))


def test_the_ends_are_exact():
    ones = jnp.ones(N)
    assert (np.asarray(compiled(ones, ones * 2048)) == 1).all()
    assert (np.asarray(compiled(ones * 0.25, ones * 0)) == 1).all()


def test_it_keeps_its_bound_where_the_compiler_can_see_around_it():
    """With constants, fused with what shading does before and after, and in a loop."""
    rng = np.random.default_rng(0)
    base = rng.random(N).astype(np.float32)
    half = np.clip(base, 0.5, 1.0)

    @jax.jit
    def constants(x):
        return power(x, jnp.full_like(x, 64.0)), power(jnp.full_like(x, 0.75), x * 100)

    by_base, by_exponent = constants(half)
    check(half, 64.0, by_base)
    check(0.75, np.float32(half * 100), by_exponent)

    @jax.jit
    def looped(x):
        return jax.lax.fori_loop(0, 3, lambda k, total: total + power(jnp.maximum(x, 0.5), x * 0 + 2.0**k), x * 0)

    exact = half.astype(np.float64) + half.astype(np.float64) ** 2 + half.astype(np.float64) ** 4
    assert np.abs(np.asarray(looped(base)) - exact).max() < 3e-5


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_other_precisions_keep_theirs(dtype):
    base = jnp.linspace(0.1, 1, 64).astype(dtype)
    result = compiled(base, base)
    assert result.dtype == dtype
    exact = np.asarray(base, np.float64) ** np.asarray(base, np.float64)
    assert np.abs(np.asarray(result, np.float64) - exact).max() < 4 * float(jnp.finfo(dtype).eps)
