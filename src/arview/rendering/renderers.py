"""Offscreen rendering of a model: depth, component ids and normals.

Two renderers draw the same picture to a pixel: `PyrenderRenderer` (OpenGL by EGL) and `ZBufferRenderer` (numba, no
system library). Depth is the distance along the optical axis in mm, 0 where there is no part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from arview.cad import Model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.rendering.pyrender_renderer import PyrenderRenderer, probe_gpu
from arview.rendering.rasterizer import rasterise
from arview.rendering.rendering import Rendering


class Renderer(Protocol):
    """Draws one model with one ideal (distortion-free) camera.

    Attributes:
        camera: of the pictures.
    """

    camera: Camera

    def render(self, cam_from_model: Array) -> Rendering:
        """The view of the model at a pose (4,4)."""
        ...

    def draw_each(self, poses: Sequence[Array]) -> Iterator[Callable[[], Rendering]]:
        """The views at some poses (4,4) in their order, each as a call that gives the rendering.

        The calls may be made by several threads at once: they hold what of the drawing need not be done here.
        """
        ...

    def close(self) -> None:
        """Free the context; the renderer cannot be used afterwards."""
        ...


class ZBufferRenderer:
    """Renderer on the numba z-buffer, which needs no system library; several threads may call `render` at once."""

    def __init__(self, model: Model, camera: Camera) -> None:
        self.camera = camera.without_distortion()
        self._vertices, self._faces, self._component_of_face = model.mesh

    def render(self, cam_from_model: Array) -> Rendering:
        """The view of the model at a pose (4,4)."""
        camera = self.camera
        inverse_depth, face_ids = rasterise(
            apply(cam_from_model, self._vertices),
            self._faces,
            camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            width=camera.width,
            height=camera.height,
        )
        seen = face_ids >= 0
        depth = np.zeros(inverse_depth.shape, dtype=np.float32)
        depth[seen] = 1.0 / inverse_depth[seen]
        ids = np.full(face_ids.shape, -1, dtype=np.int16)
        ids[seen] = self._component_of_face[face_ids[seen]]
        return Rendering(depth_mm=depth, component_ids=ids)

    def draw_each(self, poses: Sequence[Array]) -> Iterator[Callable[[], Rendering]]:
        """The views at some poses (4,4) in their order, each as a call that draws it."""
        return (partial(self.render, cam_from_model) for cam_from_model in poses)

    def close(self) -> None:
        """Nothing to free."""


class RendererChoice(NamedTuple):
    """The renderer that is taken, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name} ({self.reason})"


def choose_renderer(backend: str = "auto") -> RendererChoice:
    """The renderer that a name stands for.

    ``auto`` is pyrender where OpenGL is drawn by a GPU, which is asked once, and the z-buffer where it is not: on the
    processor the z-buffer draws the same in less time.

    Raises:
        InputError: unknown name.
    """
    if backend == "auto":
        is_gpu, found = probe_gpu()
        return RendererChoice("pyrender" if is_gpu else "zbuffer", found)
    if backend in ("pyrender", "zbuffer"):
        return RendererChoice(backend, "as asked")
    raise InputError(f"unknown renderer {backend!r}; choose auto, pyrender or zbuffer")


def open_renderer(model: Model, camera: Camera, backend: str = "auto") -> Renderer:
    """A renderer by name: ``pyrender``, ``zbuffer``, or ``auto``; see `choose_renderer`.

    Raises:
        InputError: unknown name.
        MissingDependencyError: ``pyrender``, where its GL library is missing.
    """
    if choose_renderer(backend).name == "pyrender":
        return PyrenderRenderer(model, camera)
    return ZBufferRenderer(model, camera)
