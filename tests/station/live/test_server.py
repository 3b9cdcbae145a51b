"""The server without WebRTC: JPEG path of a phone, station camera, control, snapshots, recordings, inspection."""

from __future__ import annotations

import io
import json
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image as Pillow

from arview.station.live.stream.frames import from_jpeg, to_jpeg
from arview.video import open_source
from helpers.live_client import Http, Running, running, visiting, wait
from helpers.live_sample import (
    CAMERA,
    COUNT,
    HEIGHT,
    INSPECTION,
    WIDTH,
    errors,
    frames,
    loader,
    nearest,
    options,
    there_and_back,
    truth,
)
from helpers.told_station import told_loader


def send(page: Http, name: str, index: int, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Send a frame of the sample as JPEG; the frames are played forwards and backwards."""
    order = there_and_back()
    image = frames()[order[index % len(order)]]
    return page.ask(
        "POST", f"/api/clients/{name}/frame?id={index}", to_jpeg(image, 92), Content_Type="image/jpeg", **headers
    )


@pytest.fixture(scope="module")
def phones(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("live")
    shutil.copy(INSPECTION, folder / "inspection.json")
    chosen = options(inspection=folder / "inspection.json", record_folder=folder, max_age_s=None, clients=3)
    with running(chosen, loader(chosen)) as server:
        yield server


@pytest.fixture
def page(phones: Running) -> Iterator[Http]:
    yield from visiting(phones)


@pytest.mark.slow
def test_poses_by_jpeg_are_those_of_the_very_frame(page: Http) -> None:
    name = page.join()
    off_mm, off_deg = [], []
    for index in range(COUNT):
        status, _, content = send(page, name, index)
        answer = json.loads(content)
        assert status == 200 and answer["id"] == index and answer["state"] == "tracked"
        assert (answer["camera"]["width"], answer["camera"]["height"]) == (WIDTH, HEIGHT)
        assert nearest(answer) == index
        mm, deg = errors(answer, truth()[index])
        off_mm.append(mm)
        off_deg.append(deg)
    assert np.median(off_mm) < 1.0 and max(off_mm) < 3.0
    assert np.median(off_deg) < 0.3 and max(off_deg) < 1.0
    status = page.json("GET", f"/api/clients/{name}/status")[1]
    feed = status["feed"]
    assert (feed["kind"], feed["state"], feed["received"], feed["dropped"]) == ("phone", "live", COUNT, 0)
    assert (status["clients"], status["max_clients"], status["mode"]) == (1, 3, "poses")


@pytest.mark.slow
def test_annotated_picture_by_jpeg(page: Http) -> None:
    name = page.join(mode="video")
    status, headers, content = send(page, name, 0)
    answer = json.loads(headers["x-arview-answer"])
    assert (status, headers["content-type"], answer["id"], answer["state"]) == (200, "image/jpeg", 0, "tracked")
    drawn = from_jpeg(content).astype(int)
    assert drawn.shape == (HEIGHT, WIDTH, 3)
    changed = np.abs(drawn - frames()[0]).max(axis=2) > 60
    assert 0.05 < changed.mean() < 0.6  # ghosts, labels and the status line, not the whole picture
    # Fewer pixels are drawn when the page switches something off.
    page.json(
        "POST",
        f"/api/clients/{name}/control",
        {"style": {"ghost": False, "labels": False, "edges": "none", "status": False}},
    )
    plain = from_jpeg(send(page, name, 1)[2]).astype(int)
    assert (np.abs(plain - frames()[1]).max(axis=2) > 60).mean() < 0.02


@pytest.mark.slow
def test_control_changes_state_and_an_invalid_request_changes_nothing(page: Http) -> None:
    name = page.join()
    path = f"/api/clients/{name}/control"
    status, answer = page.json("POST", path, {"mode": "video", "style": {"opacity": 0.2, "only": "post_1"}})
    assert status == 200 and answer["mode"] == "video"
    style = {
        "ghost": True,
        "edges": "visible",
        "labels": True,
        "opacity": 0.2,
        "only": "post_1",
        "status": True,
        "only_part": 0,
    }
    assert answer["style"] == style
    for wrong in (
        {"mode": "sideways"}, {"mode": 3}, {"style": {"opacity": 7}}, {"style": {"opacity": True}}, {"unknown": 1},
        {"style": {"edges": "x"}}, {"style": {"only": "no_such"}}, {"style": []}, {"style": {"ghost": None}},
        {"confirm": 1}, {"hold": -1}, {"hold": True}, {"hold": 1 << 20}, {"record": "yes"},
        {"mode": "poses", "style": {"ghost": "yes"}}, {"screen": {"width": 390, "height": 220}}, {"screen": []},
        {"screen": {"width": 390.5, "height": 220, "density": 2}},
        {"screen": {"width": 390, "height": 9, "density": 2}},
        {"screen": {"width": 390, "height": 220, "density": True}},
    ):  # fmt: skip
        status, refused = page.json("POST", path, wrong)
        assert (status, refused["error"]) == (400, "bad_control"), wrong
    again = page.json("GET", f"/api/clients/{name}/status")[1]
    assert (again["mode"], again["style"]) == ("video", answer["style"])


@pytest.mark.slow
def test_reset_searches_again(page: Http) -> None:
    name = page.join()
    assert json.loads(send(page, name, 0)[2])["track_ms"] > 0
    hub_feed = page.json("POST", f"/api/clients/{name}/control", {"reset": True})[0]
    answer = json.loads(send(page, name, COUNT - 1)[2])  # 45 mm away: not to be tracked from the pose before
    assert hub_feed == 200 and answer["state"] == "tracked" and errors(answer, truth()[COUNT - 1])[0] < 3.0


@pytest.mark.slow
def test_a_page_confirms_the_part_in_view(page: Http) -> None:
    name = page.join()
    assert json.loads(send(page, name, 0)[2])["withheld"] is None
    assert page.json("POST", f"/api/clients/{name}/control", {"confirm": True})[0] == 200
    answer = json.loads(send(page, name, 1)[2])
    assert (answer["state"], answer["withheld"], answer["identity"]) == ("tracked", None, "confirmed")


@pytest.mark.slow
def test_snapshot_of_a_held_frame_with_all_about_it(page: Http) -> None:
    name = page.join()
    send(page, name, 3)
    page.json("POST", f"/api/clients/{name}/control", {"hold": 3})
    for index in range(4, 4 + 14):
        send(page, name, index)
    assert page.ask("GET", f"/api/clients/{name}/snapshot.png?id=4")[0] == 404
    status, headers, content = page.ask("GET", f"/api/clients/{name}/snapshot.png?id=3")
    assert (status, headers["content-type"]) == (200, "image/png")
    png = Pillow.open(io.BytesIO(content))
    assert png.size == (WIDTH, HEIGHT)
    about = json.loads(png.text["arview"])
    assert (about["frame_id"], about["part"], about["serial"]) == (3, "bracket_plate", "BP-0417")
    assert about["inspection"]["components"]["post_1"]["verdict"] == "fail"
    pose = {"cam_from_model": np.ravel(about["cam_from_model"]).tolist()}
    assert errors(pose, truth()[3])[0] < 3.0 and about["is_camera_guessed"] is False
    newest = json.loads(Pillow.open(io.BytesIO(page.ask("GET", f"/api/clients/{name}/snapshot.png")[2])).text["arview"])
    assert newest["frame_id"] == 17


@pytest.mark.slow
def test_recording_from_the_page(phones: Running, page: Http) -> None:
    name = page.join()
    send(page, name, 0)
    on = page.json("POST", f"/api/clients/{name}/control", {"record": True})[1]["recording"]
    assert on["is_on"] and on["finished"] == []
    assert phones.hub.recordings is not None
    recorder = phones.hub.recordings.of(phones.hub.clients[name].feed)
    assert recorder is not None
    for index in range(1, 9):
        send(page, name, index)
        wait(lambda count=index: recorder._frames == count)  # a slow recorder takes the newest picture only
    off = page.json("POST", f"/api/clients/{name}/control", {"record": False})[1]["recording"]
    assert not off["is_on"] and off["finished"] == [0]
    status, headers, content = page.ask("GET", "/api/recordings/0")
    assert (status, headers["content-type"]) == (200, "video/mp4")
    assert "bracket_plate" in headers["content-disposition"] and "/" not in headers["content-disposition"]
    with av.open(io.BytesIO(content)) as video:
        shown = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(shown) == 8 and shown[0].shape == (HEIGHT, WIDTH, 3)
    assert page.ask("GET", "/api/recordings/1")[0] == 404


def test_part_document_tells_what_the_inspection_says(page: Http) -> None:
    status, part = page.json("GET", "/api/part")
    assert status == 200 and part["state"] == "ready" and part["source"] == "phone"
    named = {component["name"]: component for component in part["components"]}
    assert len(named) == 11 and named["base_plate"]["verdict"] is None
    post = named["post_1"]
    assert (post["verdict"], post["verdict_text"], post["rank"]) == ("fail", "FAIL", 0)
    assert (post["distance_mm"], post["uncertainty_mm"], post["tolerance_mm"]) == (1.357, 0.12, 0.8)
    assert post["value_text"] == "1.36 mm" and "U 0.12" in post["detail_text"]
    assert str(INSPECTION.parent) not in json.dumps(part) and "/tmp" not in json.dumps(part)


@pytest.mark.slow
def test_model_glb_holds_the_cad_in_mm(page: Http, phones: Running) -> None:
    import trimesh

    status, headers, content = page.ask("GET", "/api/model.glb")
    assert (status, headers["content-type"]) == (200, "model/gltf-binary")
    assert page.ask("GET", "/api/model.glb", If_None_Match=headers["etag"])[0] == 304
    scene = trimesh.load(io.BytesIO(content), file_type="glb")
    assert phones.hub.subjects is not None
    components = phones.hub.subjects[0].part.model.components
    assert len(components) > 10
    for index, component in enumerate(components):
        mesh, lines = scene.geometry[f"c{index}"], scene.geometry[f"e{index}"]
        np.testing.assert_allclose(mesh.bounds, component.bounds_in_model, atol=1e-3)
        assert len(mesh.faces) == len(component.faces) and len(lines.entities) > 0
        np.testing.assert_allclose(lines.bounds, component.bounds_in_model, atol=1e-3)


@pytest.mark.slow
def test_too_many_pages_are_told_so_and_a_reload_is_not_one(page: Http, phones: Running) -> None:
    names = [page.join() for _ in range(3)]
    status, refused = page.json("POST", "/api/clients", {"transport": "jpeg"})
    assert (status, refused["error"]) == (503, "busy") and "3 of 3" in refused["message"]
    again = page.join(replaces=names[0])
    assert page.json("GET", f"/api/clients/{names[0]}/status")[1]["error"] == "no_such_client"
    assert page.ask("DELETE", f"/api/clients/{again}")[0] == 204
    assert page.ask("DELETE", f"/api/clients/{again}")[0] == 404
    assert len(phones.hub.clients) == 2


@pytest.mark.slow
def test_one_picture_in_flight(phones: Running, page: Http) -> None:
    name = page.join()
    client = phones.hub.clients[name]
    client.is_busy = True
    status, _, content = send(page, name, 0)
    assert (status, json.loads(content)["error"]) == (429, "one_in_flight")
    client.is_busy = False
    assert send(page, name, 0)[0] == 200


@pytest.mark.slow
def test_phone_of_another_shape_is_refused_in_words(page: Http) -> None:
    """The camera file is for 16:9, so 4:3 pictures are refused."""
    name = page.join()
    square = to_jpeg(np.zeros((480, 640, 3), dtype=np.uint8))
    status, _, content = page.ask("POST", f"/api/clients/{name}/frame?id=0", square, Content_Type="image/jpeg")
    answer = json.loads(content)
    assert status == 200 and answer["state"] == "searching" and answer["cam_from_model"] is None
    assert "camera.json" in answer["reason"] and str(CAMERA.parent) not in answer["reason"]
    notices = page.json("GET", f"/api/clients/{name}/status")[1]["notices"]
    assert "size_refused" in [notice["code"] for notice in notices]
    # Both landscape orientations and portrait belong to the same camera.
    assert json.loads(send(page, name, 0)[2])["state"] == "tracked"
    upright = to_jpeg(np.ascontiguousarray(np.rot90(frames()[0], -1)), 92)
    path = f"/api/clients/{name}/frame?id=1&turns=1"
    turned = json.loads(page.ask("POST", path, upright, Content_Type="image/jpeg")[2])
    assert (turned["camera"]["width"], turned["camera"]["height"]) == (HEIGHT, WIDTH)


def codes(page: Http) -> list[str]:
    return [notice["code"] for notice in page.json("GET", "/api/status")[1]["notices"]]


@pytest.mark.slow
def test_inspection_is_reloaded_and_garbage_keeps_the_last_good_one(page: Http, phones: Running) -> None:
    path = phones.server.options.inspections[0]
    assert path is not None
    good = json.loads(path.read_text())
    before = page.json("GET", "/api/part")[1]
    assert codes(page) == []
    path.write_text('{"schema_version": "1.0", "comp')
    wait(lambda: "inspection_unreadable" in codes(page))
    assert page.json("GET", "/api/part")[1]["revision"] == before["revision"]
    path.unlink()
    wait(lambda: "inspection_unreadable" in codes(page))
    other = {**good, "model_hash": "0" * 64}
    path.write_text(json.dumps(other))
    wait(lambda: "inspection_model" in codes(page))
    changed = {**good, "serial": "BP-0999"}
    changed["components"][0]["uncertainty_mm"] = 0.2
    path.write_text(json.dumps(changed))
    after = wait(lambda: (part := page.json("GET", "/api/part")[1])["revision"] > before["revision"] and part)
    assert {c["name"]: c for c in after["components"]}["post_1"]["uncertainty_mm"] == 0.2
    assert codes(page) == ["inspection_serial"]
    name = page.join(mode="video")
    assert json.loads(send(page, name, 0)[1]["x-arview-answer"])["revision"] == after["revision"]


@pytest.mark.slow
def test_part_is_aligned_with_a_guide_view_when_asked_for() -> None:
    """The response has the pose of the guide view; the part is accepted near it only."""
    chosen = options(guide="az-110_el50_d550", max_age_s=None)
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        name = page.join()
        answers = [json.loads(send(page, name, 0)[2]) for _ in range(4)]
        assert answers[-1]["state"] == "tracked" and errors(answers[-1], truth()[0])[0] < 3.0
    chosen = options(guide="az-40_el30", max_age_s=None)
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        name = page.join(mode="video")
        for index in range(3):
            _, headers, content = send(page, name, index)
            answer = json.loads(headers["x-arview-answer"])
            assert answer["state"] == "searching" and answer["cam_from_model"] is None
            outline = np.array(answer["guide_cam_from_model"]).reshape(4, 4)
            np.testing.assert_allclose(outline[:3, :3] @ outline[:3, :3].T, np.eye(3), atol=1e-9)
            yellow = (np.abs(from_jpeg(content).astype(int) - [255, 221, 87]).max(axis=2) < 60).sum()
            assert yellow > 500


@pytest.mark.slow
def test_old_inspection_and_guessed_camera_are_told() -> None:
    chosen = options(camera=None, max_age_s=60.0)
    with running(chosen, loader(chosen)) as server:
        assert codes(server.session()) == ["inspection_old", "camera_guessed"]


@pytest.mark.slow
def test_pages_wait_while_the_part_is_loaded() -> None:
    chosen = options()

    is_asked = threading.Event()

    def slowly() -> Any:
        assert is_asked.wait(60)
        return loader(chosen)()

    with running(chosen, slowly, until_ready=False) as server:
        page = server.session()
        assert page.json("GET", "/api/part")[1]["state"] == "loading"
        status, refused = page.json("POST", "/api/clients", {"transport": "jpeg"})
        assert (status, refused["error"]) == (503, "loading")
        assert page.json("GET", "/api/status")[1]["feed"] is None
        is_asked.set()
        wait(lambda: page.json("GET", "/api/part")[1]["state"] == "ready")
        assert page.join()


@pytest.mark.slow
def test_silent_pages_leave_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.station.live.server.hub.JPEG_SILENCE_S", 0.5)
    chosen = options()
    with running(chosen, loader(chosen)) as server:
        page = server.session()
        page.join()
        joined = len(server.hub.clients)
        wait(lambda: not server.hub.clients)
        assert joined == 1


@pytest.mark.slow
def test_every_phone_is_recorded_from_its_first_picture(tmp_path: Path) -> None:
    (tmp_path / "out-2.mp4").write_bytes(b"of another day")
    chosen = options(record=tmp_path / "out.mp4", record_folder=tmp_path, max_age_s=None)
    with running(chosen, told_loader(chosen)) as server:
        pages = [server.session(), server.session()]
        names = [page.join() for page in pages]
        for index in range(3):
            for page, name in zip(pages, names, strict=True):
                assert send(page, name, index)[0] == 200
            time.sleep(0.2)
        assert pages[0].ask("DELETE", f"/api/clients/{names[0]}")[0] == 204
        assert pages[1].json("GET", f"/api/clients/{names[1]}/status")[1]["recording"]["finished"] == [0]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "out-2.mp4",
        "out-3.jsonl",
        "out-3.mp4",
        "out.jsonl",
        "out.mp4",
    ]
    assert (tmp_path / "out-2.mp4").read_bytes() == b"of another day"
    for name in ("out.mp4", "out-3.mp4"):
        assert 1 <= len(list(open_source(tmp_path / name))) <= 3
