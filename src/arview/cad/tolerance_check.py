"""Tolerances that cannot be meant, or that photos from the declared distance cannot judge."""

from __future__ import annotations

from arview.cad.component_remarks import Remark, listed
from arview.cad.part import ComponentSettings, Part

MAX_EXTENT_SHARE = 1.0
"""A tolerance of position above this share of the component's largest extent is doubted."""
MAX_ANGLE_DEG = 45.0
"""A tolerance of rotation above this angle is doubted."""
EXPECTED_U_PX = 0.12
"""Expanded uncertainty (k = 2) of a place that two dozen photos of a sharp camera reach, px of a photo from the nearest
declared distance."""


def tolerance_remarks(
    settings: ComponentSettings,
    extents_mm: tuple[float, float, float],
    mm_per_px: float,
) -> list[Remark]:
    """Remarks on the tolerances of a component that is inspected.

    Args:
        settings: of the component.
        extents_mm: its extents, largest first.
        mm_per_px: size of a pixel at the nearest distance from which it is photographed.
    """
    if settings.role != "inspect":
        return []
    remarks = []
    tolerance_mm, angle_deg = settings.position_tolerance_mm, settings.angle_tolerance_deg
    expected_u_mm = EXPECTED_U_PX * mm_per_px
    if tolerance_mm is not None and tolerance_mm > MAX_EXTENT_SHARE * extents_mm[0]:
        text = f"has a position_tolerance_mm of {tolerance_mm:g}, larger than itself ({extents_mm[0]:.3g} mm)"
        remarks.append(
            Remark(
                "warning",
                settings.name,
                f"{text}: is it in another unit?",
                "have a position_tolerance_mm larger than themselves, {low} to {high} mm",
                tolerance_mm,
            )
        )
    if angle_deg is not None and angle_deg > MAX_ANGLE_DEG:
        remarks.append(
            Remark(
                "warning",
                settings.name,
                f"has an angle_tolerance_deg of {angle_deg:g}, with which hardly any rotation fails",
                "have an angle_tolerance_deg of {low} to {high}, with which hardly any rotation fails",
                angle_deg,
            )
        )
    if tolerance_mm is not None and tolerance_mm < expected_u_mm:
        remarks.append(
            Remark(
                "warning",
                settings.name,
                f"has a position_tolerance_mm of {tolerance_mm:g}, below the uncertainty to be expected of photos from "
                f"the nearest distance, {expected_u_mm:.2g} mm: it will be undecided; come nearer or use a "
                "sharper camera",
                "have a position_tolerance_mm of {low} to {high}, below the uncertainty to be expected of photos from "
                f"the nearest distance, {expected_u_mm:.2g} mm: they will be undecided",
                tolerance_mm,
            )
        )
    return remarks


def untold_tolerances(part: Part) -> list[str]:
    """A text on components that are inspected without a tolerance of position."""
    names = [name for name in part.inspected if part.component_settings(name).position_tolerance_mm is None]
    return [f"no position_tolerance_mm, so measured but not judged: {listed(names, 6)}"] if names else []
