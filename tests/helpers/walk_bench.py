"""A walk around a small part on a bench, one block of which stands wrong until it is put right: photos and truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from arview.cad.model import Model, make_model
from arview.geometry import Array, rigid
from helpers.cad_files import obj_text
from helpers.photo_scene import bench, photograph, ring

COMPONENT = "block_2"
"""The component that is put right between the two sets of photos."""
WRONG_MM = np.array([2.5, -1.0, 0.0])
"""Where it stands before that, from where it belongs."""
PART = (
    '[part]\nname = "bench"\ncad = "part.obj"\nunit = "mm"\n[components.plate]\nrole = "base"\n'
    + "".join(f"[components.block_{i}]\nposition_tolerance_mm = 1.5\n" for i in (1, 2, 3, 4))
)  # fmt: skip
POSES = ring(12, distance_mm=460.0)
AGAIN = ring(7, distance_mm=430.0)[:6]
"""cam_from_model of the photos, and of those after the component was put right."""


def part_model() -> Model:
    """The plate with its blocks, without the bench."""
    return make_model("part", bench().components[1:])


def write_part(folder: Path) -> Path:
    """``part.obj`` and ``part.toml``; returns the latter."""
    text, offset = "", 0
    for one in part_model().components:
        text += obj_text(one.name, one.vertices_in_model, one.faces.astype(np.int64), offset)
        offset += len(one.vertices_in_model)
    (folder / "part.obj").write_text(text, encoding="utf-8")
    (folder / "part.toml").write_text(PART, encoding="utf-8")
    return folder / "part.toml"


def photo(cam_from_model: Array, is_right: bool, kind: str = ".png") -> bytes:
    """A photo as a file, with the component where it belongs or not."""
    shift_mm = np.zeros(3) if is_right else WRONG_MM
    picture = photograph(bench(), cam_from_model, moves={COMPONENT: rigid(np.eye(3), shift_mm)})
    is_written, content = cv2.imencode(kind, picture)
    assert is_written
    return content.tobytes()
