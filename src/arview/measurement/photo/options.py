"""Options of the measurement in photos."""

from __future__ import annotations

JOINT_MM = 4.0
"""Surfaces and edges this near to another component are dropped: welds, gaps, shadows."""
UNDETERMINED_MM = 0.3
"""Largest standard deviation of a determined direction; rotations at the rim."""
