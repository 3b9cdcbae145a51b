"""The only module that uses pycolmap directly for cameras and models: its import, half-pixel shift and conversions.

COLMAP has the centre of the first pixel at (0.5, 0.5), arview at (0, 0).
"""

from __future__ import annotations

import contextlib
import signal
import zlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from arview.camera import Camera, require_brown
from arview.core.extras import load
from arview.geometry import Array, rigid
from arview.reconstruction.types import Photo, PosedPhoto, SparseModel

HALF_PX = 0.5
"""COLMAP's minus arview's pixel coordinates."""
SELF_CALIBRATED_MODEL, CALIBRATED_MODEL = "RADIAL", "FULL_OPENCV"
"""COLMAP's camera models: with intrinsics that are refined, and that are kept."""


def import_pycolmap() -> Any:
    """Import pycolmap with its logging silenced.

    It is loaded after Python's zlib, because the other order corrupts the heap.

    Raises:
        MissingDependencyError: pycolmap is not installed.
    """
    zlib.crc32(b"")
    pycolmap = load("a reconstruction from photos", "pycolmap")
    pycolmap.logging.minloglevel = 3
    _take_back_signals()
    return pycolmap


@lru_cache(maxsize=1)
def _take_back_signals() -> None:
    """Remove the signal handlers that pycolmap's logging installs: they print a stack trace when a run is ended."""
    for number in (signal.SIGTERM, signal.SIGINT):
        with contextlib.suppress(ValueError):  # not in the main thread, where handlers cannot be set
            signal.signal(number, signal.getsignal(number) or signal.SIG_DFL)


def colmap_camera(camera: Camera, is_calibrated: bool) -> Any:
    """A pycolmap camera: RADIAL (one focal length, k1, k2) to be refined, or FULL_OPENCV if calibrated.

    Raises:
        InputError: a camera with another lens model, which the later steps do not know.
    """
    camera = require_brown(camera, "reconstruction")
    pycolmap = import_pycolmap()
    cx, cy = camera.cx + HALF_PX, camera.cy + HALF_PX
    k1, k2, p1, p2, k3 = camera.dist
    if is_calibrated:
        model, params = CALIBRATED_MODEL, [camera.fx, camera.fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    else:
        model, params = SELF_CALIBRATED_MODEL, [0.5 * (camera.fx + camera.fy), cx, cy, k1, k2]
    return pycolmap.Camera(
        model=model, width=camera.width, height=camera.height, params=params, has_prior_focal_length=True
    )


def camera_of(camera: Any) -> Camera:
    """A Camera from a pycolmap camera of one of the models that `colmap_camera` creates."""
    params = np.asarray(camera.params, dtype=np.float64)
    if camera.model.name == SELF_CALIBRATED_MODEL:
        focal, cx, cy, k1, k2 = params
        fx = fy = focal
        dist = np.array([k1, k2, 0.0, 0.0, 0.0])
    else:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = params[:9]
        dist = np.array([k1, k2, p1, p2, k3])
    return Camera(camera.width, camera.height, fx, fy, cx - HALF_PX, cy - HALF_PX, dist)


def model_of_poses(posed: Sequence[tuple[Photo, Array]]) -> Any:
    """A pycolmap reconstruction of posed photos without points; photo i has image id i + 1, a lens the id of its first.

    Args:
        posed: photos with ``cam_from_scan`` (4,4).
    """
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    ids: dict[str, int] = {}
    for index, (photo, pose) in enumerate(posed):
        if photo.lens not in ids:
            camera = colmap_camera(photo.camera, photo.is_calibrated)
            ids[photo.lens] = camera.camera_id = len(ids) + 1
            model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=photo.name, camera_id=ids[photo.lens], image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    return model


def sparse_model_of(
    reconstruction: Any, photos: Sequence[Photo], unplaced: Sequence[tuple[str, str]] = ()
) -> SparseModel:
    """The SparseModel of a pycolmap reconstruction; photos keep their order."""
    given = {photo.name: photo for photo in photos}
    order = {photo.name: place for place, photo in enumerate(photos)}
    images = sorted(
        (image for image in reconstruction.images.values() if image.has_pose and image.name in given),
        key=lambda image: order[image.name],
    )
    place_of = {image.image_id: index for index, image in enumerate(images)}
    posed = []
    for image in images:
        matrix = np.asarray(image.cam_from_world().matrix())
        camera = camera_of(reconstruction.cameras[image.camera_id])
        photo = given[image.name]
        posed.append(PosedPhoto(photo.name, photo.path, camera, rigid(matrix[:, :3], matrix[:, 3]), photo.mask))
    point_ids = sorted(reconstruction.points3D)
    points = [reconstruction.points3D[point_id] for point_id in point_ids]
    seen: list[tuple[int, int, int]] = []  # point, photo, index of the feature in the photo
    for row, point in enumerate(points):
        for element in point.track.elements:
            place = place_of.get(element.image_id)
            if place is not None:
                seen.append((row, place, element.point2D_idx))
    observed_point, observed_photo, feature = np.array(seen, dtype=np.int64).reshape(-1, 3).T
    observed_px = np.empty((len(seen), 2))
    for place, image in enumerate(images):
        mine = observed_photo == place
        if mine.any():
            observed_px[mine] = np.array([one.xy for one in image.points2D])[feature[mine]]
    return SparseModel(
        photos=tuple(posed),
        points_in_scan=np.array([point.xyz for point in points]).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        point_errors_px=np.array([point.error for point in points], dtype=np.float64),
        observed_point=observed_point.astype(np.int32),
        observed_photo=observed_photo.astype(np.int32),
        observed_px=observed_px - HALF_PX,
        unplaced=tuple(unplaced),
    )


def update_model(reconstruction: Any, sparse: SparseModel) -> None:
    """Give the calibrated photos and the points of a pycolmap reconstruction the values of ``sparse``, made of it."""
    pycolmap = import_pycolmap()
    images = {image.name: image for image in reconstruction.images.values()}
    for photo in sparse.photos:
        image = images[photo.name]
        reconstruction.cameras[image.camera_id].params = colmap_camera(photo.camera, is_calibrated=True).params
        reconstruction.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(photo.cam_from_scan[:3])
    for point_id, xyz in zip(sorted(reconstruction.points3D), sparse.points_in_scan, strict=True):
        reconstruction.points3D[point_id].xyz = xyz
    reconstruction.update_point_3d_errors()


def read_reconstruction(folder: Path) -> Any:
    """Read the pycolmap reconstruction in a folder."""
    return import_pycolmap().Reconstruction(str(folder))


def write_model(source: Path, target: Path, scale: float, new_from_scan: Array) -> None:
    """Write a copy of a COLMAP model transformed by ``x_new = new_from_scan @ (scale * x)``."""
    pycolmap = import_pycolmap()
    model = read_reconstruction(source)
    rotation = pycolmap.Rotation3d(new_from_scan[:3, :3])
    model.transform(pycolmap.Sim3d(scale, rotation, new_from_scan[:3, 3]))
    target.mkdir(exist_ok=True)
    model.write(str(target))
