"""Propagation of the covariance of the camera poses to components and datums."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Model
from arview.camera import Camera
from arview.core.parallel import pool
from arview.errors import InputError
from arview.geometry import Array, apply
from arview.measurement.datums.alignment import Alignment
from arview.measurement.datums.equations import DatumEquations, point_from_move
from arview.reconstruction import PosedPhoto, SparseModel
from arview.rendering import ZBufferRenderer

DRAWN_PX = 500
"""Longer side at which the model is rendered to find out which photo shows which point."""


def shifts_from_poses(
    points: Array, photos: Sequence[PosedPhoto], sees: NDArray[np.bool_], has_lenses: bool = False
) -> Array:
    """(N,3,6M) derivative of triangulated points (N,3) by left twists of the photos' poses; with lenses (N,3,9M).

    The pixels of a point are fixed while the poses change. With P_v the projector across its ray in view v, divided by
    the squared distance, δx = (Σ P_v)⁻¹ Σ P_v δx_v, where δx_v = −Rᵀ (ω × y + t) for the point y in the camera and a
    twist (ω, t). A change of the lens, as `SparseModel.lens_covariance` has it, turns the ray instead.

    Args:
        points: in the frame and unit of the poses.
        photos: M placed photos.
        sees: (N,M) which photo shows which point; points shown by fewer than two have derivative zero.
        has_lenses: whether each photo has a lens of its own.
    """
    count, size = len(photos), 9 if has_lenses else 6
    total, parts = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, size * count))
    for view, photo in enumerate(photos):
        rotation, in_cam = photo.cam_from_scan[:3, :3], apply(photo.cam_from_scan, points)
        square = np.sum(in_cam**2, axis=1)
        ray = in_cam @ rotation / np.sqrt(square)[:, None]
        across = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) * (sees[:, view] / square)[:, None, None]
        by_unknown = np.zeros((len(points), 3, size))
        by_unknown[:, :, :6] = point_from_move(in_cam)[:, :, :6]
        if has_lenses:
            camera, depth = photo.camera, in_cam[:, 2]
            by_unknown[:, :2, 6] = in_cam[:, :2]
            by_unknown[:, 0, 7] = depth * max(camera.width, camera.height) / camera.fx
            by_unknown[:, 1, 8] = depth * max(camera.width, camera.height) / camera.fy
        parts[:, :, size * view : size * (view + 1)] = -across @ rotation.T @ by_unknown
        total += across
    good = sees.sum(axis=1) >= 2
    parts[good] = np.linalg.solve(total[good], parts[good])
    parts[~good] = 0.0
    return parts


DrawnViews = Sequence[tuple[Camera, NDArray[np.float32]]]
"""Camera and depth (H,W) of the model as each photo shows it, reduced."""


def drawn_views(sparse: SparseModel, model: Model) -> DrawnViews:
    """The model drawn as photos posed in its frame show it."""

    def drawn(photo: PosedPhoto) -> tuple[Camera, NDArray[np.float32]]:
        shrink = min(1.0, DRAWN_PX / max(photo.camera.width, photo.camera.height))
        size = (round(photo.camera.width * shrink), round(photo.camera.height * shrink))
        camera = photo.camera.without_distortion().scaled(*size)
        return camera, ZBufferRenderer(model, camera).render(photo.cam_from_scan).depth_mm

    return list(pool().map(drawn, sparse.photos))


def visibility(points: Array, normals: Array, sparse: SparseModel, drawn: DrawnViews) -> NDArray[np.bool_]:
    """(N,M) which photos, posed in the model's frame and drawn, show surface points (N,3) with normals (N,3)."""

    def seen_in(photo: PosedPhoto, camera: Camera, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        in_cam = apply(photo.cam_from_scan, points)
        pixels = camera.project(in_cam)
        last = np.array([camera.width, camera.height]) - 1
        inside = np.all(np.isfinite(pixels) & (pixels >= 0) & (pixels <= last), axis=1)
        u, v = np.round(np.where(inside[:, None], pixels, 0.0)).astype(np.intp).T
        facing = np.sum(normals * (photo.centre_in_scan - points), axis=1) > 0.2 * np.linalg.norm(in_cam, axis=1)
        near = np.abs(depth[v, u] - in_cam[:, 2]) < 4.0 * in_cam[:, 2] / camera.fx
        return np.asarray(inside & facing & near)

    return np.stack([seen_in(photo, *one) for photo, one in zip(sparse.photos, drawn, strict=True)], axis=1)


def surface_points(component: Component, count: int, seed: int = 0) -> tuple[Array, Array]:
    """``count`` random points (N,3) on a component's surface, evenly by area, with unit normals (N,3)."""
    rng = np.random.default_rng(seed)
    corners = component.vertices_in_model[component.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    faces = rng.choice(len(areas), size=count, p=areas / areas.sum())
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    points = np.einsum("nc,ncx->nx", np.stack([1 - u, u * (1 - v), u * v], axis=1), corners[faces])
    return points, doubled[faces] / areas[faces][:, None]


class PosePropagation:
    """Effect of the joint covariance of the camera poses on components, relative to the datums.

    A common change of scale is removed: the scale is measured in the same photos and has a contribution of its own.
    """

    def __init__(
        self,
        sparse: SparseModel,
        model: Model,
        alignment: Alignment,
        base: Sequence[str],
        points: int = 60,
        used: Callable[[str | None], NDArray[np.bool_]] | None = None,
    ) -> None:
        """Compute the derivative of scale and datum frame by the poses.

        Args:
            sparse: in mm in the model's frame, with a ``pose_covariance``.
            model: the nominal CAD.
            alignment: the datum frame.
            base: components that determine the scale; empty for all.
            points: points used on each component.
            used: which photos (M,) a component is measured in, and with None the datums; default: all of them.
        """
        if sparse.pose_covariance is None:
            raise InputError("uncertainty: the reconstruction has no covariance of its poses; reconstruct again")
        self.sparse, self.model, self.alignment, self.count = sparse, model, alignment, points
        self._drawn = drawn_views(sparse, model)
        self.has_lenses = sparse.lens_covariance is not None
        self.covariance = sparse.pose_covariance if sparse.lens_covariance is None else sparse.lens_covariance
        self.used = used or (lambda name: np.ones(len(sparse.photos), dtype=np.bool_))
        names = base or [component.name for component in model.components]
        arms, shifts = [], []
        for name in names:
            places, moved = self._shifts(model.component(name))
            arms.append(point_from_move(places - alignment.origin_in_model))
            shifts.append(moved)
        rows, moved = np.concatenate(arms).reshape(-1, 7), np.concatenate(shifts)
        self.by_scale = np.linalg.lstsq(rows, moved.reshape(len(rows), -1), rcond=1e-10)[0][6]
        self.frame = self._frame(alignment)

    def _frame(self, alignment: Alignment) -> Array:
        """(7,6M) derivative of a datum frame by the poses."""
        frame = np.zeros((7, len(self.covariance)))
        for one, gain in zip(alignment.equations, alignment.gains, strict=True):
            frame += gain @ self.offsets(one)
        return frame

    def relative_to(self, alignment: Alignment) -> PosePropagation:
        """The same relative to another datum frame about the same origin."""
        other = copy.copy(self)
        other.alignment, other.frame = alignment, self._frame(alignment)
        return other

    def covariance_of(self, component: Component, center: Array) -> Array:
        """(6,6) covariance of a component's twist about its centre (3,), relative to the datum frame."""
        by_poses = self.twist(component, center) - self.alignment.twist_from_move(center) @ self.frame
        return np.asarray(by_poses @ self.covariance @ by_poses.T)

    def twist(self, component: Component, center: Array) -> Array:
        """(6,6M) derivative of a component's twist by the poses, with the change of scale removed."""
        points, moved = self._shifts(component)
        moved = moved - (points - self.alignment.origin_in_model)[:, :, None] * self.by_scale
        rows = point_from_move(points - center)[:, :, :6].reshape(-1, 6)
        unit = np.array([float(np.ptp(points, axis=0).max()) or 1.0] * 3 + [1.0] * 3)
        return np.linalg.lstsq(rows / unit, moved.reshape(len(rows), -1), rcond=1e-3)[0] / unit[:, None]

    def offsets(self, one: DatumEquations) -> Array:
        """(N,6M) derivative of a datum's offsets by the poses, with the change of scale removed."""
        origin, rows, points = self.alignment.origin_in_model, one.rows, one.points
        if one.feature == "fit":
            center = points[0]
            arms = rows[:, :3] - np.cross(center, rows[:, 3:6])
            name = min(self.model.components, key=lambda c: float(np.linalg.norm(c.centroid_in_model - center)))
            return np.concatenate([arms, rows[:, 3:6]], axis=1) @ self.twist(name, center)
        normals = rows[:, 3:6]
        # Neighbouring points of a datum are visible in much the same photos, so some of them represent the others.
        step = max(1, len(points) // 40)
        some = np.arange(0, len(points), step)
        toward = np.mean([p.centre_in_scan for p in self.sparse.photos], axis=0) - points[some].mean(axis=0)
        facing = np.tile(toward / np.linalg.norm(toward), (len(some), 1))
        sees = visibility(points[some], facing, self.sparse, self._drawn) & self.used(None)
        moved = shifts_from_poses(points[some], self.sparse.photos, sees, self.has_lenses)
        apart = np.linalg.norm(points[:, None] - points[some][None], axis=2)
        apart[:, sees.sum(axis=1) < 2] = np.inf
        if not np.isfinite(apart).any():
            return np.zeros((len(points), moved.shape[2]))
        nearest = np.argmin(apart, axis=1)
        result = np.einsum("ni,nik->nk", normals, moved[nearest])
        stretch = np.einsum("ni,ni->n", normals, points - origin)
        return result - stretch[:, None] * self.by_scale

    def _shifts(self, component: Component) -> tuple[Array, Array]:
        """Visible points of a component, and their derivative by the poses."""
        points, normals = surface_points(component, 3 * self.count)
        sees = visibility(points, normals, self.sparse, self._drawn) & self.used(component.name)
        kept = np.flatnonzero(sees.sum(axis=1) >= 2)[: self.count]
        if len(kept) < 3:
            return points[:3], np.zeros((3, 3, len(self.covariance)))
        return points[kept], shifts_from_poses(points[kept], self.sparse.photos, sees[kept], self.has_lenses)
