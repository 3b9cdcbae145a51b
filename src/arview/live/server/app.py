"""The web application: routes and what each of them does."""

from __future__ import annotations

import asyncio
import json
import logging
import mimetypes
import time
from importlib import resources
from importlib.resources.abc import Traversable

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from arview.errors import InputError
from arview.live.protocol import ANSWER_HEADER, FRAME_IDS
from arview.live.security.access import Access, Gate
from arview.live.security.limits import (
    CONTROL_BYTES,
    JPEG_BYTES,
    OFFER_BYTES,
    RateLimit,
    body,
    json_body,
)
from arview.live.security.refusals import Refusal
from arview.live.server.annotated_png import snapshot_png
from arview.live.server.clients import Client
from arview.live.server.hub import Hub
from arview.live.stream.documents import Document, pose_document
from arview.live.stream.feed import Tracked
from arview.live.stream.frames import Incoming, Picture, from_jpeg
from arview.live.transport.motion_jpeg import MotionJpeg

logger = logging.getLogger("arview.live")

TRACKING_TIMEOUT_S = 10.0
"""A frame that is not tracked by then, in a search on a busy machine, is given up."""
FRAME_WAIT_S = 5.0
SNAPSHOTS_PER_S, SNAPSHOTS_BURST = 2.0, 6.0
"""Of one page: drawing and packing a PNG takes 50 ms of a core that others track with."""
SERVED = {".html", ".js", ".css", ".svg", ".png", ".webmanifest", ".woff2", ".txt", ".json"}
_TYPES = {".js": "text/javascript", ".webmanifest": "application/manifest+json", ".woff2": "font/woff2"}
_CODES = {404: "not_found", 405: "bad_method"}


def make_app(hub: Hub, access: Access) -> ASGIApp:
    """The application behind its gate."""
    options = hub.options
    handlers = Handlers(hub)
    client = "/api/clients/{client}"
    routes = [
        Route("/", handlers.index),
        Route("/watch", handlers.watch),
        Route("/watch.mjpg", handlers.watch_mjpg),
        Route("/static/{name:path}", handlers.static),
        Route("/api/part", handlers.part),
        Route("/api/model.glb", handlers.model),
        Route("/api/status", handlers.status),
        Route("/api/clients", handlers.join, methods=["POST"]),
        Route(client, handlers.leave, methods=["DELETE"]),
        Route(f"{client}/status", handlers.client_status),
        Route(f"{client}/control", handlers.control, methods=["POST"]),
        Route(f"{client}/frame", handlers.take_frame, methods=["POST"]),
        Route(f"{client}/frame", handlers.give_frame),
        Route(f"{client}/snapshot.png", handlers.snapshot),
        Route("/api/recordings/{number:int}", handlers.recording),
    ]
    app = Starlette(routes=routes, exception_handlers={Refusal: _refused, HTTPException: _not_served, Exception: _bug})
    return Gate(app, access, RateLimit(options.requests_per_s, options.requests_burst))


class Handlers:
    """What the routes do; the protocol says what they take and give."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._joins = RateLimit(hub.options.joins_per_s, hub.options.joins_burst)
        self._snapshots = RateLimit(SNAPSHOTS_PER_S, SNAPSHOTS_BURST)
        self._files = page_files()

    async def index(self, request: Request) -> Response:
        """The page."""
        return self._file("index.html")

    async def watch(self, request: Request) -> Response:
        """The page for screens that only watch."""
        return self._file("watch.html")

    async def static(self, request: Request) -> Response:
        """A file of the page."""
        return self._file(request.path_params["name"])

    async def watch_mjpg(self, request: Request) -> Response:
        """Motion JPEG of what is annotated."""
        self._hub.ready()
        if self._hub.watchers >= self._hub.options.watchers:
            raise Refusal(503, "busy", f"busy: {self._hub.watchers} screens watch already")
        return MotionJpeg(self._hub, self._hub.options.watch_fps)

    async def part(self, request: Request) -> Response:
        """*Part*."""
        return _json(await self._hub.part())

    async def model(self, request: Request) -> Response:
        """The CAD."""
        subject, _ = self._hub.ready()
        tag = f'"{subject.part.model.source_hash}"'
        headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return Response(await self._hub.glb(), media_type="model/gltf-binary", headers=headers)

    async def status(self, request: Request) -> Response:
        """*Status* without a client."""
        return _json(self._hub.status(None))

    async def client_status(self, request: Request) -> Response:
        """*Status* of a client."""
        return _json(self._hub.status(self._client(request)))

    async def join(self, request: Request) -> Response:
        """Take part."""
        self._joins.check(request.client.host if request.client else "?")
        client, answer = await self._hub.join(await json_body(request, OFFER_BYTES))
        described = None if answer is None else {"type": "answer", "sdp": answer}
        return _json({"client": client.name, "answer": described}, 201)

    async def leave(self, request: Request) -> Response:
        """Leave."""
        if not await self._hub.leave(request.path_params["client"]):
            raise Refusal(404, "no_such_client", "this page does not take part")
        return Response(status_code=204)

    async def control(self, request: Request) -> Response:
        """Do what the page asks for."""
        client = self._client(request)
        await self._hub.control(client, await json_body(request, CONTROL_BYTES))
        return _json(self._hub.status(client))

    async def take_frame(self, request: Request) -> Response:
        """Track a phone's JPEG and answer with its pose, or with the annotated picture."""
        client = self._client(request)
        if client.feed.kind != "phone" or client.transport != "jpeg":
            raise Refusal(400, "bad_request", "this client sends no pictures here")
        if client.is_busy:
            raise Refusal(429, "one_in_flight", "wait for the answer to the picture before")
        client.is_busy = True
        try:
            frame_id, turns = _number(request, "id", FRAME_IDS), _number(request, "turns", 4, 0)
            if request.headers.get("content-type", "").split(";")[0].strip().lower() != "image/jpeg":
                raise Refusal(415, "bad_type", "expected image/jpeg")
            content = await body(request, JPEG_BYTES)
            arrived_s = time.monotonic()
            try:
                image = await asyncio.to_thread(from_jpeg, content)
            except InputError as error:
                client.feed.unreadable += 1
                raise Refusal(400, "bad_request", str(error)) from error
            picture = Picture(frame_id, image, turns)
            client.feed.put(Incoming(lambda: picture, arrived_s))
            return await self._answer(client, await _tracked(client, picture))
        finally:
            client.is_busy = False
            client.seen()

    async def give_frame(self, request: Request) -> Response:
        """The newest frame of a station, other than the one that the page has."""
        client = self._client(request)
        if client.feed.kind != "station" or client.transport != "jpeg":
            raise Refusal(400, "bad_request", "this client gets no pictures here")
        if client.is_busy:
            raise Refusal(429, "one_in_flight", "wait for the answer to the request before")
        after = _number(request, "after", FRAME_IDS, -1)
        client.is_busy = True
        try:
            async with asyncio.timeout(FRAME_WAIT_S):
                tracked = client.feed.newest
                while tracked is None or tracked.picture.frame_id == after:
                    tracked = await client.inbox.take()
        except TimeoutError:
            return Response(status_code=204)
        finally:
            client.is_busy = False
            client.seen()
        if client.way == "video":
            return await self._answer(client, tracked)
        return _picture(await asyncio.to_thread(lambda: tracked.jpeg), tracked)

    async def snapshot(self, request: Request) -> Response:
        """A PNG of one frame."""
        client = self._client(request)
        self._snapshots.check(client.name)
        subject, _ = self._hub.ready()
        wants_newest = "id" not in request.query_params
        tracked = client.feed.newest if wants_newest else client.find(_number(request, "id", FRAME_IDS))
        if tracked is None:
            raise Refusal(404, "no_such_frame", "that picture is no longer kept")
        png = await asyncio.to_thread(snapshot_png, subject, client.drawing, tracked)
        return Response(png, media_type="image/png")

    async def recording(self, request: Request) -> Response:
        """A finished recording."""
        _, recordings = self._hub.ready()
        path = recordings.path(request.path_params["number"])
        if path is None or not path.is_file():
            raise Refusal(404, "not_found", "there is no such recording")
        return FileResponse(path, media_type="video/mp4", filename=path.name)

    def _client(self, request: Request) -> Client:
        return self._hub.client(request.path_params["client"])

    def _file(self, name: str) -> Response:
        found = self._files.get(name)
        if found is None:
            raise Refusal(404, "not_found", "there is no such page")
        content, media_type = found
        return Response(content, media_type=media_type, headers={"Cache-Control": "no-cache"})

    async def _answer(self, client: Client, tracked: Tracked) -> Response:
        """What a page without WebRTC gets for a tracked frame."""
        if client.way == "poses":
            return _json(pose_document(tracked, time.monotonic()))
        return _picture(await asyncio.to_thread(lambda: client.drawing.draw(tracked).jpeg), tracked)


def page_files() -> dict[str, tuple[bytes, str]]:
    """Files that may be served, by path: content and media type. Of the page, and under ``web/`` what pages share."""
    files: dict[str, tuple[bytes, str]] = {}

    def add(folder: Traversable, prefix: str) -> None:
        for entry in folder.iterdir():
            suffix = f".{entry.name.rsplit('.', 1)[-1].lower()}"
            if entry.is_dir():
                add(entry, f"{prefix}{entry.name}/")
            elif suffix in SERVED:
                media_type = _TYPES.get(suffix) or mimetypes.guess_type(entry.name)[0] or "application/octet-stream"
                files[f"{prefix}{entry.name}"] = entry.read_bytes(), media_type

    add(resources.files("arview.live") / "page", "")
    add(resources.files("arview.web"), "web/")
    return files


async def _tracked(client: Client, picture: Picture) -> Tracked:
    """Wait until exactly this picture has been tracked."""
    try:
        async with asyncio.timeout(TRACKING_TIMEOUT_S):
            while (tracked := await client.inbox.take()).picture is not picture:
                pass
            return tracked
    except TimeoutError as error:
        raise Refusal(503, "busy", "the tracking took too long; send the next picture") from error


def _picture(jpeg: bytes, tracked: Tracked) -> Response:
    """A JPEG with its pose in the header."""
    answer = json.dumps(pose_document(tracked, time.monotonic()), allow_nan=False)
    return Response(jpeg, media_type="image/jpeg", headers={ANSWER_HEADER: answer})


def _number(request: Request, name: str, end: int, default: int | None = None) -> int:
    """A whole number from 0 to below ``end`` in the query."""
    text = request.query_params.get(name)
    if text is None and default is not None:
        return default
    if text is None or not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) < end):
        raise Refusal(400, "bad_request", f"{name}: expected a whole number from 0 to {end - 1}")
    return int(text)


def _json(document: Document, status: int = 200) -> Response:
    return JSONResponse(document, status)


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return error.response()


async def _not_served(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = _CODES.get(error.status_code, "bad_request")
    return Refusal(error.status_code, code, str(error.detail)).response()


async def _bug(request: Request, error: Exception) -> Response:
    logger.error("internal error at %s", request.url.path, exc_info=error)
    return Refusal(500, "internal", "internal error; the station's terminal says more").response()
