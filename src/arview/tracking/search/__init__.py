"""Searches for the part around a known or remembered pose."""
