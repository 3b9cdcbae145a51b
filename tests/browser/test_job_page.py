"""The inspection as a job on the page, with a station that answers as told: lost photos, results, signature."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from arview.core.messages import sentence
from arview.station.capture import CaptureAdvice, ComponentNeed, capture_document, words
from arview.station.live.server import clients
from arview.station.live.stream import documents
from arview.station.live.stream.subjects import Subjects
from helpers import live_browser
from helpers.live_client import Running, running
from helpers.live_sample import INSPECTION, loader, options
from helpers.page import WATCH, opened, until
from helpers.told_jobs import CELLS, ToldJobs
from helpers.told_session import numbered_session

WIDTH, HEIGHT, FPS = 640, 360, 5
PHONE = {"width": 390, "height": 844}
JOB = "job_BP-0012"
ENGLISH = re.compile(r"\b(the|is|are|not|this|from|more|of|with|and|here|photos?)\b", re.IGNORECASE)
VISIBLE_TEXTS = """
[...document.querySelectorAll('body *')]
  .filter((one) => one.checkVisibility?.({visibilityProperty: true}) && !one.closest('[lang=en]'))
  .flatMap((one) => [...one.childNodes].filter((node) => node.nodeType === 3).map((node) => node.textContent.trim())
    .concat([one.getAttribute('title') ?? '', one.getAttribute('aria-label') ?? '']))
  .filter((text) => /[a-z]{2}/i.test(text))"""
ADVICE: dict[str, Any] = {}
"""What every pose says of the capture."""
QUICK = {
    "POLL_MS": "500",
    "BIND_MS": "400",
    "FIRST_PAUSE_MS": "300",
    "DISK_PAUSE_MS": "1_500",
    "LONGEST_PAUSE_MS": "3_000",
}
"""Of the page's pauses, a fifth; where they are tested, what comes after them is waited for."""
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    film = tmp_path_factory.mktemp("film") / "part.y4m"
    images = live_browser.frames(WIDTH, HEIGHT)
    live_browser.write_y4m(film, [images[k] for k in live_browser.there_and_back()], FPS)
    with live_browser.browser(film) as running_browser:
        yield running_browser


@pytest.fixture(scope="module")
def server() -> Iterator[Running]:
    plain = documents.pose_document

    def told(*of: Any, **more: Any) -> dict[str, Any]:
        return {**plain(*of, **more), **({"capture": dict(ADVICE)} if ADVICE else {})}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clients, "pose_document", told)
        patch.setattr(Subjects, "session", numbered_session)
        chosen = options(inspection=None, clients=4)
        with running(chosen, loader(chosen)) as one:
            yield one


@pytest.fixture
def jobs() -> Iterator[ToldJobs]:
    ADVICE.clear()
    yield ToldJobs()
    ADVICE.clear()


def capture(page: Any, jobs: ToldJobs) -> dict[str, Any]:
    """Start a job, and wait until photos can be taken; returns its document."""
    jobs.attach(page)
    until(page, "window.drawn?.pose?.state === 'tracked'")
    page.click("#open-job")
    page.fill("#job-serial", "BP-0012")
    page.locator("#job .primary").click()
    page.wait_for_selector("#job-hud .shutter:not([hidden])")
    return jobs.jobs[JOB]


def advise(**more: Any) -> None:
    """Let the poses say something of the capture."""
    usual = {"job": JOB, "take_id": 0, "takes": False, "text": "from the left", "reason": "", "progress": 0.3}
    cells = "1" + "2" * (len(CELLS) - 1)
    ADVICE.update({**usual, "is_enough": False, "distance": "good", "cells": cells, **more})


def components() -> list[dict[str, Any]]:
    """The sample's components as a job has them."""
    record = json.loads(INSPECTION.read_text())["components"]
    keys = ("name", "verdict", "distance_mm", "uncertainty_mm")
    more = {"detail_text": "", "value_text": "0.10 mm"}
    return [{**{key: one[key] for key in keys}, **more} for one in record]


def state(page: Any) -> str:
    return str(page.inner_text(".hud-state"))


def test_sha256_without_a_secure_context(chromium: Any, server: Running) -> None:
    contents = [bytes(range(256)) * 40, b"", b"abc", b"x" * 55, b"x" * 56, b"x" * 64, b"y" * 119, b"z" * 100_001]
    with opened(chromium, server) as page:
        found = page.evaluate(
            """async (contents) => {
              const { plainSha256, sha256 } = await import("/static/job/hash.js");
              const hex = (bytes) => Array.from(bytes, (one) => one.toString(16).padStart(2, "0")).join("");
              return Promise.all(contents.map(async (one) => {
                const bytes = Uint8Array.from(one);
                return [hex(plainSha256(bytes)), await sha256(bytes.buffer)];
              }));
            }""",
            [list(one) for one in contents],
        )
    assert found == [[hashlib.sha256(one).hexdigest()] * 2 for one in contents]


def test_photos_survive_a_reload_and_arrive_once(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        job = capture(page, jobs)
        jobs.is_gone = True
        for count in (1, 2):
            page.click("#job-hud .shutter")
            until(page, lambda count=count: f"No connection: {count} kept on this device" in state(page))
        assert not jobs.stored and "stored" not in state(page), "nothing is called stored before the station says so"
        page.reload()
        until(page, lambda: page.locator("#open-job").count() == 1)
        page.wait_for_timeout(1500)
        assert not jobs.stored
        jobs.is_gone = False
        until(page, lambda: len(jobs.stored) == 2)
        until(page, lambda: page.locator("#job-hud").is_visible() and "All stored" in state(page))
        page.wait_for_timeout(1500)
    assert len(jobs.stored) == 2 and job["photos"] == ["0001.jpg", "0002.jpg"]
    assert all(one[:3] == b"\xff\xd8\xff" for one in jobs.stored)


def test_a_photo_that_arrives_damaged_is_sent_again(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        capture(page, jobs)
        jobs.lost = 1
        jobs.refusals = [
            (503, {"error": "busy", "message": "busy"}),
            (422, {"error": "bad_hash", "message": "damaged"}),
        ]
        page.click("#job-hud .shutter")
        until(page, lambda: len(jobs.stored) == 1)
        jobs.refusals = [(507, {"error": "disk_full", "message": "full"})]
        page.click("#job-hud .shutter")
        until(page, lambda: "disk is full: 1 kept on this device" in state(page))
        until(page, lambda: len(jobs.stored) == 2)
    digests = {hashlib.sha256(one).hexdigest() for one in jobs.stored}
    assert {one["sha256"] for one in jobs.begun.values()} == digests


def test_a_photo_is_taken_by_itself_once_for_each_number(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    advise()
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        capture(page, jobs)
        until(page, lambda: page.locator("#job-hud .dome circle.wanted").count() == len(CELLS) - 1)
        page.wait_for_timeout(1000)
        assert not jobs.stored
        for number in (1, 2):
            advise(takes=True, take_id=number)
            until(page, lambda number=number: len(jobs.stored) == number)
            page.wait_for_timeout(1200)
            assert len(jobs.stored) == number
        assert page.inner_text(".hud-count") == "2 photos"
    for about in jobs.begun.values():
        assert about["source"] == "still" and about["media_type"] == "image/jpeg"
        assert len(about["hint"]["cam_from_model"]) == 16 and about["hint"]["camera"]["width"] == WIDTH


def test_result_comes_without_a_reload_and_is_signed(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    with opened(chromium, server, WATCH, PHONE, {**QUICK, "STALE_MS": "3_000"}) as page:
        job = capture(page, jobs)
        page.click("#job-hud .shutter")
        page.click("#job-hud .hud-done")
        until(page, lambda: len(jobs.stored) == 1)
        until(page, lambda: ("end", {}) in jobs.said)
        until(page, lambda: "Measuring: 1 photo" in page.inner_text("#job"))
        found = {
            "verdict": "fail",
            "sentence": "1 of 11 is out of tolerance",
            "components": components(),
            "created": "",
        }
        job.update(inspection=found, state={**job["state"], "is_rough": True})
        until(page, lambda: "PROVISIONAL" in page.inner_text("#job .job-banner"))
        step = {
            "component": "post_1",
            "how": "unbolt",
            "moves": [{"text": "Move it 1.4 mm towards nut_1"}],
            "turn": None,
        }
        job["rework"] = [{**step, "steps": ["Loosen", "Push"], "remark": "", "pictures": []}]
        job["state"] = {**job["state"], "stage": "done", "is_rough": False, "cloud": "done"}
        until(page, lambda: "FAIL" in page.inner_text("#job .job-banner .what"))

        page.click("#job .component[data-name=post_1]")
        assert "Move it 1.4 mm towards nut_1" in page.inner_text("#job .job-moves")
        until(page, "document.querySelector('#job .job-drawing').naturalWidth > 0")
        page.fill("#job-note", "bent in transport")
        page.fill("#job-tick-by", "M. Lang")
        page.check("#job-step-1")
        until(page, lambda: any(name == "ticks" for name, _ in jobs.said))
        page.wait_for_timeout(1200)
        assert page.input_value("#job-note") == "bent in transport", "what is typed stays while news arrive"
        page.check("#job-ok-no")
        page.fill("#job-reason", "Scrap")
        page.fill("#job-by", "M. Lang")
        page.locator("#job .job-form .primary").click()
        until(page, lambda: "Not OK by M. Lang" in page.inner_text("#job .component[data-name=post_1]"))
        page.locator("#job .job-ends .primary").click()
        assert "nut_1" in page.inner_text("#job .job-form"), "who signs is told what has no decision"
        page.locator("#job .primary").click()
        until(page, lambda: "Signed by M. Lang" in page.inner_text("#job"))
        jobs.is_gone = True
        until(page, lambda: "may be out of date" in page.inner_text("#job"))
    said = dict(jobs.said)
    decision = {"component": "post_1", "is_ok": False, "reason": "Scrap", "by": "M. Lang", "photo": None}
    assert said["decisions"] == {**decision, "note": "bent in transport"}
    assert said["ticks"] == {"component": "post_1", "step": 1, "is_done": True, "by": "M. Lang"}
    assert said["sign"] == {"by": "M. Lang", "note": ""}


def test_a_photo_is_taken_back_and_a_measurement_cancelled(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    advise(text=str(words.more_message(9, [])))
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        job = capture(page, jobs)
        for count in (1, 2):
            page.click("#job-hud .shutter")
            until(page, lambda count=count: len(jobs.stored) == count)
        until(page, lambda: page.inner_text(".hud-count") == "2 photos")
        until(page, "document.querySelectorAll('#job-hud .thumb img').length === 2")
        page.click("#job-hud .undo")
        assert "Photo 2" in page.inner_text("dialog")
        page.get_by_role("button", name="It was blurred: take it again").click()
        until(page, lambda: page.inner_text(".hud-count") == "1 photo")
        assert job["photos"] == ["0001.jpg"] and ("photos/0002.jpg", {"why": "blurred"}) in jobs.said
        jobs.is_gone = True  # one that has not arrived is taken back, too
        page.click("#job-hud .shutter")
        until(page, lambda: page.inner_text(".hud-count") == "2 photos")
        page.click("#job-hud .undo")
        page.get_by_role("button", name="Take this photo back").click()
        until(page, lambda: page.inner_text(".hud-count") == "1 photo")
        jobs.is_gone = False
        page.wait_for_timeout(1500)
        assert job["photos"] == ["0001.jpg"], "what was taken back on its way is not counted"

        page.click("#job-hud .hud-done")
        until(page, lambda: "Measuring: 1 photo" in page.inner_text("#job") and "min left" in page.inner_text("#job"))
        job.update(inspection={"verdict": "fail", "sentence": "", "components": components(), "created": ""})
        until(page, lambda: page.locator("#job .component").count() > 5)
        shown = page.locator("#job .job-view")
        assert shown.locator(".pass, .fail, .undecided").count() == 0, "nothing is judged yet"
        page.get_by_role("button", name="Cancel").click()
        page.get_by_role("button", name="Go on measuring").click()
        assert ("reopen", {}) not in jobs.said
        page.get_by_role("button", name="Cancel").click()
        page.get_by_role("button", name="Yes, cancel").click()
        until(page, lambda: page.locator("#job-hud").is_visible() and ("reopen", {}) in jobs.said)
        assert page.inner_text(".hud-count") == "1 photo"


def test_a_photo_is_taken_for_a_decision(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    found = {"verdict": "fail", "sentence": "", "components": components(), "created": ""}
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        job = capture(page, jobs)
        job.update(inspection=found, state={**job["state"], "stage": "done", "cloud": "done"})
        page.click("#job .component[data-name=post_1]")
        page.fill("#job-note", "bent")
        page.fill("#job-by", "M. Lang")
        page.fill("#job-reason", "Scrap")
        page.check("#job-ok-no")
        jobs.is_gone = True  # the network is cut: the decision waits for its photo
        page.get_by_role("button", name="Take a photo now").click()
        until(page, lambda: "kept on this device" in page.inner_text("#job .job-photo [role=status]"))
        until(page, "document.querySelector('#job .job-photo img').naturalWidth > 0")
        page.locator("#job .job-form .primary").click()
        page.wait_for_timeout(1500)
        assert not jobs.said and not jobs.attached
        assert page.input_value("#job-note") == "bent"
        jobs.is_gone = False
        until(page, lambda: any(name == "decisions" for name, _ in jobs.said))
        (content,) = jobs.attached
        assert content[:3] == b"\xff\xd8\xff" and not jobs.stored and job["photos"] == []
        said = dict(jobs.said)["decisions"]
        assert said["photo"] == f"decisions/{hashlib.sha256(content).hexdigest()}.jpg" and said["note"] == "bent"
        page.click("#job .component[data-name=post_1]")
        until(page, "document.querySelector('#job .job-drawing[alt^=\"Photo taken for\"]')?.naturalWidth > 0")


def test_check_again_shows_before_and_after(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    found = {"verdict": "fail", "sentence": "", "components": components(), "created": ""}
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        job = capture(page, jobs)
        rework = {
            "component": "post_1",
            "how": "",
            "moves": [],
            "turn": None,
            "steps": [],
            "remark": "",
            "pictures": [],
        }
        job.update(inspection=found, rework=[rework], state={**job["state"], "stage": "done", "cloud": "done"})
        page.click("#job .component[data-name=post_1]")
        page.locator("#job .primary", has_text="Check again").click()
        page.wait_for_selector("#job-hud .shutter:not([hidden])")
        again = jobs.jobs[f"{JOB}_r1"]
        assert again["components"] == ["post_1"]
        page.click("#job-hud .shutter")
        until(page, lambda: "stored" in state(page))
        page.click("#job-hud .hud-done")
        until(page, lambda: again["state"]["stage"] == "measuring")
        row = {"name": "post_1", "before_mm": 1.36, "after_mm": 0.04, "verdict_before": "fail", "verdict_after": "pass"}
        one = [one for one in components() if one["name"] == "post_1"]
        again.update(before_after=[row], inspection={**found, "verdict": "pass", "components": one})
        again["state"] = {**again["state"], "stage": "done", "cloud": "done"}
        until(page, lambda: "0.04 mm" in page.inner_text("#job .before-after .is"))
        assert "1.36 mm" in page.inner_text("#job .before-after .was")
        page.locator("#job .primary", has_text="Result").click()
        until(page, lambda: "1.36 → 0.04 mm, PASS" in page.inner_text("#job .component[data-name=post_1]"))


def test_a_german_page_says_in_german_what_the_station_says(chromium: Any, server: Running, jobs: ToldJobs) -> None:
    more = words.more_message(6, [sentence("capture.left")] * 6)
    way = sentence("capture.both", first=more, second=sentence("capture.hidden_one", name="bracket_2"))
    advice = CaptureAdvice(
        False, 0, way, sentence("capture.closer"), 0.3, False, 4, (), "far",
        (ComponentNeed("post_1", 1, 1, None, False, words.lacking_message(3, True)),),
    )  # fmt: skip
    with opened(chromium, server, WATCH, PHONE, QUICK, locale="de-DE") as page:
        capture(page, jobs)
        advise(**{**capture_document(advice, JOB), "cells": "0" * len(CELLS)})
        until(page, "document.querySelector('#job-hud .hud-text').textContent.includes('verdeckt')")
        assert page.text_content("#job-hud .hud-text") == "noch 6 von links; bracket_2 ist von hier verdeckt"
        assert page.text_content("#job-hud .hud-reason") == "näher heran"
        page.wait_for_selector(".need", state="attached")
        assert page.get_attribute(".need", "title") == "von hier verdeckt; noch 3 Fotos"
        found = page.evaluate(VISIBLE_TEXTS)
        assert len(found) > 10
        assert [text for text in found if ENGLISH.search(text)] == []
    with opened(chromium, server, WATCH, PHONE, QUICK) as page:
        capture(page, jobs)
        until(page, "document.querySelector('#job-hud .hud-text').textContent.includes('hidden')")
        assert page.text_content("#job-hud .hud-text") == way
