"""Lens calibration from pictures of a ChArUco board: finding the board, the camera, its uncertainty and a verdict."""
