"""Photos whose places are exact in a frame that is off by a little, as a reconstruction that is to be measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from arview.camera import Camera
from arview.geometry import Array, exp_so3, invert, rigid
from arview.measurement.folder import MetricReconstruction
from arview.reconstruction.scale.types import Consistency, ScaleEvidence, ScaleResult
from arview.reconstruction.types import PosedPhoto, SparseModel
from helpers.photo_scene import Picture, write_photos

ROUGH_FROM_TRUE = rigid(exp_so3(np.deg2rad([0.03, -0.02, 0.05])), [0.15, -0.2, 0.1])
"""0.27 mm and 0.06°."""
POSE_STD = (3e-6, 2e-3)
"""Standard uncertainties of the poses that are declared, rad and mm."""


def placed(folder: Path, pictures: list[Picture], poses: Sequence[Array], camera: Camera) -> MetricReconstruction:
    """Photos with their ``cam_from_model`` (4,4), written to a folder; without points or a cloud."""
    photos = tuple(
        PosedPhoto(path.name, path, camera, pose @ invert(ROUGH_FROM_TRUE))
        for path, pose in zip(write_photos(folder, pictures), poses, strict=True)
    )
    none = np.zeros(0)
    covariance = np.diag(np.tile(np.repeat(POSE_STD, 3), len(photos))) ** 2
    sparse = SparseModel(
        photos, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none.astype(np.int32), none.astype(np.int32),
        np.zeros((0, 2)), pose_covariance=covariance,
    )  # fmt: skip
    evidence = (ScaleEvidence("board", 1.0, 5e-5, "a board"),)
    scale = ScaleResult(1.0, 5e-5, np.eye(4), None, evidence, (), "", Consistency(True, "checked"))
    return MetricReconstruction(sparse, scale, None)
