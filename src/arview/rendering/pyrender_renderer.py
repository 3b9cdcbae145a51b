"""Renderer on pyrender: OpenGL by EGL, on the GPU where there is one.

pyrender draws into a multisampled buffer, which costs four times the pixels and blurs depth and silhouette where the
samples are resolved. Here its renderer is given a buffer with one sample a pixel, high enough for several views, one
below the other: the views are drawn one after another and read at once. Component ids are colours of the vertices, so
that one call draws the whole model.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Model
from arview.camera import Camera
from arview.core.kernel import kernel
from arview.errors import MissingDependencyError
from arview.geometry import Array, apply
from arview.rendering.rendering import Rendering

gl_from_cv = np.diag([1.0, -1.0, -1.0, 1.0])
"""(4,4) from OpenCV's camera frame (+Y down, +Z forward) to OpenGL's (+Y up, -Z forward)."""

GL_INSTALL_COMMAND = "apt-get install -y --no-install-recommends libegl1 libgl1"

BATCH_PIXELS = 2_000_000
"""Largest number of pixels that are drawn before they are read: 12 guide views of the default size."""

SOFTWARE_GL = ("llvmpipe", "softpipe", "swrast", "swr", "software rasterizer")
"""Words in the renderer's name of an OpenGL that runs on the processor."""


class PyrenderRenderer:
    """Draws depth and component ids of one model in one pass of pyrender.

    Closed components are drawn without their back faces, which nothing shows; sheets and open bodies from both sides.
    The context belongs to the thread that made the renderer: `render` and `draw_each` are called from it, and what
    `draw_each` yields from any.

    Raises:
        MissingDependencyError: no GL library or no working context; the message holds the command that installs it.
    """

    def __init__(self, model: Model, camera: Camera) -> None:
        self.camera = camera.without_distortion()
        self._diameter_mm = model.diameter_mm
        self._center_in_model = model.center_in_model
        pyrender = import_pyrender()
        self._flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        self._scene = pyrender.Scene(bg_color=np.zeros(4))
        for primitive in _primitives(pyrender, model.components):
            self._scene.add(pyrender.Mesh([primitive]))
        lens = self.camera
        self._gl_camera = pyrender.IntrinsicsCamera(
            fx=lens.fx, fy=lens.fy, cx=lens.cx + 0.5, cy=lens.cy + 0.5, znear=1.0, zfar=2.0
        )
        self._camera_node = self._scene.add(self._gl_camera, pose=np.eye(4))
        self._context = _open_context(lens.width, lens.height)
        self._rows = max(1, min(16, BATCH_PIXELS // (lens.width * lens.height)))
        self._tiles = _tile_renderer(lens.width, lens.height, self._rows)

    def render(self, cam_from_model: Array) -> Rendering:
        """The view of the model at a pose (4,4)."""
        return next(iter(self.draw_each([cam_from_model])))()

    def draw_each(self, poses: Sequence[Array]) -> Iterator[Callable[[], Rendering]]:
        """The views at some poses (4,4) in their order, each as a call that gives the rendering.

        Several views are drawn and read at once; what is left, the conversion of depth, is done by the call.
        """
        for start in range(0, len(poses), self._rows):
            batch = poses[start : start + self._rows]
            self._context.make_current()
            spans = []
            for row, cam_from_model in enumerate(batch):
                spans.append(self._clip_planes(cam_from_model))
                self._gl_camera.znear, self._gl_camera.zfar = spans[-1]
                self._scene.set_pose(self._camera_node, np.linalg.inv(gl_from_cv @ cam_from_model))
                self._tiles.row = row
                self._tiles.render(self._scene, self._flags)
            depths, colors = self._tiles.read(len(batch))
            for depth, color, span in zip(depths, colors, spans, strict=True):
                yield partial(_rendering, depth, color, *span)

    def close(self) -> None:
        """Free the GL context."""
        self._context.make_current()
        self._tiles.delete()
        _close_context(self._context)

    def _clip_planes(self, cam_from_model: Array) -> tuple[float, float]:
        """Distances of the near and far plane, mm, with a margin that keeps the part between them at any pose."""
        center_z_mm = float(apply(cam_from_model, self._center_in_model)[2])
        near_mm = max(0.002 * self._diameter_mm, center_z_mm - 1.5 * self._diameter_mm)
        return near_mm, max(center_z_mm + 1.5 * self._diameter_mm, 2.0 * near_mm)


def _rendering(gl_depth: NDArray[np.float32], color: NDArray[np.uint8], near_mm: float, far_mm: float) -> Rendering:
    """Depth and ids from the buffers of one view, whose first row is the lowest of the picture."""
    depth_mm = np.zeros(gl_depth.shape, dtype=np.float32)
    ids = np.full(gl_depth.shape, -1, dtype=np.int16)
    _convert(gl_depth, color, near_mm, far_mm, depth_mm, ids)
    return Rendering(depth_mm=depth_mm, component_ids=ids)


@kernel
def _convert(
    gl_depth: NDArray[np.float32],
    color: NDArray[np.uint8],
    near_mm: float,
    far_mm: float,
    depth_mm: NDArray[np.float32],
    ids: NDArray[np.int16],
) -> None:
    """Turn a view upside down, its depth (H,W) into mm and its colours (H,W,4) into component ids."""
    height, width = gl_depth.shape
    for v in range(height):
        source = height - 1 - v
        for u in range(width):
            index = color[source, u, 0] + 256 * color[source, u, 1] - 1
            if index >= 0:
                ids[v, u] = index
                ndc = 2.0 * gl_depth[source, u] - 1.0
                depth_mm[v, u] = 2.0 * near_mm * far_mm / (far_mm + near_mm - ndc * (far_mm - near_mm))


def _primitives(pyrender: Any, components: Sequence[Component]) -> list[Any]:
    """At most two primitives of pyrender: all closed components, and all that are open."""
    groups: dict[bool, list[tuple[int, Component]]] = {}
    for index, component in enumerate(components):
        groups.setdefault(_is_closed(component), []).append((index, component))
    primitives = []
    for is_closed, members in groups.items():
        counts = [len(component.vertices_in_model) for _, component in members]
        offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
        number = np.repeat([index + 1 for index, _ in members], counts)
        color = np.stack([number % 256, number // 256, np.zeros_like(number), np.full_like(number, 255)], axis=1)
        primitives.append(
            pyrender.Primitive(
                positions=np.concatenate([c.vertices_in_model for _, c in members]).astype(np.float32),
                indices=np.concatenate([c.faces + o for (_, c), o in zip(members, offsets, strict=True)]),
                color_0=color.astype(np.float32) / 255.0,
                material=pyrender.MetallicRoughnessMaterial(doubleSided=not is_closed),
                mode=pyrender.constants.GLTF.TRIANGLES,
            )
        )
    return primitives


def _is_closed(component: Component) -> bool:
    """The faces of a component bound a solid and look outwards."""
    import trimesh

    mesh = trimesh.Trimesh(component.vertices_in_model, component.faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


def _tile_renderer(width: int, height: int, rows: int) -> Any:
    """Pyrender's renderer, drawing into one row of a buffer of `rows` views, with one sample a pixel."""
    from OpenGL import GL
    from pyrender.constants import ProgramFlags
    from pyrender.renderer import Renderer
    from pyrender.shader_program import ShaderProgramCache

    class TileRenderer(Renderer):
        """Draws each view into the row of the buffer that `row` says."""

        def __init__(self) -> None:
            self._main_fb: Any = None
            super().__init__(width, height)
            self.row = 0
            self._program_cache = ShaderProgramCache(str(_shader_folder()))

        def _configure_main_framebuffer(self) -> None:
            if self._main_fb is not None:
                return
            self._main_cb, self._main_db = GL.glGenRenderbuffers(2)
            self._main_fb = self._main_fb_ms = GL.glGenFramebuffers(1)
            self._main_fb_dims = (width, height)
            GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
            for buffer, kind, attachment in (
                (self._main_cb, GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0),
                (self._main_db, GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT),
            ):
                GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
                GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, width, height * rows)
                GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)

        def _delete_main_framebuffer(self) -> None:
            if self._main_fb is not None:
                GL.glDeleteFramebuffers(1, [self._main_fb])
                GL.glDeleteRenderbuffers(2, [self._main_cb, self._main_db])
            self._main_fb = None

        def _configure_forward_pass_viewport(self, flags: int) -> None:
            super()._configure_forward_pass_viewport(flags)
            GL.glViewport(0, self.row * height, width, height)

        def _forward_pass(self, scene: Any, flags: int, seg_node_map: Any = None) -> None:
            """Draw the view; the buffer of all rows is cleared before the first, since a part of it costs a drawing."""
            self._configure_forward_pass_viewport(flags)
            if self.row == 0:
                GL.glClearColor(0.0, 0.0, 0.0, 0.0)
                GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
            view, projection = self._get_camera_matrices(scene)
            for node in scene.mesh_nodes:
                for primitive in node.mesh.primitives:
                    program = self._get_primitive_program(primitive, flags, ProgramFlags.USE_MATERIAL)
                    program._bind()
                    program.set_uniform("V", view)
                    program.set_uniform("P", projection)
                    self._bind_and_draw_primitive(primitive, np.eye(4), program, flags)

        def read(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
            """Depth (count,H,W) as GL holds it and colours (count,H,W,4) of the first views, rows from below."""
            depth = np.empty((count, height, width), dtype=np.float32)
            color = np.empty((count, height, width, 4), dtype=np.uint8)
            GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
            GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
            GL.glReadPixels(0, 0, width, height * count, GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT, depth)
            GL.glReadPixels(0, 0, width, height * count, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, color)
            return depth, color

    return TileRenderer()


@cache
def _shader_folder() -> Path:
    """The folder of the shaders, which pyrender reads by path."""
    return Path(str(resources.files("arview.rendering") / "shaders"))


def import_pyrender() -> Any:
    """Import pyrender without a display.

    Libraries are checked before, since pyrender aborts without a clear message where one is missing.

    Raises:
        MissingDependencyError: a GL library or pyrender itself is missing.
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


def gl_name() -> str:
    """Vendor and renderer of the OpenGL that pyrender would draw with.

    Raises:
        MissingDependencyError: no GL library or no working context.
    """
    import_pyrender()
    context = _open_context(16, 16)
    from OpenGL import GL

    try:
        return " ".join(GL.glGetString(what).decode(errors="replace") for what in (GL.GL_VENDOR, GL.GL_RENDERER))
    finally:
        _close_context(context)


def _open_context(width: int, height: int) -> Any:
    """An EGL context of pyrender's, made current, on the device that EGL_DEVICE_ID says.

    Raises:
        MissingDependencyError: no working context.
    """
    try:
        from pyrender.platforms import egl

        context = egl.EGLPlatform(
            width, height, device=egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", 0)))
        )
        context.init_context()
    except Exception as error:
        raise MissingDependencyError(
            f"pyrender could not open an offscreen GL context ({error or type(error).__name__}); "
            f"run: {GL_INSTALL_COMMAND}  (or choose --renderer zbuffer)"
        ) from error
    return context


def _close_context(context: Any) -> None:
    """Free a context, but not its display, which all contexts of the process share and pyrender would end."""
    from OpenGL.EGL import eglDestroyContext

    eglDestroyContext(context._egl_display, context._egl_context)
    context._egl_context = context._egl_display = None


def has_gpu_device() -> bool:
    """The machine has a device file of a GPU, without which OpenGL is drawn by the processor."""
    return any(Path("/dev").glob("nvidia[0-9]*")) or any(Path("/dev/dri").glob("renderD*")) or Path("/dev/dxg").exists()


@cache
def probe_gpu(timeout_s: float = 30.0) -> tuple[bool, str]:
    """Whether OpenGL is drawn by a GPU, and the name of what draws it or the reason why nothing does.

    A process of its own asks, since a broken driver ends the process that asks it. It is asked once.
    """
    if not has_gpu_device():
        return False, "no GPU"
    ask = "import json; from arview.rendering.pyrender_renderer import gl_name; print(json.dumps(gl_name()))"
    try:
        asked = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, timeout=timeout_s)
    except (OSError, subprocess.TimeoutExpired):
        return False, "OpenGL does not answer"
    if asked.returncode != 0:
        return False, "no working OpenGL"
    name = str(json.loads(asked.stdout.splitlines()[-1]))
    if any(word in name.lower() for word in SOFTWARE_GL):
        return False, f"OpenGL in software: {name}"
    return True, name
