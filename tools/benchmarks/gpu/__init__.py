"""Checks and timings of all that a GPU can do."""
