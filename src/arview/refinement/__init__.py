"""Refinement: from a rough pose to the pose, in one picture; nothing is kept between calls."""
