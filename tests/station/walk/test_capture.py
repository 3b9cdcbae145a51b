"""Guided capture on a source of frames: which of them become photos, and what is on the disk."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from arview.cad.model import make_model
from arview.cad.part import ComponentSettings, Part
from arview.cad.view_range import ViewRange
from arview.cad.viewpoint import Viewpoint, pose_at
from arview.camera import Camera
from arview.camera.exif import focal_length_px, read_exif
from arview.core import atomic
from arview.core.messages import sentence
from arview.errors import OutputError
from arview.geometry import Array
from arview.pose import Pose, TrackingState
from arview.reconstruction.intake.reading import photo_paths
from arview.station.walk.capture import capture_options, capture_photos, open_folder, summary_lines
from arview.video import Frame, FrameSource
from arview.video.pictures import PictureSource
from arview.video.source import FrameRange
from helpers.cad_files import box
from helpers.synthetic import component

CAMERA = Camera(640, 480, 720.0, 720.0, 319.5, 239.5)
MODEL = make_model(
    "part",
    (
        component("plate", box((-80, -80, -8), (80, 80, 0)), (0.5, 0.5, 0.5)),
        component("block", box((20, -10, 0), (50, 10, 25)), (0.5, 0.5, 0.5)),
    ),
)
PART = Part(
    "part", Path("part.toml"), Path("part.step"), MODEL,
    (ComponentSettings("plate", role="base"), ComponentSettings("block", position_tolerance_mm=0.5)),
    ViewRange((300.0, 600.0), elevation_deg=(15.0, 60.0)),
)  # fmt: skip


def picture(number: int) -> np.ndarray:
    """Sharp rectangles that differ from frame to frame."""
    rng = np.random.default_rng(number)
    image = np.full((480, 640, 3), 90, dtype=np.uint8)
    for _ in range(200):
        x, y = rng.uniform((0, 0), (640, 480)).astype(int)
        cv2.rectangle(image, (x, y), (x + 30, y + 20), rng.uniform(0, 255, 3).tolist(), -1)
    return image


class Walk(FrameSource):
    """Frames of a walk: two rings round the part, 15 frames a second, with a rest of four frames at each place."""

    def __init__(self, interrupt_at: int | None = None) -> None:
        self.name, self.width, self.height, self.fps = "walk", 640, 480, 15.0
        self.poses: list[Array] = []
        self._interrupt_at = interrupt_at
        for ring in (25.0, 48.0):
            for azimuth in range(-180, 180, 15):
                for step in range(8):
                    moved = 15.0 * max(0, step - 3) / 5.0
                    place = Viewpoint(420.0, ring, azimuth + moved, 0.0)
                    self.poses.append(pose_at(place, MODEL.center_in_model))
        self.frame_count = len(self.poses)

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self.poses)):
            if index == self._interrupt_at:
                raise KeyboardInterrupt
            yield Frame(picture(index // 8), index, index / 15.0)


class Known:
    """A session that knows the pose of each frame, except of those in which the part is lost."""

    def __init__(self, poses: list[Array], lost: range = range(0)) -> None:
        self._poses, self._lost = poses, lost

    def process(self, image: object, index: int, time_s: float) -> tuple[Pose, ...]:
        if index in self._lost:
            return (Pose(None, None, 0.0, TrackingState.LOST, time_s, index),)
        return (Pose(self._poses[index], None, 0.9, TrackingState.TRACKED, time_s, index),)


@pytest.mark.slow
def test_a_walk_gives_photos_with_their_poses(tmp_path: Path) -> None:
    walk = Walk()
    job = open_folder(tmp_path / "out", PART, "S-1", "camera.json")
    summary = capture_photos(walk, Known(walk.poses), PART, lambda index: CAMERA, job, capture_options(None))
    stored = job.photos()
    assert len(summary.photos) == 20 and summary.advice is not None and summary.advice.is_enough
    assert tuple(photo.name for photo in stored) == summary.photos and job.is_ended
    directions = []
    for photo in stored:
        content = (tmp_path / "out" / "photos" / photo.name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == photo.sha256 and len(content) == photo.bytes
        assert photo.hint is not None and photo.hint["quality"] == 0.9 and photo.hint["camera"]["fx"] == 720.0
        pose = photo.cam_from_model
        assert pose is not None
        index = next(i for i, one in enumerate(walk.poses) if np.allclose(one, pose))
        decoded = np.asarray(Image.open(io.BytesIO(content)))
        assert np.abs(decoded.astype(float) - picture(index // 8)).mean() < 2.0
        directions.append(-pose[:3, :3].T @ pose[:3, 3] - MODEL.center_in_model)
    units = np.array(directions) / np.linalg.norm(directions, axis=1, keepdims=True)
    cosines = units @ units.T - 2.0 * np.eye(20)
    assert np.degrees(np.arccos(cosines.max())) > 10.0  # never two from one place
    document = json.loads((tmp_path / "out" / "job.json").read_text())
    assert document["serial"] == "S-1" and document["model_hash"] == MODEL.source_hash
    # What `arview inspect --photos` reads, with the focal length to begin with.
    paths, _ = photo_paths(tmp_path / "out")
    assert [path.name for path in paths] == list(summary.photos)
    assert focal_length_px(read_exif(paths[0]), 640, 480) == pytest.approx(720.0, rel=0.02)
    text = "\n".join(summary_lines(summary, PART))
    assert "20 photos of" in text and "still wanted" not in text


@pytest.mark.slow
def test_nothing_is_taken_while_the_part_is_lost(tmp_path: Path) -> None:
    walk = Walk()
    job = open_folder(tmp_path / "out", PART, None, None)
    lost = range(60, 200)
    summary = capture_photos(walk, Known(walk.poses, lost), PART, lambda index: CAMERA, job)
    taken = [photo.cam_from_model for photo in job.photos()]
    assert len(taken) > 5
    for pose in taken:
        assert not any(np.allclose(walk.poses[index], pose) for index in lost)
    assert summary.reasons[sentence("capture.not_tracked")] == len(lost)
    assert not (tmp_path / "out" / "job.json").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_taken(tmp_path: Path) -> None:
    walk = Walk(interrupt_at=50)
    job = open_folder(tmp_path / "out", PART, None, None)
    summary = capture_photos(walk, Known(walk.poses), PART, lambda index: CAMERA, job)
    assert summary.is_interrupted and 2 <= len(summary.photos) < 20 and job.is_ended
    assert summary.advice is not None and not summary.advice.is_enough
    assert any(line.startswith("still wanted") for line in summary_lines(summary, PART))


@pytest.mark.slow
def test_pictures_keep_their_files(tmp_path: Path) -> None:
    folder = tmp_path / "shots"
    folder.mkdir()
    walk = Walk()
    exif = Image.Exif()
    exif[0x0110] = "a real camera"
    for index in range(40):
        Image.fromarray(picture(index // 8)).save(folder / f"shot_{index:03d}.jpg", quality=90, exif=exif)
    source = PictureSource("shots", sorted(folder.iterdir()), FrameRange(), 15.0)
    job = open_folder(tmp_path / "out", PART, None, None)
    summary = capture_photos(source, Known(walk.poses), PART, lambda index: CAMERA, job)
    originals = {path.read_bytes() for path in folder.iterdir()}
    assert len(summary.photos) >= 2
    for name in summary.photos:
        assert (tmp_path / "out" / "photos" / name).read_bytes() in originals


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        open_folder(tmp_path, PART, None, None)
    with pytest.raises(OutputError, match=r"note\.txt"):
        open_folder(tmp_path / "note.txt", PART, None, None)


@pytest.mark.slow
def test_a_full_disk_ends_it_and_keeps_the_photos_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk()
    job = open_folder(tmp_path / "out", PART, None, None)
    replacing, written = atomic.replacing, []

    def full(path: Path) -> object:
        if len(written) >= 3:
            raise OSError(28, "No space left on device")
        written.append(path)
        return replacing(path)

    monkeypatch.setattr("arview.core.durable.replacing", full)
    with pytest.raises(OutputError, match="out"):
        capture_photos(walk, Known(walk.poses), PART, lambda index: CAMERA, job)
    assert len(job.photos()) == 3
    assert len(list((tmp_path / "out" / "photos").iterdir())) == 3
