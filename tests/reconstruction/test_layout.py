"""Scale from tags with known corners: synthetic corners of 36 tags, with noise, moved tags and wrong files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from arview.camera import Camera
from arview.errors import InputError
from arview.fiducials.board import Tags
from arview.fiducials.targets import CornerKey
from arview.geometry import Array, apply, exp_so3, look_at, rigid
from arview.reconstruction.scale.layout import scale_from_layout
from arview.reconstruction.scale.specs import TagLayout, load_scale_file
from arview.reconstruction.scale.targets import TAG_EDGE_STD_PX, _tag_evidence
from arview.reconstruction.scale.triangulation import TriangulatedCorners, triangulate_corners
from arview.reconstruction.scale.types import ScaleEvidence

LENS = Camera(1280, 960, 1500.0, 1502.0, 641.3, 476.8, np.array([-0.08, 0.03, 4e-4, -3e-4, 0.0]))
APRILTAG = "DICT_APRILTAG_36h11"
SCALE = 123.4
SIDE_MM, PITCH_MM = 20.0, 50.0
SIDE_PX = 38.0
"""Side of a tag in the pictures made here."""


def tags_of(columns: int = 6, rows: int = 6) -> dict[int, Array]:
    """Corners of tags on a sheet, clockwise from the upper left."""
    square = 0.5 * SIDE_MM * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    return {r * columns + c: np.array([c * PITCH_MM, r * PITCH_MM, 0.0]) + square
            for r in range(rows) for c in range(columns)}  # fmt: skip


def seen(
    tags: dict[int, Array], noise_px: float, seed: int, edge_px: float = 0.0, views: int = 8
) -> TriangulatedCorners:
    """Corners triangulated from pictures, in units of SCALE mm; ``edge_px`` shifts all sides outwards."""
    rng = np.random.default_rng(seed)
    middle = np.mean([corners.mean(axis=0) for corners in tags.values()], axis=0)
    poses, found = [], list[dict[CornerKey, Array]]()
    for angle in np.arange(views) * 2.0 * np.pi / views:
        height = np.deg2rad(50.0 + 15.0 * np.sin(angle))
        towards = np.array([np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)])
        pose = look_at(middle + 700.0 * towards, middle, [0.0, 0.0, 1.0])
        poses.append(rigid(pose[:3, :3], pose[:3, 3] / SCALE))
        here: dict[CornerKey, Array] = {}
        for index, corners in tags.items():
            pixels = LENS.project(apply(pose, corners))
            outwards = pixels - pixels.mean(axis=0)
            pixels += np.sqrt(2.0) * edge_px * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
            for corner, place in enumerate(pixels + rng.normal(0.0, noise_px, pixels.shape)):
                here[APRILTAG, index, corner] = place
        found.append(here)
    return triangulate_corners([LENS] * views, poses, found)


def scale_of(tags: dict[int, Array], corners: TriangulatedCorners, std_mm: float = 0.001) -> tuple[ScaleEvidence, str]:
    found, said = scale_from_layout(TagLayout(APRILTAG, tags, std_mm), corners, TAG_EDGE_STD_PX / SIDE_PX)
    assert found is not None, said
    return found, said


def off(found: ScaleEvidence) -> float:
    return float(np.log(found.mm_per_unit / SCALE))


@pytest.mark.slow
@pytest.mark.parametrize(("noise_px", "max_u"), [(0.1, 2e-4), (0.3, 2.5e-4)])
def test_scale_is_within_u_and_far_better_than_from_sides(noise_px: float, max_u: float) -> None:
    tags, errors, stds = tags_of(), [], []
    for seed in range(24):
        edge_px = float(np.random.default_rng(1000 + seed).normal(0.0, TAG_EDGE_STD_PX))
        corners = seen(tags, noise_px, seed, edge_px)
        found, said = scale_of(tags, corners)
        sides = _tag_evidence(Tags(APRILTAG, SIDE_MM), set(), corners, SIDE_PX, "tags")
        assert not said and sides is not None
        assert 2.0 * found.std < max_u < 2.0 * sides.std / 30.0
        errors.append(off(found))
        stds.append(found.std)
    z = np.array(errors) / stds
    assert np.mean(np.abs(z) <= 2.0) >= 0.9
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.2
    assert abs(np.mean(errors)) < 5e-5


def test_moved_and_exchanged_tags_are_left_out_and_named() -> None:
    tags = tags_of()
    there = tags | {4: tags[4] + [0.0, 3.0, 0.0], 11: tags[20], 20: tags[11], 30: tags[30] + [2.0, 0.0, 5.0]}
    found, said = scale_of(tags, seen(there, 0.2, seed=1))
    assert said.endswith("left out: corners of 4, 11, 20, 30")
    assert "128 corners of 32 tags over" in found.detail
    assert abs(off(found)) < 2.0 * found.std < 3e-4


def test_tags_that_are_not_quite_where_listed_widen_u() -> None:
    tags, rng = tags_of(), np.random.default_rng(5)
    z, stds = [], []
    for seed in range(12):
        there = {index: corners + rng.normal(0.0, [0.3, 0.3, 0.0]) for index, corners in tags.items()}
        found, _ = scale_of(tags, seen(there, 0.1, seed))
        z.append(off(found) / found.std)
        stds.append(found.std)
    assert np.median(stds) > 3e-4  # 0.3 mm of 36 places, 120 mm from their middle
    assert np.mean(np.abs(z) <= 2.0) >= 0.8
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_any_common_order_of_the_corners_three_dimensions_and_few_tags() -> None:
    flat = tags_of(3, 2)
    folded = {
        index: apply(rigid(exp_so3([0.0, 0.3 * index, 0.0]), [0.0, 0.0, 0.0]), corners)
        for index, corners in flat.items()
    }
    corners = seen(folded, 0.1, seed=2)
    for order in ([0, 1, 2, 3], [3, 0, 1, 2], [0, 3, 2, 1], [2, 1, 0, 3]):
        listed = {index: places[order] for index, places in folded.items()}
        found, said = scale_of(listed, corners)
        assert not said and abs(off(found)) < 2.5 * found.std < 5e-3
    one, _ = scale_of({0: flat[0]}, seen(flat, 0.1, seed=3))
    assert "4 corners of 1 tags" in one.detail
    assert abs(off(one)) < 2.0 * one.std
    assert one.std > 2.0 * TAG_EDGE_STD_PX / SIDE_PX
    rough, _ = scale_of(flat, seen(flat, 0.1, seed=3), std_mm=0.5)
    assert rough.std == pytest.approx(0.5 / np.hypot(120.0, 70.0), rel=0.05)


def test_layouts_that_do_not_fit_say_so() -> None:
    tags = tags_of(4, 4)
    corners = seen(tags, 0.2, seed=0)
    none: Sequence[tuple[dict[int, Array], str]] = (
        ({index + 100: places for index, places in tags.items()}, "no tag of it was seen"),
        (
            dict(zip(tags, np.random.default_rng(3).permutation(list(tags.values())), strict=True)),
            "not arranged as it says",
        ),
        (tags | {index: tags[index] + [0.0, 0.0, 5.0 + 3.0 * index] for index in range(7)}, "only 9 of the 16"),
    )
    for listed, expected in none:
        found, said = scale_from_layout(TagLayout(APRILTAG, listed), corners, TAG_EDGE_STD_PX / SIDE_PX)
        assert found is None
        assert expected in said and "\n" not in said


@pytest.mark.parametrize("name", ["layout.json", "layout.toml"])
def test_files(name: str, tmp_path: Path) -> None:
    tags = tags_of(2, 1)
    listed = {str(index): places.tolist() for index, places in tags.items()}
    path = tmp_path / name
    lines = "".join(f"{index} = {places}\n" for index, places in listed.items())
    toml = f'[[tag_layout]]\ndictionary = "apriltag36h11"\nstd_mm = 0.01\n[tag_layout.corners_mm]\n{lines}'
    content = {"tag_layout": [{"dictionary": "apriltag36h11", "std_mm": 0.01, "corners_mm": listed}]}
    path.write_text(json.dumps(content) if name.endswith("json") else toml)
    (layout,) = load_scale_file(path).layouts
    assert (layout.dictionary, layout.std_mm, list(layout.corners_mm)) == (APRILTAG, 0.01, [0, 1])
    np.testing.assert_array_equal(layout.corners_mm[1], tags[1])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[1, 2]", "expected an object with board, tag, tag_layout"),
        ("{", "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ('{"tags": []}', "unknown key 'tags'"),
        ('{"tag_layout": {"corners_mm": {}}}', r"expected tables \[\[tag_layout\]\]"),
        ('{"tag_layout": [{"std_mm": 1}]}', "the key 'corners_mm' is missing"),
        ('{"tag_layout": [{"corners_mm": {}}]}', "expected four corners"),
        ('{"tag_layout": [{"corners_mm": {"a": []}}]}', "'a' is not the id of a tag"),
        ('{"tag_layout": [{"corners_mm": {"1": [[0, 0, 0]]}}]}', "tag 1: expected four corners"),
        ('{"tag_layout": [{"corners_mm": {"1": [[0,0,0],[1,0,0],[1,1,NaN],[0,1,0]]}}]}', "tag 1: expected four"),
        ('{"tag_layout": [{"corners_mm": {"1": [[0,0,0],[1,0,0],[0,0,0],[0,1,0]]}}]}', "two of its corners"),
        ('{"tag_layout": [{"corners_mm": {"1": "x"}, "dictionary": "9x9"}]}', "tag 1: expected four corners"),
    ],
)  # fmt: skip
def test_wrong_files_are_one_line(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "layout.json"
    path.write_text(text)
    with pytest.raises(InputError, match=expected) as raised:
        load_scale_file(path)
    assert "\n" not in str(raised.value)
