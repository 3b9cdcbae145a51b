"""Recorded sequences as films for trackers, arview on them, and what comes out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.tracking import TrackedPart, TrackingSession
from arview.video import Image
from arview_lab.evaluation import PoseMeter, Scene, SceneFrame, scene_guide_views
from peers.programs import Track

WARM_UP = 5
"""Frames that arview tracks before it is measured, to load compiled code."""
COARSE = (50.0, 5.0)
"""5 cm and 5°, in mm and degrees: a pose beyond is wrong."""
IN_VIEW = 0.5
"""Errors count in frames that show at least this share of the part."""


@dataclass(frozen=True)
class Film:
    """The frames of a sequence from the first one with a reference pose on.

    Attributes:
        scene: the sequence.
        frames: its frames that are used.
        images: (H,W,3) uint8 RGB of each.
        folder: where the files for programs are: task.txt, frames/ and body.obj, in metres, of the model moved so that
            its centre is the origin.
    """

    scene: Scene
    frames: tuple[SceneFrame, ...]
    images: tuple[Image, ...]
    folder: Path

    @property
    def first_pose(self) -> Array:
        """(4,4) reference ``cam_from_model`` of the first frame, mm."""
        pose = self.frames[0].cam_from_model
        assert pose is not None
        return pose

    @property
    def center_mm(self) -> Array:
        """(3,) centre of the model's bounding box in its own frame, mm."""
        return self.scene.part.model.center_in_model

    @property
    def mesh_m(self) -> tuple[Array, NDArray[np.int32]]:
        """Vertices (V,3) about the centre, m, and faces (F,3)."""
        vertices, faces, _ = self.scene.part.model.mesh
        return 1e-3 * (vertices - self.center_mm), faces


def make_film(scene: Scene, folder: Path, limit: int | None = None) -> Film:
    """Write what programs need of a scene, at most ``limit`` frames of it, into a new folder."""
    start = next(k for k, frame in enumerate(scene.frames) if frame.cam_from_model is not None)
    frames = scene.frames[start:][:limit]
    film = Film(scene, frames, tuple(scene.image(frame) for frame in frames), folder)
    (folder / "frames").mkdir(parents=True)
    for index, image in enumerate(film.images):
        picture = np.ascontiguousarray(image[..., ::-1])
        cv2.imwrite(str(folder / "frames" / f"{index:06d}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    camera, pose = scene.camera, film.first_pose
    at = 1e-3 * (pose[:3, :3] @ film.center_mm + pose[:3, 3])
    numbers = [len(frames), camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    rows = np.column_stack([pose[:3, :3], at])
    lines = [" ".join(map(str, numbers)), *(" ".join(f"{v:.12g}" for v in row) for row in rows)]
    (folder / "task.txt").write_text("\n".join(lines) + "\n")
    vertices, faces = film.mesh_m
    body = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
    body += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (folder / "body.obj").write_text("\n".join(body) + "\n")
    return film


def track_with_arview(film: Film) -> Track:
    """Track a film from its first reference pose with a session of arview in this process."""
    session = _session(film)
    cpu_ms: list[float] = []
    poses: list[Array | None] = []
    for number, (frame, image) in enumerate(zip(film.frames, film.images, strict=True)):
        began = time.process_time()
        (pose,) = session.process(image, frame.index, number / 30.0)
        cpu_ms.append(1e3 * (time.process_time() - began))
        poses.append(pose.cam_from_model)
    return Track(cpu_ms, poses)


def warm_up(film: Film) -> None:
    """Let arview load its compiled code, and make guide views where they are not made yet."""
    session = _session(film)
    for number, image in enumerate(film.images[:WARM_UP]):
        session.process(image, number, number / 30.0)


def _session(film: Film) -> TrackingSession:
    scene = film.scene
    part = TrackedPart(scene_guide_views(scene), scene.part.model, initial_cam_from_model=film.first_pose)
    return TrackingSession([part], scene.camera)


@dataclass(frozen=True)
class TrackRow:
    """One way on one sequence.

    Attributes:
        sequence, way: names.
        rounds_ms: median CPU ms a frame of each round, without the first frame.
        median_ms, p95_ms: medians over the rounds of the median and of the 95th percentile; None without a frame.
        evaluated: frames with a reference and enough of the part in view.
        followed: those of them in which there is a pose.
        right: those within 5 cm and 5°.
        translation_mm, rotation_deg: median and maximum of the errors where there is a pose, or None.
    """

    sequence: str
    way: str
    rounds_ms: list[float]
    median_ms: float | None
    p95_ms: float | None
    evaluated: int
    followed: int
    right: int
    translation_mm: tuple[float, float] | None
    rotation_deg: tuple[float, float] | None


def row_of(film: Film, way: str, tracks: Sequence[Track]) -> TrackRow:
    """Times of all rounds, and errors of the first."""
    scene = film.scene
    meter = PoseMeter(scene.part.model, scene.camera, None, scene.part.symmetries, scene.symmetric_poses)
    evaluated, errors = 0, []
    for number, frame in enumerate(film.frames):
        if frame.cam_from_model is None or (frame.visible is not None and frame.visible < IN_VIEW):
            continue
        evaluated += 1
        pose = tracks[0].poses[number] if number < len(tracks[0].poses) else None
        if pose is not None:
            errors.append(meter.measure(pose, frame.cam_from_model))
    times = [np.array(track.cpu_ms[1:]) for track in tracks if len(track.cpu_ms) > 1]
    medians = [float(np.median(ms)) for ms in times]
    return TrackRow(
        scene.name, way, medians,
        float(np.median(medians)) if medians else None,
        float(np.median([np.percentile(ms, 95) for ms in times])) if times else None,
        evaluated, len(errors), sum(error.within(*COARSE) for error in errors),
        _median_and_max([error.translation_mm for error in errors]),
        _median_and_max([error.rotation_deg for error in errors]),
    )  # fmt: skip


def _median_and_max(values: list[float]) -> tuple[float, float] | None:
    return (float(np.median(values)), max(values)) if values else None
