"""What is found in photos as soon as they arrive: checks, features, matches of pairs; all of it is taken up later."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread

from arview import reconstruction, workflow
from arview.errors import ArviewError
from arview.geometry import Array
from arview.station.walk.job import JobFolder
from arview.station.walk.records import StoredPhoto


@dataclass
class PhotoPreparation:
    """A thread that works on each photo when it arrives.

    Attributes:
        job: the job.
        prepared: its inputs.
        memory: where features and matches are kept.
        threads: photos or pairs at a time.
        also: what else is done with the usable photos.
        ready: photos of the job that are worked on, in their order.
    """

    job: JobFolder
    prepared: workflow.Prepared
    memory: reconstruction.SparseMemory
    threads: int
    also: Callable[[Sequence[reconstruction.Photo]], None]
    ready: tuple[StoredPhoto, ...] = ()
    _ends: Event = field(default_factory=Event)
    _thread: Thread | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread = Thread(target=self._run, name="preparation", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Let the thread finish the photo it works on, and wait for it."""
        self._ends.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._ends.is_set():
            photos = self.job.photos()
            self.ready = tuple(photo for photo in photos if photo in self.ready)  # others were taken back
            newest = next((photo for photo in photos if photo not in self.ready), None)
            if newest is not None:
                self._work((*self.ready, newest))
                self.ready += (newest,)
            else:
                self._ends.wait(0.1)

    def _work(self, photos: Sequence[StoredPhoto]) -> None:
        """Check the last of the photos, find its features, and match it with those before."""
        paths = [self.job.path / "photos" / photo.name for photo in photos]
        newest = paths[-1]
        options = replace(self.prepared.reconstruct, last_stage="photos")
        try:
            reconstruction.read_and_check(newest, newest.name)
            reconstruction.kept("picture", newest, lambda: reconstruction.read_photo(newest))
            intake = reconstruction.reconstruct(
                paths, self.job.path / "rough" / "photos", None, self.prepared.job.camera, options
            ).intake
            sparse = options.sparse
            features, remarks = reconstruction.moving_features(
                intake.photos, sparse, self.threads, _nothing, self.memory
            )
            min_move_px = reconstruction.MAX_SHIFT_PX if remarks else 0.0
            known = reconstruction.KnownPairs(poses=poses_of(photos))
            reconstruction.match_by_appearance(
                intake.photos,
                features,
                sparse,
                threads=self.threads,
                tell=_nothing,
                min_move_px=min_move_px,
                known=known,
                memory=self.memory,
            )
            self.also(intake.photos)
        except ArviewError:
            return  # photos that cannot be used are told of when all of them are there


def poses_of(photos: Sequence[StoredPhoto]) -> Mapping[str, Array]:
    """Rough ``cam_from_model`` of the photos that have one, by name."""
    return {photo.name: pose for photo in photos if (pose := photo.cam_from_model) is not None}


def photo_files(job: JobFolder, photos: Sequence[StoredPhoto]) -> list[Path]:
    """Paths of the photos' files."""
    return [job.path / "photos" / photo.name for photo in photos]


def _nothing(what: str, done: int, total: int) -> None:
    """Progress that nobody waits for."""
