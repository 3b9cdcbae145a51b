"""Reading and checking of the inputs of a job, and hashes of everything that its results depend on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from arview import measurement, reconstruction
from arview.cad import Part, load_part
from arview.camera import load_camera, split_spec
from arview.core.stage_cache import content_key, key_of
from arview.errors import InputError
from arview.version import __version__
from arview.video import load_camera_of, open_source
from arview.workflow.job import InspectJob
from arview.workflow.silhouettes import CadSilhouettes


@dataclass(frozen=True)
class Prepared:
    """A job with its inputs, which are checked, and the options of its stages."""

    job: InspectJob
    part: Part
    reconstruct: reconstruction.ReconstructOptions
    measure: measurement.MeasureOptions


def prepare(job: InspectJob, folder: Path) -> Prepared:
    """Read the inputs and check everything that can be checked before the work starts.

    Args:
        job: the job.
        folder: folder of the results.

    Raises:
        InputError, MismatchError: an input is missing or unusable, or does not belong to the others.
    """
    if not job.photos and not job.video:
        raise InputError("give photos, a video, or both")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give a folder for the results")
    if job.photos:
        if Path(job.photos).is_dir() and folder.resolve() == Path(job.photos).resolve():
            raise InputError(f"{folder}: is the folder of the photos; give another one for the results")
        reconstruction.photo_paths(job.photos)
    part = load_part(job.part, job.unit)
    if job.serial is not None:
        part = replace(part, serial=job.serial)
    if not part.inspected and not part.characteristics:
        raise InputError(
            f"part {part.name!r}: no component has the role 'inspect', and nothing stands in [[characteristics]]"
        )
    if job.masks and job.masks != reconstruction.AUTO and not Path(job.masks).is_dir():
        raise InputError(f"{job.masks}: no such folder; give the folder of the masks, or auto")
    if job.sparse:
        reconstruction.read_poses(job.sparse)
    _check_cameras(job)
    threads, seed = job.threads, job.seed
    reconstruct = reconstruction.ReconstructOptions(
        video=reconstruction.VideoIntakeOptions(max_frames=job.max_frames),
        sparse=reconstruction.SparseOptions(seed=seed, threads=threads, device=job.device),
        sources=reconstruction.load_scale_file(job.scale_file) if job.scale_file else reconstruction.ScaleSources(),
        dense=reconstruction.DenseOptions(seed=seed, threads=threads, device=job.device),
        poses=Path(job.sparse) if job.sparse else None,
        masks=Path(job.masks) if job.masks and job.masks != reconstruction.AUTO else None,
        silhouettes=CadSilhouettes(part) if job.masks == reconstruction.AUTO else None,
        known=reconstruction.read_pairs(job.pairs) if job.pairs else reconstruction.KnownPairs(),
        needs_scale=True,
        last_stage="dense" if job.makes_cloud else "scale",
    )
    methods = measurement.MeasureOptions().methods
    measure = measurement.MeasureOptions(
        methods=methods if job.makes_cloud else tuple(one for one in methods if one != "cloud"),
        tolerance_mm=job.tolerance_mm,
        maps_folder=folder / "inspection_distances",
        decision=measurement.DecisionOptions(job.guard),
    )
    return Prepared(job, part, reconstruct, measure)


def _check_cameras(job: InspectJob) -> None:
    """Open the video once, and read the cameras as far as that is possible without a photo."""
    if job.video:
        with open_source(job.video) as frames:
            if frames.is_live:
                raise InputError(f"{job.video}: is a live source; record a video first and give its file")
            if job.video_camera is not None:
                load_camera_of(frames, job.video_camera, job.video)
    elif job.video_camera:
        raise InputError("a camera of the video is given without a video")
    if job.camera:
        is_angle = job.camera.startswith("fov:")
        load_camera(job.camera, *((1000, 1000) if is_angle else (None, None)))


def measurement_key(prepared: Prepared) -> str:
    """A hash of everything that the measurement depends on, by content and independent of paths."""
    job, part, options = prepared.job, prepared.part, prepared.measure
    source = Path(job.photo_source)
    photos = [source] if source.is_file() else reconstruction.photo_paths(job.photo_source)[0]
    reconstruct = prepared.reconstruct
    masks = [] if reconstruct.masks is None else sorted(reconstruct.masks.rglob("*.png"))
    made = None if reconstruct.silhouettes is None else reconstruct.silhouettes.key()
    poses = (
        [(one.name, one.cam_from_scan.tolist()) for one in reconstruction.read_poses(job.sparse)] if job.sparse else []
    )
    return key_of(
        content_key(photos),
        content_key(masks),
        made,
        poses,
        job.compares_halves,
        _content(job.camera),
        part.model.source_hash,
        part.name,
        part.settings,
        part.datums,
        part.features,
        part.characteristics,
        part.drawing,
        part.serial,
        part.effective_view_range,
        replace(options, maps_folder=None),
        replace(
            reconstruct,
            masks=None,
            silhouettes=None,
            poses=None,
            sparse=replace(reconstruct.sparse, threads=0),
            dense=replace(reconstruct.dense, threads=0),
        ),
        __version__,
    )


def job_key(prepared: Prepared) -> str:
    """A hash of everything that the results depend on: measurement, film and kinds of files."""
    job = prepared.job
    video = content_key([Path(job.video)]) if job.video else None
    return key_of(measurement_key(prepared), video, _content(job.video_camera), job.makes_pdf)


def _content(spec: str | None) -> str | None:
    """A hash of the content of a file, or the text itself if it is not a file."""
    return content_key([split_spec(spec)[0]]) + split_spec(spec)[1] if spec and split_spec(spec)[0].is_file() else spec
