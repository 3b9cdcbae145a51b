"""Whole datasets: choosing the background and the occluder of a sequence, and reusing one that exists already."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from arview.cad.model import Model
from arview.cad.shape.symmetry import Symmetry
from arview.camera import Camera
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.geometry import Array
from arview.rendering import rasterizer
from arview_lab.evaluation.bop import Scene
from arview_lab.evaluation.metrics import symmetry_group
from arview_lab.semisynthetic.backgrounds import read_photo
from arview_lab.semisynthetic.conditions import CONDITIONS, Conditions
from arview_lab.semisynthetic.curved_shapes import CURVED_SHAPES, curved_shape
from arview_lab.semisynthetic.look_alikes import LookAlike, different_share
from arview_lab.semisynthetic.real_sequence import real_trajectory, render_real
from arview_lab.semisynthetic.scene_files import RECORD_FILE, write_dataset
from arview_lab.semisynthetic.sequence import (
    CAMERA,
    VARIANTS,
    SequenceFrame,
    SequenceOptions,
    generator,
    render_sequence,
    trajectory,
)
from arview_lab.semisynthetic.shapes import BOX_SHAPES, SHAPES, shape, symmetries_of
from arview_lab.semisynthetic.trajectory import TrajectoryOptions, followed_trajectory

WALK_ROUND = TrajectoryOptions(turn_deg=4.0, step_mm=8.0, distance_mm=(450.0, 800.0))
"""Motion of a camera that is moved around an assembly, for look-alikes."""
PRINTED_PHOTOS = 8
"""Photographs to choose from for a part's prints."""


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
        conditions: real ones instead of the options' variant, of which then only frames and seed are used; or None.
    """

    name: str
    model: Model
    options: SequenceOptions
    photos: tuple[Path, ...]
    look_alike: LookAlike | None = None
    follow: Scene | None = None
    symmetries: tuple[Symmetry, ...] = ()
    conditions: Conditions | None = None

    @property
    def camera(self) -> Camera:
        """The camera of RBOT, of the conditions, or of the followed scene."""
        if self.conditions is not None:
            return self.conditions.pinhole
        return self.follow.camera.without_distortion() if self.follow else CAMERA

    @property
    def photo(self) -> Path:
        """The background: a different one for each variant, and for each shape if there are enough."""
        order = generator(self.options.seed, "photos").permutation(len(self.photos))
        if self.conditions is not None:
            return self.photos[order[self._place_of_conditions() % len(order)]]
        known = SHAPES.index(self.model.name) if self.model.name in SHAPES else len(SHAPES)
        place = len(VARIANTS) * known + VARIANTS.index(self.options.variant)
        if self.look_alike:
            place += int(generator(self.options.seed, self.look_alike.name).integers(len(order)))
        return self.photos[order[place % len(order)]]

    def _place_of_conditions(self) -> int:
        names = (*SHAPES, *BOX_SHAPES, *CURVED_SHAPES, self.model.name)
        assert self.conditions is not None
        known = list(CONDITIONS)
        number = known.index(self.conditions.name) if self.conditions.name in known else len(known)
        return len(names) * number + names.index(self.model.name)

    def printed_photos(self) -> list[Path]:
        """Photos to print on the part: never its background."""
        others = [photo for photo in self.photos if photo != self.photo] or list(self.photos)
        order = generator(self.options.seed, self.name, "printed").permutation(len(others))
        return [others[k] for k in order[:PRINTED_PHOTOS]]

    def poses(self) -> Array:
        """``cam_from_model`` (frames,4,4)."""
        if self.conditions is not None:
            return real_trajectory(self.model, self.conditions, self.options.frames, self.options.seed)
        if self.follow is None:
            return trajectory(self.model, self.options, name=self.look_alike.name if self.look_alike else "")
        center = self.follow.part.model.center_in_model
        return followed_trajectory(self.follow.poses[: self.options.frames], center, self.model.center_in_model)


def shape_job(name: str, options: SequenceOptions, photos: tuple[Path, ...]) -> Job:
    """A sequence of one of the test shapes."""
    return Job(f"{name}_{options.variant}", shape(name), options, photos)


def conditions_job(name: str, conditions: Conditions, frames: int, seed: int, photos: tuple[Path, ...]) -> Job:
    """A sequence of one of the test shapes, plain, box or curved, under real conditions."""
    model = curved_shape(name) if name in CURVED_SHAPES else shape(name)
    options = SequenceOptions(frames=frames, seed=seed)
    symmetries = symmetries_of(name)
    return Job(f"{name}_{conditions.name}", model, options, photos, symmetries=symmetries, conditions=conditions)


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
    drawn = job.look_alike.model if job.look_alike else job.model
    frames = _frames(job, drawn, poses, camera)
    shares = None
    if job.look_alike:
        shares = [different_share(job.model, drawn, camera, pose) for pose in poses]
    turns = tuple(symmetry_group(job.symmetries)[1:])
    report = None if progress is None else (lambda done: progress(done, len(poses)))
    write_dataset(target, job.model, camera, frames, record, turns, shares, report)
    return target


def _frames(job: Job, drawn: Model, poses: Array, camera: Camera) -> Iterator[SequenceFrame]:
    photo = read_photo(job.photo)
    if job.conditions is not None:
        printed = [read_photo(path) for path in job.printed_photos()]
        return render_real(drawn, poses, photo, printed, job.conditions, job.options.seed, job.name)
    blocker = shape(_other_shape(job.model.name))
    return render_sequence(drawn, poses, photo, job.options, camera, blocker, job.name)


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
    record = {
        "made_by": "arview semisynthetic",
        "name": job.name,
        "model": job.model.source_hash,
        "options": asdict(job.options),
        "photo": "/".join(job.photo.parts[-3:]),
        "look_alike": look_alike,
        "trajectory": job.follow.name if job.follow else None,
        "code": _code_hash(),
    }
    if job.conditions is not None:
        record["conditions"] = asdict(job.conditions)
    return record


def _has_record(dataset: Path, record: dict[str, Any]) -> bool:
    return read_record(dataset) == json.loads(json.dumps(record))


@cache
def _code_hash() -> str:
    """Hash of the code that makes sequences, so that sequences made by other code are not reused."""
    files = [*sorted(Path(__file__).parent.glob("*.py")), Path(rasterizer.__file__)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
