"""The z-buffer against analytic depths, pyrender against the z-buffer, and what is said where GL is missing."""

from __future__ import annotations

import ctypes
import re
import subprocess
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.camera import Camera
from arview.errors import InputError, MissingDependencyError
from arview.geometry import Array, apply, exp_so3, invert, rigid
from arview.rendering import pyrender_renderer
from arview.rendering.pyrender_renderer import PyrenderRenderer
from arview.rendering.rasterizer import rasterise
from arview.rendering.renderers import ZBufferRenderer, choose_renderer, open_renderer
from arview.rendering.rendering import Rendering
from helpers.cad_files import box
from helpers.synthetic import assembly, pose_from

CAMERA = Camera(320, 240, 350.0, 352.0, 158.0, 121.5)


def boxes(*bounds: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Model:
    parts = [(f"box_{i}", *box(*b)) for i, b in enumerate(bounds)]
    return make_model("boxes", tuple(Component(n, v, f.astype(np.int32)) for n, v, f in parts))


def rays_in_cam(camera: Camera = CAMERA) -> Array:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], axis=-1))


def test_depth_of_a_tilted_plane() -> None:
    """Perspective-correct: depth of the plane n · x = d along the ray r is d / (n · r)."""
    cam_from_plane = rigid(exp_so3([0.9, -0.5, 0.2]), [20.0, -10.0, 600.0])
    square = np.array([[-150.0, -150, 0], [150, -150, 0], [150, 150, 0], [-150, 150, 0]])
    inverse_depth, faces = rasterise(
        apply(cam_from_plane, square), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.width, CAMERA.height,
    )  # fmt: skip
    normal = cam_from_plane[:3, 2]
    depth = (normal @ cam_from_plane[:3, 3]) / (rays_in_cam() @ normal)
    at = apply(invert(cam_from_plane), rays_in_cam() * depth[..., None])
    inside = np.abs(at[..., :2]).max(axis=-1) < 150.0
    assert inside.sum() > 5000
    assert np.array_equal(faces >= 0, inside)
    assert 1.0 / inverse_depth[inside] == pytest.approx(depth[inside], abs=1e-3)
    assert set(np.unique(faces)) == {-1, 0, 1}


def test_depth_of_a_box_is_that_of_the_slabs() -> None:
    low, high = np.array([-40.0, -30, -20]), np.array([60.0, 30, 25])
    pose = rigid(exp_so3([2.1, 0.4, -0.3]), [15.0, 8.0, 420.0])
    rendering = ZBufferRenderer(boxes((tuple(low), tuple(high))), CAMERA).render(pose)
    rays = rays_in_cam() @ pose[:3, :3]
    origin = invert(pose)[:3, 3]
    enter = np.minimum((low - origin) / rays, (high - origin) / rays).max(axis=-1)
    leave = np.maximum((low - origin) / rays, (high - origin) / rays).min(axis=-1)
    hit = enter < leave
    assert hit.sum() > 2000
    assert np.array_equal(rendering.component_ids == 0, hit)
    assert np.array_equal(rendering.silhouette > 0, hit)
    assert rendering.depth_mm[hit] == pytest.approx(enter[hit], abs=1e-3)
    assert not rendering.depth_mm[~hit].any()


def test_normals_of_a_box_face_the_camera() -> None:
    pose = rigid(exp_so3([2.1, 0.4, -0.3]), [0.0, 0.0, 400.0])
    rendering = ZBufferRenderer(boxes(((-40, -40, -40), (40, 40, 40))), CAMERA).render(pose)
    normals = rendering.normals_in_cam(CAMERA).astype(np.float64)
    seen = rendering.component_ids >= 0
    assert np.linalg.norm(normals[seen], axis=1) == pytest.approx(np.ones(seen.sum()), abs=1e-5)
    assert np.all(np.sum(normals[seen] * rays_in_cam()[seen], axis=1) < 1e-6)
    along = np.abs(normals[seen] @ pose[:3, :3]).max(axis=1)
    assert np.mean(along > 0.999) > 0.95
    assert not normals[~seen].any()


def test_the_nearer_component_hides_the_other() -> None:
    model = boxes(((-50, -50, 0), (50, 50, 10)), ((-10, -10, 40), (10, 10, 50)))
    seen_from_above = rigid(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 350.0])
    rendering = ZBufferRenderer(model, CAMERA).render(seen_from_above)
    row, column = 121, 158
    assert rendering.component_ids[row, column] == 1
    assert rendering.depth_mm[row, column] == pytest.approx(300.0, abs=1e-3)
    assert rendering.component_ids[row, column + 30] == 0
    assert rendering.depth_mm[row, column + 30] == pytest.approx(340.0, abs=1e-3)


def test_what_crosses_the_near_plane_is_clipped() -> None:
    """A floor 100 mm below the camera that reaches behind it: seen below the horizon, at its analytic depth."""
    floor = np.array([[-5e3, 100.0, -2e3], [5e3, 100, -2e3], [5e3, 100, 8e3], [-5e3, 100, 8e3]])
    inverse_depth, faces = rasterise(
        floor, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.width, CAMERA.height,
    )  # fmt: skip
    rows = np.arange(CAMERA.height)
    with np.errstate(divide="ignore"):
        depth = 100.0 * CAMERA.fy / (rows - CAMERA.cy)
    below = (depth > 0) & (depth < 8e3)
    assert np.array_equal((faces >= 0).all(axis=1), below)
    assert not (faces[~below] >= 0).any()
    expected = np.repeat(depth[below][:, None], CAMERA.width, axis=1)
    assert 1.0 / inverse_depth[below] == pytest.approx(expected, rel=1e-9)
    nothing, _ = rasterise(
        floor - [0, 0, 9e3], np.array([[0, 1, 2]], dtype=np.int32), 350.0, 350.0, 160.0, 120.0, 320, 240
    )
    assert not nothing.any()


def test_a_window_is_cut_from_the_whole() -> None:
    vertices, faces, _ = assembly().mesh
    points = apply(pose_from(25, 40, 500), vertices)
    lens = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    whole, whole_ids = rasterise(points, faces, *lens, 320, 240)
    window, window_ids = rasterise(points, faces, *lens, 90, 70, origin=(110, 80))
    assert np.array_equal(window_ids, whole_ids[80:150, 110:200])
    assert window == pytest.approx(whole[80:150, 110:200], abs=1e-12)


@pytest.fixture(scope="module")
def gl() -> Iterator[PyrenderRenderer]:
    try:
        renderer = PyrenderRenderer(assembly(), CAMERA)
    except MissingDependencyError as error:
        pytest.skip(str(error))
    yield renderer
    renderer.close()


@pytest.mark.slow
@pytest.mark.parametrize("azimuth,elevation,distance", [(20, 40, 420), (-130, 10, 600), (75, -35, 500), (0, 88, 380)])
def test_both_renderers_draw_the_same(gl: PyrenderRenderer, azimuth: float, elevation: float, distance: float) -> None:
    pose = pose_from(azimuth, elevation, distance, roll_deg=13)
    theirs: Rendering = gl.render(pose)
    ours = ZBufferRenderer(assembly(), CAMERA).render(pose)
    part = (ours.component_ids >= 0).sum()
    assert part > 3000
    differing = np.count_nonzero(theirs.component_ids != ours.component_ids)
    assert differing / part < 0.002
    same = (theirs.component_ids == ours.component_ids) & (ours.component_ids >= 0)
    # One pixel off at the border between two faces of one component is no error of depth.
    apart = np.abs(theirs.depth_mm[same] - ours.depth_mm[same])
    assert np.quantile(apart, 0.999) < 0.05


@pytest.mark.slow
def test_a_batch_of_views_is_the_views_one_by_one(gl: PyrenderRenderer) -> None:
    """40 views are more than one batch holds: none is mixed up or keeps something of the one before."""
    poses = [pose_from(9 * i, 60 - 3 * i, 400 + 5 * i) for i in range(40)]
    drawn = [draw() for draw in gl.draw_each(poses)]
    alone = ZBufferRenderer(assembly(), CAMERA)
    assert len(drawn) == 40
    for pose, rendering in zip(poses, drawn, strict=True):
        ids = alone.render(pose).component_ids
        assert np.count_nonzero(ids != rendering.component_ids) < 0.003 * np.count_nonzero(ids >= 0)


@pytest.mark.slow
def test_pyrender_draws_a_sheet_and_an_inverted_body_from_both_sides() -> None:
    corners = np.array([[-40.0, -30, 0], [40, -30, 0], [40, 30, 0], [-40, 30, 0]])
    vertices, faces = box((50, -20, -20), (80, 20, 20))
    model = make_model(
        "sheet",
        (
            Component("sheet", corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)),
            Component("inverted", vertices, faces[:, ::-1].astype(np.int32)),
        ),
    )
    try:
        renderer = PyrenderRenderer(model, CAMERA)
    except MissingDependencyError as error:
        pytest.skip(str(error))
    for pose in (pose_from(20, 50, 400), pose_from(20, -50, 400)):
        ids, expected = renderer.render(pose).component_ids, ZBufferRenderer(model, CAMERA).render(pose).component_ids
        assert (expected == 0).sum() > 1000
        assert (expected == 1).sum() > 500
        assert np.count_nonzero(ids != expected) < 0.005 * np.count_nonzero(expected >= 0)
    renderer.close()


@pytest.mark.parametrize(
    "asked,name,reason",
    [
        ('"NVIDIA Corporation NVIDIA T4"', "pyrender", "NVIDIA T4"),
        ('"Mesa llvmpipe (LLVM 15.0.6, 256 bits)"', "zbuffer", "in software.*llvmpipe"),
        (None, "zbuffer", "no working OpenGL"),
    ],
)
def test_auto_takes_pyrender_where_a_gpu_draws(
    monkeypatch: pytest.MonkeyPatch, asked: str | None, name: str, reason: str
) -> None:
    def answer(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 0 if asked else 1, f"{asked}\n", "")

    monkeypatch.setattr(pyrender_renderer, "has_gpu_device", lambda: True)
    monkeypatch.setattr(pyrender_renderer.subprocess, "run", answer)
    pyrender_renderer.probe_gpu.cache_clear()
    try:
        chosen = choose_renderer("auto")
    finally:
        pyrender_renderer.probe_gpu.cache_clear()
    assert chosen.name == name
    assert re.search(reason, chosen.reason)


def test_auto_asks_no_opengl_on_a_machine_without_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyrender_renderer, "has_gpu_device", lambda: False)
    pyrender_renderer.probe_gpu.cache_clear()
    try:
        assert choose_renderer("auto") == ("zbuffer", "no GPU")
    finally:
        pyrender_renderer.probe_gpu.cache_clear()


def test_without_gl_the_error_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    real = ctypes.CDLL

    def missing(name: str, *args: Any, **more: Any) -> Any:
        asked.append(name)
        if "GL" in str(name):
            raise OSError(f"{name}: cannot open shared object file")
        return real(name, *args, **more)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    with pytest.raises(MissingDependencyError) as caught:
        open_renderer(assembly(), CAMERA, "pyrender")
    assert "apt-get install -y --no-install-recommends libegl1 libgl1" in str(caught.value)
    assert "libEGL.so.1" in str(caught.value)
    assert asked == ["libEGL.so.1"]


def test_an_unknown_renderer_is_refused() -> None:
    with pytest.raises(InputError, match=r"'vulkan'.*auto, pyrender or zbuffer"):
        open_renderer(assembly(), CAMERA, "vulkan")
