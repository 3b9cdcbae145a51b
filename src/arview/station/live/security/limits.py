"""Limits on the requests of a client: their rate, their size and the time that their bodies take."""

from __future__ import annotations

import asyncio
import json
import time
from collections import OrderedDict
from typing import Any

from starlette.requests import ClientDisconnect, Request

from arview.station.live.security.refusals import Refusal

MAX_ADDRESSES = 1024
"""Addresses that a rate limit remembers."""


class RateLimit:
    """A token bucket for each address; the addresses used longest ago are forgotten.

    Args:
        per_s: tokens added per second.
        burst: capacity of a bucket, full at the start.
    """

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> float:
        """Take one token; returns 0, or the seconds until there is one again when the bucket is empty."""
        now_s = time.monotonic()
        left, since_s = self._buckets.pop(address, (self._burst, now_s))
        left = min(self._burst, left + (now_s - since_s) * self._per_s)
        wait_s = 0.0 if left >= 1.0 else (1.0 - left) / self._per_s
        self._buckets[address] = (left - 1.0 if wait_s == 0.0 else left), now_s
        if len(self._buckets) > MAX_ADDRESSES:
            self._buckets.popitem(last=False)
        return wait_s

    def check(self, address: str) -> None:
        """Take one token.

        Raises:
            Refusal: 429, when the bucket is empty.
        """
        wait_s = self.take(address)
        if wait_s > 0.0:
            headers = {"Retry-After": str(max(1, round(wait_s)))}
            raise Refusal(429, "too_many", "too many requests; wait a moment", headers)


async def body(request: Request, max_bytes: int, timeout_s: float) -> bytes:
    """The body of a request.

    Raises:
        Refusal: the body is too large, does not arrive in time, or is incomplete.
    """
    too_large = Refusal(413, "too_large", f"the body is larger than {max_bytes} bytes")
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > max_bytes:
        raise too_large
    content = bytearray()
    try:
        async with asyncio.timeout(timeout_s):
            async for chunk in request.stream():
                content += chunk
                if len(content) > max_bytes:
                    raise too_large
    except TimeoutError as error:
        raise Refusal(408, "too_slow", "the body did not arrive in time", {"Connection": "close"}) from error
    except ClientDisconnect as error:
        raise Refusal(400, "bad_request", "the body is incomplete") from error
    return bytes(content)


async def json_body(request: Request, max_bytes: int, timeout_s: float) -> dict[str, Any]:
    """The JSON object in the body of a request.

    Raises:
        Refusal: as `body`; or the body is of another type or no JSON object.
    """
    if request.headers.get("content-type", "").split(";")[0].strip().lower() != "application/json":
        raise Refusal(415, "bad_type", "expected application/json")
    content = await body(request, max_bytes, timeout_s)
    try:
        value = json.loads(content, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise Refusal(400, "bad_request", "the body is not JSON") from error
    if not isinstance(value, dict):
        raise Refusal(400, "bad_request", "expected a JSON object")
    return value


def _refuse_constant(name: str) -> float:
    """Refuse NaN and Infinity, which are not JSON but which Python reads."""
    raise ValueError(f"{name} is not a number")
