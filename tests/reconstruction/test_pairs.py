"""Which pairs of photos are matched, their record, and what is remembered of photos and pairs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.errors import InputError
from arview.reconstruction import pairs
from arview.reconstruction.features import FeatureOptions, Features, find_features
from arview.reconstruction.intake.kept import keeping_photos
from arview.reconstruction.intake.reading import read_photo
from arview.reconstruction.matching import Matches, epipolar_inliers, match_descriptors
from arview.reconstruction.memory import SparseMemory, feature_prints
from arview.reconstruction.pairs import KnownPairs, chosen_pairs, doubtful_pairs, read_pairs, write_pairs
from arview.reconstruction.types import Photo
from helpers.photo_scene import CAMERA, ring

COUNT = 14


@pytest.fixture(autouse=True)
def small_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rough poses choose the pairs of this many photos, and a few features are compared."""
    monkeypatch.setattr(pairs, "PREVIEW_FEATURES", 40)
    monkeypatch.setattr(pairs, "HINTS_FROM", COUNT)


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


def test_rough_poses_choose_the_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = ring(COUNT, elevations_deg=(30.0,))
    known = KnownPairs(poses={one.name: pose for one, pose in zip(PHOTOS, poses, strict=True)})
    with ThreadPoolExecutor(2) as pool:
        by_pose = chosen_pairs(PHOTOS, unlike(), known, pool)
        by_look = chosen_pairs(PHOTOS, unlike(), KnownPairs(), pool)
        monkeypatch.setattr(pairs, "HINTS_FROM", COUNT + 1)
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
    listed = [(0, 5), (2, 3), (4, 13)]
    write_pairs(tmp_path / "pairs.json", PHOTOS, listed)
    known = read_pairs(tmp_path / "pairs.json")
    with ThreadPoolExecutor(2) as pool:
        assert chosen_pairs(PHOTOS, unlike(), known, pool) == listed
        assert chosen_pairs(PHOTOS[:5], unlike()[:5], known, pool) == [(2, 3)]
        assert doubtful_pairs(PHOTOS, unlike(), known, listed, [], pool) == []
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


def test_few_matches_of_unrelated_photos_have_no_inliers() -> None:
    """OpenCV 5 raises an error for these 18, of which no sample gives a fundamental matrix."""
    one = [
        (299.3, 332.9), (341.3, 353.7), (261.6, 225.6), (268.4, 339.9), (430.4, 184.2), (430.4, 184.2), (372.1, 196.0),
        (537.9, 316.9), (469.7, 293.8), (412.1, 346.1), (458.5, 316.1), (220.1, 369.1), (306.3, 345.1), (427.6, 332.8),
        (497.8, 333.0), (509.5, 310.5), (436.2, 322.7), (297.9, 199.6),
    ]  # fmt: skip
    other = [
        (197.9, 264.1), (185.3, 296.1), (326.6, 205.1), (180.7, 249.8), (478.5, 297.2), (478.5, 297.2), (422.2, 259.6),
        (299.0, 431.0), (306.7, 365.9), (213.0, 338.2), (267.7, 365.0), (248.9, 326.0), (186.4, 273.3), (234.4, 345.2),
        (257.2, 399.0), (296.9, 403.0), (381.5, 166.4), (379.9, 214.9),
    ]  # fmt: skip
    nothing = (np.empty((18, 128), np.float32), np.empty(18, np.float32), np.empty((18, 3), np.uint8))
    features = [Features(np.array(points, np.float32), *nothing) for points in (one, other)]
    matches = np.repeat(np.arange(18, dtype=np.int32)[:, None], 2, axis=1)
    assert len(epipolar_inliers(*features, matches, 4.0)) == 0
