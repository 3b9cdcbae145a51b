"""The station camera: files, streams that break and return, frozen pictures, screens that watch."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arview.errors import InputError
from arview.station.live.options import LiveOptions
from arview.station.live.security.addresses import LOOPBACK
from arview.station.live.stream import station
from arview.station.live.stream.frames import from_jpeg
from arview.video import Frame, FrameSource, Image, VideoSink, open_source
from arview.video.sources import check_source
from helpers.live_client import Http, Running, paired_cookie, running, wait
from helpers.live_sample import HEIGHT, WIDTH, errors, frames, loader, options, there_and_back, truth

pytestmark = pytest.mark.slow  # a camera that plays in real time


class Cable(FrameSource):
    """A live camera that can be unplugged, plugged in again, and can freeze."""

    is_live, fps = True, 30.0
    width, height = WIDTH, HEIGHT

    def __init__(self) -> None:
        self.name = "camera 0"
        self.is_plugged, self.is_frozen = True, False
        self.opened = 0
        self._count = 0

    def open(self, spec: str, **timeouts: float) -> FrameSource:
        if spec != "0":  # of another server that runs at the same time
            return open_source(spec, **timeouts)
        if not self.is_plugged:
            raise InputError("camera 0: there is no camera 0, or it is in use")
        self.opened += 1
        self.ended_reason = ""
        return self

    def __iter__(self) -> Iterator[Frame]:
        order = there_and_back()
        while self.is_plugged:
            if not self.is_frozen:
                self._count += 1
            time.sleep(1 / 30)
            image = frames()[order[self._count % len(order)]].copy()
            image[0, 0] = self._count % 251
            image[:7, :7] = self._count % 251
            yield Frame(image, self._count, time.monotonic())
        self.ended_reason = "camera 0: the camera gives no more frames; was it unplugged?"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("station") / "clip.mp4"
    with VideoSink(path, WIDTH, HEIGHT, 15.0, crf=10) as sink:
        for count, index in enumerate(there_and_back()):
            sink.write(frames()[index], count / 15.0)
    return path


@pytest.fixture(scope="module")
def playing(clip: Path) -> Iterator[Running]:
    chosen = options(source=str(clip), max_age_s=None)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("arview.station.live.server.app.WATCHERS", 2)
        with running(chosen, loader(chosen)) as server:
            yield server


def newest(page: Http, name: str, after: int = -1) -> tuple[dict[str, Any], Image]:
    """Pose and picture of the next frame."""
    query = f"?after={after}" if after >= 0 else ""
    for _ in range(12):
        status, headers, content = page.ask("GET", f"/api/clients/{name}/frame{query}")
        assert status in (200, 204)
        if status == 200:
            break
    return json.loads(headers["x-arview-answer"]), from_jpeg(content)


def test_file_is_played_and_all_pages_see_its_poses(playing: Running) -> None:
    page, other = playing.session(), playing.session()
    name, other_name = page.join(), other.join(mode="video")
    wait(lambda: (feed := playing.hub.watched()) and feed[0].newest and feed[0].newest.pose.cam_from_model is not None)
    order = there_and_back()
    last, seen = -1, 0
    for _ in range(8):
        answer, picture = newest(page, name, last)
        assert answer["id"] != last
        last = answer["id"]
        index = order[last % len(order)]
        # The picture belongs to the pose: it is the most similar frame, and the pose is correct.
        differences = [float(np.abs(picture.astype(int) - frame).mean()) for frame in frames()]
        assert int(np.argmin(differences)) == index
        if answer["cam_from_model"] is not None:
            seen += 1
            assert errors(answer, truth()[index])[0] < 3.0
    assert seen >= 6
    answer, picture = newest(other, other_name)
    plain = frames()[order[answer["id"] % len(order)]]
    assert (np.abs(picture.astype(int) - plain).max(axis=2) > 60).mean() > 0.05  # drawn on
    status = page.json("GET", "/api/status")[1]
    assert status["feed"]["kind"] == "station" and status["feed"]["state"] == "live"
    assert 3.0 < status["feed"]["received_fps"] < 20.0  # its own rate is 15
    part = page.json("GET", "/api/part")[1]
    assert (part["source"], part["source_name"]) == ("station", "clip.mp4")
    sent = page.ask("POST", f"/api/clients/{name}/frame?id=0", b"x", Content_Type="image/jpeg")
    assert sent[0] == 400


def test_screens_that_watch_get_motion_jpeg_and_only_so_many(playing: Running) -> None:
    watching = []
    for _ in range(2):
        connection = http.client.HTTPConnection(LOOPBACK, playing.port, timeout=20)
        connection.request("GET", "/watch.mjpg", headers={"Cookie": paired_cookie(playing.port, playing.token)})
        answer = connection.getresponse()
        assert answer.status == 200 and "multipart/x-mixed-replace" in answer.headers["content-type"]
        watching.append((connection, answer))
    pictures = b""
    began_s = time.monotonic()
    while pictures.count(b"--arview-frame") < 4 and time.monotonic() - began_s < 20:
        pictures += watching[0][1].read(20_000)
    parts = pictures.split(b"--arview-frame\r\n")[1:3]
    assert len(parts) == 2
    for part in parts:
        head, content = part.split(b"\r\n\r\n", 1)
        length = int(head.split(b"Content-Length: ")[1].split(b"\r\n")[0])
        assert from_jpeg(content[:length]).shape == (HEIGHT, WIDTH, 3)
    wait(lambda: playing.hub.watchers == 2)
    status, refused = playing.session().json("GET", "/watch.mjpg")
    assert (status, refused["error"]) == (503, "busy")
    for connection, answer in watching:
        answer.close()
        connection.close()
    wait(lambda: playing.hub.watchers == 0)


def test_twenty_pages_show_one_station(clip: Path) -> None:
    """Each page gets plain or annotated pictures; each picture is drawn and encoded once."""
    from concurrent.futures import ThreadPoolExecutor

    chosen = options(source=str(clip), max_age_s=None, clients=20)
    with running(chosen, loader(chosen)) as server:

        def fetch(number: int) -> list[int]:
            page = server.session()
            name = page.join(mode="video" if number % 2 else "poses")
            ids = []
            for _ in range(4):
                answer, picture = newest(page, name, ids[-1] if ids else -1)
                assert picture.shape == (HEIGHT, WIDTH, 3)
                ids.append(answer["id"])
            return ids

        with ThreadPoolExecutor(20) as pool:
            for ids in pool.map(fetch, range(20)):
                assert len(set(ids)) == 4
        assert len(server.hub.clients) == 20
        assert server.session().json("POST", "/api/clients", {"transport": "jpeg"})[0] == 503


def test_camera_that_breaks_is_told_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    cable = Cable()
    monkeypatch.setattr(station, "open_source", cable.open)
    monkeypatch.setattr(station, "FROZEN_S", 1.2)
    chosen = options(source="0", max_age_s=None)
    with running(chosen, loader(chosen)) as server:
        page = server.session()

        def said() -> tuple[str, list[str]]:
            status = page.json("GET", "/api/status")[1]
            return status["feed"]["state"], [notice["code"] for notice in status["notices"]]

        wait(lambda: said() == ("live", []))
        cable.is_plugged = False
        wait(lambda: said() == ("reconnecting", ["source_reconnecting"]))
        notices = page.json("GET", "/api/status")[1]["notices"]
        assert "unplugged" in notices[0]["text"] or "no camera 0" in notices[0]["text"]
        cable.is_plugged = True
        wait(lambda: said() == ("live", []))
        assert cable.opened == 2
        name = page.join()
        wait(lambda: newest(page, name)[0]["state"] == "tracked")
        cable.is_frozen = True
        wait(lambda: said() == ("frozen", ["source_frozen"]))
        cable.is_frozen = False
        wait(lambda: said() == ("live", []))


def test_a_stream_over_http_is_killed_and_served_again(clip: Path) -> None:
    """A real connection: an MPEG-TS server on the loopback interface that is closed in the middle and restarted."""
    content = _mpegts(clip)
    stream = _Stream(content)
    chosen = options(source=f"http://user:secret@{LOOPBACK}:{stream.port}/1", max_age_s=None)
    try:
        with running(chosen, loader(chosen)) as server:
            page = server.session()

            def feed() -> Any:
                return page.json("GET", "/api/status")[1]["feed"]

            wait(lambda: feed()["received"] > 3)
            stream.stop()
            wait(lambda: feed()["state"] == "reconnecting")
            told = json.dumps(page.json("GET", "/api/status")[1]) + json.dumps(page.json("GET", "/api/part")[1])
            assert "secret" not in told
            received = feed()["received"]
            stream.start()
            wait(lambda: feed()["received"] > received + 3)
            wait(lambda: feed()["state"] == "live")
    finally:
        stream.stop()


def test_recording_of_a_station_from_the_start(clip: Path, tmp_path: Path) -> None:
    chosen = options(source=str(clip), max_age_s=None, record=tmp_path / "out.mp4", record_folder=tmp_path)
    with running(chosen, loader(chosen)) as server:
        wait(lambda: (feed := server.hub.watched()) and feed[0].newest and feed[0].newest.serial > 12)
        assert server.hub.status(None)["recording"]["is_on"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.jsonl", "out.mp4"]
    shown = list(open_source(tmp_path / "out.mp4"))
    poses = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [one["index"] for one in poses] == list(range(len(shown))) and "camera" in poses[0]
    assert len(shown) >= 5 and shown[0].image.shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("spec", ["no_such_file.mp4", "shots/*.jpg"])
def test_a_source_that_cannot_be_is_refused_at_once(spec: str) -> None:
    with pytest.raises(InputError):
        assert check_source(spec) is None
    with pytest.raises(InputError):
        check_source("/nowhere/clip.mp4")


@pytest.mark.parametrize("spec", ["0", "/dev/video7", "rtsp://127.0.0.1:9/1"])
def test_a_camera_need_not_be_there_yet(spec: str) -> None:
    assert check_source(spec) is None
    with pytest.raises(InputError):
        check_source("/nowhere/clip.mp4")


@pytest.mark.parametrize(
    "wrong", [{"width": 641}, {"height": 20}, {"fps": 0.0}, {"clients": 0}, {"max_age_s": 0.0}, {"width": 4000}]
)
def test_options_outside_their_range(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        LiveOptions(**wrong)


def _mpegts(clip: Path) -> bytes:
    """The clip as an MPEG transport stream."""
    import io

    import av

    file = io.BytesIO()
    with av.open(str(clip)) as source, av.open(file, "w", format="mpegts") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    return file.getvalue()


class _Stream:
    """A server that sends a recorded stream slowly until it is stopped."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.port = 0
        self.start()

    def start(self) -> None:
        import http.server

        content, outer = self._content, self
        self._is_on = True

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "video/mp2t")
                self.end_headers()
                step = max(188, len(content) // 200)
                for place in range(0, len(content), step):
                    if not outer._is_on:
                        self.connection.close()
                        return
                    self.wfile.write(content[place : place + step])
                    time.sleep(0.02)

            def log_message(self, *_: Any) -> None:
                pass

        http.server.ThreadingHTTPServer.allow_reuse_address = True
        self._server = http.server.ThreadingHTTPServer((LOOPBACK, self.port), Handler)
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def stop(self) -> None:
        if self._is_on:
            self._is_on = False
            self._server.shutdown()
            self._server.server_close()
