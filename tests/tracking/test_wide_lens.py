"""Tracking and drawing through lenses that the kernels do not know: frames are undistorted, drawings are not."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.camera import Camera
from arview.camera.lens import LensDistortion, LensModel
from arview.camera.undistort import FrameView
from arview.detection.detector import Detector
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, rigid
from arview.overlay import OverlayOptions, OverlayRenderer
from arview.pose import ComponentPresence, Pose, Presence, TrackingState, Visibility
from arview.tracking import SpecimenTracking
from helpers.synthetic import assembly, assembly_views, error, path, picture

FISHEYE = Camera(1100, 800, 500.0, 501.0, 552.0, 398.0, lens=LensDistortion(LensModel.FISHEYE, (-0.02, 0.006, -0.003)))
RATIONAL = Camera(
    1100, 800, 720.0, 722.0, 552.0, 398.0, lens=LensDistortion(LensModel.RATIONAL, (0.5, -0.1, 0.001, 0, 0, 0.8, 0.05))
)
SCENE = Camera(1760, 1280, 560.0, 560.0, 880.0, 640.0)
"""A pinhole camera that sees all that the lenses see of the part, with more pixels in the middle of the fisheye."""
ASIDE_DEG = 32.0


def poses(count: int) -> list[Array]:
    """Poses with the part far off the axis: the camera is turned, not moved."""
    turn = rigid(exp_so3([0.0, np.deg2rad(ASIDE_DEG), 0.0]), [0.0, 0.0, 0.0])
    return [turn @ pose for pose in path(count, 4)]


def through(camera: Camera, cam_from_model: Array, seed: int) -> NDArray[np.uint8]:
    """What a camera with a lens sees of the assembly."""
    scene = picture(cam_from_model, camera=SCENE, seed=seed)
    u, v = _scene_pixels(camera is FISHEYE)
    return np.asarray(cv2.remap(scene, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


@cache
def _scene_pixels(is_fisheye: bool) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    camera = FISHEYE if is_fisheye else RATIONAL
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(float)
    seen = np.nan_to_num(SCENE.project(camera.unproject(grid)), nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])


@pytest.mark.slow
@pytest.mark.parametrize("camera", [FISHEYE, RATIONAL], ids=["fisheye", "rational"])
def test_part_is_found_and_tracked_far_off_the_axis(camera: Camera) -> None:
    session = SpecimenTracking(assembly_views(), camera, assembly())
    assert session.frames.tracked_camera.lens is None
    truths = poses(6)
    tracked = 0
    for index, truth in enumerate(truths):
        found = session.process(through(camera, truth, index), index, index / 30)
        if found.state != TrackingState.TRACKED:
            continue
        tracked += 1
        assert found.cam_from_model is not None
        distance_mm, across_mm, angle_deg = error(found.cam_from_model, truth)
        assert across_mm < 0.3
        assert distance_mm < 2.5
        assert angle_deg < 0.6
    assert tracked >= 5


@pytest.mark.slow
def test_detector_takes_pictures_of_a_wide_lens() -> None:
    truth = poses(1)[0]
    found = Detector(assembly_views(), FISHEYE).detect(through(FISHEYE, truth, 0))
    assert len(found) > 0
    distance_mm, across_mm, angle_deg = error(found[0].cam_from_model, truth)
    assert across_mm < 0.5
    assert distance_mm < 4.0
    assert angle_deg < 1.0


@pytest.mark.parametrize("camera", [FISHEYE, RATIONAL], ids=["fisheye", "rational"])
def test_edges_are_drawn_where_the_lens_shows_them(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.overlay.part_layers.SHOW_ARROWS", False)
    pose = poses(1)[0]
    options = OverlayOptions(show_ghost=False, show_labels=False, show_status=False)
    grey = np.full((camera.height, camera.width, 3), 118, dtype=np.uint8)
    present = ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0)
    components = {one.name: present for one in assembly().components}
    shown = Pose(pose, None, 0.9, TrackingState.TRACKED, 0.0, 0, 0.0, components=components)
    drawn = np.any(OverlayRenderer(assembly(), camera, options=options).draw(grey, shown) != grey, axis=-1)
    assert drawn.sum() > 500
    # The upper rim of the plate towards the camera, by OpenCV.
    corners = np.array([[160.0, 0, 12], [160, 120, 12], [0, 120, 12]])
    rim = np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(corners)])
    in_cam = apply(pose, rim)
    assert camera.lens is not None
    if camera.lens.model is LensModel.FISHEYE:
        pixels = cv2.fisheye.projectPoints(
            in_cam[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.lens.terms)
        )[0][:, 0]
    else:
        pixels = cv2.projectPoints(in_cam, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.lens.terms))[0][
            :, 0
        ]
    off_axis = np.degrees(np.arctan2(np.hypot(in_cam[:, 0], in_cam[:, 1]), in_cam[:, 2]))
    assert off_axis.max() > 30
    np.testing.assert_allclose(camera.project(in_cam), pixels, rtol=0, atol=1e-6)
    distance = cv2.distanceTransform((~drawn).astype(np.uint8), cv2.DIST_L2, 5)
    near = distance[np.round(pixels[:, 1]).astype(int), np.round(pixels[:, 0]).astype(int)]
    assert np.mean(near <= 1.5) > 0.9


@pytest.mark.slow
def test_pixels_and_sizes_of_frames() -> None:
    view = FrameView(FISHEYE)
    u, v = view.pixel((300.0, 200.0))
    ray = view.tracked_camera.unproject([u, v])
    np.testing.assert_allclose(FISHEYE.project(ray), [300.0, 200.0], atol=1e-6)
    with pytest.raises(InputError, match="outside the picture of 1100 × 800"):
        view.pixel((1100.0, 3.0))
    with pytest.raises(InputError, match=r"frame 3: .*expected \(800, 1100, 3\) uint8"):
        view.picture(np.zeros((10, 10, 3), dtype=np.uint8), 3)
    plain = FrameView(SCENE)
    assert plain.tracked_camera is SCENE
    frame = np.zeros((SCENE.height, SCENE.width, 3), dtype=np.uint8)
    assert plain.picture(frame, 0) is frame
