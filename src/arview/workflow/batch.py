"""Many parts at once with Dask: each job is done by some worker, and its results are in its folder or nowhere.

A job writes its results where they belong and, when they are complete, ``result.json`` with the hash of everything
that they depend on. So a job that is run again (its worker died, the batch was interrupted, the file grew) sees that it
is done; and a worker has nothing in memory that could be lost with it.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arview import __version__
from arview.core.stage_cache import write_json
from arview.errors import ArviewError, CannotMeasureError, InputError, MismatchError, MissingDependencyError
from arview.workflow.jobs_file import PLACES, BatchJob
from arview.workflow.lock import alone
from arview.workflow.storage import fetched, is_url, read, sent

if TYPE_CHECKING:
    from distributed import Client

    from arview.workflow.job import InspectJob

RESULT = "result.json"


@dataclass(frozen=True)
class JobResult:
    """What became of a job.

    Attributes:
        name: of the job.
        verdict: pass, fail, undecided, not_measured; ``error`` where an input is bad or the work broke off.
        text: the counts, or why there is no verdict.
        out: where the results are.
        key: hash of all that the results depend on; empty for errors.
        inspection_sha256: of ``inspection.json``; empty where there is none.
        is_kept: an earlier run had done it.
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

    scheduler: str | None = None  # tcp://host:port of a running one; None starts workers on this machine
    workers: int = 0  # of this machine; 0: as many as cores and memory allow
    memory_limit: str = "4GB"  # per job; a reconstruction of 24 photos of 2 Mpx takes 2.4 GB
    retries: int = 2  # of a job that broke off by something that may pass: storage, memory, a dead worker
    connect_s: float = 15.0  # how long a scheduler may take to answer
    scratch: str | None = None  # folder for what is fetched from URLs; None: the system's for temporary files


@dataclass(frozen=True)
class Work:
    """What a job does, so that it can be another one in tests.

    Attributes:
        key: hash of all that the results depend on.
        inspect: does it into a folder and returns verdict and text; raises ArviewError.
        files: names of the results, of which those that are there are kept.
    """

    key: Callable[[InspectJob, Path], str]
    inspect: Callable[[InspectJob, Path], tuple[str, str]]
    files: tuple[str, ...]


def _inspect_key(job: InspectJob, folder: Path) -> str:
    from arview.workflow.prepare import job_key, prepare

    return job_key(prepare(job, folder))


def _inspect(job: InspectJob, folder: Path) -> tuple[str, str]:
    from arview.workflow.run import inspect_part

    try:
        outcome = inspect_part(job, folder)
    except CannotMeasureError as error:
        return "not_measured", str(error)
    return outcome.verdict.value, outcome.sentence


INSPECTION = Work(
    _inspect_key, _inspect,
    ("inspection.json", "report.html", "report.pdf", "annotated.mp4", "poses.jsonl", "cloud.ply",
     "inspection_distances/distances.ply", "inspection_distances/map.png", "inspection_distances/histogram.png"),
)  # fmt: skip


def carry_out(job: BatchJob, work: Work = INSPECTION, scratch: str | None = None) -> JobResult:
    """Do one job, here, unless it is done: this is what a worker runs.

    With a local folder for the results the stages work in it, and one that was interrupted goes on where it was. With
    a URL the job works in a scratch folder and sends its results when they are complete.

    Raises:
        OutputError, OSError: storage that may be there again later; a bad input is a result, not an exception.
    """
    with tempfile.TemporaryDirectory(prefix="arview-", dir=scratch) as temporary:
        try:
            local = _local(job.job, Path(temporary) / "in")
            if is_url(job.out):
                return _done(job, local, Path(temporary) / "out", work)
            with alone(Path(job.out), ".job.lock", waits=True):
                return _done(job, local, Path(job.out), work)
        except (InputError, MismatchError, MissingDependencyError) as error:
            return JobResult(job.name, "error", str(error), job.out)


def _local(job: InspectJob, folder: Path) -> InspectJob:
    """The job with all that it names by URL fetched."""
    for name in PLACES:
        place = getattr(job, name)
        if place is not None and is_url(place):
            values: dict[str, Any] = {name: str(fetched(place, folder / name))}
            job = replace(job, **values)
    return job


def _done(job: BatchJob, local: InspectJob, folder: Path, work: Work) -> JobResult:
    key = work.key(local, folder)
    known = finished(job, key)
    if known is not None:
        return known
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULT).unlink(missing_ok=True)
    verdict, text = work.inspect(local, folder)
    files = [name for name in work.files if (folder / name).is_file()]
    source = folder / "inspection.json"
    digest = hashlib.sha256(source.read_bytes()).hexdigest() if source.is_file() else ""
    result = JobResult(job.name, verdict, text, job.out, key, digest)
    write_json(folder / RESULT, {**asdict(result), "files": files, "version": __version__})
    if is_url(job.out):
        sent(folder, [*files, RESULT], job.out)
    return result


def finished(job: BatchJob, key: str) -> JobResult | None:
    """The result that is there already, when it was made with this key and its inspection is as it was left."""
    content = read(f"{job.out}/{RESULT}")
    if content is None:
        return None
    try:
        known = json.loads(content)
        result = JobResult(**{**{name: known[name] for name in JobResult.__dataclass_fields__}, "is_kept": True})
    except (ValueError, KeyError, TypeError):
        return None
    inspection = read(f"{job.out}/inspection.json") if result.inspection_sha256 else b""
    is_whole = inspection is not None and (
        not result.inspection_sha256 or hashlib.sha256(inspection).hexdigest() == result.inspection_sha256
    )
    return replace(result, name=job.name, out=job.out) if result.key == key and is_whole else None


def run_batch(
    jobs: Sequence[BatchJob], options: BatchOptions | None = None, work: Work = INSPECTION,
    started: Callable[[str, int], None] | None = None, progress: Callable[[JobResult], None] | None = None,
) -> list[JobResult]:  # fmt: skip
    """Do all jobs and return what became of them, in their order.

    A job whose worker dies is given to another, and one that fails by storage or memory is tried again, as often as the
    options say. Neither stops the others. Ctrl-C keeps what is finished.

    Args:
        jobs: what is to be done.
        options: where.
        work: what a job does.
        started: called with the link of the dashboard and the number of workers.
        progress: called with each result as it comes.

    Raises:
        InputError: the scheduler cannot be reached, or has no workers.
        MissingDependencyError: Dask is not installed.
    """
    options = options or BatchOptions()
    try:
        from distributed import as_completed
    except ImportError as error:
        raise MissingDependencyError("a batch needs Dask: pip install 'arview[batch]'") from error
    results: dict[str, JobResult] = {}
    with _client(options, len(jobs)) as client:
        workers = client.nthreads()
        if started is not None:
            started(client.dashboard_link, len(workers))
        if options.scheduler is None and len(workers) > 1:  # they share the cores; elsewhere each has its own
            threads = max(1, (os.cpu_count() or 1) // len(workers))
            jobs = [one if one.job.threads else replace(one, job=replace(one.job, threads=threads)) for one in jobs]
        futures = {
            client.submit(carry_out, one, work, options.scratch, key=f"arview-{one.name}", pure=False,
                          retries=options.retries): one
            for one in jobs
        }  # fmt: skip
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
    """Of a future that is done, or what broke it off, in one line."""
    from distributed import KilledWorker

    error = future.exception()
    if error is None:
        found: JobResult = future.result()
        return found
    if isinstance(error, KilledWorker):
        workers = f"{retries + 1} workers" if retries else "its worker"
        text = f"{workers} died of it; it needs more memory than a worker has (--memory-limit), or crashes a library"
    elif isinstance(error, ArviewError):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    return JobResult(job.name, "error", " ".join(text.split()), job.out)


@contextmanager
def _client(options: BatchOptions, count: int) -> Iterator[Client]:
    """A client of the scheduler, or of workers of our own on this machine, one job at a time each."""
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": options.retries,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.pause": False,  # a job that waits for memory which only it holds would wait forever
        "distributed.comm.timeouts.connect": f"{options.connect_s} s",
    }
    with dask.config.set(settings):
        if options.scheduler is not None:
            try:
                client = Client(options.scheduler, timeout=f"{options.connect_s} s")
            except (OSError, ValueError, TimeoutError) as error:
                raise InputError(f"{options.scheduler}: no Dask scheduler answers there ({error})") from error
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
                n_workers=min(number, count), threads_per_worker=1, processes=True, host="127.0.0.1",
                memory_limit=options.memory_limit, dashboard_address="127.0.0.1:0", silence_logs=50,
            ) as cluster,
            Client(cluster) as client,
        ):  # fmt: skip
            yield client


def default_workers(memory_limit: str) -> int:
    """As many jobs at once as fit into the memory, with two cores for each: stages use both."""
    from dask.utils import parse_bytes
    from distributed.system import MEMORY_LIMIT

    try:
        limit = parse_bytes(memory_limit)
    except ValueError as error:
        raise InputError(f"memory limit {memory_limit!r}: expected a size like 4GB") from error
    return max(1, min((os.cpu_count() or 1) // 2, int(MEMORY_LIMIT / max(limit, 1))))


def failures(results: Sequence[JobResult]) -> list[JobResult]:
    """Those without a verdict."""
    return [one for one in results if one.verdict in ("error", "not_measured")]
