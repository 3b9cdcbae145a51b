"""Small parts are measured in a larger unit, so that distances which suit parts of usual size suit them, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arview.cad import Model, Part, make_model
from arview.measurement.types import Move
from arview.reconstruction import DenseCloud, PosedPhoto

USUAL_MM = 80.0
"""Diameter from which distances in mm hold for a part; a smaller one is enlarged to it."""


def enlargement(model: Model) -> float:
    """The factor by which a part is enlarged; 1 from a usual size on."""
    return max(1.0, USUAL_MM / model.diameter_mm)


def enlarged(
    cloud: DenseCloud, model: Model, part: Part, photos: Sequence[PosedPhoto], by: float
) -> tuple[DenseCloud, Model, Part, list[PosedPhoto]]:
    """A cloud, the CAD with its symmetries, and the places of photos, enlarged by a factor."""
    components = tuple(replace(one, vertices_in_model=by * one.vertices_in_model) for one in model.components)
    settings = tuple(replace(one, symmetry=one.symmetry and one.symmetry.enlarged(by)) for one in part.settings)
    scale = np.diag([by, by, by, 1.0])
    return (
        replace(cloud, points=cloud.points * by, sigma=(cloud.sigma * by).astype(np.float32)),
        make_model(model.name, components),
        replace(part, settings=settings),
        [replace(one, cam_from_scan=scale @ one.cam_from_scan @ np.linalg.inv(scale)) for one in photos],
    )


def reduced(move: Move, by: float) -> Move:
    """The move of an enlarged component in mm."""
    unit = np.array([1.0] * 3 + [1.0 / by] * 3)
    return replace(
        move,
        center_in_model=move.center_in_model / by,
        twist=move.twist * unit,
        covariance=move.covariance * np.outer(unit, unit),
        radius_mm=move.radius_mm / by,
        residual_mm=move.residual_mm / by,
    )
