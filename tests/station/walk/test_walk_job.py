"""The folder of a job: what was confirmed is there afterwards, whatever happened in between."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.cad import Part, load_part
from arview.errors import InputError, OutputError
from arview.inspection import save_inspection
from arview.quality import decisions
from arview.station.walk.frozen_part import freeze_part
from arview.station.walk.job import JobFolder, jobs_in
from arview.station.walk.records import WalkState
from helpers.cad_files import write_bench
from helpers.inspections import deviation, inspection
from helpers.paths import ROOT

PART = '[part]\nname = "bench 4/2"\ncad = "bench.obj"\nunit = "mm"\n[components.plate]\nrole = "base"\n'
POSE = np.eye(4).ravel().tolist()


@pytest.fixture
def part(tmp_path: Path) -> Part:
    write_bench(tmp_path)
    (tmp_path / "part.toml").write_text(PART)
    return load_part(tmp_path / "part.toml")


def new_job(part: Part, folder: Path, serial: str = "SN 1") -> JobFolder:
    return JobFolder.create(folder / "jobs", part, folder / "part.toml", serial)


def picture(number: int) -> bytes:
    return b"\xff\xd8\xff" + bytes([number]) * 50


def add(job: JobFolder, number: int, **more: Any) -> str:
    return job.add_photo(picture(number), hashlib.sha256(picture(number)).hexdigest(), "still", **more)


def test_a_job_is_found_again_with_its_photos(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    hint = {"cam_from_model": POSE, "camera": {"fx": 1}, "quality": 0.5}
    assert add(job, 1, hint=hint, taken="2026-01-02T03:04:05+02:00") == "0001.jpg"
    assert add(job, 2) == "0002.jpg"
    assert add(job, 1) == "0001.jpg"
    again = JobFolder.open(job.path)
    assert (again.id, again.serial, again.components, again.parent) == (job.id, "SN 1", None, None)
    assert job.id.startswith("bench-4-2_SN-1_20")
    first, second = again.photos()
    assert (first.bytes, first.taken, first.hint) == (53, "2026-01-02T01:04:05+00:00", hint)
    assert first.cam_from_model is not None and np.array_equal(first.cam_from_model, np.eye(4))
    assert second.cam_from_model is None
    assert (job.path / "photos" / second.name).read_bytes() == picture(2)
    assert again.state() == WalkState(photos=2) and again.inspection() is None and not again.is_ended
    assert [one.id for one in jobs_in(tmp_path / "jobs")] == [job.id]


def test_jobs_of_the_same_second_are_apart(part: Part, tmp_path: Path) -> None:
    jobs = [new_job(part, tmp_path, serial) for serial in ("A", "A", "A/1", "A.1", "../../A")]
    assert len({job.id for job in jobs}) == len({job.path for job in jobs}) == 5
    assert {job.path.parent for job in jobs} == {tmp_path / "jobs"}
    for number, job in enumerate(jobs):
        add(job, number)
    assert all((job.path / "photos" / "0001.jpg").read_bytes() == picture(i) for i, job in enumerate(jobs))


@pytest.mark.parametrize(
    ("content", "sha256", "more", "message"),
    [
        (picture(1), "0" * 64, {}, "does not have the hash"),
        (b"text", None, {}, "is no photo"),
        (picture(1), None, {"hint": {"cam_from_model": [1.0] * 16}}, "is not a pose"),
        (picture(1), None, {"hint": {"cam_from_model": [1.0] * 9}}, "expected 16 numbers"),
        (picture(1), None, {"hint": {"quality": float("nan")}}, "quality"),
        (picture(1), None, {"taken": "yesterday"}, "no ISO 8601 time"),
        (picture(1), None, {"source": "radio"}, "is no photo of a job"),
    ],
)
def test_what_is_no_photo_is_refused(
    part: Part, tmp_path: Path, content: bytes, sha256: str | None, more: dict[str, Any], message: str
) -> None:
    job = new_job(part, tmp_path)
    with pytest.raises(InputError, match=message):
        job.add_photo(content, sha256 or hashlib.sha256(content).hexdigest(), **more)
    assert job.photos() == () and list((job.path / "photos").iterdir()) == []


def test_a_walk_ends_and_is_reopened(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    add(job, 1)
    job.end()
    job.end()
    assert job.is_ended and job.ended is not None
    with pytest.raises(InputError, match="reopen"):
        add(job, 2)
    assert add(job, 1) == "0001.jpg"  # it is there already
    job.reopen()
    assert not job.is_ended
    assert len({add(job, 2), "0001.jpg"}) == 2
    assert len((job.path / "photos.jsonl").read_text().splitlines()) == 4


def test_a_photo_is_taken_back_until_the_walk_ends(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    for number in (1, 2, 3):
        add(job, number)
    job.take_back("0002.jpg", "blurred")
    again = JobFolder.open(job.path)
    assert [photo.name for photo in again.photos()] == ["0001.jpg", "0003.jpg"] and again.faults() == ()
    assert not (job.path / "photos" / "0002.jpg").exists()
    assert (job.path / "taken_back" / "0002.jpg").read_bytes() == picture(2)
    with pytest.raises(InputError, match="no photo that can be taken back"):
        job.take_back("0002.jpg")
    assert add(job, 2) == "0005.jpg"  # the same content once more is a photo of its own
    job.remove_unconfirmed()
    assert len(list((job.path / "photos").iterdir())) == len(job.photos()) == 3
    job.end()
    with pytest.raises(InputError, match="reopen"):
        job.take_back("0001.jpg")
    job.reopen()
    job.take_back("0001.jpg")
    assert [photo.name for photo in job.photos()] == ["0003.jpg", "0005.jpg"]


def test_a_torn_line_is_set_aside_and_told(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    add(job, 1)
    path = job.path / "photos.jsonl"
    whole = path.read_bytes()
    add(job, 2)
    path.write_bytes(path.read_bytes()[:-9])
    assert [photo.name for photo in job.photos()] == ["0001.jpg"]
    assert "cut off" in job.faults()[0]
    job.remove_unconfirmed()
    assert [one.name for one in (job.path / "photos").iterdir()] == ["0001.jpg"]
    assert add(job, 3) == "0002.jpg"
    assert path.read_bytes().startswith(whole) and len(job.photos()) == 2 and job.faults() == ()
    assert b'"name": "0002.jpg"' in (job.path / "photos.torn").read_bytes()


def test_a_damaged_line_loses_only_its_photo(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    for number in (1, 2, 3):
        add(job, number)
    path = job.path / "photos.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + b"\x00\xff{\n" + lines[2])
    assert [photo.name for photo in job.photos()] == ["0001.jpg", "0003.jpg"]
    assert job.faults() == ("photos.jsonl: line 2 is damaged; its photo is not used",)
    assert add(job, 4) == "0004.jpg"


def test_two_phones_at_once(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    numbers = range(1, 25)
    threads = [
        threading.Thread(target=lambda first=first: [add(job, n) for n in numbers[first::3] or ()])
        for first in (0, 1, 2, 0)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    photos = job.photos()
    assert len({photo.name for photo in photos}) == len(photos) == 24
    for photo in photos:
        content = (job.path / "photos" / photo.name).read_bytes()
        assert hashlib.sha256(content).hexdigest() == photo.sha256


KILLED = """
import hashlib, sys
from arview.station.walk.job import JobFolder
job = JobFolder.open(sys.argv[1])
for number in range(200):
    content = b"\\xff\\xd8\\xff" + bytes([number]) * 50000
    print(job.add_photo(content, hashlib.sha256(content).hexdigest(), "still"), flush=True)
"""


@pytest.mark.slow
def test_what_was_confirmed_survives_kill(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    with subprocess.Popen([sys.executable, "-c", KILLED, str(job.path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        confirmed = [process.stdout.readline().strip() for _ in range(7)]
        process.kill()
        confirmed += process.stdout.read().split()
    photos = {photo.name: photo for photo in job.photos()}
    assert len(confirmed) >= 7 and set(confirmed) <= set(photos)
    for name, photo in photos.items():
        assert hashlib.sha256((job.path / "photos" / name).read_bytes()).hexdigest() == photo.sha256
    assert add(job, 1) not in confirmed


def test_a_full_disk_confirms_nothing(part: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = new_job(part, tmp_path)
    add(job, 1)
    before = (job.path / "photos.jsonl").read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="No space left"):
            add(job, 2)
    assert (job.path / "photos.jsonl").read_bytes() == before and len(job.photos()) == 1
    assert add(job, 2) == "0002.jpg"


def test_the_state_is_read_back(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    job.write_state(WalkState("measuring", "placing photos", 9, 8, "placing", 3, 9, is_rough=True, cloud="running"))
    state = job.state()
    assert (state.stage, state.placed, state.is_rough, state.cloud) == ("measuring", 8, True, "running")
    assert state.updated
    (job.path / "state.json").write_text('{"stage": "melting"}')
    assert job.state().stage == "collecting" and "damaged" in job.state().text


def test_a_recheck_belongs_to_its_first_measurement(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    with pytest.raises(InputError, match="not measured yet"):
        job.recheck(["block"])
    measured = inspection(
        part.model, (deviation("block", (2.0, 0.0, 0.0), np.array([30.0, 27.5, 12.5])),), serial="SN 1"
    )
    save_inspection(measured, job.path / "inspection.json")
    job.write_state(WalkState("done"))
    with pytest.raises(InputError, match="bolt"):
        job.recheck(["bolt"])
    with pytest.raises(InputError, match="no component"):
        job.recheck([])
    first = job.recheck(["block"])
    second = first.recheck(["block"])
    assert (first.components, first.document["parent"], first.serial) == (("block",), job.id, "SN 1")
    assert first.parent == job and second.parent == job
    assert [one.id for one in jobs_in(tmp_path / "jobs")] == [job.id, f"{job.id}_r01", f"{job.id}_r02"]
    assert first.photos() == () and first.inspection() is None
    assert job.inspection(part.model) is not None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no job folder"),
        ("{", "damaged"),
        ("[]", "no job folder"),
        ("version", "version 9"),
        ("id", "expected a text"),
    ],
)
def test_what_is_no_job_is_said(part: Part, tmp_path: Path, content: str | None, message: str) -> None:
    job = new_job(part, tmp_path)
    path = job.path / "job.json"
    document = json.loads(path.read_text())
    if content is None:
        path.unlink()
    elif content in document:
        path.write_text(json.dumps(document | {content: 9}))
    else:
        path.write_text(content)
    with pytest.raises(InputError, match=message):
        JobFolder.open(job.path)
    assert jobs_in(tmp_path / "jobs") == []


def test_a_serial_number_is_needed(part: Part, tmp_path: Path) -> None:
    for serial in ("", "  ", "a" * 101, "a\nb"):
        with pytest.raises(InputError, match="serial number"):
            new_job(part, tmp_path, serial)


def test_the_part_is_frozen_into_the_job(part: Part, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(ROOT / "samples" / "bracket_plate", source / "parts")
    (source / "cad").mkdir()
    text = (source / "parts" / "part.toml").read_text()
    cad = load_part(source / "parts" / "part.toml").cad_path
    shutil.move(cad, source / "cad" / cad.name)
    (source / "parts" / "part.toml").write_text(text.replace(f'"{cad.name}"', f'"../cad/{cad.name}"'))
    loaded = load_part(source / "parts" / "part.toml")
    job = JobFolder.create(tmp_path / "jobs", loaded, loaded.path, "SN 1")
    before = load_part(job.part_file)
    assert before.model.source_hash == loaded.model.source_hash and job.path in job.part_file.parents
    changed = (source / "parts" / "part.toml").read_text().replace("position_tolerance_mm", "angle_tolerance_deg")
    (source / "parts" / "part.toml").write_text(changed)
    shutil.rmtree(source / "cad")
    after = load_part(JobFolder.open(job.path).part_file)
    assert after.settings == before.settings and after.model.source_hash == loaded.model.source_hash


def test_parts_of_a_gltf_and_a_step_in_files_beside_them_are_frozen(part: Part, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    names = {"a.gltf": '{"buffers": [{"uri": "sub/a%20b.bin"}]}', "b.stp": "X('sub/post.stp','/etc/passwd','no.stp');"}
    for name, text in {**names, "sub/a b.bin": "1", "sub/post.stp": "2"}.items():
        (tmp_path / name).write_text(text)
    for name, others in (("a.gltf", ["sub/a b.bin"]), ("b.stp", ["sub/post.stp"])):
        job = tmp_path / f"job_{name}"
        assert freeze_part(tmp_path / name, job) == f"part/{name}"
        found = [path.relative_to(job / "part").as_posix() for path in (job / "part").rglob("*") if path.is_file()]
        assert sorted(found) == sorted([name, *others])


def test_a_copied_folder_is_a_job_of_its_own(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    add(job, 1)
    shutil.copytree(job.path, job.path.with_name("copy"))
    mine, copy = sorted(jobs_in(tmp_path / "jobs"), key=lambda one: one.id == "copy")
    assert (mine.id, copy.id) == (job.id, "copy")
    add(copy, 2)
    assert len(mine.photos()) == 1 and len(copy.photos()) == 2


def test_a_signed_job_is_not_reopened(part: Part, tmp_path: Path) -> None:
    job = new_job(part, tmp_path)
    add(job, 1)
    job.end()
    measured = inspection(part.model, (deviation("block", (0.0, 0.0, 0.0), np.array([30.0, 27.5, 12.5])),))
    save_inspection(measured, job.path / "inspection.json")
    job.write_state(WalkState("done"))
    decisions.sign_inspection(job.path, "Ada")
    assert job.is_signed
    with pytest.raises(InputError, match="is signed"):
        job.reopen()
    assert job.is_ended
    # A check that begins after the signature is open; one that was signed is not.
    check = job.recheck(["block"])
    add(check, 2)
    check.end()
    assert not check.is_signed
    check.reopen()
    check.end()
    decisions.sign_inspection(job.path, "Ada")
    assert check.is_signed
