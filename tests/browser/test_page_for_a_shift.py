"""The page as a tool for a shift: languages, looks, names of controls, zoom, files, serials, camera, faults told."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PilImage

from helpers import live_browser
from helpers.live_browser import closed, difference_mask, number_in, outline_errors_px, screenshot, true_mask
from helpers.live_client import Running
from helpers.page import TIMEOUT_S, WATCH, changed, until
from helpers.told_station import told_station

pytestmark = [pytest.mark.browser, pytest.mark.slow]

WIDTH, HEIGHT = 640, 360
PHONE = {"width": 390, "height": 844}
ROOMY = {"width": 680, "height": 640}
LOADED = "document.querySelector('.components button') !== null"
TRACKED = "window.drawn?.pose?.state === 'tracked'"
FREE_POINT = """() => {
  for (let y = 160; y < 480; y += 8) for (let x = 100; x < 580; x += 8) {
    const near = [-16, 0, 16].flatMap((dx) => [-16, 0, 16].map((dy) => document.elementFromPoint(x + dx, y + dy)));
    if (near.every((one) => one.tagName === "CANVAS")) return [x, y];
  }
}"""
OWN_NAME = """
fetch('/api/devices').then((one) => one.json()).then((one) => one.devices.find((each) => each.is_this).name)"""
NO_WEBRTC = "delete globalThis.RTCPeerConnection"
NAMED_ROLES = {"button", "switch", "radio", "slider", "combobox", "textbox", "link", "progressbar", "meter", "checkbox"}
RATIO = """
(() => {
  const luminance = (color) => {
    const context = document.createElement('canvas').getContext('2d');
    context.fillStyle = color;
    context.fillRect(0, 0, 1, 1);
    const linear = [...context.getImageData(0, 0, 1, 1).data].slice(0, 3).map((v) => v / 255)
      .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const style = getComputedStyle(document.documentElement);
  return (a, b) => {
    const [x, y] = [a, b].map((name) => luminance(style.getPropertyValue(`--${name}`).trim()));
    return (Math.max(x, y) + 0.05) / (Math.min(x, y) + 0.05);
  };
})()
"""


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with told_station(tmp_path_factory.mktemp("station"), WIDTH, HEIGHT) as server:
        yield server


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with live_browser.browser(None, "--use-fake-device-for-media-stream") as running_browser:
        yield running_browser


@contextmanager
def opened(
    chromium: Any, server: Running, *scripts: str, route: Callable[[Any], None] | None = None, **settings: Any
) -> Iterator[Any]:
    """The open page; at the end it is checked that it raised no errors."""
    context = chromium.new_context(**{"viewport": ROOMY, "accept_downloads": True, **settings})
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    for script in (WATCH, *scripts):
        page.add_init_script(script)
    if route is not None:
        route(page)
    try:
        page.goto(f"http://127.0.0.1:{server.port}/?token={server.token}")
        yield page
    finally:
        page.unroute_all(behavior="ignoreErrors")
        context.close()
    assert not errors


def open_section(page: Any, name: str) -> None:
    page.evaluate(f"document.querySelector('#tabs [data-tab={name}]').click()")


def controls(page: Any, least: int = 8) -> list[tuple[str, str]]:
    """Role and name of every control in the accessibility tree."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    session.detach()
    found = [
        (node["role"]["value"], node.get("name", {}).get("value", "").strip())
        for node in nodes
        if not node["ignored"] and node["role"]["value"] in NAMED_ROLES
    ]
    assert len(found) >= least
    return found


# --- languages, looks, names ----------------------------------------------------------------------------


def test_every_control_has_a_name_and_german_is_complete(chromium: Any, station: Running) -> None:
    names: dict[str, dict[str, set[str]]] = {}
    for locale in ("en-US", "de-AT"):
        with opened(chromium, station, locale=locale, viewport=PHONE) as page:
            until(page, LOADED)
            found = names[locale[:2]] = {"picture": {name for _, name in controls(page)}}
            assert page.evaluate("document.documentElement.lang") == locale[:2]
            for section in ("job", "parts", "view", "files", "devices"):
                open_section(page, section)
                page.wait_for_timeout(400)
                assert all(name for _, name in controls(page)), (locale, section, controls(page))
                found[section] = {name for _, name in controls(page)}
            if locale == "en-US":
                page.evaluate("document.querySelector('.components button[data-name=nut_1]').click()")
                page.evaluate(
                    "import('/static/serial.js').then((one) => void one.askSerial({frame: () => null, seen: () => ''}))"
                )
                until(page, "document.querySelector('dialog[open]') !== null")
                assert all(name for _, name in controls(page, least=3))
    assert {"Freeze", "Snapshot", "Zoom in"} <= names["en"]["picture"]
    assert {"Anhalten", "Bild", "Vergrößern"} <= names["de"]["picture"]
    for section in ("picture", "view", "files", "devices"):
        words = {name for name in names["en"][section] if re.search(r"[a-z]{3}", name)}
        same = {one for one in words & names["de"][section] if "_" not in one}  # names of components
        assert len(same) <= 0.2 * len(words), (section, same)


@pytest.mark.parametrize(
    ("settings", "theme", "ratio"),
    [
        ({"color_scheme": "dark"}, "dark", 4.5),
        ({"color_scheme": "light"}, "light", 4.5),
        ({"contrast": "more"}, "contrast", 7.0),
    ],
)
def test_looks_follow_the_device_and_can_be_read(
    chromium: Any, station: Running, settings: dict[str, Any], theme: str, ratio: float
) -> None:
    with opened(chromium, station, **settings) as page:
        assert page.evaluate("document.documentElement.dataset.theme") == theme
        pairs = [
            ("text", "panel"),
            ("text", "raised"),
            ("muted", "panel"),
            ("muted", "raised"),
            ("on-accent", "accent"),
        ]
        for tone in ("pass", "fail", "undecided", "measured", "not-measured"):
            pairs += [(tone, "panel"), (tone, "raised"), ("ink", tone)]
        ratios = page.evaluate(
            f"pairs => {{ const ratio = {RATIO}; return pairs.map(([a, b]) => ratio(a, b)); }}", pairs
        )
        assert [pair for pair, value in zip(pairs, ratios, strict=True) if value < ratio] == []


def test_a_chosen_look_stays(chromium: Any, station: Running) -> None:
    with opened(chromium, station, color_scheme="dark", viewport=PHONE) as page:
        until(page, LOADED)
        open_section(page, "view")
        size_px = "parseFloat(getComputedStyle(document.querySelector('#side h2:not([hidden])')).fontSize)"
        before_px = page.evaluate(size_px)
        for choice in ("theme][value=contrast", "size][value=largest"):
            page.evaluate(f"document.querySelector('input[name={choice}]').click()")
        assert page.evaluate(size_px) == pytest.approx(1.45 * before_px)
        page.reload()
        until(page, LOADED)
        assert page.evaluate("document.documentElement.dataset.theme") == "contrast"
        assert page.evaluate(size_px) == pytest.approx(1.45 * before_px)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]


# --- zoom -----------------------------------------------------------------------------------------------


def test_the_overlay_is_exact_under_zoom(chromium: Any, station: Running) -> None:
    with opened(chromium, station) as page:
        until(page, TRACKED)
        for key in "le":
            page.keyboard.press(key)
        page.keyboard.press(" ")
        until(page, "document.body.dataset.state === 'frozen'")
        page.wait_for_timeout(300)
        number = number_in(screenshot(page), page.locator("#picture").bounding_box()["width"] / WIDTH)
        assert number is not None
        page.mouse.move(330, 330)
        for _ in range(4):
            page.mouse.wheel(0, -120)
        page.mouse.down()
        page.mouse.move(300, 300, steps=4)
        page.mouse.up()
        until(page, "document.querySelector('#picture').getBoundingClientRect().width > 1200")
        page.wait_for_timeout(1000)
        place = page.locator("#picture").bounding_box()
        assert place["width"] > 2 * WIDTH
        assert page.evaluate("document.querySelector('#zoom').getAttribute('aria-label')").startswith("Zoom 2.")

        def seen() -> np.ndarray:
            """What is in view between the bars."""
            shown = np.array(PilImage.open(io.BytesIO(page.screenshot())).convert("RGB"))
            return shown[rows, columns]

        bar, actions = (page.locator(name).bounding_box() for name in ("#bar", "#zoom"))
        rows = slice(round(bar["height"]) + 60, round(actions["y"]) - 4)
        columns = slice(0, ROOMY["width"])
        ghosted = seen()
        draws = page.evaluate("window.draws")
        page.keyboard.press("g")
        until(page, f"window.draws > {draws}")
        page.wait_for_timeout(300)
        found = closed(difference_mask(ghosted, seen(), 5), 1)
        whole = true_mask((round(place["height"]), round(place["width"])), number)
        top, left = rows.start - round(place["y"]), -round(place["x"])
        true = whole[top : top + found.shape[0], left : left + found.shape[1]]
        inner = np.s_[6:-6, 6:-6]  # at the border the outlines of the two are cut differently
        errors_px = outline_errors_px(found[inner], closed(true, 1)[inner])
        assert np.median(errors_px) < 1.5 and np.quantile(errors_px, 0.95) < 6.0
        page.keyboard.press("0")
        page.wait_for_timeout(300)
        assert page.locator("#picture").bounding_box()["width"] <= ROOMY["width"]


def test_double_tap_and_pinch(chromium: Any, station: Running) -> None:
    width = "document.querySelector('#picture').getBoundingClientRect().width"
    with opened(chromium, station, has_touch=True, viewport=ROOMY) as page:
        until(page, TRACKED)
        whole_px = page.evaluate(width)
        page.mouse.dblclick(*page.evaluate(FREE_POINT))  # a tap on a label chooses its component
        until(page, f"{width} > {2 * whole_px}")
        assert page.locator("#card").is_hidden(), "the first of two taps chose a component"
        page.mouse.dblclick(*page.evaluate(FREE_POINT))
        until(page, f"Math.abs({width} - {whole_px}) < 2")
        session = page.context.new_cdp_session(page)
        for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 100), ("touchEnd", None)):
            points = (
                []
                if apart is None
                else [{"x": 340 + side * apart, "y": 320, "id": k} for k, side in enumerate((-1, 1))]
            )
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        until(page, f"Math.abs({width} / {whole_px} - 2.5) < 0.2")


def test_a_wide_picture_is_enlarged_around_the_part_on_a_tall_screen(chromium: Any, station: Running) -> None:
    with opened(chromium, station, viewport=PHONE) as page:
        until(page, TRACKED)
        until(page, "document.querySelector('#picture').getBoundingClientRect().width > 1.4 * innerWidth")
        until(page, "document.querySelectorAll('#labels .label:not(.off)').length >= 3")
        # The whole part is in view, and failing components out of view are pointed to.
        assert page.evaluate("document.querySelectorAll('#leaders .pointer[visibility=visible]').length") == 0
        page.click("#zoom-fit")
        until(page, "document.querySelector('#picture').getBoundingClientRect().width <= innerWidth + 1")
        assert page.get_attribute("#zoom-fit", "aria-label") == "Follow the part"
        for _ in range(4):
            page.click("#zoom-in")
        for _ in range(20):
            page.keyboard.press("Shift+ArrowRight")
        pointers = "[...document.querySelectorAll('#leaders .pointer[visibility=visible]')]"
        pointers += ".map((one) => one.getBoundingClientRect().left)"
        until(page, f"{pointers}.length > 0")
        assert all(left < 60 for left in page.evaluate(pointers)), "what is out of view lies to the left"
        assert page.evaluate("document.querySelectorAll('#labels .label.fail:not(.off)').length") == 1


# --- files, serial numbers, camera ----------------------------------------------------------------------


def test_files_are_listed_opened_and_shared(chromium: Any, station: Running) -> None:
    created = datetime.now(UTC).isoformat()
    film = {
        "number": 7,
        "name": "film.mp4",
        "bytes": 3_400_000,
        "seconds": 61.0,
        "created": created,
        "is_recovered": True,
    }
    job = {
        "id": "j 1",
        "part": "plate",
        "serial": "A1",
        "created": created,
        "stage": "done",
        "verdict": "fail",
        "photos": 24,
        "parent": None,
    }

    def route(page: Any) -> None:
        page.route("**/api/recordings", lambda route: route.fulfill(json={"recordings": [film]}))
        page.route("**/api/recordings/7", lambda route: route.fulfill(body=b"0123", content_type="video/mp4"))
        page.route("**/api/jobs", lambda route: route.fulfill(json={"jobs": [job]}))
        page.route(
            "**/api/snapshots",
            lambda route: route.fulfill(status=500, json={"error": "x", "message": "the disk is gone"}),
        )

    sharing = """
    window.shared = [];
    navigator.canShare = () => true;
    navigator.share = async ({ files: [file] }) => { window.shared.push([file.name, file.size]); };"""
    with opened(chromium, station, sharing, route=route, viewport=PHONE) as page:
        until(page, TRACKED)
        with page.expect_download(timeout=60_000):
            page.click("#snapshot")
        open_section(page, "files")
        until(page, "document.querySelectorAll('.files li').length === 3")
        text = page.inner_text("#file-lists")
        for said in (
            "film.mp4",
            "1:01",
            "3.4 MB",
            "recovered after a crash",
            "plate A1",
            "FAIL",
            "24 photos",
            "bracket_plate_BP-0417",
            "the disk is gone",
        ):
            assert said in text, said
        assert page.get_attribute(".files a[aria-label='Open plate A1']", "href") == "/api/jobs/j%201/report.html"
        page.click("[aria-label='Share film.mp4']")
        until(page, "window.shared.length === 1")
        assert page.evaluate("window.shared[0]") == ["film.mp4", 4]
        page.reload()  # snapshots stay in this browser
        until(page, LOADED)
        open_section(page, "files")
        until(page, "document.querySelectorAll('.files li').length === 3")


def test_paired_devices_are_listed_and_revoked(chromium: Any, station: Running) -> None:
    with opened(chromium, station, viewport=PHONE) as lent, opened(chromium, station, viewport=PHONE) as page:
        until(lent, LOADED)
        until(page, LOADED)
        own = page.evaluate(OWN_NAME)
        other = lent.evaluate(OWN_NAME)
        assert own != other
        open_section(page, "devices")
        until(page, "document.querySelectorAll('.devices li').length >= 2")
        assert page.locator(".devices li[aria-current=true] .name").all_inner_texts() == [own]
        assert "this device" in page.inner_text(".devices li[aria-current=true]")
        assert "last seen just now" in page.inner_text(f".devices li:has([aria-label='Revoke {other}'])")
        revoke = page.get_by_role("button", name=f"Revoke {other}", exact=True)
        for refuse in (lambda: page.keyboard.press("Enter"), lambda: page.keyboard.press("Escape")):
            revoke.click()
            dialog = page.get_by_role("alertdialog", name=f"Revoke {other}?")
            assert dialog.is_visible()
            refuse()  # "Keep it" has the focus
            until(page, "document.querySelector('dialog') === null")
            assert lent.evaluate("fetch('/api/devices').then((one) => one.status)") == 200
        revoke.click()
        page.get_by_role("button", name="Yes, revoke it").click()
        until(page, f"document.querySelector('#toast').textContent === '{other} is no longer paired'")
        until(page, f"![...document.querySelectorAll('.devices .name')].some((one) => one.textContent === '{other}')")
        assert lent.evaluate("fetch('/api/devices').then((one) => one.status)") == 403
        until(lent, "document.querySelector('#message').textContent.includes('no longer valid')")
        page.get_by_role("button", name=f"Revoke {own}", exact=True).click()
        assert "the device that you are using" in page.inner_text("dialog")
        page.get_by_role("button", name="Yes, revoke it").click()
        until(page, "document.querySelector('#message').textContent.includes('no longer valid')")


def test_a_serial_number_is_typed_scanned_or_taken_over(chromium: Any, station: Running) -> None:
    detector = """
    window.codes = [];
    window.BarcodeDetector = class {
      static async getSupportedFormats() { return ['qr_code']; }
      async detect() { return window.codes.map((rawValue) => ({ rawValue })); }
    };"""
    ask = """
    const frame = () => document.createElement('canvas'), seen = () => window.seen ?? '';
    void import('/static/serial.js').then((one) => one.askSerial({ frame, seen }))
      .then((serial) => { window.serial = serial; });"""
    ask = f"(() => {{ {ask} }})()"
    with opened(chromium, station, detector) as page:
        page.evaluate(ask)
        page.get_by_label("Serial number of the part").fill("BP-1")
        page.keyboard.press("Enter")
        until(page, "window.serial === 'BP-1'")
        page.evaluate(ask)
        page.get_by_role("button", name="Scan a code").click()
        assert page.get_by_role("button", name="Use this number").is_disabled()
        page.evaluate("window.codes = ['BP-2']")
        until(page, "document.querySelector('#serial-number')?.value === 'BP-2'")
        page.get_by_role("button", name="Use this number").click()
        until(page, "window.serial === 'BP-2'")
        page.evaluate("window.seen = 'BP-3'")
        page.evaluate(ask)
        page.get_by_role("button", name="Use BP-3, read from the part").click()
        until(page, "window.serial === 'BP-3'")
        page.evaluate(ask)
        page.get_by_role("button", name="Cancel").click()
        until(page, "window.serial === null")


def test_camera_controls_are_those_that_the_camera_has(chromium: Any, station: Running) -> None:
    capable = """
    window.applied = [];
    const range = { min: -2, max: 2, step: 0.5 };
    MediaStreamTrack.prototype.getCapabilities = () => ({
      torch: true, exposureCompensation: range, focusMode: ['continuous', 'manual'],
      focusDistance: { min: 0.1, max: 1, step: 0.1 },
    });
    MediaStreamTrack.prototype.getSettings = () => ({ focusMode: 'continuous', focusDistance: 0.1 });
    MediaStreamTrack.prototype.applyConstraints = async (wanted) => { window.applied.push(wanted.advanced[0]); };"""
    phone = changed("/api/part", lambda part: part.update(source="phone"))
    with opened(chromium, station, capable, route=phone) as page:
        until(page, "document.querySelector('#torch') !== null")
        page.evaluate("document.querySelector('#torch').click()")
        page.evaluate(
            "(() => { const one = document.querySelector('#camera-exposure');"
            " one.value = 1; one.dispatchEvent(new Event('input')); })()"
        )
        page.evaluate("document.querySelector('#focus-auto').click()")
        until(page, "window.applied.length >= 3 && !document.querySelector('#camera-focus').disabled")
        wanted = [{"torch": True}, {"exposureCompensation": 1}, {"focusMode": "manual", "focusDistance": 0.1}]
        assert [one for one in wanted if one not in page.evaluate("window.applied")] == []
        assert page.get_attribute("#torch", "aria-checked") == "true"
    with opened(chromium, station, route=phone) as page:
        until(page, "document.querySelector('#camera').srcObject !== null")
        page.wait_for_timeout(500)
        assert page.evaluate("document.querySelector('#torch')") is None


# --- faults told ----------------------------------------------------------------------------------------


def test_figures_of_a_server_that_is_gone_are_old(chromium: Any, station: Running) -> None:
    with opened(chromium, station, NO_WEBRTC) as page:
        until(page, TRACKED)
        assert not page.evaluate("document.body.classList.contains('is-stale')")
        page.context.set_offline(True)
        until(page, "document.body.classList.contains('is-stale')")
        until(page, r"/^figures of [1-9]\d* s ago$/.test(document.querySelector('#figures-stale').textContent)")
        assert (
            "the station does not respond" in page.inner_text(".stale-note", timeout=1000 * TIMEOUT_S)
            or page.locator(".stale-note").text_content()
        )
        page.context.set_offline(False)
        until(page, f"{TRACKED} && !document.body.classList.contains('is-stale')")


def test_an_inspection_from_the_future_and_a_browser_without_webrtc_are_named(chromium: Any, station: Running) -> None:
    def ahead(part: dict[str, Any]) -> None:
        made = datetime.now(UTC) + timedelta(days=3)
        part["inspection"] |= {"created": made.isoformat(), "age_s": -3 * 86400}

    with opened(chromium, station, NO_WEBRTC, route=changed("/api/part", ahead)) as page:
        until(page, TRACKED)
        page.click("#notices .notice")
        text = page.inner_text("#notices")
        assert "Inspection from the future: it is dated 3 d later than now" in text
        assert "This browser has no WebRTC" in text and "network blocks" not in text
        assert "JPEG over HTTP" in page.text_content("#link-state")


@pytest.mark.parametrize(
    ("name", "text"), [("NotAllowedError", "Allow it for this page"), ("NotFoundError", "Connect one")]
)
def test_a_camera_that_is_denied_or_missing(chromium: Any, station: Running, name: str, text: str) -> None:
    refuse = f"navigator.mediaDevices.getUserMedia = () => Promise.reject(new DOMException('', '{name}'));"
    phone = changed("/api/part", lambda part: part.update(source="phone"))
    with opened(chromium, station, refuse, route=phone) as page:
        until(page, "!document.querySelector('#message').hidden")
        assert text in page.inner_text("#message")
        assert page.get_by_role("button", name="Try again").is_visible()


def test_module_texts_fall_back_to_english(chromium: Any, station: Running, tmp_path: Path) -> None:
    with opened(chromium, station, locale="fr-FR") as page:
        until(page, LOADED)
        assert page.evaluate("document.documentElement.lang") == "en"
        assert page.inner_text("#freeze") == "Freeze"
