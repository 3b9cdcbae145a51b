"""The motion that brings a component to its design place, with its uncertainty and what of it is not known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arview import measurement
from arview.cad import Model, Part
from arview.core.fits import row_space
from arview.core.messages import sentence
from arview.geometry import Array, apply, log_so3
from arview.inspection import ComponentDeviation
from arview.quality.rework.words import up_of


@dataclass(frozen=True)
class Standing:
    """Where a component belongs and on what it stands, by the CAD.

    Attributes:
        component: its name.
        center_in_model: (3,) nominal position of the point whose displacement is stated, mm.
        point: that point, in words, a message.
        normal_in_model: (3,) unit vector away from what it stands on; up where it stands on nothing.
        seat: name of the component on which it stands; empty if it stands on none.
        axis_in_model: (3,) its own axis: tilt is that of this axis, twist the turn about it.
        radius_mm: half the diagonal of its bounding box.
        is_round: nothing changes when it turns about its own axis.
    """

    component: str
    center_in_model: Array
    point: str
    normal_in_model: Array
    seat: str
    axis_in_model: Array
    radius_mm: float
    is_round: bool


@dataclass(frozen=True)
class Correction:
    """The motion back to the design place; undetermined directions are zero.

    Attributes:
        shift_mm: (3,) translation of the point, in the axes of the model.
        rotation_rad: (3,) rotation vector about the point.
        covariance: (6,6) of rotation (rad) and shift (mm).
        k: coverage factor of U.
        free_shifts: (N,3) orthonormal directions in which the position is not known.
        free_turns: (N,3) orthonormal axes about which the rotation is not known.
    """

    shift_mm: Array
    rotation_rad: Array
    covariance: Array
    k: float
    free_shifts: Array
    free_turns: Array

    def shift_uncertainty_mm(self, row: Array) -> float:
        """U of ``row @ shift_mm``."""
        return float(self.k * np.sqrt(max(0.0, float(row @ self.covariance[3:, 3:] @ row))))

    def turn_uncertainty_rad(self, row: Array) -> float:
        """U of ``row @ rotation_rad``."""
        return float(self.k * np.sqrt(max(0.0, float(row @ self.covariance[:3, :3] @ row))))


def standing_of(one: ComponentDeviation, part: Part) -> Standing:
    """Where a component of an inspection belongs and on what it stands.

    Raises:
        InputError: the model has no such component, or it has no point such as the part file names.
    """
    component = part.model.component(one.name)
    measurand = measurement.measurand_of(one.name, part)
    details = one.details
    center, kind = measurand.point_in_model, measurand.kind
    axis, axis_from = measurand.axes[2], measurand.axis_from
    if details is not None:
        center, kind = np.array(details.center_mm), details.measurand
        if details.axes is not None and details.axis_from is not None:
            axis, axis_from = np.array(details.axes)[2], details.axis_from
    seat = measurement.seat_of(component, part.model)
    normal = up_of(part) if seat is None or seat.normal is None else seat.normal
    low, high = component.bounds_in_model
    return Standing(
        component=one.name,
        center_in_model=center,
        point=sentence(f"point.{kind}"),
        normal_in_model=normal / np.linalg.norm(normal),
        seat="" if seat is None else _seat_name(one.name, part, seat.middle),
        axis_in_model=axis / np.linalg.norm(axis),
        radius_mm=0.5 * float(np.linalg.norm(high - low)),
        is_round=axis_from == "symmetry",
    )


def _seat_name(name: str, part: Part, middle: Array) -> str:
    """The component with which most of the points of another are in contact."""
    model, component = part.model, part.model.component(name)
    corners = component.vertices_in_model[component.faces]
    points = np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1), middle[None]])
    others = [one for one in model.components if one.name != name]
    pairs = [Model(model.name, (component, one), model.source_hash) for one in others]
    counts = {pair.components[1].name: int(measurement.near_others(points, pair, 0, 0.3).sum()) for pair in pairs}
    best = max(counts, key=lambda one: counts[one], default="")
    return best if best and counts[best] else ""


def correction_of(one: ComponentDeviation, standing: Standing) -> Correction:
    """The motion that takes a measured component back to its design place."""
    details = one.details
    shift = -np.array([value or 0.0 for value in one.displacement_mm])
    rotation = np.zeros(3)
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.eye(3) * (0.5 * (one.uncertainty_mm or 0.0)) ** 2
    k = 2.0
    free = np.zeros((0, 6))
    if details is not None:
        if details.measured_from_nominal is not None:
            measured = np.array(details.measured_from_nominal)
            shift = standing.center_in_model - apply(measured, standing.center_in_model)
            rotation = -log_so3(measured[:3, :3])
        if details.covariance is not None:
            covariance = np.array(details.covariance)
        k = details.k or k
        free = np.array(details.undetermined).reshape(-1, 6)
    if not len(free):
        free = np.eye(6)[[index for index, seen in enumerate(one.observable) if not seen]]
    free_shifts, free_turns = _span(free[:, 3:]), _span(free[:, :3])
    shift = shift - free_shifts.T @ (free_shifts @ shift)
    rotation = rotation - free_turns.T @ (free_turns @ rotation)
    return Correction(shift, rotation, covariance, k, free_shifts, free_turns)


def _span(rows: Array) -> Array:
    """(N,3) orthonormal directions that rows (K,3) span; short rows are noise."""
    return row_space(rows[np.linalg.norm(rows, axis=1) > 0.05], 0.05)
