"""Hooks: each result and alarm is posted to a URL."""

from __future__ import annotations

import asyncio
from urllib.error import HTTPError
from urllib.request import HTTPRedirectHandler, Request, build_opener

from arview.station.plant.outbox import Outbox, PendingMessage
from arview.station.plant.outlet import Outlet
from arview.station.plant.settings import HookTable, PlantSettings

TIMEOUT_S = 4.0
"""Time for the answer to a message; the end of the program waits for it."""


class _NoRedirects(HTTPRedirectHandler):
    """A redirect would turn the POST into a GET, whose answer confirms nothing."""

    def redirect_request(self, *_: object) -> None:
        """Follow no redirect."""


class Hook(Outlet):
    """Posts the messages of the outbox to a URL, one after another."""

    def __init__(self, settings: PlantSettings, hook: HookTable, outbox: Outbox) -> None:
        super().__init__(hook.name)
        self._settings, self._hook, self._outbox = settings, hook, outbox
        self._opener = build_opener(_NoRedirects)

    async def run(self) -> None:
        """Post until there is no answer or one that is no confirmation.

        Raises:
            OSError: so it is; an `HTTPError` too.
        """
        await self.deliver(self._outbox, lambda message: asyncio.to_thread(self._post, message))

    def _post(self, message: PendingMessage) -> str | None:
        headers = {"Content-Type": "application/json", "Idempotency-Key": message.key, "User-Agent": "arview"}
        if token := self._settings.secret(self._hook.token_file):
            headers["Authorization"] = f"Bearer {token}"
        try:
            with self._opener.open(Request(self._hook.url, message.body, headers), timeout=TIMEOUT_S):
                self.is_connected, self.error = True, ""
                return None
        except HTTPError as error:
            error.close()
            if not 400 <= error.code < 500 or error.code in (408, 429):
                raise
            self.is_connected, self.error = True, str(error)
            return self.error
