"""Edges of each component that are visible from one direction.

They are sampled on a z-buffer rendering of the nearest guide view and cached, because a tracked part shows the same
few directions again and again. Points where another component could be mistaken for this one are marked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model, make_model
from arview.core.kernel import kernel
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet, facing
from arview.guideviews.mesh_edges import mesh_edges
from arview.rendering import Rendering, ZBufferRenderer

INITIAL_SAMPLES = 4096
"""Samples for which memory is reserved at first; it doubles when it is full."""
MIN_FORESHORTENING = 0.05
"""Edges whose image is shorter than this share of their length seen frontally have no stable image direction."""


SHARED_PX = 3.0
"""Points this near to a parallel edge of another component are shared, and evidence for neither."""
SHARED_COS = 0.87
"""Edges are parallel when the cosine between their normals is above this."""
OCCLUDER_PX = 2
"""Points this near to a surface in front of them may be hidden from directions between two views."""
SIDE_PX = 4.0
"""Distance from an edge at which the component beside it is looked up."""
TOLERANCE_PX = 3.0
"""Depth tolerance in pixels; three are two pixels of a surface seen at 45°."""
MAX_CACHED = 64
"""Directions kept in memory."""


class VisibleEdges(NamedTuple):
    """Visible edge points of all components from one direction, sorted by component. Kernels take it as it is.

    Attributes:
        points_in_body: (N,3) float32 mm about the model's centre.
        tangents: (N,3) float32 unit vectors along the edges.
        component: (N,) int16 component of each point.
        sides: (N,2) int16 component seen beside the edge, against and along its image normal; -1: none.
        is_own: (N,) bool; False for points shared with another component or close to an occluder.
        starts: (C+1,) int64 index of the first point of each component.
    """

    points_in_body: NDArray[np.float32]
    tangents: NDArray[np.float32]
    component: NDArray[np.int16]
    sides: NDArray[np.int16]
    is_own: NDArray[np.bool_]
    starts: NDArray[np.int64]


class _Mesh(NamedTuple):
    """`MeshEdges` in a form that kernels take: see there."""

    vertices: Array
    ends: NDArray[np.int32]
    faces: NDArray[np.int32]
    is_sharp: NDArray[np.bool_]
    normals: Array
    component: NDArray[np.int32]


class _Rendering(NamedTuple):
    """A rendered view: pose (4,4), focal length and principal point in px, component ids and depth (H,W)."""

    cam_from_model: Array
    focal_px: float
    center_px: float
    ids: NDArray[np.int16]
    depth_mm: NDArray[np.float32]
    tolerance_mm: float


class _Samples(NamedTuple):
    """Samples along edges: points (N,3) mm, unit tangents (N,3), pixels (N,2), image normals (N,2), depths (N,) mm and
    components (N,).
    """

    points: Array
    tangents: Array
    pixels: Array
    normals_px: Array
    depths: Array
    component: NDArray[np.int16]


class VisibleEdgeCache:
    """Visible edges of a model by direction, made when first needed.

    Args:
        views: guide views of the model; their directions and camera are used.
        model: the same model.
    """

    def __init__(self, views: GuideViewSet, model: Model) -> None:
        self._views, self._model = views, model
        self._count = len(model.components)
        self._renderer = ZBufferRenderer(model, views.camera)
        edges = mesh_edges(model, views.options.crease_angle_deg)
        self._mesh = _Mesh(
            edges.vertices_in_model, edges.ends, edges.faces, edges.is_sharp, edges.face_normals, edges.component
        )
        self._cached: dict[tuple[int, bytes], VisibleEdges] = {}
        self._incomplete: tuple[bytes, ZBufferRenderer, NDArray[np.int16]] | None = None

    def nearest(self, cam_from_model: Array, is_absent: NDArray[np.bool_] | None = None) -> VisibleEdges:
        """Visible edges of the guide view whose direction is nearest to a pose (4,4).

        Args:
            cam_from_model: (4,4).
            is_absent: (C,) components that are not there: they hide nothing, and edges of others are not near theirs.
                Their own edges are those of the complete part. None: all are there.
        """
        index = self._views.nearest_index(cam_from_model)
        absent = is_absent.tobytes() if is_absent is not None and is_absent.any() else b""
        key = (index, absent)
        if key not in self._cached:
            if len(self._cached) >= MAX_CACHED:
                del self._cached[next(iter(self._cached))]
            pose = self._views.poses[index]
            if is_absent is None or not absent:
                self._cached[key] = self._sampled(pose, self._renderer.render(pose), self._mesh)
            else:
                self._cached[key] = self._sampled_without(cam_from_model, pose, is_absent)
        return self._cached[key]

    def _sampled_without(self, cam_from_model: Array, view_pose: Array, is_absent: NDArray[np.bool_]) -> VisibleEdges:
        """As `nearest` for some absent components, for the guide view of a pose (4,4)."""
        complete, absent, mesh = self.nearest(cam_from_model), is_absent.tobytes(), self._mesh
        if self._incomplete is None or self._incomplete[0] != absent:
            kept = np.flatnonzero(~is_absent)
            model = make_model(self._model.name, tuple(self._model.components[index] for index in kept))
            # The last number is that of the background, -1.
            self._incomplete = absent, ZBufferRenderer(model, self._views.camera), np.append(kept, -1).astype(np.int16)
        _, renderer, names = self._incomplete
        drawn = renderer.render(view_pose)
        is_kept = ~is_absent[mesh.component]
        left = mesh._replace(
            ends=mesh.ends[is_kept],
            faces=mesh.faces[is_kept],
            is_sharp=mesh.is_sharp[is_kept],
            component=mesh.component[is_kept],
        )
        found = self._sampled(view_pose, replace(drawn, component_ids=names[drawn.component_ids]), left)
        is_own = is_absent[complete.component]
        component = np.concatenate([found.component, complete.component[is_own]])
        order = np.argsort(component, kind="stable")
        return VisibleEdges(
            points_in_body=np.concatenate([found.points_in_body, complete.points_in_body[is_own]])[order],
            tangents=np.concatenate([found.tangents, complete.tangents[is_own]])[order],
            component=component[order],
            sides=np.concatenate([found.sides, complete.sides[is_own]])[order],
            is_own=np.concatenate([found.is_own, complete.is_own[is_own]])[order],
            starts=self._starts(component[order]),
        )

    def _starts(self, component: NDArray[np.int16]) -> NDArray[np.int64]:
        """(C+1,) index of the first point of each component, of those (N,) of sorted points."""
        return np.searchsorted(component, np.arange(self._count + 1)).astype(np.int64)

    def _sampled(self, cam_from_model: Array, image: Rendering, mesh: _Mesh) -> VisibleEdges:
        camera, center_in_model = self._views.camera, self._views.center_in_model
        ids = image.component_ids
        tolerance_mm = TOLERANCE_PX * float(apply(cam_from_model, center_in_model)[2]) / camera.fx
        rendering = _Rendering(cam_from_model, camera.fx, camera.cx, ids, image.depth_mm, tolerance_mm)
        samples = _sample_edges(mesh, rendering)
        order = np.argsort(samples.component, kind="stable")
        is_own = _own_samples(samples, rendering, SHARED_PX, SHARED_COS, OCCLUDER_PX)
        beside = [np.round(samples.pixels + sign * SIDE_PX * samples.normals_px).astype(np.intp) for sign in (-1, 1)]
        beside = [np.clip(place, 0, [camera.width - 1, camera.height - 1]) for place in beside]
        component = samples.component[order]
        return VisibleEdges(
            points_in_body=(samples.points - center_in_model)[order].astype(np.float32),
            tangents=samples.tangents[order].astype(np.float32),
            component=component,
            sides=np.stack([ids[place[:, 1], place[:, 0]] for place in beside], axis=1)[order],
            is_own=is_own[order],
            starts=self._starts(component),
        )


@kernel
def _longer(array: NDArray[Any]) -> NDArray[Any]:
    """A copy of twice the length."""
    return np.concatenate((array, np.empty_like(array)))


@kernel
def _is_visible(view: _Rendering, column: int, row: int, depth_mm: float, component: int, is_silhouette: bool) -> bool:
    """Whether an edge point of a component is visible, by the 3 × 3 pixels around it.

    Either the rendered surface is at its depth, or the point is on a silhouette beside its own surface, which curves
    towards the camera by more than the tolerance (thin cylinders), with free space on the other side.
    """
    on_surface = False
    beside = False
    open_side = False
    for y in range(row - 1, row + 2):
        for x in range(column - 1, column + 2):
            d = view.depth_mm[y, x]
            if view.ids[y, x] == component:
                if abs(depth_mm - d) < view.tolerance_mm:
                    on_surface = True
                elif d < depth_mm:
                    beside = True
            elif view.ids[y, x] < 0 or d > depth_mm - view.tolerance_mm:
                open_side = True
    return on_surface or (is_silhouette and beside and open_side)


@kernel
def _sample_edges(mesh: _Mesh, view: _Rendering) -> _Samples:
    """Samples (a `_Samples`), one per pixel, along the visible sharp edges and silhouettes of a `_Mesh`.

    As `mesh_edges.sample_visible_edges`, but with the visibility test of `_is_visible`.
    """
    height, width = view.ids.shape
    r = view.cam_from_model
    focal, middle = view.focal_px, view.center_px
    eye = np.empty(3)
    for k in range(3):
        eye[k] = -(r[0, k] * r[0, 3] + r[1, k] * r[1, 3] + r[2, k] * r[2, 3])
    a_cam, b_cam = np.empty(3), np.empty(3)
    capacity = INITIAL_SAMPLES
    points, tangents = np.empty((capacity, 3)), np.empty((capacity, 3))
    pixels, normals_px = np.empty((capacity, 2)), np.empty((capacity, 2))
    depths, owners = np.empty(capacity), np.empty(capacity, dtype=np.int16)
    found = 0
    carry = 0.5
    for e in range(mesh.ends.shape[0]):
        a, b = mesh.vertices[mesh.ends[e, 0]], mesh.vertices[mesh.ends[e, 1]]
        f0, f1 = mesh.faces[e, 0], mesh.faces[e, 1]
        front0, front1 = facing(eye, a, mesh.normals, f0, f1)
        silhouette = f1 < 0 or (front0 > 0) != (front1 > 0)
        if not (silhouette or (mesh.is_sharp[e] and front0 > 0)):
            continue
        for k in range(3):
            a_cam[k] = r[k, 0] * a[0] + r[k, 1] * a[1] + r[k, 2] * a[2] + r[k, 3]
            b_cam[k] = r[k, 0] * b[0] + r[k, 1] * b[1] + r[k, 2] * b[2] + r[k, 3]
        if a_cam[2] < 1.0 or b_cam[2] < 1.0:
            continue
        du = focal * (b_cam[0] / b_cam[2] - a_cam[0] / a_cam[2])
        dv = focal * (b_cam[1] / b_cam[2] - a_cam[1] / a_cam[2])
        length = np.sqrt(du * du + dv * dv)
        size = np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        if length < MIN_FORESHORTENING * focal * size / a_cam[2]:
            continue
        # The remainder is carried to the next edge, so that short edges get their share of samples.
        wanted = length + carry
        count = int(wanted)
        carry = wanted - count
        for i in range(count):
            t = (i + 0.5) / count
            z = a_cam[2] + t * (b_cam[2] - a_cam[2])
            u = focal * (a_cam[0] + t * (b_cam[0] - a_cam[0])) / z + middle
            v = focal * (a_cam[1] + t * (b_cam[1] - a_cam[1])) / z + middle
            iu, iv = int(np.round(u)), int(np.round(v))
            if iu < 1 or iv < 1 or iu >= width - 1 or iv >= height - 1:
                continue
            if not _is_visible(view, iu, iv, z, mesh.component[e], silhouette):
                continue
            if found == capacity:
                capacity *= 2
                points, tangents, pixels = _longer(points), _longer(tangents), _longer(pixels)
                normals_px, depths, owners = _longer(normals_px), _longer(depths), _longer(owners)
            for k in range(3):
                points[found, k] = a[k] + t * (b[k] - a[k])
                tangents[found, k] = (b[k] - a[k]) / size
            pixels[found, 0], pixels[found, 1] = u, v
            normals_px[found, 0], normals_px[found, 1] = -dv / length, du / length
            depths[found] = z
            owners[found] = mesh.component[e]
            found += 1
    return _Samples(
        points[:found], tangents[:found], pixels[:found], normals_px[:found], depths[:found], owners[:found]
    )


@kernel
def _own_samples(
    samples: _Samples, view: _Rendering, shared_px: float, shared_cos: float, occluder_px: int
) -> NDArray[np.bool_]:
    """(N,) False for samples near a parallel edge of another component, or near a surface in front of them.

    The limits are the constants of this module.
    """
    pixels, normals_px, depths, owners = samples.pixels, samples.normals_px, samples.depths, samples.component
    ids, depth = view.ids, view.depth_mm
    height, width = ids.shape
    # A linked list of the samples in each pixel.
    grid = np.full((height, width), -1, dtype=np.int32)
    following = np.full(pixels.shape[0], -1, dtype=np.int32)
    for i in range(pixels.shape[0]):
        x, y = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        following[i] = grid[y, x]
        grid[y, x] = i
    own = np.ones(pixels.shape[0], dtype=np.bool_)
    reach = max(int(np.ceil(shared_px)), occluder_px)
    for i in range(pixels.shape[0]):
        x0, y0 = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        for y in range(max(0, y0 - reach), min(height, y0 + reach + 1)):
            for x in range(max(0, x0 - reach), min(width, x0 + reach + 1)):
                in_front = ids[y, x] >= 0 and ids[y, x] != owners[i] and depth[y, x] < depths[i] - view.tolerance_mm
                if in_front and max(abs(x - x0), abs(y - y0)) <= occluder_px:
                    own[i] = False
                j = grid[y, x]
                while j >= 0:
                    if owners[j] != owners[i]:
                        apart = (pixels[j, 0] - pixels[i, 0]) ** 2 + (pixels[j, 1] - pixels[i, 1]) ** 2
                        along = normals_px[i, 0] * normals_px[j, 0] + normals_px[i, 1] * normals_px[j, 1]
                        if apart < shared_px * shared_px and abs(along) > shared_cos:
                            own[i] = False
                    j = following[j]
    return own
