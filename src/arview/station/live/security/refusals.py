"""Refusals: requests that the server does not carry out, and the responses that say so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from starlette.responses import JSONResponse, Response


class Refusal(Exception):
    """An error of the protocol: HTTP status, error code, a message of one line, and what else the response holds."""

    def __init__(
        self,
        status: int,
        code: str,
        message: str,
        headers: Mapping[str, str] | None = None,
        details: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.headers = status, code, message, headers
        self.details = details or {}

    def response(self) -> Response:
        """The JSON response to the refused request."""
        return JSONResponse({"error": self.code, "message": self.message, **self.details}, self.status, self.headers)
