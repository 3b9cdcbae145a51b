"""What runs on a GPU, run on the processor: features, matches and reconstructions are as by the processor's path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import invert, skew
from arview.reconstruction.features import FeatureOptions, Features, find_features
from arview.reconstruction.gpu.device import device_memory, torch_device
from arview.reconstruction.matching import Matches, match_along_lines, match_descriptors
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.sparse import SparseOptions, reconstruct_sparse
from arview.reconstruction.types import Photo
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos

torch = pytest.importorskip("torch", reason="torch is not installed: tools/setup")
pytest.importorskip("kornia", reason="kornia is not installed: tools/setup")
pytestmark = pytest.mark.slow  # features of whole photos

OPTIONS = FeatureOptions(max_features=600)


@pytest.fixture(scope="module")
def pictures() -> list[NDArray[np.uint8]]:
    return [photograph(bench(), pose) for pose in ring(12)[:2]]


@pytest.fixture(scope="module")
def pair(pictures: list[NDArray[np.uint8]]) -> tuple[Features, Features]:
    """Features of both pictures by the processor's path."""
    return find_features(pictures[0]), find_features(pictures[1])


def share_alike(ones: Features, others: Features) -> float:
    """Share of the features that the others have too: to 0.05 px in place and size, with the same description."""
    tree = cKDTree(np.column_stack([others.points_px, others.sizes_px]))
    found = 0
    for place, size, described in zip(ones.points_px, ones.sizes_px, ones.descriptors, strict=True):
        near = tree.query_ball_point((*place, size), 0.05)
        found += len(near) > 0 and bool((others.descriptors[near] @ described).max() > 0.99)
    return found / len(ones)


def share_common(ones: Matches, others: Matches) -> float:
    """Matches in both, of those in either."""
    one, other = ({tuple(row) for row in rows.tolist()} for rows in (ones, others))
    return len(one & other) / len(one | other)


def test_features_are_those_of_opencv(pictures: list[NDArray[np.uint8]]) -> None:
    processor, device = find_features(pictures[0], OPTIONS), find_features(pictures[0], OPTIONS, device="cpu")
    assert len(processor) == len(device) == OPTIONS.max_features
    assert share_alike(processor, device) > 0.98
    assert share_alike(device, processor) > 0.98


@pytest.mark.parametrize("shape", [(61, 180), (141, 97)])
def test_features_of_odd_shapes(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, shape).astype(np.float32), (0, 0), 1.5)
    image = np.repeat(np.clip(4 * (noise - 128) + 128, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    processor, device = find_features(image), find_features(image, device="cpu")
    assert len(processor) > 50
    assert abs(len(device) - len(processor)) <= 0.02 * len(processor)
    assert share_alike(processor, device) > 0.98


def test_features_only_where_the_mask_allows(pictures: list[NDArray[np.uint8]]) -> None:
    mask = np.zeros(pictures[0].shape[:2], bool)
    mask[:, : mask.shape[1] // 2] = True
    processor, device = (find_features(pictures[0], OPTIONS, mask, device) for device in (None, "cpu"))
    assert len(device) > 100
    assert device.points_px[:, 0].max() < mask.shape[1] // 2 + 1
    assert share_alike(processor, device) > 0.98


def test_a_plain_picture_has_no_features() -> None:
    assert len(find_features(np.full((200, 300, 3), 90, np.uint8), device="cpu")) == 0
    assert len(find_features(np.full((9, 12, 3), 90, np.uint8), device="cpu")) == 0


def test_matches_by_appearance_are_the_same(pair: tuple[Features, Features]) -> None:
    ones, others = pair[0].descriptors, pair[1].descriptors
    processor = match_descriptors(ones, others)
    assert len(processor) > 200
    assert share_common(processor, match_descriptors(ones, others, "cpu")) > 0.98
    back = match_descriptors(others[:900], ones, "cpu")
    assert share_common(match_descriptors(others[:900], ones), back) > 0.98


def test_matches_along_lines_are_the_same(pair: tuple[Features, Features]) -> None:
    rays = [np.ascontiguousarray(CAMERA.unproject(one.points_px)[:, :2]) for one in pair]
    relative = ring(12)[1] @ invert(ring(12)[0])
    essential = skew(relative[:3, 3]) @ relative[:3, :3]
    processor, device = (
        match_along_lines((rays[0], rays[1]), CAMERA.fx, pair, essential, 2.0, device) for device in (None, "cpu")
    )
    assert len(processor) > 300
    assert share_common(processor, device) > 0.98


def test_features_and_matches_of_nothing() -> None:
    nothing = np.zeros((0, 128), np.float32)
    assert match_descriptors(nothing, nothing, "cpu").shape == (0, 2)
    none = Features(np.zeros((0, 2), np.float32), nothing, np.zeros(0, np.float32), np.zeros((0, 3), np.uint8))
    assert len(match_along_lines((np.zeros((0, 2)),) * 2, 900.0, (none, none), np.eye(3), 2.0, "cpu")) == 0


def test_photos_are_placed_as_by_the_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = ring(12)[:4]
    paths = write_photos(tmp_path, [photograph(bench(), pose) for pose in poses])
    camera = Camera(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.dist)
    photos = [Photo(path.name, path, camera.width, camera.height, "lens", camera, True) for path in paths]
    options = SparseOptions(features=FeatureOptions(max_features=1000), first_features=800, threads=2)
    errors = []
    for device in (None, "cpu"):
        monkeypatch.setattr("arview.reconstruction.sparse.torch_device", lambda _, device=device: device)
        sparse = reconstruct_sparse(photos, tmp_path / str(device), options)
        assert len(sparse.photos) == len(poses)
        centres = np.array([photo.centre_in_scan for photo in sparse.photos])
        truth = np.array([invert(pose)[:3, 3] for pose in poses])
        fit = fit_points(centres, truth).similarity
        moved = sparse.transformed(fit.scale, fit.model_from_scan)
        errors.append(np.linalg.norm([p.centre_in_scan for p in moved.photos] - truth, axis=1).max())
    assert max(errors) < 1.0
    assert errors[1] < 1.5 * errors[0] + 0.1


@pytest.mark.parametrize("device", ["cuda:77", "nonsense"])
def test_a_device_that_is_not_there_is_refused(tmp_path: Path, device: str) -> None:
    options = replace(SparseOptions(), device=device)
    with pytest.raises(InputError, match="--device"):
        reconstruct_sparse([], tmp_path, options)


def test_auto_is_the_processor_without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert torch_device("auto") is None
    assert torch_device("cpu") is None
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert torch_device("auto") == "cuda"


def test_too_little_memory_is_said() -> None:
    with pytest.raises(InputError, match="too little memory"), device_memory("cuda:0"):
        raise torch.OutOfMemoryError("CUDA out of memory")
