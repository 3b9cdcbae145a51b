"""Requests to the application of `arview live`, called as a server calls it, without a network."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from guard import Fault, guarded
from hypothesis import strategies as st
from mutations import CHANGES, changed
from seeds import make_seeds

from arview.guideviews import GuideViewOptions
from arview.station.live.options import JobOptions, LiveOptions, RequestLimits
from arview.station.live.security.access import Access
from arview.station.live.server.app import make_app
from arview.station.live.server.hub import Hub
from arview.station.live.server.loading import load_subjects

HOST = "127.0.0.1:8443"
PIECES = (
    "/",
    "api",
    "clients",
    "part",
    "static",
    "watch",
    "frame",
    "control",
    "NAME",
    "..",
    "%00",
    "é",
    "?id=",
    "1",
    "=",
    "&",
    "snapshot.png",
    "recordings",
    "index.html",
    "\\",
    "//",
    "model.glb",
    "status",
    "turns",
    "after",
    "token",
    "jobs",
    "JOB",
    "uploads",
    "photos",
    "rework",
    "devices",
    "snapshots",
)
PATHS = (
    "/api/clients",
    "/api/clients/NAME/control",
    "/api/clients/NAME/frame?id=1",
    "/api/clients/NAME/frame?id=2&turns=3",
    "/api/clients/NAME/snapshot.png",
    "/api/status",
    "/api/part",
    "/api/recordings/0",
    "/",
    "/watch",
    "/api/clients/NAME/status",
    "/static/main.js",
    "/api/model.glb",
    "/api/part?client=NAME",
    "/api/recordings",
    "/api/devices",
    "/api/devices/Device",
    "/api/snapshots",
    "/api/clients/NAME/snapshots?id=1",
    "/api/jobs",
    "/api/jobs/JOB",
    "/api/jobs/JOB/capture",
    "/api/jobs/JOB/uploads",
    "/api/jobs/JOB/uploads/UPLOAD",
    "/api/jobs/JOB/uploads/UPLOAD?offset=0",
    "/api/jobs/JOB/take",
    "/api/jobs/JOB/end",
    "/api/jobs/JOB/reopen",
    "/api/jobs/JOB/recheck",
    "/api/jobs/JOB/decisions",
    "/api/jobs/JOB/ticks",
    "/api/jobs/JOB/sign",
    "/api/jobs/JOB/photos/0001.jpg",
    "/api/jobs/JOB/decisions.csv",
    "/api/jobs/JOB/report.html",
    "/api/jobs/JOB/rework/brick.svg",
)
BODIES = (
    b"",
    b"{}",
    b'{"transport": "jpeg", "mode": "poses"}',
    b'{"mode": "poses", "style": {"ghost": true, "edges": "all", "labels": false, "opacity": 0.5, "only": "brick", '
    b'"status": false}, "reset": true, "confirm": true, "hold": 1, "record": false}',
    b'{"transport": "webrtc", "mode": "video", "offer": {"type": "offer", "sdp": "'
    b"v=0\\r\\no=- 1 2 IN IP4 127.0.0.1\\r\\n"
    b's=-\\r\\nt=0 0\\r\\na=group:BUNDLE 0 1\\r\\nm=video 9 UDP/TLS/RTP/SAVPF 96\\r\\na=mid:0\\r\\n"}}',
)
JOB_BODIES = (
    b'{"part": 0, "serial": "BP-1"}',
    b'{"bytes": 1000, "sha256": "' + b"ab" * 32 + b'", "source": "still", "taken": "2026-11-27T08:00:00Z", "hint": '
    b'{"cam_from_model": [1,0,0,0,0,1,0,0,0,0,1,300,0,0,0,1], "camera": {}, "quality": 0.5}, '
    b'"media_type": "image/jpeg"}',
    b'{"job": "JOB", "capture": "JOB"}',
    b'{"client": "NAME"}',
    b'{"components": ["brick"]}',
    b'{"component": "brick", "is_ok": false, "reason": "bent", "note": "", "by": "Ada", "photo": null}',
    b'{"component": "brick", "step": 0, "is_done": true, "by": "Ada"}',
)
HEADERS = (
    ("content-type", "application/json"),
    ("content-type", "image/jpeg"),
    ("content-type", "text/plain"),
    ("content-length", "5"),
    ("content-length", "-1"),
    ("content-length", "99999999999"),
    ("origin", "http://x"),
    ("sec-fetch-site", "cross-site"),
    ("cookie", "a=\xff"),
    ("host", "x"),
    ("range", "bytes=0-1,3-2"),
    ("if-none-match", "*"),
    ("accept", "\xff" * 3000),
)
REQUESTS = st.tuples(
    st.sampled_from(["GET", "POST", "DELETE", "PUT", "HEAD", "PATCH", "FOO"]),
    st.one_of(
        st.sampled_from(PATHS), st.lists(st.sampled_from(PIECES), max_size=6).map(lambda parts: "/" + "".join(parts))
    ),
    st.lists(st.sampled_from(HEADERS), max_size=3),
    st.integers(0, 100),
    st.one_of(st.just([]), CHANGES),
)


async def ask(app: Any, method: str, target: str, headers: list[tuple[str, str]], body: bytes) -> tuple[int, bytes]:
    """Status and body of the response."""
    path, _, query = target.partition("?")
    sent: list[dict[str, Any]] = []
    pending = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> dict[str, Any]:
        return pending.pop() if pending else {"type": "http.disconnect"}

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": path,
        "raw_path": path.encode("utf-8"),
        "query_string": query.encode("utf-8"),
        "root_path": "",
        "client": ("127.0.0.1", 5000),
        "server": ("127.0.0.1", 8443),
        "headers": [(name.encode("latin-1"), value.encode("latin-1")) for name, value in headers],
    }
    await asyncio.wait_for(app(scope, receive, send), 20.0)
    content = b"".join(one.get("body", b"") for one in sent if one["type"] == "http.response.body")
    return int(sent[0]["status"]), content


def check_answer(name: str, method: str, target: str, status: int, content: bytes) -> None:
    """Raise Fault unless an answer is one that the server may give: no failure, errors as JSON."""
    if status == 500 or not 200 <= status < 600:
        raise Fault(f"{name} {status}", f"{method} {target} {content[:200]!r}")
    if status >= 400 and method != "HEAD" and status != 403:
        json.loads(content)


def fuzz_requests(folder: Path) -> tuple[Callable[[Any], None], st.SearchStrategy[Any]]:
    """The attempt on the application and the strategy of its argument."""
    home = folder / "http" / "seeds"
    seeds = make_seeds(home, "part", "picture")
    jpeg = next(path for path in seeds["picture"] if path.suffix == ".jpg").read_bytes()
    bodies = (*BODIES, *JOB_BODIES, jpeg)
    options = LiveOptions(
        requests=RequestLimits(
            per_s=1e9,
            burst=1e9,
            unauthenticated_per_s=1e9,
            unauthenticated_burst=1e9,
            joins_per_s=1e9,
            joins_burst=1e9,
            images_per_s=1e9,
            images_burst=1e9,
        ),
        camera="fov:60",
        record_folder=folder / "http",
        jobs=JobOptions(folder / "http" / "jobs", min_free_bytes=0, workers=0),
        clients=4,
    )
    views = GuideViewOptions(subdivisions=0, resolution_px=100, renderer="zbuffer")
    subject = load_subjects([str(home / "part.toml")], None, None, options, views)
    loop = asyncio.new_event_loop()
    access = Access.to(["127.0.0.1"], 8443, False)
    usual = [("host", HOST), ("origin", f"http://{HOST}"), ("cookie", access.cookie.split(";")[0])]

    async def start() -> tuple[Hub, Any]:
        hub = Hub(options, ["127.0.0.1"])
        hub.begin(subject)
        return hub, make_app(hub, access)

    hub, app = loop.run_until_complete(start())
    hub.desk.begin(subject)
    job, _ = hub.desk.start(0, "BP-1", None)

    def filled(text: str, name: str) -> str:
        return text.replace("NAME", name).replace("JOB", job.id).replace("UPLOAD", "ab" * 16)

    async def client() -> str:
        if not hub.clients:
            made, _ = await hub.join({"transport": "jpeg", "mode": "poses"})
            return made.name
        return next(iter(hub.clients))

    def attempt(argument: tuple[str, str, list[tuple[str, str]], int, list[Any]]) -> None:
        method, target, more, number, changes = argument
        body = changed(bodies[number % len(bodies)], changes, False)
        (folder / "http" / "current").write_bytes(repr((method, target, more)).encode() + b"\n" + body)

        async def one() -> tuple[int, bytes]:
            name = await client()
            names = {name for name, _ in more}
            headers = [*[pair for pair in usual if pair[0] not in names], *more]
            content = body.replace(b"JOB", job.id.encode()).replace(b"NAME", name.encode())
            return await ask(app, method, filled(target, name), headers, content)

        if "watch.mjpg" in target:
            return
        with guarded("http", folder / "http" / "native.txt"):
            status, content = loop.run_until_complete(one())
            check_answer("http", method, target, status, content)

    return attempt, REQUESTS
