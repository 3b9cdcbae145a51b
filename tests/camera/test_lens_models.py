"""Lens models against OpenCV and COLMAP, and what replaces them in the engine."""

import cv2
import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.undistort import Undistorter, brown_camera, require_brown
from arview.errors import InputError
from arview.geometry import Array
from arview.refinement.projection import intrinsics_of

FISHEYE = LensDistortion(LensModel.FISHEYE, (-0.021, 0.0061, -0.0034, 0.0007))
RATIONAL = LensDistortion(LensModel.RATIONAL, (0.51, -2.73, 0.0007, -0.0002, 1.55, 0.39, -2.55, 1.47))
THIN_PRISM = LensDistortion(LensModel.RATIONAL, (*RATIONAL.terms[:8], 1e-3, -2e-3, 5e-4, 1e-4))
FOV = LensDistortion(LensModel.FOV, (0.9,))
DIVISION = LensDistortion(LensModel.DIVISION, (-0.2,))
PRISM_FISHEYE = LensDistortion(LensModel.THIN_PRISM_FISHEYE, (-0.02, 0.006, 1e-3, -5e-4, -0.003, 7e-4, 8e-4, -6e-4))
INVERSE_BROWN = LensDistortion(LensModel.INVERSE_BROWN, (-0.055, 0.061, 1e-3, -5e-4, -0.02))
LENSES = {
    "fisheye": FISHEYE, "rational": RATIONAL, "thin prism": THIN_PRISM, "fov": FOV, "division": DIVISION,
    "thin prism fisheye": PRISM_FISHEYE,
}  # fmt: skip


def camera_with(lens: LensDistortion) -> Camera:
    return Camera(1280, 720, 620.0, 621.0, 645.5, 357.5, lens=lens)


def pixels() -> Array:
    return np.stack(np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 719, 21)), axis=-1).reshape(-1, 2)


def reference(camera: Camera, rays: Array) -> Array:
    """Pixels by OpenCV, or by COLMAP for the models that only it has."""
    assert camera.lens is not None
    no_move = np.zeros(3)
    if camera.lens.model is LensModel.FISHEYE:
        found = cv2.fisheye.projectPoints(rays[:, None], no_move, no_move, camera.matrix, np.array(camera.lens.terms))
        return np.asarray(found[0][:, 0], dtype=np.float64)
    if camera.lens.model is LensModel.RATIONAL:
        found = cv2.projectPoints(rays[:, None], no_move, no_move, camera.matrix, np.array(camera.lens.terms))
        return np.asarray(found[0][:, 0], dtype=np.float64)
    pycolmap = pytest.importorskip("pycolmap")
    params = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *camera.lens.terms]
    other = pycolmap.Camera(model=camera.lens.model.upper(), width=1280, height=720, params=params)
    return np.array([other.img_from_cam(ray) for ray in rays]) - 0.5


@pytest.mark.parametrize("name", LENSES)
def test_lens_is_that_of_opencv_and_colmap(name: str) -> None:
    camera = camera_with(LENSES[name])
    rays = camera.unproject(pixels())
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(camera.project(rays), pixels(), rtol=0, atol=1e-6)
    np.testing.assert_allclose(reference(camera, rays), pixels(), rtol=0, atol=1e-6)


def test_inverse_brown_is_brown_from_distorted_to_ideal() -> None:
    """librealsense's rs2_deproject_pixel_to_point: OpenCV's formula, applied to the distorted coordinates."""
    camera = camera_with(INVERSE_BROWN)
    rays = camera.unproject(pixels())
    normalised = np.column_stack([(pixels() - [645.5, 357.5]) / [620.0, 621.0], np.ones(len(pixels()))])
    expected = cv2.projectPoints(
        normalised[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(INVERSE_BROWN.terms)
    )[0][:, 0]
    np.testing.assert_allclose(rays[:, :2], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(camera.project(rays), pixels(), rtol=0, atol=1e-6)
    x, y, z = rays.T
    turned = camera.rotated(1).project(np.stack([-y, x, z], axis=-1))
    np.testing.assert_allclose(turned, np.stack([719 - pixels()[:, 1], pixels()[:, 0]], axis=-1), atol=1e-6)


@pytest.mark.parametrize("dist", [[0.2, 0.3], [-0.3, 0.09], [-0.28, 0.07, 1e-3, -2e-3, 0.01]])
def test_strong_brown_terms_are_undone_exactly(dist: list[float]) -> None:
    camera = Camera(1280, 960, 700.0, 700.0, 640.0, 480.0, np.array(dist))
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 959, 21)), axis=-1)
    np.testing.assert_allclose(camera.project(camera.unproject(grid)), grid, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_lens_turns_scales_and_crops_with_the_picture(name: str) -> None:
    camera = camera_with(LENSES[name])
    points = np.array([[0.3, -0.2, 1.0], [-0.4, 0.1, 1.0], [0.05, 0.3, 0.9]])
    u, v = camera.project(points).T
    turned = np.stack([-points[:, 1], points[:, 0], points[:, 2]], axis=-1)
    np.testing.assert_allclose(camera.rotated(1).project(turned), np.stack([719 - v, u], axis=-1), atol=1e-9)
    half = np.stack([(u + 0.5) / 2 - 0.5, (v + 0.5) / 2 - 0.5], axis=-1)
    np.testing.assert_allclose(camera.scaled(640, 360).project(points), half, atol=1e-9)
    np.testing.assert_allclose(camera.cropped(100, 50, 600, 400).project(points), np.stack([u - 100, v - 50], -1))


def test_brown_terms_replace_a_lens_only_where_they_are_exact() -> None:
    mild = Camera(
        1280, 720, 1400.0, 1400.0, 640.0, 360.0, lens=LensDistortion(LensModel.RATIONAL, (0.1, -0.2, 0, 0, 0, 0.05))
    )
    fitted = brown_camera(mild)
    assert fitted is not None
    assert fitted.lens is None
    rays = mild.unproject(pixels())
    off = np.linalg.norm(fitted.project(rays) - pixels(), axis=1)
    assert 0 < off.max() <= 0.03
    assert brown_camera(camera_with(FISHEYE)) is None
    with pytest.raises(InputError, match=r"part\.mp4: the lens model fisheye of the camera is not supported here"):
        require_brown(camera_with(FISHEYE), "part.mp4")
    # The kernels never see a lens that they do not know.
    with pytest.raises(InputError, match="fisheye"):
        intrinsics_of(camera_with(FISHEYE))
    np.testing.assert_allclose(intrinsics_of(mild)[4:9], fitted.dist)


@pytest.mark.slow
def test_undistorted_picture_is_that_of_the_pinhole_camera() -> None:
    camera = camera_with(FISHEYE)
    undistorter = Undistorter(camera)
    ideal = undistorter.ideal
    assert ideal.lens is None
    assert not ideal.is_distorted

    # A pattern smooth in the directions of the rays, seen by both cameras.
    def pattern(rays: Array) -> Array:
        angle = np.arctan(rays[..., :2])
        return 127.0 + 100.0 * np.sin(14.0 * angle[..., 0]) * np.cos(14.0 * angle[..., 1])

    def picture(of: Camera) -> Array:
        grid = np.stack(np.meshgrid(np.arange(of.width), np.arange(of.height)), axis=-1).astype(float)
        return np.nan_to_num(pattern(of.unproject(grid)))

    seen = undistorter.undistort(np.repeat(picture(camera)[..., None], 3, axis=2).round().astype(np.uint8))
    assert seen.shape == (ideal.height, ideal.width, 3)
    inside = camera.project(ideal.unproject(np.stack(
        np.meshgrid(np.arange(ideal.width), np.arange(ideal.height)), axis=-1).astype(float)))  # fmt: skip
    is_seen = ((inside > 1) & (inside < [1278, 718])).all(axis=-1)
    assert is_seen.mean() > 0.4
    assert np.abs(seen[..., 0] - picture(ideal))[is_seen].max() < 2.0
    # The whole picture is covered.
    corners = undistorter.to_ideal(np.array([[0.0, 0.0], [1279.0, 719.0], [640.0, 0.0]]))
    assert ((corners > -1) & (corners < [ideal.width, ideal.height])).all()


def test_lens_beyond_a_right_angle() -> None:
    camera = Camera(1280, 720, 300.0, 300.0, 639.5, 359.5, lens=LensDistortion(LensModel.FISHEYE, (0.0, 0.0, 0.0, 0.0)))
    assert np.isnan(camera.unproject([0.0, 359.5])).any()  # 122° off the axis
    assert np.isfinite(camera.unproject([639.5, 0.0])).all()
    ideal = Undistorter(camera).ideal
    assert ideal.width <= 2 * 1280
    half_angle = np.degrees(np.arctan(0.5 * ideal.width / ideal.fx))
    assert 70 < half_angle <= 75.1


def test_terms_that_no_lens_has() -> None:
    with pytest.raises(InputError, match="5 terms; expected k1 k2 k3 k4"):
        LensDistortion(LensModel.FISHEYE, (0.1,) * 5)
    with pytest.raises(InputError, match="NaN"):
        LensDistortion(LensModel.FOV, (float("nan"),))
    with pytest.raises(InputError, match="beside the lens model"):
        Camera(640, 480, 600, 600, 320, 240, np.array([0.1]), FISHEYE)
