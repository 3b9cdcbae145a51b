"""Camera poses made elsewhere: the conventions of each format to 1e-9, and photos placed by them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arview.camera import Camera
from arview.errors import CannotMeasureError, InputError
from arview.geometry import Array, apply, invert, rigid
from arview.reconstruction.features import FeatureOptions
from arview.reconstruction.given_poses import GivenPose, photos_with_poses, read_poses
from arview.reconstruction.scale.similarity import fit_points
from arview.reconstruction.sparse import SparseOptions, reconstruct_from_poses
from arview.reconstruction.types import Photo
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos

POSES = ring(6)
LENS = Camera(640, 480, 720.0, 725.0, 322.25, 236.75, np.array([-0.06, 0.01, 0.002, -0.001, 0.003]))
POINTS = np.random.default_rng(2).uniform(-60, 60, (40, 3))
NAMES = [f"img_{i:03d}.png" for i in range(6)]


def opengl_matrix(cam_from_scan: Array) -> list[list[float]]:
    """nerfstudio's matrix: columns are the camera's right, up and back axes and its centre, in the world."""
    world_from_cam = invert(cam_from_scan)
    right, down, forward, centre = world_from_cam[:3].T
    return np.vstack([np.column_stack([right, -down, -forward, centre]), [0, 0, 0, 1]]).tolist()


def write_transforms(path: Path, poses: list[Array]) -> Path:
    k1, k2, p1, p2, k3 = LENS.dist.tolist()
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl_matrix(pose)}
        for name, pose in zip(NAMES, poses, strict=True)
    ]
    content = {
        "camera_model": "OPENCV", "w": 640, "h": 480, "fl_x": LENS.fx, "fl_y": LENS.fy, "cx": LENS.cx + 0.5,
        "cy": LENS.cy + 0.5, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3, "frames": frames,
    }  # fmt: skip
    path.write_text(json.dumps(content))
    return path


def write_metashape(path: Path, poses: list[Array]) -> Path:
    """As Metashape projects: u = w/2 + cx + x' f + x' b1, with p1 on r² + 2x² and p2 on 2xy."""
    k1, k2, p1, p2, k3 = LENS.dist.tolist()
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" label="{Path(name).stem}"><transform>'
        + " ".join(repr(float(v)) for v in invert(pose).ravel())
        + "</transform></camera>"
        for i, (name, pose) in enumerate(zip(NAMES, poses, strict=True))
    )
    path.write_text(
        '<?xml version="1.0"?><document version="1.4.0"><chunk><sensors><sensor id="0" label="a" type="frame">'
        '<resolution width="640" height="480"/><calibration type="frame" class="adjusted">'
        f'<resolution width="640" height="480"/><f>{LENS.fy}</f><cx>{LENS.cx + 0.5 - 320}</cx>'
        f"<cy>{LENS.cy + 0.5 - 240}</cy><b1>{LENS.fx - LENS.fy}</b1><k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3>"
        f"<p1>{p2}</p1><p2>{p1}</p2></calibration></sensor></sensors><cameras>{cameras}"
        '<camera id="9" sensor_id="0" label="not aligned"/></cameras></chunk></document>'
    )
    return path


def write_colmap_text(folder: Path, poses: list[Array]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    k1, k2, p1, p2, k3 = LENS.dist.tolist()
    values = [LENS.fx, LENS.fy, LENS.cx + 0.5, LENS.cy + 0.5, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    (folder / "cameras.txt").write_text("1 FULL_OPENCV 640 480 " + " ".join(map(repr, values)) + "\n")
    lines = []
    for i, (name, pose) in enumerate(zip(NAMES, poses, strict=True)):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        lines += [f"{i + 1} {w!r} {x!r} {y!r} {z!r} {' '.join(repr(float(v)) for v in pose[:3, 3])} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")
    return folder


def write_colmap_binary(folder: Path, poses: list[Array]) -> Path:
    from arview.reconstruction.colmap import import_pycolmap

    model = import_pycolmap().Reconstruction(str(write_colmap_text(folder / "text", poses)))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(folder / "sparse" / "0"))
    return folder


@pytest.mark.parametrize("kind", ["transforms", "metashape", "colmap text", "colmap binary"])
def test_pixels_of_points_are_those_of_the_truth(tmp_path: Path, kind: str) -> None:
    write = {
        "transforms": lambda: write_transforms(tmp_path / "transforms.json", POSES),
        "metashape": lambda: write_metashape(tmp_path / "cameras.xml", POSES),
        "colmap text": lambda: write_colmap_text(tmp_path / "model", POSES),
        "colmap binary": lambda: write_colmap_binary(tmp_path / "work", POSES),
    }
    found = read_poses(write[kind]())
    assert len(found) == len(POSES)
    for given, pose in zip(found, POSES, strict=True):
        assert np.allclose(given.cam_from_scan, pose, atol=1e-9)
        in_cam = apply(pose, POINTS)
        assert np.allclose(given.camera.project(apply(given.cam_from_scan, POINTS)), LENS.project(in_cam), atol=1e-6)
        assert (given.camera.cx, given.camera.cy) == pytest.approx((LENS.cx, LENS.cy), abs=1e-9)
        assert np.allclose(given.camera.dist, LENS.dist, atol=1e-12)


def test_photos_are_found_by_name(tmp_path: Path) -> None:
    poses = read_poses(write_metashape(tmp_path / "cameras.xml", POSES))
    photos = [Photo(f"walk/{name}", tmp_path, 640, 480, "lens", CAMERA) for name in NAMES]
    photos += [Photo("other.png", tmp_path, 640, 480, "lens", CAMERA)]
    photos[5] = Photo(f"walk/{NAMES[5]}", tmp_path, 480, 640, "lens", CAMERA)
    found, left_out = photos_with_poses(photos, poses, "cameras.xml")
    assert [photo.name for photo, _ in found] == [f"walk/{name}" for name in NAMES[:5]]
    assert {photo.lens for photo, _ in found} == {"given camera 1"} and all(photo.is_calibrated for photo, _ in found)
    assert dict(left_out)["other.png"] == "has no pose in cameras.xml" and "480×640" in dict(left_out)[photos[5].name]
    with pytest.raises(InputError, match="names must be those of the photos"):
        photos_with_poses(photos[6:], poses, "cameras.xml")


def test_bad_files_are_refused_in_one_line(tmp_path: Path) -> None:
    cases = {
        "a.json": "{}", "b.json": "no json", "c.xml": "<document/>", "d.xml": "<a", "e.txt": "",
        "f.xml": '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>',
        "g.json": json.dumps({"w": 640, "h": 480, "fl_x": 700, "frames": [
            {"file_path": "a.png", "transform_matrix": np.zeros((4, 4)).tolist()}]}),
        "h.json": json.dumps({"camera_model": "OPENCV_FISHEYE", "frames": []}),
    }  # fmt: skip
    for name, text in cases.items():
        path = tmp_path / name
        path.write_text(text)
        with pytest.raises(InputError, match=name):
            read_poses(path)
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError):
            read_poses(path)


@pytest.mark.slow  # features of eight photos
def test_a_quaternion_of_another_length_is_refused(tmp_path: Path) -> None:
    folder = write_colmap_text(tmp_path / "model", POSES)
    lines = (folder / "images.txt").read_text().splitlines()
    words = lines[0].split()
    (folder / "images.txt").write_text("\n".join([" ".join([*words[:2], "-10.6", *words[3:]]), *lines[1:]]) + "\n")
    with pytest.raises(InputError, match="not a rotation"):
        read_poses(folder)


def test_a_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    folder = write_colmap_text(tmp_path / "model", POSES)
    content = (folder / "images.txt").read_bytes()
    (folder / "images.txt").write_bytes(content.replace(NAMES[0].encode(), b"\x80.png"))
    with pytest.raises(InputError, match="COLMAP model cannot be read"):
        read_poses(folder)


def test_photos_are_placed_by_given_poses(tmp_path: Path) -> None:
    """Poses with small errors, in a frame and unit of their own, give the true places after the adjustment."""
    poses = ring(12)[:8]
    paths = write_photos(tmp_path / "photos", [photograph(bench(), pose) for pose in poses])
    rng = np.random.default_rng(4)
    new_from_scan, scale = rigid(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([5.0, -2.0, 1.0])), 0.013
    given = []
    for path, pose in zip(paths, poses, strict=True):
        moved = rigid(pose[:3, :3], scale * pose[:3, 3]) @ invert(new_from_scan)
        shaken = rigid(Rotation.from_rotvec(rng.normal(0, 3e-4, 3)).as_matrix(), rng.normal(0, 2e-3, 3)) @ moved
        given.append(GivenPose(path.name, CAMERA, shaken))
    photos = [Photo(path.name, path, CAMERA.width, CAMERA.height, "lens", CAMERA) for path in paths]
    posed, _ = photos_with_poses(photos, given, "here")
    options = SparseOptions(features=FeatureOptions(max_features=2500), threads=2)
    sparse = reconstruct_from_poses(posed, tmp_path / "sparse", options)
    assert len(sparse.photos) == 8 and sparse.pose_covariance is not None and len(sparse.points_in_scan) > 500
    a = np.array([photo.centre_in_scan for photo in sparse.photos])
    b = np.array([invert(pose)[:3, 3] for pose in poses])
    fit = fit_points(a, b).similarity
    left = fit.scale * a @ fit.model_from_scan[:3, :3].T + fit.model_from_scan[:3, 3] - b
    assert np.median(np.linalg.norm(left, axis=1)) < 0.3
    wrong = [(photo, ring(12)[(3 * i) % 12]) for i, (photo, _) in enumerate(posed)]
    with pytest.raises(CannotMeasureError, match="do not fit the photos"):
        reconstruct_from_poses(wrong, tmp_path / "wrong", options)
