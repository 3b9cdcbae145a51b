"""The detector on rendered frames: found anywhere in the range, not found where it is not, snapped from nearby."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from arview.errors import InputError
from arview.geometry import apply
from arview.tracking import Detector, DetectorOptions
from synthetic import CAMERA, RANGE, assembly, assembly_views, error, picture, pose_from, wrong


@cache
def detector() -> Detector:
    return Detector(assembly_views(), CAMERA)


def anywhere(rng: np.random.Generator) -> np.ndarray:
    """A pose of the declared range, the part wholly in the picture."""
    pose = pose_from(
        rng.uniform(*RANGE.azimuth_deg), rng.uniform(*RANGE.elevation_deg), rng.uniform(440, 620),
        roll_deg=rng.uniform(*RANGE.roll_deg),
    )  # fmt: skip
    pose[:2, 3] += rng.uniform([-90, -50], [90, 50])
    return pose


def test_the_part_is_found_without_a_hint() -> None:
    rng = np.random.default_rng(11)
    found, exact = 0, 0
    for k in range(20):
        truth = anywhere(rng)
        detections = detector().detect(picture(truth, seed=k, scene=k % 9, noise=3.0))
        qualities = [d.quality for d in detections]
        assert qualities == sorted(qualities, reverse=True)
        assert all(quality >= detector().options.min_quality for quality in qualities)
        if not detections:
            continue
        depth = apply(detections[0].cam_from_model, assembly().center_in_model)[2]
        depth_truth = apply(truth, assembly().center_in_model)[2]
        mm, _, deg = error(detections[0].cam_from_model, truth)
        found += deg < 10.0 and abs(depth / depth_truth - 1.0) < 0.05
        exact += mm < 5.0 and deg < 1.0
    assert found >= 18
    assert exact >= 16


def test_nothing_is_found_where_there_is_no_part() -> None:
    for k in range(20):
        assert detector().detect(picture(None, seed=k, scene=20 + k)) == []


def test_snapping_from_15_degrees_and_2_percent() -> None:
    rng = np.random.default_rng(12)
    converged = 0
    for k in range(12):
        truth = pose_from(rng.uniform(-60, 60), rng.uniform(25, 65), rng.uniform(460, 600))
        start = wrong(truth, rng, 15.0, 0.0)
        start[:3, 3] += (0.02 if k % 2 else -0.02) * apply(truth, assembly().center_in_model)
        _, across, deg = error(detector().snap(picture(truth, seed=k, scene=k), start).cam_from_model, truth)
        converged += across < 3.0 and deg < 3.0
    assert converged >= 11


def test_results_are_apart_and_no_more_than_asked_for() -> None:
    image = picture(pose_from(30, 40, 520), seed=1)
    assert len(detector().detect(image, max_results=1)) == 1
    assert detector().detect(image, max_results=0) == []


def test_options_without_sense_are_refused() -> None:
    with pytest.raises(InputError, match="radius_px"):
        DetectorOptions(radius_px=2.0)
