"""Dense reconstruction of a textured plate with a box, rendered with exact depth, and the measures of a cloud."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from arview.cad.model import Component, Model, make_model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, look_at
from arview.reconstruction.dense import Cad, DenseOptions, read_ply, reconstruct_dense, write_map, write_ply
from arview.reconstruction.dense.options import MIN_VIEWS
from arview.reconstruction.types import DenseCloud, PosedPhoto, SparseModel
from arview.rendering.rasterizer import rasterise
from arview_lab.evaluation.clouds import distances_to_mesh, sample_mesh, score_cloud, views_of

pytestmark = pytest.mark.slow  # depth maps of all views

CAMERA = Camera(400, 300, 520.0, 520.0, 199.5, 149.5, np.array([-0.06, 0.01, 0.0, 0.0, 0.0]))
PLATE, BOX = (120.0, 90.0, 8.0), (36.0, 26.0, 22.0)
MOVED_MM = np.array([1.2, -0.8, 0.0])
NOISE_GREY = 2.0
TINY = DenseOptions(max_region_px=60_000, threads=2)


def _box(name: str, size: tuple[float, float, float], base_mm: Array) -> Component:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]) * size + base_mm
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
             [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return Component(name, corners, np.array(faces, dtype=np.int32))


def _model(moved_mm: Array) -> Model:
    return make_model("plate", (_box("plate", PLATE, np.array([0, 0, -8.0])), _box("box", BOX, moved_mm)))


def _grey(points: Array) -> Array:
    """A solid texture: waves of 2.5 to 20 mm in all directions."""
    rng = np.random.default_rng(7)
    value = np.zeros(len(points))
    for wavelength in np.geomspace(2.5, 20.0, 24):
        direction = rng.normal(size=3)
        value += np.sin(points @ direction / np.linalg.norm(direction) * 2 * np.pi / wavelength + rng.uniform(0, 6.28))
    return 120.0 + 18.0 * value


@cache
def _bent() -> tuple[np.ndarray, Camera]:
    """(900,1200,2) where the distorted camera's pixels, three times as many, are in a picture without distortion."""
    fine = Camera(1400, 1100, 3 * CAMERA.fx, 3 * CAMERA.fy, 699.5, 549.5)
    rows, columns = np.mgrid[0:900, 0:1200]
    return fine.project(CAMERA.scaled(1200, 900).unproject(np.stack([columns, rows], axis=-1))).astype(np.float32), fine


def _photo(model: Model, cam_from_model: Array, has_texture: bool, rng: np.random.Generator) -> np.ndarray:
    """What the distorted camera sees: rendered at three times the size, bent, averaged, with noise."""
    at, fine = _bent()
    vertices, faces, _ = model.mesh
    w, _ = rasterise(apply(cam_from_model, vertices), faces, fine.fx, fine.fy, fine.cx, fine.cy, 1400, 1100)
    v, u = np.nonzero(w)
    in_cam = fine.unproject(np.stack([u, v], axis=-1)) / w[v, u, None]
    image = np.full(w.shape, 60.0 if has_texture else 128.0, dtype=np.float32)
    rotation, translation = cam_from_model[:3, :3], cam_from_model[:3, 3]
    image[v, u] = _grey((in_cam - translation) @ rotation) if has_texture else 128.0
    bent = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    small = cv2.resize(bent, (400, 300), interpolation=cv2.INTER_AREA)
    noisy = small[..., None] + rng.normal(0.0, NOISE_GREY, (300, 400, 1))
    return np.clip(np.repeat(noisy, 3, axis=2), 0, 255).astype(np.uint8)


def _scene(folder: Path, has_texture: bool = True) -> SparseModel:
    """Ten photos all around, and rough sparse points of what was built: the box is out of place."""
    model = _model(MOVED_MM)
    rng = np.random.default_rng(1)
    folder.mkdir(exist_ok=True)
    photos = []
    for i in range(10):
        around, up = np.deg2rad(36.0 * i), np.deg2rad(42.0 if i % 2 else 58.0)
        eye = 240.0 * np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        pose = look_at(eye, np.array([0.0, 0.0, 4.0]), np.array([0.0, 0.0, 1.0]))
        path = folder / f"{i}.png"
        cv2.imwrite(str(path), _photo(model, pose, has_texture, rng))
        photos.append(PosedPhoto(path.name, path, CAMERA, pose))
    vertices, faces, _ = model.mesh
    points, _ = sample_mesh(vertices, faces, 6.0, seed=3)
    seen = [views_of(points, vertices, faces, [(CAMERA, photo.cam_from_scan)]) > 0 for photo in photos]
    photo_of, point_of = np.nonzero(np.array(seen))
    pixels = np.concatenate(
        [CAMERA.project(apply(p.cam_from_scan, points[s])) for p, s in zip(photos, seen, strict=True)]
    )
    return SparseModel(
        tuple(photos), points + rng.normal(0.0, 0.3, points.shape), np.zeros((len(points), 3), np.uint8),
        np.full(len(points), 0.5), point_of.astype(np.int32), photo_of.astype(np.int32), pixels,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SparseModel:
    return _scene(tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def nominal() -> Cad:
    return Cad(_model(np.zeros(3)), np.eye(4))


@pytest.fixture(scope="module")
def cloud(scene: SparseModel, nominal: Cad, tmp_path_factory: pytest.TempPathFactory) -> DenseCloud:
    return reconstruct_dense(scene, TINY, nominal, tmp_path_factory.getbasetemp() / "dense")


def _box_place(cloud: DenseCloud) -> Array:
    """(2,) x and y by which the box stands from nominal: medians over its four sides."""
    points, normals = cloud.points, cloud.normals
    is_high = (points[:, 2] > 5.0) & (points[:, 2] < 19.0)
    place = []
    for axis in range(2):
        sides = []
        for sign in (-1.0, 1.0):
            on = is_high & (sign * normals[:, axis] > 0.9) & (np.abs(points[:, 1 - axis]) < 0.5 * BOX[1 - axis] - 3.0)
            assert np.count_nonzero(on) > 50
            sides.append(np.median(points[on, axis]))
        place.append(np.mean(sides))
    return np.array(place)


def _score(cloud: DenseCloud, scene: SparseModel, **limits: float) -> object:
    vertices, faces, _ = _model(MOVED_MM).mesh
    cameras = [(photo.camera, photo.cam_from_scan) for photo in scene.photos]
    return score_cloud(cloud.points, vertices, faces, cameras, **limits)


def test_cloud_lies_on_what_was_built(cloud: DenseCloud, scene: SparseModel) -> None:
    # A pixel is 0.5 mm wide there, one of the depth maps 1 mm.
    score = _score(cloud, scene, near_mm=1.0)
    assert score.median_mm < 0.03
    assert score.p90_mm < 0.20
    assert score.far < 0.02  # the rim before a plain background
    assert score.complete > 0.85
    assert len(cloud.points) == len(cloud.normals) == len(cloud.colors) == len(cloud.sigma) == len(cloud.views)
    assert cloud.views.min() >= MIN_VIEWS


def test_normals_colors_and_deviations_are_right(cloud: DenseCloud) -> None:
    on_plate = (np.abs(cloud.points[:, 2]) < 1.0) & (np.abs(cloud.points[:, 0]) > 25.0)
    on_plate &= (np.abs(cloud.points[:, 0]) < 55.0) & (np.abs(cloud.points[:, 1]) < 40.0)
    z = cloud.points[on_plate, 2]
    assert np.median(np.rad2deg(np.arccos(np.clip(cloud.normals[on_plate, 2], -1, 1)))) < 6.0
    assert 0.4 < 1.4826 * np.median(np.abs(z)) / np.median(cloud.sigma[on_plate]) < 2.5
    truth = np.clip(_grey(cloud.points[on_plate]), 0, 255)
    assert np.corrcoef(truth, cloud.colors[on_plate, 0])[0, 1] > 0.9


def test_cad_does_not_pull_a_displaced_component(
    cloud: DenseCloud, scene: SparseModel, nominal: Cad, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("arview.reconstruction.dense.depth.CAD_HYPOTHESES", False)
    without = reconstruct_dense(scene, TINY, nominal)
    assert np.abs(_box_place(cloud) - MOVED_MM[:2]).max() < 0.05
    assert np.abs(_box_place(without) - _box_place(cloud)).max() < 0.02


def test_without_cad_the_sparse_points_do(scene: SparseModel) -> None:
    cloud = reconstruct_dense(scene, TINY)
    score = _score(cloud, scene, near_mm=1.0)
    assert score.median_mm < 0.08
    assert score.p90_mm < 0.4
    assert score.complete > 0.75


def test_same_seed_same_cloud_whatever_the_threads(cloud: DenseCloud, scene: SparseModel, nominal: Cad) -> None:
    again = reconstruct_dense(scene, replace(TINY, threads=1), nominal)
    assert again.points.shape == cloud.points.shape
    assert np.abs(again.points - cloud.points).max() < 1e-6
    assert np.array_equal(again.views, cloud.views)


def test_no_texture_no_points(tmp_path: Path, nominal: Cad, cloud: DenseCloud) -> None:
    blank = reconstruct_dense(_scene(tmp_path / "blank", has_texture=False), TINY, nominal)
    assert len(blank.points) < 0.001 * len(cloud.points)


def test_photos_that_share_nothing_are_refused(scene: SparseModel) -> None:
    alone = replace(
        scene, observed_point=scene.observed_point[:0], observed_photo=scene.observed_photo[:0],
        observed_px=scene.observed_px[:0],
    )  # fmt: skip
    with pytest.raises(InputError, match="only 0 photos see enough"):
        reconstruct_dense(alone, TINY)


def test_a_photo_of_another_size_is_named(scene: SparseModel, nominal: Cad) -> None:
    larger = replace(CAMERA, width=402)
    photos = (replace(scene.photos[0], camera=larger), *scene.photos[1:])
    with pytest.raises(InputError, match=r"0\.png: is 400×300 px, its camera 402×300"):
        reconstruct_dense(replace(scene, photos=photos), TINY, nominal)


@pytest.mark.parametrize(
    ("field", "value"),
    [("max_region_px", 10), ("band_mm", 0.0)],
)
def test_options_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(InputError, match=field):
        replace(TINY, **{field: value})


def read_map(path: Path) -> np.ndarray:
    """The map in a file of COLMAP, as its documentation says."""
    data = path.read_bytes()
    width, height, channels = (int(number) for number in data.split(b"&", 3)[:3])
    values = np.frombuffer(data, "<f4", offset=len(f"{width}&{height}&{channels}&")).reshape(channels, height, width)
    return values[0] if channels == 1 else values.transpose(1, 2, 0)


def test_maps_are_written_as_colmap_reads_them(cloud: DenseCloud, scene: SparseModel, tmp_path_factory) -> None:
    folder = tmp_path_factory.getbasetemp() / "dense" / "stereo"
    depth = read_map(folder / "depth_maps" / "0.png.geometric.bin")
    normals = read_map(folder / "normal_maps" / "0.png.geometric.bin")
    assert normals.shape == (*depth.shape, 3)
    known = depth > 0
    assert known.mean() > 0.3
    assert np.allclose(np.linalg.norm(normals[known], axis=1), 1.0, atol=1e-5)
    assert np.all(normals[known][:, 2] < 0.3)  # towards the camera
    assert 150.0 < np.median(depth[known]) < 300.0


def test_map_file_layout_and_damage(tmp_path: Path) -> None:
    image = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    path = tmp_path / "a.bin"
    write_map(path, image)
    # COLMAP: text "width&height&channels&", then float32 with the column running fastest and the channel slowest.
    data = path.read_bytes()
    assert data.startswith(b"4&2&3&")
    assert np.array_equal(np.frombuffer(data[6:], "<f4")[:4], image[0, :, 0])
    assert np.array_equal(read_map(path), image)


def test_ply_comes_back_and_damage_is_told(cloud: DenseCloud, tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_ply(cloud, path)
    again = read_ply(path)
    for name in ("points", "normals", "colors", "sigma", "views"):
        assert np.array_equal(getattr(again, name), getattr(cloud, name))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cloud.ply"]
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match="truncated"):
        read_ply(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match="not a cloud"):
        read_ply(path)


def test_distances_to_mesh_are_exact() -> None:
    vertices, faces, _ = _model(np.zeros(3)).mesh
    rng = np.random.default_rng(0)
    samples, of_face = sample_mesh(vertices, faces, 2.0)
    triangles = vertices[faces[of_face]]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offset = rng.uniform(0.0, 1.0, len(samples))
    # Above the box and outside the plate nothing else is nearer.
    free = (samples[:, 2] > 1.5) | (samples[:, 2] < -7.999)
    found = distances_to_mesh(samples + offset[:, None] * normals, vertices, faces)
    assert np.abs(found - offset)[free].max() < 1e-3
    corner = np.array([[60.0 + 3.0, 45.0 + 4.0, 0.0 + 12.0]])
    assert distances_to_mesh(corner, vertices, faces)[0] == pytest.approx(13.0, abs=1e-3)


def test_score_counts_what_is_missing_and_what_is_off(scene: SparseModel) -> None:
    vertices, faces, _ = _model(MOVED_MM).mesh
    samples, _ = sample_mesh(vertices, faces, 0.3, seed=5)
    shifted = samples + np.array([0.0, 0.0, 0.2])
    everything = DenseCloud(shifted, *(np.zeros(0) for _ in range(4)))  # type: ignore[arg-type]
    assert _score(everything, scene).complete > 0.99
    half = replace(everything, points=shifted[shifted[:, 0] > 0])
    assert _score(half, scene).complete == pytest.approx(0.5, abs=0.06)
    top = replace(everything, points=shifted[samples[:, 2] == 0.0])
    assert _score(top, scene).median_mm == pytest.approx(0.2, abs=1e-3)
    with pytest.raises(InputError, match="no points"):
        _score(replace(everything, points=np.empty((0, 3))), scene)


def test_torch_finds_the_same_surface(scene: SparseModel, nominal: Cad, monkeypatch) -> None:
    # What a GPU does, on the processor: the same pixels get the same elements, but for ties and rounding.
    pytest.importorskip("torch", reason="torch is not installed: tools/setup")
    pytest.importorskip("kornia", reason="kornia is not installed: tools/setup")
    few = replace(TINY, max_region_px=20_000)
    cloud = reconstruct_dense(scene, few, nominal)
    monkeypatch.setattr("arview.reconstruction.dense.depth.torch_device", lambda device: "cpu")
    other = reconstruct_dense(scene, few, nominal)
    assert len(cloud.points) > 1000
    apart, _ = cKDTree(other.points).query(cloud.points)
    assert abs(len(other.points) / len(cloud.points) - 1) < 0.01
    assert np.mean(apart < 0.01) > 0.98
    on_box = cloud.points[:, 2] > 5.0
    assert np.count_nonzero(on_box) > 300 and np.mean(apart[on_box] < 0.02) > 0.95


@pytest.mark.parametrize("device", ["cuda:7", "nonsense"])
def test_a_device_that_is_not_there_is_refused(scene: SparseModel, device: str) -> None:
    with pytest.raises(InputError, match="--device"):
        reconstruct_dense(scene, replace(TINY, device=device))
