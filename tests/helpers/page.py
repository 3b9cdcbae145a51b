"""The live page in a browser: opening it, waiting for it, and what it has drawn."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from helpers.live_client import Running

TIMEOUT_S = 120.0
"""Chromium without a GPU, the tracker and the tests share two cores."""
VIEWPORT = {"width": 680, "height": 640}
"""Here the picture is shown a little larger than it is."""


@contextmanager
def opened(
    chromium: Any,
    server: Running,
    script: str = "",
    viewport: dict[str, int] = VIEWPORT,
    constants: Mapping[str, str] | None = None,
    **settings: Any,
) -> Iterator[Any]:
    """The open page, with settings of the browser's context; at the end it is checked that it raised no errors.

    The ``constants`` of the page's scripts have other values than usual, by their names; each is there.
    """
    context = chromium.new_context(viewport=viewport, accept_downloads=True, **settings)
    page = context.new_page()
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(f"error: {error}"))
    page.on("console", lambda said: troubles.append(said.text) if "Content Security" in said.text else None)
    if script:
        page.add_init_script(script)
    left = dict(constants or {})
    if left:
        page.route("**/*.js", lambda route: _with_constants(route, dict(constants or {}), left))
    try:
        page.goto(f"http://127.0.0.1:{server.port}/?token={server.token}")
        yield page
    except AssertionError as error:
        if troubles:  # the cause, rather than what did not happen because of it
            raise AssertionError(f"{error}; the page reported {troubles}") from error
        raise
    finally:
        context.close()
    assert not troubles
    assert not left, f"no script has {sorted(left)}"


def _with_constants(route: Any, constants: Mapping[str, str], left: dict[str, str]) -> None:
    """Answer a request for a script with some of its constants changed; those are no longer left."""
    answer = route.fetch()
    text = answer.text()
    for name, value in constants.items():
        text, count = re.subn(rf"\b{name} = [\d_.]+", f"{name} = {value}", text)
        if count:
            left.pop(name, None)
    route.fulfill(response=answer, body=text)


def until(page: Any, condition: str | Callable[[], Any], timeout_s: float = TIMEOUT_S) -> Any:
    """Wait until an expression of the page, or a function, is true; returns its value."""
    end_s = time.monotonic() + timeout_s
    while True:
        value = page.evaluate(condition) if isinstance(condition, str) else condition()
        if value:
            return value
        if time.monotonic() > end_s:
            state = page.inner_text("#state"), page.inner_text("#link-state"), page.inner_text("#message")
            raise AssertionError(f"not within {timeout_s:.0f} s: {condition}; the page says {state}")
        page.wait_for_timeout(150)


WATCH = """
window.drawn = null;
window.draws = 0;
document.addEventListener("arview:drawn", (event) => { window.drawn = event.detail; window.draws += 1; });
"""


def changed(path: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Any], None]:
    """What makes a page get changed documents from the station for a path."""

    def act(page: Any) -> None:
        def handle(route: Any) -> None:
            document = route.fetch().json()
            change(document)
            route.fulfill(json=document)

        page.route(f"**{path}", handle)

    return act
