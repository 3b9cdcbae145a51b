"""Several parts on the page: the documents, requests and recordings of two specimens, one of which is confirmed."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from arview.errors import InputError
from arview.geometry import rigid
from arview.pose import Identity, Pose, TrackingState
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.annotated_png import _frame_data
from arview.station.live.server.clients import check_control
from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.documents import parts_document, pose_document, with_ages
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.frames import DecodedFrame
from arview.station.live.stream.subject import OverlayStyle
from arview.station.live.stream.subjects import Subjects
from helpers.live_client import Http, running
from helpers.live_sample import HEIGHT, INSPECTION, WIDTH, frames, loader, options, truth

NAMES = ("bracket_plate#1", "bracket_plate#2")


@pytest.fixture(scope="module")
def subjects() -> Subjects:
    """Two specimens of the sample; only the first one was inspected."""
    return loader(options(), instances=2)()


@pytest.fixture(scope="module")
def tracked(subjects: Subjects) -> TrackedFrame:
    """Both in one picture: the first where it is, the second withheld; it is drawn over the bench."""
    camera = subjects.camera(WIDTH, HEIGHT)
    beside = rigid(np.eye(3), [150.0, 0.0, 60.0]) @ truth()[0]
    poses = (
        Pose(truth()[0], None, 0.9, TrackingState.TRACKED, 0.0, 5, instance=NAMES[0]),
        Pose(
            beside, None, 0.7, TrackingState.CRITICAL, 0.0, 5, instance=NAMES[1], identity=Identity.UNCONFIRMED,
            identity_reason="it was out of sight",
        ),
    )  # fmt: skip
    return TrackedFrame(DecodedFrame(5, frames()[0]), poses, camera, 1.0, 1.0, 1.1, 0, 1, 1, subjects)


@pytest.mark.slow
def test_the_part_document_lists_all_parts_and_begins_with_the_first(subjects: Subjects) -> None:
    document = with_ages(parts_document(subjects), subjects)
    assert document["protocol"] == 3 and document["revision"] == 1
    first, second = document["parts"]
    assert [(one["id"], one["name"]) for one in (first, second)] == list(enumerate(NAMES))
    assert first["mark"] != second["mark"] and first["tag_color"] != second["tag_color"]
    for key in ("part", "components", "inspection", "arrow_scale"):  # what a page of version 1 reads
        assert document[key] == first[key]
    assert first["inspection"]["serial"] and second["inspection"] is None
    assert [one["verdict"] for one in second["components"]] == [None] * len(first["components"])
    alone = parts_document(loader(options())())
    assert "parts" not in alone and alone["components"] == first["components"]


@pytest.mark.slow
def test_the_pose_document_says_which_part_is_where(tracked: TrackedFrame) -> None:
    document = pose_document(tracked, 1.2)
    first, second = document["parts"]
    assert [one["id"] for one in (first, second)] == [0, 1]
    assert (first["state"], second["state"]) == ("tracked", "critical")
    np.testing.assert_allclose(first["cam_from_model"], truth()[0].ravel())
    assert second["cam_from_model"] != first["cam_from_model"]
    assert first["withheld"] is None and second["withheld"]["text"] == "it was out of sight"
    assert {key: document[key] for key in first if key != "id"} == {k: v for k, v in first.items() if k != "id"}
    assert "camera" in document and "camera" not in first
    json.dumps(document, allow_nan=False)


@pytest.mark.slow
def test_pictures_and_their_data_show_all_parts(subjects: Subjects, tracked: TrackedFrame) -> None:
    annotator = FrameAnnotator(subjects)
    both = annotator.draw_with_status(tracked).image
    assert both.shape == (HEIGHT, WIDTH, 3)
    alone = annotator.draw_with_status(
        TrackedFrame(
            tracked.frame,
            (tracked.poses[0], Pose(None, None, 0.0, TrackingState.LOST, 0.0, 5, instance=NAMES[1])),
            tracked.camera,
            1.0,
            1.0,
            1.1,
            0,
            1,
            2,
            subjects,
        )
    ).image
    assert (both != alone).any(axis=2).mean() > 0.03
    data = _frame_data(subjects, tracked)
    assert [(one["id"], one["instance"]) for one in data["parts"]] == list(enumerate(NAMES))
    assert data["state"] == data["parts"][0]["state"] == "tracked" and data["parts"][1]["state"] == "critical"
    assert data["parts"][1]["inspection"] is None and data["parts"][0]["inspection"] is not None


@pytest.mark.slow
def test_more_inspections_than_specimens_are_refused() -> None:
    chosen = options(inspections=(INSPECTION,) * 3)
    with pytest.raises(InputError, match="3 inspections for 2 specimens"):
        loader(chosen, instances=2)()


def test_a_control_request_names_the_part_it_means() -> None:
    style, names = OverlayStyle(), [["a", "b"], ["c"]]
    assert check_control({"confirm": 1, "reset": 0}, style, names) == style
    assert check_control({"confirm": True}, style, names[:1]) == style
    only = check_control({"style": {"only": "c", "only_part": 1}}, style, names)
    assert (only.only, only.only_part) == ("c", 1)
    assert check_control({"style": {"only": "a"}}, only, names).only_part == 0
    for wrong in (
        {"confirm": True}, {"confirm": 2}, {"confirm": -1}, {"reset": 2}, {"reset": 1.0}, {"confirm": None},
        {"style": {"only": "c"}}, {"style": {"only": "a", "only_part": 2}}, {"style": {"only_part": True}},
    ):  # fmt: skip
        with pytest.raises(Refusal):
            check_control(wrong, style, names)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Http]:
    folder: Path = tmp_path_factory.mktemp("several")
    chosen = options(record_folder=folder)
    with running(chosen, loader(chosen, instances=2)) as server:
        yield server.session()


@pytest.mark.slow
def test_a_phone_gets_both_poses_and_a_recording_of_them(page: Http, tmp_path: Path) -> None:
    from arview.station.live.stream.frames import to_jpeg

    status, part = page.json("GET", "/api/part")
    assert status == 200 and len(part["parts"]) == 2
    models = [page.ask("GET", f"/api/model.glb?part={number}") for number in (0, 1)]
    assert [one[0] for one in models] == [200, 200] and models[0][2] == models[1][2]
    assert page.ask("GET", "/api/model.glb?part=2")[0] == 400
    _, joined = page.json("POST", "/api/clients", {"transport": "jpeg"})
    client = f"/api/clients/{joined['client']}"
    assert page.json("POST", f"{client}/control", {"record": True})[0] == 200
    states = []
    for number in range(6):
        jpeg = to_jpeg(frames()[number], 92)
        answer = page.ask("POST", f"{client}/frame?id={number}", jpeg, Content_Type="image/jpeg")
        assert answer[0] == 200
        pose = json.loads(answer[2])
        states.append([one["state"] for one in pose["parts"]])
        time.sleep(0.2)
    assert "tracked" in {state for pair in states for state in pair}
    assert all(pair.count("tracked") <= 1 for pair in states), "one specimen is in view"
    assert page.json("POST", f"{client}/control", {"confirm": True})[0] == 400
    assert page.json("POST", f"{client}/control", {"confirm": 1})[0] == 200
    _, told = page.json("POST", f"{client}/control", {"record": False})
    (number,) = told["recording"]["finished"]
    assert page.ask("GET", f"/api/recordings/{number}")[0] == 200
    page.ask("DELETE", client)
