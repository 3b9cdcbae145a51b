"""The studio's page in a browser: opening it, waiting for it, and clicking true places of the part."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from helpers.studio_client import Studio

TIMEOUT_MS = 180_000
VIEWPORT = {"width": 1400, "height": 860}
WATCH = """
window.drawn = null;
document.addEventListener("arview:drawn", (event) => { window.drawn = event.detail; });
"""


class StudioPage:
    """An open page.

    Args:
        page: of Playwright.
        pictures: folder of the screenshots; the folder in ARVIEW_PICTURES takes its place.
    """

    def __init__(self, page: Any, pictures: Path) -> None:
        self.page = page
        self._pictures = Path(os.environ.get("ARVIEW_PICTURES", pictures))
        self._shots = 0

    def photograph(self, name: str) -> None:
        """Write a screenshot."""
        self.page.screenshot(path=self._pictures / f"{self._shots:02d}_{name}.png")
        self._shots += 1

    def tab(self, name: str) -> None:
        """Open a tab."""
        self.page.click(f'role=tab[name="{name}"]')

    def select(self, name: str, add: bool = False) -> None:
        """Click a component in the tree."""
        row = self.page.locator("#tree .leaf", has=self.page.get_by_text(name, exact=True))
        row.click(modifiers=["Control"] if add else [])

    def set(self, key: str, value: str) -> None:
        """Give the selection a value, and wait until the page has taken it."""
        control = self.page.locator(f'#settings [data-key="{key}"]')
        if key == "role":
            control.select_option(value)
        else:
            control.fill(value)
            control.press("Enter")
        self.settled()

    def settled(self) -> None:
        """Wait until no edit is under way."""
        self.page.wait_for_timeout(60)
        self.until("!document.body.classList.contains('is-editing')")

    def until(self, condition: str) -> None:
        """Wait until an expression is true; the page's policy forbids Playwright's own way."""
        end_s = time.monotonic() + TIMEOUT_MS / 1000
        while not self.page.evaluate(condition):
            assert time.monotonic() < end_s, f"not within {TIMEOUT_MS / 1000:.0f} s: {condition}"
            self.page.wait_for_timeout(100)

    def pixel(self, point_mm: list[float]) -> tuple[float, float]:
        """Where a point of the model is on the page, px, from the matrix of the picture that was drawn last."""
        self.page.wait_for_timeout(150)
        column_major = self.page.evaluate("window.drawn.clip_from_model")
        clip = np.array(column_major).reshape(4, 4).T @ np.array([*point_mm, 1.0])
        box = self.page.locator("#canvas").bounding_box()
        x, y = clip[:2] / clip[3]
        return box["x"] + 0.5 * (1 + x) * box["width"], box["y"] + 0.5 * (1 - y) * box["height"]

    def click(self, point_mm: list[float]) -> Any:
        """Click a point of the model; the features that are offered."""
        self.page.mouse.click(*self.pixel(point_mm))
        self.page.wait_for_selector("#picked:not([hidden]) li", timeout=TIMEOUT_MS)
        return self.page.locator("#picked li")


def is_trouble(said: Any) -> bool:
    """Whether the console tells of an error other than a refused edit, or a view that an edit has replaced."""
    is_expected = "status of 422" in said.text or "/api/views/" in said.location.get("url", "")
    return said.type == "error" and not is_expected


@contextmanager
def opened(chromium: Any, studio: Studio, pictures: Path) -> Iterator[StudioPage]:
    """The page, once the CAD is drawn; at the end it is checked that it raised no errors."""
    context = chromium.new_context(viewport=VIEWPORT, permissions=["camera"])
    context.set_default_timeout(TIMEOUT_MS)
    page = context.new_page()
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(f"error: {error}"))
    page.on("console", lambda said: troubles.append(said.text) if is_trouble(said) else None)
    page.add_init_script(WATCH)
    try:
        page.goto(studio.server.link)
        page.wait_for_selector("#loading", state="hidden")
        studio_page = StudioPage(page, pictures)
        studio_page.until("window.drawn && window.drawn.level === 'full'")
        yield studio_page
    finally:
        context.close()
    assert not troubles, troubles
