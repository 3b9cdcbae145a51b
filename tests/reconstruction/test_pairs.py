"""Which pairs of photos are matched, their record, and what is remembered of photos and pairs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.errors import InputError
from arview.reconstruction.features import FeatureOptions, Features, find_features
from arview.reconstruction.intake.kept import keeping_photos
from arview.reconstruction.intake.reading import read_photo
from arview.reconstruction.matching import Matches, match_descriptors
from arview.reconstruction.memory import SparseMemory, feature_prints
from arview.reconstruction.pairs import KnownPairs, chosen_pairs, doubtful_pairs, read_pairs, write_pairs
from arview.reconstruction.types import Photo
from helpers.photo_scene import CAMERA, ring

COUNT = 14
OPTIONS = PairOptions(preview_features=40, hints_from=COUNT)


def photo(name: str, path: Path = Path("none")) -> Photo:
    return Photo(name, path, CAMERA.width, CAMERA.height, "lens", CAMERA)


PHOTOS = [photo(f"{i:04d}.jpg") for i in range(COUNT)]


def unlike() -> list[Features]:
    """Features of photos that have nothing in common."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(COUNT):
        descriptors = rng.uniform(0.0, 1.0, (60, 128)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        points = rng.uniform(0, 400, (60, 2)).astype(np.float32)
        found.append(Features(points, descriptors, np.ones(60, np.float32), np.zeros((60, 3), np.uint8)))
    return found


def test_rough_poses_choose_the_pairs() -> None:
    poses = ring(COUNT, elevations_deg=(30.0,))
    known = KnownPairs(poses={one.name: pose for one, pose in zip(PHOTOS, poses, strict=True)})
    with ThreadPoolExecutor(2) as pool:
        by_pose = chosen_pairs(PHOTOS, unlike(), known, pool)
        by_look = chosen_pairs(PHOTOS, unlike(), KnownPairs(), pool)
        few = chosen_pairs(PHOTOS, unlike(), known, pool)
    apart = {min(j - i, COUNT - j + i) for i, j in by_pose}
    assert apart == {1, 2} and len(by_pose) == 2 * COUNT  # 26° from photo to photo, less between their axes
    assert few == by_look
    assert {j - i for i, j in by_look} == {1, 2, 3}  # nothing in common, so that only what follows is matched


def test_a_photo_with_a_wrong_pose_is_matched_by_its_look() -> None:
    features = unlike()
    features[9] = features[2]
    poses = ring(COUNT, elevations_deg=(30.0,))
    known = KnownPairs(poses={one.name: pose for one, pose in zip(PHOTOS, poses, strict=True)})
    with ThreadPoolExecutor(2) as pool:
        tried = chosen_pairs(PHOTOS, features, known, pool)
        assert (2, 9) not in tried
        matched = [pair for pair in tried if not {2, 9} & set(pair)]
        assert (2, 9) in doubtful_pairs(PHOTOS, features, known, tried, matched, pool)
        assert doubtful_pairs(PHOTOS, features, known, tried, tried, pool) == []


def test_recorded_pairs_are_matched_and_no_others(tmp_path: Path) -> None:
    pairs = [(0, 5), (2, 3), (4, 13)]
    write_pairs(tmp_path / "pairs.json", PHOTOS, pairs)
    known = read_pairs(tmp_path / "pairs.json")
    with ThreadPoolExecutor(2) as pool:
        assert chosen_pairs(PHOTOS, unlike(), known, pool) == pairs
        assert chosen_pairs(PHOTOS[:5], unlike()[:5], known, pool) == [(2, 3)]
        assert doubtful_pairs(PHOTOS, unlike(), known, pairs, [], pool) == []
    assert known.key() != KnownPairs().key()


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"format": "arview pairs", "version": 1, "pairs": [["a"]]}',
                                     '{"format": "arview pairs", "version": 1, "pairs": []}'])  # fmt: skip
def test_what_is_no_list_of_pairs_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "pairs.json").write_text(content)
    with pytest.raises(InputError, match="pairs"):
        read_pairs(tmp_path / "pairs.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_pairs(tmp_path / "other.json")


@pytest.fixture
def picture(tmp_path: Path) -> Photo:
    coarse = np.random.default_rng(0).uniform(0, 255, (60, 80, 3)).astype(np.uint8)
    path = tmp_path / "0001.png"
    cv2.imwrite(str(path), cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC))
    return photo("0001.png", path)


def test_remembered_features_are_those_that_would_be_found(picture: Photo, tmp_path: Path) -> None:
    options = FeatureOptions(max_features=800)
    found = find_features(read_photo(picture.path), options)
    assert len(found) > 300
    first = SparseMemory(tmp_path / "features")
    for memory in (first, first, SparseMemory(tmp_path / "features"), SparseMemory()):
        again = memory.features(picture, options)
        for name in ("points_px", "descriptors", "sizes_px", "colors"):
            assert np.array_equal(getattr(again, name), getattr(found, name)), name
    (file,) = (tmp_path / "features").iterdir()
    file.write_bytes(file.read_bytes()[:1000])
    assert np.array_equal(SparseMemory(tmp_path / "features").features(picture, options).points_px, found.points_px)
    other = first.features(picture, replace(options, max_features=100))
    assert len(other) == 100


def test_matches_are_remembered_by_content(picture: Photo) -> None:
    found = find_features(read_photo(picture.path), FeatureOptions(max_features=200))
    prints = feature_prints([found, found.taken(np.arange(100))])
    assert prints[0] != prints[1] and feature_prints([found]) == prints[:1]
    memory, calls = SparseMemory(), []

    def find() -> Matches:
        calls.append(1)
        return match_descriptors(found.descriptors, found.descriptors)

    assert len(memory.matches(("a", "b"), find)) > 100
    assert memory.matches(("a", "b"), find) is memory.matches(("a", "b"), find) and len(calls) == 1


def test_a_kept_photo_is_read_again_when_it_changes(picture: Photo) -> None:
    with keeping_photos() as store:
        first = read_photo(picture.path)
        assert read_photo(picture.path) is first and not first.flags.writeable
        assert store.size_bytes == first.nbytes
        cv2.imwrite(str(picture.path), np.zeros((480, 700, 3), np.uint8))
        assert read_photo(picture.path).shape == (480, 700, 3)
    assert read_photo(picture.path) is not read_photo(picture.path)
    with keeping_photos(limit_bytes=10):
        assert read_photo(picture.path) is not read_photo(picture.path)
