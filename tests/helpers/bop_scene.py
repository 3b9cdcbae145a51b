"""A tiny dataset in the BOP layout: one scene of grey pictures of a brick at known poses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arview.camera import Camera
from arview.geometry import Array, rigid
from helpers.cad_files import box

CAMERA = Camera(320, 240, 400.0, 400.0, 159.5, 119.5)
TRUTH = rigid(np.eye(3), [-30.0, -30.0, 400.0])


def entry(pose: Array, object_id: int = 3) -> dict[str, Any]:
    rotation, translation = pose[:3, :3].ravel().tolist(), pose[:3, 3].tolist()
    return {"cam_R_m2c": rotation, "cam_t_m2c": translation, "obj_id": object_id}


def write_scene(dataset: Path, frames: int = 3, truths: int = 3) -> Path:
    """A dataset of one scene of grey pictures; frame ids start at 4; poses move by 1 mm a frame."""
    scene = dataset / "test" / "000002"
    (scene / "gray").mkdir(parents=True)
    (dataset / "models").mkdir()
    vertices, faces = box((10.0, 20.0, 0.0), (50.0, 40.0, 10.0))
    rows = [" ".join(map(str, v)) for v in vertices] + ["3 " + " ".join(map(str, f)) for f in faces]
    head = ["ply", "format ascii 1.0", "element vertex 8", *[f"property float {axis}" for axis in "xyz"]]
    head += ["element face 12", "property list uchar int vertex_indices", "end_header"]
    (dataset / "models" / "obj_000003.ply").write_text("\n".join([*head, *rows]) + "\n")
    ids = range(4, 4 + frames)
    matrix = CAMERA.matrix.ravel().tolist()
    for index in ids:
        picture = np.full((CAMERA.height, CAMERA.width), 10 * index, np.uint8)
        cv2.imwrite(str(scene / "gray" / f"{index:06d}.png"), picture)
    write_json(scene / "scene_camera.json", {str(k): {"cam_K": matrix, "depth_scale": 1.0} for k in ids})
    moved = {k: rigid(np.eye(3), [k - 4, 0.0, 0.0]) @ TRUTH for k in ids}
    write_json(scene / "scene_gt.json", {str(k): [entry(moved[k])] for k in list(ids)[:truths]})
    write_json(scene / "scene_gt_info.json", {str(k): [{"visib_fract": 0.9}] for k in ids})
    return scene


def write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content))
