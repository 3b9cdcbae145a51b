"""Recorded scenes with poses, in the folder layout of the BOP benchmark (https://bop.felk.cvut.cz)::

DATASET/models/obj_000001.ply (mm) or assembly.glb, models_info.json
DATASET/test/000001/rgb/000000.png … (or gray/), scene_camera.json, scene_gt.json, scene_gt_info.json
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Part, load_part
from arview.cad.shape.symmetry import Symmetry
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, check_rigid, rigid
from arview.video import Image

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
PICTURE_FOLDERS = ("rgb", "gray")
MASK_FOLDER = "mask_visib"
PEER_FILE = "peer_visp.json"
VISIBILITY_KEYS = ("visib_fract", "plate_in_view")


@dataclass(frozen=True)
class SceneFrame:
    """One picture of a scene.

    Attributes:
        index: frame id in the files.
        path: of the picture.
        matrix: (3,3) calibration matrix of this picture, px.
        cam_from_model: (4,4) reference pose in mm, or None.
        is_truth: the pose is from scene_gt.json, not from a reference file.
        visible: share of the part that is visible, 0–1, or None where the scene does not say.
        mask_path: mask of the visible part, or None.
    """

    index: int
    path: Path
    matrix: Array
    cam_from_model: Array | None = None
    is_truth: bool = False
    visible: float | None = None
    mask_path: Path | None = None


@dataclass(frozen=True)
class Scene:
    """Pictures of one part with reference poses.

    Attributes:
        name: of the dataset, with the scene's number where the dataset has several.
        folder: of the scene.
        part: from the part file, or from the dataset's models folder.
        symmetric_poses: (4,4) ``model_from_model`` declared symmetric in models_info.json.
        camera: of the first picture; the others are warped to it when they are read.
        frames: in the order of their ids.
        reference: file with poses of frames that scene_gt.json lacks, or None.
    """

    name: str
    folder: Path
    part: Part
    symmetric_poses: tuple[Array, ...]
    camera: Camera
    frames: tuple[SceneFrame, ...]
    reference: Path | None = None

    @property
    def poses(self) -> list[Array]:
        """All reference poses."""
        return [frame.cam_from_model for frame in self.frames if frame.cam_from_model is not None]

    def image(self, frame: SceneFrame) -> Image:
        """Picture (H,W,3) uint8 RGB of a frame, as `camera` would have taken it.

        Datasets whose pictures are cropped differently have one matrix per frame; pictures of one viewpoint with
        different matrices differ by an affine map.

        Raises:
            InputError: the picture cannot be read, or has another size than the first.
        """
        return self._as_taken(_read_picture(frame.path), frame, frame.path)

    def mask(self, frame: SceneFrame) -> NDArray[np.bool_] | None:
        """Mask (H,W) of the visible part in a frame's `image`; None where the scene does not say.

        Raises:
            InputError: the mask cannot be read, or has another size than the pictures.
        """
        if frame.mask_path is None:
            return None
        return np.asarray(self._as_taken(_read_picture(frame.mask_path), frame, frame.mask_path)[..., 0] > 127)

    def _as_taken(self, image: Image, frame: SceneFrame, path: Path) -> Image:
        """A picture or mask of a frame, as `camera` would have taken it."""
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise InputError(
                f"{path}: is {image.shape[1]}×{image.shape[0]} px, the first picture of the scene is "
                f"{self.camera.width}×{self.camera.height} px"
            )
        if not np.allclose(frame.matrix, self.camera.matrix, rtol=0, atol=1e-6):
            change = self.camera.matrix @ np.linalg.inv(frame.matrix)
            image = np.asarray(cv2.warpAffine(image, change[:2], (self.camera.width, self.camera.height)))
        return image


def find_scenes(path: str | Path) -> list[Path]:
    """Scene folders at a path: the folder itself, or all scenes in its ``test`` folder.

    Raises:
        InputError: no scene is there.
    """
    path = Path(path)
    if (path / "scene_camera.json").is_file():
        return [path]
    scenes = sorted(file.parent for file in path.glob("test/*/scene_camera.json"))
    if not scenes:
        what = "contains no scene" if path.is_dir() else "no such folder"
        raise InputError(
            f"{path}: {what}; give a BOP scene folder (with scene_camera.json) or its dataset folder "
            "(with test/000001/scene_camera.json)"
        )
    return scenes


def load_scene(
    folder: str | Path,
    part: Part | None = None,
    reference: str | Path | None = None,
    object_id: int | None = None,
) -> Scene:
    """Read a scene; its pictures are read later, one by one.

    Args:
        folder: of the scene, as `find_scenes` returns it.
        part: the part in it; None takes the dataset's ``models/assembly.glb`` or ``models/obj_*.ply``.
        reference: JSON file of poses, ``{"1": {"R": 9 row-major, "t_mm": 3}}``, for frames without one in
            scene_gt.json; None takes a ``peer_visp.json`` in the dataset's folder when there is one.
        object_id: the object to follow in a scene with several.

    Raises:
        InputError: a file is missing or broken; there are several objects and none is chosen; no picture or model.
    """
    folder = Path(folder)
    dataset = folder.resolve().parent.parent
    cameras = _read_json_object(folder / "scene_camera.json")
    truth_file = folder / "scene_gt.json"
    truths = _read_json_object(truth_file) if truth_file.is_file() else {}
    info_file = folder / "scene_gt_info.json"
    infos = _read_json_object(info_file) if info_file.is_file() else {}
    object_id = _choose_object(truths, object_id, truth_file)
    reference = _reference_file(reference, dataset)
    peers = _read_json_object(reference) if reference else {}
    pictures = _pictures(folder)
    frames = []
    for index in sorted(pictures):
        key = str(index)
        matrix = _matrix(cameras.get(key), f"{folder / 'scene_camera.json'}: frame {key}")
        place = _entry_of(truths.get(key), object_id, f"{truth_file}: frame {key}")
        frame = SceneFrame(index, pictures[index], matrix)
        if place is not None:
            info = infos.get(key) or []
            mask_path = folder / MASK_FOLDER / f"{index:06d}_{place:06d}.png"
            frame = replace(
                frame,
                cam_from_model=_pose(truths[key][place], "cam_R_m2c", "cam_t_m2c", f"{truth_file}: frame {key}"),
                is_truth=True,
                visible=_visibility(info[place] if place < len(info) else {}),
                mask_path=mask_path if mask_path.is_file() else None,
            )
        elif key in peers:
            frame = replace(frame, cam_from_model=_pose(peers[key], "R", "t_mm", f"{reference}: frame {key}"))
        frames.append(frame)
    symmetries: tuple[Symmetry, ...] = ()
    symmetric_poses: tuple[Array, ...] = ()
    if part is None:
        part = _load_model_part(dataset, object_id or 1)
        symmetries, symmetric_poses = _model_symmetries(dataset, object_id or 1)
        part = replace(part, name=dataset.name, symmetries=symmetries)
    first = _read_picture(frames[0].path)
    matrix = frames[0].matrix
    camera = Camera(first.shape[1], first.shape[0], matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    several = len(list(folder.resolve().parent.glob("*/scene_camera.json"))) > 1
    name = f"{dataset.name}/{folder.resolve().name}" if several else dataset.name
    return Scene(name, folder, part, symmetric_poses, camera, tuple(frames), reference)


def _read_json_object(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object with a key for each frame")
    return content


def _reference_file(reference: str | Path | None, dataset: Path) -> Path | None:
    if reference is not None:
        return Path(reference)
    return dataset / PEER_FILE if (dataset / PEER_FILE).is_file() else None


def _pictures(folder: Path) -> dict[int, Path]:
    for name in PICTURE_FOLDERS:
        pictures = {
            int(path.stem): path
            for path in (folder / name).glob("*")
            if path.suffix.lower() in PICTURE_SUFFIXES and path.stem.isdecimal()
        }
        if pictures:
            return pictures
    raise InputError(f"{folder}: contains no numbered pictures in rgb/ or gray/")


def _read_picture(path: Path) -> Image:
    data = np.fromfile(path, dtype=np.uint8) if path.is_file() else np.zeros(0, np.uint8)
    bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if bgr is None:
        raise InputError(f"{path}: cannot be read as a picture")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def _numbers(entry: Any, key: str, count: int, place: str) -> Array:
    try:
        values = np.asarray(entry[key], dtype=np.float64).ravel()
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{place}: {key} is missing or not {count} numbers") from error
    if values.size != count or not np.all(np.isfinite(values)):
        raise InputError(f"{place}: {key} must be {count} finite numbers")
    return values


def _matrix(entry: Any, place: str) -> Array:
    matrix = _numbers(entry, "cam_K", 9, place).reshape(3, 3)
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise InputError(f"{place}: cam_K has a focal length that is not positive")
    return matrix


def _pose(entry: Any, rotation_key: str, translation_key: str, place: str) -> Array:
    rotation = _numbers(entry, rotation_key, 9, place)
    return check_rigid(rigid(rotation, _numbers(entry, translation_key, 3, place)), place)


def _choose_object(truths: dict[str, Any], object_id: int | None, path: Path) -> int | None:
    """Id of the object to follow; None when the scene has no true poses."""
    try:
        found = sorted({int(entry["obj_id"]) for entries in truths.values() for entry in entries})
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: an entry has no obj_id") from error
    if object_id is not None:
        if found and object_id not in found:
            raise InputError(f"{path}: contains no object {object_id}, only {', '.join(map(str, found))}")
        return object_id
    if len(found) > 1:
        raise InputError(f"{path}: contains the objects {', '.join(map(str, found))}; choose one with --object")
    return found[0] if found else None


def _entry_of(entries: Any, object_id: int | None, place: str) -> int | None:
    """Index of the object's entry in a frame; None when the frame does not have it."""
    found = [k for k, entry in enumerate(entries or []) if int(entry["obj_id"]) == object_id]
    if len(found) > 1:
        raise InputError(f"{place}: contains object {object_id} {len(found)} times; only one can be followed")
    return found[0] if found else None


def _visibility(info: Any) -> float | None:
    for key in VISIBILITY_KEYS:
        value = info.get(key) if isinstance(info, dict) else None
        if isinstance(value, int | float):
            return float(value)
    return None


def _load_model_part(dataset: Path, object_id: int) -> Part:
    assembly = dataset / "models" / "assembly.glb"
    if assembly.is_file():
        return load_part(assembly)
    for folder in ("models", "models_cad", "models_eval"):
        mesh = dataset / folder / f"obj_{object_id:06d}.ply"
        if mesh.is_file():
            return load_part(mesh, unit="mm")
    raise InputError(
        f"{dataset}: contains neither models/assembly.glb nor models/obj_{object_id:06d}.ply; give --part PART"
    )


def _model_symmetries(dataset: Path, object_id: int) -> tuple[tuple[Symmetry, ...], tuple[Array, ...]]:
    """Continuous symmetries and discrete ones (4,4) that models_info.json declares."""
    path = dataset / "models" / "models_info.json"
    info = _read_json_object(path).get(str(object_id), {}) if path.is_file() else {}
    free = []
    for entry in info.get("symmetries_continuous", []):
        axis = _numbers(entry, "axis", 3, f"{path}: symmetries_continuous")
        offset = _numbers(entry, "offset", 3, f"{path}: symmetries_continuous")
        x, y, z = (axis / np.linalg.norm(axis)).tolist()
        free.append(Symmetry((x, y, z), (float(offset[0]), float(offset[1]), float(offset[2])), None))
    discrete = [
        check_rigid(np.reshape(matrix, (4, 4)), f"{path}: symmetries_discrete")
        for matrix in info.get("symmetries_discrete", [])
    ]
    return tuple(free), tuple(discrete)
