"""What the tests of the live server share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from helpers.live_client import Http, Running, visiting


@pytest.fixture
def page(server: Running) -> Iterator[Http]:
    """A page of the module's server; at the end, no client is left."""
    yield from visiting(server)
