"""What the tests of pages share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from helpers.live_sample import patience


@pytest.fixture(scope="module", autouse=True)
def patient_servers() -> Iterator[None]:
    """Servers of these tests are as patient as the machine is slow."""
    with patience():
        yield
