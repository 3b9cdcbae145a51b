"""Options of the monitoring of the identity."""

from __future__ import annotations
