"""Decimals of a measured value as its uncertainty allows (GUM 7.2.6): U has two significant digits.

Only what people and other programs read is rounded; ``inspection.json`` keeps every digit.
"""

from __future__ import annotations

import math

SIGNIFICANT_DIGITS = 2
"""Digits of U, and with it the last decimal of the value."""
MAX_DECIMALS = 6
"""Largest number of decimals, for a very small U."""
EXACT_DECIMALS = 4
"""Decimals of exact numbers and of values without U: 0.1 µm."""


def decimals_of(uncertainty: float | None) -> int:
    """Number of decimals of a value with this expanded uncertainty, at least 0; the default without one."""
    if uncertainty is None or not uncertainty > 0.0:
        return EXACT_DECIMALS
    # The exponent of the rounded U: 0.0996 becomes 0.10.
    exponent = int(f"{uncertainty:.{SIGNIFICANT_DIGITS - 1}e}".partition("e")[2])
    return min(max(SIGNIFICANT_DIGITS - 1 - exponent, 0), MAX_DECIMALS)


def decimals_beside_limit(value: float, uncertainty: float | None, limit: float | None) -> int:
    """As `decimals_of`, with more decimals where the rounded value would lie on the other side of the limit."""
    decimals = decimals_of(uncertainty)
    if limit is None or not math.isfinite(value):
        return decimals
    while decimals < MAX_DECIMALS and (round(value, decimals) <= limit) != (value <= limit):
        decimals += 1
    return decimals


def fixed(value: float, decimals: int) -> str:
    """The value with so many decimals and no sign before zero."""
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0.0 else text


def exact(value: float) -> str:
    """An exact number such as a tolerance or a nominal position, without the noise of binary fractions."""
    text = fixed(value, EXACT_DECIMALS)
    text = text.rstrip("0").rstrip(".") if "." in text else text
    if float(text) == 0.0 and value != 0.0:
        return fixed(value, MAX_DECIMALS).rstrip("0").rstrip(".")
    return text
