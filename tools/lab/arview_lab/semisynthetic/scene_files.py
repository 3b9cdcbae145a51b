"""A semi-synthetic sequence on disk: a BOP dataset of one scene, written completely or not at all."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arview.cad.model import Model
from arview.camera import Camera
from arview.errors import OutputError
from arview.geometry import Array
from arview_lab.evaluation.bop import MASK_FOLDER
from arview_lab.semisynthetic.sequence import SequenceFrame

RECORD_FILE = "sequence.json"
JPEG_QUALITY = 95


def write_dataset(
    folder: Path,
    model: Model,
    camera: Camera,
    frames: Iterable[SequenceFrame],
    record: dict[str, Any],
    symmetries: tuple[Array, ...] = (),
    different_shares: list[float] | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write models, pictures, masks and true poses; an older dataset of this kind in the same folder is replaced.

    Args:
        folder: of the dataset, see `arview_lab.evaluation.bop`.
        model: the nominal CAD, which is to be found in the pictures.
        camera: ideal.
        frames: in order.
        record: how it was made, for sequence.json.
        symmetries: (S,4,4) ``model_from_model`` that change nothing.
        different_shares: of each frame, see `look_alikes.different_share`; None unless a look-alike is shown.
        progress: called with the number of frames done.

    Raises:
        OutputError: the folder cannot be written to, or contains something else.
    """
    if folder.exists() and not (folder / RECORD_FILE).is_file():
        raise OutputError(f"{folder}: exists and is not a sequence made by arview; give another -o")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as temporary:
            made = Path(temporary) / folder.name
            _write_models(made / "models", model, symmetries)
            _write_frames(made / "test" / "000001", camera, frames, different_shares, progress)
            content = {"width": camera.width, "height": camera.height, **_intrinsics(camera), "depth_scale": 1.0}
            _write_json(made / "camera.json", content)
            _write_json(made / RECORD_FILE, record)
            if folder.exists():
                shutil.move(folder, Path(temporary) / "old")
            made.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error})") from error


def _write_frames(
    folder: Path,
    camera: Camera,
    frames: Iterable[SequenceFrame],
    different_shares: list[float] | None,
    progress: Callable[[int], None] | None,
) -> None:
    (folder / "rgb").mkdir(parents=True)
    (folder / MASK_FOLDER).mkdir()
    cameras, truths, infos = {}, {}, {}
    matrix = camera.matrix.ravel().tolist()
    for number, frame in enumerate(frames):
        pose = frame.cam_from_model
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        _write_picture(folder / "rgb" / f"{number:06d}.jpg", frame.image[..., ::-1], quality)
        covered = np.where(frame.mask >= 0.5, np.uint8(255), np.uint8(0))
        _write_picture(folder / MASK_FOLDER / f"{number:06d}_000000.png", covered, [])
        cameras[str(number)] = {"cam_K": matrix, "depth_scale": 1.0}
        place = {"cam_R_m2c": pose[:3, :3].ravel().tolist(), "cam_t_m2c": pose[:3, 3].tolist(), "obj_id": 1}
        truths[str(number)] = [place]
        info = {
            "px_count_all": round(frame.pixels),
            "px_count_valid": round(frame.pixels_in_picture),
            "px_count_visib": round(float(frame.mask.sum())),
            "visib_fract": round(frame.visible, 5),
        }
        if different_shares is not None:
            info["different_fract"] = round(different_shares[number], 5)
        infos[str(number)] = [info]
        if progress:
            progress(number + 1)
    _write_json(folder / "scene_camera.json", cameras)
    _write_json(folder / "scene_gt.json", truths)
    _write_json(folder / "scene_gt_info.json", infos)


def _write_models(folder: Path, model: Model, symmetries: tuple[Array, ...]) -> None:
    """The CAD as named components (glTF, metres), and BOP's information about models."""
    folder.mkdir(parents=True)
    (folder / "assembly.glb").write_bytes(model_as_glb(model))
    low, high = model.bounds_in_model
    info: dict[str, Any] = {"diameter": model.diameter_mm}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
    info["symmetries_discrete"] = [pose.ravel().tolist() for pose in symmetries]
    info["components"] = [component.name for component in model.components]
    _write_json(folder / "models_info.json", {"1": info})


def model_as_glb(model: Model) -> bytes:
    """Binary glTF file of a model's components, in metres."""
    import trimesh

    scene = trimesh.Scene()
    for component in model.components:
        mesh = trimesh.Trimesh(component.vertices_in_model / 1000.0, component.faces, process=False)
        mesh.visual.face_colors = [*(round(255 * value) for value in component.color), 255]
        scene.add_geometry(mesh, node_name=component.name, geom_name=component.name)
    return bytes(scene.export(file_type="glb"))


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}


def _write_picture(path: Path, image: Any, options: list[int]) -> None:
    done, data = cv2.imencode(path.suffix, np.ascontiguousarray(image), options)
    if not done:
        raise OutputError(f"{path}: the picture cannot be encoded")
    path.write_bytes(data.tobytes())


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
