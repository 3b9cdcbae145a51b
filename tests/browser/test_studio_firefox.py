"""The studio in Firefox by WebDriver: from a bare STEP file to a tracked clip without a text editor."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PilImage

from arview.cad.part_file import load_part
from helpers.studio_client import running_studio
from helpers.web_driver import Firefox, firefox, until

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SAMPLE = Path(__file__).parents[2] / "samples" / "bracket_plate"
RIM_MM = 0.3
"""Outside the rim of a hole of 12 mm, where the plate's top is clicked."""
TIMEOUT_S = 180.0
CONTROL, ENTER = "\ue009", "\ue007"
WATCH = """
document.addEventListener('arview:drawn', (event) => {
  document.documentElement.dataset.drawn = JSON.stringify([...(event.wrappedJSObject ?? event).detail.clip_from_model]);
});
"""


class Page:
    """The studio's page in Firefox; the pictures go to the folder in ARVIEW_PICTURES where it is given."""

    def __init__(self, browser: Firefox, pictures: Path) -> None:
        self.browser = browser
        self._pictures = Path(os.environ.get("ARVIEW_PICTURES", pictures))
        self._shots = 0

    def until(self, condition: str) -> Any:
        return until(self.browser, condition, TIMEOUT_S)

    def photograph(self, name: str) -> None:
        time.sleep(0.6)
        PilImage.fromarray(self.browser.screenshot()).save(self._pictures / f"ff_{self._shots:02d}_{name}.png")
        self._shots += 1

    def text(self, selector: str) -> str:
        return str(self.browser.run(f"return document.querySelector({selector!r})?.innerText ?? ''"))

    def click(self, found: str, key: str = "") -> None:
        """Click the middle of an element, which an expression finds."""
        self.until(f"({found})?.getClientRects().length > 0")
        self.browser.run(f"({found}).scrollIntoView({{ block: 'nearest' }})")
        middle = self.browser.run(
            f"const {{ left, top, width, height }} = ({found}).getBoundingClientRect();"
            " return [left + width / 2, top + height / 2];"
        )
        self.browser.drag_mouse((middle[0], middle[1]), key=key)

    def tab(self, name: str) -> None:
        self.click(f"document.getElementById('tab-{name.lower()}')")

    def select(self, name: str, key: str = "") -> None:
        leaves = "[...document.querySelectorAll('#tree .leaf')]"
        self.click(f"{leaves}.find((one) => one.querySelector('.name').textContent === {name!r})", key)

    def fill(self, selector: str, value: str) -> None:
        """Type a value over what is there, and wait until the page has taken it."""
        self.until(f"document.querySelector({selector!r})?.getClientRects().length > 0")
        self.browser.run(f"document.querySelector({selector!r}).select()")
        self.browser.send_keys(selector, f"{value}{ENTER}")
        self.settled()

    def settled(self) -> None:
        time.sleep(0.15)
        self.until("!document.body.classList.contains('is-editing')")

    def pixel(self, point_mm: list[float]) -> tuple[float, float]:
        """Where a point of the model is on the page, px."""
        time.sleep(0.4)
        drawn, x, y, width, height = self.browser.run(
            "const { left, top, width, height } = document.getElementById('canvas').getBoundingClientRect();"
            " return [JSON.parse(document.documentElement.dataset.drawn), left, top, width, height];"
        )
        clip = np.array(drawn).reshape(4, 4).T @ np.array([*point_mm, 1.0])
        u, v = clip[:2] / clip[3]
        return x + 0.5 * (1 + u) * width, y + 0.5 * (1 - v) * height

    def make_datum(self, point_mm: list[float], feature: str, label: str) -> None:
        """Click a point of the model, and make the feature that is offered there a datum."""
        self.browser.drag_mouse(self.pixel(point_mm))
        self.until("document.querySelector('#picked:not([hidden]) li')")
        rows = "[...document.querySelectorAll('#picked li')]"
        self.photograph(f"offered_{label}")
        self.click(f"{rows}.find((one) => one.innerText.includes({feature!r})).querySelector('[data-label={label}]')")
        self.settled()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Firefox]:
    with firefox(tmp_path_factory.mktemp("firefox") / "profile") as running:
        running.resize(1360, 860)
        yield running


def test_from_a_bare_step_file_to_a_tracked_clip(browser: Firefox, tmp_path: Path) -> None:
    folder = tmp_path / "bracket"
    folder.mkdir()
    (folder / "bracket.step").write_bytes((SAMPLE / "bracket_plate.step").read_bytes())
    page = Page(browser, tmp_path)
    with running_studio(folder / "bracket.step") as studio:
        browser.go(studio.server.link)
        browser.run(WATCH)
        page.until("document.getElementById('loading').hidden")
        page.photograph("opened")
        page.select("base_plate")
        browser.send_keys("#settings [data-key=role]", "base")
        page.settled()
        for name in ("post_1", "post_2", "post_3", "nut_1"):
            page.select(name, "" if name == "post_1" else CONTROL)
        page.fill("#settings [data-key=position_tolerance_mm]", "0.8")
        page.photograph("roles_and_tolerances")

        page.tab("Datums")
        page.click("document.querySelector('[data-look=top]')")
        page.make_datum([0.0, -70.0, 0.0], "plane", "A")
        for label, x in (("B", -97.0), ("C", 97.0)):
            page.make_datum([x, -67.0 + 6.0 + RIM_MM, 0.0], "hole ⌀12.000", label)
        page.click("document.querySelector('[data-look=iso]')")
        page.photograph("datums")
        datums = {row["label"]: row for row in studio.get("/api/part")["datums"]}
        assert datums["A"]["feature"] == "plane" and abs(datums["A"]["point_mm"][2]) < 1e-4
        assert datums["B"]["point_mm"] == pytest.approx([-97.0, -67.0, 0.0], abs=1e-4)
        assert datums["C"]["point_mm"] == pytest.approx([97.0, -67.0, 0.0], abs=1e-4)

        page.tab("Range")
        wanted = {
            "distance_mm": (400, 660),
            "elevation_deg": (20, 68),
            "azimuth_deg": (-160, 30),
            "roll_deg": (-30, 30),
        }
        for key, ends in wanted.items():
            for side, value in enumerate(ends):
                page.fill(f'[data-key="{key}-{side}"]', f"{value}")
        drag_greatest_azimuth(page, -15.0)
        page.photograph("range")
        dragged = studio.get("/api/part")["view_range"]
        assert dragged["azimuth_deg"] == [-160.0, pytest.approx(-15.0, abs=2.0)]

        page.tab("Views")
        page.until("document.querySelector('#verdict.pass')")
        page.until("[...document.querySelectorAll('.tile img')].slice(0, 6).every((one) => one.naturalWidth)")
        page.photograph("views")
        assert page.text(".verdict-box").startswith("sufficient")
        page.tab("Photos")
        page.until("document.querySelector('tr[data-name=post_1]')")
        page.photograph("photos")
        assert "±0.8 mm" in page.text("tr[data-name=post_1]")

        page.tab("Trial")
        page.fill("[data-key=fov]", "59")
        browser.send_keys("#trial-file", str(SAMPLE / "clip.mp4"))
        page.until("document.querySelector('.trial-state') && document.querySelector('.result img').naturalWidth > 0")
        page.photograph("trial")
        found, of = (int(word) for word in page.text(".trial-state").split() if word.isdigit())
        assert of == 60 and found >= 57

        browser.press_keys(CONTROL, "s")
        page.until("document.getElementById('unsaved').hidden")
        page.click("document.querySelector('#export summary')")
        page.photograph("export_menu")
        page.click("document.querySelector('[data-kind=gv]')")
        page.until("document.querySelector('#toast.info:not([hidden])')?.innerText.includes('.gv')")
        page.tab("Text")
        page.photograph("saved")
        browser.resize(390, 844)
        page.photograph("narrow")
        assert browser.run("return document.documentElement.scrollWidth <= innerWidth")
        browser.resize(1360, 860)
    saved = load_part(folder / "part.toml")
    assert saved.component_settings("base_plate").role == "base"
    assert saved.component_settings("nut_1").position_tolerance_mm == 0.8
    assert [datum.label for datum in saved.datums] == ["A", "B", "C"]
    assert saved.view_range is not None and saved.view_range.distance_mm == (400.0, 660.0)
    assert list(folder.glob("*.gv"))


def drag_greatest_azimuth(page: Page, azimuth_deg: float) -> None:
    """Drag that border of the shell to an azimuth, at the height where its handle is."""
    left, top, width, height = page.browser.run(
        "const all = [...document.querySelectorAll('[role=slider]')];"
        " const one = all.find((one) => one.ariaLabel === 'Greatest azimuth');"
        " const { left, top, width, height } = one.getBoundingClientRect(); return [left, top, width, height];"
    )
    azimuth, elevation = np.deg2rad([azimuth_deg, 44.0])
    level = np.cos(elevation)
    eye = np.array([0.0, 0.0, 26.0]) + 400.0 * np.array(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    )
    start, end = np.array([left + width / 2, top + height / 2]), np.array(page.pixel(eye.tolist()))
    way = [start + share * (end - start) for share in np.linspace(0.0, 1.0, 7)]
    page.browser.drag_mouse(*[(float(x), float(y)) for x, y in way])
    page.settled()
