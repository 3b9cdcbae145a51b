"""What the tests of the overlay share."""

from __future__ import annotations

import pytest


@pytest.fixture
def no_arrows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Displacements are drawn without arrows."""
    monkeypatch.setattr("arview.overlay.part_layers.SHOW_ARROWS", False)
