"""From photos or a video to poses, millimetres in the approximate CAD frame and a dense cloud, in stages.

| file | stage |
|---|---|
| ``photos.json`` | intake: checks of each photo, and which were rejected and why |
| ``frames/`` | the chosen frames, of a video |
| ``sparse/model/``, ``sparse/database.db`` | COLMAP model in its own unit, features and matches |
| ``silhouettes/`` | masks of the part, where they were made of its CAD |
| ``sparse/points.ply``, ``sparse/covariance.npy`` | its points; covariance of the poses, see `SparseModel` |
| ``scale.json`` | mm per unit and approximate CAD frame, with the evidence |
| ``metric/`` | the COLMAP model in mm in the approximate CAD frame |
| ``dense/stereo/`` | depth and normal maps in COLMAP's format |
| ``cloud.ply`` | the dense cloud |
| ``reconstruction.json`` | summary |
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import numpy as np

from arview.cad import Part
from arview.core.atomic import replacing
from arview.core.checks import PATH, check_type
from arview.core.extras import require
from arview.core.progress import Progress
from arview.core.stage_cache import Stages, content_key, key_of, write_json
from arview.errors import CannotMeasureError, InputError, OutputError
from arview.geometry import Array
from arview.reconstruction.adjustment.covariance import read_model, write_covariances
from arview.reconstruction.colmap import write_model
from arview.reconstruction.coverage import Coverage, coverage
from arview.reconstruction.dense import Cad, DenseOptions, read_ply, reconstruct_dense, write_ply
from arview.reconstruction.given_poses import photos_with_poses, read_poses
from arview.reconstruction.groups import groups_warning
from arview.reconstruction.intake import (
    Intake,
    VideoIntakeOptions,
    intake_frames,
    intake_photos,
    intake_video,
    undistort_photos,
)
from arview.reconstruction.intake.masks import with_masks
from arview.reconstruction.intake.sensor import share_lenses
from arview.reconstruction.memory import SparseMemory
from arview.reconstruction.pairs import KnownPairs
from arview.reconstruction.part_masks import Silhouettes, placed_with_silhouettes, with_masks_of
from arview.reconstruction.quality import Quality, quality_of
from arview.reconstruction.scale import CadOptions, ScaleResult, ScaleSources, find_scale
from arview.reconstruction.sparse import SparseOptions, reconstruct_from_poses, reconstruct_sparse
from arview.reconstruction.types import DenseCloud, Photo, SparseModel
from arview.version import __version__

StageName = Literal["photos", "sparse", "scale", "dense"]
STAGES: tuple[StageName, ...] = ("photos", "sparse", "scale", "dense")
"""Stages in their order."""

_RESULTS: dict[StageName, tuple[str, ...]] = {
    "photos": ("photos.json", "reconstruction.json"),
    "sparse": ("sparse/model/*", "sparse/*.json", "sparse/*.npy", "sparse/points.ply"),
    "scale": ("scale.json", "metric/*"),
    "dense": ("cloud.ply",),
}
"""Files of each stage's results."""
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mts", ".3gp"})
"""Files with these suffixes are videos."""


SCALE = CadOptions()


@dataclass(frozen=True)
class ReconstructOptions:
    """Options of the stages, and the last stage to run."""

    video: VideoIntakeOptions = field(default_factory=VideoIntakeOptions)
    sparse: SparseOptions = field(default_factory=SparseOptions)
    sources: ScaleSources = field(default_factory=ScaleSources)
    dense: DenseOptions = field(default_factory=DenseOptions)
    poses: Path | None = None  # camera poses made elsewhere, see `given_poses`; None: structure from motion
    masks: Path | None = None  # folder with a mask for each photo, black where it is not to be used
    silhouettes: Silhouettes | None = None  # makes masks of the part where there are none, see `part_masks`
    known: KnownPairs = field(
        default_factory=KnownPairs
    )  # pairs of photos to be matched, or rough poses to choose them
    needs_scale: bool = False  # end before the cloud where nothing gives the scale
    last_stage: StageName = "dense"
    starts_over: bool = False  # discard what an earlier run left in the folder


@dataclass(frozen=True)
class Reconstruction:
    """Result of a reconstruction.

    Attributes:
        folder: of its files.
        intake: the photos.
        sparse: poses and points; in mm in the approximate CAD frame if ``scale.similarity`` is known.
        scale: None if the run ended before.
        cloud: in the frame of ``sparse``; None if the run ended before.
        coverage: of the part's components; None without a frame.
        quality: reprojection error, tracks, noise.
        seconds: wall time of each stage; stages finished by an earlier run are missing.
    """

    folder: Path
    intake: Intake
    sparse: SparseModel | None
    scale: ScaleResult | None
    cloud: DenseCloud | None
    coverage: Coverage | None
    quality: Quality | None
    seconds: dict[str, float]

    @property
    def is_metric(self) -> bool:
        """Whether lengths are in mm."""
        return self.scale is not None and self.scale.scale is not None


def reconstruct(
    source: str | Path | Sequence[str | Path],
    folder: str | Path,
    part: Part | None = None,
    camera: str | None = None,
    options: ReconstructOptions | None = None,
    *,
    progress: Progress | None = None,
    memory: SparseMemory | None = None,
) -> Reconstruction:
    """Reconstruct what the photos show.

    Stages that an earlier run finished in ``folder`` with the same photos and options are read, not repeated.

    Args:
        source: folder, glob or list of photos, or a video file.
        folder: where everything is written; made when missing.
        part: gives the scale and the frame, the region of the dense cloud and the coverage.
        camera: camera file or ``fov:DEG``; without it, EXIF data or a guess, refined with the poses.
        options: of the stages.
        progress: called with (what, done, total).
        memory: features and matches that were found before.

    Raises:
        InputError: too few or unusable photos, or photos that do not fit together; the message says what to do.
        MismatchError: the camera does not fit the photos.
        OutputError: the folder cannot be written to.
        MissingDependencyError: pycolmap is not installed.
    """
    check_type(source, (*PATH, list, tuple), "reconstruct: source")
    check_type(folder, PATH, "reconstruct: folder")
    check_type(part, (Part, NoneType), "reconstruct: part")
    require("a reconstruction from photos", "pycolmap")
    run = _ReconstructionRun(
        Path(folder), part, options or ReconstructOptions(), progress or (lambda what, done, total: None), memory
    )
    return run.all(source, camera)


class _ReconstructionRun:
    """One run, with its folder and options and the time of its stages."""

    def __init__(
        self,
        folder: Path,
        part: Part | None,
        options: ReconstructOptions,
        tell: Progress,
        memory: SparseMemory | None = None,
    ) -> None:
        self.folder, self.part, self.options, self.tell, self.memory = folder, part, options, tell, memory
        self.stages = Stages(folder)
        self.seconds: dict[str, float] = {}
        if options.starts_over:
            self.stages.restart("frames")
            self._restart("photos")

    def all(self, source: str | Path | Sequence[str | Path], camera: str | None) -> Reconstruction:
        """Run the stages in their order."""
        intake = self._photos(source, camera)
        sparse, scale, cloud, cover = None, None, None, None
        last = STAGES.index(self.options.last_stage)
        if last >= 1:
            key = key_of([replace(photo, path=Path(), mask=None) for photo in intake.photos], self.options.sparse)
            masks = [photo.mask for photo in intake.photos if photo.mask is not None]
            key = key_of(key, content_key(photo.path for photo in intake.photos), content_key(masks))
            key = key_of(key, self.options.known.key())
            if self.options.poses is not None:
                key = key_of(key, [(one.name, one.cam_from_scan.tolist()) for one in read_poses(self.options.poses)])
            if self.options.silhouettes is not None:
                key = key_of(key, self.options.silhouettes.key())
            sparse = self._sparse(intake.photos, key)
        if last >= 2 and sparse is not None:
            part_key = None if self.part is None else (self.part.model.source_hash, self.part.effective_view_range)
            key = key_of(key, part_key, self.options.sources, SCALE)
            scale = self._scale(intake.photos, sparse, key)
            if self.options.needs_scale and scale.scale is None:
                raise CannotMeasureError(
                    f"the part was not found in the photos: {scale.why_no_frame}. Is it this part? If it is, put a "
                    "board or tag beside it and name it in a scale file, or run `arview reconstruct` and `arview "
                    "measure`, which look for its shape in the cloud"
                )
            sparse, cad = self._metric(sparse, scale)
            cover = self._coverage(sparse, cad)
        if last >= 3 and sparse is not None:
            key = key_of(key, self.options.dense)
            cloud = self._dense(sparse, cad, key)
        quality = None if sparse is None else quality_of(sparse, cloud)
        result = Reconstruction(
            self.folder, intake, sparse, scale=scale, cloud=cloud, coverage=cover, quality=quality, seconds=self.seconds
        )
        write_json(self.folder / "reconstruction.json", summary(result))
        return result

    def _restart(self, stage: StageName) -> None:
        """Remove the results of a stage and of those after it, which this run may not reach.

        Otherwise an old cloud would stand beside a new scale.
        """
        for name in STAGES[STAGES.index(stage) :]:
            self.stages.restart(name)
            for pattern in _RESULTS[name]:
                for old in self.folder.glob(pattern):
                    old.unlink(missing_ok=True)

    def _record_time(self, name: str, began: float) -> None:
        self.seconds[name] = round(time.perf_counter() - began, 2)

    def _photos(self, source: str | Path | Sequence[str | Path], camera: str | None) -> Intake:
        began = time.perf_counter()
        if isinstance(source, str | Path) and Path(source).suffix.lower() in VIDEO_SUFFIXES and Path(source).is_file():
            intake = self._frames(Path(source), camera)
        else:
            intake = intake_photos(source, camera, progress=lambda i, n: self.tell("photos", i, n))
            if self.options.poses is None and self.options.masks is None:  # both are made for upright photos
                intake = share_lenses(intake, self.folder / "turned")
        if self.options.masks is not None:
            intake = with_masks(intake, self.options.masks)
        intake = undistort_photos(intake, self.folder / "undistorted", lambda i, n: self.tell("photos", i, n))
        write_json(self.folder / "photos.json", intake_summary(intake))
        self._record_time("photos", began)
        return intake

    def _frames(self, video: Path, camera: str | None) -> Intake:
        frames = self.folder / "frames"
        key = key_of(content_key([video]), self.options.video)
        if self.stages.is_finished("frames", key) and frames.is_dir():
            return intake_frames(video, frames, self.options.video, camera, lambda i, n: self.tell("photos", i, n))
        self.stages.restart("frames")
        for old in frames.glob("frame_*.png"):
            old.unlink()
        intake = intake_video(video, frames, self.options.video, camera, lambda i, n: self.tell("frames", i, n))
        self.stages.finish("frames", key)
        return intake

    def _sparse(self, photos: tuple[Photo, ...], key: str) -> SparseModel:
        began = time.perf_counter()
        folder = self.folder / "sparse"
        if self.stages.is_finished("sparse", key):
            return _read_sparse(folder, photos)
        self._restart("sparse")
        sparse = self._placed_and_masked(photos, folder)
        write_sparse(folder, sparse)
        self.stages.finish("sparse", key)
        self._record_time("sparse", began)
        return sparse

    def _placed_and_masked(self, photos: tuple[Photo, ...], folder: Path) -> SparseModel:
        """The placed photos, with masks of the part where these are wished for."""
        silhouettes = self.options.silhouettes
        if silhouettes is None:
            return self._placed(photos, folder)
        return placed_with_silhouettes(
            photos,
            folder,
            self.folder / "silhouettes",
            silhouettes,
            self._placed,
            self.tell,
            can_place_again=self.options.poses is None,
        )

    def _placed(self, photos: Sequence[Photo], folder: Path) -> SparseModel:
        """The photos placed by structure from motion, or by the poses that were given."""
        if self.options.poses is None:
            return reconstruct_sparse(photos, folder, self.options.sparse, self.tell, self.options.known, self.memory)
        posed, left_out = photos_with_poses(photos, read_poses(self.options.poses), self.options.poses)
        sparse = reconstruct_from_poses(posed, folder, self.options.sparse, self.tell)
        return replace(sparse, unplaced=(*sparse.unplaced, *left_out))

    def _scale(self, photos: tuple[Photo, ...], sparse: SparseModel, key: str) -> ScaleResult:
        began = time.perf_counter()
        path = self.folder / "scale.json"
        if self.stages.is_finished("scale", key):
            return ScaleResult.from_provenance(json.loads(path.read_text(encoding="utf-8")))
        self._restart("scale")
        scale = find_scale(sparse, self.part, self.options.sources, SCALE, progress=self.tell)
        # The scale's file carries all doubts about the reconstruction to the measurement and its report.
        apart = groups_warning([photo.name for photo in photos], sparse.groups)
        scale = replace(scale, warnings=(*sparse.remarks, *((apart,) if apart else ()), *scale.warnings))
        write_json(path, scale.provenance())
        self.stages.finish("scale", key)
        self._record_time("scale", began)
        return scale

    def _metric(self, sparse: SparseModel, scale: ScaleResult) -> tuple[SparseModel, Cad | None]:
        """The model in mm and, if the CAD was found, in its frame; also written as a COLMAP model."""
        if scale.scale is None:
            return sparse, None
        frame = scale.model_from_scan if scale.model_from_scan is not None else np.eye(4)
        metric = sparse.transformed(scale.scale, frame)
        write_model(self.folder / "sparse" / "model", self.folder / "metric", scale.scale, frame)
        if self.part is None or scale.model_from_scan is None or not scale.consistency.is_consistent:
            return metric, None
        return metric, Cad(self.part.model, np.eye(4))

    def _coverage(self, sparse: SparseModel, cad: Cad | None) -> Coverage | None:
        if cad is None:
            return None
        views = [(photo.camera, photo.cam_from_scan) for photo in sparse.photos]
        return coverage(cad.model, views, names=[photo.name for photo in sparse.photos])

    def _dense(self, sparse: SparseModel, cad: Cad | None, key: str) -> DenseCloud:
        began = time.perf_counter()
        path = self.folder / "cloud.ply"
        if self.stages.is_finished("dense", key):
            return read_ply(path)
        self._restart("dense")
        cloud = reconstruct_dense(sparse, self.options.dense, cad, self.folder / "dense", self.tell)
        write_ply(cloud, path)
        self.stages.finish("dense", key)
        self._record_time("dense", began)
        return cloud


# --- files -----------------------------------------------------------------------------------------------


def write_sparse(folder: Path, sparse: SparseModel) -> None:
    """Write what COLMAP's model, which is already in the folder, does not contain."""
    write_json(folder / "unplaced.json", dict(sparse.unplaced))
    made = folder.parent / "silhouettes"  # masks that were given are found again by intake
    masks = {photo.name: photo.mask for photo in sparse.photos if photo.mask is not None}
    names = {name: path.relative_to(made).as_posix() for name, path in masks.items() if path.is_relative_to(made)}
    write_json(folder / "silhouettes.json", names)
    write_json(
        folder / "groups.json", {"groups": [list(one) for one in sparse.groups], "remarks": list(sparse.remarks)}
    )
    try:
        write_covariances(sparse, folder)
        with replacing(folder / "points.ply") as file:
            file.write(points_ply(sparse))
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written to ({error.strerror or error})") from error


def _read_sparse(folder: Path, photos: tuple[Photo, ...]) -> SparseModel:
    """Read what `reconstruct_sparse` and `write_sparse` wrote. Raises InputError when files are missing."""
    try:
        unplaced = json.loads((folder / "unplaced.json").read_text(encoding="utf-8"))
        groups = json.loads((folder / "groups.json").read_text(encoding="utf-8"))
        sparse = replace(read_model(folder, photos), unplaced=tuple(unplaced.items()))
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{folder}: files are missing or damaged ({error}); run again with --force") from error
    sparse = replace(sparse, groups=tuple(tuple(group) for group in groups["groups"]), remarks=tuple(groups["remarks"]))
    return with_masks_of(sparse, _read_silhouettes(folder))


def _read_silhouettes(folder: Path) -> dict[str, Path]:
    """The masks that an earlier run made, by the names of their photos. Raises InputError when files are missing."""
    path = folder / "silhouettes.json"
    if not path.is_file():  # written by arview before it made masks
        return {}
    try:
        names = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is damaged ({error}); run again with --force") from error
    masks = {photo: folder.parent / "silhouettes" / name for photo, name in names.items()}
    absent = next((mask for mask in masks.values() if not mask.is_file()), None)
    if absent is not None:
        raise InputError(f"{absent}: the mask is missing; run again with --force")
    return masks


def points_ply(sparse: SparseModel) -> bytes:
    """The sparse points as binary PLY."""
    rows = np.zeros(len(sparse.points_in_scan), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = sparse.points_in_scan, sparse.colors
    fields = [*(f"float {name}" for name in "xyz"), *(f"uchar {name}" for name in ("red", "green", "blue"))]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {name}" for name in fields]
    return "\n".join([*lines, "end_header", ""]).encode() + rows.tobytes()


# --- summaries -------------------------------------------------------------------------------------------


def intake_summary(intake: Intake) -> dict[str, Any]:
    """Content of ``photos.json``."""
    return {
        "photos": [
            {
                "name": photo.name,
                "path": str(photo.path.resolve()),
                "lens": photo.lens,
                "width": photo.width,
                "height": photo.height,
            }
            for photo in intake.photos
        ],
        "rejected": dict(intake.rejected),
        "warnings": list(intake.warnings),
        "lenses": [
            {"key": lens.key, "focal_px": lens.camera.fx, "focal_from": lens.focal_from} for lens in intake.lenses
        ],
        "checks": [vars(check) for check in intake.checks],
    }


def summary(result: Reconstruction) -> dict[str, Any]:
    """Content of ``reconstruction.json``; transforms are 4×4, row-major."""
    content: dict[str, Any] = {
        "version": __version__,
        "unit": "mm" if result.is_metric else None,
        "rejected": dict(result.intake.rejected),
        "warnings": list(result.intake.warnings),
        "seconds": result.seconds,
    }
    sparse = result.sparse
    if sparse is not None:
        deviations = pose_deviations(sparse)
        content["unplaced"] = dict(sparse.unplaced)
        content["groups"] = [list(group) for group in sparse.groups]
        content["photos"] = {
            photo.name: {
                "camera": camera_summary(photo.camera),
                "cam_from_scan": photo.cam_from_scan.tolist(),
                **({} if photo.mask is None else {"mask": str(photo.mask)}),
                **({} if deviations is None else {"std_rad": deviations[i, 0], "std_position": deviations[i, 1]}),
            }
            for i, photo in enumerate(sparse.photos)
        }
    if result.scale is not None:
        content["scale"] = result.scale.provenance()
    if result.quality is not None:
        content["quality"] = result.quality.as_dict()
    if result.coverage is not None:
        content["coverage"] = {
            "components": {
                one.name: {"photos": len(one.photos), "directions": one.directions, "spread_deg": one.spread_deg}
                for one in result.coverage.components
            },
            "advice": list(result.coverage.advice),
        }
    return content


def camera_summary(camera: Any) -> dict[str, Any]:
    """A camera for JSON, in arview's own format."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "dist": camera.dist.tolist(),
    }


def pose_deviations(sparse: SparseModel) -> Array | None:
    """(M,2) standard deviations of each photo's rotation (rad) and centre (unit), means over the axes; or None."""
    if sparse.pose_covariance is None:
        return None
    rows = []
    for i in range(len(sparse.photos)):
        block = sparse.pose_covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        # The centre is the origin of the camera frame, so a left twist (w, v) moves it by −v alone.
        rows.append(np.sqrt([np.trace(block[:3, :3]) / 3.0, np.trace(block[3:, 3:]) / 3.0]))
    return np.array(rows)
