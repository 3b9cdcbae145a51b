"""The live page in Chromium, Firefox and WebKitGTK on phone screens: it draws, and every control can be used."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import live_browser
from helpers.live_client import Running
from helpers.told_station import told_station
from helpers.web_driver import Browser, ChromiumPage, firefox, until, webkit

pytestmark = [pytest.mark.browser, pytest.mark.slow]

WIDTH, HEIGHT = 640, 360
SCREENS = [(360, 640), (430, 932)]
"""The smallest and the largest of today's phones."""
MIN_TOUCH_PX = 44
SETTLED_S = 0.6
LABELS = "[...document.querySelectorAll('#labels .label:not(.off), #labels .sign:not(.off)')]"
CONTROLS = """
const all = [...document.querySelectorAll('#actions button, #zoom button, #confirms button')];
const shown = all.filter((one) => one.getClientRects().length && getComputedStyle(one).visibility === 'visible');
return shown.map((one) => {
  const { left, top, right, bottom } = one.getBoundingClientRect();
  const hit = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
  return { id: one.id, left, top, right, bottom, isHit: one.contains(hit) };
});
"""
IN_SHEET = """
const side = document.querySelector('#side'), box = side.getBoundingClientRect();
const own = ['button', 'input', 'label'].map((one) => `section.is-open ${one}`);
const shown = [...side.querySelectorAll([...own, '#tabs button', '#close-side'].join())];
return {
  left: box.left, right: box.right, overflow: side.scrollWidth - side.clientWidth,
  outside: shown.filter((one) => one.getClientRects().length)
    .map((one) => [one.id || one.textContent, one.getBoundingClientRect()])
    .filter(([, { left, right }]) => left < box.left - 1 || right > box.right + 1).map(([name]) => name),
  count: shown.length,
};
"""


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A station camera that plays the sample."""
    with told_station(tmp_path_factory.mktemp("station"), WIDTH, HEIGHT) as server:
        yield server


@pytest.fixture(scope="module", params=["chromium", "firefox", "webkit"])
def browser(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp(request.param) / "profile"
    if request.param == "chromium":
        with live_browser.browser(None) as chromium:
            yield ChromiumPage(chromium.new_page())
        return
    opened: Callable[[Path], Any] = {"firefox": firefox, "webkit": webkit}[request.param]
    with opened(folder) as other:
        yield other


@pytest.fixture(scope="module")
def page(browser: Browser, station: Running) -> Browser:
    """The page of the station, with the part tracked."""
    browser.resize(*SCREENS[0])
    browser.go(f"http://127.0.0.1:{station.port}/?token={station.token}")
    until(browser, "document.body.dataset.state === 'tracked'")
    return browser


@pytest.mark.parametrize("size", [*SCREENS, *((height, width) for width, height in SCREENS)], ids=str)
def test_picture_overlay_and_controls_on_every_screen(page: Browser, size: tuple[int, int]) -> None:
    page.resize(*size)
    until(page, f"document.body.dataset.state === 'tracked' && {LABELS}.length > 0")
    assert page.run("return document.documentElement.scrollWidth - innerWidth") <= 0, "it scrolls to the side"
    picture = page.run(
        "const box = document.querySelector('#picture').getBoundingClientRect();"
        "return [box.left, box.top, box.right, box.bottom]"
    )
    left, top, right, bottom = (max(0, round(value)) for value in picture)
    shown = page.screenshot()
    assert abs(shown.shape[1] - size[0]) <= 1
    assert shown[top : min(bottom, size[1]), left : min(right, size[0])].std() > 20, "there is no picture"
    controls = page.run(CONTROLS)
    assert {"open-parts", "snapshot", "freeze", "record", "open-view", "zoom-in"} <= {one["id"] for one in controls}
    for one in controls:
        assert one["left"] >= 0 and one["top"] >= 0 and one["right"] <= size[0] and one["bottom"] <= size[1], one
        assert min(one["right"] - one["left"], one["bottom"] - one["top"]) >= MIN_TOUCH_PX and one["isHit"], one
    for section in ("parts", "view"):
        page.run(f"document.querySelector('#open-{section}').click()")
        until(page, "getComputedStyle(document.querySelector('#side')).opacity === '1'")
        sheet = page.run(IN_SHEET)
        assert sheet["count"] > 3 and sheet["outside"] == [] and sheet["overflow"] <= 0, (section, sheet)
        assert sheet["left"] >= 0 and sheet["right"] <= size[0]
        page.run("document.querySelector('#close-side').click()")
    assert page.run("return globalThis.arviewErrors") == []


def test_the_ghost_is_drawn(page: Browser) -> None:
    page.resize(*SCREENS[1])
    if page.name == "webkit":
        page.run("document.querySelector('#notices .notice').click()")
        assert "this browser has no webrtc" in page.run("return document.querySelector('#notices').textContent").lower()
        page.run("document.querySelector('#notices .notice').click()")
    until(page, f"document.body.dataset.state === 'tracked' && {LABELS}.length > 0")
    page.run("document.querySelector('#freeze').click()")
    until(page, "document.body.dataset.state === 'frozen'")
    try:
        pictures = []
        for _ in range(2):
            page.run("for (const name of ['ghost', 'edges']) document.querySelector(`#show-${name}`).click()")
            time.sleep(SETTLED_S)
            pictures.append(page.screenshot().astype(int))
    finally:
        page.run("document.querySelector('#freeze').click()")
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 12).sum() > 500, "there is no ghost"
    assert page.run("return globalThis.arviewErrors") == []
