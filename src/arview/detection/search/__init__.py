"""Searches for rough poses: templates everywhere, pattern search, refinement around the best."""
