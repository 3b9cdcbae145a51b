"""Where the checkout, its samples and the data beside it lie, whatever the depth of the test that asks."""

from __future__ import annotations

import os
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
SAMPLES = ROOT / "samples"
TOOLS = ROOT / "tools"
SHARED = Path(os.environ.get("ARVIEW_DATA") or ROOT.parent / "shared" / "data")
"""Recorded sequences and photo sets that are too large for the repository; tests that need them are marked `shared`."""
