"""Lens calibration from pictures of a ChArUco board: the board to print, finding it, the camera and how sure it is."""
