"""A cost law: a sum of terms with positive costs, or the smooth maximum of two such sums."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tuning.terms import Term

SHARPNESS = 16.0
"""Of the smooth maximum `(a^p + b^p)^(1/p)`: 4 % above the larger where both are equal, 0.4 % where one is 1.2 times
the other."""


@dataclass(frozen=True)
class Law:
    """Milliseconds as `sum(cost * term)`, or where `sides` has ones too, the smooth maximum of the sums of both sides:
    two resources that work at the same time, as a CPU beside a GPU, or bandwidth beside arithmetic (a roofline).

    - `costs_ms`: positive, one a term.
    """

    terms: tuple[Term, ...]
    costs_ms: tuple[float, ...]
    sides: tuple[int, ...]

    def predict(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """float64 `[rows]`.

        **Raises:** `InputError` where a column is missing.
        """
        return combined(self.design(columns), np.array(self.costs_ms), np.array(self.sides))

    def predict_one(self, point: Mapping[str, Any]) -> Any:
        """The same for one row of JAX scalars, to be differentiated; milliseconds."""
        import jax.numpy as jnp

        totals = [
            sum(
                cost * term.values(point, jnp)
                for term, cost, of in zip(self.terms, self.costs_ms, self.sides, strict=True)
                if of == side
            )
            for side in sorted(set(self.sides))
        ]
        larger = jnp.maximum(totals[0], totals[-1])
        if len(totals) == 1:
            return larger
        return larger * (1 + (jnp.minimum(*totals) / larger) ** SHARPNESS) ** (1 / SHARPNESS)

    def design(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """float64 `[rows, terms]`."""
        return np.stack([term.values(columns) for term in self.terms], axis=1)

    def slopes(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """d log(time) / d log(cost), `[rows, terms]`: each term's share of the time; rows add up to 1."""
        parts = self.design(columns) * np.array(self.costs_ms)
        sides = np.array(self.sides)
        total = np.stack([parts[:, sides == side].sum(axis=1) for side in (0, 1)], axis=1)
        largest = np.maximum(total.max(axis=1, keepdims=True), 1e-300)
        powers = (total / largest) ** SHARPNESS
        of_side = powers / powers.sum(axis=1, keepdims=True)
        return of_side[:, sides] * parts / np.maximum(total[:, sides], 1e-300)

    @property
    def size(self) -> int:
        return sum(term.size for term in self.terms if term.factors) + (1 if any(self.sides) else 0)

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(column for term in self.terms for column in term.columns))

    @property
    def text(self) -> str:
        sums = [
            " + ".join(
                f"{cost:.4g}" if not term.factors else f"{cost:.4g} * {term.name}"
                for term, cost, of in zip(self.terms, self.costs_ms, self.sides, strict=True)
                if of == side
            )
            for side in (0, 1)
        ]
        return sums[0] if not sums[1] else f"smooth max({sums[0]}, {sums[1]})"

    def as_json(self) -> dict[str, object]:
        return {
            "text": self.text,
            "terms": [
                term.as_json() | {"cost_ms": cost, "side": side}
                for term, cost, side in zip(self.terms, self.costs_ms, self.sides, strict=True)
            ],
        }

    @classmethod
    def from_json(cls, entry: Mapping[str, object]) -> Law:
        terms: Sequence[Mapping[str, object]] = entry["terms"]  # type: ignore[assignment]
        return cls(
            tuple(Term.from_json(term) for term in terms),
            tuple(float(term["cost_ms"]) for term in terms),  # type: ignore[arg-type]
            tuple(int(term["side"]) for term in terms),  # type: ignore[call-overload]
        )


def combined(design: np.ndarray, costs_ms: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Times `[..., rows]` of a design `[rows, terms]` and costs `[..., terms]`."""
    first, second = ((costs_ms * (sides == side)) @ design.T for side in (0, 1))
    larger, smaller = np.maximum(first, second), np.minimum(first, second)
    ratio = smaller / np.maximum(larger, 1e-300)
    return larger * (1 + ratio**SHARPNESS) ** (1 / SHARPNESS)
