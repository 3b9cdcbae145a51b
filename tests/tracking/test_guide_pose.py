"""Guide views of parts whose up axis is not +Z: what is called top is seen from the top."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from arview.cad import load_part
from arview.cad.view_range import UP_AXES, ViewRange
from arview.cad.viewpoint import pose_at, viewpoint
from arview.camera import Camera
from arview.geometry import Array
from arview.guideviews.sphere import directions_in_range, view_poses
from arview.tracking.guide_pose import guide_pose
from helpers.cad_files import box, glb_with_boxes, obj_text

CAMERA = Camera(640, 480, 800.0, 800.0, 319.5, 239.5)
UNIT = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0], "-z": [0, 0, -1]}


def eye_direction(cam_from_model: Array, center: Array) -> Array:
    """Unit vector of the model from a centre to the camera."""
    eye = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3] - center
    return eye / np.linalg.norm(eye)


def seen(path: Path, name: str) -> tuple[Array, Array]:
    """Direction to the camera and image-up of a guide view, both in the model."""
    part = load_part(path)
    pose = guide_pose(name, part, part.effective_view_range, CAMERA)
    return eye_direction(pose, part.model.center_in_model), -pose[1, :3]


def part_file(folder: Path, up: str | None, extra: str = "") -> Path:
    (folder / "b.obj").write_text(obj_text("b", *box((0, 0, 0), (100, 60, 40))))
    line = f'up = "{up}"\n' if up else ""
    (folder / "p.toml").write_text(f'[part]\ncad = "b.obj"\nunit = "mm"\n{line}{extra}')
    return folder / "p.toml"


def test_gltf_is_seen_from_the_top_along_its_y(tmp_path: Path) -> None:
    path = glb_with_boxes(tmp_path / "g.glb", [{"name": "lug", "mesh": 0}], [0])
    direction, image_up = seen(path, "top")
    np.testing.assert_allclose(direction, [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(image_up, [0, 0, -1], atol=1e-9)
    direction, image_up = seen(path, "front")
    np.testing.assert_allclose(direction, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(image_up, [0, 1, 0], atol=1e-9)
    (tmp_path / "p.toml").write_text('[part]\ncad = "g.glb"\nup = "z"\n')
    np.testing.assert_allclose(seen(tmp_path / "p.toml", "top")[0], [0, 0, 1], atol=1e-9)


def test_trimesh_writes_axes_as_they_are(tmp_path: Path) -> None:
    import trimesh

    mesh = trimesh.Trimesh(*box((0, 0, 0), (0.1, 0.2, 0.3)), process=False)
    (tmp_path / "t.glb").write_bytes(mesh.export(file_type="glb"))
    np.testing.assert_allclose(seen(tmp_path / "t.glb", "top")[0], [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize("up", [None, *UP_AXES])
def test_the_declared_axis_is_up(up: str | None, tmp_path: Path) -> None:
    axis = UNIT[up or "z"]
    path = part_file(tmp_path, up)
    assert load_part(path).up == (up or "z")
    np.testing.assert_allclose(seen(path, "top")[0], axis, atol=1e-9)
    np.testing.assert_allclose(seen(path, "bottom")[0], -np.array(axis), atol=1e-9)
    for name in ("front", "left", "iso"):
        direction, image_up = seen(path, name)
        assert image_up @ axis == pytest.approx(np.sqrt(1 - (direction @ axis) ** 2))
    # The geometry stays in the frame of the CAD file.
    np.testing.assert_allclose(load_part(path).model.bounds_in_model, [[0, 0, 0], [100, 60, 40]])


@pytest.mark.parametrize("up", UP_AXES)
def test_ranges_and_viewpoints_follow_the_axis(up: str, tmp_path: Path) -> None:
    extra = "[view_range]\ndistance_mm = [300, 900]\nelevation_deg = [50, 85]\nroll_deg = [-20, 20]\n"
    view_range = load_part(part_file(tmp_path, up, extra)).effective_view_range
    directions = directions_in_range(view_range, 2, 0.0)
    assert len(directions) > 10
    assert (directions @ UNIT[up]).min() >= np.sin(np.deg2rad(50)) - 1e-9
    center = np.array([50.0, 30.0, 20.0])
    for pose in view_poses(directions, 500.0, center, view_range.up_in_model):
        place = viewpoint(pose, center, up)
        assert place.roll_deg == pytest.approx(0.0, abs=1e-6)
        np.testing.assert_allclose(pose_at(place, center, up=up), pose, atol=1e-9)
        assert view_range.contains_direction(view_range.direction(place.azimuth_deg, place.elevation_deg), 1e-6)
    np.testing.assert_allclose(np.linalg.det(ViewRange((1, 2), up=up).upright_from_model), 1.0)
