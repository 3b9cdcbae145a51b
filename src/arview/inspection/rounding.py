"""Decimals of a measured value as its uncertainty allows (GUM 7.2.6): U has two significant digits.

Only what people and other programs read is rounded; ``inspection.json`` keeps every digit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class RoundingOptions:
    """Digits of values in texts and exports."""

    significant_digits: int = 2  # digits of U, and with it the last decimal of the value
    max_decimals: int = 6  # largest number of decimals, for a very small U
    exact_decimals: int = 4  # decimals of exact numbers and of values without U: 0.1 µm


DEFAULT_ROUNDING = RoundingOptions()


def decimals_of(uncertainty: float | None, options: RoundingOptions = DEFAULT_ROUNDING) -> int:
    """Number of decimals of a value with this expanded uncertainty, at least 0; the default without one."""
    if uncertainty is None or not uncertainty > 0.0:
        return options.exact_decimals
    # The exponent of the rounded U: 0.0996 becomes 0.10.
    exponent = int(f"{uncertainty:.{options.significant_digits - 1}e}".partition("e")[2])
    return min(max(options.significant_digits - 1 - exponent, 0), options.max_decimals)


def decimals_beside_limit(
    value: float, uncertainty: float | None, limit: float | None, options: RoundingOptions = DEFAULT_ROUNDING
) -> int:
    """As `decimals_of`, with more decimals where the rounded value would lie on the other side of the limit."""
    decimals = decimals_of(uncertainty, options)
    if limit is None or not math.isfinite(value):
        return decimals
    while decimals < options.max_decimals and (round(value, decimals) <= limit) != (value <= limit):
        decimals += 1
    return decimals


def fixed(value: float, decimals: int) -> str:
    """The value with so many decimals and no sign before zero."""
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0.0 else text


def exact(value: float, options: RoundingOptions = DEFAULT_ROUNDING) -> str:
    """An exact number such as a tolerance or a nominal position, without the noise of binary fractions."""
    text = fixed(value, options.exact_decimals)
    text = text.rstrip("0").rstrip(".") if "." in text else text
    if float(text) == 0.0 and value != 0.0:
        return fixed(value, options.max_decimals).rstrip("0").rstrip(".")
    return text
