"""What monitors read: whether the server is alive and ready, which needs no token, and its figures."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from arview.station.live.server.hub import Hub


def monitoring_routes(hub: Hub) -> list[Route]:
    """``/health``, ``/ready`` (503 while the part is being loaded) and ``/metrics`` in the format of Prometheus."""

    async def health(request: Request) -> Response:
        return JSONResponse({"status": "alive"})

    async def ready(request: Request) -> Response:
        hub.ready()
        return JSONResponse({"is_ready": True})

    async def metrics(request: Request) -> Response:
        feeds = {id(client.feed): client.feed for client in hub.clients.values()}
        values = {
            "ready": int(hub.subjects is not None),
            "clients": len(hub.clients),
            "watchers": hub.watchers,
            "tracked_frames_per_second": sum(feed.tracked_rate.value() for feed in feeds.values()),
            "jobs_pending": hub.desk.workers.pending,
        }
        lines = [f"# TYPE arview_live_{name} gauge\narview_live_{name} {value}\n" for name, value in values.items()]
        return PlainTextResponse("".join(lines))

    return [Route("/health", health), Route("/ready", ready), Route("/metrics", metrics)]
