"""The hub: the state that all pages share. Parts, clients with their feeds, station camera, recordings."""

from __future__ import annotations

import asyncio
import gc
import logging
import time
from collections.abc import Awaitable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from arview.core.messages import sentence, with_messages
from arview.errors import ArviewError, InputError
from arview.station.live.jobs.desk import Binding, JobDesk, JobView
from arview.station.live.options import LiveOptions
from arview.station.live.protocol import Transport, ViewMode
from arview.station.live.security.devices import Devices
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.clients import Client, check_control, choice_of, screen_of
from arview.station.live.server.glb import model_glb
from arview.station.live.server.workers import in_daemon_thread
from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.documents import (
    Document,
    feed_document,
    loading_document,
    notice_documents,
    parts_document,
    style_document,
    with_ages,
)
from arview.station.live.stream.feed import Feed
from arview.station.live.stream.notices import Notice
from arview.station.live.stream.recording import Recordings
from arview.station.live.stream.station import StationCamera
from arview.station.live.stream.subjects import Subjects
from arview.station.live.transport.webrtc import Connection

OFFER_TIMEOUT_S = 10.0
"""Time to answer an offer."""
CONNECT_TIMEOUT_S = 20.0
"""Time from the offer to a connection."""
JPEG_SILENCE_S = 15.0
"""A page without WebRTC that sends no request for so long is removed."""
TICK_S = 0.25
"""Interval of the regular work: clients that are gone, changed inspections, status messages."""
STATUS_INTERVAL_S = 1.0
"""A status is sent at least this often."""
RELOAD_INTERVAL_S = 1.0
"""Time between two checks of the inspection file."""
CLOSING_TIMEOUT_S = 1.2
"""At the end, time for each of pages, camera and tracking to close."""

logger = logging.getLogger("arview.station.live")


class Hub:
    """The state of one run. Its methods must be called in the event loop.

    Args:
        options: options of the server.
        addresses: addresses at which WebRTC is offered.
        devices: the paired devices; None: there are none, and pages show the token of the run.

    Attributes:
        subjects, recordings: None while the parts are being loaded.
        desk: the jobs that pages start.
        clients: the pages that take part, by name.
        watchers: number of screens that only watch.
    """

    def __init__(self, options: LiveOptions, addresses: Sequence[str], devices: Devices | None = None) -> None:
        self.options, self._addresses, self.devices = options, addresses, devices
        self.subjects: Subjects | None = None
        self.recordings: Recordings | None = None
        self.desk = JobDesk(options.jobs)
        self.clients: dict[str, Client] = {}
        self.watchers = 0
        self._loading = loading_document(options, "loading", sentence("told.loading"))
        self._part: tuple[int, Document] | None = None
        self._glb: dict[str, asyncio.Task[bytes]] = {}
        self._station: StationCamera | None = None
        self._shared: tuple[Feed, FrameAnnotator] | None = None
        self._recorded: set[Path] = set()
        self._ticker: asyncio.Task[None] | None = None
        self._adopting: asyncio.Task[None] | None = None
        self._resuming: asyncio.Task[None] | None = None
        self._joining = 0
        self._leaving: set[asyncio.Future[bool]] = set()

    # --- the part -------------------------------------------------------------------------------------

    def begin(self, subjects: Subjects) -> None:
        """Start with the loaded parts: open the station camera and admit pages."""
        self.subjects = subjects
        self.recordings = Recordings(
            self.options.record_folder, subjects.file_name, self.options.recording, self.options.record
        )
        if not self.options.is_phone:
            feed, annotator = Feed(subjects, "station"), FrameAnnotator(subjects)
            self._shared = feed, annotator
            self._station = StationCamera(self.options.source, feed)
            if self.options.record is not None:
                self.recordings.start(feed, annotator, self.options.record)
        self._ticker = asyncio.ensure_future(self._run_ticker())
        self._adopting = asyncio.ensure_future(self._adopt())
        self._resuming = asyncio.ensure_future(in_daemon_thread(lambda: self.desk.begin(subjects)))

    def ready(self) -> tuple[Subjects, Recordings]:
        """The parts and the recordings.

        Raises:
            Refusal: the part is still being loaded.
        """
        if self.subjects is None or self.recordings is None:
            raise Refusal(503, "loading", "the part is being loaded; wait a moment", {"Retry-After": "1"})
        return self.subjects, self.recordings

    async def part(self, client: str | None = None) -> Document:
        """The *Part* document, for a client that is bound to a job with the numbers of that job."""
        if self.subjects is None:
            return with_messages(self._loading)
        bound = self.clients.get(client or "")
        if bound is not None and bound.binding is not None:
            subjects = bound.binding.view.subjects
            return with_messages(with_ages(await asyncio.to_thread(parts_document, subjects), subjects))
        revision = self.subjects.revision
        if self._part is None or self._part[0] != revision:
            self._part = revision, await asyncio.to_thread(parts_document, self.subjects)
        return with_messages(with_ages(self._part[1], self.subjects))

    async def glb(self, part: int) -> bytes:
        """The CAD model of a part as GLB, made once."""
        subjects, _ = self.ready()
        model = subjects[part].part.model
        if model.source_hash not in self._glb:
            self._glb[model.source_hash] = asyncio.ensure_future(in_daemon_thread(lambda: model_glb(model)))
        return await asyncio.shield(self._glb[model.source_hash])

    # --- clients --------------------------------------------------------------------------------------

    async def join(self, request: dict[str, Any], device: str | None = None) -> tuple[Client, str | None]:
        """Add a client for a *Join* request; returns it and the SDP that answers its offer, if it made one.

        Args:
            request: the request.
            device: name of the paired device that makes it, if any.

        Raises:
            Refusal: the part is being loaded, too many pages take part, or the offer cannot be used.
        """
        subjects, recordings = self.ready()
        transport: Transport = choice_of(request.get("transport"), Transport, "transport")
        mode: ViewMode = choice_of(request.get("mode", "poses"), ViewMode, "mode")
        offer = request.get("offer")
        sdp = offer.get("sdp") if isinstance(offer, dict) and offer.get("type") == "offer" else None
        if transport == "webrtc" and not isinstance(sdp, str):
            raise Refusal(400, "bad_offer", "transport webrtc needs an offer with its sdp")
        if isinstance(previous := request.get("replaces"), str):
            await self.leave(previous)
        if len(self.clients) + self._joining >= self.options.max_clients:
            count = len(self.clients)
            raise Refusal(503, "busy", f"busy: {count} of {self.options.max_clients} pages take part")
        self._joining += 1
        try:
            feed, annotator = self._shared or (Feed(subjects, "phone"), FrameAnnotator(subjects))
            client = Client(feed, annotator, transport, mode, device)
            answer = await self._connect(client, str(sdp)) if transport == "webrtc" else None
        finally:
            self._joining -= 1
        self.clients[client.name] = client
        logger.info("a page joined by %s (%d of %d)", transport, len(self.clients), self.options.max_clients)
        if self.options.is_phone and self.options.record is not None:
            self._record_phone(recordings, client, self.options.record)
        return client, answer

    async def leave(self, name: str) -> bool:
        """Remove a client; returns whether there was one of that name."""
        client = self.clients.pop(name, None)
        if client is None:
            return False
        logger.info("a page left (%d of %d)", len(self.clients), self.options.max_clients)
        self._free(client)
        await self._release(client)
        return True

    def is_paired(self, device: str | None) -> bool:
        """Whether a device is paired; True where devices are not."""
        return self.devices is None or device is None or self.devices.has(device)

    async def revoke(self, device: str) -> bool:
        """Forget a paired device, whose pages are removed; returns whether there was one of that name."""
        if self.devices is None or not await asyncio.to_thread(self.devices.revoke, device):
            return False
        await self._remove_unpaired()
        return True

    def client(self, name: str) -> Client:
        """The client of that name, whose request is noted.

        Raises:
            Refusal: there is no such client.
        """
        client = self.clients.get(name)
        if client is None:
            raise Refusal(404, "no_such_client", "this page no longer takes part; join again")
        client.seen()
        return client

    async def control(self, client: Client, request: dict[str, Any]) -> None:
        """Carry out a *Control* request.

        Raises:
            Refusal: an unknown key or a wrong value; then nothing is changed.
        """
        subjects, recordings = self.ready()
        names = [[component.name for component in one.part.model.components] for one in subjects]
        style = check_control(request, client.annotator.style, names)
        held = None
        if request.get("hold") is not None:
            held = client.find(request["hold"])
            if held is None:
                raise Refusal(404, "no_such_frame", "that frame is no longer kept")
        await self._bind(client, request)
        client.annotator.style = style
        client.mode = request.get("mode", client.mode)
        client.screen = screen_of(request["screen"]) if "screen" in request else client.screen
        for what, act in (("reset", client.feed.reset), ("confirm", client.feed.confirm)):
            if (wanted := request.get(what, False)) is not False:
                act(None if wanted is True else wanted)
        if "hold" in request:
            client.held = held
        if request.get("record") is True:
            recordings.start(client.feed, client.annotator)
        elif request.get("record") is False:
            await asyncio.to_thread(recordings.stop, client.feed)

    async def _bind(self, client: Client, request: dict[str, Any]) -> None:
        """Bind a client to a job, or free it, and begin or end guided capture.

        Raises:
            Refusal: there is no such job, or it is of another part; then nothing is changed.
        """
        before = client.binding
        wanted = request.get("job", before.view.job.id if before is not None else None)
        guided = request.get("capture", wanted if before is not None and before.guiding is not None else None)
        if guided is not None and guided != wanted:
            raise Refusal(400, "bad_control", "control: capture is not the job that is shown")
        if before is None or wanted != before.view.job.id:
            view = None if wanted is None else await asyncio.to_thread(self.desk.view, wanted)
            self._free(client)
            if view is not None:
                self._show(client, view)
        binding = client.binding
        if binding is not None and (guided is None) != (binding.guiding is None):
            if binding.guiding is not None:
                client.feed.unlisten(binding.guiding.listen)
                self.desk.unguide(binding.guiding, binding.view)
                binding.guiding = None
            else:
                binding.guiding = self.desk.guide(binding.view)
                client.feed.listen(binding.guiding.listen)

    def _show(self, client: Client, view: JobView) -> None:
        """Let a client show a job: a phone's stream is then of that specimen, a station's only for this page."""
        client.binding = Binding(view)
        self.desk.retain(view)
        if self._shared is None:
            client.feed.show(view.subjects)
            if client.serial not in (None, view.job.serial):
                client.feed.reset()  # another specimen: what was seen of the one before is forgotten
            client.annotator.show(view.subjects)
        else:
            style, client.annotator = client.annotator.style, FrameAnnotator(view.subjects)
            client.annotator.style = style
        client.serial = view.job.serial

    def _free(self, client: Client) -> None:
        """Let a client show what it showed before it was bound to a job."""
        binding, client.binding = client.binding, None
        if binding is None or self.subjects is None:
            return
        if binding.guiding is not None:
            client.feed.unlisten(binding.guiding.listen)
            self.desk.unguide(binding.guiding, binding.view)
        self.desk.release(binding.view)
        if self._shared is None:
            client.feed.show(self.subjects)
            client.annotator.show(self.subjects)
        else:
            client.annotator = self._shared[1]

    # --- status ------------------------------------------------------------------------------

    def watched(self) -> tuple[Feed, FrameAnnotator] | None:
        """The feed for screens that only watch: the station camera, or the phone that joined last."""
        if self._shared is not None:
            return self._shared
        latest = max(self.clients.values(), key=lambda client: client.joined_s, default=None)
        return (latest.feed, latest.annotator) if latest is not None else None

    def status(self, client: Client | None) -> Document:
        """The *Status* document of a client, or without one."""
        shared, binding = self._shared, client.binding if client is not None else None
        subjects = self.subjects if binding is None else binding.view.subjects
        feed = client.feed if client is not None else shared[0] if shared is not None else None
        described = None
        if feed is not None:
            described = feed_document(feed)
            if self._station is not None:
                described["state"], described["text"] = self._station.state
        recorder = self.recordings.of(feed) if self.recordings is not None and feed is not None else None
        document: Document = {
            "type": "status",
            "revision": subjects.revision if subjects is not None else 0,
            "mode": client.mode if client is not None else None,
            "style": style_document(client.annotator.style) if client is not None else None,
            "feed": described,
            "notices": notice_documents(self._notices(feed, subjects)),
            "recording": {
                "is_on": recorder is not None,
                "seconds": round(recorder.seconds, 1) if recorder is not None else 0.0,
                "finished": self.recordings.finished if self.recordings is not None else [],
            },
            "job": None if binding is None else binding.view.status,
            "clients": len(self.clients),
            "max_clients": self.options.max_clients,
        }
        return with_messages(document)

    async def close(self) -> None:
        """Remove all clients, close the station camera and finish the files."""
        finishing = asyncio.ensure_future(in_daemon_thread(self.desk.close()))
        for task in (self._ticker, self._adopting, self._resuming):
            if task is not None:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
        # The files come first; what does not close in time is left to the end of the program.
        if self.recordings is not None:
            await self._within(in_daemon_thread(self.recordings.stop_all), 2.0 * CLOSING_TIMEOUT_S)
        closing: list[Awaitable[object]] = [self.leave(name) for name in list(self.clients)]
        if self._station is not None:
            closing.append(in_daemon_thread(self._station.close))
        if self._shared is not None:
            closing.append(in_daemon_thread(self._shared[0].close))
        await self._within(asyncio.gather(*closing, return_exceptions=True), CLOSING_TIMEOUT_S)
        await self._within(finishing, CLOSING_TIMEOUT_S)

    async def _within(self, work: Awaitable[object], timeout_s: float) -> None:
        """Wait for work, but not for long."""
        try:
            await asyncio.wait_for(work, timeout_s)
        except TimeoutError:
            logger.warning("a worker did not come back at the end")

    # --- internals ---------------------------------------------------------------------------------------

    async def _connect(self, client: Client, sdp: str) -> str:
        def ended() -> None:
            leaving = asyncio.ensure_future(self.leave(client.name))
            self._leaving.add(leaving)
            leaving.add_done_callback(self._leaving.discard)

        connection = Connection(client.feed, client, self._addresses, ended)
        client.connection = connection
        try:
            return await asyncio.wait_for(connection.answer(sdp), OFFER_TIMEOUT_S)
        except (InputError, TimeoutError) as error:
            await self._release(client)
            raise Refusal(400, "bad_offer", str(error) or "the offer could not be answered in time") from error
        except BaseException:
            await self._release(client)
            raise

    async def _release(self, client: Client) -> None:
        await client.close()
        if self._shared is None:
            if self.recordings is not None:
                await asyncio.to_thread(self.recordings.forget, client.feed)
            await asyncio.to_thread(client.feed.close)
            await asyncio.to_thread(client.annotator.close)
            # Peer connections and sessions hold reference cycles; without this call about thirty of them pile up.
            await asyncio.to_thread(gc.collect)

    def _record_phone(self, recordings: Recordings, client: Client, path: Path) -> None:
        """Record a phone from its first frame: to OUT.mp4, else to the first free one of OUT-2.mp4, OUT-3.mp4, ..."""
        target, number = path, 1
        while target in self._recorded or (number > 1 and (target.exists() or target.with_suffix(".jsonl").exists())):
            number += 1
            target = path.with_name(f"{path.stem}-{number}{path.suffix}")
        self._recorded.add(target)
        recordings.start(client.feed, client.annotator, target)

    def _notices(self, feed: Feed | None, subjects: Subjects | None) -> list[Notice]:
        notices = subjects.notices() if subjects is not None else []
        if self._station is not None:
            notices = [*notices, *self._station.notices()]
        if feed is not None:
            own = feed.notices()
            if any(notice.code == "camera_estimated" for notice in own):
                notices = [notice for notice in notices if notice.code != "camera_guessed"]
            notices = [*notices, *own]
            if self.recordings is not None:
                notices = [*notices, *self.recordings.notices(feed)]
        return notices

    async def _run_ticker(self) -> None:
        reloaded_s = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            try:
                now_s = time.monotonic()
                if now_s - reloaded_s >= RELOAD_INTERVAL_S and self.subjects is not None:
                    reloaded_s = now_s
                    await asyncio.to_thread(self._look_up, self.subjects)
                    await self._remove_unpaired()
                self._replace_stuck()
                for client in list(self.clients.values()):
                    if self._is_gone(client, now_s):
                        await self.leave(client.name)
                    else:
                        self._send_status(client, now_s)
            except ArviewError as error:
                logger.warning("%s", error)
            except Exception:  # the ticker serves all pages and must not end
                logger.exception("the regular work for all pages failed")

    def _look_up(self, subjects: Subjects) -> None:
        """Read what may have changed in files: inspections, paired devices, the room on the disk."""
        subjects.reload()
        if self.devices is not None:
            self.devices.refresh()
        if self.recordings is not None:
            self.recordings.check_space()
        self.desk.look_up()

    async def _adopt(self) -> None:
        """List earlier recordings, and recover those that a crash has cut off."""
        assert self.recordings is not None
        try:
            await in_daemon_thread(self.recordings.adopt)
        except OSError as error:
            logger.warning("the folder of the recordings cannot be read (%s)", error.strerror or error)

    async def _remove_unpaired(self) -> None:
        """Remove the pages of devices that are no longer paired."""
        for client in list(self.clients.values()):
            if not self.is_paired(client.device):
                logger.info("the page of %s is removed: it is no longer paired", client.device)
                await self.leave(client.name)

    def _replace_stuck(self) -> None:
        """Replace threads of tracking and camera that do not come back."""
        for feed in {id(client.feed): client.feed for client in self.clients.values()}.values():
            feed.replace_if_stuck()
        if self._shared is not None:
            self._shared[0].replace_if_stuck()
        if self._station is not None:
            self._station.replace_if_stuck()

    def _is_gone(self, client: Client, now_s: float) -> bool:
        if client.connection is None:
            return not client.is_busy and now_s - client.seen_s > JPEG_SILENCE_S
        return not client.connection.is_connected and now_s - client.joined_s > CONNECT_TIMEOUT_S

    def _send_status(self, client: Client, now_s: float) -> None:
        """Send a page its status when it has changed, or when the last one is older than the interval."""
        if client.connection is None or not client.connection.is_connected:
            return
        status = self.status(client)
        news = (
            status["revision"],
            status["notices"],
            status["recording"]["is_on"],
            status["recording"]["finished"],
            status["job"],
        )
        if news != client.last_status[0] or now_s - client.last_status[1] >= STATUS_INTERVAL_S:
            client.last_status = news, now_s
            client.connection.send(status)
