"""Limits on what a client may ask for: how often, how much, how slowly."""

from __future__ import annotations

import asyncio
import json
import time
from collections import OrderedDict
from typing import Any

from starlette.requests import ClientDisconnect, Request

from arview.live.security.refusals import Refusal

BODY_TIMEOUT_S = 10.0
JPEG_BYTES, OFFER_BYTES, CONTROL_BYTES = 4_000_000, 64_000, 4_000
KNOWN_ADDRESSES = 1024


class RateLimit:
    """A token bucket for each address; the addresses seen longest ago are forgotten."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> float:
        """Take one token: 0 when there was one, else the seconds until there will be."""
        now_s = time.monotonic()
        left, since_s = self._buckets.pop(address, (self._burst, now_s))
        left = min(self._burst, left + (now_s - since_s) * self._per_s)
        wait_s = 0.0 if left >= 1.0 else (1.0 - left) / self._per_s
        self._buckets[address] = (left - 1.0 if wait_s == 0.0 else left), now_s
        if len(self._buckets) > KNOWN_ADDRESSES:
            self._buckets.popitem(last=False)
        return wait_s

    def check(self, address: str) -> None:
        """Raise Refusal 429 when the address asks too often."""
        wait_s = self.take(address)
        if wait_s > 0.0:
            headers = {"Retry-After": str(max(1, round(wait_s)))}
            raise Refusal(429, "too_many", "too many requests; wait a moment", headers)


async def body(request: Request, most_bytes: int) -> bytes:
    """The body of a request.

    Raises:
        Refusal: longer than allowed, slower than 10 s, or broken off.
    """
    too_large = Refusal(413, "too_large", f"the body is larger than {most_bytes} bytes")
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > most_bytes:
        raise too_large
    content = bytearray()
    try:
        async with asyncio.timeout(BODY_TIMEOUT_S):
            async for chunk in request.stream():
                content += chunk
                if len(content) > most_bytes:
                    raise too_large
    except TimeoutError as error:
        raise Refusal(408, "too_slow", "the body did not arrive in time", {"Connection": "close"}) from error
    except ClientDisconnect as error:
        raise Refusal(400, "bad_request", "the body broke off") from error
    return bytes(content)


async def json_body(request: Request, most_bytes: int) -> dict[str, Any]:
    """The JSON object in the body of a request.

    Raises:
        Refusal: as `body`, another type, or no JSON object.
    """
    if request.headers.get("content-type", "").split(";")[0].strip().lower() != "application/json":
        raise Refusal(415, "bad_type", "expected application/json")
    content = await body(request, most_bytes)
    try:
        value = json.loads(content, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise Refusal(400, "bad_request", "the body is not JSON") from error
    if not isinstance(value, dict):
        raise Refusal(400, "bad_request", "expected a JSON object")
    return value


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")
