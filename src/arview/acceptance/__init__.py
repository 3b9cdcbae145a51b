"""Acceptance test by lengths, in the manner of VDI/VDE 2634 part 1: known lengths against measured ones."""
