"""Two halves of the photos, adjusted apart: they are placed as the truth is, in the frame of the whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from arview.camera import Camera
from arview.errors import CannotMeasureError
from arview.reconstruction.features import FeatureOptions
from arview.reconstruction.halves import HalvesOptions, halves_of
from arview.reconstruction.sparse import SparseOptions, reconstruct_sparse
from arview.reconstruction.types import Photo
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos


@pytest.mark.slow  # structure from motion of sixteen photos
def test_halves_are_placed_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = ring(16)
    paths = write_photos(tmp_path / "photos", [photograph(bench(), pose) for pose in poses])
    guess = Camera(CAMERA.width, CAMERA.height, 740.0, 740.0, CAMERA.cx, CAMERA.cy)
    photos = [Photo(path.name, path, guess.width, guess.height, "lens", guess) for path in paths]
    options = SparseOptions(features=FeatureOptions(max_features=2500), first_features=1500, threads=2)
    whole = reconstruct_sparse(photos, tmp_path / "sparse", options)
    assert len(whole.photos) == 16
    # As after the scale is known: the model on disk keeps its own unit.
    metric = whole.transformed(37.0, np.eye(4))
    halves = halves_of(tmp_path / "sparse" / "model", metric, HalvesOptions(sparse=options))
    names = [[photo.name for photo in half.photos] for half in halves]
    assert names == [[path.name for path in paths[0::2]], [path.name for path in paths[1::2]]]
    centres = {photo.name: photo.centre_in_scan for photo in metric.photos}
    size = np.linalg.norm(np.ptp(list(centres.values()), axis=0))
    for half in halves:
        apart = [np.linalg.norm(photo.centre_in_scan - centres[photo.name]) for photo in half.photos]
        assert 0.0 < max(apart) < 2e-3 * size
        assert half.pose_covariance is not None and half.pose_covariance.shape == (48, 48)
        assert half.photos[0].camera.fx != metric.photos[0].camera.fx
        assert half.photos[0].camera.fx == pytest.approx(metric.photos[0].camera.fx, rel=0.02)
    monkeypatch.setattr("arview.reconstruction.halves.MIN_PHOTOS", 20)
    with pytest.raises(CannotMeasureError, match="16 photos are too few to be halved"):
        halves_of(tmp_path / "sparse" / "model", metric)
