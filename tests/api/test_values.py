"""Values of the public interface can be copied, pickled and made from what other libraries give."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview import Camera, Detection, Pose, PosePrior, load_inspection, load_part
from arview.errors import InputError
from arview.pose import ComponentPresence, Presence, TrackingState
from arview.pose_file import pose_line
from arview.tracking import TrackingSession
from arview.video import Frame
from helpers.synthetic import CAMERA, assembly, assembly_views, picture, pose_from

ROOT = Path(__file__).parents[2]


def test_poses_can_be_pickled_and_copied() -> None:
    pose = Pose(
        np.eye(4),
        np.eye(6),
        0.9,
        TrackingState.TRACKED,
        1.5,
        45,
        components={"nut": ComponentPresence(Presence.PRESENT)},
    )
    for same in (pickle.loads(pickle.dumps(pose)), copy.deepcopy(pose), copy.copy(pose)):
        assert same.index == 45 and same.state is TrackingState.TRACKED
        assert same.components["nut"].presence is Presence.PRESENT and np.array_equal(same.covariance, np.eye(6))
        with pytest.raises(TypeError):
            same.components["nut"] = ComponentPresence()
        with pytest.raises(FrozenInstanceError):
            same.index = 3


def test_a_camera_of_a_matrix() -> None:
    k = [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
    camera = Camera.from_matrix(np.array(k), (640, 480), np.array([[0.1, -0.2, 1e-3, 2e-3, 0.01]]))
    np.testing.assert_allclose(camera.dist, [0.1, -0.2, 1e-3, 2e-3, 0.01])
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (500.0, 501.0, 320.0, 240.0, 640)
    rational = Camera.from_matrix(k, (640, 480), [0.1, -0.2, 0.0, 0.0, 0.01, 0.3, 0.0, 0.0, *6 * [0.0]])
    assert rational.lens is not None and rational.lens.terms[5] == 0.3
    assert not Camera.from_matrix(k, (640, 480)).is_distorted
    for wrong, dist in ((np.eye(4), ()), ([[500, 3, 320], *k[1:]], ()), (k, [0.1, 0.2, 0.3]), (k, 13 * [0.0] + [0.1])):
        with pytest.raises(InputError):
            Camera.from_matrix(wrong, (640, 480), dist)


def test_a_session_takes_pictures_alone() -> None:
    session = TrackingSession.of(assembly_views(), CAMERA, assembly())
    image = picture(pose_from(20.0, 45.0, 440.0), seed=1)
    poses = [session.process(image)[0] for _ in range(3)]
    assert [pose.index for pose in poses] == [0, 1, 2]
    assert 0.0 <= poses[0].time_s <= poses[1].time_s <= poses[2].time_s and poses[2].cam_from_model is not None
    with pytest.raises(InputError, match="uint8"):
        session.process(image.astype(np.float32))


def same(value: object, other: object) -> bool:
    """Whether two results are equal, arrays included."""
    return pickle.dumps(value) == pickle.dumps(other) or repr(value) == repr(other)


def test_results_become_json_values() -> None:
    pose = Pose(
        np.eye(4),
        np.diag([np.inf, *5 * [1.0]]),
        0.9,
        TrackingState.TRACKED,
        1.5,
        45,
        components={"nut": ComponentPresence(Presence.DISPLACED, model_from_nominal=2.0 * np.eye(4))},
    )
    told = json.loads(json.dumps(pose.to_dict(), allow_nan=False))
    assert told["cam_from_model"] == np.eye(4).tolist() and told["covariance"] is None and told["state"] == "tracked"
    assert told["presence"] == {"nut": "displaced"} and told["completeness"] == "incomplete"
    assert told["presence_details"]["nut"]["model_from_nominal"][0][0] == 2.0
    assert json.loads(pose_line(pose, file="a.png")) == {**told, "file": "a.png"}
    assert "presence" not in Pose(None, None, 0.0, TrackingState.LOST, 1.5, 45).to_dict()
    detection = Detection(np.eye(4), 0.7, (2.0 * np.eye(4),))
    assert json.loads(json.dumps(detection.to_dict())) == {
        "cam_from_model": np.eye(4).tolist(),
        "quality": 0.7,
        "alternatives": [(2.0 * np.eye(4)).tolist()],
    }


def test_an_inspection_becomes_a_table_and_a_page_of_a_notebook() -> None:
    inspection = load_inspection(ROOT / "samples" / "bracket_plate" / "inspection.json")
    rows = inspection.to_table()
    assert [row["component"] for row in rows] == [one.name for one in inspection.components]
    first, one = rows[0], inspection.components[0]
    assert (first["dx_mm"], first["dy_mm"], first["dz_mm"]) == one.displacement_mm
    assert (first["distance_mm"], first["uncertainty_mm"]) == (one.distance_mm, one.uncertainty_mm)
    assert first["verdict"] == one.verdict.value and len({tuple(row) for row in rows}) == 1
    html = replace(inspection, part="<plate> & co")._repr_html_()
    assert html.startswith("<p>&lt;plate&gt; &amp; co") and html.count("<tr>") == len(rows) + 1
    assert f"<td>{one.distance_mm:.3f}</td>" in html and "None" not in html
    document = json.loads((ROOT / "samples" / "bracket_plate" / "inspection.json").read_text())
    assert [entry["name"] for entry in inspection.to_dict()["components"]] == [
        c["name"] for c in document["components"]
    ]


def test_inspections_cameras_and_detections_can_be_pickled_and_copied() -> None:
    inspection = load_inspection(ROOT / "samples" / "bracket_plate" / "inspection.json")
    part = load_part(ROOT / "samples" / "bracket_plate" / "part.toml")
    for value in (inspection, CAMERA, Detection(np.eye(4), 0.7), assembly(), part, PosePrior(np.eye(4), np.eye(6))):
        for made in (pickle.loads(pickle.dumps(value)), copy.deepcopy(value), copy.copy(value)):
            assert type(made) is type(value) and same(made, value)


def test_a_frame_is_shown_as_a_picture() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0] = 200
    shown = cv2.imdecode(np.frombuffer(Frame(image, 0, 0.0)._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (4, 6, 3) and shown[0, 0].tolist() == [0, 0, 200]
