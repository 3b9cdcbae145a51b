"""Two parts, or two specimens of one, in one film: each as exact as alone, and the time of both."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from arview.annotation import annotate
from arview.cad import Part, load_part
from arview.camera import Camera
from arview.camera.read import load_camera
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet
from arview.guideviews.cache import cached_guide_views
from arview.overlay import OverlayRenderer
from arview.pose import Pose
from arview.tracking import TrackedPart, TrackingSession
from arview.video import Image, VideoSink, open_source
from arview_lab.evaluation import Scene, scene_guide_views
from recordings import ROOT
from rows import ResultRow

ASIDE = 0.47
"""Tangent of the angle by which each half is turned aside, in widths of a frame over the focal length."""
FRAMES = 90


@dataclass(frozen=True)
class Half:
    """One half of the film: a part, its guide views, its frames and its true ``cam_from_model`` (4,4) in each."""

    part: Part
    views: GuideViewSet
    camera: Camera
    images: list[Image]
    truth: list[Array]


class SeveralSuite:
    """The section ``several`` of the evaluation.

    Args:
        recorded: scenes by name.
        details: for evaluation.json.
        frames: at most so many.
    """

    def __init__(self, recorded: dict[str, Scene], details: dict[str, Any], frames: int | None = None) -> None:
        self._recorded, self._details, self._frames = recorded, details, frames or FRAMES

    def rows(self) -> list[ResultRow]:
        """Rows of two castles, and of the two samples."""
        rows = []
        if "castle" in self._recorded:
            scene = self._recorded["castle"]
            views = scene_guide_views(scene)
            images = [scene.image(frame) for frame in scene.frames]
            truth = [frame.cam_from_model for frame in scene.frames if frame.cam_from_model is not None]
            one = Half(scene.part, views, scene.camera, images, truth)
            rows += self._pair("two castles", one, Half(scene.part, views, scene.camera, images[::-1], truth[::-1]))
        return rows + self._pair("both samples", bracket_half(self._frames), plate_half(self._frames))

    def _pair(self, name: str, left: Half, right: Half) -> list[ResultRow]:
        """Rows of one film."""
        camera, frames = composed(left, right)
        names, halves = (f"{left.part.name}#1", f"{right.part.name}#2"), (left, right)
        alone, alone_ms = [], []
        for k in range(2):
            found, ms = run([(half_only(image, k), truth) for image, truth in frames], camera, {names[k]: halves[k]})
            alone.append(errors_mm(halves[k], [one[0] for one in found], [truth[k] for _, truth in frames]))
            alone_ms.append(ms)
        found, both_ms = run(frames, camera, dict(zip(names, halves, strict=True)))
        both = []
        for k in range(2):
            own = [nearest_of(poses, truth, k, halves) for poses, (_, truth) in zip(found, frames, strict=True)]
            both.append(errors_mm(halves[k], own, [truth[k] for _, truth in frames]))
        ratios = both_ms / np.mean(alone_ms, axis=0)
        self._details[f"several-{name}"] = {
            "alone_mm": alone,
            "both_mm": both,
            "alone_wall_cpu_ms": [times.tolist() for times in alone_ms],
            "both_wall_cpu_ms": both_ms.tolist(),
        }
        medians = [(float(np.nanmedian(a)), float(np.nanmedian(b))) for a, b in zip(alone, both, strict=True)]
        shares = [(share_found(a), share_found(b)) for a, b in zip(alone, both, strict=True)]
        text = "; ".join(
            f"{100 * after:.0f} % of frames at {b:.2f} mm (alone {100 * before:.0f} % at {a:.2f})"
            for (a, b), (before, after) in zip(medians, shares, strict=True)
        )
        is_exact = all(b <= 1.1 * a + 0.02 for a, b in medians) and all(
            after >= 0.9 * before for before, after in shares
        )
        rows = [ResultRow("two at once", name, text, "each as alone ± 10 %", is_exact)]
        for kind, ratio in zip(("CPU time", "wall time"), ratios[::-1], strict=True):
            found_text = f"{ratio:.2f} × that of one, film included"
            rows.append(ResultRow(f"two at once, {kind}", name, found_text, "≤ 1.7 ×", bool(ratio <= 1.7)))
        return rows


def bracket_half(count: int) -> Half:
    """The clip of the bracket plate."""
    folder = ROOT / "samples" / "bracket_plate"
    described = json.loads((folder / "truth.json").read_text())["frames"]
    truth = [np.array(frame["cam_from_model"]) for frame in described[:count]]
    return clip_half(folder, load_camera(str(folder / "camera.json"), 1280, 720), truth)


def plate_half(count: int) -> Half:
    """The clip of the welded plate, whose camera is described with its truth."""
    folder = ROOT / "samples" / "plate"
    described = json.loads((folder / "clip_truth.json").read_text())
    lens = described["camera"]
    camera = Camera(
        lens["width"], lens["height"], lens["fx"], lens["fy"], lens["cx"], lens["cy"], np.array(lens["dist"])
    )
    return clip_half(folder, camera, [np.array(pose) for pose in described["cam_from_model"][:count]])


def clip_half(folder: Path, lens: Camera, truth: list[Array]) -> Half:
    """The first frames of a sample's clip, 360 rows high, without the distortion of its lens."""
    part = load_part(folder / "part.toml")
    small = lens.scaled(round(360 * lens.width / lens.height), 360)
    images = []
    for frame in open_source(folder / "clip.mp4", end=len(truth)):
        reduced = cv2.resize(frame.image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        images.append(np.asarray(cv2.undistort(reduced, small.matrix, small.dist)))
    return Half(
        part, cached_guide_views(part.model, part.effective_view_range), small.without_distortion(), images, truth
    )


def composed(left: Half, right: Half) -> tuple[Camera, list[tuple[Image, tuple[Array, Array]]]]:
    """Wide frames with one part in each half, and both true poses.

    A turn about the optical centre is a homography of the picture, whatever the scene; the right half is brought to the
    focal length of the left one, which its pose does not change.
    """
    lens = left.camera
    width = round(2.3 * lens.width) // 2 * 2
    wide = Camera(width, lens.height, lens.fx, lens.fy, 0.5 * (width - 1), lens.cy)
    frames = []
    for k in range(min(len(left.images), len(right.images), len(left.truth), len(right.truth))):
        halves = [turned(half, k, side, wide) for half, side in ((left, -1.0), (right, 1.0))]
        image = np.concatenate([halves[0][0][:, : width // 2], halves[1][0][:, width // 2 :]], axis=1)
        frames.append((np.ascontiguousarray(image), (halves[0][1], halves[1][1])))
    return wide, frames


def half_only(image: Image, k: int) -> Image:
    """A wide frame without the part in the other half."""
    shown = image.copy()
    middle = image.shape[1] // 2
    (shown[:, middle:] if k == 0 else shown[:, :middle])[:] = 110
    return shown


def turned(half: Half, k: int, side: float, wide: Camera) -> tuple[Image, Array]:
    """A frame as a wide camera sees it after a turn to one side, and its pose."""
    angle = side * np.arctan(ASIDE * wide.width / 2.3 / wide.fx)
    turn = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    moved = wide.matrix @ turn @ np.linalg.inv(half.camera.matrix)
    shown = cv2.warpPerspective(half.images[k], moved, (wide.width, wide.height), borderValue=(110, 110, 110))
    pose = half.truth[k].copy()
    pose[:3] = turn @ half.truth[k][:3]
    return np.asarray(shown), pose


def run(
    frames: list[tuple[Image, tuple[Array, Array]]], camera: Camera, halves: dict[str, Half]
) -> tuple[list[tuple[Pose, ...]], Array]:
    """Poses of some parts in all frames, and the time of a frame (2,), ms, by wall and CPU: read, tracked, drawn."""
    views: dict[str, GuideViewSet] = {}
    parts = []
    overlay: OverlayRenderer | None = None
    for name, half in halves.items():
        shared = views.setdefault(half.part.model.source_hash, half.views)
        parts.append(TrackedPart(shared, half.part.model, name))
        if overlay is None:
            overlay = OverlayRenderer(half.part.model, camera, name=name)
        else:
            overlay.add(half.part.model, name=name)
    with TemporaryDirectory() as folder:
        made = Path(folder) / "frames.mp4"
        write(made, camera, [image for image, _ in frames])
        recorder = Recorder(TrackingSession(parts, camera))
        began = time.process_time()
        with open_source(made) as source:
            sink = VideoSink(Path(folder) / "out.mp4", camera.width, camera.height, 30.0, source)
            summary = annotate(source, recorder, overlay, sink)
        cpu_s = time.process_time() - began
    return recorder.found, 1e3 * np.array([summary.seconds, cpu_s]) / summary.frames


class Recorder:
    """A session whose poses are kept."""

    def __init__(self, session: TrackingSession) -> None:
        self._session = session
        self.found: list[tuple[Pose, ...]] = []

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        """Poses of the next frame."""
        self.found.append(self._session.process(image, index, time_s))
        return self.found[-1]


def write(path: Path, camera: Camera, images: list[Image]) -> None:
    """Write frames as a film."""
    sink = VideoSink(path, camera.width, camera.height, 30.0)
    for number, image in enumerate(images):
        sink.write(image, number / 30.0)
    sink.close()


def nearest_of(poses: tuple[Pose, ...], truth: tuple[Array, Array], k: int, halves: tuple[Half, Half]) -> Pose:
    """The pose that lies on specimen ``k``: which session follows which specimen of one part is left to them."""
    if halves[0].part.model.source_hash != halves[1].part.model.source_hash:
        return poses[k]
    return min(poses, key=lambda one: center_error_mm(halves[k], one, truth[k]))


def center_error_mm(half: Half, pose: Pose, truth: Array) -> float:
    """Error of the centre; infinite without a pose."""
    if pose.cam_from_model is None:
        return float("inf")
    center = half.part.model.center_in_model
    return float(np.linalg.norm(apply(pose.cam_from_model, center) - apply(truth, center)))


def errors_mm(half: Half, poses: list[Pose], truth: list[Array]) -> list[float]:
    """Errors of the centre; NaN where there is no pose or one of another place."""
    found = [center_error_mm(half, *of) for of in zip(poses, truth, strict=True)]
    return [error if error < 0.1 * half.part.model.diameter_mm else float("nan") for error in found]


def share_found(errors: list[float]) -> float:
    return float(np.mean(np.isfinite(errors)))
