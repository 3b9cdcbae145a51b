"""Refusal: a request that is not served, and its answer."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.responses import JSONResponse, Response


class Refusal(Exception):
    """An error of the protocol: HTTP status, code and one line for a person."""

    def __init__(self, status: int, code: str, message: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.headers = status, code, message, headers

    def response(self) -> Response:
        """The answer."""
        return JSONResponse({"error": self.code, "message": self.message}, self.status, self.headers)
