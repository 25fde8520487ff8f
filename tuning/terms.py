"""A term of a cost law: a product of powers and logarithms of columns, or a column cut where a capacity is exceeded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import numpy as np

from vtfs.input_error import InputError

Shape = Literal["whole", "up_to", "beyond", "step"]


@dataclass(frozen=True)
class Factor:
    """`x ** power * log2(x) ** log_power`; logarithms of what is below 1 count as 0."""

    column: str
    power: float = 1.0
    log_power: int = 0

    def values(self, x: Any, xp: ModuleType = np) -> Any:
        grown = x**self.power if self.power else xp.ones_like(x)
        return grown * xp.log2(xp.maximum(x, 1.0)) ** self.log_power if self.log_power else grown

    @property
    def name(self) -> str:
        parts = []
        if self.power:
            parts.append(self.column if self.power == 1 else f"{self.column}^{self.power:g}")
        if self.log_power:
            parts.append(f"log2({self.column})")
        return " * ".join(parts)


@dataclass(frozen=True)
class Term:
    """Not negative. No factors: the constant 1.

    - `shape`: the product of the factors as it is (`whole`); or of the first factor's column x, with `knot` k:
      `min(x, k)` (`up_to`: what saturates), `max(x - k, 0)` (`beyond`: what a full cache costs), `x > k` (`step`).
    """

    factors: tuple[Factor, ...] = ()
    shape: Shape = "whole"
    knot: float = 0.0

    def values(self, columns: Mapping[str, Any], xp: ModuleType = np) -> Any:
        """float64 `[rows]`; with `jax.numpy` for `xp` it can be differentiated.

        **Raises:** `InputError` where a column is missing.
        """
        if not self.factors:
            return xp.ones_like(next(iter(columns.values())))
        missing = [factor.column for factor in self.factors if factor.column not in columns]
        if missing:
            raise InputError(f"column `{missing[0]}`: missing; the model depends on it, add it to the table.")
        x = xp.asarray(columns[self.factors[0].column], float)
        if self.shape == "up_to":
            return xp.minimum(x, self.knot)
        if self.shape == "beyond":
            return xp.maximum(x - self.knot, 0.0)
        if self.shape == "step":
            return xp.where(x > self.knot, 1.0, 0.0)
        product = xp.ones_like(x)
        for factor in self.factors:
            product = product * factor.values(xp.asarray(columns[factor.column], float), xp)
        return product

    @property
    def name(self) -> str:
        if not self.factors:
            return "1"
        column = self.factors[0].column
        if self.shape == "up_to":
            return f"min({column}, {self.knot:g})"
        if self.shape == "beyond":
            return f"max({column} - {self.knot:g}, 0)"
        if self.shape == "step":
            return f"({column} > {self.knot:g})"
        return " * ".join(factor.name for factor in self.factors)

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(factor.column for factor in self.factors))

    @property
    def size(self) -> int:
        """Numbers that the data has to settle: the cost, and the knot where there is one."""
        return 1 if self.shape == "whole" else 2

    @property
    def surprise(self) -> float:
        """How unlikely beforehand, in nats: x and 1/x least, then x log x, roots and squares, products, cuts."""
        of_factors = sum(0.5 * (abs(f.power) != 1) + 0.5 * (f.power < 0) + f.log_power for f in self.factors)
        return of_factors + 1.5 * max(len(self.factors) - 1, 0) + (0.0 if self.shape == "whole" else 2.0)

    def as_json(self) -> dict[str, object]:
        factors = [[factor.column, factor.power, factor.log_power] for factor in self.factors]
        return {"name": self.name, "factors": factors, "shape": self.shape, "knot": self.knot}

    @classmethod
    def from_json(cls, entry: Mapping[str, object]) -> Term:
        factors = tuple(Factor(str(c), float(a), int(b)) for c, a, b in entry["factors"])  # type: ignore[union-attr]
        return cls(factors, entry["shape"], float(entry["knot"]))  # type: ignore[arg-type]


CONSTANT = Term()
