"""Readers of CAD files, and what they have in common."""
