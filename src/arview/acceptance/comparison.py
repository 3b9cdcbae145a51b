"""An inspection beside the list of another measurement, such as that of a coordinate measuring machine: E_n numbers.

The E_n number (ISO/IEC 17043, ISO 13528) of a scalar is the difference of two results over the root of the sum of their
squared U. Here a component has up to three coordinates with one covariance: the squared difference in the metric of the
summed covariances, over the quantile of chi-squared that has the coverage of k = 2, which is E_n itself for one
coordinate. Up to 1 the results agree within their stated uncertainties.
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

_COVERAGE = 0.9545
"""Coverage of U with k = 2 for a normally distributed error."""


@dataclass(frozen=True)
class ComparedComponent:
    """A component in both measurements.

    Attributes:
        name: of the component.
        difference_mm: (3,) displacement of the inspection minus that of the list, NaN where one of them has none.
        distance_mm: length of the difference over the axes that both have.
        uncertainty_mm: expanded uncertainty (k = 2) of the inspection along the difference.
        list_uncertainty_mm: that of the list; None when the list does not state it.
        e_n: E_n number; None when neither measurement states an uncertainty.
    """

    name: str
    difference_mm: Array
    distance_mm: float
    uncertainty_mm: float
    list_uncertainty_mm: float | None
    e_n: float | None

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
                "uncertainty_mm": one.uncertainty_mm,
                "list_uncertainty_mm": one.list_uncertainty_mm,
                "E_n": one.e_n,
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
    if np.isnan(theirs).all():
        if center is None:
            return "the inspection has no nominal position of the listed point; give --part, or list dx, dy, dz"
        theirs = line.place - center
    ours = np.array([np.nan if value is None else value for value in one.displacement_mm])
    difference = ours - theirs
    axes = np.flatnonzero(~np.isnan(difference))
    if not len(axes):
        return "was not measured" if np.isnan(ours).all() else "has no coordinate that both measurements determine"
    known = difference[axes]
    distance = float(np.linalg.norm(known))
    along = known / distance if distance > 0.0 else np.full(len(axes), len(axes) ** -0.5)
    covariance = _covariance(one)[np.ix_(axes, axes)]
    of_list = None
    if line.uncertainty is not None and not np.isnan(line.uncertainty[axes]).any():
        of_list = np.diag((line.uncertainty[axes] / K) ** 2)
    total = covariance if of_list is None else covariance + of_list
    return ComparedComponent(
        one.name,
        difference,
        distance,
        K * float(np.sqrt(along @ covariance @ along)),
        None if of_list is None else K * float(np.sqrt(along @ of_list @ along)),
        _e_n(known, total),
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


def _e_n(difference: Array, covariance: Array) -> float | None:
    from scipy import stats

    values, vectors = np.linalg.eigh(covariance)
    if values.min() <= 1e-18:
        return None
    squared = float((((vectors.T @ difference) ** 2) / values).sum())
    return float(np.sqrt(squared / stats.chi2.ppf(_COVERAGE, len(difference))))
