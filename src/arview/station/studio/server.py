"""The life cycle of the studio's server, which is reached from this machine only."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from arview.cad import Part
from arview.station import live
from arview.station.studio.app import make_app
from arview.station.studio.document import StudioDocument

WORKERS = 8
"""Threads for the work that takes time."""
WORK_TIMEOUT_S = 1800.0
"""Longest time for one piece of work."""


class StudioServer:
    """Serves the studio of one part at the loopback address.

    Args:
        document: the part.
        port: of the page; 0 stands for any free one.
        others: parts that it might be taken for.

    Raises:
        InputError: the port is not available.
    """

    def __init__(self, document: StudioDocument, port: int, others: Sequence[Part] = ()) -> None:
        self._endpoint = live.open_endpoint(None, port, is_plain=True)
        self.access = live.Access.to([live.LOOPBACK, "localhost"], self._endpoint.port, is_secure=False)
        self._server = live.UvicornServer(make_app(document, self.access, others), self._endpoint.listener)

    @property
    def port(self) -> int:
        """Port of the page."""
        return self._endpoint.port

    @property
    def link(self) -> str:
        """URL of the page with the token of this run."""
        return f"http://{live.LOOPBACK}:{self.port}/?token={self.access.token}"

    def stop(self) -> None:
        """Make `serve` end."""
        self._server.stop()

    async def serve(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Serve until `stop`."""
        # Work that is under way when the server ends is not waited for.
        asyncio.get_running_loop().set_default_executor(live.WorkerPool(WORKERS, WORK_TIMEOUT_S))
        task = asyncio.ensure_future(self._server.run_until_stopped())
        on_ready()
        await task
