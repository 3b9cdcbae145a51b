"""The studio in Chromium: from bare CAD to a part file and a part that is found, by pointing only."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from arview.cad.part_file import load_part
from helpers.live_browser import browser
from helpers.studio_client import running_studio
from helpers.studio_page import StudioPage, opened

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SAMPLE = Path(__file__).parents[2] / "samples" / "bracket_plate"
RIM_MM = 0.3
"""Outside the rim of a hole of 12 mm, where the plate's top is clicked."""
RECORD = """
window.levels = [];
document.addEventListener("arview:drawn", (event) => window.levels.push([event.detail.level, performance.now()]));
"""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser(None, "--use-fake-device-for-media-stream") as running:
        yield running


def become(offered: Any, feature: str, label: str) -> None:
    """Make a feature that is offered a datum."""
    offered.filter(has_text=feature).first.locator(f'[data-label="{label}"]').click()


def put_range(page: StudioPage, **intervals: tuple[float, ...]) -> None:
    for key, ends in intervals.items():
        for side, value in enumerate(ends):
            control = page.page.locator(f'[data-key="{key}-{side}"]')
            control.fill(f"{value:g}")
            control.press("Enter")
            page.settled()


def frame_of_the_clip(path: Path) -> Path:
    capture = cv2.VideoCapture(str(SAMPLE / "clip.mp4"))
    _, frame = capture.read()
    cv2.imwrite(str(path), frame)
    return path


def test_from_a_bare_step_file_to_a_tracked_part(chromium: Any, tmp_path: Path) -> None:
    folder = tmp_path / "bracket"
    folder.mkdir()
    (folder / "bracket.step").write_bytes((SAMPLE / "bracket_plate.step").read_bytes())
    with running_studio(folder / "bracket.step") as studio, opened(chromium, studio, tmp_path) as page:
        page.photograph("opened")
        page.select("base_plate")
        page.set("role", "base")
        for name in ("post_1", "post_2", "post_3", "nut_1"):
            page.select(name, add=name != "post_1")
        page.set("position_tolerance_mm", "0.8")
        page.photograph("roles_and_tolerances")

        page.tab("Datums")
        page.page.click("[data-look=top]")
        offered = page.click([0.0, -70.0, 0.0])
        page.photograph("plane_offered")
        become(offered, "plane", "A")
        page.settled()
        for label, x in (("B", -97.0), ("C", 97.0)):
            offered = page.click([x, -67.0 + 6.0 + RIM_MM, 0.0])
            assert "hole ⌀12.000" in offered.first.inner_text()
            become(offered, "hole", label)
            page.settled()
        become(page.click([97.0, -67.0 + 6.0 + RIM_MM, 0.0]), "hole", "feature")
        page.settled()
        page.page.click("[data-look=iso]")
        page.page.wait_for_timeout(300)
        page.photograph("datums")
        datums = {row["label"]: row for row in studio.get("/api/part")["datums"]}
        assert datums["A"]["feature"] == "plane" and abs(datums["A"]["point_mm"][2]) < 1e-4
        assert datums["B"]["point_mm"] == pytest.approx([-97.0, -67.0, 0.0], abs=1e-4)
        assert datums["C"]["point_mm"] == pytest.approx([97.0, -67.0, 0.0], abs=1e-4)
        assert datums["B"]["diameter_mm"] == pytest.approx(12.0, abs=1e-3)
        (feature,) = studio.get("/api/part")["features"]
        assert feature["label"] == "hole_1" and page.page.get_by_label("Remove feature hole_1").count() == 1

        page.tab("Range")
        put_range(page, distance_mm=(400.0, 660.0), elevation_deg=(20.0, 68.0), azimuth_deg=(-160.0, 30.0))
        drag_border(page, "Greatest azimuth", towards_azimuth=-15.0)
        dragged = studio.get("/api/part")["view_range"]
        assert dragged["azimuth_deg"][0] == -160.0 and dragged["azimuth_deg"][1] == pytest.approx(-15.0, abs=2.0)
        put_range(page, azimuth_deg=(-160.0, -15.0), roll_deg=(-30.0, 30.0))
        page.photograph("range")

        page.tab("Views")
        page.page.wait_for_selector(".tile")
        page.page.wait_for_selector("#verdict.pass")
        assert "sufficient" in page.page.inner_text(".verdict-box")
        page.until("[...document.querySelectorAll('.tile img')].slice(0, 6).every((one) => one.naturalWidth)")
        page.photograph("views")
        page.tab("Photos")
        page.page.wait_for_selector('tr[data-name="post_1"]')
        row = page.page.inner_text('tr[data-name="post_1"]')
        assert "±0.8 mm" in row and "/24" in row
        page.photograph("photos")

        page.tab("Trial")
        page.page.fill('[data-key="fov"]', "59")
        page.page.set_input_files("#trial-file", frame_of_the_clip(tmp_path / "frame.png"))
        page.page.wait_for_selector(".trial-state")
        page.until("document.querySelector('.result img').naturalWidth > 0")
        page.photograph("trial")
        assert page.page.inner_text(".trial-state") == "tracked"

        assert page.page.is_visible("#unsaved")
        page.page.click("#canvas", position={"x": 8, "y": 300})
        page.page.keyboard.press("Control+z")
        page.settled()
        assert studio.get("/api/part")["can_redo"]
        page.page.keyboard.press("Control+y")
        page.settled()
        page.page.keyboard.press("Control+s")
        page.page.wait_for_selector("#unsaved", state="hidden")
        page.tab("Text")
        page.photograph("saved")
    saved = load_part(folder / "part.toml")
    assert saved.component_settings("base_plate").role == "base"
    assert saved.component_settings("nut_1").position_tolerance_mm == 0.8
    assert [datum.label for datum in saved.datums] == ["A", "B", "C"]
    assert saved.view_range is not None
    assert saved.view_range.distance_mm == (400.0, 660.0) and saved.view_range.azimuth_deg == (-160.0, -15.0)


def drag_border(page: StudioPage, label: str, towards_azimuth: float) -> None:
    """Drag a border of the shell to an azimuth, at the height where the border's handle is."""
    handle = page.page.get_by_role("slider", name=label)
    box = handle.bounding_box()
    azimuth, elevation = np.deg2rad([towards_azimuth, 44.0])
    center = np.array([0.0, 0.0, 26.0])
    level = np.cos(elevation)
    eye = center + 400.0 * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    target = page.pixel(eye.tolist())
    page.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.page.mouse.down()
    page.page.mouse.move(*target, steps=6)
    page.page.mouse.up()
    page.settled()


def test_a_lone_block_is_insufficient_with_a_reason(chromium: Any, tmp_path: Path) -> None:
    (tmp_path / "block.stl").write_bytes(trimesh.creation.box((80, 50, 30)).export(file_type="stl"))
    (tmp_path / "part.toml").write_text('[part]\ncad = "block.stl"\nunit = "mm"\n')
    with running_studio(tmp_path / "part.toml") as studio, opened(chromium, studio, tmp_path) as page:
        assert page.page.inner_text("#tree .leaf .name") == "block"
        page.page.wait_for_selector("#verdict.fail")
        page.page.click("#verdict")
        text = page.page.inner_text(".verdict-box")
        assert text.startswith("insufficient") and "lines" in text
        assert page.page.locator(".tile.plain, .tile.alike").count() > 0
        page.photograph("block")


def test_the_plate_is_sufficient(chromium: Any, tmp_path: Path) -> None:
    with running_studio(SAMPLE.parent / "plate" / "part.toml") as studio, opened(chromium, studio, tmp_path) as page:
        page.page.wait_for_selector("#verdict.pass")
        assert page.page.inner_text("#verdict") == "Views: sufficient"
        page.page.click("#verdict")
        assert page.page.inner_text(".verdict-box b") == "sufficient"
        assert page.page.locator(".tile.fine").count() > 20
        page.photograph("plate")


def post_moved(path: Path, moved_mm: float) -> Path:
    """A plate with brackets and posts, one of which is moved."""
    boxes = [
        ((120, 80, 10), (0, 0, 0)), ((20, 30, 6), (-40, 0, 8)), ((6, 30, 40), (-50, 0, 25)), ((20, 30, 6), (30, 0, 8)),
        ((6, 30, 25), (20, 0, 18)), ((14, 14, 20), (45 - moved_mm, 25, 15)), ((9, 9, 30), (-10, -25, 20)),
    ]  # fmt: skip
    scene = trimesh.Scene()
    for size, center in boxes:
        scene.add_geometry(trimesh.creation.box(np.array(size) / 1000).apply_translation(np.array(center) / 1000))
    path.write_bytes(scene.export(file_type="glb"))
    return path


def test_two_parts_that_look_alike_are_confusable_with_each_other(chromium: Any, tmp_path: Path) -> None:
    """In amber and in words, in the bar and on the tab; a block beside is not."""
    left, right = post_moved(tmp_path / "left.glb", 0.0), post_moved(tmp_path / "right.glb", 4.0)
    (tmp_path / "block.stl").write_bytes(trimesh.creation.box((80, 50, 30)).export(file_type="stl"))
    (tmp_path / "block.toml").write_text('[part]\ncad = "block.stl"\nunit = "mm"\n')
    against = (right, tmp_path / "block.toml")
    with running_studio(left, *against) as studio, opened(chromium, studio, tmp_path) as page:
        page.page.wait_for_selector("#verdict.alike")
        assert page.page.inner_text("#verdict") == "Views: sufficient, confusable with right"
        assert page.page.locator("#verdict .icon-warning").count() == 1
        amber = page.page.evaluate("getComputedStyle(document.getElementById('verdict')).color")
        assert amber in ("rgb(255, 176, 32)", "rgb(163, 95, 0)")  # dark, light
        page.page.click("#verdict")
        assert page.page.inner_text(".verdict-box b") == "sufficient, confusable with right"
        (warning,) = page.page.locator(".verdict-box .warning").all_inner_texts()
        assert "confusable with right" in warning and "likeness" in warning
        assert "told apart from block" in page.page.inner_text(".verdict-box")
        page.page.wait_for_timeout(1000)
        page.photograph("left_against_right")
        page.page.set_viewport_size({"width": 390, "height": 844})
        page.page.wait_for_timeout(300)
        assert page.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.photograph("left_narrow")


def test_a_part_that_looks_the_same_after_a_turn(chromium: Any, tmp_path: Path) -> None:
    """Its views are confused with those from the other side, and the symmetry that causes this can be confirmed."""
    plate, pin = trimesh.creation.box((120, 60, 8)), trimesh.creation.cylinder(6, 24)
    rib = trimesh.creation.box((6, 34, 30))
    half = [(pin, (45, 15, 16)), (rib, (20, 5, 19)), (trimesh.creation.box((14, 10, 12)), (35, -18, 10))]
    turn = trimesh.transformations.rotation_matrix(np.pi, (0, 0, 1))
    placed = [mesh.copy().apply_translation(place) for mesh, place in half]
    whole = trimesh.util.concatenate([plate, *placed, *(mesh.copy().apply_transform(turn) for mesh in placed)])
    (tmp_path / "plate.stl").write_bytes(whole.export(file_type="stl"))
    (tmp_path / "part.toml").write_text(
        '[part]\ncad = "plate.stl"\nunit = "mm"\n[view_range]\ndistance_mm = [300.0, 500.0]\n'
        "elevation_deg = [20.0, 70.0]\n"
    )
    with running_studio(tmp_path / "part.toml") as studio, opened(chromium, studio, tmp_path) as page:
        page.tab("Views")
        page.page.wait_for_selector(".tile")
        assert page.page.locator(".tile.alike").count() > 20
        page.photograph("alike")
        page.tab("Symmetries")
        page.page.get_by_role("button", name="Confirm").first.click()
        page.until("document.body.innerText.includes('None that is not declared.')")
        page.settled()
        (symmetry,) = studio.get("/api/part")["symmetries"]
        assert symmetry["order"] == 2 and abs(symmetry["axis"][2]) == pytest.approx(1.0, abs=1e-3)
        page.photograph("symmetries")


def test_a_refused_edit_is_told_and_changes_nothing(chromium: Any, tmp_path: Path) -> None:
    (tmp_path / "block.stl").write_bytes(trimesh.creation.box((80, 50, 30)).export(file_type="stl"))
    (tmp_path / "part.toml").write_text('[part]\ncad = "block.stl"\nunit = "mm"\n')
    with running_studio(tmp_path / "part.toml") as studio, opened(chromium, studio, tmp_path) as page:
        page.tab("Range")
        put_range(page, elevation_deg=(95.0,))
        page.page.wait_for_selector("#toast:not([hidden])")
        assert "elevation_deg" in page.page.inner_text("#toast")
        assert page.page.input_value('[data-key="elevation_deg-0"]') == "-90"
        page.tab("Text")
        page.page.fill("textarea", "[part")
        page.page.get_by_role("button", name="Apply").click()
        page.until("document.getElementById('toast').textContent.includes('TOML')")
        assert page.page.input_value("textarea") == "[part"
        assert studio.get("/api/part")["can_undo"] is False
        page.photograph("refused")


def large_assembly(path: Path, columns: int, rows: int) -> None:
    """Pins and nuts on a plate: 2 columns × rows components in as many assemblies as columns."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((30.0 * columns, 30.0 * rows, 6.0)), node_name="plate", geom_name="plate")
    pin, nut = trimesh.creation.cylinder(4.0, 30.0, sections=96), trimesh.creation.annulus(5.0, 10.0, 8.0, sections=96)
    for column in range(columns):
        scene.graph.update(frame_to=f"row_{column}", matrix=np.eye(4))
        for row in range(rows):
            place = trimesh.transformations.translation_matrix(
                [30.0 * (column - columns / 2 + 0.5), 30.0 * (row - rows / 2 + 0.5), 18.0]
            )
            for kind, mesh in (("pin", pin), ("nut", nut)):
                name = f"{kind}_{column}_{row}"
                scene.add_geometry(
                    mesh, node_name=name, geom_name=name, parent_node_name=f"row_{column}", transform=place
                )
    path.write_bytes(scene.export(file_type="glb"))


def test_five_hundred_components(chromium: Any, tmp_path: Path) -> None:
    """The time to the first picture and of a drag are printed, since they are those of the machine."""
    large_assembly(tmp_path / "large.glb", 10, 25)
    (tmp_path / "part.toml").write_text('[part]\ncad = "large.glb"\nunit = "mm"\n')
    with running_studio(tmp_path / "part.toml") as studio:
        assert len(studio.document.cad.components) == 501
        before_s = time.monotonic()
        with opened(chromium, studio, tmp_path) as page:
            complete_s = time.monotonic() - before_s
            marks = "performance.getEntriesByType('mark').map((one) => [one.name, Math.round(one.startTime)])"
            print(f"complete after {complete_s:.1f} s; ms in the page: {page.page.evaluate(marks)}")
            page.photograph("large")
            assert page.page.locator("#tree .leaf").count() == 501
            page.page.fill("#search", "pin_3_")
            assert page.page.locator("#tree .leaf").count() == 25
            page.page.locator("#tree .branch", has_text="row_3").click()
            page.set("position_tolerance_mm", "0.4")
            page.photograph("large_selected")
            part = studio.get("/api/part")
            assert sum(row["position_tolerance_mm"] == 0.4 for row in part["components"]) == 25
            page.page.fill("#search", "")
            page.page.locator("#tree .branch", has_text="row_4").click()
            page.set("position_tolerance_mm", "0.6")
            part = studio.get("/api/part")
            assert sum(row["position_tolerance_mm"] == 0.6 for row in part["components"]) == 50
            assert part["text"].count("position_tolerance_mm = 0.6") == 1  # one table with a pattern
            box = page.page.locator("#canvas").bounding_box()
            page.page.evaluate(RECORD)
            page.page.mouse.move(box["x"] + 300, box["y"] + 200)
            page.page.mouse.down()
            for step in range(20):
                page.page.mouse.move(box["x"] + 300 + 8 * step, box["y"] + 200 + 3 * step)
            page.page.mouse.up()
            page.page.wait_for_timeout(500)
            levels = page.page.evaluate("window.levels")
            faces = sum(row["faces"] for row in part["components"])
            step_ms = np.median(np.diff([at_ms for _, at_ms in levels]))
            print(f"{faces} faces; {len(levels)} pictures while dragging, median of {step_ms:.0f} ms")
            assert {"coarse"} == {level for level, _ in levels[2:-2]} and levels[-1][0] == "full"
