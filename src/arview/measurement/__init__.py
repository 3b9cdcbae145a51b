"""Measurement: datum alignment, deviation of each component with its uncertainty, verdicts."""
