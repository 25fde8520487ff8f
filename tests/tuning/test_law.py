import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tuning.family import candidate_terms
from tuning.law import Law
from tuning.terms import CONSTANT, Factor, Term
from vtfs.input_error import InputError

X = np.array([0.5, 1.0, 2.0, 8.0])
COLUMNS = {"x": X, "y": 10 * X[::-1]}


@pytest.mark.parametrize(
    ("term", "name", "values"),
    [
        (CONSTANT, "1", [1, 1, 1, 1]),
        (Term((Factor("x"),)), "x", [0.5, 1, 2, 8]),
        (Term((Factor("x", -1.0),)), "x^-1", [2, 1, 0.5, 0.125]),
        (Term((Factor("x", 1.0, 1),)), "x * log2(x)", [0, 0, 2, 24]),  # below 1 a logarithm counts as 0
        (Term((Factor("x", 0.0, 1),)), "log2(x)", [0, 0, 1, 3]),
        (Term((Factor("x"), Factor("y", 2.0))), "x * y^2", [3200, 400, 200, 200]),
        (Term((Factor("x"),), "up_to", 1.5), "min(x, 1.5)", [0.5, 1, 1.5, 1.5]),
        (Term((Factor("x"),), "beyond", 1.5), "max(x - 1.5, 0)", [0, 0, 0.5, 6.5]),
        (Term((Factor("x"),), "step", 1.5), "(x > 1.5)", [0, 0, 1, 1]),
    ],
)
def test_terms_are_what_their_names_say(term, name, values):
    assert term.name == name
    assert_allclose(term.values(COLUMNS), values)
    assert Term.from_json(term.as_json()) == term


def test_a_missing_column_is_named():
    with pytest.raises(InputError, match="`z`"):
        Term((Factor("z"),)).values(COLUMNS)


@pytest.mark.parametrize("sides", [(0, 0, 0), (0, 1, 1)])
def test_slopes_and_jax_agree_with_the_law(sides):
    law = Law((CONSTANT, Term((Factor("x"),)), Term((Factor("y"),))), (2.0, 0.5, 0.1), sides)
    slopes = law.slopes(COLUMNS)
    assert_allclose(slopes.sum(axis=1), 1)
    for k in range(3):
        moved = list(law.costs_ms)
        moved[k] *= 1 + 1e-6
        there = Law(law.terms, tuple(moved), sides).predict(COLUMNS)
        # A difference of first order over 1e-6.
        assert_allclose(np.log(there / law.predict(COLUMNS)) / 1e-6, slopes[:, k], atol=1e-4)
    with jax.enable_x64(True):
        rows = zip(*COLUMNS.values(), strict=True)
        ours = [float(law.predict_one({"x": jnp.float64(x), "y": jnp.float64(y)})) for x, y in rows]
    assert_allclose(ours, law.predict(COLUMNS), rtol=1e-12)
    assert Law.from_json(law.as_json()) == law


def test_what_a_column_means_decides_its_terms():
    n = np.geomspace(4, 512, 8)
    rng = np.random.default_rng(0)

    def names(stage=None, **columns):
        return {term.name for term in candidate_terms(columns, stage)[0]}

    assert names(samples=n) == {"samples"}
    assert names(num_lights=n) == {"num_lights", "num_lights * log2(num_lights)", "log2(num_lights)"}
    assert names("sort", num_lights=n) == {"num_lights * log2(num_lights)"}
    assert names("build_bvh", num_lights=n) == {"num_lights"}
    assert names(tile_px=n) == {"tile_px", "tile_px^-1", "tile_px^2", "tile_px^-2"}
    assert len(names(a=n)) == 11  # six powers with and without a logarithm, less the constant
    assert len(names(a=n, b=rng.permutation(n))) == 2 * 11 + 11 * 11
    a = np.arange(1.0, 33.0)
    # Cuts need rows on either side; of the only column at every second value, of one of several at six.
    assert sum("max(a" in name for name in names(a=a)) == 32 // 2
    assert sum("max(a" in name for name in names(a=a, b=rng.permutation(a))) == 6
    with_zero = names(a=np.append(n, 0.0))
    assert not any("^-" in name for name in with_zero)
