"""The laboratory of arview: evaluation on recorded scenes, semi-synthetic sequences, studies of accuracy."""
