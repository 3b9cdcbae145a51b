"""One stream of frames: its source, tracking, drawing, recording and JSON documents."""
