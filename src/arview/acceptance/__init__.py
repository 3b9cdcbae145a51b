"""Acceptance test with calibrated lengths after VDI/VDE 2634 part 1."""
