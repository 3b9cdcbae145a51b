"""The report in a browser: it works under its own Content-Security-Policy, which stops what did not come with it."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from arview.cad import load_part
from arview.report import make_report
from helpers.live_browser import browser
from helpers.live_sample import INSPECTION, PART

WATCH = """
window.violations = [];
document.addEventListener("securitypolicyviolation", (event) => {
  window.violations.push(`${event.violatedDirective} ${event.blockedURI} ${event.sample}`);
});
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    page = tmp_path_factory.mktemp("report") / "report.html"
    make_report(INSPECTION, page, part=load_part(str(PART)))
    return page


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser(None) as running:
        yield running


def opened(chromium: Any, path: Path) -> tuple[Any, list[str]]:
    """The page of a file, and what its console says."""
    page = chromium.new_page(viewport={"width": 1100, "height": 900})
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.add_init_script(WATCH)
    page.goto(path.as_uri())
    return page, said


def test_the_report_works_under_its_policy(chromium: Any, report: Path) -> None:
    page, said = opened(chromium, report)
    page.wait_for_selector("#viewer.live canvas", timeout=60_000)
    page.locator("#viewer canvas").scroll_into_view_if_needed()
    page.wait_for_timeout(500)
    png = page.locator("#viewer canvas").screenshot()
    drawn = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
    assert np.unique(drawn.reshape(-1, 3), axis=0).shape[0] > 20  # the part, not only the background
    page.click("button[data-view=top]")
    page.wait_for_timeout(500)
    assert page.locator("#viewer canvas").screenshot() != png  # the controls work
    assert "Inter" in page.evaluate("getComputedStyle(document.body).fontFamily")
    assert page.evaluate("document.fonts.check('16px Inter')")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert page.evaluate("[...document.querySelectorAll('details')].every((one) => one.open)")
    assert page.locator("svg[role=img]").count() >= 1 and page.locator("[style]:not(#viewer *)").count() == 0
    assert page.evaluate("window.violations") == []
    assert not [text for text in said if "Content Security Policy" in text or "Refused" in text], said
    page.close()


def test_what_did_not_come_with_the_report_does_not_run(chromium: Any, report: Path, tmp_path: Path) -> None:
    foreign = (
        "<script>window.ran = true</script><img src=x onerror='window.ran = true'>"
        "<img src='http://127.0.0.1:9/pixel.png'><p style='color: red'>x</p></main>"
    )
    changed = tmp_path / "changed.html"
    changed.write_text(report.read_text(encoding="utf-8").replace("</main>", foreign, 1), encoding="utf-8")
    page, _ = opened(chromium, changed)
    page.wait_for_selector("#viewer.live canvas", timeout=60_000)
    assert page.evaluate("window.ran === undefined")
    kinds = {text.split()[0] for text in page.evaluate("window.violations")}
    assert {"script-src-elem", "script-src-attr", "img-src", "style-src-attr"} <= kinds
    page.close()


def test_surfaces_that_no_two_photos_saw_are_hatched(chromium: Any, tmp_path: Path) -> None:
    """With photos from one side only, most of the part is hatched; the switch removes the hatching."""
    from dataclasses import replace

    from arview.camera import Camera
    from arview.core.progress import Progress
    from arview.geometry import look_at
    from arview.reconstruction.types import PosedPhoto, SparseModel
    from arview.report.evidence import gather
    from arview.report.page import build_context, render

    part = load_part(str(PART))
    middle, diameter = part.model.center_in_model, part.model.diameter_mm
    camera = Camera(800, 600, 900.0, 900.0, 399.5, 299.5)
    eyes = [middle + 2.0 * diameter * np.array([0.7, 0.1 * k, 0.7]) for k in range(3)]
    poses = [look_at(eye, middle, np.array([0.0, 0.0, 1.0])) for eye in eyes]
    photos = tuple(PosedPhoto(f"{k}.jpg", tmp_path, camera, pose) for k, pose in enumerate(poses))
    none, ints = np.zeros((0, 3)), np.zeros(0, np.int32)
    sparse = SparseModel(photos, none, none.astype(np.uint8), np.zeros(0), ints, ints, np.zeros((0, 2)))
    quiet: Progress = lambda what, done, total: None  # noqa: E731
    evidence = gather(INSPECTION, part)
    context = build_context(evidence, quiet)
    from arview.report.page import _viewer

    context |= _viewer(replace(evidence, sparse=sparse))
    path = tmp_path / "report.html"
    path.write_text(render(context, for_print=False), encoding="utf-8")
    page, said = opened(chromium, path)
    page.wait_for_selector("#viewer.live canvas", timeout=60_000)
    page.locator("#viewer canvas").scroll_into_view_if_needed()
    page.wait_for_timeout(500)

    def hatched() -> float:
        """Share of pixels in the colour of the hatching."""
        rgb = np.asarray(Image.open(io.BytesIO(page.locator("#viewer canvas").screenshot())).convert("RGB")).astype(int)
        return float(np.mean((rgb[..., 0] > rgb[..., 2] + 60) & (rgb[..., 1] > rgb[..., 2] + 40)))

    with_hatching = hatched()
    page.click("input[name=uncovered]")
    page.wait_for_timeout(500)
    without = hatched()
    page.click("input[name=uncovered]")
    page.click("button[data-view=right]")
    page.wait_for_timeout(500)
    assert with_hatching > without + 0.005, (with_hatching, without)
    assert not [text for text in said if "rror" in text], said
    page.close()
