"""The overlay against independently computed geometry, and the label layout over moving pictures."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from arview.cad.model import Component, Model, make_model
from arview.camera import Camera
from arview.errors import InputError, MismatchError
from arview.geometry import Array, apply, look_at, rigid
from arview.inspection import CharacteristicResult, ComponentDeviation, Finding, Inspection, Provenance, Verdict
from arview.overlay import OverlayOptions, OverlayRenderer, age_text, labels, paint
from arview.overlay.ghost import CELL_PX
from arview.overlay.layout import LabelLayout, LabelRequest, PlacedLabel
from arview.overlay.options import VERDICT_RGB
from arview.overlay.status import StatusLine
from arview.pose import ComponentPresence, Pose, Presence, TrackingState, Visibility
from helpers.inspections import bench_inspection
from helpers.paths import SHARED
from helpers.photo_scene import bench

PLATE = SHARED / "sequences" / "plate"
CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
LENS = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, np.array([-0.28, 0.09, 0.001, -0.002, 0.0]))
GREY = np.full((480, 640, 3), 118, dtype=np.uint8)
NOW = datetime(2026, 3, 1, 14, tzinfo=UTC)
BARE = {"show_labels": False, "show_status": False}
GHOST_ONLY = OverlayOptions(show_edges="none", opacity=1.0, **BARE)
EDGES_ONLY = OverlayOptions(show_ghost=False, **BARE)
SEEN = (True,) * 6


def box(name: str, center: tuple[float, float, float], size: tuple[float, float, float]) -> Component:
    mesh = trimesh.creation.box(size)
    return Component(name, mesh.vertices + np.array(center), mesh.faces)


def post(name: str, x: float, y: float, radius: float = 8.0, height: float = 40.0) -> Component:
    mesh = trimesh.creation.cylinder(radius, height, sections=48)
    return Component(name, mesh.vertices + np.array([x, y, height / 2]), mesh.faces)


class AllPresent(dict[str, ComponentPresence]):
    """Every component of any part is present."""

    def __contains__(self, name: object) -> bool:
        return True

    def __missing__(self, name: str) -> ComponentPresence:
        return ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0)


def pose(cam_from_model: Array | None, state: TrackingState = TrackingState.TRACKED, reason: str = "") -> Pose:
    return Pose(cam_from_model, None, 0.9, state, 0.0, 0, 0.0, reason, components=AllPresent())


def orbit(azimuth_deg: float, elevation_deg: float = 45.0, distance_mm: float = 620.0) -> Array:
    a, e = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return look_at(distance_mm * direction, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])


def deviation(
    name: str, displacement_mm: tuple[float, float, float], verdict: str, tolerance_mm: float = 0.5
) -> ComponentDeviation:
    distance_mm = math.hypot(*displacement_mm)
    return ComponentDeviation(name, displacement_mm, distance_mm, SEEN, 0.12, tolerance_mm, Verdict(verdict))


def inspection(model: Model, *components: ComponentDeviation, note: str = "") -> Inspection:
    created = datetime(2026, 3, 1, 12, tzinfo=UTC)
    return Inspection("plate", "SN 7", model.source_hash, created, components, Provenance("t", "1", "m", note))


@pytest.fixture(scope="module")
def plate() -> Model:
    posts = [post(f"post_{i}_{j}", -75.0 + 50 * i, -75.0 + 50 * j) for i in range(4) for j in range(4)]
    return make_model("plate", (box("base", (0, 0, -4), (200, 200, 8)), *posts))


@pytest.fixture(scope="module")
def record(plate: Model) -> Inspection:
    entries = []
    for index, component in enumerate(plate.components[1:]):
        if index % 7 == 0:
            entries.append(deviation(component.name, (1.0, -0.61, 0.02), "fail"))
        elif index % 7 == 3:
            entries.append(deviation(component.name, (0.0, 0.45, 0.05), "undecided"))
        else:
            entries.append(deviation(component.name, (0.03, 0.01, -0.04), "pass"))
    return inspection(plate, *entries, note="example, written by hand")


def changed(picture: paint.Image) -> NDArray[np.bool_]:
    return np.any(picture != GREY, axis=-1)


def outline_mask(points_px: Array) -> NDArray[np.uint8]:
    mask = np.zeros((480, 640), dtype=np.uint8)
    hull = cv2.convexHull(points_px.astype(np.float32))
    cv2.fillPoly(mask, [np.round(hull * 16).astype(np.int32)], 255, cv2.LINE_8, 4)
    return mask


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("azimuth_deg", [10.0, 77.0, 200.0])
@pytest.mark.usefixtures("no_arrows")
def test_ghost_is_within_a_pixel_of_the_projected_outline(camera: Camera, azimuth_deg: float) -> None:
    model = make_model("m", (box("a", (10, 5, 0), (160, 90, 40)),))
    cam_from_model = orbit(azimuth_deg, 35.0, 480.0)
    picture = OverlayRenderer(model, camera, options=GHOST_ONLY).draw(GREY, pose(cam_from_model))
    corners = trimesh.creation.box((160, 90, 40)).vertices + np.array([10, 5, 0])
    # The outline of a box is made of its edges; sample them densely, as a lens bends them.
    pairs = [(a, b) for a, b in itertools.combinations(corners, 2) if np.sum(a != b) == 1]
    dense = np.concatenate([np.linspace(a, b, 60) for a, b in pairs])
    expected = outline_mask(camera.project(apply(cam_from_model, dense)))
    kernel = np.ones((3, 3), dtype=np.uint8)
    drawn = changed(picture)
    assert drawn.sum() > 5000
    assert not np.any(drawn & (cv2.dilate(expected, kernel) == 0))
    assert not np.any(~drawn & (cv2.erode(expected, kernel) > 0))


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.usefixtures("no_arrows")
def test_edges_follow_the_projection(camera: Camera) -> None:
    model = make_model("m", (box("a", (60, 30, 0), (200, 120, 60)),))
    cam_from_model = orbit(30.0, 40.0, 480.0)
    drawn = changed(OverlayRenderer(model, camera, options=EDGES_ONLY).draw(GREY, pose(cam_from_model)))
    corners = trimesh.creation.box((200, 120, 60)).vertices + np.array([60, 30, 0])
    pairs = [(a, b) for a, b in itertools.combinations(corners, 2) if np.sum(a != b) == 1]
    assert len(pairs) == 12
    far = np.argmax(apply(cam_from_model, corners)[:, 2])
    near_pairs = [p for p in pairs if not any(np.array_equal(end, corners[far]) for end in p)]
    distance = cv2.distanceTransform((~drawn).astype(np.uint8), cv2.DIST_L2, 5)
    points = np.concatenate([np.linspace(a, b, 80) for a, b in near_pairs])
    pixels = np.round(camera.project(apply(cam_from_model, points))).astype(int)
    inside = np.all((pixels >= 0) & (pixels < [640, 480]), axis=1)
    assert distance[pixels[inside, 1], pixels[inside, 0]].max() <= 1.0

    # And nothing else is drawn: not the three edges at the far corner, no diagonal of a face.
    canvas = np.full((480, 640), 255, dtype=np.uint8)
    canvas[pixels[inside, 1], pixels[inside, 0]] = 0
    assert cv2.distanceTransform(canvas, cv2.DIST_L2, 5)[drawn].max() <= 4.0


@pytest.mark.usefixtures("no_arrows")
def test_hidden_components_leave_no_trace() -> None:
    wall, behind = box("wall", (0, 60, 0), (200, 10, 120)), box("behind", (0, -60, 0), (60, 30, 40))
    model = make_model("m", (wall, behind))
    result = inspection(model, deviation("behind", (1.0, 0.0, 0.0), "fail"))
    cam_from_model = look_at([0.0, 600.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    options = OverlayOptions(opacity=1.0, **BARE)
    drawn = changed(OverlayRenderer(model, CAMERA, result, options).draw(GREY, pose(cam_from_model)))
    corners = CAMERA.project(apply(cam_from_model, behind.vertices_in_model))
    (u0, v0), (u1, v1) = corners.min(axis=0).astype(int) - 3, corners.max(axis=0).astype(int) + 4
    assert not drawn[v0:v1, u0:u1].any()

    shown = OverlayOptions(show_edges="all", show_ghost=False, **BARE)
    dashed = changed(OverlayRenderer(model, CAMERA, result, shown).draw(GREY, pose(cam_from_model)))
    assert dashed[v0:v1, u0:u1].sum() > 50


@pytest.mark.usefixtures("no_arrows")
def test_cylinder_shows_its_silhouette_and_no_facets() -> None:
    model = make_model("m", (post("p", 0.0, 0.0, 30.0, 100.0),))
    cam_from_model = look_at([600.0, 0.0, 50.0], [0.0, 0.0, 50.0], [0.0, 0.0, 1.0])
    drawn = changed(OverlayRenderer(model, CAMERA, options=EDGES_ONLY).draw(GREY, pose(cam_from_model)))
    row = np.flatnonzero(drawn[240])
    radius_px = 700.0 * 30.0 / math.sqrt(600.0**2 - 30.0**2)
    assert np.all(np.abs(np.abs(row - 319.5) - radius_px) < 2.0)
    assert row.min() < 319 < row.max()


@pytest.mark.usefixtures("no_arrows")
def test_colours_show_the_verdict() -> None:
    centers = [(-90, 0, 0), (-30, 0, 0), (30, 0, 0), (90, 0, 0)]
    model = make_model("m", tuple(box(f"b{i}", c, (40, 40, 40)) for i, c in enumerate(centers)))
    unmeasured = ComponentDeviation("b3", (None, None, None), None, (False,) * 6, None, 0.5, Verdict.NOT_MEASURED)
    result = inspection(
        model,
        deviation("b0", (0.0, 0.0, 0.1), "pass"),
        deviation("b1", (0.0, 0.0, 1.0), "fail"),
        deviation("b2", (0.0, 0.0, 0.5), "undecided"),
        unmeasured,
    )
    cam_from_model = orbit(90.0, 40.0, 500.0)
    options = OverlayOptions(opacity=0.6, **BARE)
    picture = OverlayRenderer(model, CAMERA, result, options).draw(GREY, pose(cam_from_model))
    tops = CAMERA.project(apply(cam_from_model, np.add(centers, (0.0, 0.0, 20.0))))
    for verdict, (u, v) in zip(
        (Verdict.PASS, Verdict.FAIL, Verdict.UNDECIDED, Verdict.NOT_MEASURED), tops, strict=True
    ):
        tint = picture[round(v), round(u)].astype(float) - picture[round(v), round(u)].mean()
        fit = {}
        for name, rgb in VERDICT_RGB.items():
            direction = np.array(rgb) - np.mean(rgb)
            fit[name] = tint @ direction / np.linalg.norm(direction)
        assert max(fit, key=fit.__getitem__) is verdict


def test_label_texts_come_from_the_inspection(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = deviation("post_3", (1.0, -0.61, 0.05), "fail")
    assert labels.value_text(failed) == "1.17 mm"
    assert labels.detail_text(failed) == "dx +1.00  dy −0.61   U 0.12"
    blind = ComponentDeviation(
        "a", (0.3, 0.4, None), 0.5, (True,) * 5 + (False,), 0.1, 0.4, Verdict.FAIL, tilt_deg=1.25
    )
    assert labels.detail_text(blind) == "dx +0.30  dy +0.40  dz ?   tilt 1.2°   U 0.10"
    missing = ComponentDeviation(
        "a", (None,) * 3, None, (False,) * 6, None, None, Verdict.FAIL, finding=Finding.MISSING
    )
    assert (labels.value_text(missing), labels.detail_text(missing)) == ("missing", "")
    rough = replace(failed, uncertainty_mm=2.34)
    assert labels.value_text(rough) == "1.2 mm"  # no more decimals than U allows
    assert labels.detail_text(rough) == "U 2.3"
    monkeypatch.setattr(labels, "UNIT", "inch")
    monkeypatch.setattr(labels, "DECIMALS", 3)
    assert labels.value_text(deviation("a", (0.0, 25.4, 0.0), "fail")) == "1.000 in"


def test_failures_come_first(plate: Model, record: Inspection) -> None:
    order = labels.by_urgency(record)
    verdicts = [entry.verdict for entry in order]
    assert verdicts == sorted(verdicts, key=["fail", "undecided", "pass"].index)
    renderer, placed = spied(plate, CAMERA, record, OverlayOptions(max_labels=3))
    renderer.draw(GREY, pose(orbit(20.0)))
    assert {label.key for label in placed()} == {entry.name for entry in order[:3]}


def test_arrow_points_along_the_displacement() -> None:
    model = make_model("m", (box("a", (0, 0, 0), (40, 40, 40)),))
    result = inspection(model, deviation("a", (0.5, 0.0, 0.0), "fail", 0.2))
    cam_from_model = look_at([0.0, 0.0, 500.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    options = OverlayOptions(
        show_ghost=False, show_edges="none", show_labels=False, show_status=False, arrow_scale=100.0
    )
    drawn = changed(OverlayRenderer(model, CAMERA, result, options).draw(GREY, pose(cam_from_model)))
    v, u = np.nonzero(drawn)
    assert abs(u.max() - (319.5 + 700.0 * 50.0 / 500.0)) < 4.0
    assert u.min() > 319.5 - 6.0
    assert abs(v.mean() - 239.5) < 1.5
    within_u = inspection(model, deviation("a", (0.05, 0.0, 0.0), "undecided", 0.1))
    assert not changed(OverlayRenderer(model, CAMERA, within_u, options).draw(GREY, pose(cam_from_model))).any()


def test_arrow_scale_is_round_and_fits() -> None:
    model = make_model("m", (box("a", (0, 0, 0), (40, 40, 40)),))
    for distance_mm, expected in ((0.1, 50.0), (0.8, 10.0), (30.0, 1.0)):
        result = inspection(model, deviation("a", (distance_mm, 0.0, 0.0), "fail", 0.05))
        assert labels.arrow_scale(result, 60.0, OverlayOptions()) == expected


def test_without_a_pose_only_the_status_line_is_drawn(plate: Model, record: Inspection) -> None:
    renderer = OverlayRenderer(plate, CAMERA, record)
    renderer.draw(GREY, pose(orbit(20.0)), 30.0, NOW)
    lost = pose(None, TrackingState.LOST, "the part left the picture")
    rows = np.flatnonzero(changed(renderer.draw(GREY, lost, 30.0, NOW)).any(axis=1))
    assert rows.min() > 480 - 60
    searching = renderer.draw(GREY, pose(None, TrackingState.SEARCHING, "x" * 500), None, NOW)
    assert changed(searching).any()
    none = OverlayRenderer(plate, CAMERA, record, OverlayOptions(show_status=False))
    assert not changed(none.draw(GREY, lost)).any()


def test_the_status_line_names_unverified_components(plate: Model, record: Inspection) -> None:
    renderer = OverlayRenderer(plate, CAMERA, record)
    seen = pose(orbit(20.0))
    plain, one, many = (
        renderer.draw(GREY, replace(seen, unverified=names), 30.0, NOW)[-60:]
        for names in ((), ("nut",), tuple("abcdef"))
    )
    assert (one != plain).any() and (many != one).any()
    assert replace(seen, unverified=("nut",)).remark == "not yet verified: nut"
    assert replace(seen, unverified=tuple("abcdef")).remark == "not yet verified: 6 components"
    lost = replace(pose(None, TrackingState.LOST, "too dark"), unverified=("nut",))
    assert lost.remark == "too dark"


def test_on_one_row_unverified_components_give_way_to_the_inspection(plate: Model, record: Inspection) -> None:
    line = StatusLine(1600, 480, 18, record, None)
    assert line.rows == 1
    bars = []
    for names in ((), ("nut",), ("n" * 300,)):
        bars.append(np.full((480, 1600, 3), 127, np.uint8))
        line.draw(bars[-1], replace(pose(orbit(20.0)), unverified=names), 30.0, NOW)
    plain, one, long = bars
    right = slice(1600 - 500, None)
    assert (one != plain).any() and (long != one).any()
    assert (one[:, right] == plain[:, right]).all() and (long[:, right] == plain[:, right]).all()


@pytest.mark.parametrize(
    ("age_s", "text"),
    [(-5, "in the future"), (20, "just now"), (70, "1 min ago"), (7300, "2 h ago"), (4e5, "5 d ago")],
)
def test_age_text(age_s: float, text: str) -> None:
    assert age_text(age_s) == text


def test_input_is_left_alone_unless_asked(plate: Model, record: Inspection) -> None:
    image = GREY.copy()
    picture = OverlayRenderer(plate, CAMERA, record).draw(image, pose(orbit(20.0)), 30.0, NOW)
    assert np.array_equal(image, GREY)
    again = OverlayRenderer(plate, CAMERA, record).draw(image, pose(orbit(20.0)), 30.0, NOW, in_place=True)
    assert again is image
    assert np.array_equal(image, picture)


def test_refusals(plate: Model, record: Inspection) -> None:
    with pytest.raises(MismatchError, match="another model"):
        OverlayRenderer(make_model("x", (*plate.components, post("new", 0, 0))), CAMERA, record)
    with pytest.raises(MismatchError, match="camera expects"):
        OverlayRenderer(plate, CAMERA).draw(np.zeros((720, 1280, 3), np.uint8), pose(None))
    for bad in (
        {"opacity": 1.5},
        {"show_edges": "some"},
        {"arrow_scale": 0.0},
    ):
        with pytest.raises(InputError, match=next(iter(bad))):
            OverlayOptions(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_unusual_poses_leave_a_picture_of_the_same_size(plate: Model, record: Inspection, camera: Camera) -> None:
    renderer = OverlayRenderer(plate, camera, record, OverlayOptions(show_edges="all"))
    front = orbit(20.0)
    places = [(0.0, 0.0, z) for z in (-500.0, 0.0, 30.0, 120.0, 1e6)] + [(x, 0.0, 600.0) for x in (-400.0, 330.0, 5e3)]
    drawn = [renderer.draw(GREY, pose(rigid(front[:3, :3], list(place)))) for place in places]
    assert all(picture.shape == GREY.shape and picture.dtype == np.uint8 for picture in drawn)
    # Behind the camera, and far beside the picture, nothing of the part is drawn: both differ by their texts alone.
    share = [float(changed(picture).mean()) for picture in drawn]
    assert share[0] < 0.2 and share[-1] < 0.2 and max(share) > 0.2


@pytest.mark.usefixtures("no_arrows")
def test_meshes_that_are_open_or_inside_out_are_drawn() -> None:
    closed = trimesh.creation.box((80, 80, 80))
    for faces in (closed.faces[:, ::-1], closed.faces[:-1], closed.faces[:-1, ::-1]):
        model = make_model("m", (Component("a", closed.vertices, faces),))
        reference = make_model("m", (Component("a", closed.vertices, closed.faces),))
        pictures = [
            changed(OverlayRenderer(m, CAMERA, options=GHOST_ONLY).draw(GREY, pose(orbit(31.0))))
            for m in (model, reference)
        ]
        assert pictures[0].sum() > 5000
        assert np.count_nonzero(pictures[0] != pictures[1]) <= 4


def test_text_without_opencv_5(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paint, "_font", lambda: None)
    paint.text_mask.cache_clear()
    mask = paint.text_mask("dy −0.61", 13)
    paint.text_mask.cache_clear()
    assert mask.max() > 200
    assert 20 < mask.shape[1] < 120


# ---- layout -----------------------------------------------------------------------------------------------


def spied(
    model: Model, camera: Camera, result: Inspection, options: OverlayOptions | None = None
) -> tuple[OverlayRenderer, Callable[[], list[PlacedLabel]]]:
    """A renderer, and a function that gives the labels of the last frame."""
    renderer = OverlayRenderer(model, camera, result, options)
    frames: list[list[PlacedLabel]] = [[]]
    layout = renderer._annotations._layout
    place = layout.place

    def spy(*arguments: object) -> list[PlacedLabel]:
        frames.append(place(*arguments))  # type: ignore[arg-type]
        return frames[-1]

    layout.place = spy  # type: ignore[method-assign, assignment]
    return renderer, lambda: frames[-1]


def overlapping(boxes: list[PlacedLabel]) -> list[tuple[PlacedLabel, PlacedLabel]]:
    return [
        (a, b)
        for a, b in itertools.combinations(boxes, 2)
        if a.x < b.x + b.width and b.x < a.x + a.width and a.y < b.y + b.height and b.y < a.y + a.height
    ]


def largest_step_px(before: list[PlacedLabel], after: list[PlacedLabel]) -> float:
    old = {label.key: label for label in before}
    steps = [math.hypot(b.x - old[b.key].x, b.y - old[b.key].y) for b in after if b.key in old]
    return max(steps, default=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(640, 480), (1280, 720)])
def test_labels_keep_apart_and_glide(plate: Model, record: Inspection, size: tuple[int, int]) -> None:
    width, height = size
    focal = 1.46 * height
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    renderer, placed = spied(plate, camera, record)
    failed = {entry.name for entry in record.components if entry.verdict is Verdict.FAIL}
    image = np.full((height, width, 3), 118, dtype=np.uint8)
    boxes: list[PlacedLabel] = []
    covered, labelled = [], []
    for frame in range(150):
        cam_from_model = orbit(-40.0 + 0.9 * frame, 48.0 + 10.0 * math.sin(frame / 20.0), 760.0)
        cam_from_model[0, 3] += 60.0 * math.sin(frame / 25.0)
        renderer.draw(image, pose(cam_from_model), 30.0, NOW)
        before, boxes = boxes, placed()
        assert not overlapping(boxes)
        assert largest_step_px(before, boxes) <= height / 60.0
        for label in boxes:
            assert label.x >= 0 and label.x + label.width <= width
            assert label.y >= 0 and label.y + label.height <= height - renderer.status_height_px
        on_posts = np.zeros((height, width), dtype=bool)
        for component in plate.components[1:]:
            u, v = np.round(camera.project(apply(cam_from_model, component.vertices_in_model))).astype(int).T
            on_posts[max(v.min(), 0) : v.max(), max(u.min(), 0) : u.max()] = True
        covered += [on_posts[b.y : b.y + b.height, b.x : b.x + b.width].mean() > 0.02 for b in boxes]
        labelled.append(failed <= {label.key for label in boxes})
    assert labelled[0]
    assert np.mean(labelled) > 0.8  # a label that changes sides is away for a moment
    assert np.mean(covered) < 0.05


def test_steady_part_has_steady_labels(plate: Model, record: Inspection) -> None:
    renderer, placed = spied(plate, CAMERA, record)
    rng = np.random.default_rng(1)
    renderer.draw(GREY, pose(orbit(20.0)))
    first = placed()
    for _ in range(40):
        renderer.draw(GREY, pose(orbit(20.0 + 0.05 * rng.standard_normal())))
        assert largest_step_px(first, placed()) <= 4.0
    assert {label.key for label in placed()} == {label.key for label in first}


def test_layout_with_more_labels_than_room() -> None:
    layout = LabelLayout(400, 10, 200, 10, 6, 120)
    cells = np.zeros((200 // CELL_PX, 400 // CELL_PX), dtype=np.float32)
    rng = np.random.default_rng(0)
    anchors = {f"l{i}": rng.uniform([0, 0], [400, 200]) for i in range(30)}
    seen: set[str] = set()
    for _ in range(120):
        keys = [key for key in anchors if rng.random() > 0.05]
        for key in keys:
            anchors[key] = np.clip(anchors[key] + rng.normal(0, 5, 2), 0, [400, 200])
        requests = [LabelRequest(key, 60 + 2 * int(key[1:]), 20, anchors[key]) for key in keys]
        boxes = layout.place(requests, (150.0 + rng.normal(0, 20), 250.0), cells)
        assert not overlapping(boxes)
        assert all(b.x >= 10 and b.x + b.width <= 390 for b in boxes)
        assert all(b.y >= 10 and b.y + b.height <= 200 for b in boxes)
        seen |= {label.key for label in boxes}
    assert {"l0", "l1", "l2"} <= seen


def test_labels_avoid_covering_components() -> None:
    layout = LabelLayout(640, 10, 440, 10, 6, 150)
    cells = np.zeros((480 // CELL_PX, 640 // CELL_PX), dtype=np.float32)
    cells[20:30, :] = CELL_PX**2
    (label,) = layout.place([LabelRequest("a", 150, 30, np.array([60.0, 200.0]))], (200.0, 600.0), cells)
    assert label.y + label.height <= 20 * CELL_PX or label.y >= 30 * CELL_PX


@pytest.mark.shared
@pytest.mark.parametrize("index", [0, 150])
@pytest.mark.usefixtures("no_arrows")
def test_edges_lie_on_the_edges_of_a_real_frame(index: int) -> None:
    scene = trimesh.load(PLATE / "models" / "assembly.glb")
    components = []
    for name in scene.graph.nodes_geometry:
        model_from_node, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        vertices = trimesh.transform_points(mesh.vertices, model_from_node) * 1000.0
        components.append(Component(name, vertices, mesh.faces))
    model = make_model("plate", tuple(components))
    truth = json.loads((PLATE / "test/000001/scene_gt.json").read_text())[str(index)][0]
    cam_from_model = rigid(np.reshape(truth["cam_R_m2c"], (3, 3)), truth["cam_t_m2c"])
    frame = cv2.imread(str(PLATE / f"test/000001/rgb/{index:06d}.jpg"), cv2.IMREAD_GRAYSCALE)
    camera = Camera(640, 480, 768.0, 768.0, 319.5, 239.5)
    picture = OverlayRenderer(model, camera, options=EDGES_ONLY).draw(GREY, pose(cam_from_model))
    drawn = np.abs(picture.astype(float) - GREY).sum(axis=-1)
    smooth = cv2.GaussianBlur(frame.astype(np.float64), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_64F, 1, 0), cv2.Sobel(smooth, cv2.CV_64F, 0, 1))
    strength = {
        (u, v): float(np.sum(drawn * np.roll(gradient, (-v, -u), axis=(0, 1)))) for u in (-3, 0, 3) for v in (-3, 0, 3)
    }
    best = strength.pop((0, 0))
    assert best > 1.1 * max(strength.values())


def test_labels_say_which_places_depend_on_the_ambiguous_pose() -> None:
    model = make_model("plate", (box("base", (0, 0, -4), (200, 200, 8)), post("middle", 0, 0), post("side", 70, 0)))
    result = inspection(model, deviation("middle", (0.9, 0, 0), "fail"), deviation("side", (0.9, 0, 0), "fail"))
    renderer = OverlayRenderer(model, CAMERA, result)
    turned = pose(orbit(20.0), TrackingState.CRITICAL)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    ambiguous = replace(turned, alternatives=(orbit(20.0) @ half_turn,))
    # The half turn about the middle leaves it where it is, and moves the post at the side.
    for shown, expected in ((turned, set()), (ambiguous, {"side"})):
        renderer.draw(GREY, shown, now=NOW)
        assert {one.text.name for one in renderer.laid_out.labels} == {"middle", "side"}
        noted = {one.text.name for one in renderer.laid_out.labels if "one of two places" in one.lines}
        assert noted == expected


def test_a_failed_characteristic_has_a_label_at_its_place() -> None:
    """Its zone and what is allowed; the count in the status line has it, and a passed one gets no label."""
    model = bench()
    one = CharacteristicResult(
        "bore", "position", ("bore",), Verdict.FAIL, value_mm=0.4213, uncertainty_mm=0.03, zone_mm=0.3,
        zone="diameter", point_mm=(0.0, 0.0, 0.0),
    )  # fmt: skip
    passed = replace(one, name="other", verdict=Verdict.PASS, value_mm=0.1)
    measured = replace(bench_inspection(model), characteristics=(passed, one))
    (label, point), *others = labels.characteristic_labels(measured)
    assert not others and (label.name, label.value, label.word) == ("bore", "Ø0.421 (Ø0.3)", "FAIL")
    assert point.tolist() == [0.0, 0.0, 0.0]
