"""Batches: many inspections at once with Dask.

A job writes its results to their destination and then ``result.json``, which holds a hash of everything that the
results depend on. A job that is run again, because its worker died, the batch was interrupted or the jobs file has
grown, finds this file and is skipped. Workers keep nothing in memory that would be lost with them.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arview import workflow
from arview.core.extras import require
from arview.core.stage_cache import write_json
from arview.errors import ArviewError, CannotMeasureError, InputError, MismatchError, MissingDependencyError
from arview.inspection import content_hash, fingerprint_of_file
from arview.quality.batch.jobs_file import LOCATION_FIELDS, BatchJob
from arview.quality.batch.storage import download, is_url, read, upload
from arview.version import __version__

if TYPE_CHECKING:
    from distributed import Client


RESULT = "result.json"
"""Name of the file that marks the results of a job as complete."""


@dataclass(frozen=True)
class JobResult:
    """The outcome of a job.

    Attributes:
        name: name of the job.
        verdict: pass, fail, undecided, measured or not_measured; ``error`` when an input is invalid or the job failed.
        text: summary of the verdicts, or why there is no verdict.
        out: folder or URL of the results.
        key: hash of everything that the results depend on; empty for errors.
        inspection_sha256: fingerprint of ``inspection.json``; empty when there is none.
        is_kept: whether the result is that of an earlier run.
    """

    name: str
    verdict: str
    text: str
    out: str
    key: str = ""
    inspection_sha256: str = ""
    is_kept: bool = False


@dataclass(frozen=True)
class BatchOptions:
    """How a batch is run."""

    scheduler: str | None = None  # tcp://host:port of a running scheduler; None starts workers on this machine
    workers: int = 0  # number of workers on this machine; 0: as many as cores and memory allow
    memory_limit: str = "4GB"  # memory of a worker; a reconstruction of 24 photos of 2 Mpx needs 2.4 GB
    retries: int = 2  # attempts after failures that may be temporary: storage, memory, a dead worker
    connect_s: float = 15.0  # time in which a scheduler must answer
    scratch: str | None = None  # folder for downloaded files; None: that of the system for temporary files
    resources: Mapping[str, float] = field(
        default_factory=dict
    )  # that workers of a scheduler must have, such as GPU: 1


@dataclass(frozen=True)
class Work:
    """The functions that a job consists of; tests replace them.

    Attributes:
        key: returns a hash of everything that the results depend on.
        inspect: writes the results to a folder and returns verdict and text; raises ArviewError.
        files: names of the possible results.
    """

    key: Callable[[workflow.InspectJob, Path], str]
    inspect: Callable[[workflow.InspectJob, Path], tuple[str, str]]
    files: tuple[str, ...]


def _inspect_key(job: workflow.InspectJob, folder: Path) -> str:
    from arview.workflow.prepare import prepare

    return workflow.job_key(prepare(job, folder))


def _inspect(job: workflow.InspectJob, folder: Path) -> tuple[str, str]:

    try:
        outcome = workflow.inspect_part(job, folder)
    except CannotMeasureError as error:
        return "not_measured", str(error)
    return outcome.verdict.value, outcome.sentence


INSPECTION = Work(
    _inspect_key,
    _inspect,
    (
        "inspection.json",
        "report.html",
        "report.pdf",
        "annotated.mp4",
        "poses.jsonl",
        "cloud.ply",
        "inspection_distances/distances.ply",
        "inspection_distances/map.png",
        "inspection_distances/histogram.png",
    ),
)


def run_job(job: BatchJob, work: Work = INSPECTION, scratch: str | None = None) -> JobResult:
    """Run one job in this process, unless its results exist. This is the function that workers run.

    With a local folder for the results the stages work in it, and an interrupted job resumes. With a URL the job works
    in a scratch folder and uploads its results when they are complete.

    Raises:
        OutputError, OSError: a failure of the storage, which may be temporary. An invalid input is returned as a
            result with the verdict ``error``.
    """
    with tempfile.TemporaryDirectory(prefix="arview-", dir=scratch) as temporary:
        try:
            local = _local(job.job, Path(temporary) / "in")
            if is_url(job.out):
                return _run(job, local, Path(temporary) / "out", work)
            with workflow.exclusive_access(Path(job.out), ".job.lock", waits=True):
                return _run(job, local, Path(job.out), work)
        except (InputError, MismatchError, MissingDependencyError) as error:
            return JobResult(job.name, "error", str(error), job.out)


def _local(job: workflow.InspectJob, folder: Path) -> workflow.InspectJob:
    """The job with all inputs that are URLs downloaded to a folder."""
    for name in LOCATION_FIELDS:
        location = getattr(job, name)
        if location is not None and is_url(location):
            values: dict[str, Any] = {name: str(download(location, folder / name))}
            job = replace(job, **values)
    return job


def _run(job: BatchJob, local: workflow.InspectJob, folder: Path, work: Work) -> JobResult:
    key = work.key(local, folder)
    earlier = finished(job, key)
    if earlier is not None:
        return earlier
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULT).unlink(missing_ok=True)
    verdict, text = work.inspect(local, folder)
    files = [name for name in work.files if (folder / name).is_file()]
    source = folder / "inspection.json"
    digest = fingerprint_of_file(source) if source.is_file() else ""
    result = JobResult(job.name, verdict, text, job.out, key, digest)
    write_json(folder / RESULT, {**asdict(result), "files": files, "version": __version__})
    if is_url(job.out):
        upload(folder, [*files, RESULT], job.out)
    return result


def finished(job: BatchJob, key: str) -> JobResult | None:
    """The result of an earlier run if it has this key and its inspection is unchanged, else None."""
    content = read(f"{job.out}/{RESULT}")
    if content is None:
        return None
    try:
        known = json.loads(content)
        result = JobResult(**{**{name: known[name] for name in JobResult.__dataclass_fields__}, "is_kept": True})
    except (ValueError, KeyError, TypeError):
        return None
    is_whole = not result.inspection_sha256 or _has_fingerprint(
        read(f"{job.out}/inspection.json"), result.inspection_sha256
    )
    return replace(result, name=job.name, out=job.out) if result.key == key and is_whole else None


def _has_fingerprint(content: bytes | None, sha256: str) -> bool:
    """Whether an inspection is there and unchanged; results of arview 0.9 and before hold the hash of its bytes."""
    if content is None:
        return False
    try:
        return sha256 in (content_hash(json.loads(content)), hashlib.sha256(content).hexdigest())
    except ValueError:
        return False


def run_batch(
    jobs: Sequence[BatchJob],
    options: BatchOptions | None = None,
    work: Work = INSPECTION,
    started: Callable[[str, int], None] | None = None,
    progress: Callable[[JobResult], None] | None = None,
) -> list[JobResult]:
    """Run all jobs and return their results in the order of the jobs.

    A job whose worker dies is given to another worker, and a job that fails because of storage or memory is retried,
    as often as the options allow. The other jobs continue. Ctrl-C keeps finished results.

    Args:
        jobs: the jobs.
        options: workers and limits.
        work: what a job consists of.
        started: called with the URL of the dashboard and the number of workers.
        progress: called with each result as it arrives.

    Raises:
        InputError: the scheduler cannot be reached, or has no workers.
        MissingDependencyError: Dask is not installed.
    """
    options = options or BatchOptions()
    require("a batch", "distributed")
    from distributed import as_completed

    results: dict[str, JobResult] = {}
    with _client(options, len(jobs)) as client:
        workers = client.nthreads()
        if started is not None:
            started(client.dashboard_link, len(workers))
        if options.scheduler is None and len(workers) > 1:  # they share the cores of this machine
            threads = max(1, (os.cpu_count() or 1) // len(workers))
            jobs = [one if one.job.threads else replace(one, job=replace(one.job, threads=threads)) for one in jobs]
        futures = {
            client.submit(
                run_job,
                one,
                work,
                options.scratch,
                key=f"arview-{one.name}",
                pure=False,
                retries=options.retries,
                resources=dict(options.resources) or None,
            ): one
            for one in jobs
        }
        try:
            for future in as_completed(futures):
                job = futures[future]
                result = _result(job, future, options.retries)
                results[job.name] = result
                if progress is not None:
                    progress(result)
        except KeyboardInterrupt:
            client.cancel(list(futures), force=True)
            raise
    return [results[one.name] for one in jobs]


def _result(job: BatchJob, future: Any, retries: int) -> JobResult:
    """The result of a finished future; an exception becomes a result with a message of one line."""
    from distributed import KilledWorker

    error = future.exception()
    if error is None:
        found: JobResult = future.result()
        return found
    if isinstance(error, KilledWorker):
        workers = f"{retries + 1} workers" if retries else "its worker"
        text = f"{workers} died; the job needs more memory than a worker has (--memory-limit), or a library crashes"
    elif isinstance(error, ArviewError):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return JobResult(job.name, "error", " ".join(text.split()), job.out)


@contextmanager
def _client(options: BatchOptions, count: int) -> Iterator[Client]:
    """A client of the scheduler, or of a local cluster whose workers run one job at a time."""
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": options.retries,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.pause": False,  # a paused job would wait forever for memory that it holds itself
        "distributed.comm.timeouts.connect": f"{options.connect_s} s",
    }
    with dask.config.set(settings):
        if options.scheduler is not None:
            try:
                client = Client(options.scheduler, timeout=f"{options.connect_s} s")
            except (OSError, ValueError, TimeoutError) as error:
                raise InputError(f"{options.scheduler}: no Dask scheduler answers ({error})") from error
            with client:
                if not client.nthreads():
                    raise InputError(
                        f"{options.scheduler}: the scheduler has no workers; start some: dask worker"
                        f" {options.scheduler} --nthreads 1 --memory-limit {options.memory_limit}"
                    )
                yield client
            return
        number = options.workers or default_workers(options.memory_limit)
        with (
            LocalCluster(
                n_workers=min(number, count),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                memory_limit=options.memory_limit,
                dashboard_address="127.0.0.1:0",
                silence_logs=50,
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client


def default_workers(memory_limit: str) -> int:
    """Number of jobs that fit into the memory, with two cores for each because the stages use both.

    Raises:
        InputError: the memory limit is no size.
    """
    from dask.utils import parse_bytes
    from distributed.system import MEMORY_LIMIT

    try:
        limit = parse_bytes(memory_limit)
    except ValueError as error:
        raise InputError(f"memory limit {memory_limit!r}: expected a size like 4GB") from error
    return max(1, min((os.cpu_count() or 1) // 2, int(MEMORY_LIMIT / max(limit, 1))))


def failures(results: Sequence[JobResult]) -> list[JobResult]:
    """The results without a verdict."""
    return [one for one in results if one.verdict in ("error", "not_measured")]
