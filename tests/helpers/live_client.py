"""A live server in a thread, and clients for it on the loopback interface: plain HTTP, and a phone by WebRTC."""

from __future__ import annotations

import asyncio
import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Self

import numpy as np
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.mediastreams import MediaStreamTrack
from av.video.frame import VideoFrame

from arview.station.live.options import LiveOptions
from arview.station.live.security.addresses import LOOPBACK
from arview.station.live.server.hub import Hub
from arview.station.live.server.live_server import LiveServer, open_endpoint
from arview.station.live.stream.stamp import read_stamp, stamped
from arview.station.live.stream.subjects import Subjects
from arview.station.live.transport.receiving import reduce_latency, restrict_candidates
from arview.video import Image


@dataclass
class Running:
    """A running server."""

    server: LiveServer
    hub: Hub

    @property
    def port(self) -> int:
        return self.server.endpoint.port

    @property
    def token(self) -> str:
        return self.server.access.token

    def session(self, **headers: str) -> Http:
        return Http(self.port, self.token, headers)


@contextmanager
def running(options: LiveOptions, load: Callable[[], Subjects], until_ready: bool = True) -> Iterator[Running]:
    """A server at a free port of the loopback interface, which is stopped at the end of the block."""
    server = LiveServer(options, open_endpoint(None, 0, is_plain=True))
    ready = threading.Event()
    hubs: list[Hub] = []
    failures: list[BaseException] = []

    def note(hub: Hub) -> None:
        hubs.append(hub)
        ready.set()

    def run() -> None:
        try:
            asyncio.run(server.serve(load, note))
        except BaseException as error:
            failures.append(error)
            ready.set()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    if until_ready:
        assert ready.wait(60), "the server did not get ready"
    else:
        time.sleep(0.3)
    try:
        if failures:
            raise failures[0]
        yield Running(server, hubs[0] if hubs else None)  # type: ignore[arg-type]
    finally:
        server.stop()
        thread.join(20)
        assert not thread.is_alive(), "the server did not end"


def paired_cookie(port: int, token: str) -> str:
    """The cookie that a browser gets when it opens the link with the token of the run."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=120)
    connection.request("GET", f"/?token={token}")
    answer = connection.getresponse()
    answer.read()
    cookie = (answer.getheader("Set-Cookie") or f"arview_{port}=").split(";")[0]
    connection.close()
    return cookie


class Http:
    """Requests of a page over one connection."""

    def __init__(self, port: int, token: str, headers: dict[str, str] | None = None) -> None:
        self._connection = http.client.HTTPConnection(LOOPBACK, port, timeout=120)
        origin = f"http://{LOOPBACK}:{port}"
        self.headers = {"Cookie": paired_cookie(port, token), "Origin": origin, **(headers or {})}

    def ask(
        self, method: str, path: str, content: bytes | None = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers in lower case, body."""
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        for attempt in (1, 2):
            try:
                self._connection.request(method, path, content, {**self.headers, **named})
                answer = self._connection.getresponse()
                return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
            except (http.client.RemoteDisconnected, ConnectionError):
                self._connection.close()
                if attempt == 2:
                    raise
        raise AssertionError

    def json(self, method: str, path: str, content: Any = None) -> tuple[int, Any]:
        """Status and document."""
        body = None if content is None else json.dumps(content).encode()
        headers = {"Content_Type": "application/json"} if body is not None else {}
        status, _, answer = self.ask(method, path, body, **headers)
        return status, json.loads(answer) if answer else None

    def join(self, **wanted: Any) -> str:
        """Join; returns the name of the client."""
        status, answer = self.json("POST", "/api/clients", {"transport": "jpeg", "mode": "poses", **wanted})
        assert status == 201, answer
        return str(answer["client"])

    def close(self) -> None:
        self._connection.close()


class Camera(MediaStreamTrack):
    """Stamped frames at a constant rate in a loop; records when each id was sent."""

    kind = "video"

    def __init__(self, images: Sequence[Image], fps: float, first_id: int = 0) -> None:
        super().__init__()
        self._images, self._fps, self.next_id = images, fps, first_id
        self._first_id, self._began_s = first_id, 0.0
        self.sent_s: dict[int, float] = {}

    async def recv(self) -> VideoFrame:
        count = self.next_id - self._first_id
        if count == 0:
            self._began_s = time.monotonic()
        await asyncio.sleep(max(0.0, self._began_s + count / self._fps - time.monotonic()))
        frame_id = self.next_id
        self.next_id += 1
        image = stamped(self._images[count % len(self._images)], frame_id)
        frame = VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = round(count * 90_000 / self._fps), Fraction(1, 90_000)
        self.sent_s[frame_id] = time.monotonic()
        return frame


@dataclass
class Phone:
    """A page with WebRTC.

    Attributes:
        answers: poses that came, with the moment.
        statuses: statuses that came.
        shown: ids of the video frames that came back, with the moment.
        pictures: the last of these frames, whole.
    """

    http: Http
    camera: Camera | None
    mode: str = "poses"
    pause_s: float = 0.0  # taken after each video frame: a slow screen
    answers: list[tuple[float, dict[str, Any]]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    shown: list[tuple[float, int | None]] = field(default_factory=list)
    picture: Image | None = None
    name: str = ""
    change_offer: Callable[[str], str] = str

    async def __aenter__(self) -> Self:
        self._peer = peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._tasks: list[asyncio.Task[None]] = []
        if self.camera is not None:
            peer.addTransceiver(self.camera, "sendrecv")
        else:
            peer.addTransceiver("video", "recvonly")
        channel = peer.createDataChannel("arview", ordered=False, maxRetransmits=0)
        channel.on("message", self._take)
        peer.on("track", self._watch)
        opened = asyncio.Event()
        channel.on("open", opened.set)
        restrict_candidates(peer, [LOOPBACK])
        await peer.setLocalDescription(await peer.createOffer())
        offer = {"type": "offer", "sdp": self.change_offer(peer.localDescription.sdp)}
        wanted = {"transport": "webrtc", "mode": self.mode, "offer": offer}
        status, answer = await asyncio.to_thread(self.http.json, "POST", "/api/clients", wanted)
        if status != 201:
            await peer.close()
            raise RuntimeError(f"{status} {answer}")
        self.name = answer["client"]
        self.answer_sdp = answer["answer"]["sdp"]
        await peer.setRemoteDescription(RTCSessionDescription(self.answer_sdp, "answer"))
        await asyncio.wait_for(opened.wait(), 20)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.vanish()
        with suppress(Exception):
            await asyncio.to_thread(self.http.ask, "DELETE", f"/api/clients/{self.name}")

    async def vanish(self) -> None:
        """Disappear without closing the connection."""
        for task in self._tasks:
            task.cancel()
        await self._peer.close()

    async def until(self, condition: Callable[[], Any], timeout_s: float = 30.0) -> None:
        """Wait until a condition is true."""
        async with asyncio.timeout(timeout_s):
            while not condition():
                await asyncio.sleep(0.02)

    def states(self) -> list[str]:
        return [answer["state"] for _, answer in self.answers]

    def _take(self, message: str) -> None:
        document = json.loads(message)
        if document["type"] == "pose":
            self.answers.append((time.monotonic(), document))
        else:
            self.statuses.append(document)

    def _watch(self, track: Any) -> None:
        for transceiver in self._peer.getTransceivers():
            reduce_latency(transceiver.receiver)

        async def watch() -> None:
            with suppress(Exception):
                while True:
                    frame = await track.recv()
                    image = await asyncio.to_thread(frame.to_ndarray, format="rgb24")
                    stamp = read_stamp(np.ascontiguousarray(image[:, :, 1]))
                    self.shown.append((time.monotonic(), stamp.frame_id if stamp else None))
                    self.frame = image
                    await asyncio.sleep(self.pause_s)

        self._tasks.append(asyncio.ensure_future(watch()))


def visiting(server: Running) -> Iterator[Http]:
    """A page of a server; at the end its clients leave."""
    page = server.session()
    yield page
    for name in list(server.hub.clients):
        page.ask("DELETE", f"/api/clients/{name}")
    page.close()


def wait(condition: Callable[[], Any], timeout_s: float = 60.0) -> Any:
    """Wait until a condition is true; returns its value."""
    ends_s = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < ends_s, "it did not happen in time"
        time.sleep(0.01)
    return value
