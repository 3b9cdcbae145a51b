"""The web application of the studio.

| request | what it does |
|---|---|
| ``GET /``, ``GET /static/...`` | the page |
| ``GET /api/part`` | the part: text, components, datums, range, what can be undone (`StudioDocument.describe`) |
| ``GET /api/findings`` | remarks of `arview check` |
| ``GET /api/symmetries`` | symmetries of the geometry |
| ``POST /api/edit`` | an edit (`StudioDocument.edit`); answers with the part |
| ``POST /api/undo``, ``/api/redo``, ``/api/save`` | answer with the part; save writes the part file |
| ``GET /api/mesh?coarse=1`` | the mesh of the whole CAD (`arview.station.studio.mesh_data`) |
| ``POST /api/pick`` | ``{component, face, point_mm}``: features there, each with the table that makes it a datum |
| ``GET /api/views`` | the assessed guide views (`Assessment.describe`); 202 while they are being made |
| ``GET /api/views/{index}.png`` | a view with its contour and edge points |
| ``GET /api/advice`` | edits that make the guide views better, with the score they reach |
| ``GET /api/photos?count=24`` | a plan of photos (`photo_plan`) |
| ``POST /api/trial?name=clip.mp4&camera=fov:65`` | try the picture or clip in the body |
| ``GET /api/trial.jpg`` | the best frame of the last trial |
| ``POST /api/export`` | ``{kinds: ["gv", "sheet", "station"]}``: write files beside the part file |

Errors are ``{"error": code, "message": text}``; a message is one line.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from arview.cad import Part
from arview.errors import ArviewError
from arview.station import live
from arview.station.studio.assessment import Assessments, advice
from arview.station.studio.document import StudioDocument
from arview.station.studio.exports import write_exports
from arview.station.studio.mesh_data import mesh_bytes
from arview.station.studio.photo_plan import photo_plan
from arview.station.studio.trial import Trials

EDIT_BYTES = 2_000_000
"""Largest body of an edit; one may hold the whole text of a part file."""
TRIAL_BYTES = 300_000_000
"""Largest picture or clip of a trial."""
BODY_TIMEOUT_S = 120.0
"""Seconds in which a body must arrive."""
TRIAL_SUFFIXES = {
    ".jpg",
    ".jpeg",
    ".png",
    ".tif",
    ".tiff",
    ".bmp",
    ".heic",
    ".mp4",
    ".mov",
    ".m4v",
    ".avi",
    ".mkv",
    ".webm",
}
"""Endings of the names of pictures and clips that can be tried."""


def make_app(document: StudioDocument, access: live.Access, others: Sequence[Part] = ()) -> ASGIApp:
    """The application, for those with the token of this run."""
    handlers = StudioHandlers(document, others)
    routes = [
        Route("/", handlers.index),
        Route("/static/{name:path}", handlers.static),
        Route("/api/part", handlers.part),
        Route("/api/findings", handlers.findings),
        Route("/api/symmetries", handlers.symmetries),
        Route("/api/edit", handlers.edit, methods=["POST"]),
        Route("/api/undo", handlers.undo, methods=["POST"]),
        Route("/api/redo", handlers.redo, methods=["POST"]),
        Route("/api/save", handlers.save, methods=["POST"]),
        Route("/api/mesh", handlers.mesh),
        Route("/api/pick", handlers.pick, methods=["POST"]),
        Route("/api/views", handlers.views),
        Route("/api/views/{index:int}.png", handlers.view_picture),
        Route("/api/advice", handlers.advice),
        Route("/api/photos", handlers.photos),
        Route("/api/trial", handlers.trial, methods=["POST"]),
        Route("/api/trial.jpg", handlers.trial_picture),
        Route("/api/export", handlers.export, methods=["POST"]),
    ]
    app = Starlette(
        routes=routes, exception_handlers={ArviewError: _told, HTTPException: _told, **live.refusal_handlers()}
    )
    limits = live.LiveOptions(source="none").requests
    return _Ended(live.Gate(app, access, live.RateLimit(limits.per_s, limits.burst)))


class _Ended:
    """Answers requests that are still being worked on when the server ends, so that nothing is logged as a failure."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request."""
        try:
            await self._app(scope, receive, send)
        except asyncio.CancelledError:
            await live.Refusal(503, "ended", "the studio has been ended").response()(scope, receive, send)


class StudioHandlers:
    """The handlers of the routes; what takes time is done in threads."""

    def __init__(self, document: StudioDocument, others: Sequence[Part]) -> None:
        self._document = document
        self._views, self._trials = Assessments(others), Trials()
        self._files = live.static_files("arview.station.studio")

    async def index(self, request: Request) -> Response:
        """The page."""
        return live.static_response(self._files, "index.html")

    async def static(self, request: Request) -> Response:
        """A static file of the page."""
        return live.static_response(self._files, request.path_params["name"])

    async def part(self, request: Request) -> Response:
        """The part."""
        return JSONResponse(self._document.describe())

    async def findings(self, request: Request) -> Response:
        """Remarks on the part."""
        return JSONResponse({"findings": await asyncio.to_thread(self._document.findings)})

    async def symmetries(self, request: Request) -> Response:
        """Symmetries of the geometry of the part."""
        return JSONResponse({"symmetries": await asyncio.to_thread(self._document.found_symmetries)})

    async def edit(self, request: Request) -> Response:
        """Carry out an edit."""
        change = await live.json_body(request, EDIT_BYTES, BODY_TIMEOUT_S)
        return await self._changed(lambda: self._document.edit(change))

    async def undo(self, request: Request) -> Response:
        """Undo the last edit."""
        return await self._changed(self._document.undo)

    async def redo(self, request: Request) -> Response:
        """Do the last undone edit again."""
        return await self._changed(self._document.redo)

    async def save(self, request: Request) -> Response:
        """Write the part file."""
        return await self._changed(self._document.save)

    async def mesh(self, request: Request) -> Response:
        """The mesh."""
        is_coarse = request.query_params.get("coarse") == "1"
        content = await asyncio.to_thread(mesh_bytes, self._document.cad, is_coarse)
        return Response(content, media_type="application/octet-stream")

    async def pick(self, request: Request) -> Response:
        """Features at a point."""
        asked = await live.json_body(request, EDIT_BYTES, BODY_TIMEOUT_S)
        component, face, point = asked.get("component"), asked.get("face"), asked.get("point_mm")
        if not (isinstance(component, str) and isinstance(face, int) and isinstance(point, list)):
            raise live.Refusal(400, "bad_request", "expected component, face and point_mm")
        if len(point) != 3 or not all(isinstance(value, int | float) for value in point):
            raise live.Refusal(400, "bad_request", "point_mm: expected three numbers")
        found = await asyncio.to_thread(self._document.pick, component, face, point)
        return JSONResponse({"features": found})

    async def views(self, request: Request) -> Response:
        """The assessed guide views."""
        done, error = self._views.of(self._document.part)
        if error:
            raise live.Refusal(422, "no_views", error)
        if done is None:
            return JSONResponse({"is_pending": True}, 202)
        return JSONResponse(done.describe())

    async def view_picture(self, request: Request) -> Response:
        """The picture of a view."""
        png = await asyncio.to_thread(self._views.picture, self._document.part, request.path_params["index"])
        if png is None:
            raise live.Refusal(404, "no_such_view", "there is no such view, or the views are still being made")
        return Response(png, media_type="image/png")

    async def advice(self, request: Request) -> Response:
        """Edits that help."""
        return JSONResponse({"advice": await asyncio.to_thread(advice, self._document.part, self._document.cad)})

    async def photos(self, request: Request) -> Response:
        """A plan of photos."""
        text = request.query_params.get("count", "24")
        if not (text.isascii() and text.isdecimal() and len(text) < 4):
            raise live.Refusal(400, "bad_request", "count: expected a whole number")
        return JSONResponse(await asyncio.to_thread(photo_plan, self._document.part, int(text)))

    async def trial(self, request: Request) -> Response:
        """Try a picture or clip."""
        suffix = Path(request.query_params.get("name", "")).suffix.lower()
        if suffix not in TRIAL_SUFFIXES:
            raise live.Refusal(415, "bad_type", f"expected a picture or clip ({' '.join(sorted(TRIAL_SUFFIXES))})")
        content = await live.body(request, TRIAL_BYTES, BODY_TIMEOUT_S)
        camera = request.query_params.get("camera") or None
        if camera is not None and not camera.startswith("fov:"):
            raise live.Refusal(400, "bad_request", "camera: expected fov:DEG")
        return JSONResponse(await asyncio.to_thread(self._tried, content, suffix, camera))

    async def trial_picture(self, request: Request) -> Response:
        """The best frame of the last trial."""
        if self._trials.picture is None:
            raise live.Refusal(404, "no_trial", "nothing has been tried yet")
        return Response(self._trials.picture, media_type="image/jpeg")

    async def export(self, request: Request) -> Response:
        """Write files beside the part file."""
        kinds = (await live.json_body(request, EDIT_BYTES, BODY_TIMEOUT_S)).get("kinds")
        if not isinstance(kinds, list) or not all(isinstance(kind, str) for kind in kinds):
            raise live.Refusal(400, "bad_request", "kinds: expected a list")
        written = await asyncio.to_thread(write_exports, self._document, kinds)
        return JSONResponse({"files": [str(path) for path in written]})

    def _tried(self, content: bytes, suffix: str, camera: str | None) -> dict[str, Any]:
        with tempfile.TemporaryDirectory(prefix="arview-studio-") as folder:
            path = Path(folder) / f"trial{suffix}"
            path.write_bytes(content)
            return self._trials.run(self._document.part, path, camera)

    async def _changed(self, work: Callable[[], object]) -> Response:
        await asyncio.to_thread(work)
        return JSONResponse(self._document.describe())


async def _told(request: Request, error: Exception) -> Response:
    """The response to an error that the user can mend."""
    if isinstance(error, HTTPException):
        return live.Refusal(error.status_code, "bad_request", str(error.detail)).response()
    return live.Refusal(422, "refused", str(error)).response()
