"""A cell: fixed cameras above a plate with many blocks and studs, of which each stands a little off, and a board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from arview.cad.model import Component, Model, make_model
from arview.cad.part import ComponentSettings, Part
from arview.camera import Camera, write_camera
from arview.fiducials import parse_board
from arview.geometry import Array, apply, exp_so3, look_at, rigid
from helpers import board_scene
from helpers.cad_files import box, obj_text
from helpers.photo_scene import Picture, photograph
from helpers.synthetic import post

CAMERA = Camera(1600, 1200, 1900.0, 1900.0, 799.5, 599.5, np.array([-0.06, 0.01, 0.0, 0.0, 0.0]))
BOARD = parse_board("charuco:12x9:20:15:DICT_5X5_250")


@dataclass(frozen=True)
class Cell:
    """A part, how it was built, and the cameras above it.

    Attributes:
        part: nominal.
        built: the model as built.
        moves: measured_from_nominal (4,4) of each component that is inspected.
        cams_from_rig: (M,4,4) true poses of the cameras.
        rig_from_model: (4,4) where the part lies.
    """

    part: Part
    built: Model
    moves: dict[str, Array]
    cams_from_rig: Array
    rig_from_model: Array

    def pictures(self, seed: int = 0, turned: dict[int, Array] | None = None, camera: Camera = CAMERA) -> list[Picture]:
        """What the cameras see; those in ``turned`` (3,) rad were knocked."""
        poses = self.cams_from_rig @ self.rig_from_model
        knocks = turned or {}
        return [
            photograph(
                self.built, rigid(exp_so3(knocks.get(i, np.zeros(3))), np.zeros(3)) @ pose, camera, seed, is_linear=True
            )
            for i, pose in enumerate(poses)
        ]


def cell(count: int, cameras: int, seed: int = 0) -> Cell:
    """A plate with ``count`` components in a grid under some cameras, placed anyhow within 10 mm and 5°."""
    rng = np.random.default_rng(seed)
    columns = int(np.ceil(np.sqrt(1.4 * count)))
    rows = int(np.ceil(count / columns))
    pitch = np.array([260.0, 190.0]) / (columns, rows)
    half = np.array([130.0, 95.0])
    table_vertices, table_faces = box((-half[0] - 5, -half[1] - 5, -8.0), (half[0] + 5, half[1] + 5, 0.0))
    nominal = [Component("plate", table_vertices, table_faces.astype(np.int32))]
    built = [nominal[0]]
    moves: dict[str, Array] = {}
    for index in range(count):
        middle = (np.array([index % columns, index // columns]) + 0.5) * pitch - half
        size = rng.uniform(0.22, 0.36, 2) * pitch.min() * (1, 1.25)
        height = rng.uniform(0.4, 1.1) * pitch.min()
        name = f"part_{index + 1}"
        if index % 4 == 3:
            vertices, faces = post((middle[0], middle[1]), float(size[0]), 0.0, float(height), 96)
            component = Component(name, vertices, faces.astype(np.int32))
        else:
            vertices, faces = box((*(middle - size), 0.0), (*(middle + size), float(height)))
            component = Component(name, vertices, faces.astype(np.int32))
        nominal.append(component)
        shift = np.array([*rng.normal(0.0, 0.25, 2), 0.0])
        turn = exp_so3(np.array([0.0, 0.0, np.deg2rad(rng.normal(0.0, 0.4))]))
        foot = np.array([*middle, 0.0])
        moves[name] = rigid(turn, foot - turn @ foot + shift)
        built.append(Component(name, apply(moves[name], component.vertices_in_model), component.faces))
    settings = [ComponentSettings("plate", "base"), *(ComponentSettings(name, "inspect", 0.6) for name in moves)]
    part = Part("cell", Path("part.toml"), Path("cell.stl"), make_model("cell", tuple(nominal)), tuple(settings))
    poses = []
    for index in range(cameras):
        azimuth = 2.0 * np.pi * (index + 0.35) / cameras
        elevation = np.deg2rad(52.0 if index % 2 else 68.0)
        direction = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        poses.append(look_at(430.0 * direction, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    placement = rigid(exp_so3(np.deg2rad([0.0, 0.0, 5.0]) * rng.uniform(-1, 1)), [*rng.uniform(-8, 8, 2), 0.0])
    return Cell(part, make_model("cell", tuple(built)), moves, np.array(poses), placement)


def names_of(cell: Cell) -> list[str]:
    """Names of the cameras of a cell."""
    return [f"cam_{index + 1}" for index in range(len(cell.cams_from_rig))]


def true_mm(cell: Cell, name: str) -> float:
    """Distance by which a component's centre of mass is off."""
    center = cell.part.model.component(name).centroid_in_model
    return float(np.linalg.norm(apply(cell.moves[name], center) - center))


def board_shots(folder: Path, cell: Cell, count: int, seed: int = 0) -> list[dict[str, Path]]:
    """Pictures of a board that is held before the cameras, tilted and turned anyhow."""
    rng = np.random.default_rng(seed)
    shots = []
    for shot in range(count):
        tilt = exp_so3(np.deg2rad([*rng.uniform(-18, 18, 2), rng.uniform(0, 360)]))
        place = rigid(tilt, [*rng.uniform(-30, 30, 2), rng.uniform(10, 60)])
        upright = rigid(np.eye(3), [-120.0, -90.0, 0.0]) @ rigid(np.diag([1.0, -1.0, -1.0]), [0.0, 180.0, 0.0])
        one = {}
        for name, pose in zip(names_of(cell), cell.cams_from_rig, strict=True):
            one[name] = folder / name / f"board_{shot:03d}.png"
            one[name].parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(one[name]), board_scene.photograph(BOARD, CAMERA, pose @ place @ upright, rng))
        shots.append(one)
    return shots


def write_part(folder: Path, cell: Cell) -> Path:
    """The part file of a cell with its CAD."""
    text, count = "", 0
    for component in cell.part.model.components:
        text += obj_text(component.name, component.vertices_in_model, component.faces.astype(np.int64), count)
        count += len(component.vertices_in_model)
    (folder / "cell.obj").write_text(text)
    lines = ["[part]", 'cad = "cell.obj"', 'unit = "mm"', '[components.plate]\nrole = "base"']
    lines += [f"[components.{name}]\nposition_tolerance_mm = 0.6" for name in cell.moves]
    path = folder / "part.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_station(folder: Path, cell: Cell, more: str = "") -> Path:
    """A station whose cameras are folders of pictures; part, lens files and station file."""
    write_part(folder, cell)
    write_camera(CAMERA, folder / "lens.json")
    lines = ['name = "cell 4"', 'part = "part.toml"', more]
    lines += [f'[[cameras]]\nname = "{name}"\nsource = "{name}"\ncamera = "lens.json"' for name in names_of(cell)]
    path = folder / "station.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_pictures(folder: Path, cell: Cell, number: int, turned: dict[int, Array] | None = None) -> None:
    """The pictures of one cycle, in the folders of the cameras."""
    for name, picture in zip(names_of(cell), cell.pictures(number, turned), strict=True):
        (folder / name).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name / f"part_{number:03d}.png"), picture[..., ::-1])
