"""Formatting of numbers and verdicts. An undetermined value is written as a word, never as a number.

Measured lengths of a component have the decimals that its U allows; nominal positions and tolerances are exact.
"""

from __future__ import annotations

from markupsafe import Markup

from arview.inspection import (
    ComponentDeviation,
    Finding,
    ForeignReport,
    Verdict,
    decimals_beside_limit,
    decimals_of,
    exact,
)

UNDETERMINED = Markup('<i class="open">undetermined</i>')
NONE = "–"
VERDICT_WORD = {
    Verdict.PASS: "Pass",
    Verdict.FAIL: "Fail",
    Verdict.UNDECIDED: "Undecided",
    Verdict.MEASURED: "Measured",
    Verdict.NOT_MEASURED: "Not measured",
}


def number(value: float | None, digits: int = 3, signed: bool = False) -> str:
    """A number with a typographic minus; a dash for None."""
    if value is None:
        return NONE
    text = f"{value:{'+' if signed else ''}.{digits}f}"
    if float(text) == 0.0:
        text = text.lstrip("+-")
    return text.replace("-", "−")


def determined(value: float | None, digits: int = 3, signed: bool = False) -> str | Markup:
    """As `number`, but ``undetermined`` for None."""
    return UNDETERMINED if value is None else number(value, digits, signed)


def distance_digits(deviation: ComponentDeviation) -> int:
    """Decimals of the distance: as U allows, and enough to be on the right side of the tolerance."""
    return decimals_beside_limit(deviation.distance_mm or 0.0, deviation.uncertainty_mm, deviation.tolerance_mm)


def exact_number(value: float | None) -> str:
    """An exact number, such as a tolerance; a dash for None."""
    return NONE if value is None else exact(value).replace("-", "−")


def verdict_word(deviation: ComponentDeviation) -> str:
    """The verdict, or ``Missing``."""
    return "Missing" if deviation.finding is Finding.MISSING else VERDICT_WORD[deviation.verdict]


def zone_text(deviation: ComponentDeviation) -> str | Markup:
    """Diameter of the position tolerance zone that contains the component, and the allowed diameter (ISO 1101)."""
    if deviation.distance_mm is None:
        return UNDETERMINED if deviation.verdict is Verdict.UNDECIDED else NONE
    details = deviation.details
    zone = details.zone_diameter_mm if details is not None else None
    text = number(2.0 * deviation.distance_mm if zone is None else zone, distance_digits(deviation))
    if None in deviation.displacement_mm:
        text = f"≥ {text}"  # a displacement along the undetermined axis can only enlarge it
    return text if deviation.tolerance_mm is None else f"{text} ({exact(2.0 * deviation.tolerance_mm)})"


def finding_text(deviation: ComponentDeviation) -> str:
    """Description of a component that did not pass."""
    if deviation.finding is Finding.MISSING:
        return "The component is missing."
    if deviation.distance_mm is None:
        state = "was not measured" if deviation.verdict is Verdict.NOT_MEASURED else "could not be determined"
        return f"Its position {state}."
    digits = decimals_of(deviation.uncertainty_mm)
    distance = number(deviation.distance_mm, distance_digits(deviation))
    text = f"{distance} mm from its design position, U = {number(deviation.uncertainty_mm, digits)} mm"
    if deviation.tolerance_mm is not None:
        text += f"; {exact(deviation.tolerance_mm)} mm is allowed"
    axes = ", ".join(
        f"d{axis}\u00a0{'undetermined' if value is None else number(value, digits, signed=True)}"
        for axis, value in zip("xyz", deviation.displacement_mm, strict=True)
    )
    details = deviation.details
    rotation = ""
    if details is not None and details.angle_tolerance_deg is not None and details.angle_deg is not None:
        rotation = (
            f" Rotated by {number(details.angle_deg, 2)}° ± {number(details.angle_uncertainty_deg, 2)}°,"
            f" {number(details.angle_tolerance_deg, 2)}° is allowed."
        )
    return f"{text}: {axes}.{rotation}"


def short_text(deviation: ComponentDeviation) -> str:
    """Distance, U and tolerance as a caption."""
    distance = number(deviation.distance_mm, distance_digits(deviation))
    text = f"{distance} ± {number(deviation.uncertainty_mm, decimals_of(deviation.uncertainty_mm))} mm"
    return text if deviation.tolerance_mm is None else f"{text} of {exact(deviation.tolerance_mm)}"


def foreign_text(one: ForeignReport) -> str:
    """Description of a foreign object."""
    x, y, z = (number(value, 1) for value in one.center_mm)
    a, b, c = (number(value, 1) for value in one.size_mm)
    box = f"Its bounding box of {a} × {b} × {c} mm has its centre at ({x}, {y}, {z}) mm."
    return f"{one.text[:1].upper()}{one.text[1:]}. {box}"
