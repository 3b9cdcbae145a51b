"""Tolerances that cannot be meant, or that photos from the declared distance cannot judge."""

from __future__ import annotations

from dataclasses import dataclass

from arview.cad.component_remarks import Remark, listed
from arview.cad.part import ComponentSettings, Part


@dataclass(frozen=True)
class ToleranceCheckOptions:
    """Limits of tolerances.

    Attributes:
        max_extent_share: a tolerance of position above this share of the component's largest extent is doubted.
        max_angle_deg: a tolerance of rotation above it is doubted.
        expected_u_px: expanded uncertainty (k = 2) of a place that two dozen photos of a sharp camera reach, px of a
            photo from the nearest declared distance.
    """

    max_extent_share: float = 1.0
    max_angle_deg: float = 45.0
    expected_u_px: float = 0.12


def tolerance_remarks(
    settings: ComponentSettings,
    extents_mm: tuple[float, float, float],
    mm_per_px: float,
    options: ToleranceCheckOptions | None = None,
) -> list[Remark]:
    """Remarks on the tolerances of a component that is inspected.

    Args:
        settings: of the component.
        extents_mm: its extents, largest first.
        mm_per_px: size of a pixel at the nearest distance from which it is photographed.
        options: see `ToleranceCheckOptions`.
    """
    options = options or ToleranceCheckOptions()
    if settings.role != "inspect":
        return []
    remarks = []
    tolerance_mm, angle_deg = settings.position_tolerance_mm, settings.angle_tolerance_deg
    expected_u_mm = options.expected_u_px * mm_per_px
    if tolerance_mm is not None and tolerance_mm > options.max_extent_share * extents_mm[0]:
        text = f"has a position_tolerance_mm of {tolerance_mm:g}, larger than itself ({extents_mm[0]:.3g} mm)"
        plural = "have a position_tolerance_mm larger than themselves, {low} to {high} mm"
        remarks.append(Remark("warning", settings.name, f"{text}: is it in another unit?", plural, tolerance_mm))
    if angle_deg is not None and angle_deg > options.max_angle_deg:
        text = f"has an angle_tolerance_deg of {angle_deg:g}, with which hardly any rotation fails"
        plural = "have an angle_tolerance_deg of {low} to {high}, with which hardly any rotation fails"
        remarks.append(Remark("warning", settings.name, text, plural, angle_deg))
    if tolerance_mm is not None and tolerance_mm < expected_u_mm:
        text = (
            f"has a position_tolerance_mm of {tolerance_mm:g}, below the uncertainty to be expected of photos from the "
            f"nearest distance, {expected_u_mm:.2g} mm: it will be undecided; come nearer or use a sharper camera"
        )
        plural = (
            "have a position_tolerance_mm of {low} to {high}, below the uncertainty to be expected of photos from the "
            f"nearest distance, {expected_u_mm:.2g} mm: they will be undecided"
        )
        remarks.append(Remark("warning", settings.name, text, plural, tolerance_mm))
    return remarks


def untold_tolerances(part: Part) -> list[str]:
    """A text on components that are inspected without a tolerance of position."""
    names = [name for name in part.inspected if part.component_settings(name).position_tolerance_mm is None]
    return [f"no position_tolerance_mm, so measured but not judged: {listed(names, 6)}"] if names else []
