"""Numbers as an engineer reads them: three digits, a unit, and a no-break space between the two."""

from __future__ import annotations

import math

from tuning.measurement import FLOAT32_ERROR

EXACT_BELOW = FLOAT32_ERROR
"""An image whose error is below this differs from the float64 reference by float32 rounding alone."""

_SPACE = "\u00a0"


def digits(value: float) -> str:
    """Three significant digits without an exponent; from 1,000 on all that stand before the point."""
    if abs(value) >= 999.5:
        return f"{value:,.0f}"
    value = float(f"{value:.3g}")  # first, since 99.96 has one digit more when it is rounded
    if value == 0:
        return "0"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}"


def ms(value: float | None) -> str:
    return "–" if value is None else f"{digits(value)}{_SPACE}ms"


def seconds(value: float | None) -> str:
    return "–" if value is None else f"{digits(value)}{_SPACE}s"


def ratio(value: float) -> str:
    return f"{value:.2f}×"


def ratios(low: float, high: float) -> str:
    return f"{low:.2f} to {high:.2f}"


def count(value: float | None) -> str:
    """A whole number in full; a mean with three digits."""
    if value is None:
        return "–"
    return f"{value:,.0f}" if value == int(value) else digits(value)


def percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.{1 if share < 0.1 else 0}f}{_SPACE}%"


def error(value: float | None) -> str:
    """An image's error; "exact" where only rounding is left."""
    if value is None:
        return "–"
    return "exact" if value < EXACT_BELOW else f"{value:.1e}".replace("e-0", "e-")


def cost(ms_per_op: float) -> str:
    """The time of one operation, in the unit that needs no exponent."""
    for unit, ms_per_unit in (("ms", 1.0), ("µs", 1e-3), ("ns", 1e-6)):
        if ms_per_op >= ms_per_unit:
            return f"{digits(ms_per_op / ms_per_unit)}{_SPACE}{unit}"
    return f"{digits(ms_per_op / 1e-9)}{_SPACE}ps" if ms_per_op else "0"


def setting(value: object) -> str:
    """The value of a parameter: 0 for 0.0."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def interval(low: float, high: float) -> str:
    """Both ends with the same decimals, so that they line up."""
    smallest = min((abs(end) for end in (low, high) if end), default=1.0)
    decimals = max(0, 2 - math.floor(math.log10(smallest)))
    return f"{low:,.{decimals}f} to {high:,.{decimals}f}"
