"""Whole datasets: choosing the background and the occluder of a sequence, and reusing one that exists already."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from arview.cad.model import Model
from arview.cad.symmetry import Symmetry
from arview.camera import Camera
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.evaluation.bop import Scene
from arview.evaluation.metrics import symmetry_group
from arview.evaluation.semisynthetic.backgrounds import read_photo
from arview.evaluation.semisynthetic.look_alikes import LookAlike, different_share
from arview.evaluation.semisynthetic.scene_files import RECORD_FILE, write_dataset
from arview.evaluation.semisynthetic.sequence import (
    CAMERA,
    VARIANTS,
    SequenceOptions,
    generator,
    render_sequence,
    trajectory,
)
from arview.evaluation.semisynthetic.shapes import SHAPES, shape
from arview.evaluation.semisynthetic.trajectory import TrajectoryOptions, followed_trajectory
from arview.geometry import Array

WALK_ROUND = TrajectoryOptions(turn_deg=4.0, step_mm=8.0, distance_mm=(450.0, 800.0))
"""Motion of a camera that is moved around an assembly, for look-alikes."""


@dataclass(frozen=True)
class Job:
    """A sequence to be made.

    Attributes:
        name: of the dataset's folder.
        model: the CAD to be found.
        options: of the sequence.
        photos: backgrounds to choose from.
        look_alike: rendered instead of the model, or None.
        follow: scene whose camera and trajectory are used, or None.
        symmetries: rotations of the model that change nothing.
    """

    name: str
    model: Model
    options: SequenceOptions
    photos: tuple[Path, ...]
    look_alike: LookAlike | None = None
    follow: Scene | None = None
    symmetries: tuple[Symmetry, ...] = ()

    @property
    def camera(self) -> Camera:
        """The camera of RBOT, or of the followed scene."""
        return self.follow.camera.without_distortion() if self.follow else CAMERA

    @property
    def photo(self) -> Path:
        """The background: a different one for each variant, and for each shape if there are enough."""
        order = generator(self.options.seed, "photos").permutation(len(self.photos))
        known = SHAPES.index(self.model.name) if self.model.name in SHAPES else len(SHAPES)
        place = len(VARIANTS) * known + VARIANTS.index(self.options.variant)
        if self.look_alike:
            place += int(generator(self.options.seed, self.look_alike.name).integers(len(order)))
        return self.photos[order[place % len(order)]]

    def poses(self) -> Array:
        """``cam_from_model`` (frames,4,4)."""
        if self.follow is None:
            return trajectory(self.model, self.options, name=self.look_alike.name if self.look_alike else "")
        center = self.follow.part.model.center_in_model
        return followed_trajectory(self.follow.poses[: self.options.frames], center, self.model.center_in_model)


def shape_job(name: str, options: SequenceOptions, photos: tuple[Path, ...]) -> Job:
    """A sequence of one of the test shapes."""
    return Job(f"{name}_{options.variant}", shape(name), options, photos)


def look_alike_job(
    name: str,
    model: Model,
    look_alike: LookAlike,
    options: SequenceOptions,
    photos: tuple[Path, ...],
    follow: Scene | None = None,
) -> Job:
    """A sequence of a look-alike, in which the nominal model is tracked; the camera moves more slowly."""
    options = replace(options, motion=WALK_ROUND)
    name = f"{name}_{look_alike.name.replace('/', '-')}_{options.variant}"
    return Job(name, model, options, photos, look_alike, follow)


def make_sequence(job: Job, folder: Path, progress: StepProgress | None = None) -> Path:
    """Make a sequence and write it below a folder, unless it exists already; returns the sequence's folder.

    Raises:
        InputError: there is no background, or one cannot be read; the followed scene has no poses.
        OutputError: see `write_dataset`.
    """
    if not job.photos:
        raise InputError("there are no background photos; give a folder of photos with --backgrounds")
    if job.follow is not None and not job.follow.poses:
        raise InputError(f"{job.follow.folder}: no frame has a pose to follow; give another --trajectory")
    target = folder / job.name
    record = _record(job)
    if _has_record(target, record):
        return target
    poses, camera = job.poses(), job.camera
    blocker = shape(_other_shape(job.model.name))
    drawn = job.look_alike.model if job.look_alike else job.model
    frames = render_sequence(drawn, poses, read_photo(job.photo), job.options, camera, blocker, job.name)
    shares = None
    if job.look_alike:
        shares = [different_share(job.model, drawn, camera, pose) for pose in poses]
    turns = tuple(symmetry_group(job.symmetries)[1:])
    report = None if progress is None else (lambda done: progress(done, len(poses)))
    write_dataset(target, job.model, camera, frames, record, turns, shares, report)
    return target


def read_record(dataset: Path) -> dict[str, Any]:
    """Contents of sequence.json of a dataset made here; empty if there is none."""
    try:
        content = json.loads((dataset / RECORD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _other_shape(name: str) -> str:
    place = SHAPES.index(name) + 2 if name in SHAPES else 0
    return SHAPES[place % len(SHAPES)]


def _record(job: Job) -> dict[str, Any]:
    look_alike = None
    if job.look_alike:
        look_alike = {"fault": job.look_alike.fault, "components": list(job.look_alike.components)}
    return {
        "made_by": "arview semisynthetic",
        "name": job.name,
        "model": job.model.source_hash,
        "options": asdict(job.options),
        "photo": "/".join(job.photo.parts[-3:]),
        "look_alike": look_alike,
        "trajectory": job.follow.name if job.follow else None,
        "code": _code_hash(),
    }


def _has_record(dataset: Path, record: dict[str, Any]) -> bool:
    return read_record(dataset) == json.loads(json.dumps(record))


@cache
def _code_hash() -> str:
    """Hash of the code that makes sequences, so that sequences made by other code are not reused."""
    package = Path(__file__).parent
    files = [*sorted(package.glob("*.py")), package.parent.parent / "rendering" / "rasterizer.py"]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
