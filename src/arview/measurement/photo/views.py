"""The photos and the model in the form that both methods of measuring in photos use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core import subpixel_edges
from arview.core.kernel import kernel
from arview.core.parallel import pool
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.reconstruction import SparseModel
from arview.rendering import rasterise

MAX_LINEAR_PX = 24_000_000
"""Pixels of all photos up to which they are kept in linear light too: 130 MB with their reduced sizes."""
SCENE_MARGIN_PX = 60
"""Drawn around the model: components may stand that far outside its bounding box."""


class PhotoStack(NamedTuple):
    """All photos at one resolution as flat arrays, for kernels.

    Attributes:
        pixels: grey levels of all pictures one after another, uint8.
        starts: (M,) index of each picture's first pixel.
        sizes: (M,2) width and height, px.
        lenses: (M,9) fx fy cx cy k1 k2 p1 p2 k3.
        poses: (M,3,4) cam_from_model.
    """

    pixels: NDArray[np.uint8]
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    lenses: Array
    poses: Array


class RenderedWindow(NamedTuple):
    """The model rendered without distortion into a window of a photo.

    Attributes:
        lens: fx, fy, cx, cy of the ideal camera.
        origin: first column and row of the window, px; may be negative.
        inverse_depth: (H,W) 1/mm, 0 where nothing is.
        ids: (H,W) component index, -1 where nothing is.
    """

    lens: tuple[float, float, float, float]
    origin: tuple[int, int]
    inverse_depth: Array
    ids: NDArray[np.int32]

    def cropped(self, origin: tuple[int, int], width: int, height: int) -> RenderedWindow | None:
        """A smaller window; None: it is not within this one."""
        column, row = origin[0] - self.origin[0], origin[1] - self.origin[1]
        if min(column, row) < 0 or row + height > self.ids.shape[0] or column + width > self.ids.shape[1]:
            return None
        part = slice(row, row + height), slice(column, column + width)
        return RenderedWindow(self.lens, origin, self.inverse_depth[part].astype(np.float64), self.ids[part])


@dataclass(frozen=True)
class PhotoViews:
    """Photos in grey with their poses in the model frame, and the model.

    Attributes:
        model: the nominal CAD.
        names: of the photos.
        cameras: of the photos, with distortion.
        cam_from_model: (M,4,4).
        levels: the photos at full, half and quarter size.
        pose_covariance: see `SparseModel`; None when unknown.
        places: (4,4) measured_from_nominal of components that stand there, by index; others are at nominal.
        scenes: the photos with all components where they stand, see `standing`; empty without.
    """

    model: Model
    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cam_from_model: Array
    levels: tuple[PhotoStack, ...]
    pose_covariance: Array | None = None
    places: Mapping[int, Array] = field(default_factory=dict)
    scenes: tuple[RenderedWindow, ...] = ()
    _linear: dict[tuple[int, int], NDArray[np.float32]] = field(default_factory=dict, repr=False)

    @property
    def centres(self) -> Array:
        """(M,3) camera centres in the model frame, mm."""
        return -np.einsum("mji,mj->mi", self.cam_from_model[:, :3, :3], self.cam_from_model[:, :3, 3])

    def gray(self, view: int, level: int = 0) -> NDArray[np.uint8]:
        """(H,W) uint8 picture of one photo, at full size or at a half for each level."""
        stack = self.levels[level]
        width, height = stack.sizes[view]
        return stack.pixels[stack.starts[view] : stack.starts[view] + width * height].reshape(height, width)

    def linear(self, view: int, level: int) -> NDArray[np.float32] | None:
        """The same in linear light, made once; None where all photos together are too large to be kept so."""
        if len(self.levels[0].pixels) > MAX_LINEAR_PX:
            return None
        if (view, level) not in self._linear:
            self._linear[view, level] = subpixel_edges.linear_light(np.ascontiguousarray(self.gray(view, level)))
        return self._linear[view, level]

    @cached_property
    def _vertices(self) -> Array:
        """(V,3) vertices of the model with its components where they stand."""
        vertices, faces, owner = self.model.mesh
        vertices = vertices.copy()
        for component, place in self.places.items():
            mine = np.unique(faces[owner == component])
            vertices[mine] = apply(place, vertices[mine])
        return vertices

    def standing(self, places: Mapping[int, Array]) -> PhotoViews:
        """The same photos with components at ``places``; few enough photos are drawn so, once for all components."""
        views = replace(self, places=places)
        if not places or len(self.levels[0].pixels) > MAX_LINEAR_PX:
            return views
        low, high = self.model.bounds_in_model
        corners = low + np.array(list(np.ndindex(2, 2, 2))) * (high - low)

        def drawn(view: int) -> RenderedWindow:
            window = views.window(view, None, np.eye(4), corners, SCENE_MARGIN_PX)
            return window._replace(inverse_depth=window.inverse_depth.astype(np.float32))

        return replace(views, scenes=tuple(pool().map(drawn, range(len(self.cameras)))))

    def mm_per_px(self, point: Array) -> float:
        """Size of a pixel at a point (3,): median over the photos in front of which it lies.

        Raises:
            InputError: the point is behind every camera.
        """
        depths = apply_all(self.cam_from_model, point)[:, 2]
        in_front = depths > 0
        if not in_front.any():
            raise InputError("photos: the part is behind every camera; the poses are not in the frame of the CAD")
        return float(np.median(depths[in_front] / np.array([camera.fx for camera in self.cameras])[in_front]))

    def window(
        self, view: int, component: int | None, place: Array, around: Array, margin_px: int = 12
    ) -> RenderedWindow:
        """Render the model around some points, as a photo without distortion shows it.

        Args:
            view: index of the photo.
            component: index of the component that stands at ``place``; None: all are where they stand; ``-1 - i``
                removes component i.
            place: (4,4) measured_from_nominal.
            around: (N,3) points that the window must contain, mm.
            margin_px: added on every side.
        """
        camera, pose = self.cameras[view], self.cam_from_model[view]
        nominal, faces, owner = self.model.mesh
        vertices = self._vertices
        if component is not None and component >= 0:
            mine, vertices = np.unique(faces[owner == component]), vertices.copy()
            vertices[mine] = apply(place, nominal[mine])
        elif component is not None:
            faces, owner = faces[owner != -1 - component], owner[owner != -1 - component]
        pixels = camera.without_distortion().project(apply(pose, around))
        if not np.isfinite(pixels).all():
            return RenderedWindow((1.0, 1.0, 0.0, 0.0), (0, 0), np.zeros((1, 1)), np.full((1, 1), -1, dtype=np.int32))
        border = 0.15 * max(camera.width, camera.height)  # a distorted picture may show more than the ideal one
        largest = np.array([camera.width, camera.height]) + border
        low = np.floor(np.clip(pixels.min(axis=0) - margin_px, -border, largest)).astype(int)
        high = np.ceil(np.clip(pixels.max(axis=0) + margin_px, -border, largest)).astype(int)
        width, height = (int(v) for v in np.maximum(high - low, 1))
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        origin = (int(low[0]), int(low[1]))
        drawn = self.scenes[view].cropped(origin, width, height) if component is None and self.scenes else None
        if drawn is not None:
            return drawn
        inverse_depth, face = rasterise(apply(pose, vertices), faces, *lens, width, height, origin=origin)
        return RenderedWindow(lens, origin, inverse_depth, np.where(face >= 0, owner[np.maximum(face, 0)], -1))

    def visible(self, view: int, window: RenderedWindow, groups: Array, component: int = -1) -> NDArray[np.bool_]:
        """(N,) whether all points of each group (N,Q,3) are inside the photo and not hidden in the window.

        With ``component`` >= 0 the window must also show that component there.
        """
        stack = self.levels[0]
        return _all_visible(
            groups,
            stack.poses[view],
            stack.lenses[view],
            size=stack.sizes[view],
            ideal=np.array(window.lens),
            origin=np.array(window.origin),
            inverse_depth=window.inverse_depth,
            ids=window.ids,
            component=component,
        )


def load_views(sparse: SparseModel, model: Model) -> PhotoViews:
    """Read the photos of a reconstruction whose poses are in mm and in the frame of the model.

    Raises:
        InputError: there are fewer than three photos, a photo cannot be read, or its size differs from its camera's.
    """
    from arview.reconstruction import read_photo

    if len(sparse.photos) < 3:
        raise InputError(f"photos: {len(sparse.photos)} were placed; measuring in photos needs at least 3")

    def read(index: int) -> NDArray[np.uint8]:
        photo = sparse.photos[index]
        gray = np.asarray(cv2.cvtColor(read_photo(photo.path), cv2.COLOR_RGB2GRAY))
        if gray.shape != (photo.camera.height, photo.camera.width):
            raise InputError(
                f"{photo.path}: the photo has {gray.shape[1]}×{gray.shape[0]} px, its camera "
                f"{photo.camera.width}×{photo.camera.height}; reconstruct again from the photos as they are now"
            )
        return gray

    grays = list(pool().map(read, range(len(sparse.photos))))
    cameras = tuple(photo.camera for photo in sparse.photos)
    poses = np.stack([photo.cam_from_scan for photo in sparse.photos])
    return views_of(grays, cameras, poses, model, tuple(p.name for p in sparse.photos), sparse.pose_covariance)


def views_of(
    grays: list[NDArray[np.uint8]],
    cameras: tuple[Camera, ...],
    cam_from_model: Array,
    model: Model,
    names: tuple[str, ...],
    pose_covariance: Array | None = None,
) -> PhotoViews:
    """Views of grey pictures (H,W) uint8 that are already in memory; see `PhotoViews` for the other arguments."""
    levels = []
    for level in range(3):
        if level:
            grays = [
                np.asarray(cv2.resize(g, (g.shape[1] // 2, g.shape[0] // 2), interpolation=cv2.INTER_AREA))
                for g in grays
            ]
        sizes = np.array([[g.shape[1], g.shape[0]] for g in grays], dtype=np.int64)
        starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
        small = [c.scaled(int(w), int(h)) for c, (w, h) in zip(cameras, sizes, strict=True)]
        lenses = np.array([[c.fx, c.fy, c.cx, c.cy, *c.dist] for c in small], dtype=np.float64)
        pixels = np.concatenate([g.ravel() for g in grays])
        levels.append(PhotoStack(pixels, starts, sizes, lenses, np.ascontiguousarray(cam_from_model[:, :3])))
    return PhotoViews(model, names, cameras, cam_from_model, tuple(levels), pose_covariance)


def apply_all(cam_from_model: Array, point: Array) -> Array:
    """(M,3) a point (3,) in the frame of each of M cameras."""
    return np.asarray(cam_from_model[:, :3, :3] @ point + cam_from_model[:, :3, 3])


@kernel
def _all_visible(
    groups: NDArray[np.float64],
    pose: NDArray[np.float64],
    lens: NDArray[np.float64],
    size: NDArray[np.int64],
    ideal: NDArray[np.float64],
    origin: NDArray[np.int64],
    inverse_depth: NDArray[np.float64],
    ids: NDArray[np.int32],
    component: int,
) -> NDArray[np.bool_]:
    """(N,) whether all points of each group are inside the picture and not behind the rendered surface."""
    margin = 2.0
    height, width = inverse_depth.shape
    result = np.zeros(groups.shape[0], dtype=np.bool_)
    for i in range(groups.shape[0]):
        good = True
        for j in range(groups.shape[1]):
            point = groups[i, j]
            x = pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3]
            y = pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3]
            z = pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3]
            if z <= 1.0:
                good = False
                break
            x, y = x / z, y / z
            r2 = x * x + y * y
            radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
            u = lens[0] * (x * radial + 2 * lens[6] * x * y + lens[7] * (r2 + 2 * x * x)) + lens[2]
            v = lens[1] * (y * radial + lens[6] * (r2 + 2 * y * y) + 2 * lens[7] * x * y) + lens[3]
            if not (margin < u < size[0] - 1 - margin and margin < v < size[1] - 1 - margin):
                good = False
                break
            iu = int(np.round(ideal[0] * x + ideal[2])) - origin[0]
            iv = int(np.round(ideal[1] * y + ideal[3])) - origin[1]
            if iu < 0 or iv < 0 or iu >= width or iv >= height:
                good = False
                break
            # The depth of a surface inclined by up to 70° varies within a pixel by the width of a few pixels.
            if (component >= 0 and ids[iv, iu] != component) or z * inverse_depth[iv, iu] > 1.0 + 4.0 / ideal[0]:
                good = False
                break
        result[i] = good
    return result
