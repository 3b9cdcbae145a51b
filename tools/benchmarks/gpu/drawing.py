"""pyrender beside the z-buffer: the same views of two parts, drawn by both in turn."""

from __future__ import annotations

import time

import numpy as np

from arview.cad import Component, Model, make_model
from arview.errors import MissingDependencyError
from arview.guideviews.sphere import icosphere_directions, view_poses
from arview.guideviews.views import guide_camera
from arview.rendering.pyrender_renderer import gl_name
from arview.rendering.renderers import open_renderer
from gpu.clock import Row

SIZES = ((100, 95), (400, 250))  # steps around and along the ring: 19,000 and 200,000 triangles
SUBDIVISIONS, ROUNDS = 2, 3  # 162 views, drawn three times by each
RESOLUTION_PX = 400  # of guide views
DISTANCE_MM = 600.0
MAX_UNLIKE = 2e-3  # share of pixels at which only one has the part, or whose depth differs by more than …
MAX_DEPTH_MM = 0.1


def bumpy_ring(around: int, along: int) -> Model:
    """A ring of 160 mm with bumps, of 2·around·along triangles."""
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, around, endpoint=False),
        np.linspace(0, 2 * np.pi, along, endpoint=False),
        indexing="ij",
    )
    thick = 22.0 + 4.0 * np.sin(9 * u) * np.cos(4 * v)
    radius = 58.0 + thick * np.cos(v)
    vertices = np.stack([radius * np.cos(u), radius * np.sin(u), thick * np.sin(v)], axis=2).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along), indexing="ij")
    a, b = i * along + j, (i + 1) % around * along + j
    c, d = (i + 1) % around * along + (j + 1) % along, i * along + (j + 1) % along
    faces = np.concatenate([np.stack([a, b, c], axis=2).reshape(-1, 3), np.stack([a, c, d], axis=2).reshape(-1, 3)])
    return make_model(f"ring of {len(faces)} triangles", (Component("ring", vertices, faces.astype(np.int32)),))


def renderer_rows(devices: list[str]) -> list[Row]:
    """A row for each size of part."""
    try:
        name = gl_name()
    except MissingDependencyError:
        return []
    return [_row(bumpy_ring(*size), name) for size in SIZES]


def _row(model: Model, gl: str) -> Row:
    camera = guide_camera(model, DISTANCE_MM, RESOLUTION_PX)
    poses = view_poses(icosphere_directions(SUBDIVISIONS), DISTANCE_MM, model.center_in_model)
    seconds: dict[str, list[float]] = {"zbuffer": [], "pyrender": []}
    renderers = {backend: open_renderer(model, camera, backend) for backend in seconds}
    unlike = 0.0
    try:
        for turn in range(ROUNDS + 1):  # the first is not counted
            views = {}
            for backend, renderer in renderers.items():
                began_s = time.process_time()
                views[backend] = [draw() for draw in renderer.draw_each(list(poses))]
                if turn > 0:
                    seconds[backend].append(time.process_time() - began_s)
        pairs = zip(views["zbuffer"], views["pyrender"], strict=True)
        shares = [np.mean(np.abs(one.depth_mm - other.depth_mm) > MAX_DEPTH_MM) for one, other in pairs]
        unlike = float(np.mean(shares))
    finally:
        for renderer in renderers.values():
            renderer.close()
    own_s, other_s = (float(np.median(seconds[backend])) for backend in ("zbuffer", "pyrender"))
    result = f"{100 * unlike:.3f} % of pixels differ by more than {MAX_DEPTH_MM} mm"
    subject, beside = f"{len(model.mesh[1]):,} triangles", f"pyrender on {gl}"
    what = f"{len(poses)} views of {RESOLUTION_PX} px"
    return Row(what, subject, beside, own_s, other_s, result, unlike <= MAX_UNLIKE)
