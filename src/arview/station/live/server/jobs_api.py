"""Requests about jobs: uploads, the end of a walk, re-checks, decisions, files."""

from __future__ import annotations

import asyncio
import hashlib
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from arview.errors import InputError, OutputError
from arview.quality import decisions as quality
from arview.quality.rework import drawing_svg
from arview.station import walk
from arview.station.live.jobs.desk import JobDesk
from arview.station.live.jobs.documents import job_document, job_row, rework
from arview.station.live.jobs.records import tell_report_and_history
from arview.station.live.jobs.uploads import Purpose, Upload, store_attachment, store_photo
from arview.station.live.security.access import DEVICE
from arview.station.live.security.limits import RateLimit, body, json_body
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.hub import Hub
from arview.station.live.stream.documents import Document, camera_document
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.frames import to_jpeg

BODY_TIMEOUT_S = 10.0
"""Time in which a body must arrive."""
PIECE_BYTES = 1 << 20
"""Largest body of one request of an upload."""
PIECE_TIMEOUT_S = 60.0
"""Time in which the body of an upload must arrive; a slow network is no reason to start again."""
TEXT_BYTES = 16_000
"""Largest bodies of the other requests: hints, decisions."""

T = TypeVar("T")

REPORT_POLICY = "sandbox allow-scripts allow-popups allow-downloads allow-modals; frame-ancestors 'self'"
"""The report brings a policy of its own; here it is kept away from the pages of this origin."""
DRAWING_POLICY = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'self'"
"""A drawing holds its own styles and runs nothing."""
KEPT_DRAWINGS = 64
"""Drawings that are kept; one takes half a second."""
PICTURE_TYPES = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
"""Pictures of instructions that are served."""
PHOTO_QUALITY = 95
"""JPEG quality of frames that are stored as photos."""
_PHOTO_TYPES = {".jpg": "image/jpeg", ".png": "image/png", ".heic": "image/heic"}


class JobHandlers:
    """The handlers of these routes; `arview.station.live.protocol` defines requests and responses."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._desk: JobDesk = hub.desk
        limits = hub.options.requests
        self._starts = RateLimit(limits.joins_per_s, limits.joins_burst)
        self._following: set[asyncio.Future[None]] = set()
        self._drawings: OrderedDict[tuple[str, str, int], str] = OrderedDict()

    @property
    def routes(self) -> list[Route]:
        """The routes."""
        job, upload = "/api/jobs/{job}", "/api/jobs/{job}/uploads"
        return [
            Route("/api/jobs", self.jobs),
            Route("/api/jobs", self.start, methods=["POST"]),
            Route(job, self.job),
            Route(f"{job}/capture", self.capture),
            Route(upload, self.begin_upload, methods=["POST"]),
            Route(f"{upload}/{{upload}}", self.upload),
            Route(f"{upload}/{{upload}}", self.add_piece, methods=["PATCH"]),
            Route(f"{job}/take", self.take, methods=["POST"]),
            Route(f"{job}/end", self.end, methods=["POST"]),
            Route(f"{job}/reopen", self.reopen, methods=["POST"]),
            Route(f"{job}/recheck", self.recheck, methods=["POST"]),
            Route(f"{job}/decisions", self.decide, methods=["POST"]),
            Route(f"{job}/ticks", self.tick, methods=["POST"]),
            Route(f"{job}/sign", self.sign, methods=["POST"]),
            Route(f"{job}/report.html", self.report),
            Route(f"{job}/inspection.json", self.inspection),
            Route(f"{job}/decisions.csv", self.decisions),
            Route(f"{job}/photos/{{name:path}}", self.photo),
            Route(f"{job}/photos/{{name}}", self.take_back, methods=["DELETE"]),
            Route(f"{job}/rework/{{component}}.svg", self.drawing),
            Route(f"{job}/rework/{{picture:path}}", self.picture),
        ]

    # --- jobs ------------------------------------------------------------------------------------------

    async def jobs(self, request: Request) -> Response:
        """All jobs."""
        self._hub.ready()

        def rows() -> list[Document]:
            board = self._desk.board
            return [job_row(job, board, self._desk.part_of(job)) for job in board.jobs()]

        return JSONResponse({"jobs": await asyncio.to_thread(rows)})

    async def start(self, request: Request) -> Response:
        """Start a job."""
        self._hub.ready()
        self._starts.check(request.client.host if request.client else "?")
        wanted = await self._json(request)
        part, serial = wanted.get("part", 0), wanted.get("serial")
        if type(part) is not int or not isinstance(serial, str):
            raise Refusal(400, "bad_request", "expected the number of a part and a serial number")
        job, is_new = await asyncio.to_thread(self._desk.start, part, serial, _absolute(self._hub.options.job_camera))
        return await self._document(job, 201 if is_new else 200)

    async def job(self, request: Request) -> Response:
        """One job."""
        return await self._document(await self._job(request))

    async def capture(self, request: Request) -> Response:
        """Cells of the dome of a job's guide."""
        job = await self._job(request)
        for guiding in self._desk.guides(job):
            if (layout := guiding.layout()) is not None:
                return JSONResponse(layout)
        raise Refusal(503, "loading", "guided capture is not ready; wait a moment", {"Retry-After": "1"})

    async def end(self, request: Request) -> Response:
        """No more photos come."""
        job = await self._job(request)
        await self._stored(lambda: job.end())
        await asyncio.to_thread(self._desk.changed, job)
        return await self._document(job)

    async def reopen(self, request: Request) -> Response:
        """More photos come after all."""
        job = await self._job(request)
        await self._stored(lambda: self._desk.reopen(job))
        return await self._document(job)

    async def recheck(self, request: Request) -> Response:
        """Start a re-check."""
        job = await self._job(request)
        names = (await self._json(request)).get("components")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise Refusal(400, "bad_request", "components: expected a list of names")
        return await self._document(await asyncio.to_thread(self._desk.board.recheck, job, names), 201)

    # --- photos ----------------------------------------------------------------------------------------

    async def begin_upload(self, request: Request) -> Response:
        """Announce a photo."""
        job = await self._job(request)
        wanted = await self._json(request)
        known = await asyncio.to_thread(self._desk.board.uploads(job).begin, wanted)
        if isinstance(known, str):
            return JSONResponse({"photo": known})
        if known.offset == 0 and known.purpose == "measure":
            await asyncio.to_thread(self._desk.announced, job, known.hint)
        return JSONResponse({"upload": known.name, "offset": known.offset}, 201)

    async def upload(self, request: Request) -> Response:
        """How far an upload is."""
        job = await self._job(request)
        name = request.path_params["upload"]
        answer = await asyncio.to_thread(self._desk.board.uploads(job).state, name)
        if isinstance(answer, Upload):
            return JSONResponse({"offset": answer.offset})
        path = await asyncio.to_thread(_photo_file, job, answer)
        return JSONResponse({"photo": answer, "offset": 0 if path is None else path.stat().st_size})

    async def add_piece(self, request: Request) -> Response:
        """Take a piece of a photo; the last one is answered when the photo is on the disk."""
        job = await self._job(request)
        text = request.query_params.get("offset", "")
        if not (text.isascii() and text.isdecimal() and len(text) < 12):
            raise Refusal(400, "bad_request", "offset: expected a number of bytes")
        piece = await body(request, PIECE_BYTES, PIECE_TIMEOUT_S)
        uploads = self._desk.board.uploads(job)
        name = request.path_params["upload"]
        before = await asyncio.to_thread(uploads.state, name)
        is_measured = isinstance(before, Upload) and before.purpose == "measure"
        try:
            answer = await asyncio.to_thread(uploads.add, name, int(text), piece)
        except Refusal as refusal:
            if refusal.status == 422 and is_measured:
                await asyncio.to_thread(self._desk.lost, job)
            raise
        if isinstance(answer, str) and not quality.is_attachment(answer):
            await asyncio.to_thread(self._desk.changed, job)
        return _upload_response(answer)

    async def take(self, request: Request) -> Response:
        """Store the newest frame of a client as a photo."""
        job = await self._job(request)
        wanted = await self._json(request)
        name, purpose = wanted.get("client"), wanted.get("purpose", "measure")
        if purpose not in get_args(Purpose):
            raise Refusal(400, "bad_request", f"purpose: expected one of {', '.join(get_args(Purpose))}")
        client = self._hub.client(name if isinstance(name, str) else "")
        binding, tracked = client.binding, client.feed.newest
        if binding is None or binding.view.job.id != job.id:
            raise Refusal(409, "other_job", "this page shows another inspection")
        if tracked is None:
            raise Refusal(409, "no_such_frame", "there is no picture yet")
        source: walk.PhotoOrigin = "station" if client.feed.kind == "station" else "stream"
        hint = _hint(tracked, binding.view.number)

        def store() -> str:
            image = tracked.frame.image if tracked.frame.original is None else tracked.frame.original
            content = to_jpeg(image, PHOTO_QUALITY)
            self._desk.board.space.take(len(content))
            if purpose == "decide":
                return store_attachment(job, content)
            photo = store_photo(job, content, hashlib.sha256(content).hexdigest(), source, hint)
            self._desk.announced(job, hint)
            self._desk.changed(job)
            return photo

        return JSONResponse({"photo": await asyncio.to_thread(store)}, 201)

    async def take_back(self, request: Request) -> Response:
        """Take a photo back, until the walk has ended."""
        job = await self._job(request)
        name, why = request.path_params["name"], request.query_params.get("why", "unwanted")[:40]
        await self._stored(lambda: job.take_back(name, why))
        await asyncio.to_thread(self._desk.lost, job)
        await asyncio.to_thread(self._desk.changed, job)
        return await self._document(job)

    async def photo(self, request: Request) -> Response:
        """A photo as it was received."""
        job, name = await self._job(request), request.path_params["name"]
        path = await asyncio.to_thread(_photo_file, job, name)
        if path is None:
            raise Refusal(404, "not_found", "there is no such photo")
        headers = {"Cache-Control": "private, max-age=86400"}
        return FileResponse(path, media_type=_PHOTO_TYPES.get(path.suffix, "application/octet-stream"), headers=headers)

    # --- people ------------------------------------------------------------------------------------------

    async def decide(self, request: Request) -> Response:
        """Keep a decision about a component."""
        job = await self._measured(request)
        one = {"component": "", "is_ok": None, "photo": None} | await self._json(request)
        reason, note, by = (one.get(key) or "" for key in ("reason", "note", "by"))
        return await self._kept(
            job,
            lambda: quality.decide_component(job.path, one["component"], one["is_ok"], reason, note, by, one["photo"]),
        )

    async def tick(self, request: Request) -> Response:
        """Keep the tick of a step."""
        job = await self._measured(request)
        one = {"component": "", "step": None, "is_done": None} | await self._json(request)
        return await self._kept(
            job,
            lambda: quality.tick_step(job.path, one["component"], one["step"], one["is_done"], one.get("by") or ""),
        )

    async def sign(self, request: Request) -> Response:
        """Keep a signature."""
        job = await self._measured(request)
        one = await self._json(request)
        return await self._kept(
            job, lambda: quality.sign_inspection(job.path, one.get("by") or "", one.get("note") or "")
        )

    async def decisions(self, request: Request) -> Response:
        """The decisions as CSV."""
        job = await self._job(request)

        def table() -> str:
            return quality.decisions_csv(
                quality.log_of(job.path).content().entries, str(job.document["part_name"]), job.serial
            )

        headers = {"Content-Disposition": f'attachment; filename="decisions_{job.id}.csv"'}
        return Response(await self._stored(table), media_type="text/csv; charset=utf-8", headers=headers)

    # --- files -------------------------------------------------------------------------------------------

    async def report(self, request: Request) -> Response:
        """The report."""
        job = await self._job(request)
        headers = {"Content-Security-Policy": REPORT_POLICY}
        return self._file(job, "report.html", "text/html; charset=utf-8", headers)

    async def inspection(self, request: Request) -> Response:
        """The record of the measurement."""
        return self._file(await self._job(request), "inspection.json", "application/json")

    async def drawing(self, request: Request) -> Response:
        """The drawing of a component that is to be moved."""
        job = await self._measured(request)
        part, inspection = self._desk.part(job), self._desk.board.inspection(job)
        if part is None or inspection is None or inspection.find(request.path_params["component"]) is None:
            raise Refusal(404, "not_found", "there is no such component here")
        component = request.path_params["component"]
        form: Literal["sheet", "screen"] = "screen" if "screen" in request.query_params else "sheet"
        key = job.id, f"{form} {component}", (job.path / "inspection.json").stat().st_mtime_ns
        if key not in self._drawings:
            self._drawings[key] = await self._stored(lambda: drawing_svg(part, inspection, component, form))
            while len(self._drawings) > KEPT_DRAWINGS:
                self._drawings.popitem(last=False)
        headers = {"Content-Security-Policy": DRAWING_POLICY}
        return Response(self._drawings[key], media_type="image/svg+xml", headers=headers)

    async def picture(self, request: Request) -> Response:
        """A picture of an instruction, by the name that the instruction has for it."""
        job = await self._job(request)
        subject, name = self._desk.subject(job), request.path_params["picture"]
        told = await asyncio.to_thread(rework, job, self._desk)
        if subject is None or subject.path is None or all(name not in one["pictures"] for one in told):
            raise Refusal(404, "not_found", "there is no such picture")
        path = Path(subject.path).parent / name
        media_type = PICTURE_TYPES.get(path.suffix.lower())
        if media_type is None or not path.is_file():
            raise Refusal(404, "not_found", "there is no such picture")
        return FileResponse(path, media_type=media_type)

    def _file(self, job: walk.JobFolder, name: str, media_type: str, headers: dict[str, str] | None = None) -> Response:
        path = job.path / name
        if not path.is_file():
            raise Refusal(404, "not_found", "this part is not measured yet")
        return FileResponse(path, media_type=media_type, headers=headers)

    # --- internals ---------------------------------------------------------------------------------------

    async def _job(self, request: Request) -> walk.JobFolder:
        self._hub.ready()
        return await asyncio.to_thread(self._desk.board.find, request.path_params["job"])

    async def _measured(self, request: Request) -> walk.JobFolder:
        """The job, which must be measured."""
        job = await self._job(request)
        is_done = await asyncio.to_thread(
            lambda: job.state().stage == "done" and (job.path / "inspection.json").is_file()
        )
        if not is_done:
            raise Refusal(409, "not_done", "this part is not measured yet")
        quality.acting_device.set(request.scope.get(DEVICE) or "")
        return job

    async def _document(self, job: walk.JobFolder, status: int = 200) -> Response:
        return JSONResponse(await self._stored(lambda: job_document(job, self._desk)), status)

    async def _kept(self, job: walk.JobFolder, write: Callable[[], quality.Decision]) -> Response:
        """Add an entry to the log of decisions; it is answered when it is on the disk, then report and store follow."""
        kept = await self._stored(write)
        following = asyncio.ensure_future(asyncio.to_thread(tell_report_and_history, job))
        self._following.add(following)
        following.add_done_callback(self._following.discard)
        return JSONResponse(quality.decision_document(kept), 201)

    async def _stored(self, work: Callable[[], T]) -> T:
        """Do something with files in a thread; what is wrong becomes an answer."""
        try:
            return await asyncio.to_thread(work)
        except InputError as error:
            raise Refusal(400, "bad_request", _without_folders(str(error), self._desk)) from error
        except OutputError as error:
            raise Refusal(507, "disk_full", _without_folders(str(error), self._desk)) from error

    async def _json(self, request: Request) -> dict[str, Any]:
        return await json_body(request, TEXT_BYTES, BODY_TIMEOUT_S)


def _photo_file(job: walk.JobFolder, name: str) -> Path | None:
    """File of a photo of a job, or of the photo of another of its record that a decision names; None without one."""
    if name in {photo.name for photo in job.photos()}:
        return job.path / "photos" / name
    path = quality.photo_path((job.parent or job).path, name) if "/" in name else None
    if path is None or quality.is_attachment(name):
        return path if path is not None and path.is_file() else None
    try:
        owner = walk.JobFolder.open(path.parent.parent)
    except InputError:
        return None
    return path if path.name in {photo.name for photo in owner.photos()} else None


def _absolute(camera: str | None) -> str | None:
    """A camera whose file is named from the root: measurements may be continued from another folder."""
    if camera is None:
        return None
    path, _, name = camera.partition(":") if not Path(camera).is_file() else (camera, "", "")
    return camera if not Path(path).is_file() else f"{Path(path).resolve()}{f':{name}' if name else ''}"


def _upload_response(answer: Upload | str) -> Response:
    return JSONResponse({"photo": answer} if isinstance(answer, str) else {"offset": answer.offset})


def _hint(tracked: TrackedFrame, part: int) -> dict[str, Any]:
    """Where the tracker sees the camera of a frame."""
    pose = tracked.poses[part]
    matrix = None if pose.cam_from_model is None else [float(value) for value in pose.cam_from_model.ravel()]
    quality = min(1.0, max(0.0, float(pose.quality)))
    return {"cam_from_model": matrix, "camera": camera_document(tracked.camera), "quality": quality}


def _without_folders(text: str, desk: JobDesk) -> str:
    """A message that does not show where the files of the station are."""
    folder = desk.board.options.folder
    for prefix in (f"{folder.resolve()}/", f"{folder}/"):
        text = text.replace(prefix, "")
    return text
