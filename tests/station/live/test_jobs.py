"""Jobs over HTTP: start, uploads, numbers on the live picture, re-check, decisions, files; two serials never mix."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from arview.inspection import load_inspection, save_inspection
from arview.station.live.server import hub
from arview.station.live.stream.frames import to_jpeg
from arview.station.walk.job import JobFolder, jobs_in
from arview.station.walk.records import WalkState
from helpers.live_client import Http, Running, running, wait
from helpers.live_jobs import about, job_options, measured, photo, piece, quiet_worker, rough, send
from helpers.live_sample import CLIP, frames, loader, options

pytestmark = pytest.mark.slow  # each needs a server


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("jobs")


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Running]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("arview.station.walk.start_worker", quiet_worker)
        patched.setattr(hub, "RELOAD_INTERVAL_S", 0.1)
        chosen = options(inspection=None, record_folder=folder, clients=4, jobs=job_options(folder))
        with running(chosen, loader(chosen)) as server:
            yield server


SERIALS = iter(range(1000, 10_000))


def started(page: Http, serial: str | None = None) -> str:
    status, job = page.json("POST", "/api/jobs", {"part": 0, "serial": serial or f"BP-{next(SERIALS)}"})
    assert status == 201, job
    return str(job["id"])


def on_disk(folder: Path, job: str) -> JobFolder:
    return next(found for found in jobs_in(folder / "jobs") if found.id == job)


def track(page: Http, client: str, index: int = 0) -> dict[str, Any]:
    """Send a frame of the sample; returns *Pose*."""
    path = f"/api/clients/{client}/frame?id={index}"
    status, _, content = page.ask("POST", path, to_jpeg(frames()[0], 92), Content_Type="image/jpeg")
    assert status == 200, content
    return dict(json.loads(content))


def control(page: Http, client: str, **wanted: Any) -> dict[str, Any]:
    status, answer = page.json("POST", f"/api/clients/{client}/control", wanted)
    assert status == 200, answer
    return dict(answer)


def test_the_folder_is_made_with_the_first_job_and_the_same_serial_continues(tmp_path: Path) -> None:
    chosen = options(inspection=None, jobs=job_options(tmp_path))
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        assert page.json("GET", "/api/jobs") == (200, {"jobs": []}) and not (tmp_path / "jobs").exists()
        first = started(page, "BP-1")
        assert page.json("POST", "/api/jobs", {"part": 0, "serial": " BP-1 "})[0] == 200
        other = started(page, "BP-2")
        serials = [{"part": 0, "serial": wrong} for wrong in ("", 5, "x" * 200, "a\nb")]
        for wrong in ({}, {"part": 1, "serial": "x"}, {"part": True, "serial": "x"}, *serials):
            assert page.json("POST", "/api/jobs", wrong)[0] == 400, wrong
        rows = page.json("GET", "/api/jobs")[1]["jobs"]
        assert [(one["id"], one["serial"], one["stage"], one["verdict"], one["photos"]) for one in rows] == [
            (first, "BP-1", "collecting", None, 0), (other, "BP-2", "collecting", None, 0)
        ]  # fmt: skip
        assert all(one["part_name"] == "bracket_plate" and one["part"] == 0 for one in rows)
        measured(on_disk(tmp_path, first))
        assert page.json("POST", "/api/jobs", {"part": 0, "serial": "BP-1"})[0] == 201  # the first is finished


def test_photos_are_uploaded_in_pieces_and_asked_for_again(page: Http, folder: Path) -> None:
    job, content = started(page), photo(1)
    assert send(page, job, content) == "0001.jpg"
    assert page.json("POST", f"/api/jobs/{job}/uploads", about(content)) == (200, {"photo": "0001.jpg"})
    status, headers, served = page.ask("GET", f"/api/jobs/{job}/photos/0001.jpg")
    assert status == 200 and headers["content-type"] == "image/jpeg" and served == content
    upload = about(content)["sha256"][:32]
    asked = page.json("GET", f"/api/jobs/{job}/uploads/{upload}")
    assert asked == (200, {"photo": "0001.jpg", "offset": len(content)})
    status, begun = page.json("POST", f"/api/jobs/{job}/uploads", about(photo(2)))
    assert status == 201 and begun["offset"] == 0
    assert piece(page, job, begun["upload"], 0, photo(2)[:1000]) == (200, {"offset": 1000})
    assert page.json("GET", f"/api/jobs/{job}/uploads/{begun['upload']}") == (200, {"offset": 1000})
    status, wrong = piece(page, job, begun["upload"], 5, b"x")
    assert status == 409 and (wrong["error"], wrong["offset"]) == ("bad_offset", 1000)
    assert page.ask("PATCH", f"/api/jobs/{job}/uploads/{begun['upload']}?offset=1000", b"x" * (1 << 21))[0] == 413
    assert page.ask("PATCH", f"/api/jobs/{job}/uploads/{begun['upload']}?offset=x", b"x")[0] == 400
    told = page.json("GET", f"/api/jobs/{job}")[1]
    assert told["photos"] == ["0001.jpg"] and not told["is_ended"] and told["inspection"] is None
    assert told["uploads"] == [{"upload": begun["upload"], "bytes": len(photo(2)), "offset": 1000}]
    ended = page.json("POST", f"/api/jobs/{job}/end")[1]
    assert ended["is_ended"] and on_disk(folder, job).is_ended
    assert not page.json("POST", f"/api/jobs/{job}/reopen")[1]["is_ended"]


def test_a_photo_is_taken_back(page: Http, folder: Path) -> None:
    job = started(page)
    assert [send(page, job, photo(number)) for number in (1, 2)] == ["0001.jpg", "0002.jpg"]
    status, left = page.json("DELETE", f"/api/jobs/{job}/photos/0001.jpg?why=blurred")
    assert status == 200 and left["photos"] == ["0002.jpg"]
    assert page.json("GET", f"/api/jobs/{job}")[1]["photos"] == ["0002.jpg"]
    assert page.ask("GET", f"/api/jobs/{job}/photos/0001.jpg")[0] == 404
    assert b'"why": "blurred"' in (on_disk(folder, job).path / "photos.jsonl").read_bytes()
    assert page.json("DELETE", f"/api/jobs/{job}/photos/0001.jpg")[0] == 400
    page.json("POST", f"/api/jobs/{job}/end")
    assert page.json("DELETE", f"/api/jobs/{job}/photos/0002.jpg")[0] == 400


def test_the_time_of_a_measurement_is_told_by_the_last_ones(page: Http, folder: Path) -> None:
    first, second = started(page), started(page)
    for job in (first, second):
        send(page, job, photo(3, 90))
    send(page, second, photo(4, 90))
    done = on_disk(folder, first)
    measured(done)
    done.write_state(replace(done.state(), photos=1, seconds_after_last_photo=30.0))
    page.json("GET", "/api/jobs")
    page.json("POST", f"/api/jobs/{second}/end")
    told = page.json("GET", f"/api/jobs/{second}")[1]
    assert told["expected_s"] is not None and told["expected_s"] > 0.0 and 0.0 <= told["measuring_s"] < 60.0
    reopened = page.json("POST", f"/api/jobs/{second}/reopen")[1]
    assert reopened["measuring_s"] is None and reopened["state"]["stage"] == "collecting"


def test_what_is_not_there_is_not_found(page: Http) -> None:
    job = started(page)
    for path in ("/api/jobs/nope", "/api/jobs/..%2f..", f"/api/jobs/{job}/photos/..%2fjob.json", f"/api/jobs/{job}/x",
                 f"/api/jobs/{job}/photos/0009.jpg", f"/api/jobs/{job}/report.html", f"/api/jobs/{job}/inspection.json",
                 f"/api/jobs/{job}/rework/..%2f..%2fjob.json", f"/api/jobs/{job}/job.json"):  # fmt: skip
        status, _, content = page.ask("GET", path)
        assert status == 404 and b"arview job" not in content, path
    assert page.json("GET", f"/api/jobs/{job}/rework/post_1.svg")[0] == 409
    assert page.json("POST", f"/api/jobs/{job}/sign", {"by": "Ada"}) == (
        409, {"error": "not_done", "message": "this part is not measured yet"}
    )  # fmt: skip
    assert page.json("POST", f"/api/jobs/{job}/recheck", {"components": ["post_1"]})[0] == 409


def test_labels_go_from_measuring_to_numbers_without_a_reload(page: Http, folder: Path) -> None:
    client, job = page.join(), started(page)
    before = track(page, client)
    assert before["state"] == "tracked" and "capture" not in before
    status = control(page, client, job=job)
    assert status["job"]["id"] == job and status["job"]["stage"] == "collecting"
    path = f"/api/part?client={client}"
    part = page.json("GET", path)[1]
    assert part["revision"] == status["revision"] != before["revision"]
    assert part["part"]["serial"] == status["job"]["serial"] and part["inspection"] is None
    assert {one["value_text"] for one in part["components"]} == {"measuring"}
    assert {one["verdict"] for one in part["components"]} == {None}
    pose = track(page, client, 1)
    assert pose["revision"] == part["revision"]
    assert {one["value"] for one in pose["labels"] if one["evidence"] in ("unverified", "uncertain")} <= {"measuring"}
    # First numbers.
    rough(on_disk(folder, job), ["post_1", "post_2"])
    told = wait(lambda: news(page, client, part["revision"], "measuring"), 20)
    assert told["job"]["state"]["is_rough"]
    assert "inspection_rough" in [one["code"] for one in told["notices"]]
    values = {one["name"]: one["value_text"] for one in page.json("GET", path)[1]["components"]}
    assert "1.36" in values["post_1"] and values["nut_1"] == "measuring"
    # All of them.
    measured(on_disk(folder, job), post_1=0.0)
    final = wait(lambda: news(page, client, told["revision"], "done"), 20)
    assert final["revision"] > told["revision"]
    shown = {one["name"]: one for one in page.json("GET", path)[1]["components"]}
    assert shown["post_1"]["verdict"] == "pass" and shown["nut_1"]["verdict"] == "undecided"
    assert track(page, client, 2)["revision"] == final["revision"]
    # The part without a job never has its numbers, and the client has them no more once it is free.
    assert {one["verdict"] for one in page.json("GET", "/api/part")[1]["components"]} == {None}
    free = control(page, client, job=None)
    assert free["job"] is None and free["revision"] == before["revision"]
    assert {one["value_text"] for one in page.json("GET", path)[1]["components"]} == {""}


def news(page: Http, client: str, revision: int, stage: str) -> dict[str, Any] | None:
    """The status once numbers and stage are new: the numbers are on the disk a moment before the stage is."""
    status = page.json("GET", f"/api/clients/{client}/status")[1]
    return status if status["revision"] != revision and status["job"]["stage"] == stage else None


def test_two_clients_with_two_serials_see_only_their_own_numbers(page: Http, server: Running, folder: Path) -> None:
    other = server.session()
    clients = [page.join(), other.join()]
    jobs = [started(page), started(page)]
    measured(on_disk(folder, jobs[0]), post_1=0.11)
    measured(on_disk(folder, jobs[1]), post_1=2.22)
    pages = [page, other]
    for turn in range(3):
        for k in range(2):
            control(pages[k], clients[k], job=jobs[(k + turn) % 2])
        for k in range(2):
            number = (k + turn) % 2
            part = pages[k].json("GET", f"/api/part?client={clients[k]}")[1]
            pose = track(pages[k], clients[k], turn)
            serial = on_disk(folder, jobs[number]).serial
            value = next(one["value_text"] for one in part["components"] if one["name"] == "post_1")
            assert part["part"]["serial"] == part["inspection"]["serial"] == serial
            assert ("0.11" in value, "2.22" in value) == (number == 0, number == 1)
            assert pose["revision"] == part["revision"]
    assert on_disk(folder, jobs[0]).photos() == () == on_disk(folder, jobs[1]).photos()


def test_wrong_bindings_change_nothing(page: Http, folder: Path) -> None:
    client, job = page.join(), started(page)
    path = f"/api/clients/{client}/control"
    assert page.json("POST", path, {"job": "nope"})[0] == 404
    for wrong in ({"job": 3}, {"job": ""}, {"job": "x" * 300}, {"capture": job}, {"job": job, "capture": "other"}):
        assert page.json("POST", path, wrong)[0] == 400, wrong
    assert page.json("GET", f"/api/clients/{client}/status")[1]["job"] is None
    foreign = on_disk(folder, job)
    copied = foreign.path.with_name("foreign_X_20260101T000000")
    shutil.copytree(foreign.path, copied)
    document = json.loads((copied / "job.json").read_text()) | {"id": copied.name, "model_hash": "0" * 64}
    (copied / "job.json").write_text(json.dumps(document))
    status, refused = page.json("POST", path, {"job": copied.name})
    assert (status, refused["error"]) == (409, "other_part")
    shutil.rmtree(copied)


def test_guided_capture_goes_out_with_the_poses(page: Http, folder: Path) -> None:
    client, job = page.join(), started(page)
    control(page, client, job=job, capture=job)
    index = iter(range(1000))
    advice = wait(lambda: track(page, client, next(index)).get("capture"), 60)
    assert advice["job"] == job and advice["photos"] == 0 and not advice["is_enough"]
    layout = page.json("GET", f"/api/jobs/{job}/capture")[1]
    assert len(layout["cells"]) == len(advice["cells"]) and set(advice["cells"]) <= set("012")
    # A photo counts as soon as it is announced.
    page.json("POST", f"/api/jobs/{job}/uploads", about(photo(1)))
    assert wait(lambda: track(page, client, next(index))["capture"]["photos"], 20) == 1
    # The newest frame as a photo, with its pose.
    status, taken = page.json("POST", f"/api/jobs/{job}/take", {"client": client})
    assert status == 201
    stored = on_disk(folder, job)
    assert stored.photos()[0].name == taken["photo"]
    assert stored.photos()[0].source == "stream" and stored.photos()[0].cam_from_model is not None
    control(page, client, capture=None)
    assert "capture" not in track(page, client, next(index))
    assert page.json("POST", f"/api/jobs/{job}/take", {"client": "x"})[0] == 404
    control(page, client, job=None)
    assert page.json("POST", f"/api/jobs/{job}/take", {"client": client})[0] == 409


def test_decisions_ticks_and_signature(page: Http, folder: Path) -> None:
    job = started(page)
    send(page, job, photo(1))
    measured(on_disk(folder, job))
    base = f"/api/jobs/{job}"
    decision = {
        "component": "post_1",
        "is_ok": False,
        "reason": "bent",
        "note": "left",
        "by": "Ada",
        "photo": "0001.jpg",
    }
    status, kept = page.json("POST", f"{base}/decisions", decision)
    assert status == 201 and kept["entry"] == 1 and kept["photo"] == "0001.jpg"
    done = {"component": "post_1", "step": 0, "is_done": True, "by": "Ada"}
    assert page.json("POST", f"{base}/ticks", done)[0] == 201
    wrongs = [("component", "nope"), ("by", ""), ("is_ok", "yes"), ("photo", "9.jpg"), ("reason", ""), ("reason", 3)]
    for wrong in ({}, *({**decision, key: value} for key, value in wrongs)):
        status, refused = page.json("POST", f"{base}/decisions", wrong)
        assert status == 400 and str(folder) not in refused["message"], refused
    assert page.json("POST", f"{base}/ticks", {**done, "step": -1})[0] == 400
    told = page.json("GET", base)[1]
    assert [one["kind"] for one in told["decisions"]] == ["decision", "tick"]
    assert told["signed"] is None and told["record"]["rejected"] == ["post_1"]
    assert page.json("POST", f"{base}/sign", {"by": "Ada", "note": "seen"})[0] == 201
    assert page.json("GET", base)[1]["signed"]["by"] == "Ada"
    assert page.json("POST", f"{base}/decisions", {**decision, "is_ok": True})[0] == 201
    assert page.json("GET", base)[1]["signed"] is None  # void: a decision came after it
    table = page.ask("GET", f"{base}/decisions.csv")
    assert table[0] == 200 and table[2].decode().count("\r\n") == 5 and "attachment" in table[1]["content-disposition"]
    assert json.loads(page.ask("GET", f"{base}/inspection.json")[2])["components"]
    (on_disk(folder, job).path / "report.html").write_text("<html>report</html>")
    status, headers, _ = page.ask("GET", f"{base}/report.html")
    assert status == 200 and headers["content-security-policy"].startswith("sandbox")


def test_a_photo_taken_for_a_decision_is_in_the_record_and_is_not_measured(page: Http, folder: Path) -> None:
    job = started(page)
    send(page, job, photo(1))
    measured(on_disk(folder, job))
    base, content = f"/api/jobs/{job}", photo(2)
    said = about(content, purpose="decide", hint=None)
    status, begun = page.json("POST", f"{base}/uploads", said)
    assert status == 201
    # The connection is cut after the first piece: nothing is there to decide with, and the rest continues.
    assert piece(page, job, begun["upload"], 0, content[:70_000])[1] == {"offset": 70_000}
    told = page.json("GET", base)[1]
    assert told["attachments"] == [] and told["photos"] == ["0001.jpg"]
    name = f"decisions/{said['sha256']}.jpg"
    decision = {"component": "post_1", "is_ok": False, "reason": "bent", "by": "Ada", "photo": name}
    status, refused = page.json("POST", f"{base}/decisions", decision)
    assert status == 400 and "is missing" in refused["message"]
    assert send(page, job, content, purpose="decide", hint=None) == name
    assert send(page, job, content, purpose="decide", hint=None) == name
    told = page.json("GET", base)[1]
    assert told["attachments"] == [name] and told["photos"] == ["0001.jpg"] and told["state"]["stage"] == "done"
    # A job's photo may be attached as well: it is kept on its own.
    other = send(page, job, photo(1), purpose="decide", hint=None)
    assert other.startswith("decisions/") and page.json("GET", base)[1]["attachments"] == [name, other]
    assert page.json("POST", f"{base}/decisions", decision)[0] == 201
    assert page.ask("GET", f"{base}/photos/{name}")[2] == content
    assert name in page.ask("GET", f"{base}/decisions.csv")[2].decode()
    assert page.json("GET", base)[1]["record"]["faults"] == []
    for wrong in ("decisions/../job.json", f"decisions/{'0' * 64}.jpg", "decisions/x.jpg"):
        assert page.json("POST", f"{base}/decisions", {**decision, "photo": wrong})[0] == 400
        assert page.ask("GET", f"{base}/photos/{wrong}")[0] == 404
    assert page.json("POST", f"{base}/uploads", {**said, "purpose": "else"})[0] == 400
    kept = on_disk(folder, job).path / name
    kept.write_bytes(content[:-1] + b"x")
    record = page.json("GET", base)[1]["record"]
    assert "post_1 (entry 1) was changed" in record["faults"][0] and not record["is_released"]
    assert record["sentence"].startswith("not valid")


def test_rework_and_its_drawing(page: Http, folder: Path) -> None:
    job = started(page)
    measured(on_disk(folder, job))
    told = page.json("GET", f"/api/jobs/{job}")[1]
    instruction = next(one for one in told["rework"] if one["component"] == "post_1")
    assert instruction["moves"][0]["distance_mm"] == pytest.approx(1.357, abs=0.1) and instruction["steps"]
    assert told["inspection"]["verdict"] == "fail" and told["inspection"]["sentence"]
    status, headers, svg = page.ask("GET", f"/api/jobs/{job}/rework/post_1.svg")
    assert status == 200 and headers["content-type"] == "image/svg+xml" and b"<svg" in svg
    assert page.ask("GET", f"/api/jobs/{job}/rework/nope.svg")[0] == 404


def test_a_recheck_shows_the_new_number_beside_the_others(page: Http, folder: Path) -> None:
    client, first = page.join(), started(page)
    measured(on_disk(folder, first))
    status, again = page.json("POST", f"/api/jobs/{first}/recheck", {"components": ["post_1"]})
    assert status == 201 and again["parent"] == first and again["components"] == ["post_1"]
    assert page.json("POST", f"/api/jobs/{first}/recheck", {"components": ["nope"]})[0] == 400
    assert page.json("POST", f"/api/jobs/{first}/recheck", {"components": [3]})[0] == 400
    status = control(page, client, job=again["id"])
    assert [(one["name"], one["before_mm"], one["after_mm"]) for one in again["before_after"]] == [
        ("post_1", 1.357, None)
    ]
    shown = {one["name"]: one for one in page.json("GET", f"/api/part?client={client}")[1]["components"]}
    assert shown["post_1"]["value_text"] == "measuring" and shown["post_1"]["verdict"] is None
    assert shown["post_2"]["verdict"] == "pass"
    measured(on_disk(folder, again["id"]), post_1=0.1)
    wait(lambda: news(page, client, status["revision"], "done"), 20)
    shown = {one["name"]: one for one in page.json("GET", f"/api/part?client={client}")[1]["components"]}
    assert shown["post_1"]["verdict"] == "pass" and shown["post_2"]["verdict"] == "pass"
    told = page.json("GET", f"/api/jobs/{again['id']}")[1]
    assert told["before_after"] == [
        {"name": "post_1", "before_mm": 1.357, "after_mm": 0.1, "verdict_before": "fail", "verdict_after": "pass"}
    ]
    assert page.json("GET", f"/api/jobs/{first}")[1]["rechecks"] == [again["id"]]
    # The first measurement shows the newest value of each component, too.
    control(page, client, job=first)
    shown = {one["name"]: one for one in page.json("GET", f"/api/part?client={client}")[1]["components"]}
    assert shown["post_1"]["verdict"] == "pass"
    # One log for both; a photo of the re-check has its place in its name.
    send(page, again["id"], photo(1))
    decision = {"component": "post_1", "is_ok": True, "reason": "put right", "by": "Ada", "photo": "0001.jpg"}
    status, kept = page.json("POST", f"/api/jobs/{again['id']}/decisions", decision)
    assert status == 201 and kept["photo"] == "recheck/01/0001.jpg"
    for job in (first, again["id"]):
        assert [one["entry"] for one in page.json("GET", f"/api/jobs/{job}")[1]["decisions"]] == [1]
        assert page.ask("GET", f"/api/jobs/{job}/photos/recheck/01/0001.jpg")[2] == photo(1)
    assert page.ask("GET", f"/api/jobs/{first}/photos/recheck/01/0002.jpg")[0] == 404


def test_a_signature_at_the_verdict_holds_while_the_cloud_is_made(page: Http, server: Running, folder: Path) -> None:
    job = started(page)
    measured(on_disk(folder, job))
    on_disk(folder, job).write_state(replace(on_disk(folder, job).state(), cloud="running"))
    server.hub.desk.workers.ask(on_disk(folder, job))
    assert page.json("POST", f"/api/jobs/{job}/sign", {"by": "Ada", "note": "reworked tomorrow"})[0] == 201
    assert page.json("GET", f"/api/jobs/{job}")[1]["signed"]["by"] == "Ada"
    path = on_disk(folder, job).path / "inspection.json"
    made = load_inspection(path)
    save_inspection(replace(made, warnings=(*made.warnings, "a remark of the cloud")), path)
    assert page.json("GET", f"/api/jobs/{job}")[1]["signed"]["by"] == "Ada"


def test_a_failed_measurement_is_told(page: Http, folder: Path) -> None:
    client, job = page.join(), started(page)
    control(page, client, job=job)
    on_disk(folder, job).write_state(WalkState("failed", "the photos do not overlap"))
    told = wait(
        lambda: (s := page.json("GET", f"/api/clients/{client}/status")[1])["job"]["stage"] == "failed" and s, 20
    )
    assert [one["code"] for one in told["notices"] if one["level"] == "error"] == ["job_failed"]


def test_a_disk_that_is_full_is_said_and_nothing_is_confirmed(page: Http, server: Running, folder: Path) -> None:
    job = started(page)
    space, chosen = server.hub.desk.board.space, server.hub.desk.board.space._options
    space._options = replace(chosen, min_free_bytes=10**18)
    try:
        status, refused = page.json("POST", f"/api/jobs/{job}/uploads", about(photo(1)))
        assert (status, refused["error"]) == (507, "disk_full")
        assert page.json("POST", "/api/jobs", {"part": 0, "serial": "BP-full"})[0] == 507
    finally:
        space._options = chosen
    assert send(page, job, photo(1)) == "0001.jpg"


def test_pages_of_a_station_camera_show_each_its_own_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.station.walk.start_worker", quiet_worker)
    monkeypatch.setattr(hub, "RELOAD_INTERVAL_S", 0.1)
    chosen = options(source=str(CLIP), inspection=None, jobs=job_options(tmp_path))
    with running(chosen, loader(chosen)) as server:
        pages = [server.session(), server.session(), server.session()]
        clients = [page.join() for page in pages]
        jobs = [started(pages[0], "BP-1"), started(pages[0], "BP-2")]
        for number, value_mm in enumerate((0.11, 2.22)):
            measured(on_disk(tmp_path, jobs[number]), post_1=value_mm)
            control(pages[number], clients[number], job=jobs[number])
        shown = []
        for page, client in zip(pages, clients, strict=True):
            part = page.json("GET", f"/api/part?client={client}")[1]
            shown.append(next(one["value_text"] for one in part["components"] if one["name"] == "post_1"))
            pose = wait(lambda page=page, client=client: newest(page, client), 60)  # type: ignore[misc]
            assert pose["revision"] == part["revision"]
        assert "0.11" in shown[0] and "2.22" in shown[1] and shown[2] == ""
        status, taken = pages[0].json("POST", f"/api/jobs/{jobs[0]}/take", {"client": clients[0]})
        assert status == 201
        (stored,) = on_disk(tmp_path, jobs[0]).photos()
        assert stored.name == taken["photo"] and stored.source == "station"
        assert pages[1].json("POST", f"/api/jobs/{jobs[0]}/take", {"client": clients[1]})[0] == 409


def newest(page: Http, client: str) -> dict[str, Any] | None:
    """*Pose* of the newest frame of a station camera, or None while there is none."""
    status, headers, _ = page.ask("GET", f"/api/clients/{client}/frame")
    return json.loads(headers["x-arview-answer"]) if status == 200 else None


def test_the_list_reads_no_inspection_and_signed_jobs_are_archived(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = options(inspection=None, jobs=job_options(tmp_path))
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        signed, other = started(page, "BP-1"), started(page, "BP-2")
        for job in (signed, other):
            measured(on_disk(tmp_path, job))
        with monkeypatch.context() as patch:
            patch.setattr("arview.station.live.jobs.board.load_inspection", None)
            states = [on_disk(tmp_path, job).state() for job in (signed, other)]
            for job, state in zip((signed, other), states, strict=True):
                on_disk(tmp_path, job).write_state(replace(state, verdict="fail"))
            rows = page.json("GET", "/api/jobs")[1]["jobs"]
            assert [one["verdict"] for one in rows] == ["fail", "fail"]
        assert page.json("POST", f"/api/jobs/{signed}/sign", {"by": "Ada", "note": "scrapped"})[0] == 201
    old = time.time() - 40 * 86400
    for path in (tmp_path / "jobs" / signed, tmp_path / "jobs" / signed / "decisions.jsonl"):
        os.utime(path, (old, old))
    chosen = options(inspection=None, jobs=replace(job_options(tmp_path), archive_days=30.0))
    with running(chosen, loader(chosen)) as server:
        assert [one["id"] for one in server.session().json("GET", "/api/jobs")[1]["jobs"]] == [other]
    assert (tmp_path / "jobs" / "archive" / signed / "inspection.json").is_file()
