"""Named peers beside arview, on the same frames, photos and clouds."""
