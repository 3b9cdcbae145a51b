"""The studio's requests, from a bare CAD file to a part file, guide views and a part that is found in a picture."""

from __future__ import annotations

import json
import struct
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from arview.cad.part_file import load_part
from arview.guideviews import load_guide_views
from arview.station.studio.mesh_data import clustered
from helpers.live_client import Http
from helpers.paths import ROOT
from helpers.studio_client import Studio, running_studio

SAMPLE = ROOT / "samples" / "bracket_plate"


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    (tmp_path / "bracket.step").write_bytes((SAMPLE / "bracket_plate.step").read_bytes())
    with running_studio(tmp_path / "bracket.step") as running:
        yield running


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A studio for tests that change nothing."""
    folder = tmp_path_factory.mktemp("unchanged")
    (folder / "bracket.step").write_bytes((SAMPLE / "bracket_plate.step").read_bytes())
    with running_studio(folder / "bracket.step") as running:
        yield running


def test_without_the_token_nothing_is_served(unchanged: Studio) -> None:
    assert Http(unchanged.server.port, "guessed").ask("GET", "/api/part")[0] == 403
    assert unchanged.http.ask("GET", "/api/part")[0] == 200


def test_a_bare_cad_file_becomes_a_part_file(tmp_path: Path, studio: Studio) -> None:
    part = studio.get("/api/part")
    assert len(part["components"]) == 11
    assert not part["is_saved"]
    assert not (tmp_path / "part.toml").exists()
    studio.edit(kind="component", names=["base_plate"], key="role", value="base")
    studio.edit(kind="component", names=["post_1", "post_2"], key="position_tolerance_mm", value=0.5)
    studio.edit(kind="view_range", value={"distance_mm": [400.0, 660.0], "elevation_deg": [20.0, 68.0]})
    studio.post("/api/save")
    saved = load_part(tmp_path / "part.toml")
    assert saved.component_settings("base_plate").role == "base"
    assert saved.component_settings("post_2").position_tolerance_mm == 0.5
    assert saved.view_range is not None and saved.view_range.elevation_deg == (20.0, 68.0)


def test_a_click_on_a_hole_and_the_top_makes_datums(tmp_path: Path, studio: Studio) -> None:
    """The datum holes of the sample are at (±97, -67, 0), ⌀ 12; the top of its base plate is z = 0."""
    base = studio.document.cad.component("base_plate")
    mesh = trimesh.Trimesh(base.vertices_in_model, base.faces, process=False)
    up = np.flatnonzero((mesh.face_normals[:, 2] > 0.99) & (np.abs(mesh.triangles_center[:, 2]) < 1e-6))

    def pick(point: list[float]) -> list[dict[str, Any]]:
        near = trimesh.triangles.closest_point(mesh.triangles[up], np.repeat([point], len(up), axis=0))
        face = int(up[np.linalg.norm(near - point, axis=1).argmin()])
        body = {"component": "base_plate", "face": face, "point_mm": point}
        found: list[dict[str, Any]] = studio.post("/api/pick", body)["features"]
        return found

    plane = next(one["datum"] for one in pick([20.0, 0.0, 0.0]) if one["datum"]["feature"] == "plane")
    hole = pick([-97.0 + 6.3, -67.0, 0.0])[0]["datum"]
    assert hole["feature"] == "hole"
    assert hole["point_mm"] == pytest.approx([-97.0, -67.0, 0.0], abs=1e-4)
    assert hole["diameter_mm"] == pytest.approx(12.0, abs=1e-3)
    studio.edit(kind="datum", label="A", value=plane)
    part = studio.edit(kind="datum", label="B", value=hole)
    assert [datum["label"] for datum in part["datums"]] == ["A", "B"]
    assert not [one for one in studio.get("/api/findings")["findings"] if one["text"].startswith("datum")]
    assert studio.post("/api/undo")["datums"][-1]["label"] == "A"
    assert len(studio.post("/api/redo")["datums"]) == 2
    assert studio.edit(kind="datum", label="B", value=None)["datums"][0]["label"] == "A"
    # It can be a feature as well, of which the drawing requires something; then it is not removed.
    part = studio.edit(kind="feature", label="hole_1", value=hole)
    assert [(one["label"], one["diameter_mm"]) for one in part["features"]] == [
        ("hole_1", pytest.approx(12.0, abs=1e-3))
    ]
    required = f'{part["text"]}\n[[characteristics]]\nkind = "size"\nof = "hole_1"\nmin_mm = 11.9\n'
    assert "characteristics" in studio.edit(kind="text", value=required)["text"]
    refused = studio.edit(422, kind="feature", label="hole_1", value=None)
    assert "hole_1" in refused["message"] and len(studio.get("/api/part")["features"]) == 1


@pytest.mark.parametrize(
    "change,message",
    [
        ({"kind": "component", "names": ["post_9"], "key": "role", "value": "base"}, "post_9"),
        ({"kind": "component", "names": ["post_1"], "key": "role", "value": "boss"}, "role"),
        ({"kind": "component", "names": ["post_1"], "key": "mass", "value": 3}, "expected one of"),
        ({"kind": "view_range", "value": {"distance_mm": [700.0, 400.0]}}, "distance_mm"),
        ({"kind": "datum", "label": "AA", "value": {}}, "label"),
        ({"kind": "text", "value": "[part"}, "not valid TOML"),
        ({"kind": "explode"}, "kind"),
    ],
)
def test_an_edit_that_would_break_the_file_changes_nothing(
    unchanged: Studio, change: dict[str, object], message: str
) -> None:
    before = unchanged.get("/api/part")
    answer = unchanged.edit(422, **change)
    assert message in answer["message"] and "\n" not in answer["message"]
    assert unchanged.get("/api/part") == before


def test_the_mesh_holds_every_component_with_its_faces(unchanged: Studio) -> None:
    content = unchanged.get("/api/mesh")
    (length,) = struct.unpack_from("<I", content)
    header = json.loads(content[4 : 4 + length])
    model = unchanged.document.cad
    assert [count for _, count in header["ranges"]] == [len(component.faces) for component in model.components]
    points = np.frombuffer(content, np.float32, 3 * header["vertices"], 4 + length).reshape(-1, 3)
    corners = np.frombuffer(content, np.uint32, 3 * header["faces"], 4 + length + points.nbytes).reshape(-1, 3)
    first, count = header["ranges"][3]
    component = model.components[3]
    drawn = points[corners[first : first + count]]
    assert drawn == pytest.approx(component.vertices_in_model[component.faces], abs=1e-4)
    assert len(content) == 4 + length + points.nbytes + corners.nbytes + 24 * header["edges"]


def test_a_coarser_mesh_keeps_the_shape() -> None:
    sphere = trimesh.creation.icosphere(6, 50.0)
    vertices, faces = clustered(np.asarray(sphere.vertices), np.asarray(sphere.faces, dtype=np.int32), 2000)
    assert 300 < len(faces) < 6000
    assert np.linalg.norm(vertices[np.unique(faces)], axis=1) == pytest.approx(50.0, abs=2.5)


@pytest.mark.slow
def test_views_advice_photos_and_exports(tmp_path: Path, studio: Studio) -> None:
    studio.edit(kind="view_range", value={"distance_mm": [400.0, 660.0], "elevation_deg": [20.0, 68.0]})
    deadline = time.monotonic() + 120
    while (views := studio.http.json("GET", "/api/views"))[0] == 202 and time.monotonic() < deadline:
        time.sleep(0.1)
    found = views[1]
    assert found["is_sufficient"] and found["plain_share"] == 0.0
    assert len(found["views"]) >= 40
    picture = cv2.imdecode(np.frombuffer(studio.get("/api/views/3.png"), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 320 and picture.std() > 20
    studio.get("/api/views/9999.png", 404)
    plan = studio.get("/api/photos?count=24")
    assert len(plan["photos"]) == 24
    rows = {row["name"]: row for row in plan["components"]}
    assert len(rows["block_1"]["photos"]) > 12 and rows["block_1"]["spread_deg"] > 90
    assert 0.005 < rows["block_1"]["expected_U_mm"] < 0.2
    studio.get("/api/photos?count=1", 422)
    assert "saved" in studio.post("/api/export", {"kinds": ["gv"]}, 422)["message"]
    studio.post("/api/save")
    files = [Path(name) for name in studio.post("/api/export", {"kinds": ["sheet", "station"]})["files"]]
    assert [path.name for path in files] == ["bracket_views.png", "bracket_station.html"]
    assert "base_plate" in files[1].read_text()


@pytest.mark.slow
def test_leaving_out_what_hides_the_part_or_a_range_is_advised(tmp_path: Path) -> None:
    """A lone block is insufficient; with the bracket that was left out it is better, and that is said."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((80, 50, 30)), node_name="block", geom_name="block")
    bracket = trimesh.util.concatenate(
        [trimesh.creation.box((8, 30, 50), trimesh.transformations.translation_matrix(t)) for t in
         ([30, 0, 35], [-20, 5, 30], [5, -15, 40])]
    )  # fmt: skip
    scene.add_geometry(bracket, node_name="bracket", geom_name="bracket")
    (tmp_path / "part.glb").write_bytes(scene.export(file_type="glb"))
    (tmp_path / "part.toml").write_text(
        '[part]\ncad = "part.glb"\nunit = "mm"\n[components.bracket]\nrole = "ignore"\n[view_range]\n'
        "distance_mm = [300.0, 500.0]\nelevation_deg = [15.0, 70.0]\n"
    )
    with running_studio(tmp_path / "part.toml") as studio:
        advice = studio.get("/api/advice")["advice"]
        assert advice and advice[0]["text"] == "include bracket"
        assert advice[0]["score"] > 0.5
        studio.post("/api/edit", advice[0]["edit"])
        assert studio.document.part.component_settings("bracket").role == "inspect"


@pytest.mark.slow
def test_a_trial_finds_the_part_in_a_frame_of_the_clip(tmp_path: Path, studio: Studio) -> None:
    studio.edit(
        kind="view_range",
        value={"distance_mm": [400.0, 660.0], "elevation_deg": [20.0, 68.0], "azimuth_deg": [-160.0, -15.0]},
    )
    capture = cv2.VideoCapture(str(SAMPLE / "clip.mp4"))
    _, frame = capture.read()
    _, jpeg = cv2.imencode(".jpg", frame)
    answer = studio.send("/api/trial?name=frame.jpg&camera=fov:59", jpeg.tobytes())
    assert answer["tracked"] == 1 and answer["quality"] > 0.8
    drawn = cv2.imdecode(np.frombuffer(studio.get("/api/trial.jpg"), np.uint8), cv2.IMREAD_COLOR)
    assert drawn.shape == frame.shape
    assert np.abs(drawn.astype(int) - frame).mean() > 1.0
    empty = cv2.imencode(".jpg", np.full_like(frame, 120))[1].tobytes()
    answer = studio.send("/api/trial?name=e.jpg", empty)
    assert answer["tracked"] == 0 and "not found" in answer["reason"]


def test_comments_of_a_part_file_stay(tmp_path: Path) -> None:
    text = (SAMPLE / "part.toml").read_text()
    (tmp_path / "bracket_plate.step").write_bytes((SAMPLE / "bracket_plate.step").read_bytes())
    (tmp_path / "part.toml").write_text(text)
    with running_studio(tmp_path / "part.toml") as studio:
        studio.edit(kind="component", names=["post_1"], key="position_tolerance_mm", value=0.9)
        studio.post("/api/save")
        saved = (tmp_path / "part.toml").read_text()
        assert [line for line in saved.splitlines() if "#" in line] == [
            line for line in text.splitlines() if "#" in line
        ]
        assert tomllib.loads(saved)["components"]["post_1"]["position_tolerance_mm"] == 0.9


def test_guide_views_are_written_for_the_saved_part(tmp_path: Path) -> None:
    (tmp_path / "block.stl").write_bytes(trimesh.creation.box((60, 40, 20)).export(file_type="stl"))
    (tmp_path / "block.toml").write_text(
        '[part]\ncad = "block.stl"\nunit = "mm"\n[view_range]\ndistance_mm = [300.0, 400.0]\n'
        "elevation_deg = [40.0, 50.0]\nazimuth_deg = [0.0, 30.0]\n"
    )
    with running_studio(tmp_path / "block.toml") as studio:
        (path,) = studio.post("/api/export", {"kinds": ["gv"]})["files"]
        assert path.endswith("block.gv")
        assert len(load_guide_views(path, studio.document.part.model)) > 3
