"""Corners of boards and tags found in rendered pictures, against their exact places."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from arview.core.subpixel_edges import linear_light
from arview.errors import InputError
from arview.fiducials.board import Tags, cv_board, cv_dictionary, parse_board, parse_tags, spec_of
from arview.fiducials.targets import find_corners, refined_quad
from helpers.board_scene import BOARD, LENS, photograph, pose


def test_corners_of_a_board_are_where_the_lens_shows_them() -> None:
    rng = np.random.default_rng(2)
    cam_from_board = pose(BOARD, LENS, rng, (15.0, 25.0), aside=0.1)
    gray = photograph(BOARD, LENS, cam_from_board, rng)
    found = find_corners(gray, LENS, [BOARD], [])
    places = np.asarray(cv_board(BOARD).getChessboardCorners(), dtype=np.float64)
    assert len(found) > 40
    assert {key[0] for key in found} == {"board 0"}
    for (_, index, _), pixel in found.items():
        in_cam = cam_from_board[:3, :3] @ places[index] + cam_from_board[:3, 3]
        assert np.linalg.norm(LENS.project(in_cam[None])[0] - pixel) < 0.3


def test_sides_of_a_tag_give_its_corners() -> None:
    super_px = 8
    tag = cv2.aruco.generateImageMarker(cv_dictionary("DICT_APRILTAG_36h11"), 7, 800)
    truth = np.array([[200.3, 120.8], [301.6, 151.2], [270.4, 249.7], [172.1, 226.5]])
    ends = np.array([[-0.5, -0.5], [799.5, -0.5], [799.5, 799.5], [-0.5, 799.5]])
    to_picture, _ = cv2.findHomography(ends, (truth + 0.5) * super_px - 0.5)
    # Blended and blurred in linear light, as a sensor does, before the tone curve.
    dark = np.where(tag > 127, 0.8, 0.01).astype(np.float32)
    size = (640 * super_px, 480 * super_px)
    light = cv2.warpPerspective(dark, to_picture, size, flags=cv2.INTER_LINEAR, borderValue=0.8)
    light = cv2.GaussianBlur(cv2.resize(light, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    gray = np.round(255.0 * (1.055 * light ** (1 / 2.4) - 0.055)).astype(np.uint8)
    camera = LENS.without_distortion()
    found = find_corners(gray, camera, [], ["DICT_APRILTAG_36h11"])
    corners = np.array([found["DICT_APRILTAG_36h11", 7, k] for k in range(4)])
    assert np.abs(corners - truth).max() < 0.08
    refined = refined_quad(linear_light(gray), camera, truth + 0.4)
    assert np.abs(refined - truth).max() < 0.08
    far_away = truth + 200.0  # no edges: the quad comes back as it is
    assert refined_quad(linear_light(gray), camera, far_away) is far_away


def test_specs_are_read_back_and_wrong_ones_refused() -> None:
    assert parse_board(spec_of(BOARD)) == BOARD
    assert parse_tags("tag36h11:20") == Tags("DICT_APRILTAG_36h11", 20.0)
    for text, message in (("charuco:8x6:22:30:5x5_100", "do not fit"), ("charuco:2x6:30:22:5x5_100", "at least 3×3")):
        with pytest.raises(InputError, match=message):
            parse_board(text)
    with pytest.raises(InputError, match="not a positive length"):
        parse_tags("tag36h11:-3")
