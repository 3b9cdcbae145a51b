"""Edges of each component that are visible from one direction.

They are sampled on a z-buffer rendering of the nearest guide view and cached, because a tracked part shows the same
few directions again and again. Points where another component could be mistaken for this one are marked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model, make_model
from arview.core.kernel import kernel
from arview.geometry import Array, apply
from arview.guideviews import GuideViewSet
from arview.rendering import EDGE_SILHOUETTE, EdgeSamples, MeshEdges, Rendering, ZBufferRenderer, sample_edges
from arview.rendering.mesh_edges import mesh_edges

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


class _Rendering(NamedTuple):
    """A rendered view: component ids and depth (H,W), and the tolerance of depths."""

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
        self._mesh = mesh_edges(model, views.options.crease_angle_deg)
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
            is_crease=mesh.is_crease[is_kept],
            is_sharp=mesh.is_sharp[is_kept],
            is_rough=mesh.is_rough[is_kept],
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

    def _sampled(self, cam_from_model: Array, image: Rendering, mesh: MeshEdges) -> VisibleEdges:
        camera, center_in_model = self._views.camera, self._views.center_in_model
        ids = image.component_ids
        tolerance_mm = TOLERANCE_PX * float(apply(cam_from_model, center_in_model)[2]) / camera.fx
        rendering = _Rendering(ids, image.depth_mm, tolerance_mm)
        along = sample_edges(
            mesh,
            mesh.is_sharp,
            cam_from_model,
            intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            width=camera.width,
            height=camera.height,
            spacing_px=1.0,
            min_depth_mm=1.0,
            min_foreshortening=MIN_FORESHORTENING,
        )
        is_seen = _visible_samples(along, rendering, mesh.component[along.edges])
        along = EdgeSamples._make(values[is_seen] for values in along)
        across = along.along_px[:, ::-1] * [-1.0, 1.0]
        samples = _Samples(
            along.points_in_model,
            along.tangents_in_model,
            along.pixels,
            normals_px=across / np.linalg.norm(across, axis=1, keepdims=True),
            depths=along.depths_mm,
            component=mesh.component[along.edges].astype(np.int16),
        )
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
def _visible_samples(samples: EdgeSamples, view: _Rendering, owners: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(N,) whether samples of components (N,) are visible in a view, see `_is_visible`."""
    seen = np.zeros(len(owners), dtype=np.bool_)
    for i in range(len(owners)):
        column, row = int(np.round(samples.pixels[i, 0])), int(np.round(samples.pixels[i, 1]))
        is_silhouette = samples.kinds[i] & EDGE_SILHOUETTE > 0
        seen[i] = _is_visible(view, column, row, samples.depths_mm[i], owners[i], is_silhouette)
    return seen


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
