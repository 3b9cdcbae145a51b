"""The web application: its routes and their handlers."""

from __future__ import annotations

import asyncio
import json
import logging
import mimetypes
import time
from collections.abc import Awaitable, Callable, Mapping
from importlib import resources
from importlib.resources.abc import Traversable

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from arview.errors import InputError
from arview.station.live.protocol import ANSWER_HEADER, FRAME_IDS
from arview.station.live.security.access import DEVICE, Access, Gate
from arview.station.live.security.connections import ConnectionTable
from arview.station.live.security.limits import RateLimit, body, json_body
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.annotated_png import annotated_png
from arview.station.live.server.clients import Client
from arview.station.live.server.hub import Hub
from arview.station.live.server.jobs_api import BODY_TIMEOUT_S, JobHandlers
from arview.station.live.server.monitoring import monitoring_routes
from arview.station.live.server.station_api import StationHandlers, keep_snapshot
from arview.station.live.server.workers import StuckError
from arview.station.live.stream.documents import Document
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.frames import DecodedFrame, IncomingFrame, from_jpeg
from arview.station.live.transport.motion_jpeg import MotionJpeg

JPEG_BYTES = 4_000_000
"""Largest size of an uploaded frame."""
OFFER_BYTES = 64_000
"""Largest size of a join request with its WebRTC offer."""
CONTROL_BYTES = 4_000
"""Largest size of a request that changes what a page shows."""
WATCHERS = 4
"""Screens that only watch, as motion JPEG."""
TRACKING_TIMEOUT_S = 10.0
"""Time in which an uploaded frame must be tracked."""
FRAME_WAIT_S = 5.0
"""Time that a request for a station's next frame waits."""

logger = logging.getLogger("arview.station.live")

ErrorHandler = Callable[[Request, Exception], Awaitable[Response]]

SERVED_SUFFIXES = {".html", ".js", ".css", ".svg", ".png", ".webmanifest", ".woff2", ".txt", ".json"}
"""Suffixes of the static files that are served."""
_TYPES = {".js": "text/javascript", ".webmanifest": "application/manifest+json", ".woff2": "font/woff2"}
_CODES = {404: "not_found", 405: "bad_method"}


def make_app(hub: Hub, access: Access, connections: ConnectionTable | None = None) -> ASGIApp:
    """The application with its access control; the connections are told who has shown the token."""
    limits = hub.options.requests
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
        Route(f"{client}/snapshot.png", handlers.annotated_png),
        Route(f"{client}/snapshots", handlers.keep_snapshot, methods=["POST"]),
        *monitoring_routes(hub),
        *StationHandlers(hub).routes,
        *JobHandlers(hub).routes,
    ]
    handlers_of_errors = {**refusal_handlers(), HTTPException: _http_error, StuckError: _stuck}
    app = Starlette(routes=routes, exception_handlers=handlers_of_errors)
    unauthenticated = RateLimit(limits.unauthenticated_per_s, limits.unauthenticated_burst)
    return Gate(app, access, RateLimit(limits.per_s, limits.burst), connections, unauthenticated)


class Handlers:
    """The handlers of the routes; `arview.station.live.protocol` defines requests and responses."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        limits = hub.options.requests
        self._joins = RateLimit(limits.joins_per_s, limits.joins_burst)
        self._snapshots = RateLimit(limits.images_per_s, limits.images_burst)
        self._files = static_files("arview.station.live")

    async def index(self, request: Request) -> Response:
        """The page."""
        return self._file("index.html")

    async def watch(self, request: Request) -> Response:
        """The page of screens that only watch."""
        return self._file("watch.html")

    async def static(self, request: Request) -> Response:
        """A static file of the page."""
        return self._file(request.path_params["name"])

    async def watch_mjpg(self, request: Request) -> Response:
        """Motion JPEG of the annotated frames."""
        self._hub.ready()
        if self._hub.watchers >= WATCHERS:
            raise Refusal(503, "busy", f"busy: {self._hub.watchers} screens are watching")
        device = request.scope.get(DEVICE)
        return MotionJpeg(self._hub, lambda: self._hub.is_paired(device))

    async def part(self, request: Request) -> Response:
        """The *Part* document, for a client that of its job."""
        return _json_response(await self._hub.part(request.query_params.get("client")))

    async def model(self, request: Request) -> Response:
        """The CAD model of a part as GLB."""
        subjects, _ = self._hub.ready()
        part = _number(request, "part", len(subjects), 0)
        tag = f'"{subjects[part].part.model.source_hash}"'
        headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return Response(await self._hub.glb(part), media_type="model/gltf-binary", headers=headers)

    async def status(self, request: Request) -> Response:
        """The *Status* document without a client."""
        return _json_response(self._hub.status(None))

    async def client_status(self, request: Request) -> Response:
        """The *Status* document of a client."""
        return _json_response(self._hub.status(self._client(request)))

    async def join(self, request: Request) -> Response:
        """Add a client."""
        self._joins.check(request.client.host if request.client else "?")
        wanted = await json_body(request, OFFER_BYTES, BODY_TIMEOUT_S)
        client, answer = await self._hub.join(wanted, request.scope.get(DEVICE))
        described = None if answer is None else {"type": "answer", "sdp": answer}
        return _json_response({"client": client.name, "answer": described}, 201)

    async def leave(self, request: Request) -> Response:
        """Remove a client."""
        if not await self._hub.leave(request.path_params["client"]):
            raise Refusal(404, "no_such_client", "this page does not take part")
        return Response(status_code=204)

    async def control(self, request: Request) -> Response:
        """Carry out a *Control* request and return the *Status*."""
        client = self._client(request)
        await self._hub.control(client, await json_body(request, CONTROL_BYTES, BODY_TIMEOUT_S))
        return _json_response(self._hub.status(client))

    async def take_frame(self, request: Request) -> Response:
        """Track the JPEG of a phone and return its pose, or the annotated picture."""
        client = self._client(request)
        if client.feed.kind != "phone" or client.transport != "jpeg":
            raise Refusal(400, "bad_request", "this client cannot send pictures here")
        if client.is_busy:
            raise Refusal(429, "one_in_flight", "wait for the response to the previous picture")
        client.is_busy = True
        try:
            frame_id, turns = _number(request, "id", FRAME_IDS), _number(request, "turns", 4, 0)
            if request.headers.get("content-type", "").split(";")[0].strip().lower() != "image/jpeg":
                raise Refusal(415, "bad_type", "expected image/jpeg")
            content = await body(request, JPEG_BYTES, BODY_TIMEOUT_S)
            arrived_s = time.monotonic()
            try:
                image = await asyncio.to_thread(from_jpeg, content)
            except InputError as error:
                client.feed.unreadable += 1
                raise Refusal(400, "bad_request", str(error)) from error
            if (gyro := _decimal(request.query_params.get("gyro", ""))) is not None:
                client.turned(gyro)
            frame = DecodedFrame(frame_id, image, turns)
            client.feed.put(IncomingFrame(lambda: frame, arrived_s))
            return await self._answer(client, await self._tracked(client, frame))
        finally:
            client.is_busy = False
            client.seen()

    async def give_frame(self, request: Request) -> Response:
        """The newest frame of the station camera, other than the one that the page has."""
        client = self._client(request)
        if client.feed.kind != "station" or client.transport != "jpeg":
            raise Refusal(400, "bad_request", "this client cannot get pictures here")
        if client.is_busy:
            raise Refusal(429, "one_in_flight", "wait for the response to the previous request")
        after = _number(request, "after", FRAME_IDS, -1)
        client.is_busy = True
        try:
            async with asyncio.timeout(FRAME_WAIT_S):
                tracked = client.feed.newest
                while tracked is None or tracked.frame.frame_id == after:
                    tracked = await client.inbox.take()
        except TimeoutError:
            return Response(status_code=204)
        finally:
            client.is_busy = False
            client.seen()
        if client.mode == "video":
            return await self._answer(client, tracked)
        return _jpeg_response(await asyncio.to_thread(lambda: tracked.jpeg), client.document(tracked))

    async def annotated_png(self, request: Request) -> Response:
        """A snapshot: the PNG of a frame with its overlay."""
        return Response(await self._snapshot(request), media_type="image/png")

    async def keep_snapshot(self, request: Request) -> Response:
        """Keep a snapshot at the station."""
        png = await self._snapshot(request)
        subjects, _ = self._hub.ready()
        name = await asyncio.to_thread(keep_snapshot, self._hub.options.record_folder, subjects.file_name, png)
        return _json_response({"name": name}, 201)

    async def _snapshot(self, request: Request) -> bytes:
        client = self._client(request)
        self._snapshots.check(client.name)
        subjects, _ = self._hub.ready()
        wants_newest = "id" not in request.query_params
        tracked = client.feed.newest if wants_newest else client.find(_number(request, "id", FRAME_IDS))
        if tracked is None:
            raise Refusal(404, "no_such_frame", "that frame is no longer kept")
        if client.binding is not None:
            subjects = client.binding.view.subjects
        return await asyncio.to_thread(annotated_png, subjects, client.annotator, client.shown(tracked))

    async def _tracked(self, client: Client, frame: DecodedFrame) -> TrackedFrame:
        """Wait until this frame has been tracked."""
        try:
            async with asyncio.timeout(TRACKING_TIMEOUT_S):
                while (tracked := await client.inbox.take()).frame is not frame:
                    pass
                return tracked
        except TimeoutError as error:
            raise Refusal(503, "busy", "the tracking took too long; send the next picture") from error

    def _client(self, request: Request) -> Client:
        return self._hub.client(request.path_params["client"])

    def _file(self, name: str) -> Response:
        return static_response(self._files, name)

    async def _answer(self, client: Client, tracked: TrackedFrame) -> Response:
        """The response to a page without WebRTC for a tracked frame."""
        if client.mode == "poses":
            return _json_response(client.document(tracked))
        picture = await asyncio.to_thread(lambda: client.draw(tracked).jpeg)
        return _jpeg_response(picture, client.document(tracked))


def refusal_handlers() -> dict[type[Exception], ErrorHandler]:
    """What answers to refusals and to bugs."""
    return {Refusal: _refused, Exception: _bug}


def static_response(files: Mapping[str, tuple[bytes, str]], name: str) -> Response:
    """A static file of `static_files`; browsers ask again whether it has changed.

    Raises:
        Refusal: there is no such file.
    """
    found = files.get(name)
    if found is None:
        raise Refusal(404, "not_found", "there is no such page")
    content, media_type = found
    return Response(content, media_type=media_type, headers={"Cache-Control": "no-cache"})


def static_files(package: str) -> dict[str, tuple[bytes, str]]:
    """Content and media type of static files by path: those of a package's ``page``, and under ``web/`` shared ones."""
    files: dict[str, tuple[bytes, str]] = {}

    def add(folder: Traversable, prefix: str) -> None:
        for entry in folder.iterdir():
            suffix = f".{entry.name.rsplit('.', 1)[-1].lower()}"
            if entry.is_dir():
                add(entry, f"{prefix}{entry.name}/")
            elif suffix in SERVED_SUFFIXES:
                media_type = _TYPES.get(suffix) or mimetypes.guess_type(entry.name)[0] or "application/octet-stream"
                files[f"{prefix}{entry.name}"] = entry.read_bytes(), media_type

    add(resources.files(package) / "page", "")
    add(resources.files("arview.web"), "web/")
    return files


def _jpeg_response(jpeg: bytes, pose: Document) -> Response:
    """A JPEG with its *Pose* in the header."""
    answer = json.dumps(pose, allow_nan=False)
    return Response(jpeg, media_type="image/jpeg", headers={ANSWER_HEADER: answer})


def _number(request: Request, name: str, end: int, default: int | None = None) -> int:
    """An integer of the query, at least 0 and less than ``end``."""
    text = request.query_params.get(name)
    if text is None and default is not None:
        return default
    if text is None or not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) < end):
        raise Refusal(400, "bad_request", f"{name}: expected an integer from 0 to {end - 1}")
    return int(text)


def _decimal(text: str) -> float | None:
    """A number of the query; None where it is none."""
    try:
        return float(text) if len(text) < 30 else None
    except ValueError:
        return None


def _json_response(document: Document, status: int = 200) -> Response:
    return JSONResponse(document, status)


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return error.response()


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = _CODES.get(error.status_code, "bad_request")
    return Refusal(error.status_code, code, str(error.detail)).response()


async def _stuck(request: Request, error: Exception) -> Response:
    return Refusal(503, "busy", str(error), {"Retry-After": "5"}).response()


async def _bug(request: Request, error: Exception) -> Response:
    logger.error("internal error at %s", request.url.path, exc_info=error)
    return Refusal(500, "internal", "internal error; see the terminal of the station").response()
