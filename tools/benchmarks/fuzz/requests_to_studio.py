"""Requests to the application of `arview studio`, called as a server calls it, without a network."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from guard import Fault, guarded
from hypothesis import strategies as st
from mutations import CHANGES, changed
from requests_to_app import HEADERS, HOST, ask, check_answer
from seeds import PART, make_seeds

from arview.station.live.security.access import Access
from arview.station.studio import app as studio
from arview.station.studio.document import StudioDocument

GETS = (
    "/",
    "/static/studio.js",
    "/static/../app.py",
    "/api/part",
    "/api/findings",
    "/api/mesh",
    "/api/mesh?coarse=1",
    "/api/views",
    "/api/views/0.png",
    "/api/views/99999999999999999999.png",
    "/api/views/-1.png",
    "/api/advice",
    "/api/photos",
    "/api/photos?count=0",
    "/api/photos?count=1",
    "/api/photos?count=999",
    "/api/photos?count=x",
    "/api/trial.jpg",
    "/api/none",
)
EDITS: tuple[dict[str, Any], ...] = (
    {"kind": "component", "names": ["brick"], "key": "role", "value": "base"},
    {"kind": "component", "names": ["brick"], "key": "position_tolerance_mm", "value": 0.5},
    {"kind": "component", "names": ["brick"], "key": "color", "value": "#ff8800"},
    {"kind": "component", "names": ["brick"], "key": "point", "value": [0, 0, 0]},
    {"kind": "part", "key": "name", "value": "brick"},
    {"kind": "part", "key": "up", "value": "y"},
    {"kind": "part", "key": "unit", "value": "inch"},
    {"kind": "view_range", "value": {"distance_mm": [300, 500], "elevation_deg": [10, 60], "azimuth_deg": [0, 90]}},
    {"kind": "view_range", "value": None},
    {"kind": "datum", "label": "A", "value": {"component": "brick", "kind": "plane", "normal": [0, 0, 1]}},
    {"kind": "symmetries", "value": [{"axis": [0, 0, 1], "through_mm": [0, 0, 0], "order": 2}]},
    {"kind": "text", "value": PART},
)
POSTS: tuple[tuple[str, bytes], ...] = (
    *(("/api/edit", json.dumps(edit).encode()) for edit in EDITS),
    ("/api/pick", b'{"component": "brick", "face": 0, "point_mm": [1.0, 2.0, 0.0]}'),
    ("/api/undo", b"{}"),
    ("/api/redo", b"{}"),
    ("/api/save", b"{}"),
    ("/api/export", b'{"kinds": ["sheet", "station"]}'),
    ("/api/trial?name=a.jpg&camera=fov:65", b""),
    ("/api/trial?name=a.jpg&camera=fov:nan", b""),
    ("/api/trial?name=a.mp4", b"x"),
    ("/api/trial?name=../a.sh", b"x"),
)
REQUESTS: st.SearchStrategy[Any] = st.one_of(
    st.tuples(st.just("GET"), st.sampled_from([(path, b"") for path in GETS]), st.just([]), st.just([])),
    st.tuples(st.just("POST"), st.sampled_from(POSTS), st.just([]), st.one_of(st.just([]), CHANGES)),
    st.tuples(
        st.sampled_from(["GET", "POST", "DELETE", "PUT", "HEAD", "FOO"]),
        st.sampled_from(POSTS),
        st.lists(st.sampled_from(HEADERS), max_size=3),
        CHANGES,
    ),
)


def fuzz_studio(folder: Path) -> tuple[Callable[[Any], None], st.SearchStrategy[Any]]:
    """The attempt on the application and the strategy of its argument."""
    home = folder / "studio" / "seeds"
    make_seeds(home, "part")
    access = Access.to(["127.0.0.1"], 8443, False)
    usual = [("host", HOST), ("origin", f"http://{HOST}"), ("cookie", access.cookie.split(";")[0])]
    loop = asyncio.new_event_loop()
    document = StudioDocument(home / "part.toml")
    app = studio.make_app(document, access)
    loop.run_until_complete(ask(app, "GET", "/api/photos", usual, b""))  # compiles what it needs

    def attempt(argument: tuple[str, tuple[str, bytes], list[tuple[str, str]], list[Any]]) -> None:
        method, (target, content), more, changes = argument
        body = changed(content, changes, False)
        (folder / "studio" / "current").write_bytes(repr((method, target, more)).encode() + b"\n" + body)
        names = {name for name, _ in more}
        headers = [*[pair for pair in usual if pair[0] not in names], *more]
        with guarded("studio", folder / "studio" / "native.txt"):
            status, answer = loop.run_until_complete(ask(app, method, target, headers, body))
            check_answer("studio", method, target, status, answer)
            if status == 422 and len(str(json.loads(answer)["message"]).splitlines()) != 1:
                raise Fault("studio not one line", f"{method} {target} {answer[:300]!r}")

    return attempt, REQUESTS
