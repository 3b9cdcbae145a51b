"""Hub: what all pages share. The subject, the clients with their feeds, the station camera, the recordings."""

from __future__ import annotations

import asyncio
import gc
import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from arview.errors import ArviewError, InputError
from arview.live.options import LiveOptions
from arview.live.protocol import Transport, Way
from arview.live.security.refusals import Refusal
from arview.live.server.clients import Client, check_control, one_of
from arview.live.server.glb import model_glb
from arview.live.stream.documents import (
    Document,
    feed_document,
    loading_document,
    look_document,
    notice_documents,
    part_document,
)
from arview.live.stream.drawing import Drawing
from arview.live.stream.feed import Feed
from arview.live.stream.notices import Notice
from arview.live.stream.recording import Recordings
from arview.live.stream.station import StationCamera
from arview.live.stream.subject import Subject
from arview.live.transport.webrtc import Connection

logger = logging.getLogger("arview.live")

TICK_S = 0.25
STATUS_EVERY_S, RELOAD_EVERY_S = 1.0, 1.0
OFFER_TIMEOUT_S = 10.0


class Hub:
    """The state of one run; all its methods belong to the event loop.

    Args:
        options: of the server.
        addresses: at which WebRTC may be reached.
    """

    def __init__(self, options: LiveOptions, addresses: Sequence[str]) -> None:
        self.options, self._addresses = options, addresses
        self.subject: Subject | None = None
        self.recordings: Recordings | None = None
        self.clients: dict[str, Client] = {}
        self.watchers = 0
        self._loading = loading_document(options, "loading", "the part is being loaded")
        self._part: tuple[int, Document] | None = None
        self._glb: asyncio.Task[bytes] | None = None
        self._station: StationCamera | None = None
        self._shared: tuple[Feed, Drawing] | None = None
        self._recorded: set[Path] = set()
        self._ticker: asyncio.Task[None] | None = None
        self._joining = 0
        self._leaving: set[asyncio.Future[bool]] = set()

    # --- the part -------------------------------------------------------------------------------------

    def begin(self, subject: Subject) -> None:
        """Everything is loaded: open the station camera, let pages take part."""
        self.subject = subject
        self.recordings = Recordings(self.options.record_folder, subject.part.name)
        if not self.options.is_phone:
            feed, drawing = Feed(subject, "station"), Drawing(subject)
            self._shared = feed, drawing
            self._station = StationCamera(self.options.source, feed)
            if self.options.record is not None:
                self.recordings.start(feed, drawing, self.options.record)
        self._ticker = asyncio.ensure_future(self._tick_for_ever())

    def ready(self) -> tuple[Subject, Recordings]:
        """The subject and the recordings.

        Raises:
            Refusal: they are still being loaded.
        """
        if self.subject is None or self.recordings is None:
            raise Refusal(503, "loading", "the part is being loaded; wait a moment", {"Retry-After": "1"})
        return self.subject, self.recordings

    async def part(self) -> Document:
        """*Part*."""
        if self.subject is None:
            return self._loading
        revision = self.subject.revision
        if self._part is None or self._part[0] != revision:
            self._part = revision, await asyncio.to_thread(part_document, self.subject)
        document = self._part[1]
        inspection = self.subject.inspection
        if inspection is not None and document["inspection"] is not None:
            document = {**document, "inspection": {**document["inspection"], "age_s": round(inspection.age_s())}}
        return document

    async def glb(self) -> bytes:
        """The model for the page, made once."""
        subject, _ = self.ready()
        if self._glb is None:
            self._glb = asyncio.ensure_future(asyncio.to_thread(model_glb, subject.part.model))
        return await asyncio.shield(self._glb)

    # --- clients --------------------------------------------------------------------------------------

    async def join(self, wish: dict[str, Any]) -> tuple[Client, str | None]:
        """Take a page in; the client and the SDP of the answer, if it made an offer.

        Raises:
            Refusal: loading, busy, or an offer that cannot be used.
        """
        subject, recordings = self.ready()
        transport: Transport = one_of(wish.get("transport"), Transport, "transport")
        way: Way = one_of(wish.get("way", "poses"), Way, "way")
        offer = wish.get("offer")
        sdp = offer.get("sdp") if isinstance(offer, dict) and offer.get("type") == "offer" else None
        if transport == "webrtc" and not isinstance(sdp, str):
            raise Refusal(400, "bad_offer", "webrtc needs an offer with its sdp")
        if isinstance(before := wish.get("replaces"), str):
            await self.leave(before)
        if len(self.clients) + self._joining >= self.options.most_clients:
            count = len(self.clients)
            raise Refusal(503, "busy", f"busy: {count} of {self.options.most_clients} pages take part already")
        self._joining += 1
        try:
            feed, drawing = self._shared or (Feed(subject, "phone"), Drawing(subject))
            client = Client(feed, drawing, transport, way)
            answer = await self._connect(client, str(sdp)) if transport == "webrtc" else None
        finally:
            self._joining -= 1
        self.clients[client.name] = client
        logger.info("a page takes part by %s (%d of %d)", transport, len(self.clients), self.options.most_clients)
        if self.options.is_phone and self.options.record is not None:
            self._record_phone(recordings, client, self.options.record)
        return client, answer

    async def leave(self, name: str) -> bool:
        """Let a client go; whether there was one."""
        client = self.clients.pop(name, None)
        if client is None:
            return False
        logger.info("a page has left (%d of %d)", len(self.clients), self.options.most_clients)
        await self._let_go(client)
        return True

    def client(self, name: str) -> Client:
        """The client of that name, seen now.

        Raises:
            Refusal: there is none.
        """
        client = self.clients.get(name)
        if client is None:
            raise Refusal(404, "no_such_client", "this page no longer takes part; join again")
        client.seen()
        return client

    async def control(self, client: Client, wish: dict[str, Any]) -> None:
        """Do what a page asks for.

        Raises:
            Refusal: an unknown wish or value; nothing is done then.
        """
        subject, recordings = self.ready()
        names = tuple(component.name for component in subject.part.model.components)
        look = check_control(wish, client.drawing.look, names)
        held = None
        if wish.get("hold") is not None:
            held = client.find(wish["hold"])
            if held is None:
                raise Refusal(404, "no_such_frame", "that picture is no longer kept")
        client.drawing.look = look
        client.way = wish.get("way", client.way)
        if wish.get("reset"):
            client.feed.reset()
        if "hold" in wish:
            client.held = held
        if wish.get("record") is True:
            recordings.start(client.feed, client.drawing)
        elif wish.get("record") is False:
            await asyncio.to_thread(recordings.stop, client.feed)

    # --- what is going on ------------------------------------------------------------------------------

    def watched(self) -> tuple[Feed, Drawing] | None:
        """What a screen shows that only watches: the station, or the phone that came last."""
        if self._shared is not None:
            return self._shared
        latest = max(self.clients.values(), key=lambda client: client.joined_s, default=None)
        return (latest.feed, latest.drawing) if latest is not None else None

    def status(self, client: Client | None) -> Document:
        """*Status*."""
        shared = self._shared
        feed = client.feed if client is not None else shared[0] if shared is not None else None
        described = None
        if feed is not None:
            described = feed_document(feed)
            if self._station is not None:
                described["state"], described["text"] = self._station.state
        recorder = self.recordings.of(feed) if self.recordings is not None and feed is not None else None
        return {
            "type": "status",
            "revision": self.subject.revision if self.subject is not None else 0,
            "way": client.way if client is not None else None,
            "look": look_document(client.drawing.look) if client is not None else None,
            "feed": described,
            "notices": notice_documents(self._notices(feed)),
            "recording": {
                "is_on": recorder is not None,
                "seconds": round(recorder.seconds, 1) if recorder is not None else 0.0,
                "finished": self.recordings.finished if self.recordings is not None else [],
            },
            "clients": len(self.clients),
            "most_clients": self.options.most_clients,
        }

    async def close(self) -> None:
        """Let everyone go and finish the files."""
        if self._ticker is not None:
            self._ticker.cancel()
            with suppress(asyncio.CancelledError):
                await self._ticker
        await asyncio.gather(*(self.leave(name) for name in list(self.clients)))
        if self._station is not None:
            await asyncio.to_thread(self._station.close)
        if self.recordings is not None:
            await asyncio.to_thread(self.recordings.stop_all)
        if self._shared is not None:
            await asyncio.to_thread(self._shared[0].close)

    # --- inside ---------------------------------------------------------------------------------------

    async def _connect(self, client: Client, sdp: str) -> str:
        def ended() -> None:
            leaving = asyncio.ensure_future(self.leave(client.name))
            self._leaving.add(leaving)
            leaving.add_done_callback(self._leaving.discard)

        connection = Connection(client.feed, client.drawing, lambda: client.way, self._addresses, ended)
        client.connection = connection
        try:
            return await asyncio.wait_for(connection.answer(sdp), OFFER_TIMEOUT_S)
        except (InputError, TimeoutError) as error:
            await self._let_go(client)
            raise Refusal(400, "bad_offer", str(error) or "the offer could not be answered in time") from error
        except BaseException:
            await self._let_go(client)
            raise

    async def _let_go(self, client: Client) -> None:
        await client.close()
        if self._shared is None:
            if self.recordings is not None:
                await asyncio.to_thread(self.recordings.forget, client.feed)
            await asyncio.to_thread(client.feed.close)
            await asyncio.to_thread(client.drawing.close)
            # A peer connection and a session are full of cycles: without this some thirty of them pile up first.
            await asyncio.to_thread(gc.collect)

    def _record_phone(self, recordings: Recordings, client: Client, path: Path) -> None:
        """Record a phone from its first frame: OUT.mp4, then the next of OUT-2.mp4, OUT-3.mp4, ... that is free."""
        wanted, number = path, 1
        while wanted in self._recorded or (number > 1 and wanted.exists()):
            number += 1
            wanted = path.with_name(f"{path.stem}-{number}{path.suffix}")
        self._recorded.add(wanted)
        recordings.start(client.feed, client.drawing, wanted)

    def _notices(self, feed: Feed | None) -> list[Notice]:
        said = self.subject.notices() if self.subject is not None else []
        if self._station is not None:
            said = [*said, *self._station.notices()]
        if feed is not None:
            said = [*said, *feed.notices()]
            if self.recordings is not None:
                said = [*said, *self.recordings.notices(feed)]
        return said

    async def _tick_for_ever(self) -> None:
        reloaded_s = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            try:
                now_s = time.monotonic()
                if now_s - reloaded_s >= RELOAD_EVERY_S and self.subject is not None:
                    reloaded_s = now_s
                    await asyncio.to_thread(self.subject.reload)
                for client in list(self.clients.values()):
                    if self._has_gone(client, now_s):
                        await self.leave(client.name)
                    else:
                        self._tell(client, now_s)
            except ArviewError as error:
                logger.warning("%s", error)
            except Exception:  # the ticker serves all pages: it must go on
                logger.exception("the regular look at all pages failed")

    def _has_gone(self, client: Client, now_s: float) -> bool:
        if client.connection is None:
            return not client.is_busy and now_s - client.seen_s > self.options.jpeg_silence_s
        return not client.connection.is_connected and now_s - client.joined_s > self.options.connect_timeout_s

    def _tell(self, client: Client, now_s: float) -> None:
        """Send a page its status when that has news, or once a second."""
        if client.connection is None or not client.connection.is_connected:
            return
        status = self.status(client)
        news = (status["revision"], status["notices"], status["recording"]["is_on"], status["recording"]["finished"])
        if news != client.told[0] or now_s - client.told[1] >= STATUS_EVERY_S:
            client.told = news, now_s
            client.connection.send(status)
