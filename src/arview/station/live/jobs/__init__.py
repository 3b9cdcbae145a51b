"""Inspections that pages start: uploads of their photos, their measurement, what pages are told, decisions."""
