"""COLMAP's database: photos with their features, and the matches of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from arview.reconstruction.colmap import HALF_PX, colmap_camera, import_pycolmap
from arview.reconstruction.features import Features
from arview.reconstruction.matching import Matches
from arview.reconstruction.pairs import Pair
from arview.reconstruction.types import Photo


def write_database(
    path: Path,
    photos: Sequence[Photo],
    features: Sequence[Features],
    pairs: dict[Pair, Matches],
    min_matches: int,
    seed: int,
) -> None:
    """Write COLMAP's database; photo i has image id i + 1.

    Args:
        path: of the database.
        photos: the photos.
        features: of each photo.
        pairs: matches by pairs of photos.
        min_matches: pairs with fewer matches on one two-view geometry are left out.
        seed: of its estimation.
    """
    pycolmap = import_pycolmap()
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(str(path)) as database:
        cameras: dict[str, Any] = {}
        for index, photo in enumerate(photos):
            if photo.lens not in cameras:
                camera = colmap_camera(photo.camera, photo.is_calibrated)
                camera.camera_id = database.write_camera(camera)
                cameras[photo.lens] = camera
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            camera = cameras[photo.lens]
            image = pycolmap.Image(name=photo.name, camera_id=camera.camera_id, image_id=index + 1)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera.camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(index + 1, features[index].points_px + np.float32(HALF_PX))
        verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=min_matches)
        verification.ransac.random_seed = seed
        verification.ransac.max_num_trials = 2000
        for (i, j), matches in pairs.items():
            geometry = pycolmap.estimate_two_view_geometry(
                cameras[photos[i].lens],
                features[i].points_px.astype(np.float64) + HALF_PX,
                cameras[photos[j].lens],
                features[j].points_px.astype(np.float64) + HALF_PX,
                matches,
                verification,
            )
            if len(geometry.inlier_matches) >= min_matches:
                database.write_matches(i + 1, j + 1, matches)
                database.write_two_view_geometry(i + 1, j + 1, geometry)


def write_matches(path: Path, pairs: dict[Pair, Matches]) -> None:
    """Replace the matches of the first pass by those of the second."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(str(path)) as database:
        database.clear_matches()
        database.clear_two_view_geometries()
        for (i, j), matches in pairs.items():
            if len(matches) == 0:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches
            database.write_matches(i + 1, j + 1, matches)
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def emptied(folder: Path) -> Path:
    """The folder, created if missing, without files of an earlier run."""
    folder.mkdir(exist_ok=True)
    for old in folder.rglob("*"):
        if old.is_file():
            old.unlink()
    return folder
