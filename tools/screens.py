#!/usr/bin/env python3
"""Photographs the live page in every state, look and size, and puts the pictures on contact sheets.

    tools/screens.py [--only WORD …] [-o out/screens]

A station plays the sample's clip; what the page gets is changed where a state needs it. It takes some minutes, and
needs Chromium and Playwright, as the tests do.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from arview.cad import load_part
from arview.core.messages import sentence, with_messages
from arview.inspection import load_inspection
from arview.pose import ComponentPresence, Identity, Presence, TrackingState, Visibility
from arview.quality.rework import drawing_svg, instruction_document, make_instructions
from arview.station.capture import words
from arview.station.live.jobs.documents import inspection_document
from arview.station.live.server import clients
from arview.station.live.stream import documents
from helpers import live_browser
from helpers.live_client import Running
from helpers.live_sample import INSPECTION, PART
from helpers.page import changed, until
from helpers.told_jobs import CELLS, ToldJobs
from helpers.told_session import TOLD
from helpers.told_station import told_station

PHONE, SMALL, TALL = (390, 844), (360, 640), (430, 932)
LANDSCAPE, DESK = (844, 390), (1280, 800)
FILM_SIZE = 1280, 720
TILE_PX, COLUMNS, ROWS, CAPTION_PX = 330, 5, 2, 22
TRACKED = "document.body.dataset.state === 'tracked'"
LABELLED = f"{TRACKED} && document.querySelectorAll('#labels .label:not(.off)').length > 0"

PLATE = Path(__file__).resolve().parents[1] / "samples" / "plate"
SIDES = tuple(sentence(f"capture.{side}") for side in ("right", "below", "left"))

NO_WEBRTC = "delete globalThis.RTCPeerConnection"
SERIAL = "void import('/static/serial.js').then((one) => one.askSerial({ frame: () => null, seen: () => 'BP-0417' }))"
STALE_MS = 14_000

Act = Callable[[Any], None]


@dataclass(frozen=True)
class Shot:
    """A state of the page to photograph.

    Attributes:
        name: of the picture.
        size: of the screen, CSS px.
        told: what the tracker says, as in `Told`.
        before: what is done before the page is opened: routes, scripts.
        ready: expression that is true once the state is reached.
        after: what is done then.
        settings: of the browser's context, such as its locale.
        advice: what the poses say of the capture; empty: nothing.
    """

    name: str
    size: tuple[int, int] = PHONE
    told: dict[str, dict[str, Any]] = field(default_factory=dict)
    before: Act = lambda page: None
    ready: str = LABELLED
    after: Act = lambda page: None
    settings: dict[str, Any] = field(default_factory=dict)
    advice: dict[str, Any] = field(default_factory=dict)


def answers(path: str, document: Any, status: int = 200) -> Act:
    """Answer requests for a path with this document."""
    return lambda page: page.route(f"**{path}", lambda route: route.fulfill(status=status, json=document))


def script(text: str) -> Act:
    return lambda page: page.add_init_script(text)


def evaluate(text: str) -> Act:
    return lambda page: page.evaluate(text)


def click(selector: str) -> Act:
    return lambda page: page.locator(selector).evaluate("element => element.click()")


def both(*acts: Act) -> Act:
    def act(page: Any) -> None:
        for one in acts:
            one(page)
            page.wait_for_timeout(250)

    return act


def refused(name: str) -> Act:
    """A phone whose browser refuses the camera with this error."""
    wanted = f"navigator.mediaDevices.getUserMedia = () => Promise.reject(new DOMException('', '{name}'))"
    return both(script(wanted), changed("/api/part", lambda part: part.update(source="phone")))


def appearance(theme: str, size: str = "normal") -> Act:
    return script(f"localStorage.setItem('arview-look', JSON.stringify({{theme: '{theme}', size: '{size}'}}))")


def notice(code: str, level: str, text: str) -> Act:
    """One more notice of the station; a page without WebRTC asks for them."""

    def add(status: dict[str, Any]) -> None:
        status.setdefault("notices", []).insert(0, {"code": code, "level": level, "text": text})

    return both(
        script("localStorage; delete globalThis.RTCPeerConnection"), changed("/status", add), changed("/control", add)
    )


def files() -> Act:
    now = datetime.now(UTC)

    def moment(hours: float) -> str:
        return (now - timedelta(hours=hours)).isoformat().replace("+00:00", "Z")

    def job(name: str, hours: float, stage: str, verdict: str | None, photos: int, **more: Any) -> dict[str, Any]:
        about = {"id": name, "part": "bracket_plate", "serial": "BP-0417", "created": moment(hours), "parent": None}
        return {**about, "stage": stage, "verdict": verdict, "photos": photos, **more}

    films = [
        {"number": 2, "name": "bracket_plate_20270111T101500.mp4", "bytes": 48_200_000, "seconds": 73.2},
        {"number": 1, "name": "bracket_plate_20270110T083000.mp4", "bytes": 9_100_000, "seconds": None},
    ]
    recordings = [
        {**film, "created": moment(hours), "is_recovered": hours > 1}
        for film, hours in zip(films, (1, 26), strict=True)
    ]
    jobs = [
        job("j2", 2, "measuring", None, 14, serial="BP-0418"), job("j1", 20, "done", "fail", 24),
        job("j1r", 19, "done", "pass", 6, parent="j1"),
    ]  # fmt: skip
    return both(
        answers("/api/recordings", {"recordings": recordings}), answers("/api/jobs", {"jobs": jobs}),
        answers("/api/snapshots", {"snapshots": []}),
    )  # fmt: skip


def devices() -> Act:
    now = datetime.now(UTC)

    def device(name: str, days: float, is_this: bool = False) -> dict[str, Any]:
        used = (now - timedelta(days=days)).isoformat().replace("+00:00", "Z")
        return {"name": name, "created": "2026-11-02T08:12:00Z", "last_used": used, "is_this": is_this}

    listed = [device("Android Chrome", 0, True), device("iPad Safari", 0.1), device("Windows Firefox 2", 12)]
    return answers("/api/devices", {"devices": listed})


def jpeg(seed: int) -> bytes:
    """A photo of a pattern, another one for each seed."""
    v, u = np.mgrid[0:480, 0:640]
    picture = np.stack([(u * (1 + seed) + v) % 256, (v + 40 * seed) % 256, (u + v) % 256], axis=-1).astype(np.uint8)
    kept = io.BytesIO()
    Image.fromarray(picture).save(kept, "JPEG")
    return kept.getvalue()


def decision(**decided: Any) -> Act:
    """A measured job with a failing component, photos and an instruction; ``decided`` was decided about it."""
    record = json.loads(INSPECTION.read_text())["components"]
    keys = ("name", "verdict", "distance_mm", "uncertainty_mm")
    more = {"detail_text": "dx +1.21  dz −0.44   U 0.09"}
    components = [
        {**{key: one[key] for key in keys}, **more, "value_text": f"{one['distance_mm'] or 0.0:.2f} mm"}
        for one in record
    ]
    found = {"verdict": "fail", "sentence": "12 components: 1 out of tolerance, 11 in tolerance", "note": ""}
    instruction = {
        "component": "post_1", "how": "unbolt", "text": "", "place": "", "turn": None, "remark": "", "pictures": [],
        "moves": [{"text": "1.31 ± 0.09 mm towards hole_B"}],
        "steps": ["Loosen the bolts of post_1 until it can be moved; leave them in.", "1.31 ± 0.09 mm towards hole_B"],
    }  # fmt: skip
    taken = f"decisions/{'3fa09c41' * 8}.jpg"
    entries = [{"component": "post_1", "time": "2026-11-27T06:20:00Z", "photo": taken, **decided}] if decided else []

    def act(page: Any) -> None:
        jobs = ToldJobs()
        photos = [f"{number:04d}.jpg" for number in range(1, 5)]
        jobs.stored += [jpeg(number) for number in range(4)]
        jobs.attached.append(jpeg(5))
        job = jobs.add(
            "job_BP-0417", serial="BP-0417", photos=photos, rework=[instruction], decisions=entries,
            attachments=[taken], inspection={**found, "components": components, "created": "2026-11-27T06:12:00Z"},
        )  # fmt: skip
        job["state"] = {**job["state"], "stage": "done", "photos": 4, "cloud": "done"}
        jobs.attach(page)

    return act


def component_of_job(*then: Act) -> Act:
    """Open the failing component of the job, and scroll to its decision."""
    job = ".job-list button, #job .jobs button, #job li button"
    opened = both(click("#open-job"), lambda page: page.wait_for_selector(job), click(job))
    row = '#job .component[data-name="post_1"]'
    shown = "document.querySelector('#job .job-choices, #job .job-decided').scrollIntoView({ block: 'center' })"
    return both(opened, lambda page: page.wait_for_selector(row), click(row), evaluate(shown), *then)


def sample() -> tuple[Any, Any]:
    """The sample part and its inspection, of which a component fails by a skewed move."""
    return load_part(PART), load_inspection(INSPECTION)


@cache
def measured_job() -> dict[str, Any]:
    """What a station says of the sample's measurement, with instructions and drawings as it makes them."""
    part, inspection = sample()
    told = make_instructions(part, inspection)
    instructions = [instruction_document(one) for one in told]
    drawings = {one.component: drawing_svg(part, inspection, one.component, "screen").encode() for one in told}
    return {
        "inspection": inspection_document(inspection),
        "rework": instructions,
        "messages": with_messages({"rework": instructions})["messages"],
        "drawings": drawings,
    }


def worker_job(stage: str, is_recheck: bool = False) -> Act:
    """A job in a stage: collecting, measuring, done; or the check of the failing component after its rework."""

    def act(page: Any) -> None:
        known = measured_job()
        jobs = ToldJobs(drawings=known["drawings"])
        photos = [f"{number:04d}.jpg" for number in range(1, 13)]
        jobs.stored += [path.read_bytes() for path in sorted((PLATE / "photos").glob("*.jpg"))[:12]]
        name = known["rework"][0]["component"]
        job = jobs.add("j1", serial="BP-0417", photos=photos, messages=known["messages"])
        state = {"stage": stage, "photos": 12, "cloud": "done", "is_rough": stage == "collecting"}
        job["state"] = {
            **job["state"],
            **state,
            "step": "adjusting" if stage == "measuring" else "",
            "done": 1,
            "total": 3,
        }
        job.update(inspection=known["inspection"])
        if stage == "measuring":
            job.update(is_ended=True, measuring_s=95.0, expected_s=210.0)
        if stage == "done":
            job.update(is_ended=True, rework=known["rework"])
        if is_recheck:
            checked = {**known["inspection"], "verdict": "not_measured"}
            row = {"name": name, "before_mm": 2.99, "after_mm": 0.31, "verdict_before": "fail", "verdict_after": "pass"}
            again = jobs.add(
                "j1r", parent="j1", components=[name], serial="BP-0417", photos=photos[:5], before_after=[row]
            )
            again.update(inspection=checked, is_ended=True, state={**job["state"], "stage": "done"})
        jobs.attach(page)
        page.add_init_script(f"localStorage.setItem('arview-job', '{'j1r' if is_recheck else 'j1'}')")

    return act


def worker_shots() -> list[Shot]:
    """What a worker sees of one inspection, in all sizes and both languages."""
    advice = {
        "job": "j1", "take_id": 0, "takes": False, "progress": 0.57, "is_enough": False, "distance": "good",
        "text": str(words.more_message(9, [SIDES[0]] * 4 + [SIDES[1]] * 2 + [SIDES[2]] * 3)),
        "reason": str(sentence("capture.hold_still")), "cells": "1" * 8 + "2" * 9 + "0" * (len(CELLS) - 17),
        "components": [{"index": k, "photos": 2 + k, "U_mm": 0.1, "is_enough": k > 3, "text": ""} for k in range(11)],
    }  # fmt: skip
    advice["messages"] = {
        **with_messages({"text": words.more_message(9, [SIDES[0]] * 4 + [SIDES[1]] * 2 + [SIDES[2]] * 3)})["messages"],
        **with_messages({"reason": sentence("capture.hold_still")})["messages"],
    }
    enough = {**advice, "is_enough": True, "progress": 1.0, "text": str(sentence("capture.enough")),
              "messages": with_messages({"text": sentence("capture.enough")})["messages"]}  # fmt: skip
    hud, side = "!document.querySelector('#job-hud').hidden", "document.querySelector('#job .{}') !== null"
    inspect = evaluate("document.body.dataset.side !== 'job' && document.querySelector('#open-job').click()")
    component = measured_job()["rework"][0]["component"]
    row = f'#job .component[data-name="{component}"]'
    to_row = both(
        inspect, lambda page: page.wait_for_selector(row), click(row), lambda page: page.wait_for_timeout(1500)
    )
    scroll = "document.querySelector('#job .{}')?.scrollIntoView({{ block: 'start' }})"
    lost = {"feed": {"kind": "station", "state": "reconnecting", "text": "camera 0: cannot be opened; trying again",
                     "age_ms": None, "received_fps": 0, "tracked_fps": 0, "received": 0, "dropped": 0, "unreadable": 0,
                     "width": None, "height": None}}  # fmt: skip
    states = {
        "worker start": Shot("", before=files(), ready="true", after=inspect),
        "worker capture": Shot("", before=worker_job("collecting"), ready=hud, advice=advice),
        "worker enough": Shot("", before=worker_job("collecting"), ready=hud, advice=enough),
        "worker undo": Shot("", before=worker_job("collecting"), ready=hud, advice=advice,
                            after=click("#job-hud .undo")),
        "worker measuring": Shot("", before=worker_job("measuring"), ready=side.format("job-progress"), after=inspect),
        "worker cancel": Shot("", before=worker_job("measuring"), ready=side.format("job-progress"),
                              after=both(inspect, click("#job .job-progress .wide"))),
        "worker verdict": Shot("", before=worker_job("done"), ready=side.format("job-banner"), after=inspect),
        "worker component": Shot("", before=worker_job("done"), ready=side.format("job-banner"), after=to_row),
        "worker steps": Shot("", before=worker_job("done"), ready=side.format("job-banner"),
                             after=both(to_row, evaluate(scroll.format("job-steps")))),
        "worker drawing": Shot("", before=worker_job("done"), ready=side.format("job-banner"),
                               after=both(to_row, evaluate(scroll.format("job-figure")))),
        "worker recheck": Shot("", before=worker_job("done", True), ready=side.format("before-after"), after=inspect),
        "worker parts": Shot("", after=evaluate("document.querySelector('#open-parts').click()")),
        "worker view": Shot("", after=evaluate("document.querySelector('#open-view').click()")),
        "worker no camera": Shot("", before=both(
            script(NO_WEBRTC), changed("/status", lambda status: status.update(lost)),
            changed("/control", lambda status: status.update(lost)),
            lambda page: page.route("**/frame?*", lambda route: route.fulfill(status=204))),
            ready="document.body.dataset.state !== undefined",
            after=lambda page: page.wait_for_timeout(2500)),
        "worker phone": Shot("", before=refused("NotAllowedError"), ready="!document.querySelector('#message').hidden"),
    }  # fmt: skip
    return [
        replace(shot, name=f"{name}, {width}, {locale[:2]}", size=(width, height), settings={"locale": locale})
        for name, shot in states.items()
        for width, height in (SMALL, PHONE, LANDSCAPE, DESK)
        for locale in ("de-DE", "en-US")
    ]


def in_the_future(part: dict[str, Any]) -> None:
    made = datetime.now(UTC) + timedelta(days=2)
    part["inspection"] |= {"created": made.isoformat().replace("+00:00", "Z"), "age_s": -172_800}


def shots() -> list[Shot]:
    moved = np.eye(4)
    moved[1, 3] = 35.0
    absent = ComponentPresence(Presence.MISSING, Visibility.VISIBLE, 0.01, 9, 40.0)
    displaced = ComponentPresence(Presence.DISPLACED, Visibility.VISIBLE, 0.01, 9, 40.0, moved)
    unposed = {"cam_from_model": None, "covariance": None}
    unsure = {"identity": Identity.UNCONFIRMED, "identity_reason": "two plates are in view"}
    unsure_pose = {"state": TrackingState.CRITICAL, "reason": "part of the plate is hidden"}
    searching = {"more": {"state": TrackingState.SEARCHING, **unposed}}
    styles = (("light", "normal", PHONE), ("contrast", "normal", PHONE), ("dark", "largest", SMALL))
    german = {"locale": "de-DE"}
    busy = answers("/api/clients", {"error": "busy", "message": "busy: 4 of 4 pages take part"}, 503)
    loading = {
        "protocol": 2,
        "revision": 0,
        "state": "loading",
        "text": "guide views of bracket_plate: 40 %",
        "source": "station",
    }
    denied = answers("/api/part", {"error": "no_token", "message": "the token is missing"}, 403)
    message = "!document.querySelector('#message').hidden"
    state = "document.body.dataset.state === '{}'"
    side = "document.querySelector('#open-{}')"
    parts, view = (evaluate(f"{side.format(name)}.click()") for name in ("parts", "view"))
    stale = both(lambda page: page.context.set_offline(True), lambda page: page.wait_for_timeout(STALE_MS))
    card = both(parts, click('.components button[data-name="nut_1"]'), click("#close-side"))
    video = both(click("#transports input[value=video]"), lambda page: page.wait_for_timeout(6000))
    open_files = both(parts, click('[data-tab="files"]'))
    open_devices = both(parts, click('[data-tab="devices"]'))
    revoke = both(open_devices, lambda page: page.wait_for_timeout(500), click(".devices li:nth-child(2) button"))
    form = component_of_job()
    chosen_photo = component_of_job(
        lambda page: page.select_option("#job-photo", "0002.jpg"),
        evaluate("document.querySelector('#job .job-photo').scrollIntoView({ block: 'center' })"),
    )
    buttons = component_of_job(
        evaluate("document.querySelector('#job .job-photo').scrollIntoView({ block: 'center' })")
    )
    said = {"is_ok": False, "reason": "Scrap", "note": "bent in transport", "by": "M. Lang"}
    to_devices = evaluate("document.querySelector('#devices').scrollIntoView()")
    return [
        Shot("loading", before=answers("/api/part", loading), ready=message),
        Shot("searching", told=searching, ready=state.format("searching")),
        Shot("tracked"),
        Shot("missing", told={"components": {"post_1": absent, "bracket_1": displaced, "boss_1": ComponentPresence()}}),
        Shot("withheld", told={"more": unsure}, ready="!document.querySelector('#labels .banner').hidden"),
        Shot("critical", told={"more": unsure_pose}, ready=state.format("critical")),
        Shot("lost", told={"more": {"state": TrackingState.LOST, **unposed}}, ready=state.format("lost")),
        Shot("stale", before=script(NO_WEBRTC), after=stale),
        Shot("stale parts", before=script(NO_WEBRTC), after=both(parts, stale)),
        Shot("no camera", before=refused("NotFoundError"), ready=message),
        Shot("camera denied", before=refused("NotAllowedError"), ready=message),
        Shot("busy", before=busy, ready=message),
        Shot("denied", before=denied, ready=message),
        Shot("no WebRTC", before=script(NO_WEBRTC), after=click("#notices .notice")),
        Shot("future", before=changed("/api/part", in_the_future), after=click("#notices .notice")),
        Shot("low disk", before=notice("disk_low", "warning", "1.2 GB are left for the recording: about 4 minutes")),
        Shot("frozen", after=click("#freeze")),
        Shot("parts", after=parts),
        Shot("view", after=view),
        Shot("files", before=files(), after=open_files),
        *(Shot(f"devices, {name}", size=shape, before=devices(), after=both(open_devices, to_devices), settings=one)
          for name, shape, one in (
              ("phone", PHONE, {}), ("small", SMALL, german), ("landscape", LANDSCAPE, {}), ("desk", DESK, german),
          )),
        Shot("devices, revoke", before=devices(), after=revoke),
        Shot("devices, revoke, landscape", size=LANDSCAPE, before=devices(), after=revoke, settings=german),
        Shot("card", after=card),
        Shot("serial", after=evaluate(SERIAL)),
        Shot("job", after=click("#open-job")),
        *(Shot(f"decision, {name}", size=shape, before=both(appearance(theme), decision()), after=form, settings=one)
          for name, shape, theme, one in (
              ("dark", PHONE, "dark", {}), ("light", PHONE, "light", {}), ("German", PHONE, "dark", german),
              ("German, light", PHONE, "light", german), ("desk", DESK, "dark", {}), ("desk, light", DESK, "light", {}),
              ("desk, German", DESK, "dark", german), ("desk, German, light", DESK, "light", german),
          )),
        *(Shot(f"decision, buttons, {name}", before=both(appearance(theme), decision()), after=buttons, settings=one)
          for name, theme, one in (("dark", "dark", {}), ("German, light", "light", german))),
        Shot("decision, photo, desk", size=DESK, before=decision(), after=chosen_photo),
        Shot("decision, photo", before=decision(), after=chosen_photo, settings=german),
        Shot("decision, made", before=decision(**said), after=component_of_job()),
        Shot("decision, made, German, light", before=both(appearance("light"), decision(**said)), settings=german,
             after=component_of_job()),
        Shot("zoomed, arrows", after=both(*[click("#zoom-in")] * 3)),
        Shot("station video", after=video),
        *(Shot(f"{theme}, {name}", before=both(appearance(theme, size), files()), after=after, size=shape)
          for theme, size, shape in styles
          for name, after in (("tracked", lambda page: None), ("parts", parts), ("view", view), ("files", open_files))),
        Shot("German", settings=german),
        Shot("German, view", settings=german, after=view, size=TALL),
        Shot("German, small", settings=german, size=SMALL),
        Shot("small", size=SMALL),
        Shot("tall", size=TALL),
        Shot("landscape", size=LANDSCAPE),
        Shot("landscape, small", size=SMALL[::-1]),
        Shot("landscape, parts", size=LANDSCAPE, after=parts),
        Shot("landscape, card", size=LANDSCAPE, after=card),
        Shot("desk", size=DESK),
        Shot("desk, light", size=DESK, before=appearance("light")),
        Shot("desk, contrast", size=DESK, before=appearance("contrast")),
        Shot("recording", after=both(click("#record"), lambda page: page.wait_for_timeout(2500))),
    ]  # fmt: skip


ADVICE: dict[str, Any] = {}
"""What every pose says of the capture."""


def patch_poses() -> None:
    """Let the poses of the station, which runs in this process, say `ADVICE`."""
    plain = documents.pose_document

    def told(*of: Any, **more: Any) -> dict[str, Any]:
        return {**plain(*of, **more), **({"capture": dict(ADVICE)} if ADVICE else {})}

    vars(clients)["pose_document"] = told


def photograph(chromium: Any, server: Running, shot: Shot, path: Path) -> list[str]:
    """Photograph a state; returns the errors that the page reported."""
    TOLD.update({"components": {}, "more": {}, **shot.told})
    ADVICE.update(shot.advice)
    width, height = shot.size
    given = {"locale": "en-US", "color_scheme": "dark", **shot.settings}
    context = chromium.new_context(viewport={"width": width, "height": height}, device_scale_factor=1, **given)
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    try:
        shot.before(page)
        page.goto(f"http://127.0.0.1:{server.port}/?token={server.token}")
        until(page, shot.ready)
        page.wait_for_timeout(1500)
        shot.after(page)
        page.wait_for_timeout(700)
        page.screenshot(path=path)
    finally:
        page.unroute_all(behavior="ignoreErrors")
        context.close()
        TOLD.update({"components": {}, "more": {}})
        ADVICE.clear()
    return errors


def sheets(pictures: list[tuple[str, Path]], folder: Path) -> list[Path]:
    """Contact sheets of named pictures."""
    height = round(TILE_PX * PHONE[1] / PHONE[0])
    font = ImageFont.load_default(16)
    made: list[Path] = []
    for first in range(0, len(pictures), COLUMNS * ROWS):
        sheet = Image.new("RGB", (COLUMNS * TILE_PX, ROWS * (height + CAPTION_PX)), (70, 74, 82))
        for i, (name, path) in enumerate(pictures[first : first + COLUMNS * ROWS]):
            picture = Image.open(path).convert("RGB")
            picture.thumbnail((TILE_PX - 8, height))
            left, top = i % COLUMNS * TILE_PX + 4, i // COLUMNS * (height + CAPTION_PX)
            ImageDraw.Draw(sheet).text((left, top + 2), name, (255, 255, 255), font=font)
            sheet.paste(picture, (left, top + CAPTION_PX))
        made.append(folder / f"sheet-{len(made) + 1}.jpg")
        sheet.save(made[-1], quality=88)
    return made


def main() -> int:
    parser = argparse.ArgumentParser(description="Photograph the live page in every state.")
    parser.add_argument("--only", nargs="*", default=[], metavar="WORD", help="states with one of these words")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/screens"), help="folder of the pictures")
    chosen = parser.parse_args()
    patch_poses()
    wanted = [
        one for one in (*shots(), *worker_shots()) if not chosen.only or any(word in one.name for word in chosen.only)
    ]
    chosen.output.mkdir(parents=True, exist_ok=True)
    pictures, failures = [], 0
    with (
        tempfile.TemporaryDirectory() as folder,
        told_station(Path(folder), *FILM_SIZE, has_numbers=False) as server,
        live_browser.browser(None) as chromium,
    ):
        for shot in wanted:
            path = chosen.output / f"{shot.name.replace(', ', '_').replace(' ', '_')}.png"
            try:
                errors = photograph(chromium, server, shot, path)
            except Exception as error:
                errors = [str(error).splitlines()[0]]
            else:
                pictures.append((shot.name, path))
            failures += bool(errors)
            print(f"{shot.name}: {'; '.join(errors) or 'photographed'}", flush=True)
    for path in sheets(pictures, chosen.output):
        print(path)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
