"""Uploads of photos: pieces, resuming, bounds, damage, a full disk, and a server killed at every single step."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from arview.cad import load_part
from arview.cad.part import Part
from arview.station.live.jobs import uploads as uploads_module
from arview.station.live.jobs.uploads import PhotoSpace, Uploads, folder_bytes
from arview.station.live.security.refusals import Refusal
from arview.station.walk.job import JobFolder
from helpers.live_jobs import about, job_options, photo
from helpers.live_sample import PART


@pytest.fixture(scope="module")
def part() -> Part:
    return load_part(str(PART), None)


def new_job(part: Part, folder: Path, serial: str = "BP-1") -> JobFolder:
    return JobFolder.create(folder / "jobs", part, PART, serial)


def uploads_of(job: JobFolder, folder: Path, **more: Any) -> Uploads:
    options = job_options(folder, **more)
    return Uploads(job, options, PhotoSpace(options))


def sent(uploads: Uploads, content: bytes, size: int = 30_000) -> str:
    """Upload a photo, from where it stands."""
    known = uploads.begin(about(content))
    while not isinstance(known, str):
        known = uploads.add(known.name, known.offset, content[known.offset : known.offset + size])
    return known


def refused(work: Callable[[], object]) -> Refusal:
    with pytest.raises(Refusal) as caught:
        work()
    return caught.value


def test_a_photo_in_pieces_is_stored_with_its_hint(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    uploads = uploads_of(job, tmp_path)
    content = photo(1)
    begun = uploads.begin(about(content))
    assert not isinstance(begun, str) and begun.offset == 0
    for offset in range(0, len(content), 50_000):
        assert job.photos() == ()
        answer = uploads.add(begun.name, offset, content[offset : offset + 50_000])
    assert answer == "0001.jpg"
    (stored,) = job.photos()
    assert (job.path / "photos" / "0001.jpg").read_bytes() == content
    assert stored.sha256 == hashlib.sha256(content).hexdigest() and stored.source == "still"
    assert stored.hint is not None and stored.hint["quality"] == 0.8 and stored.cam_from_model is not None
    assert list((job.path / "uploads").iterdir()) == [] and uploads.listed() == []
    # However often it is asked, the answer is the same photo.
    assert uploads.begin(about(content)) == uploads.state(begun.name) == uploads.add(begun.name, 0, b"") == "0001.jpg"


def test_a_lost_answer_and_a_restart_continue_where_the_upload_stopped(part: Part, tmp_path: Path) -> None:
    job, content = new_job(part, tmp_path), photo(2)
    first = uploads_of(job, tmp_path)
    begun = first.begin(about(content))
    assert not isinstance(begun, str)
    first.add(begun.name, 0, content[:70_000])
    again = uploads_of(JobFolder.open(job.path), tmp_path)  # of another server
    known = again.begin(about(content))
    assert not isinstance(known, str) and (known.name, known.offset) == (begun.name, 70_000)
    wrong = refused(lambda: again.add(known.name, 0, content[:70_000]))
    assert (wrong.status, wrong.code, wrong.details) == (409, "bad_offset", {"offset": 70_000})
    assert refused(lambda: again.add(known.name, 90_000, b"x")).code == "bad_offset"
    assert sent(again, content) == "0001.jpg"
    assert (job.path / "photos" / "0001.jpg").read_bytes() == content


def test_damage_on_the_way_is_found_and_the_photo_can_be_sent_again(part: Part, tmp_path: Path) -> None:
    job, content = new_job(part, tmp_path), photo(3)
    uploads = uploads_of(job, tmp_path)
    begun = uploads.begin(about(content))
    assert not isinstance(begun, str)
    damaged = content[:1000] + b"\0" + content[1001:]
    assert damaged != content
    wrong = refused(lambda: uploads.add(begun.name, 0, damaged))
    assert (wrong.status, wrong.code) == (422, "bad_hash") and job.photos() == ()
    assert refused(lambda: uploads.state(begun.name)).code == "no_such_upload"
    assert sent(uploads, content) == "0001.jpg"
    no_photo = b"\xff\xd8\xff" + b"no picture" * 20
    assert refused(lambda: sent(uploads, no_photo)).code == "bad_photo"
    assert len(job.photos()) == 1 and uploads.listed() == []


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"bytes": 0}, 400), ({"bytes": True}, 400), ({"bytes": 1e5}, 400), ({"bytes": 10**9}, 413),
        ({"sha256": "x"}, 400), ({"sha256": "../../../../etc/passwd"}, 400), ({"sha256": 3}, 400),
        ({"source": "else"}, 400), ({"source": []}, 400), ({"media_type": "text/html"}, 415), ({"taken": "soon"}, 400),
        ({"hint": []}, 400), ({"hint": {"cam_from_model": [1.0] * 16}}, 400), ({"hint": {"quality": 7}}, 400),
        ({"hint": {"cam_from_model": ["x"]}}, 400),
    ],
)  # fmt: skip
def test_wrong_announcements_are_refused(part: Part, tmp_path: Path, changed: dict[str, Any], status: int) -> None:
    uploads = uploads_of(new_job(part, tmp_path), tmp_path)
    assert refused(lambda: uploads.begin(about(photo(1), **changed))).status == status
    assert uploads.listed() == []


def test_bounds_on_photos_and_uploads(part: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = new_job(part, tmp_path)
    for name, value in {"MAX_PHOTOS": 2, "MAX_OPEN_UPLOADS": 2, "PHOTO_BYTES": 300_000}.items():
        monkeypatch.setattr(uploads_module, name, value)
    uploads = uploads_of(job, tmp_path)
    assert [sent(uploads, photo(number)) for number in (1, 2)] == ["0001.jpg", "0002.jpg"]
    assert refused(lambda: uploads.begin(about(photo(3)))).code == "too_many"
    assert uploads.begin(about(photo(1))) == "0001.jpg"  # one that is stored is no further one
    other = uploads_of(new_job(part, tmp_path, "BP-2"), tmp_path)
    begun = [other.begin(about(photo(number))) for number in (1, 2)]
    assert refused(lambda: other.begin(about(photo(3)))).status == 429
    assert not isinstance(begun[0], str)
    name = begun[0].name
    assert refused(lambda: other.add(name, 0, photo(1) + b"x")).code == "too_large"
    for wrong in ("x", "../job", "0" * 32, "", "a" * 500):
        assert refused(lambda wrong=wrong: other.state(wrong)).status == 404  # type: ignore[misc]


def test_a_photo_after_the_end_still_counts_and_the_walk_stays_ended(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    uploads = uploads_of(job, tmp_path)
    sent(uploads, photo(1))
    job.end()
    late = sent(uploads, photo(2))
    assert [one.name for one in job.photos()] == ["0001.jpg", late] and job.is_ended


def test_a_full_disk_keeps_what_was_confirmed_and_nothing_half(
    part: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, content = new_job(part, tmp_path), photo(5)
    uploads = uploads_of(job, tmp_path)
    sent(uploads, photo(4))
    begun = uploads.begin(about(content))
    assert not isinstance(begun, str)
    uploads.add(begun.name, 0, content[:50_000])
    real, left = os.write, [20_000]

    def write(handle: int, data: Any) -> int:
        if left[0] <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = real(handle, data[: left[0]])
        left[0] -= count
        return count

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", write)
        full = refused(lambda: uploads.add(begun.name, 50_000, content[50_000:100_000]))
    assert (full.status, full.code) == (507, "disk_full")
    state = uploads.state(begun.name)
    assert not isinstance(state, str) and state.offset == 50_000  # the part of the piece that fitted is taken back
    assert [one.name for one in job.photos()] == ["0001.jpg"]
    assert sent(uploads, content) == "0002.jpg"  # there is room again


def test_quota_and_reserve_are_kept(part: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = new_job(part, tmp_path)
    full = uploads_of(job, tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(uploads_module, "QUOTA_BYTES", folder_bytes(tmp_path / "jobs") + 300_000)
        sent(full, photo(1))
        assert refused(lambda: sent(full, photo(2))).status == 507
    reserve = uploads_of(job, tmp_path, min_free_bytes=10**18)
    assert refused(lambda: reserve.begin(about(photo(3)))).code == "disk_full"
    assert len(job.photos()) == 1


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MB; skipped where none can be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    if os.system(f"mount -t tmpfs -o size=1m none {place} 2>/dev/null") != 0:
        pytest.skip("no disk can be mounted here")
    yield place
    os.system(f"umount {place}")


def test_a_disk_that_is_really_full(part: Part, small_disk: Path) -> None:
    job = new_job(part, small_disk)
    uploads = uploads_of(job, small_disk)
    names, status = [], 0
    for number in range(20):
        try:
            names.append(sent(uploads, photo(number)))
        except Refusal as refusal:
            status = refusal.status
            break
    assert status == 507 and 1 <= len(names) < 10
    assert [one.name for one in job.photos()] == names and job.faults() == ()
    for number, name in enumerate(names):
        assert (job.path / "photos" / name).read_bytes() == photo(number)


def test_two_phones_at_once_on_two_serials(part: Part, tmp_path: Path) -> None:
    jobs = [new_job(part, tmp_path, f"BP-{number}") for number in range(2)]
    options = job_options(tmp_path)
    space = PhotoSpace(options)
    failures: list[BaseException] = []

    def phone(number: int) -> None:
        try:
            uploads = Uploads(jobs[number], options, space)
            for k in range(6):
                sent(uploads, photo(100 * number + k))
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=phone, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    for number, job in enumerate(jobs):
        stored = {(job.path / "photos" / one.name).read_bytes() for one in job.photos()}
        assert stored == {photo(100 * number + k) for k in range(6)}


CALLS = ("open", "write", "fsync", "replace", "unlink", "truncate", "ftruncate", "rename")


def killed_at(step: int, work: Callable[[Callable[[str], None]], None]) -> tuple[bool, str]:
    """Do work in a process that is killed before its ``step``-th call of the system; returns whether it got through
    all of them, and what it confirmed."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        left = [step]

        def counted(real: Any) -> Any:
            def call(*arguments: Any, **named: Any) -> Any:
                left[0] -= 1
                if left[0] < 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                return real(*arguments, **named)

            return call

        for name in CALLS:
            setattr(os, name, counted(getattr(os, name)))
        Path.replace = counted(Path.replace)  # type: ignore[method-assign]
        Path.unlink = counted(Path.unlink)  # type: ignore[method-assign]
        Path.open = counted(Path.open)  # type: ignore[method-assign]
        code = 1
        try:
            plain = os.fdopen(writing, "w")

            def confirm(text: str) -> None:
                plain.write(text)
                plain.flush()

            work(confirm)
            code = 0
        finally:
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as told:
        confirmed = told.read()
    _, status = os.waitpid(pid, 0)
    is_killed = os.WIFSIGNALED(status)
    assert is_killed or os.waitstatus_to_exitcode(status) == 0
    return not is_killed, confirmed


@pytest.mark.slow
def test_killed_before_every_single_step_of_an_upload(part: Part, tmp_path: Path) -> None:
    content, steps = photo(7, 120), 0
    for step in range(200):
        job = new_job(part, tmp_path, f"BP-{step}")
        before = sent(uploads_of(job, tmp_path), photo(8, 120))

        def work(confirm: Callable[[str], None], job: JobFolder = job) -> None:
            confirm(sent(uploads_of(job, tmp_path), content, 10_000))

        is_through, confirmed = killed_at(step, work)
        after = JobFolder.open(job.path)
        stored = {one.name: (after.path / "photos" / one.name).read_bytes() for one in after.photos()}
        assert stored[before] == photo(8, 120)
        if confirmed:
            assert stored[confirmed] == content
        # The page goes on as after any fault: it asks again, and the photo is there once.
        name = sent(uploads_of(after, tmp_path), content, 10_000)
        stored = {one.name: (after.path / "photos" / one.name).read_bytes() for one in after.photos()}
        assert stored == {before: photo(8, 120), name: content}
        uploads_of(after, tmp_path).drop_old()
        assert list((after.path / "uploads").iterdir()) == []
        steps = step
        if is_through:
            break
    assert 15 <= steps < 199


@pytest.mark.slow
def test_killed_before_every_single_step_of_a_decision(part: Part, tmp_path: Path) -> None:
    from arview.quality.decisions import decide_component, log_of
    from helpers.live_jobs import measured

    steps = 0
    for step in range(100):
        job = new_job(part, tmp_path, f"BP-{step}")
        measured(job)
        decide_component(job.path, "post_1", False, "first", by="Ada")

        def work(confirm: Callable[[str], None], job: JobFolder = job) -> None:
            confirm(str(decide_component(job.path, "post_1", True, "agreed", by="Ada").number))

        is_through, confirmed = killed_at(step, work)
        content = log_of(job.path).content()
        reasons = [one.reason for one in content.entries]
        assert content.faults == () and reasons[0] == "first"
        if confirmed:
            assert reasons == ["first", "agreed"]
        decide_component(job.path, "post_1", True, "again", by="Ada")
        later = [one.reason for one in log_of(job.path).content().entries]
        assert later in (["first", "again"], ["first", "agreed", "again"]) and later[: len(reasons)] == reasons
        steps = step
        if is_through:
            break
    assert 4 <= steps < 99


def test_announcements_that_a_crash_damaged_are_begun_again(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    damages = (b"", b"{", b"[]", json.dumps({"bytes": "x"}).encode())
    for number, damage in enumerate(damages):
        uploads, content = uploads_of(job, tmp_path), photo(number)
        begun = uploads.begin(about(content))
        assert not isinstance(begun, str)
        uploads.add(begun.name, 0, content[:1000])
        (job.path / "uploads" / f"{begun.name}.json").write_bytes(damage)
        assert refused(lambda: uploads.state(begun.name)).status == 404  # noqa: B023 - called at once
        name = sent(uploads_of(job, tmp_path), content)
        assert (job.path / "photos" / name).read_bytes() == content
    assert len(job.photos()) == len(damages)


def test_pictures_that_show_nothing_or_are_cut_off_are_refused(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    uploads = uploads_of(job, tmp_path)
    grey = np.full((600, 800, 3), 90, dtype=np.uint8)
    png = cv2.imencode(".png", cv2.imdecode(np.frombuffer(photo(1), np.uint8), cv2.IMREAD_COLOR))[1].tobytes()
    strip = cv2.imencode(".jpg", np.random.default_rng(1).integers(0, 255, (100, 1200, 3)).astype(np.uint8))[1]
    cases = {
        "cut off": [photo(1)[: len(photo(1)) // 2], png[: len(png) // 2]],
        "one colour": [cv2.imencode(".jpg", grey)[1].tobytes(), cv2.imencode(".png", 0 * grey)[1].tobytes()],
        "strip": [strip.tobytes()],
    }
    for reason, contents in cases.items():
        for content in contents:
            wrong = refused(lambda content=content: sent(uploads, content))  # type: ignore[misc]
            assert wrong.code == "bad_photo" and reason in str(wrong), reason
    assert job.photos() == () and uploads.listed() == []
    assert sent(uploads, png).endswith(".png")
