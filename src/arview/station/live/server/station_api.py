"""Requests about what the station keeps: recordings, snapshots and paired devices."""

from __future__ import annotations

import asyncio
import re
import secrets
from datetime import UTC, datetime
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from arview.core.atomic import write_file
from arview.errors import OutputError
from arview.station.live.security.access import DEVICE
from arview.station.live.security.refusals import Refusal
from arview.station.live.server.hub import Hub
from arview.station.live.stream.documents import Document

KEPT_NAME = re.compile(r"snapshot_[\w.-]+\.png")
"""Names of the snapshots that are kept, and served."""
MAX_SNAPSHOTS = 2000
"""Snapshots that are listed, and beyond which no more are kept."""


class StationHandlers:
    """The handlers of these routes; `arview.station.live.protocol` defines requests and responses."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub

    @property
    def routes(self) -> list[Route]:
        """The routes."""
        return [
            Route("/api/recordings", self.recordings),
            Route("/api/recordings/{number:int}", self.recording),
            Route("/api/snapshots", self.snapshots),
            Route("/api/snapshots/{name}", self.snapshot),
            Route("/api/devices", self.devices),
            Route("/api/devices/{name}", self.revoke, methods=["DELETE"]),
        ]

    async def recordings(self, request: Request) -> Response:
        """The finished recordings."""
        _, recordings = self._hub.ready()
        files = await asyncio.to_thread(recordings.listed)
        return JSONResponse(
            {
                "recordings": [
                    {
                        "number": one.number,
                        "name": one.path.name,
                        "bytes": one.bytes,
                        "seconds": one.seconds,
                        "created": _text(one.created),
                        "is_recovered": one.is_recovered,
                    }
                    for one in files
                ]
            }
        )

    async def recording(self, request: Request) -> Response:
        """A finished recording."""
        _, recordings = self._hub.ready()
        path = recordings.path(request.path_params["number"])
        if path is None or not path.is_file():
            raise Refusal(404, "not_found", "there is no such recording")
        return FileResponse(path, media_type="video/mp4", filename=path.name)

    async def snapshots(self, request: Request) -> Response:
        """The snapshots that are kept."""
        return JSONResponse({"snapshots": await asyncio.to_thread(_kept_pictures, self._folder)})

    async def snapshot(self, request: Request) -> Response:
        """A snapshot that is kept."""
        name = request.path_params["name"]
        path = self._folder / name
        if KEPT_NAME.fullmatch(name) is None or not path.is_file():
            raise Refusal(404, "not_found", "there is no such snapshot")
        return FileResponse(path, media_type="image/png")

    async def devices(self, request: Request) -> Response:
        """The paired devices."""
        devices = self._hub.devices
        own = request.scope.get(DEVICE)
        return JSONResponse(
            {
                "devices": [
                    {
                        "name": one.name,
                        "created": _text(one.created),
                        "last_used": _text(one.last_used),
                        "is_this": one.name == own,
                    }
                    for one in (devices.listed() if devices is not None else ())
                ]
            }
        )

    async def revoke(self, request: Request) -> Response:
        """Forget a device: its page stops at once, and it has to be paired again."""
        if not await self._hub.revoke(request.path_params["name"]):
            raise Refusal(404, "not_found", "there is no device of that name")
        return Response(status_code=204)

    @property
    def _folder(self) -> Path:
        return self._hub.options.record_folder


def keep_snapshot(folder: Path, part_name: str, png: bytes) -> str:
    """Write a snapshot into the folder of the recordings; returns its name.

    Raises:
        Refusal: there are too many, or it cannot be written.
    """
    if sum(1 for _ in folder.glob("snapshot_*.png")) >= MAX_SNAPSHOTS:
        raise Refusal(507, "disk_full", f"{MAX_SNAPSHOTS} snapshots are kept at the station; move some")
    stem = re.sub(r"[^\w.-]+", "_", part_name).strip("._") or "part"
    name = f"snapshot_{stem}_{datetime.now():%Y%m%d-%H%M%S}_{secrets.token_hex(2)}.png"
    try:
        write_file(folder / name, png)
    except OutputError as error:
        raise Refusal(507, "disk_full", "the snapshot cannot be written at the station") from error
    return name


def _kept_pictures(folder: Path) -> list[Document]:
    """Name, size and time of each snapshot, the newest first."""
    found = []
    for path in folder.glob("snapshot_*.png"):
        try:
            stat = path.stat()
        except OSError:
            continue
        found.append((stat.st_mtime, path.name, stat.st_size))
    return [
        {"name": name, "bytes": size, "created": _text(datetime.fromtimestamp(moment, UTC))}
        for moment, name, size in sorted(found, reverse=True)[:MAX_SNAPSHOTS]
    ]


def _text(time: datetime) -> str:
    return time.isoformat(timespec="seconds").replace("+00:00", "Z")
