"""Several parts, or specimens of one, in one stream."""
