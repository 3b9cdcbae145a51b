"""The edge network: responds to edges of solids, by orientation, more than to noise and texture."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.detection.features.edge_net import (
    MAX_SIDE_PX,
    SOLID_CHANNEL,
    EdgeNet,
    halve_responses,
    resize_responses,
)
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.features.response_maps import (
    ORIENTATIONS,
    orientation_bins,
    response_maps,
)
from arview.geometry import Array, apply
from arview.refinement.projection import project_lines
from arview.refinement.view_model import PartView
from arview.rendering.rasterizer import rasterise
from helpers.synthetic import CAMERA, assembly, assembly_views, background, pose_from
from helpers.synthetic import picture as drawn

PART = PartView(assembly_views())
POSE = pose_from(30.0, 45.0, 520.0)


@cache
def network() -> EdgeNet:
    return EdgeNet()


def outline() -> tuple[Array, Array]:
    """Pixels (N,2) of the outline in the image, and their normals (N,2)."""
    view = PART.views.view(int(np.argmax(PART.views.directions @ (POSE[:3, :3].T @ -POSE[:3, 3]))))
    intrinsics = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, 0, 0, 0, 0, 0, 0], dtype=np.float64)
    points, normals = view.features.contour_points, view.features.contour_normals
    pixels, across, _ = project_lines(points, normals, False, POSE, intrinsics, 1.0)
    return pixels, across


def standing_out(maps: NDArray[np.uint8], quarter_turns: int = 0) -> float:
    """Mean response along the outline, in its orientation or rotated, relative to the mean of all responses."""
    pixels, normals = outline()
    columns, rows = np.round((pixels + 0.5) / 2.0 - 0.5).astype(int).T
    around = np.stack([cv2.dilate(plane, np.ones((3, 3), np.uint8)) for plane in maps])
    bins = (orientation_bins(normals) + 4 * quarter_turns) % ORIENTATIONS
    return float(around[bins, rows, columns].mean() / around.mean())


@pytest.mark.parametrize("noise", [3.0, 9.0, 16.0])
def test_the_outline_stands_out_more_than_by_gradients(noise: float) -> None:
    image = drawn(POSE, noise=noise)
    seen = network().predict(image)[:ORIENTATIONS]
    assert standing_out(seen) > 6.0
    assert standing_out(seen) > 2.5 * standing_out(response_maps(image, 0, 0, 2))
    assert standing_out(seen, 1) < 0.3 * standing_out(seen)


def test_noise_gives_hardly_any_response() -> None:
    rng = np.random.default_rng(0)
    noise = np.clip(110 + 14 * rng.standard_normal((480, 640, 3)), 0, 255).astype(np.uint8)
    seen = network().predict(noise)
    assert np.mean(seen[:ORIENTATIONS].max(axis=0) > 128) < 0.01
    assert np.mean(seen[SOLID_CHANNEL] > 128) < 0.01


@pytest.mark.parametrize("noise", [3.0, 9.0, 16.0])
def test_the_solid_is_predicted(noise: float) -> None:
    seen = network().predict(drawn(POSE, noise=noise))[SOLID_CHANNEL]
    vertices, faces, _ = assembly().mesh
    c = CAMERA.scaled(seen.shape[1], seen.shape[0])
    _, face_ids = rasterise(apply(POSE, vertices), faces, c.fx, c.fy, c.cx, c.cy, c.width, c.height)
    is_inside, side = (face_ids >= 0).astype(np.uint8), np.ones((9, 9), np.uint8)
    assert np.median(seen[cv2.erode(is_inside, side) > 0]) > 128
    assert np.median(seen[cv2.dilate(is_inside, side) == 0]) < 64


class FixedNetwork:
    """Replaces the network: predicts the same maps for any input."""

    def __init__(self, seen: NDArray[np.float32]) -> None:
        self._seen = seen[None]

    def __call__(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        assert picture.shape == (1, 3, 320, 640)
        return self._seen


def test_responses_are_normalised_by_the_strongest_nearby() -> None:
    seen = np.zeros((ORIENTATIONS + 1, 160, 320), dtype=np.float32)
    seen[3, :, 20], seen[5, 40, 200:], seen[1, 120, 200:] = 0.9, 0.3, 0.02
    seen[0, :, 30] = 0.3  # beside a clear one
    lines = EdgeNet()
    lines._network = FixedNetwork(seen)
    found = lines.predict(np.zeros((320, 640, 3), dtype=np.uint8)).astype(float) / 255.0
    assert found[3, 60:100, 20].min() == 1.0
    assert found[5, 40, 240:280].min() == 1.0  # as clear as any around
    assert found[1, 120, 240:280].max() < 0.15
    assert 0.3 < found[0, 60:100, 30].max() < 0.4


def test_halved_maps_keep_the_maximum_of_four_pixels() -> None:
    rng = np.random.default_rng(0)
    lines = rng.integers(0, 256, (ORIENTATIONS, 24, 40)).astype(np.uint8)
    levels = halve_responses(lines)
    assert [level.shape[1:] for level in levels] == [(24, 40), (12, 20), (6, 10), (3, 5)]
    for level, half in pairwise(levels):
        _, rows, columns = half.shape
        blocks = level.reshape(ORIENTATIONS, rows, 2, columns, 2)
        np.testing.assert_array_equal(half, blocks.max(axis=(2, 4)))


@pytest.mark.parametrize(("height", "width"), [(480, 640), (257, 331), (720, 1280), (40, 30)])
def test_images_of_any_size_are_taken(height: int, width: int) -> None:
    seen = network().predict(background(1, width, height))
    share = min(1.0, MAX_SIDE_PX / max(height, width))
    assert abs(seen.shape[1] - share * height / 2) <= 1 and abs(seen.shape[2] - share * width / 2) <= 1
    assert resize_responses(seen, 50, 40, 1).shape == (8, 40, 50)


def test_edges_of_an_enlarged_image_keep_their_places() -> None:
    image = drawn(POSE, noise=2.0)
    large = np.asarray(cv2.resize(image, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC))
    small, again = (network().predict(of)[:ORIENTATIONS].max(axis=0) for of in (image, large))
    again = cv2.resize(again, small.shape[::-1]).astype(np.uint8)
    assert np.corrcoef(cv2.blur(small, (5, 5)).ravel(), cv2.blur(again, (5, 5)).ravel())[0, 1] > 0.8


def test_response_maps_combine_gradients_and_edge_responses() -> None:
    image = drawn(POSE, noise=6.0)
    plain, lined = ImagePyramid(image, CAMERA, 12), ImagePyramid(image, CAMERA, 12, network())
    (by_gradients, one), (mixed, other) = plain.maps(-4), lined.maps(-4)
    np.testing.assert_array_equal(one, other)
    rows, columns = by_gradients.shape[1] - 24, by_gradients.shape[2] - 24
    lines = resize_responses(network().predict(image), columns, rows, 1)
    inside = np.s_[:, 12:-12, 12:-12]
    wanted = 0.5 * by_gradients[inside].astype(float) + 0.5 * lines
    assert np.abs(mixed[inside] - wanted).max() <= 1.0
    assert mixed[:, :12].max() == 0  # the rim stays empty
    assert not plain.edge_responses().maps.any()
    np.testing.assert_array_equal(lined.without_edge_net.maps(-4)[0], by_gradients)
    np.testing.assert_array_equal(lined.maps(-4)[0], mixed)  # as it was
    assert lined.edge_responses().maps.any() and lined.level(-4).edge_responses.any()
