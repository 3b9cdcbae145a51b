"""Small parts are measured in a larger unit, so that distances which suit parts of usual size suit them, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arview.cad import Model, Part, make_model
from arview.geometry import Array, rigid
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
    sigma = np.asarray(cloud.sigma * by, dtype=np.float32)
    components = tuple(replace(one, vertices_in_model=by * one.vertices_in_model) for one in model.components)
    settings = []
    for one in part.settings:
        x, y, z = one.symmetry.through_in_model if one.symmetry else (0.0, 0.0, 0.0)
        symmetry = one.symmetry and replace(one.symmetry, through_in_model=(by * x, by * y, by * z))
        settings.append(replace(one, symmetry=symmetry))
    return (
        replace(cloud, points=cloud.points * by, sigma=sigma),
        make_model(model.name, components),
        replace(part, settings=tuple(settings)),
        [replace(one, cam_from_scan=_at(one.cam_from_scan, by)) for one in photos],
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


def _at(pose: Array, by: float) -> Array:
    return rigid(pose[:3, :3], by * pose[:3, 3])
