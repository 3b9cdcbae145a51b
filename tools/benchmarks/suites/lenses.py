"""Errors of the lens models against OpenCV and COLMAP, and of what replaces them in the engine."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from arview.camera import Camera
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.undistort import FrameView, Undistorter
from arview.geometry import Array
from recordings import skip

WIDTH, HEIGHT = 1280, 720
LENSES = {
    "Brown": None,
    "rational": LensDistortion(LensModel.RATIONAL, (0.51, -2.73, 7e-4, -2e-4, 1.55, 0.39, -2.55, 1.47)),
    "rational, thin prism": LensDistortion(
        LensModel.RATIONAL, (0.51, -2.73, 7e-4, -2e-4, 1.55, 0.39, -2.55, 1.47, 1e-3, -2e-3, 5e-4, 1e-4)
    ),
    "fisheye": LensDistortion(LensModel.FISHEYE, (-0.021, 0.0061, -0.0034, 0.0007)),
    "fisheye, thin prism": LensDistortion(
        LensModel.THIN_PRISM_FISHEYE, (-0.02, 0.006, 1e-3, -5e-4, -0.003, 7e-4, 8e-4, -6e-4)
    ),
    "field of view": LensDistortion(LensModel.FOV, (0.9,)),
    "division": LensDistortion(LensModel.DIVISION, (-0.2,)),
    "inverse Brown": LensDistortion(LensModel.INVERSE_BROWN, (-0.055, 0.061, 1e-3, -5e-4, -0.02)),
}
_BROWN = np.array([-0.3, 0.09, 1e-3, -5e-4, 0.0])


def lens_errors() -> Iterator[tuple[str, str, float, float, float]]:
    """For each lens: name, reference, largest errors in px of projection, of the way back, and of what is tracked.

    The last is how far a ray is, in the picture that the engine's kernels get, from where these project it.
    """
    grid = np.stack(np.meshgrid(np.linspace(0, WIDTH - 1, 33), np.linspace(0, HEIGHT - 1, 21)), axis=-1).reshape(-1, 2)
    for name, lens in LENSES.items():
        dist = _BROWN if lens is None else np.zeros(5)
        camera = Camera(WIDTH, HEIGHT, 620.0, 621.0, 645.5, 357.5, dist, lens)
        rays = camera.unproject(grid)
        library, expected = _reference(camera, rays)
        forth = float(np.abs(expected - camera.project(rays)).max()) if library else float("nan")
        back = float(np.abs(camera.project(rays) - grid).max())
        yield name, library or "-", forth, back, _tracked_error(camera)


def _reference(camera: Camera, rays: Array) -> tuple[str, Array]:
    """The name of the library that knows a lens, and its pixels (N,2) of rays; an empty name without it."""
    still = np.zeros(3)
    lens = camera.lens
    if lens is not None and lens.model is LensModel.FISHEYE:
        found = cv2.fisheye.projectPoints(rays[:, None], still, still, camera.matrix, np.array(lens.terms))[0]
        return "OpenCV", np.asarray(found[:, 0], dtype=np.float64)
    if lens is None or lens.model is LensModel.RATIONAL:
        terms = camera.dist if lens is None else np.array(lens.terms)
        found = cv2.projectPoints(rays[:, None], still, still, camera.matrix, terms)[0]
        return "OpenCV", np.asarray(found[:, 0], dtype=np.float64)
    if lens.model is LensModel.INVERSE_BROWN:
        # OpenCV's formula is this lens's way from pixels to rays: where it leads to the ray, the pixel is right.
        pixels = camera.project(rays)
        ideal = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))])
        found = cv2.projectPoints(ideal[:, None], still, still, np.eye(3), np.array(lens.terms))[0][:, 0]
        return "OpenCV", pixels + (found - rays[:, :2]) * [camera.fx, camera.fy]
    try:
        import pycolmap
    except ImportError:
        skip(f"lens {lens.model}", "pycolmap is not installed")
        return "", rays[:, :2]
    params = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *lens.terms]
    other = pycolmap.Camera(model=lens.model.upper(), width=WIDTH, height=HEIGHT, params=params)
    return "pycolmap", np.array([other.img_from_cam(ray) for ray in rays]) - 0.5


def _tracked_error(camera: Camera) -> float:
    """Largest distance, px of the tracked picture, by which the resampling maps miss the lens; 0 without resampling."""
    if not FrameView(camera).is_resampling:
        return 0.0
    undistorter = Undistorter(camera)
    ideal = undistorter.ideal
    # A picture whose grey value is the column, and one for the row, tell where each resampled pixel comes from.
    u, v = np.meshgrid(np.arange(0, ideal.width, 16.0), np.arange(0, ideal.height, 16.0))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    seen = camera.project(ideal.unproject(pixels))
    inside = ((seen > 1) & (seen < [WIDTH - 2, HEIGHT - 2])).all(axis=1)
    whole, part = undistorter.maps
    rows, columns = pixels[inside].astype(int)[:, ::-1].T
    code = part[rows, columns]
    taken = whole[rows, columns] + np.stack([code % cv2.INTER_TAB_SIZE, code // cv2.INTER_TAB_SIZE], -1) / 32.0
    return float(np.linalg.norm(taken - seen[inside], axis=1).max())
