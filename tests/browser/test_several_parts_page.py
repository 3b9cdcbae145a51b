"""The page with two specimens in a real browser: ghosts, labels without overlaps, states, confirmation, recording."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.camera import Camera
from arview.camera.read import save_camera
from arview.pose import ComponentPresence, Identity, Pose, Presence, TrackingState, Visibility
from arview.station.live.stream.subjects import Subjects
from arview.video import Image, VideoSink
from helpers import live_browser, two_specimens
from helpers.live_client import Running, running, wait
from helpers.live_sample import INSPECTION, loader, options
from helpers.page import WATCH, opened, until

FPS = 5
NAMES = ("bracket_plate#1", "bracket_plate#2")
BOXES = """[...document.querySelectorAll('#labels .label:not(.off)')].map((one) => {
  const { left, top, right, bottom } = one.getBoundingClientRect();
  return [left, top, right, bottom, one.querySelector('.mark').textContent];
})"""


class TrueSession:
    """Both specimens at their true poses; what is told of the second one changes."""

    camera: Camera | None = None
    estimate = None

    def __init__(self, names: list[str]) -> None:
        self.components = dict.fromkeys(names, ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0))
        self.confirmed: list[int | None] = []
        self.second = {"identity": Identity.UNCONFIRMED, "identity_reason": "it was out of sight"}

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        film = two_specimens.frames()
        _, truths = film[order()[index % len(order())]]
        return tuple(
            Pose(
                truth, np.eye(6), 0.9, TrackingState.TRACKED, time_s, index, 1.0, instance=name,
                components=self.components, **(self.second if name == NAMES[1] else {}),
            )
            for name, truth in zip(NAMES, truths, strict=True)
        )  # fmt: skip

    def expect(self, serials: Any) -> None:
        pass

    def reset(self, part: int | None) -> None:
        pass

    def confirm(self, part: int | None) -> None:
        self.confirmed.append(part)
        self.second = {"identity": Identity.CONFIRMED}

    def finish(self) -> None:
        pass


def order() -> list[int]:
    return live_browser.there_and_back(len(two_specimens.frames()))


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with live_browser.browser(None) as running_browser:
        yield running_browser


@pytest.fixture
def session() -> Iterator[TrueSession]:
    made: list[TrueSession] = []

    def start(subjects: Subjects, camera: Camera) -> TrueSession:
        made[0].camera = camera
        made[0].components = dict.fromkeys(
            [one.name for one in subjects[0].part.model.components], next(iter(made[0].components.values()))
        )
        return made[0]

    made.append(TrueSession(["any"]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Subjects, "session", start)
        yield made[0]


@pytest.fixture
def station(session: TrueSession, tmp_path: Path) -> Iterator[Running]:
    """Two inspected specimens before a station camera."""
    camera = two_specimens.wide_camera()
    save_camera(camera, tmp_path / "camera.json")
    with VideoSink(tmp_path / "film.mp4", camera.width, camera.height, FPS) as sink:
        for count, k in enumerate(order()):
            sink.write(two_specimens.frames()[k][0], count / FPS)
    record = json.loads(INSPECTION.read_text())
    record["created"] = (datetime.now(UTC) - timedelta(minutes=30)).strftime("%Y-%m-%dT%H:%M:%SZ")
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text(json.dumps(record))
    chosen = options(
        source=str(tmp_path / "film.mp4"), camera=str(tmp_path / "camera.json"), record_folder=tmp_path,
        inspections=(tmp_path / "a.json", tmp_path / "b.json"),
    )  # fmt: skip
    with running(chosen, loader(chosen, instances=2)) as server:
        yield server


def overlapping(boxes: list[list[Any]]) -> list[tuple[Any, Any]]:
    return [
        (one, other)
        for k, one in enumerate(boxes)
        for other in boxes[:k]
        if one[0] < other[2] - 1 and other[0] < one[2] - 1 and one[1] < other[3] - 1 and other[1] < one[3] - 1
    ]


def test_each_part_has_its_ghost_its_labels_and_its_button(
    chromium: Any, station: Running, session: TrueSession, tmp_path: Path
) -> None:
    with opened(chromium, station, WATCH, {"width": 1280, "height": 800}) as page:
        until(page, "window.drawn?.pose?.parts?.length === 2 && window.drawn.pose.isPosed")
        page.wait_for_timeout(1500)
        # The second one waits for its confirmation: no label and no number is on it.
        boxes = page.evaluate(BOXES)
        assert len(boxes) >= 3 and {one[4] for one in boxes} == {"●"}
        assert not overlapping(boxes)
        tags = page.evaluate("[...document.querySelectorAll('#labels .tag:not(.off)')].map((one) => one.textContent)")
        assert tags == [f"● {NAMES[0]}", f"▲ {NAMES[1]}"]
        rows = page.locator("#specimens li").all_text_contents()
        assert all(name in row and "Tracked" in row for name, row in zip(NAMES, rows, strict=True))
        assert "it was out of sight" in rows[1] and "it was out of sight" not in rows[0]
        assert f"to be confirmed: ▲ {NAMES[1]}" in page.locator("#state-why").text_content()
        assert page.locator("#confirms button:visible").all_text_contents() == [f"▲This is {NAMES[1]}2"]
        panels = page.locator(".panel").all_text_contents()
        assert len(panels) == 2 and " mm" in panels[0] and " mm" not in panels[1]
        page.keyboard.press("c")
        until(page, "document.querySelector('#confirms').offsetHeight === 0")
        assert session.confirmed == [1]
        page.wait_for_timeout(1500)
        boxes = page.evaluate(BOXES)
        assert {one[4] for one in boxes} == {"●", "▲"} and not overlapping(boxes)
        assert all(" mm" in text for text in page.locator(".panel").all_text_contents())
        assert ghosts_are_there(page)
        # A component of the second specimen, by itself.
        page.locator(".panel").nth(1).locator("button[data-name=boss_1]").evaluate("one => one.click()")
        until(page, f"{BOXES}.length === 1")
        assert page.evaluate(BOXES)[0][4] == "▲"
        until(page, lambda: station.hub.watched()[1].style.only_part == 1)  # type: ignore[index]
        page.keyboard.press("Escape")
        page.keyboard.press("r")
        until(page, "document.querySelector('#record').getAttribute('aria-pressed') === 'true'")
        page.wait_for_timeout(2500)
        page.keyboard.press("r")
        until(page, "document.querySelector('#record').getAttribute('aria-pressed') === 'false'")
    # The poses are closed after the film.
    (path,) = wait(lambda: list(tmp_path.glob("live_*.jsonl")))
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert len(lines) >= 4 and [one["instance"] for one in lines] == [*NAMES] * (len(lines) // 2)
    assert path.with_suffix(".mp4").stat().st_size > 10_000


def ghosts_are_there(page: Any) -> bool:
    """Whether the ghosts of both specimens change the picture, in its left and in its right half."""
    page.keyboard.press("l")
    page.keyboard.press(" ")
    until(page, "document.body.dataset.state === 'frozen'")
    page.wait_for_timeout(500)
    with_ghost = live_browser.screenshot(page).astype(int)
    page.keyboard.press("g")
    page.keyboard.press("e")
    page.wait_for_timeout(500)
    changed = np.abs(live_browser.screenshot(page).astype(int) - with_ghost).max(axis=2) > 12
    for key in ("g", "e", "l", " "):
        page.keyboard.press(key)
    middle = changed.shape[1] // 2
    return bool(changed[:, :middle].mean() > 0.03 and changed[:, middle:].mean() > 0.03)


def test_on_a_narrow_screen_nothing_overlaps_and_all_states_are_there(
    chromium: Any, station: Running, session: TrueSession
) -> None:
    with opened(chromium, station, WATCH, {"width": 360, "height": 740}) as page:
        until(page, "window.drawn?.pose?.parts?.length === 2 && window.drawn.pose.isPosed")
        session.second = {"identity": Identity.CONFIRMED}
        until(page, f"new Set({BOXES}.map((one) => one[4])).size === 2")
        page.wait_for_timeout(1500)
        boxes = page.evaluate(BOXES)
        assert 2 <= len(boxes) <= 4 and not overlapping(boxes)
        assert all(one[0] >= 0 and one[2] <= 360 for one in boxes)
        assert page.locator("#specimens li:visible").count() == 2
        assert page.evaluate("document.querySelector('#specimens').scrollWidth") <= 360
