"""Refusals: requests that the server does not carry out, and the responses that say so."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.responses import JSONResponse, Response


class Refusal(Exception):
    """An error of the protocol: HTTP status, error code and a message of one line."""

    def __init__(self, status: int, code: str, message: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.headers = status, code, message, headers

    def response(self) -> Response:
        """The JSON response to the refused request."""
        return JSONResponse({"error": self.code, "message": self.message}, self.status, self.headers)
