"""With masks of the part: when the poses of the whole photos stand, and when the photos are placed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from arview.core.progress import Progress
from arview.errors import CannotMeasureError
from arview.geometry import Array
from arview.reconstruction.part_masks import PartMasks, placed_with_silhouettes
from arview.reconstruction.types import Photo, PosedPhoto, SparseModel
from helpers.photo_scene import CAMERA

PHOTOS = [Photo(f"{i}.png", Path(f"{i}.png"), CAMERA.width, CAMERA.height, "lens", CAMERA) for i in range(10)]


def placed(photos: Sequence[Photo]) -> SparseModel:
    none = np.zeros(0, np.int32)
    posed = tuple(PosedPhoto(one.name, one.path, one.camera, np.eye(4), one.mask) for one in photos)
    points: Array = np.zeros((0, 3))
    return SparseModel(posed, points, np.zeros((0, 3), np.uint8), np.zeros(0), none, none, np.zeros((0, 2)))


@dataclass
class Fake:
    """Places as many of the whole photos, and of the masked ones, as it is told; finds the part or not."""

    whole: int
    by_part: int = 0
    found: int = 0
    agrees: bool = True
    did: list[str] = field(default_factory=list)

    def key(self) -> str:
        return ""

    def place(self, photos: Sequence[Photo], folder: Path) -> SparseModel:
        is_masked = photos[0].mask is not None
        self.did.append(f"{'masked' if is_masked else 'whole'} {len(photos)}")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "who").write_text("masked" if is_masked else "whole")
        count = self.by_part if is_masked else self.whole
        if count < 3:
            raise CannotMeasureError("no two photos match")
        return placed(photos[:count])

    def at_poses(self, sparse: SparseModel, folder: Path, tell: Progress) -> PartMasks:
        if not self.agrees and sparse.photos[0].mask is None:
            return PartMasks("the part is elsewhere")
        return PartMasks("wide", {one.name: folder / f"wide_{one.name}" for one in sparse.photos})

    def in_photos(self, photos: Sequence[Photo], folder: Path, tell: Progress) -> PartMasks:
        return PartMasks("tight", {one.name: folder / f"tight_{one.name}" for one in photos[: self.found]})

    def run(self, folder: Path, can_place_again: bool = True) -> SparseModel:
        return placed_with_silhouettes(
            PHOTOS, folder / "sparse", folder / "silhouettes", self, self.place, lambda *of: None, can_place_again
        )


def test_poses_that_the_part_agrees_with_stand(tmp_path: Path) -> None:
    fake = Fake(whole=9)
    sparse = fake.run(tmp_path)
    assert fake.did == ["whole 10"] and len(sparse.photos) == 9
    assert all(one.mask == tmp_path / "silhouettes" / f"wide_{one.name}" for one in sparse.photos)
    assert "the camera poses come from the whole photos" in sparse.remarks[-1]


@pytest.mark.parametrize(
    ("whole", "agrees", "why"),
    [
        (0, True, "could not be placed"),
        (9, False, "the part is elsewhere"),
        (5, True, "only 5 of 10 photos were placed whole"),
    ],
)
def test_a_moving_background_is_left_out(tmp_path: Path, whole: int, agrees: bool, why: str) -> None:
    fake = Fake(whole, by_part=9, found=9, agrees=agrees)
    sparse = fake.run(tmp_path)
    assert fake.did == ["whole 10", "masked 9"]
    assert len(sparse.photos) == 9 and all(one.mask and "wide" in one.mask.name for one in sparse.photos)
    assert (tmp_path / "sparse" / "who").read_text() == "masked" and not (tmp_path / "sparse_by_part").exists()
    assert [name for name, _ in sparse.unplaced] == ["9.png"]
    assert "by the part alone" in sparse.remarks[-1] and why in sparse.remarks[-1]


@pytest.mark.parametrize(("found", "by_part"), [(2, 0), (10, 0), (10, 4)])
def test_without_masks_the_photos_are_used_whole(tmp_path: Path, found: int, by_part: int) -> None:
    sparse = Fake(5, by_part, found).run(tmp_path)
    assert len(sparse.photos) == 5 and all(one.mask is None for one in sparse.photos)
    assert (tmp_path / "sparse" / "who").read_text() == "whole" and not (tmp_path / "sparse_by_part").exists()
    assert sparse.remarks[-1].startswith("no masks from the CAD's silhouette, the photos are used whole: only 5 of 10")


@pytest.mark.parametrize("found", [0, 10])
def test_where_nothing_is_placed_one_line_says_both_reasons(tmp_path: Path, found: int) -> None:
    with pytest.raises(CannotMeasureError) as error:
        Fake(0, 0, found).run(tmp_path)
    text = str(error.value)
    assert text.startswith("no two photos match; --masks auto does not help: ") and "\n" not in text


def test_given_poses_are_never_replaced(tmp_path: Path) -> None:
    fake = Fake(9, by_part=10, found=10, agrees=False)
    sparse = fake.run(tmp_path, can_place_again=False)
    assert fake.did == ["whole 10"] and all(one.mask is None for one in sparse.photos)
    assert "no masks" in sparse.remarks[-1] and "the part is elsewhere" in sparse.remarks[-1]
    with pytest.raises(CannotMeasureError, match=r"^no two photos match$"):
        Fake(0, 10, 10).run(tmp_path, can_place_again=False)
