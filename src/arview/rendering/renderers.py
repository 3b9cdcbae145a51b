"""Offscreen rendering of a model: depth, component ids and normals.

Two renderers draw the same picture to a pixel: `PyrenderRenderer` (OpenGL by EGL) and `ZBufferRenderer` (numba, no
system library). Depth is the distance along the optical axis in mm, 0 where there is no part.
"""

from __future__ import annotations

import ctypes
import os
import sys
import types
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.errors import InputError, MissingDependencyError
from arview.geometry import Array, apply
from arview.rendering.rasterizer import rasterise

gl_from_cv = np.diag([1.0, -1.0, -1.0, 1.0])
"""(4,4) from OpenCV's camera frame (+Y down, +Z forward) to OpenGL's (+Y up, -Z forward)."""

GL_INSTALL_COMMAND = "apt-get install -y --no-install-recommends libegl1 libgl1"


@dataclass(frozen=True)
class Rendering:
    """A rendered view of a model.

    Attributes:
        depth_mm: (H,W) float32, along the optical axis; 0 where there is no part.
        component_ids: (H,W) int16, index into ``model.components``; -1 where there is no part.
    """

    depth_mm: NDArray[np.float32]
    component_ids: NDArray[np.int16]

    @cached_property
    def silhouette(self) -> NDArray[np.uint8]:
        """(H,W) uint8, 255 on the part."""
        return np.where(self.component_ids >= 0, np.uint8(255), np.uint8(0))

    def normals_in_cam(self, camera: Camera) -> NDArray[np.float32]:
        """(H,W,3) unit surface normals facing the camera, from the gradients of the depth; 0 off the part."""
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        z = self.depth_mm.astype(np.float64)
        points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
        same = self.component_ids >= 0
        forward_u, backward_u = np.roll(points, -1, axis=1) - points, points - np.roll(points, 1, axis=1)
        forward_v, backward_v = np.roll(points, -1, axis=0) - points, points - np.roll(points, 1, axis=0)
        # Of the two one-sided differences, the one with the smaller jump in depth stays on the surface.
        du = np.where((np.abs(forward_u[..., 2]) < np.abs(backward_u[..., 2]))[..., None], forward_u, backward_u)
        dv = np.where((np.abs(forward_v[..., 2]) < np.abs(backward_v[..., 2]))[..., None], forward_v, backward_v)
        normals = np.cross(dv, du)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.where(same[..., None] & (length > 0), normals / np.maximum(length, 1e-12), 0.0)
        return normals.astype(np.float32)


class Renderer(Protocol):
    """Draws one model with one ideal (distortion-free) camera.

    Attributes:
        camera: of the pictures.
        is_thread_safe: several threads may call `render` at once.
    """

    camera: Camera
    is_thread_safe: bool

    def render(self, cam_from_model: Array) -> Rendering:
        """The view of the model at a pose (4,4)."""
        ...

    def close(self) -> None:
        """Free the context; the renderer cannot be used afterwards."""
        ...


class ZBufferRenderer:
    """Renderer on the numba z-buffer, which needs no system library."""

    is_thread_safe = True

    def __init__(self, model: Model, camera: Camera) -> None:
        self.camera = camera.without_distortion()
        self._vertices, self._faces, self._component_of_face = model.mesh

    def render(self, cam_from_model: Array) -> Rendering:
        """The view of the model at a pose (4,4)."""
        camera = self.camera
        inverse_depth, face_ids = rasterise(
            apply(cam_from_model, self._vertices), self._faces,
            camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
        )  # fmt: skip
        seen = face_ids >= 0
        depth = np.zeros(inverse_depth.shape, dtype=np.float32)
        depth[seen] = 1.0 / inverse_depth[seen]
        ids = np.full(face_ids.shape, -1, dtype=np.int16)
        ids[seen] = self._component_of_face[face_ids[seen]]
        return Rendering(depth_mm=depth, component_ids=ids)

    def close(self) -> None:
        """Nothing to free."""


class PyrenderRenderer:
    """Renderer on pyrender and EGL.

    It uses pyrender's SEG pass, which draws without multisampling, so that depth and silhouette are not blurred.

    Raises:
        MissingDependencyError: no GL library or no working context; the message holds the command that installs it.
    """

    is_thread_safe = False

    def __init__(self, model: Model, camera: Camera) -> None:
        self.camera = camera.without_distortion()
        pyrender = _import_pyrender()
        import trimesh

        self._scene = pyrender.Scene(bg_color=np.zeros(4), ambient_light=np.ones(3))
        self._seg_node_map: dict[Any, tuple[int, int, int]] = {}
        for index, component in enumerate(model.components):
            mesh = trimesh.Trimesh(component.vertices_in_model, component.faces, process=False)
            node = self._scene.add(pyrender.Mesh.from_trimesh(mesh, smooth=False))
            self._seg_node_map[node] = ((index + 1) % 256, (index + 1) // 256, 0)
        self._camera_type = pyrender.IntrinsicsCamera
        self._flags = pyrender.RenderFlags.SEG | pyrender.RenderFlags.SKIP_CULL_FACES
        self._diameter_mm = model.diameter_mm
        self._center = model.center_in_model
        self._camera_node: Any = None
        try:
            self._renderer = pyrender.OffscreenRenderer(camera.width, camera.height)
        except Exception as error:
            raise MissingDependencyError(
                f"pyrender could not open an offscreen GL context ({error}); run: {GL_INSTALL_COMMAND}"
            ) from error

    def render(self, cam_from_model: Array) -> Rendering:
        """The view of the model at a pose (4,4)."""
        camera = self.camera
        center_z = float(apply(cam_from_model, self._center)[2])
        # The margin keeps the part inside the clip planes wherever it is in the picture.
        near = max(1.0, center_z - 1.5 * self._diameter_mm)
        far = max(center_z + 1.5 * self._diameter_mm, near + 1.0)
        if self._camera_node is not None:
            self._scene.remove_node(self._camera_node)
        gl_camera = self._camera_type(
            fx=camera.fx, fy=camera.fy, cx=camera.cx + 0.5, cy=camera.cy + 0.5, znear=near, zfar=far
        )
        model_from_gl = np.linalg.inv(gl_from_cv @ cam_from_model)
        self._camera_node = self._scene.add(gl_camera, pose=model_from_gl)
        color, depth = self._renderer.render(self._scene, flags=self._flags, seg_node_map=self._seg_node_map)
        ids = color[..., 0].astype(np.int16) + 256 * color[..., 1].astype(np.int16) - 1
        return Rendering(depth_mm=np.where(ids >= 0, depth, 0).astype(np.float32), component_ids=ids)

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.delete()


def _import_pyrender() -> Any:
    """Import pyrender without a display.

    Libraries are checked before, since pyrender aborts without a clear message where one is missing.
    """
    for library in ("libEGL.so.1", "libGL.so.1"):
        try:
            ctypes.CDLL(library)
        except OSError as error:
            raise MissingDependencyError(
                f"the GL library {library} is missing; run: {GL_INSTALL_COMMAND}  (or choose --renderer zbuffer)"
            ) from error
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # pyrender uses `np.infty`, which numpy 2 has dropped.
    vars(np).setdefault("infty", float("inf"))
    if "pyrender.viewer" not in sys.modules:
        stub = types.ModuleType("pyrender.viewer")
        stub.Viewer = None  # type: ignore[attr-defined]
        sys.modules["pyrender.viewer"] = stub
    try:
        import pyrender
    except Exception as error:
        raise MissingDependencyError(f"pyrender cannot be imported ({error}); run: {GL_INSTALL_COMMAND}") from error
    return pyrender


def open_renderer(model: Model, camera: Camera, backend: str = "auto") -> Renderer:
    """A renderer by name: ``pyrender``, ``zbuffer``, or ``auto``, the z-buffer, which draws the same and is faster.

    Raises:
        InputError: unknown name.
        MissingDependencyError: ``pyrender``, where its GL library is missing.
    """
    if backend in ("auto", "zbuffer"):
        return ZBufferRenderer(model, camera)
    if backend == "pyrender":
        return PyrenderRenderer(model, camera)
    raise InputError(f"unknown renderer {backend!r}; choose auto, pyrender or zbuffer")
