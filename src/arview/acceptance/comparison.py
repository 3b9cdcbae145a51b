"""An inspection beside the list of another measurement, such as that of a coordinate measuring machine: E_n numbers.

The E_n number (ISO/IEC 17043, ISO 13528) of a coordinate is the difference of two results over the root of the sum of
their squared U. Up to 1 the results agree within their stated uncertainties. A component has one for each coordinate
that both determine, and the largest decides, so that a coordinate more never hides a difference in another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arview.acceptance.lengths import K
from arview.acceptance.position_list import ListedComponent
from arview.cad import Model
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import ComponentDeviation, Finding, Inspection

MAX_CONTRADICTION_MM = 0.02
"""Difference of positions and deviations in one list that rounding explains."""
_MIN_U_MM = 1e-9
"""A smaller U of both together is none: E_n would be without bound."""


@dataclass(frozen=True)
class ComparedComponent:
    """A component in both measurements.

    Attributes:
        name: of the component.
        difference_mm: (3,) displacement of the inspection minus that of the list, NaN where one of them has none.
        distance_mm: length of the difference over the axes that both have.
        e_n_xyz: (3,) E_n number of each coordinate, NaN where there is no difference or no uncertainty.
        axis: x, y or z, the coordinate with the largest E_n, or with the largest difference where there is none.
        uncertainty_mm: expanded uncertainty (k = 2) of the inspection along the axis.
        list_uncertainty_mm: that of the list; None when the list does not state it.
    """

    name: str
    difference_mm: Array
    distance_mm: float
    e_n_xyz: Array
    axis: str
    uncertainty_mm: float
    list_uncertainty_mm: float | None

    @property
    def e_n(self) -> float | None:
        """The largest E_n number of a coordinate; None when neither measurement states an uncertainty."""
        return None if np.isnan(self.e_n_xyz).all() else float(np.nanmax(self.e_n_xyz))

    @property
    def agrees(self) -> bool | None:
        """Whether E_n is at most 1; None without E_n."""
        return None if self.e_n is None else self.e_n <= 1.0


@dataclass(frozen=True)
class Comparison:
    """The comparison of an inspection with a list.

    Attributes:
        label: file of the list.
        components: those in both, in the order of the list.
        left_out: reasons why components of the list or of the inspection were not compared, by name.
    """

    label: str
    components: tuple[ComparedComponent, ...]
    left_out: dict[str, str]

    @property
    def common_shift_mm(self) -> Array:
        """(3,) mean of the differences: a common shift points to different datum frames."""
        stacked = np.stack([one.difference_mm for one in self.components])
        known = ~np.isnan(stacked)
        return np.asarray(np.where(known, stacked, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))


def compare(
    inspection: Inspection, listed: Sequence[ListedComponent], label: str, model: Model | None = None
) -> Comparison:
    """Compare the components of an inspection with those of a list, in the same datum frame.

    Args:
        inspection: the inspection.
        listed: components of the list.
        label: file of the list, for messages.
        model: the CAD model, for nominal positions that the inspection does not hold.

    Raises:
        InputError: no component is in both.
    """
    found: list[ComparedComponent] = []
    left_out: dict[str, str] = {}
    by_fold = {one.name.casefold(): one for one in inspection.components}
    named = set()
    for line in listed:
        one = inspection.find(line.name) or by_fold.get(line.name.casefold())
        if one is None:
            left_out[line.name] = "the inspection has no such component"
            continue
        named.add(one.name)
        compared = _compare(one, line, _center_of(one, model, line.point))
        if isinstance(compared, str):
            left_out[one.name] = compared
        else:
            found.append(compared)
    left_out |= {one.name: "is not in the list" for one in inspection.components if one.name not in named}
    if not found:
        name, why = next(iter(left_out.items()), ("", "the inspection has no components"))
        raise InputError(f"{label}: no component can be compared ({f'{name}: ' if name else ''}{why})")
    return Comparison(label, tuple(found), left_out)


def comparison_record(comparison: Comparison) -> dict[str, Any]:
    """The comparison as JSON values."""
    return {
        "list": comparison.label,
        "components": [
            {
                "name": one.name,
                "difference_mm": [None if np.isnan(value) else float(value) for value in one.difference_mm],
                "distance_mm": one.distance_mm,
                "axis": one.axis,
                "uncertainty_mm": one.uncertainty_mm,
                "list_uncertainty_mm": one.list_uncertainty_mm,
                "E_n": one.e_n,
                "E_n_xyz": [None if np.isnan(value) else float(value) for value in one.e_n_xyz],
            }
            for one in comparison.components
        ],
        "common_shift_mm": [float(value) for value in comparison.common_shift_mm],
        "left_out": comparison.left_out,
    }


def _compare(one: ComponentDeviation, line: ListedComponent, center: Array | None) -> ComparedComponent | str:
    """The comparison of a component, or the reason why there is none."""
    if one.finding is Finding.MISSING:
        return "is missing by the inspection"
    theirs = line.displacement
    moved = np.zeros(3) if center is None else np.nan_to_num(line.place - center)  # none where x, y, z are nominal
    gap = np.abs(np.nan_to_num(moved - theirs)).max()
    if np.abs(moved).max() > MAX_CONTRADICTION_MM and gap > MAX_CONTRADICTION_MM:
        raise InputError(f"{one.name}: x, y, z and dx, dy, dz of the list contradict each other by {gap:.3f} mm")
    if np.isnan(theirs).all():
        if center is None:
            return "the inspection has no nominal position of the listed point; give --part, or list dx, dy, dz"
        theirs = line.place - center
    ours = np.array([np.nan if value is None else value for value in one.displacement_mm])
    difference = ours - theirs
    axes = np.flatnonzero(~np.isnan(difference))
    if not len(axes):
        return "was not measured" if np.isnan(ours).all() else "has no coordinate that both measurements determine"
    ours_u = K * np.sqrt(np.diag(_covariance(one)))
    theirs_u = np.full(3, np.nan) if line.uncertainty is None else line.uncertainty
    total = np.hypot(ours_u, np.nan_to_num(theirs_u))
    e_n = np.abs(difference) / np.where(total > _MIN_U_MM, total, np.nan)
    axis = int(np.nanargmax(np.abs(difference) if np.isnan(e_n).all() else e_n))
    return ComparedComponent(
        one.name,
        difference,
        float(np.linalg.norm(difference[axes])),
        e_n,
        "xyz"[axis],
        float(ours_u[axis]),
        None if np.isnan(theirs_u[axis]) else float(theirs_u[axis]),
    )


def _center_of(one: ComponentDeviation, model: Model | None, point: str) -> Array | None:
    """(3,) nominal position of the point that a list states: the inspection's own or a named one, mm, or None."""
    stated = None if one.details is None else one.details.measurand
    if point == "mass" and stated not in ("volume_centroid", "area_centroid"):
        return None if model is None else model.component(one.name).centroid_in_model
    if point == "box" and stated != "box_center":
        return None if model is None else np.asarray(model.component(one.name).bounds_in_model.mean(axis=0))
    if one.details is not None:
        return np.array(one.details.center_mm)
    return None if model is None else np.asarray(model.component(one.name).bounds_in_model.mean(axis=0))


def _covariance(one: ComponentDeviation) -> Array:
    """(3,3) covariance of the displacement, mm²; from U where the inspection has no other."""
    if one.details is not None and one.details.covariance is not None:
        return np.array(one.details.covariance)[3:, 3:]
    return np.eye(3) * ((one.uncertainty_mm or 0.0) / K) ** 2
