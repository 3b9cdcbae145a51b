"""Read-only page of a results store: a Pareto of failures, the last failures, and trends, in the look of the report."""

from __future__ import annotations

import base64
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, tzinfo
from importlib import resources
from itertools import accumulate
from typing import Any

import sqlalchemy as sa

from arview.errors import ArviewError
from arview.quality.history.chart import draw
from arview.quality.history.series import series_of
from arview.quality.history.statistics import capability_by_limits, control_chart
from arview.quality.history.store import HistoryStore
from arview.quality.history.tables import characteristics, components, results, voids
from arview.web import font

SHOWN_FAILURES = 20
_TABLES = ((components, "distance"), (characteristics, "characteristic"))
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; font-src data:; img-src 'self' data:;"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def application(store: HistoryStore, zone: tzinfo | None = None, hosts: Sequence[str] = ("127.0.0.1",)) -> Any:
    """The page as an ASGI application, which answers GET alone and writes nothing.

    Args:
        store: the results.
        zone: of its times; None: that of this machine.
        hosts: names that a request may call this machine, ``*`` for all; others are refused (DNS rebinding).
    """
    import jinja2
    from markupsafe import Markup
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, PlainTextResponse, Response
    from starlette.routing import Route

    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        (resources.files("arview.quality.history") / "page.html").read_text(encoding="utf-8")
    )
    drawing = threading.Lock()  # the settings of matplotlib are those of the whole process

    def page(request: Request) -> Response:
        context = _context(store, request.query_params.get("part"), zone)
        return HTMLResponse(template.render(context, css=Markup(_style())), headers=_HEADERS)

    def picture(request: Request) -> Response:
        with drawing:
            content = _picture(store, request.query_params, zone)
        return Response(content, media_type="image/svg+xml", headers=_HEADERS)

    def refuse(request: Request, error: Exception) -> Response:
        return PlainTextResponse(str(error), 404, headers=_HEADERS)

    return Starlette(
        routes=[Route("/", page), Route("/chart.svg", picture)],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[*hosts])],
        exception_handlers={ArviewError: refuse},
    )


def _style() -> str:
    """The style of the report, and its font."""
    faces = [
        f"@font-face {{ font-family: Inter; font-weight: {weight}; src: url(data:font/woff2;base64,"
        f'{base64.b64encode(font(f"inter-{weight}")).decode("ascii")}) format("woff2"); }}'
        for weight in (400, 600)
    ]
    return "\n".join([*faces, (resources.files("arview.report") / "report.css").read_text(encoding="utf-8")])


def _picture(store: HistoryStore, query: Mapping[str, str], zone: tzinfo | None) -> bytes:
    """The control chart that a request asks for, as SVG."""
    of: Any = query.get("of", "distance")
    series = replace(series_of(store, query.get("name", ""), of, query.get("part")), zone=zone)
    found = capability_by_limits(series).get((series.lower, series.upper))
    try:
        chart = control_chart([one.value for one in series.values], series.is_length)
    except ArviewError:  # too few values
        chart = None
    return draw(series, chart, None if isinstance(found, ArviewError) else found)


def _context(store: HistoryStore, part: str | None, zone: tzinfo | None) -> dict[str, Any]:
    """What the template takes."""
    parts = sorted(str(row.part) for row in store.rows(sa.select(results.c.part).distinct()))
    newest = store.listed(part, limit=1)
    part = newest[0].part if newest else part or ""
    counted = (results.c.part == part, results.c.id.not_in(sa.select(voids.c.result_id)))
    verdicts = sa.select(results.c.verdict, sa.func.count().label("count")).where(*counted).group_by(results.c.verdict)
    failing = sa.union(*(sa.select(table.c.result_id).where(table.c.verdict == "fail") for table, _ in _TABLES))
    columns = results.c.id, results.c.serial, results.c.station, results.c.measured
    last = sa.select(*columns).where(*counted, results.c.id.in_(failing)).order_by(results.c.measured.desc())
    failures = store.rows(last.limit(SHOWN_FAILURES))
    failed: list[tuple[int, str]] = []
    names: dict[str, str] = {}
    of_results: dict[int, list[str]] = {}
    for table, quantity in _TABLES:
        fails = sa.select(table.c.name, sa.func.count().label("count")).join(results).group_by(table.c.name)
        failed += [(int(row[1]), row.name) for row in store.rows(fails.where(*counted, table.c.verdict == "fail"))]
        of_newest = sa.select(table.c.name).where(table.c.result_id == (newest[0].id if newest else None))
        names |= dict.fromkeys((row.name for row in store.rows(of_newest.order_by(table.c.name))), quantity)
        shown = table.c.result_id.in_([one.id for one in failures])
        for row in store.rows(sa.select(table.c.result_id, table.c.name).where(shown, table.c.verdict == "fail")):
            of_results.setdefault(row.result_id, []).append(row.name)
    failed.sort(key=lambda pair: (-pair[0], pair[1]))
    whole, order = sum(count for count, _ in failed), {name: place for place, (_, name) in enumerate(failed)}
    sums = accumulate(count for count, _ in failed)

    def time(moment: datetime) -> str:
        return f"{moment.astimezone(zone):%Y-%m-%d %H:%M}"

    return {
        "store": store.name,
        "zone": str(zone or "local time"),
        "part": part,
        "parts": parts,
        "verdicts": {row.verdict: int(row[1]) for row in store.rows(verdicts.order_by(results.c.verdict))},
        "newest": time(newest[0].measured) if newest else "",
        "pareto": [
            {"name": name, "count": count, "share": 100.0 * count / whole, "sum": 100.0 * until / whole}
            for (count, name), until in zip(failed, sums, strict=True)
        ],
        "failures": [
            {
                "id": one.id,
                "serial": one.serial,
                "station": one.station,
                "time": time(datetime.fromisoformat(one.measured)),
                "names": ", ".join(of_results.get(one.id, ())),
            }
            for one in failures
        ],
        "charts": sorted(names.items(), key=lambda pair: order.get(pair[0], len(order))),
    }
