"""Access control: the tokens of the run and of paired devices, the host name, the origin of the request, its rate."""

from __future__ import annotations

import asyncio
import hmac
import secrets
from collections.abc import Collection
from dataclasses import dataclass, field
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from arview.station.live.protocol import COOKIE
from arview.station.live.security.connections import ConnectionTable
from arview.station.live.security.devices import Devices
from arview.station.live.security.limits import RateLimit
from arview.station.live.security.refusals import Refusal

PAGES = ("/", "/watch")
"""Paths whose query may carry the token."""
PROBES = ("/health", "/ready")
"""Paths that need no token: they tell no more than that the server is there."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "media-src 'self' blob: mediastream:; worker-src 'self' blob:; font-src 'self'; manifest-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
}
NO_TOKEN_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>arview</title>
<h1>This link is not valid</h1>
<p>Scan the code at the station again: arview makes a new one each time it starts.</p></html>"""
DEVICE = "arview_device"
"""Key of the scope of a request under which the name of its device stands."""
COOKIE_AGE_S = 180 * 86400
"""Lifetime of the cookie of a paired device; each time the page is opened it starts anew."""


@dataclass(frozen=True)
class Access:
    """What a request must present to be served.

    Attributes:
        hosts: accepted ``Host`` headers, in lower case, with the port.
        port: port of the server. It is part of the cookie's name because all ports of a host share their cookies.
        is_secure: whether the server is reached by HTTPS.
        token: secret of this run. With devices it is only good for pairing, else it is what cookies hold.
        devices: the paired devices, each with a token of its own; None: there are none.
    """

    hosts: frozenset[str]
    port: int
    is_secure: bool
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    devices: Devices | None = field(default=None, repr=False)

    @staticmethod
    def to(names: Collection[str], port: int, is_secure: bool, devices: Devices | None = None) -> Access:
        """Access to a server that is reached by these names and addresses."""
        written = [f"[{name}]" if ":" in name else name for name in names]
        usual = 443 if is_secure else 80
        hosts = {f"{name}:{port}".lower() for name in written} | {n.lower() for n in written if port == usual}
        return Access(frozenset(hosts), port, is_secure, devices=devices)

    @property
    def scheme(self) -> str:
        """URL scheme of the pages."""
        return "https" if self.is_secure else "http"

    def is_token(self, text: str) -> bool:
        """Whether a text is the token, compared in constant time."""
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())

    @property
    def cookie_name(self) -> str:
        """Name of the cookie that holds the token."""
        return f"{COOKIE}_{self.port}"

    @property
    def cookie(self) -> str:
        """Value of the ``Set-Cookie`` header that holds the token of the run."""
        return self.cookie_with(self.token)

    def cookie_with(self, token: str) -> str:
        """Value of the ``Set-Cookie`` header that holds a token."""
        secure = "; Secure" if self.is_secure else ""
        age = f"; Max-Age={COOKIE_AGE_S}" if self.devices is not None else ""
        return f"{self.cookie_name}={token}; Path=/; HttpOnly; SameSite=Strict{age}{secure}"


class Gate:
    """ASGI middleware that serves what `Access` and the rate limits allow, and adds the security headers.

    Args:
        app: the application.
        access: what a request must present.
        rate: limit on requests with the token, by address.
        connections: the open connections, which are told who has shown the token.
        unauthenticated_rate: limit on requests without the token, by address; they cannot use up the other one.
    """

    def __init__(
        self,
        app: ASGIApp,
        access: Access,
        rate: RateLimit,
        connections: ConnectionTable | None = None,
        unauthenticated_rate: RateLimit | None = None,
    ) -> None:
        self._app, self._access, self._rate = app, access, rate
        self._connections, self._unauthenticated_rate = connections, unauthenticated_rate or rate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve or refuse a request."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http":
            return
        headers = Headers(scope=scope)
        cookie: list[str] = []

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    answer.setdefault(name, value)
                answer.setdefault("Cache-Control", "no-store")
                for value in cookie:
                    answer.append("Set-Cookie", value)
            await send(message)

        address, port = scope.get("client") or ("?", 0)
        is_probe = scope["path"] in PROBES and scope["method"] in ("GET", "HEAD")
        try:
            try:
                self._check_host(headers)
                cookie += [] if is_probe else await self._check_token(scope, headers)
            except Refusal:
                self._unauthenticated_rate.check(str(address))
                raise
            (self._unauthenticated_rate if is_probe else self._rate).check(str(address))
            if self._connections is not None and not is_probe:
                self._connections.show_token((str(address), int(port)), scope.get(DEVICE) or str(address))
            self._check_origin(scope, headers)
        except Refusal as refusal:
            await self._refused(scope, refusal)(scope, receive, send_with_headers)
            return
        await self._app(scope, receive, send_with_headers)

    def _check_host(self, headers: Headers) -> None:
        """Refuse foreign host names that resolve to this address (DNS rebinding)."""
        if headers.get("host", "").lower() not in self._access.hosts:
            raise Refusal(421, "other_host", "this server does not have that name")

    async def _check_token(self, scope: Scope, headers: Headers) -> list[str]:
        """Check that a request shows a token; returns the cookie that its browser is given, if any.

        A page whose URL carries the token of the run pairs its browser, unless that is paired already.
        """
        access, devices = self._access, self._access.devices
        is_page = scope["path"] in PAGES and scope["method"] in ("GET", "HEAD")
        shown = cookie_parser("; ".join(headers.getlist("cookie"))).get(access.cookie_name, "")
        has_link = is_page and access.is_token(_query_token(scope["query_string"]))
        if devices is None:
            if not has_link and not access.is_token(shown):
                raise Refusal(403, "no_token", "scan the code at the station again")
            return [access.cookie] if has_link else []
        name = devices.find(shown)
        if name is None:
            if not has_link:
                raise Refusal(403, "no_token", "scan the code at the station again")
            name, shown = await asyncio.to_thread(devices.pair, headers.get("user-agent", ""))
        scope[DEVICE] = name
        return [access.cookie_with(shown)] if is_page else []

    def _check_origin(self, scope: Scope, headers: Headers) -> None:
        """Refuse requests from pages of other sites."""
        if scope["method"] in ("GET", "HEAD"):
            if headers.get("sec-fetch-site") in ("cross-site", "same-site") and scope["path"] not in PAGES:
                raise Refusal(403, "other_origin", "the request comes from a page of another site")
            return
        if headers.get("origin", "").lower() != f"{self._access.scheme}://{headers.get('host', '').lower()}":
            raise Refusal(403, "other_origin", "the request comes from a page of another site")

    def _refused(self, scope: Scope, refusal: Refusal) -> Response:
        if refusal.code == "no_token" and scope["path"] in PAGES:
            return HTMLResponse(NO_TOKEN_PAGE, refusal.status)
        return refusal.response()


def _query_token(query: bytes) -> str:
    """The token in the query of a URL, or an empty text."""
    try:
        return parse_qs(query.decode("latin-1"), max_num_fields=20).get("token", [""])[0]
    except ValueError:  # more fields than a page sends
        return ""
