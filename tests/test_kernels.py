"""Where the time of a program goes: what its kernels took, by the function that asked for them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.kernels import Kernels, asked_by, kernels_of, table


def _sorted_rows(x):
    return jnp.sort(x, axis=1)


def _polynomial(x):
    return x * x + 3 * x


@pytest.fixture(scope="module")
def compiled():
    x = jnp.asarray(np.random.default_rng(0).normal(size=(100, 2_000)), jnp.float32)
    program = jax.jit(lambda x: (_sorted_rows(x), _polynomial(x))).lower(x).compile()
    return program, lambda: program(x)


def test_each_instruction_is_of_the_function_that_asked(compiled):
    assert {"test_kernels:_sorted_rows", "test_kernels:_polynomial"} <= set(asked_by(compiled[0].as_text()).values())


def test_names_of_a_text_are_those_of_its_kernels():
    text = """FileNames
1 "/a/levels.py"

FunctionNames
1 "visit.<locals>.test"

FileLocations
1 {file_name_id=1 function_name_id=1 line=4 end_line=4 column=2 end_column=36}

StackFrames
7 {file_location_id=1 parent_frame_id=1}

  ROOT %input_reduce-fusion.3 = u32[5]{0} fusion(%a), kind=kInput, metadata={op_name="jit(run)/sum" stack_frame_id=7}
"""
    assert asked_by(text) == {"input_reduce_fusion_3": "levels:test"}


def test_all_time_and_launches_are_some_functions(compiled):
    found = kernels_of(*compiled, n_calls=3)
    assert "test_kernels:_sorted_rows" in found.by_function
    assert found.ms == pytest.approx(sum(ms for ms, _ in found.by_function.values()))
    assert found.launches == pytest.approx(sum(n for _, n in found.by_function.values()))
    assert found.launches >= 2


def test_a_loop_is_not_counted_beside_what_it_calls():
    x = jnp.ones(1_000)
    program = jax.jit(lambda x: jax.lax.fori_loop(0, 20, lambda _, y: jnp.sort(y) + 1, x)).lower(x).compile()
    found = kernels_of(program, lambda: program(x), n_calls=1)
    assert found.launches >= 20
    assert not any("while" in name for name in found.by_function)


def test_the_rest_is_one_row():
    found = Kernels(6.0, 6.0, {"a:f": (3.0, 1.0), "b:g": (2.0, 2.0), "c:h": (1.0, 3.0)})
    assert table(found, n_rows=1).splitlines()[2:] == [
        "| a:f | 3.000 | 1 |",
        "| others | 3.000 | 5 |",
        "| all | 6.000 | 6 |",
    ]
