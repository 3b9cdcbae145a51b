"""Self-calibration: an unknown focal length, estimated from the tracked frames of a video."""
