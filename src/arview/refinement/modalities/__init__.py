"""Modalities: what each kind of measurement adds to the pose."""
