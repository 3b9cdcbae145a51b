"""Options of measuring datum features."""

from __future__ import annotations

CLEAR_MM = 8.0
"""Distance to other components: weld beads and spatter lie within a leg's length of the joint."""
MIN_CLEAR_MM = 2.0
"""Distance to other components where a plane has no room for ``CLEAR_MM``."""
POINT_RADIUS_MM = 4.0
"""Radius of the disc around a datum point that is measured; a few patches."""
REACH_MM = 1.0
"""Largest distance of a feature from its rough place."""
CORRELATED_POINTS = 10.0
"""Neighbouring points whose errors count as one."""
