"""The HTTP routes of a station in the plant: triggers, and what monitors read."""

from __future__ import annotations

import hmac

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from arview.errors import InputError
from arview.station.plant.plant import Plant
from arview.station.plant.schema import openapi


def plant_routes(plant: Plant, token: str = "") -> list[Route]:
    """``/health``, ``/ready``, ``/metrics``, ``POST /triggers`` and ``/schema``.

    Args:
        plant: the station.
        token: that a request must show (``Authorization: Bearer …``). Without it only that the station is alive and
            whether it is ready is told. Empty: everybody who reaches the server may do all.
    """

    def is_known(request: Request) -> bool:
        shown = request.headers.get("authorization", "").removeprefix("Bearer ")
        return not token or hmac.compare_digest(shown.encode(), token.encode())

    async def trigger(request: Request) -> Response:
        if not is_known(request):
            return no_token
        # A page of another site cannot send this type without asking first, which nobody answers.
        if request.headers.get("content-type", "").split(";")[0].strip().lower() != "application/json":
            return JSONResponse({"error": "expected Content-Type: application/json"}, 415)
        try:
            plant.take(await request.body())
        except InputError as error:
            return JSONResponse({"error": str(error)}, 400)
        return JSONResponse({"is_taken": True}, 202)

    document = openapi(plant.settings.topic)
    no_token = JSONResponse({"error": "expected Authorization: Bearer TOKEN"}, 401, {"WWW-Authenticate": "Bearer"})
    return [
        Route("/health", lambda request: JSONResponse(plant.health() if is_known(request) else {"status": "alive"})),
        Route("/ready", lambda _: JSONResponse({"is_ready": plant.is_ready}, 200 if plant.is_ready else 503)),
        Route("/metrics", lambda request: PlainTextResponse(plant.metrics()) if is_known(request) else no_token),
        Route("/schema", lambda _: JSONResponse(document)),
        Route("/triggers", trigger, methods=["POST"]),
    ]
