"""The workflow from photos and a video to the verdict: reconstruct → measure → report → film, each done once.

| file | content |
|---|---|
| those of ``arview.reconstruction.run`` | camera poses, scale and cloud |
| ``inspection.json``, ``inspection_distances/`` | the measurement; the cloud coloured by its distance to the CAD |
| ``report.html``, ``report.pdf`` | the report |
| ``annotated.mp4``, ``poses.jsonl`` | the video with the measured deviations, and its poses |
| ``earlier/NN/`` | results that were made from other inputs |
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from arview import measurement, reconstruction
from arview.core.checks import PATH, check_type
from arview.core.extras import require
from arview.core.progress import Progress
from arview.core.stage_cache import Stages, content_key, key_of
from arview.errors import CannotMeasureError, InputError, MismatchError, MissingDependencyError, OutputError
from arview.inspection import Inspection, Verdict, load_inspection, overall_verdict, save_inspection, verdict_sentence
from arview.version import __version__
from arview.workflow.film import camera_of_video, make_film
from arview.workflow.halves import with_halves
from arview.workflow.job import InspectJob
from arview.workflow.lock import exclusive_access
from arview.workflow.prepare import Prepared, measurement_key, prepare

RESULTS = (
    "report.html",
    "report.pdf",
    "annotated.mp4",
    "poses.jsonl",
    "inspection.json",
    "inspection_distances/distances.ply",
)
_RECONSTRUCTION = {"photos": "photos", "sparse": "camera poses", "scale": "scale and CAD frame", "dense": "dense cloud"}


@dataclass(frozen=True)
class StageRecord:
    """A stage of a run.

    Attributes:
        name: name of the stage.
        state: ``done``, ``kept`` (the result of an earlier run is used) or ``left out``.
        seconds: duration.
        note: details.
    """

    name: str
    state: str
    seconds: float = 0.0
    note: str = ""


@dataclass(frozen=True)
class Outcome:
    """The result of an inspection.

    Attributes:
        folder: folder of its files.
        inspection: measured deviations and verdicts.
        stages: the stages in their order.
        files: the result files, those for people first.
        warnings: doubts about the result, and what is missing from it.
        peak_memory_mb: peak memory of this process.
    """

    folder: Path
    inspection: Inspection
    stages: tuple[StageRecord, ...]
    files: tuple[Path, ...]
    warnings: tuple[str, ...]
    peak_memory_mb: float

    @property
    def verdict(self) -> Verdict:
        """Verdict of the whole part."""
        return overall_verdict(self.inspection)

    @property
    def sentence(self) -> str:
        """Summary of the verdicts of the components."""
        return verdict_sentence(self.inspection)


def inspect_part(
    job: InspectJob,
    folder: str | Path,
    *,
    progress: Progress | None = None,
    starts_over: bool = False,
    on_verdict: Callable[[Inspection], None] | None = None,
) -> Outcome:
    """Inspect one part; stages that an earlier run finished in ``folder`` with the same inputs are skipped.

    Args:
        job: the inputs.
        folder: folder of all results; created if needed.
        progress: called with (step, done, total), see `arview.workflow.progress`.
        starts_over: ignore the results of earlier runs.
        on_verdict: called with the measurement in the photos, before the dense cloud and the comparison of halves,
            which may still add to it; not where the part is found in the cloud only.

    Raises:
        CannotMeasureError: the photos do not fit together, do not show the part, or contradict its CAD.
        InputError, MismatchError: an input is missing, unusable, or does not belong to the others; or another process
            uses the folder.
        OutputError: the folder cannot be written to.
        MissingDependencyError: a library is missing. If only the PDF needs it, there is a warning instead.
    """
    check_type(job, InspectJob, "inspect_part: job")
    check_type(folder, PATH, "inspect_part: folder")
    prepared, where = prepare(job, Path(folder)), Path(folder)
    return inspect_prepared(prepared, where, progress=progress, starts_over=starts_over, on_verdict=on_verdict)


def inspect_prepared(
    prepared: Prepared,
    folder: Path,
    *,
    progress: Progress | None = None,
    starts_over: bool = False,
    memory: reconstruction.SparseMemory | None = None,
    on_verdict: Callable[[Inspection], None] | None = None,
    is_settled: bool = False,
) -> Outcome:
    """Inspect one part as `inspect_part` does, from inputs that are read and checked.

    Args:
        prepared: the inputs.
        folder: folder of all results.
        progress: see `inspect_part`.
        starts_over: see `inspect_part`.
        memory: features and matches that were found while the photos came.
        on_verdict: see `inspect_part`; the measurement in the photos is written before.
        is_settled: the folder's verdict stands: nothing is measured anew by other inputs than it was made from.

    Raises:
        the same as `inspect_part`; MismatchError also where the verdict stands and the inputs have changed.
    """
    require("an inspection", "pycolmap", "jinja2", "markupsafe", "matplotlib")
    with exclusive_access(folder, ".lock", waits=False):
        run = _InspectionRun(prepared, folder, progress or (lambda what, done, total: None), memory)
        return run.execute(starts_over, on_verdict, is_settled)


class _InspectionRun:
    """One run: its inputs, and the stages and warnings so far."""

    def __init__(
        self, prepared: Prepared, folder: Path, progress: Progress, memory: reconstruction.SparseMemory | None = None
    ) -> None:
        self.prepared, self.folder, self.progress, self.memory = prepared, folder, progress, memory
        self.stages = Stages(folder)
        self.records: list[StageRecord] = []
        self.warnings: list[str] = []
        self.seconds: dict[str, float] = {}
        self.verdict: list[StageRecord] = []
        self.in_photos: dict[str, Any] = {}

    def execute(
        self, starts_over: bool, on_verdict: Callable[[Inspection], None] | None = None, is_settled: bool = False
    ) -> Outcome:
        """Run the stages in their order."""
        key = measurement_key(self.prepared)
        if starts_over or not self.stages.is_finished("inputs", key):
            if is_settled and (self.folder / "inspection.json").is_file():
                raise MismatchError(
                    "the part file, its CAD, the photos or arview itself have changed since the verdict, which is "
                    "left as it is; measure the part again for a new one"
                )
            self._set_aside()
            for stage in ("inputs", "measure"):
                self.stages.restart(stage)
        self.stages.finish("inputs", key)
        first = self._measure_in_photos(key, starts_over)
        if first is not None and on_verdict is not None:
            on_verdict(first)
        found = self._reconstruct()
        self.stages = Stages(self.folder)  # the reconstruction has changed its file
        inspection = self._measure(key)
        self._report()
        self._film(found, inspection)
        return Outcome(
            self.folder,
            inspection,
            tuple(self.records),
            tuple(path for path in (self.folder / name for name in self._files()) if path.is_file()),
            tuple(dict.fromkeys([*self.warnings, *inspection.warnings])),
            _peak_memory_mb(),
        )

    def _files(self) -> tuple[str, ...]:
        return (*RESULTS, "cloud.ply") if self.prepared.job.makes_cloud else RESULTS[:-1]

    def _set_aside(self) -> None:
        """Move results of other inputs to ``earlier/NN``, so that the folder never mixes results and loses none."""
        old = [name for name in RESULTS if (self.folder / name).is_file()]
        if not old:
            return
        aside = self.folder / "earlier"
        try:
            number = 1 + max((int(one.name) for one in aside.glob("[0-9]*") if one.name.isdigit()), default=0)
            for name in old:
                target = aside / f"{number:02d}" / name
                target.parent.mkdir(parents=True, exist_ok=True)
                (self.folder / name).replace(target)
        except OSError as error:
            raise OutputError(f"{aside}: cannot be written to ({error.strerror or error})") from error

    def _reconstruct(self) -> reconstruction.Reconstruction:
        """All stages of the reconstruction; those before the cloud were done before, unless the measurement is kept."""
        found = self._reconstructed(self.prepared.reconstruct)
        for name, title in _RECONSTRUCTION.items():
            self.records += self.verdict if name == "dense" else []
            if name == "dense" and not self.prepared.job.makes_cloud:
                continue
            seconds = max(self.seconds.get(name, 0.0), found.seconds.get(name, 0.0))
            state = "done" if name in self.seconds or name in found.seconds else "kept"
            self.records.append(StageRecord(title, state, seconds, _about(found, name)))
        self.warnings += found.intake.warnings
        self.warnings += found.coverage.advice if found.coverage is not None else ()
        return found

    def _reconstructed(self, options: reconstruction.ReconstructOptions) -> reconstruction.Reconstruction:
        job = self.prepared.job
        with _measuring():
            return reconstruction.reconstruct(
                job.photo_source,
                self.folder,
                self.prepared.part,
                job.camera,
                options,
                progress=self.progress,
                memory=self.memory,
            )

    def _measure_in_photos(self, inputs: str, starts_over: bool) -> Inspection | None:
        """The measurement without what follows from the dense cloud and from halves of the photos.

        None where the photos alone do not give it, but the cloud may.
        """
        prepared, path = self.prepared, self.folder / "inspection.json"
        if self.stages.key("measure") is None or starts_over:
            found = self._reconstructed(replace(prepared.reconstruct, starts_over=starts_over, last_stage="scale"))
            self.seconds = found.seconds
            self.stages = Stages(self.folder)
            key = key_of(inputs, self.stages.key("scale"))
            if not self.stages.is_finished("verdict", key) or not path.is_file():
                began = time.perf_counter()
                try:
                    inspection = measured_in_photos(found, prepared, self.progress, self.in_photos)
                except CannotMeasureError:
                    if not prepared.job.makes_cloud:
                        raise
                    return None
                save_inspection(inspection, path)
                self.stages.finish("verdict", key)
                said = verdict_sentence(inspection)
                self.verdict = [StageRecord("verdict by photos", "done", time.perf_counter() - began, said)]
        try:
            return load_inspection(path, prepared.part.model)
        except InputError:  # the file was removed or changed: it is made anew
            return None

    def _measure(self, inputs: str) -> Inspection:
        part, path = self.prepared.part, self.folder / "inspection.json"

        def work() -> str:

            with _measuring():
                found = measurement.read_folder(self.folder, with_cloud=self.prepared.job.makes_cloud)
                inspection = measurement.measure(
                    found, part, self.prepared.measure, progress=self.progress, known=self.in_photos
                )
            if self.prepared.job.compares_halves:
                inspection = with_halves(inspection, found, self.folder, self.prepared, self.progress)
            save_inspection(inspection, path)
            return ""

        self._once(
            "measure",
            "measurement",
            key_of(inputs, self.stages.key(self.prepared.reconstruct.last_stage)),
            [path],
            work,
        )
        inspection = load_inspection(path, part.model)
        self.records[-1] = replace(self.records[-1], note=verdict_sentence(inspection))
        return inspection

    def _report(self) -> None:
        part, wants_pdf = self.prepared.part, self.prepared.job.makes_pdf
        source, html, pdf = (self.folder / name for name in ("inspection.json", "report.html", "report.pdf"))

        def work() -> str:
            from arview.report import make_report

            try:
                evidence = make_report(source, html, pdf if wants_pdf else None, part, progress=self.progress)
            except MissingDependencyError as error:
                self.warnings.append(f"no PDF: {error}")
                evidence = make_report(source, html, None, part, progress=self.progress)
            self.warnings += evidence.absent.values()
            return "HTML and PDF" if pdf.is_file() else "HTML"

        key = key_of(
            content_key([source]),
            self.stages.key(self.prepared.reconstruct.last_stage),
            part.model.source_hash,
            __version__,
        )
        if not wants_pdf:
            pdf.unlink(missing_ok=True)
        self._once("report", "report", key, [html, pdf] if wants_pdf else [html], work)

    def _film(self, found: reconstruction.Reconstruction, inspection: Inspection) -> None:
        part, job = self.prepared.part, self.prepared.job
        film, poses = self.folder / "annotated.mp4", self.folder / "poses.jsonl"
        video = job.video
        try:
            if video is None:
                raise InputError("no --video")
            of_photos = None if found.sparse is None else found.sparse.photos[0].camera
            spec = job.video_camera
            if any(lens.camera.lens is not None for lens in found.intake.lenses):
                # The photos were undistorted, the video is not.
                of_photos, spec = None, spec or (job.camera if job.is_from_video else None)
            camera, warning = camera_of_video(video, spec, of_photos, job.is_from_video)
            self.warnings += [warning] if warning else []
            key = key_of(
                content_key([Path(video), self.folder / "inspection.json"]),
                camera.width,
                camera.height,
                camera.matrix.tolist(),
                camera.dist.tolist(),
                str(camera.lens),
                part.effective_view_range,
                __version__,
            )
            self._once(
                "film",
                "film",
                key,
                [film, poses],
                lambda: make_film(
                    video, part, camera, inspection, film, poses, lambda done, total: self.progress("film", done, total)
                ),
            )
        except (InputError, MismatchError) as error:  # the measurement is valid without the film
            for old in (film, poses):
                old.unlink(missing_ok=True)
            self.records.append(StageRecord("film", "left out", note=str(error)))
            if video is not None:
                self.warnings.append(f"no film: {error}")

    def _once(self, name: str, title: str, key: str, files: Sequence[Path], work: Callable[[], str]) -> None:
        """Do the work unless it was done with this key and its files are unchanged."""
        if self.stages.is_finished(name, f"{key} {content_key(files)}") and all(path.is_file() for path in files):
            self.records.append(StageRecord(title, "kept"))
            return
        self.stages.restart(name)
        began = time.perf_counter()
        note = work()
        if all(path.is_file() for path in files):
            self.stages.finish(name, f"{key} {content_key(files)}")
        self.records.append(StageRecord(title, "done", time.perf_counter() - began, note))


def measured_in_photos(
    found: reconstruction.Reconstruction,
    prepared: Prepared,
    progress: Progress,
    known: dict[str, Any] | None = None,
) -> Inspection:
    """The measurement of a reconstruction by sweep and edges, without a cloud; for ``known`` see `measurement.measure`.

    Raises:
        CannotMeasureError: the reconstruction has no frame, contradicts the CAD, or does not show the datums.
    """
    methods = tuple(one for one in prepared.measure.methods if one != "cloud")
    options = replace(prepared.measure, methods=methods, maps_folder=None)
    with _measuring():
        if found.sparse is None or found.scale is None or found.scale.model_from_scan is None:
            metric = measurement.read_folder(found.folder, with_cloud=False)  # which says what is missing
        else:
            metric = measurement.MetricReconstruction(found.sparse, found.scale, None)
        return measurement.measure(metric, prepared.part, options, progress=progress, known=known)


@contextmanager
def _measuring() -> Iterator[None]:
    """Turn input errors into CannotMeasureError: the inputs are valid, so that they cannot be measured."""
    try:
        yield
    except (InputError, MismatchError) as error:
        raise CannotMeasureError(str(error)) from error


def _about(found: reconstruction.Reconstruction, stage: str) -> str:
    """Summary of a stage of the reconstruction."""
    sparse, scale, quality = found.sparse, found.scale, found.quality
    if stage == "photos":
        left_out = f", {len(found.intake.rejected)} left out" if found.intake.rejected else ""
        return f"{len(found.intake.photos)} usable{left_out}"
    if stage == "sparse" and sparse is not None and quality is not None:
        total = len(sparse.photos) + len(sparse.unplaced)
        return f"{len(sparse.photos)} of {total} photos placed, {quality.reprojection_rms_px:.2f} px rms"
    if stage == "scale" and scale is not None and scale.scale_std is not None:
        kinds = ", ".join(dict.fromkeys(one.kind for one in scale.evidence if one.is_used))
        return f"scale from {kinds}, ± {200 * scale.scale_std:.3f} % (k = 2)"
    if stage == "dense" and found.cloud is not None:
        return f"{len(found.cloud.points)} points"
    return ""


def _peak_memory_mb() -> float:
    """Peak resident memory of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)
