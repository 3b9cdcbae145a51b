"""The studio's server in a thread, asked as its page asks it."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from arview.cad import load_part
from arview.station.studio.document import StudioDocument
from arview.station.studio.server import StudioServer
from helpers.live_client import Http


class Studio:
    """A running studio."""

    def __init__(self, document: StudioDocument, server: StudioServer, timeout_s: float = 120.0) -> None:
        self.document, self.server = document, server
        self.http = Http(server.port, server.access.token)
        self.http._connection.timeout = timeout_s

    def get(self, path: str, status: int = 200) -> Any:
        """The document or the bytes at a path."""
        found, headers, content = self.http.ask("GET", path)
        assert found == status, content[:500]
        return json.loads(content) if headers["content-type"] == "application/json" else content

    def post(self, path: str, body: object = None, status: int = 200) -> Any:
        """The answer to a document."""
        found, answer = self.http.json("POST", path, {} if body is None else body)
        assert found == status, answer
        return answer

    def send(self, path: str, content: bytes) -> Any:
        """The answer to a file."""
        found, _, answer = self.http.ask("POST", path, content)
        assert found == 200, answer
        return json.loads(answer)

    def edit(self, status: int = 200, **change: object) -> Any:
        """The answer to an edit."""
        return self.post("/api/edit", change, status)


@contextmanager
def running_studio(path: Path, *others: Path) -> Iterator[Studio]:
    """The studio of a part or CAD file, at a free port, beside parts that it might be taken for."""
    document = StudioDocument(path)
    server = StudioServer(document, 0, [load_part(other) for other in others])
    ready, before = threading.Event(), set(threading.enumerate())
    thread = threading.Thread(target=lambda: asyncio.run(server.serve(ready.set)), daemon=True)
    thread.start()
    assert ready.wait(20)
    studio = Studio(document, server)
    try:
        yield studio
    finally:
        studio.http.close()
        server.stop()
        thread.join(20)
        assert not thread.is_alive(), "the studio did not end"
        for one in threading.enumerate():  # native code that runs while the interpreter ends would abort it
            if one not in before and one.name in ("arview-studio-views", "arview-worker"):
                one.join(60)
