"""The photos in the form that the dense reconstruction uses: undistorted, cropped to the part, each with its sources.

A `DenseView` is an undistorted window of a photo, scaled to the working size. The inverse depth w = 1/z of a plane is
linear in its pixels, so a surface element is (w, dw/du, dw/dv) everywhere in this package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, invert
from arview.reconstruction.dense.options import SOURCES, DenseOptions
from arview.reconstruction.intake.masks import mask_of
from arview.reconstruction.types import PosedPhoto, SparseModel
from arview.rendering import rasterise

GOOD_ANGLE_DEG = (8.0, 25.0)
"""Angles between two views of a point that count fully. Smaller angles do not determine depth, and at larger ones the
surface looks different."""
MAX_ANGLE_DEG = 50.0
"""Views at a larger angle are no sources."""

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
Planes = NDArray[np.float32]
"""(H,W,3): inverse depth at the pixel, and its change per pixel along u and v; w = 0 where there is none."""

COARSEST = 4
"""Divisor of the windows' sides, so that pixels of the coarser levels are whole blocks."""
MARGIN_PX = 12
"""Margin around the region for the windows of the correlation."""


@dataclass(frozen=True)
class Cad:
    """The part's CAD model and its approximate pose ``scan_from_model`` (4,4), mm."""

    model: Model
    scan_from_model: Array


@dataclass(frozen=True)
class DenseView:
    """One photo, undistorted and cropped.

    Attributes:
        index: of the photo in the sparse model.
        name: of the photo.
        camera: ideal camera of the window: its size, no distortion.
        cam_from_scan: (4,4).
        color: (H,W,3) uint8 RGB.
        region: (H,W) bool, pixels to reconstruct.
        nearest, farthest: range of depth of the region's surfaces.
        sources: indices of the photos (later of the views) to compare with, best first.
    """

    index: int
    name: str
    camera: Camera
    cam_from_scan: Array
    color: Image
    region: NDArray[np.bool_]
    nearest: float
    farthest: float
    sources: tuple[int, ...]


def choose_sources(sparse: SparseModel) -> list[tuple[int, ...]]:
    """For each photo the photos to compare with, best first: many common points, seen from useful angles.

    Every choice lowers the score of photos close to it, so that the sources lie all around (after Schönberger 2016 and
    Goesele 2007). Photos without a source get an empty tuple.
    """
    count = len(sparse.photos)
    seen = np.zeros((count, len(sparse.points_in_scan)), dtype=bool)
    seen[sparse.observed_photo, sparse.observed_point] = True
    centres = np.stack([photo.centre_in_scan for photo in sparse.photos])
    low, high = GOOD_ANGLE_DEG
    score = np.zeros((count, count))
    apart = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            shared = sparse.points_in_scan[seen[i] & seen[j]]
            if len(shared) == 0:
                continue
            a, b = shared - centres[i], shared - centres[j]
            cosine = np.sum(a * b, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
            angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
            weights = np.clip(angle / low, 0.0, 1.0) ** 2
            weights *= np.clip((MAX_ANGLE_DEG - angle) / (MAX_ANGLE_DEG - high), 0.0, 1.0)
            score[i, j] = score[j, i] = weights.sum()
            apart[i, j] = apart[j, i] = np.median(angle)
    chosen: list[tuple[int, ...]] = []
    for i in range(count):
        left = score[i].copy()
        order: list[int] = []
        while len(order) < SOURCES and left.max() > 0.02 * score[i].max() > 0:
            best = int(np.argmax(left))
            order.append(best)
            left *= np.clip(np.where(apart[best] > 0, apart[best], 90.0) / low, 0.0, 1.0)
            left[best] = 0.0
        chosen.append(tuple(order))
    return chosen


def make_view(
    sparse: SparseModel,
    index: int,
    sources: tuple[int, ...],
    cad: Cad | None,
    options: DenseOptions,
    read: Callable[[PosedPhoto], Image],
) -> DenseView | None:
    """The window of one photo around the region to reconstruct; None if the photo does not show it.

    The region is the silhouette of the CAD widened by the band; without a CAD it is the hull of the visible sparse
    points.

    Raises:
        InputError: the photo cannot be read, or its size differs from its camera's.
    """
    photo = sparse.photos[index]
    ideal = photo.camera.without_distortion()
    if cad is not None:
        region, nearest, farthest = _cad_region(photo, cad, options.band_mm)
    else:
        region, nearest, farthest = _points_region(sparse, index)
    if not region.any():
        return None
    scale = min(1.0, float(np.sqrt(options.max_region_px / np.count_nonzero(region))))
    small = ideal.scaled(max(1, round(ideal.width * scale)), max(1, round(ideal.height * scale)))
    region = cv2.resize(region.astype(np.uint8), (small.width, small.height), interpolation=cv2.INTER_NEAREST) > 0
    u0, v0, width, height = _window(region)
    camera = Camera(width, height, small.fx, small.fy, small.cx - u0, small.cy - v0)
    image = read(photo)
    if image.shape[:2] != (photo.camera.height, photo.camera.width):
        raise InputError(
            f"{photo.path}: is {image.shape[1]}×{image.shape[0]} px, its camera {photo.camera.width}×"
            f"{photo.camera.height}; the photo may have been changed since the reconstruction began"
        )
    inside = np.zeros((height, width), dtype=bool)
    part = region[max(v0, 0) : v0 + height, max(u0, 0) : u0 + width]
    inside[max(-v0, 0) :, max(-u0, 0) :][: part.shape[0], : part.shape[1]] = part
    color, is_seen = _undistorted(image, photo.camera, camera)
    if photo.mask is not None:
        allowed = mask_of(photo.mask, photo.camera.width, photo.camera.height)
        grey = np.repeat(np.where(allowed, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
        is_seen &= _undistorted(grey, photo.camera, camera)[0][..., 0] > 127
    return DenseView(
        index,
        photo.name,
        camera,
        cam_from_scan=photo.cam_from_scan,
        color=color,
        region=inside & is_seen,
        nearest=nearest,
        farthest=farthest,
        sources=sources,
    )


def _window(region: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """(u0, v0, width, height) of the region with a margin, with sides that COARSEST divides."""
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    u0, v0 = int(columns[0]) - MARGIN_PX, int(rows[0]) - MARGIN_PX
    sides = [int(columns[-1]) + MARGIN_PX + 1 - u0, int(rows[-1]) + MARGIN_PX + 1 - v0]
    width, height = (COARSEST * -(-side // COARSEST) for side in sides)
    return u0, v0, width, height


def _undistorted(image: Image, camera: Camera, ideal: Camera) -> tuple[Image, NDArray[np.bool_]]:
    """The photo as the ideal camera sees it, and which of its pixels the photo covers."""
    if ideal.fx < 0.99 * camera.fx:
        camera = camera.scaled(round(camera.width * ideal.fx / camera.fx), round(camera.height * ideal.fy / camera.fy))
        image = np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
    v, u = np.mgrid[0 : ideal.height, 0 : ideal.width].astype(np.float64)
    x, y = camera.distort((u - ideal.cx) / ideal.fx, (v - ideal.cy) / ideal.fy)
    u, v = x * camera.fx + camera.cx, y * camera.fy + camera.cy
    is_seen = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    color = cv2.remap(
        image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(color), is_seen


def _cad_region(photo: PosedPhoto, cad: Cad, band_mm: float) -> tuple[NDArray[np.bool_], float, float]:
    """Region (H,W) and range of depth from the silhouette of the CAD."""
    camera = photo.camera
    inverse_depth, _ = render_cad(cad, photo.cam_from_scan, camera)
    seen = inverse_depth > 0
    if not seen.any():
        return seen, 1.0, 2.0
    nearest, farthest = 1.0 / inverse_depth.max() - band_mm, 1.0 / inverse_depth[seen].min() + band_mm
    reach_px = int(np.ceil(band_mm * camera.fx / np.median(1.0 / inverse_depth[seen])))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1, 2 * reach_px + 1))
    return cv2.dilate(seen.astype(np.uint8), disc) > 0, max(nearest, 1e-3 * farthest), farthest


def _points_region(sparse: SparseModel, index: int) -> tuple[NDArray[np.bool_], float, float]:
    """Region (H,W) and range of depth from the visible sparse points."""
    photo = sparse.photos[index]
    camera = photo.camera.without_distortion()
    region = np.zeros((camera.height, camera.width), dtype=np.uint8)
    pixels, depths = seen_points(sparse, index, camera)
    if len(pixels) < 3:
        return region > 0, 1.0, 2.0
    hull = cv2.convexHull(np.round(pixels).astype(np.int32))
    cv2.fillConvexPoly(region, hull, 1)
    nearest, farthest = np.percentile(depths, [1.0, 99.0])
    return region > 0, float(0.9 * nearest), float(1.1 * farthest)


def seen_points(sparse: SparseModel, index: int, camera: Camera) -> tuple[Array, Array]:
    """Pixels (N,2) in an ideal camera and depths (N,) of the sparse points observed in a photo."""
    points = sparse.points_in_scan[sparse.observed_point[sparse.observed_photo == index]]
    in_cam = apply(sparse.photos[index].cam_from_scan, points)
    in_cam = in_cam[in_cam[:, 2] > 0]
    return camera.project(in_cam), in_cam[:, 2]


def render_cad(cad: Cad, cam_from_scan: Array, camera: Camera) -> tuple[Array, NDArray[np.int32]]:
    """Inverse depth (H,W), 0 off the part, and face ids (H,W) of the CAD in an ideal camera."""
    vertices, faces, _ = cad.model.mesh
    return rasterise(
        apply(cam_from_scan @ cad.scan_from_model, vertices),
        faces,
        camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        width=camera.width,
        height=camera.height,
    )


def cad_planes(cad: Cad, cam_from_scan: Array, camera: Camera) -> Planes:
    """Planes (H,W,3) of the CAD's surface in an ideal camera; w = 0 off the part."""
    inverse_depth, face_ids = render_cad(cad, cam_from_scan, camera)
    vertices, faces, _ = cad.model.mesh
    corners = apply(cam_from_scan @ cad.scan_from_model, vertices)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    distance = np.sum(normals * corners[:, 0], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = normals[:, :2] / distance[:, None] / np.array([camera.fx, camera.fy])
    planes = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
    seen = face_ids >= 0
    planes[seen, 0] = inverse_depth[seen]
    planes[seen, 1:] = np.nan_to_num(slopes[face_ids[seen]], posinf=0.0, neginf=0.0)
    return planes


def sparse_planes(sparse: SparseModel, index: int, camera: Camera) -> Planes:
    """Planes through the triangles (Delaunay, in the image) of the sparse points observed in a photo; w = 0 outside."""
    from scipy.spatial import Delaunay, QhullError

    planes = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
    pixels, depths = seen_points(sparse, index, camera)
    if len(pixels) < 4:
        return planes
    try:
        triangles = Delaunay(pixels)
    except QhullError:
        return planes
    corners, w = pixels[triangles.simplices], 1.0 / depths[triangles.simplices]
    sides = corners[:, 1:] - corners[:, :1]
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
        rise = w[:, 1:] - w[:, :1]
        du = (rise[:, 0] * sides[:, 1, 1] - rise[:, 1] * sides[:, 0, 1]) / determinant
        dv = (rise[:, 1] * sides[:, 0, 0] - rise[:, 0] * sides[:, 1, 0]) / determinant
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    triangle = triangles.find_simplex(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)).reshape(u.shape)
    inside = (triangle >= 0) & np.isfinite(du + dv)[triangle]
    chosen = triangle[inside]
    at = np.stack([u[inside], v[inside]], axis=-1) - corners[chosen, 0]
    planes[inside, 0] = w[chosen, 0] + du[chosen] * at[:, 0] + dv[chosen] * at[:, 1]
    planes[inside, 1], planes[inside, 2] = du[chosen], dv[chosen]
    planes[planes[..., 0] <= 0] = 0.0
    return planes


def relative_pose(view: DenseView, source: DenseView) -> Array:
    """(4,4) ``source_from_view``."""
    return source.cam_from_scan @ invert(view.cam_from_scan)
