"""The page in a real browser: alignment of the overlay with each transport, messages, buttons."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image as PilImage

from arview.camera import Camera
from arview.overlay.guide import GUIDE_RGB
from arview.pose import ComponentPresence, Identity, Presence, Visibility
from arview.station.live.stream.stamp import Stamp, stamp_strip
from arview.station.live.stream.subjects import Subjects
from arview.video import VideoSink
from helpers import live_browser
from helpers.live_browser import closed, difference_mask, number_in, outline_errors_px, screenshot, true_mask
from helpers.live_client import Running, running
from helpers.live_sample import INSPECTION, loader, options
from helpers.page import WATCH, opened, until
from helpers.told_session import TOLD, Told, numbered_session

WIDTH, HEIGHT, FPS = 640, 360, 5
COLOUR_GAP_PX = 7
"""A video has its colours at half the resolution, and its encoder smooths them: in narrower slots and holes the ghost
and what is seen through it are one."""
TRACKING = Subjects.session
"""The session that tracks."""
FREEZES = 6
"""Frames that may be frozen before one with an overlay is."""
MEDIAN_PX, MAX_PX = 1.5, 4.0
"""Of the ghost's outline; of the part itself nothing may be further off in nineteen of twenty places."""


@pytest.fixture(scope="module", autouse=True)
def told_sessions() -> Iterator[None]:
    """Sessions say what the tests want; the ghost of what they do not verify would be too faint to be measured."""

    def session(subjects: Subjects, camera: Camera) -> Any:
        return Told(numbered_session(subjects, camera), [one.name for one in subjects[0].part.model.components])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Subjects, "session", session)
        yield


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The film that Chromium plays as its camera."""
    path = tmp_path_factory.mktemp("film") / "part.y4m"
    images = live_browser.frames(WIDTH, HEIGHT)
    live_browser.write_y4m(path, [images[k] for k in live_browser.there_and_back()], FPS)
    return path


@pytest.fixture(scope="module")
def chromium(film: Path) -> Iterator[Any]:
    with live_browser.browser(film) as running_browser:
        yield running_browser


@pytest.fixture(scope="module")
def inspection(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's inspection with a recent date."""
    path = tmp_path_factory.mktemp("inspection") / "inspection.json"
    write_inspection(path, timedelta(minutes=30))
    return path


def write_inspection(path: Path, age: timedelta, **changes: Any) -> None:
    """Write the sample's inspection with a given age."""
    record = json.loads(INSPECTION.read_text())
    record["created"] = (datetime.now(UTC) - age).strftime("%Y-%m-%dT%H:%M:%SZ")
    path.with_suffix(".new").write_text(json.dumps({**record, **changes}))
    path.with_suffix(".new").replace(path)


@pytest.fixture(scope="module")
def server(inspection: Path) -> Iterator[Running]:
    chosen = options(inspection=inspection, clients=1, record_folder=inspection.parent)
    with running(chosen, loader(chosen)) as one:
        yield one


def choose(page: Any, transport: str, link: str, mode: str) -> None:
    """Choose a transport and wait until the page is connected and the part is tracked."""
    page.locator(f"#transports input[value={transport}]").evaluate("input => input.click()")
    until(page, f"document.querySelector('#link-state').textContent.startsWith('Connected by {link}, {mode}')")
    until(page, "window.drawn?.pose?.state === 'tracked'")


def freeze(page: Any) -> int:
    """Freeze a frame with an overlay; returns the number that the film shows in it.

    A frame that was dropped on the way has none, as on a slow machine: then the next one is frozen.
    """
    for _ in range(FREEZES):
        until(page, "window.drawn?.pose?.state === 'tracked' && window.drawn.pose.cam_from_model !== null")
        page.keyboard.press(" ")
        until(page, "document.body.dataset.state === 'frozen'")
        page.wait_for_timeout(300)
        if page.evaluate("window.drawn.pose !== null"):
            picture = screenshot(page)
            number = number_in(picture, picture.shape[1] / WIDTH)
            assert number is not None
            return number
        page.keyboard.press(" ")
        until(page, "document.body.dataset.state !== 'frozen'")
    raise AssertionError(f"{FREEZES} times frozen without a ghost")


def nearest_frame(found: np.ndarray, number: int, gap_px: int = 1) -> int:
    """The frame, of ``number`` and those beside it, whose true outline is nearest to that of the overlay.

    Narrow gaps are ignored. It is checked that the overlay is about where the part is in the frame shown.
    """
    near = [n for n in (number - 1, number, number + 1) if 0 <= n < live_browser.COUNT]
    found = closed(found, gap_px)
    errors_px = {n: outline_errors_px(found, closed(true_mask(found.shape, n), gap_px)) for n in near}
    assert np.median(errors_px[number]) < MEDIAN_PX
    assert np.quantile(errors_px[number], 0.95) < MAX_PX
    return min(near, key=lambda n: float(np.mean(errors_px[n])))


@pytest.mark.parametrize(("transport", "link"), [("poses", "WebRTC"), ("jpeg", "JPEG over HTTP")])
def test_ghost_lies_on_the_part(chromium: Any, server: Running, transport: str, link: str) -> None:
    with opened(chromium, server, WATCH) as page:
        choose(page, transport, link, "poses")
        page.keyboard.press("l")
        page.keyboard.press("e")
        number = freeze(page)
        ghosted = screenshot(page)
        page.keyboard.press("g")
        page.wait_for_timeout(500)
        plain = screenshot(page)
        nearest = nearest_frame(difference_mask(ghosted, plain, 5), number)
        assert nearest == number, "the ghost belongs to another frame"


def test_annotated_video(chromium: Any, server: Running) -> None:
    with opened(chromium, server, WATCH) as page:
        choose(page, "video", "WebRTC", "annotated video")
        page.keyboard.press("l")
        page.keyboard.press("e")
        page.locator("#opacity").evaluate("e => { e.value = 0.9; e.dispatchEvent(new Event('input')); }")
        page.wait_for_timeout(1500)
        nearest = []
        for _ in range(3):
            until(page, "window.drawn?.isAnnotated && window.drawn.pose !== null")
            number = freeze(page)
            assert page.evaluate("window.drawn.isAnnotated")
            shown = screenshot(page)
            height, width = shown.shape[:2]
            plain = cv2.resize(live_browser.frames(WIDTH, HEIGHT)[number], (width, height))
            found = difference_mask(shown, plain, 25, blur_px=5)
            # Without the counter and the frame around a frozen picture.
            found[: height // 8] = found[-8:] = found[:, :8] = found[:, -8:] = 0
            nearest.append(nearest_frame(found, number, COLOUR_GAP_PX) - number)
            page.keyboard.press(" ")
            until(page, "document.body.dataset.state !== 'frozen'")
        # A hurried encoder renews the counter before all of the ghost, so that one frame of three may be mixed.
        assert sorted(nearest)[1] == 0 and np.count_nonzero(nearest) <= 1, "the ghost belongs to another frame"


def test_station_camera(chromium: Any, inspection: Path, tmp_path: Path) -> None:
    """The page shows a station: plain pictures and poses arrive and belong together."""
    path = tmp_path / "station.mp4"
    images = live_browser.frames(WIDTH, HEIGHT)
    with VideoSink(path, WIDTH, HEIGHT, FPS) as sink:
        for count, k in enumerate(live_browser.there_and_back()):
            sink.write(images[k], count / FPS)
    chosen = options(source=str(path), inspection=inspection)
    with running(chosen, loader(chosen)) as station, opened(chromium, station, WATCH) as page:
        until(page, "window.drawn?.pose?.state === 'tracked'")
        assert page.evaluate("document.querySelector('#camera').srcObject === null"), "the page took its own camera"
        page.keyboard.press("l")
        page.keyboard.press("e")
        number = freeze(page)
        ghosted = screenshot(page)
        page.keyboard.press("g")
        page.wait_for_timeout(500)
        assert nearest_frame(difference_mask(ghosted, screenshot(page), 5), number) == number


def test_labels_and_parts_say_what_is_seen(chromium: Any, inspection: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = np.eye(4)
    moved[1, 3] = 35.0
    absent = ComponentPresence(Presence.MISSING, Visibility.VISIBLE, 0.01, 9, 40.0)
    displaced = ComponentPresence(Presence.DISPLACED, Visibility.VISIBLE, 0.01, 9, 40.0, moved)
    kinds = {"post_1": absent, "boss_1": ComponentPresence(), "bracket_1": displaced}
    monkeypatch.setitem(TOLD, "components", kinds)
    chosen = options(inspection=inspection, clients=1)
    shown = "[...document.querySelectorAll('#labels .label:not(.off)')]"
    with running(chosen, loader(chosen)) as server, opened(chromium, server, WATCH) as page:
        until(page, f"{shown}.some((one) => one.textContent.includes('MISSING'))")
        until(page, f"{shown}.some((one) => one.textContent.includes('DISPLACED'))")
        texts = page.evaluate(f"{shown}.map((one) => [one.textContent, one.classList.contains('dimmed')])")
        by_name = {name: text for text in texts for name in kinds if name in text[0]}
        assert "changed since measured" in by_name["post_1"][0] and "mm" not in by_name["post_1"][0]
        assert "≈ 35 mm away" in by_name["bracket_1"][0] and "PASS" not in by_name["bracket_1"][0]
        rows = {row.get_attribute("data-name"): row.text_content() for row in page.locator(".components button").all()}
        assert "MISSING" in rows["post_1"] and "FAIL" not in rows["post_1"]
        assert "PASS, measured, not verified here" in rows["boss_1"]
        legend = page.locator("#labels .legend").text_content()
        assert all(text in legend for text in ("missing here", "displaced", "not verified here"))
        assert "INCOMPLETE: 1 missing, 1 displaced" in page.locator(".tally").text_content()

        more = {"identity": Identity.UNCONFIRMED, "identity_reason": "two plates are in view"}
        monkeypatch.setitem(TOLD, "more", more)
        until(page, "!document.querySelector('#labels .banner').hidden")
        assert page.evaluate(f"{shown}.length") == 0
        assert "two plates are in view" in page.locator("#labels .banner").text_content()
        assert "PASS" not in page.locator("#parts").text_content()
        assert " mm" not in page.locator(".components").text_content()


def test_the_user_confirms_the_part(chromium: Any, inspection: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "another part of this kind is in view; confirm that this is the one"
    asked: list[str] = []

    def confirm(self: Told, part: int | None) -> None:
        asked.append("confirm")
        TOLD["more"] = {"identity": Identity.CONFIRMED}

    monkeypatch.setattr(Told, "confirm", confirm, raising=False)
    chosen = options(inspection=inspection, clients=1)
    shown = "[...document.querySelectorAll('#labels .label:not(.off)')]"
    with running(chosen, loader(chosen)) as one, opened(chromium, one) as page:
        until(page, "document.getElementById('state-name').textContent === 'Tracked'")
        assert page.locator("#confirm").is_hidden()
        page.keyboard.press("c")
        try:
            for ask in (lambda: page.click("#confirm"), lambda: page.keyboard.press("c")):
                asked.clear()
                TOLD["more"] = {"identity": Identity.UNCONFIRMED, "identity_reason": reason}
                until(page, lambda: page.locator("#confirm").is_visible())
                until(page, lambda: reason in page.inner_text("#state"))
                assert not asked
                assert page.evaluate(f"{shown}.length") == 0
                ask()
                until(page, lambda: page.locator("#confirm").is_hidden())
                assert asked == ["confirm"]
                until(page, f"{shown}.length > 0")
        finally:
            TOLD["more"] = {}


def test_labels_and_parts_say_what_was_measured(chromium: Any, server: Running) -> None:
    record = {one["name"]: one for one in json.loads(INSPECTION.read_text())["components"]}
    words = {"pass": "PASS", "fail": "FAIL", "undecided": "UNDECIDED"}
    with opened(chromium, server, WATCH) as page:
        until(page, "document.querySelectorAll('.components button').length === 11")
        rows = {row.get_attribute("data-name"): row.text_content() for row in page.locator(".components button").all()}
        for name, one in record.items():
            for text in (f"{one['distance_mm']:.2f} mm", f"U {one['uncertainty_mm']:.2f}", words[one["verdict"]]):
                assert text in rows[name], (text, rows[name])
        assert list(rows)[:2] == ["post_1", "nut_1"], "what failed comes first"

        until(page, "window.drawn?.pose?.state === 'tracked'")
        until(page, "document.querySelectorAll('#labels .label:not(.off)').length >= 4")
        labels = page.evaluate(
            """[...document.querySelectorAll('#labels .label:not(.off)')].map((one) =>
                [one.textContent, one.querySelector('svg').classList[1]])"""
        )
        for said, sign in labels:
            one = next(one for name, one in record.items() if name in said)
            for text in (f"{one['distance_mm']:.2f} mm", f"U {one['uncertainty_mm']:.2f}", words[one["verdict"]]):
                assert text in said.replace("\u00a0", " "), (text, said)
            assert sign == f"icon-{one['verdict']}", "a shape says the verdict too"

        page.locator(".components button[data-name=nut_1]").evaluate("e => e.click()")
        card = page.locator("#card")
        assert all(
            text in card.inner_text() for text in ("nut_1", "UNDECIDED", "0.45 mm", "U 0.12 mm", "tolerance 0.5 mm")
        )
        until(page, "document.querySelectorAll('#labels .label:not(.off), #labels .sign:not(.off)').length === 1")
        page.keyboard.press("ArrowRight")
        assert page.locator("#card .title").inner_text().startswith("bracket_1")
        page.keyboard.press("Escape")
        assert not card.is_visible()


def test_labels_stay_apart(chromium: Any, server: Running) -> None:
    """For every shape of the screen: labels are inside it and do not overlap, and buttons are large enough."""
    with opened(chromium, server, WATCH) as page:
        until(page, "window.drawn?.pose?.state === 'tracked'")
        for width, height in ((390, 844), (844, 390), (1280, 800), (320, 568)):
            page.set_viewport_size({"width": width, "height": height})
            draws = page.evaluate("window.draws")
            until(page, f"window.innerWidth === {width} && window.draws > {draws + 2}")
            until(page, "document.querySelectorAll('#labels .label:not(.off)').length >= 2")
            checked = 0
            for _ in range(4):
                page.wait_for_timeout(250)
                checked += check_labels(page, width, height)
            assert checked >= 2
            check_buttons(page)


def check_labels(page: Any, width: int, height: int) -> int:
    """Check that labels are inside the screen, and that neither labels nor signs hide a label; returns their number."""
    boxes, signs = page.evaluate(
        """['.label', '.sign'].map((kind) => [...document.querySelectorAll(`#labels ${kind}:not(.off)`)].map((one) => {
            const {left, top, right, bottom} = one.getBoundingClientRect(); return [left, top, right, bottom]; }))"""
    )
    for left, top, right, bottom in signs:
        for box in boxes:
            apart = max(box[0] - right, left - box[2], box[1] - bottom, top - box[3])
            assert apart > -1.0, f"a sign hides a label by {-apart:.0f} px at {width} x {height}"
    for i, (left, top, right, bottom) in enumerate(boxes):
        assert left >= 0 and top >= 0 and right <= width and bottom <= height, (width, height)
        for other in boxes[:i]:
            assert right <= other[0] or left >= other[2] or bottom <= other[1] or top >= other[3], (width, height)
    return len(boxes)


def check_buttons(page: Any) -> None:
    for name in ("snapshot", "freeze", "record"):
        box = page.locator(f"#{name}").bounding_box()
        assert min(box["width"], box["height"]) >= 56
        assert page.get_by_role("button", name=name.capitalize()).count() == 1


def test_snapshot_and_recording(chromium: Any, server: Running) -> None:
    with opened(chromium, server, WATCH) as page:
        until(page, "window.drawn?.pose?.state === 'tracked'")
        page.keyboard.press(" ")
        until(page, "document.body.dataset.state === 'frozen'")
        with page.expect_download(timeout=60_000) as download:
            page.locator("#snapshot").click()
        picture = PilImage.open(download.value.path())
        about = json.loads(picture.text["arview"])
        assert picture.size == (WIDTH, HEIGHT)
        assert about["frame_id"] == page.evaluate("window.drawn.id")
        assert about["inspection"]["components"]["post_1"]["verdict"] == "fail"
        assert download.value.suggested_filename.startswith("bracket_plate_BP-0417_")

        page.locator("#record").click()
        until(page, "document.querySelector('#record').getAttribute('aria-pressed') === 'true'")
        page.wait_for_timeout(1500)
        page.locator("#record").click()
        until(page, "!document.querySelector('#toast').hidden && document.querySelector('#toast a') !== null")
        with page.expect_download(timeout=60_000) as download:
            page.locator("#toast a").click()
        assert len(Path(download.value.path()).read_bytes()) > 10_000


def test_every_failure_has_a_message(chromium: Any, server: Running) -> None:
    """No camera, a busy server, no connection: each has a message, and the page recovers."""
    denied = "navigator.mediaDevices.getUserMedia = async () => { throw new DOMException('no', 'NotAllowedError'); };"
    with opened(chromium, server, denied) as page:
        until(page, "document.querySelector('#message').innerText.includes('may not use the camera')")
        with opened(chromium, server) as second:
            until(second, "document.querySelector('#message').innerText.includes('Busy')")
            assert "1 of 1" in second.inner_text("#message")
            page.close()
            until(second, "document.body.dataset.state === 'tracked'")


def test_connection_lost(chromium: Any, inspection: Path) -> None:
    chosen = options(inspection=inspection)
    with ExitStack() as pages:
        with running(chosen, loader(chosen)) as one:
            page = pages.enter_context(opened(chromium, one))
            until(page, "document.body.dataset.state === 'tracked'")
        until(page, "document.body.dataset.state === 'retrying'")
        assert "Connection lost, retrying" in page.inner_text("#message")


def test_inspection_changes(chromium: Any, tmp_path: Path) -> None:
    path = tmp_path / "inspection.json"
    write_inspection(path, timedelta(minutes=5))
    chosen = options(inspection=path)
    with running(chosen, loader(chosen)) as one, opened(chromium, one) as page:
        row = page.locator(".components button[data-name=post_1]")
        until(page, lambda: row.count() and "1.36 mm" in row.text_content())
        assert page.locator(".notice.strong").count() == 0
        record = json.loads(INSPECTION.read_text())
        changed = [
            {**one, **({"displacement_mm": [0.5, 0, 0], "distance_mm": 0.5, "verdict": "pass"} if k == 0 else {})}
            for k, one in enumerate(record["components"])
        ]
        write_inspection(path, timedelta(hours=50), components=changed)
        until(page, lambda: "0.50 mm" in row.text_content())
        until(page, "document.querySelector('.notice.strong')?.innerText.includes('Stale inspection')")
        path.write_text("{ this is no JSON")
        until(page, "document.querySelector('.notice.strong.error') !== null")
        assert "0.50 mm" in row.text_content(), "the last good one stays"


def test_outline_to_align_with(chromium: Any, inspection: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Subjects, "session", TRACKING)
    chosen = options(inspection=inspection, guide="az-30_el60_d640")
    with running(chosen, loader(chosen)) as one, opened(chromium, one, WATCH) as page:
        until(page, "document.body.dataset.state === 'align'")
        assert "yellow outline" in page.inner_text("#state")
        page.wait_for_timeout(500)
        shown = screenshot(page).astype(int)
        is_yellow = (np.abs(shown - GUIDE_RGB) < 40).all(axis=2)
        assert 800 < is_yellow.sum() < 0.2 * is_yellow.size


def test_the_bar_says_what_has_not_been_seen_yet(
    chromium: Any, server: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(TOLD, "more", {"unverified": ("boss_1",)})
    with opened(chromium, server, WATCH) as page:
        until(page, "window.drawn?.pose?.state === 'tracked' && window.drawn.pose.unverified.length > 0")
        until(page, lambda: "Not yet verified: boss_1" in page.inner_text("#state"))


def test_screen_that_watches(chromium: Any, server: Running) -> None:
    with opened(chromium, server) as page:
        until(page, "document.body.dataset.state === 'tracked'")
        watching = page.context.new_page()
        watching.goto(f"http://127.0.0.1:{server.port}/watch")
        until(page, lambda: watching.evaluate("document.querySelector('#film').naturalWidth") == WIDTH)
        assert not watching.is_visible("#message")


def test_modules_agree_with_the_server(chromium: Any, server: Running) -> None:
    """Stamp and camera model of the page agree with arview.station.live.stream.stamp and arview.camera."""
    lens = live_browser.camera(WIDTH, HEIGHT)
    points = np.random.default_rng(1).uniform([-250, -140, 450], [250, 140, 650], (50, 3))
    fields = {key: getattr(lens, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    with opened(chromium, server) as page:
        for stamp in (Stamp(0, 640, 360, 0), Stamp(987654, 1280, 720, 3), Stamp((1 << 20) - 1, 404, 718, 1)):
            drawn = page.evaluate(
                """async ([id, width, height, turns]) => {
                    const {drawStrip, readStamp, stripHeight} = await import("/static/transport/stamp.js");
                    const canvas = document.createElement("canvas");
                    [canvas.width, canvas.height] = [width, height + stripHeight(width)];
                    const context = canvas.getContext("2d");
                    drawStrip(context, {id, width, height, turns});
                    const {data} = context.getImageData(0, height, width, stripHeight(width));
                    return [data.filter((_, i) => i % 4 === 0).join(), readStamp(canvas, width, canvas.height)]; }""",
                [stamp.frame_id, stamp.width, stamp.height, stamp.quarter_turns_clockwise],
            )
            assert np.array_equal(np.array(drawn[0].split(","), dtype=int).reshape(-1, stamp.width), stamp_strip(stamp))
            assert drawn[1]["id"] == stamp.frame_id
            assert drawn[1]["turns"] == stamp.quarter_turns_clockwise
        pixels = page.evaluate(
            """async ([camera, points]) => {
                const {Intrinsics} = await import("/static/scene/projection.js");
                const lens = new Intrinsics(camera);
                return points.map((point) => {
                    const pixel = lens.project(point);
                    return [...pixel, ...lens.ideal(...pixel)]; }); }""",
            [{**fields, "dist": lens.dist.tolist()}, points.tolist()],
        )
        assert np.allclose(np.array(pixels)[:, :2], lens.project(points), atol=1e-9)
        assert np.allclose(np.array(pixels)[:, 2:], lens.without_distortion().project(points), atol=1e-6)


def test_leaders_on_the_page_do_not_cross(chromium: Any, server: Running) -> None:
    with opened(chromium, server) as page:
        counts = page.evaluate((Path(__file__).parent / "leader_crossings.js").read_text())
    assert counts["labels"] == 40 * 12
    assert counts["first"] > 0 and counts["last"] == 0
