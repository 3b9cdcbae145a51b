"""Datums: features of the CAD, their measurement, and the coordinate system built on them."""
