"""Reader of PLY by trimesh."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np

from arview.cad.formats.raw import RawComponent, RawModel
from arview.cad.formats.text_encoding import with_decimal_points
from arview.errors import InputError


def read_ply(path: Path) -> RawModel:
    """A PLY file read by trimesh: one mesh without a unit."""
    import trimesh

    data, notes = path.read_bytes(), list[str]()
    if b"format ascii" in data[:256]:
        data, notes = with_decimal_points(data, rb"[-+]?\d")
    try:
        with _quiet_trimesh():
            scene = trimesh.load_scene(BytesIO(data), file_type="ply", process=False)
    except Exception as error:  # trimesh raises whatever its parsers stumble over
        printed = next(iter(str(error).splitlines()), "")
        raise InputError(
            f"{path}: broken or truncated PLY ({type(error).__name__}: {printed}); export it again"
        ) from error
    raw = RawModel(notes=notes)
    several = len(scene.geometry) > 1
    for name, mesh in scene.geometry.items():
        faces = np.asarray(getattr(mesh, "faces", []), dtype=np.int64).reshape(-1, 3)
        if len(faces) == 0:
            continue
        vertices, color = np.asarray(mesh.vertices, dtype=np.float64), None
        if mesh.visual.kind in ("vertex", "face"):
            colors = mesh.visual.vertex_colors if mesh.visual.kind == "vertex" else mesh.visual.face_colors
            red, green, blue = np.asarray(colors, dtype=np.float64)[:, :3].mean(axis=0) / 255.0
            color = (float(red), float(green), float(blue))
        raw.add(RawComponent((str(name),) if several else (), vertices, faces, color), path)
    return raw


@contextmanager
def _quiet_trimesh() -> Iterator[None]:
    """Suppress the warnings of trimesh and numpy about malformed files."""
    logger, silent = logging.getLogger("trimesh"), logging.NullHandler()
    was_passed_on = logger.propagate
    # Its modules have loggers of their own, whose records end here.
    logger.addHandler(silent)
    logger.propagate = False
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        logger.propagate = was_passed_on
        logger.removeHandler(silent)
