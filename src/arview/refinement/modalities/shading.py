"""Shading modality: refines the pose of a curved part by the brightness of its surface.

The outline of a smooth part changes little when the part turns, but the brightness of its surface does. Under distant
lights the brightness of a matt surface is a quadratic function of its normal (Basri & Jacobs, "Lambertian reflectance
and linear subspaces", PAMI 2003). The nine coefficients of this function, the light, are unknown and are estimated
together with the pose. The Gauss-Newton system of both is reduced to the pose by the Schur complement, so that only
brightness that no other light explains moves the pose, and is added to the information of edges and colours.
Highlights, print and occluders are outliers of a robust estimator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import edge_faces
from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.guideviews import Surface, draw_surface
from arview.refinement.gauss_newton import apply_twist, relative_twist

COEFFICIENTS = 9
"""Coefficients of a light: spherical harmonics up to the second order in a frame with x right, y down and z towards the
camera."""
RIM_PX = 2
"""Pixels closer than this to the border of the surface or to a jump in depth are not used."""
MAX_DEPTH_STEP = 0.12
"""Larger steps in depth between neighbouring pixels, in half diameters, are jumps."""
SMOOTH_COS = 0.2
"""Pixels are not used, either, where normals within ``RIM_PX`` have a smaller cosine: there the edge tells more."""
MIN_PIXELS = 60
"""Pixels of the surface needed."""
LIGHT_PRIOR = 1e-4
"""Regularisation of the light per pixel, towards no shading, because few normals determine a light only in part."""
MEAN_PRIOR = 1e-9
"""The same for the mean brightness, which is always determined."""
OUTLIER_SCALE = 2.0
"""Multiple of the median residual at which a pixel has a quarter of its weight."""
LIGHT_ROUNDS = 3
"""Updates of the light with robust weights before each update of the pose."""
MAX_TURN_RAD = 0.12
"""Largest rotation in one update."""
MIN_DEVIATION = 1.0
"""Smallest standard deviation of the brightness that is assumed, grey levels."""
MIN_RELATIVE_INFORMATION = 1e-9
"""Smallest eigenvalue of the normalised information with which a pose is updated."""
CREASE_DEG = 40.0
"""Faces that meet at a larger angle have an edge between them."""


RADIUS_PX = 26.0
"""Half diameter of the part in the reduced picture; smaller parts are not enlarged."""
REACH = 1.15
"""Half size of the crop, in half diameters of the part."""


@dataclass(frozen=True)
class ShadingOptions:
    """Options of the shading modality.

    Attributes:
        gain: weight of the shading relative to edges and colours, by the residual variance of the brightness.
        rounds: updates of the pose.
    """

    gain: float = 5.0
    rounds: int = 4


class ShadingCrop(NamedTuple):
    """Reduced picture around the part.

    Attributes:
        bright: (H,W) float32 grey levels.
        focal_px: (2,) focal lengths of the crop.
        center_px: (2,) principal point of the crop.
    """

    bright: NDArray[np.float32]
    focal_px: Array
    center_px: Array


class ShadedPose(NamedTuple):
    """Result of the refinement.

    Attributes:
        cam_from_body: (4,4) refined pose.
        information: (6,6) of edges, colours and shading.
        explained: share of the brightness' variance that the light explains; -1 where the pose was not refined.
    """

    cam_from_body: Array
    information: Array
    explained: float


def curved_share(surface: Surface, flat_deg: float = 0.5) -> float:
    """Share of a surface's area in faces that meet a neighbour at an angle that is neither flat nor an edge."""
    points, faces, normals = (np.asarray(part, dtype=np.float64) for part in surface[:3])
    corners = faces.astype(np.int64)
    edges = edge_faces(corners)
    one, other = edges.faces[edges.face_count > 1].T
    cosine = np.abs(np.sum(normals[one] * normals[other], axis=1))
    is_curved = (cosine < np.cos(np.deg2rad(flat_deg))) & (cosine > np.cos(np.deg2rad(CREASE_DEG)))
    curved = np.unique(np.concatenate([one[is_curved], other[is_curved]]))
    a, b, c = points[corners].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float(areas[curved].sum() / max(areas.sum(), 1e-12))


@kernel
def corner_normals(surface: Surface) -> NDArray[np.float32]:
    """Unit normals (F,3,3) float32 at the corners of the faces of a `Surface`.

    Each is the mean, weighted by area, of the normals of the faces around the corner that differ from the own one by
    less than ``CREASE_DEG``.
    """
    points, faces, normals, _ = surface
    count = len(faces)
    areas = np.empty(count)
    starts = np.zeros(len(points) + 1, dtype=np.int64)
    for i in range(count):
        areas[i] = np.linalg.norm(
            np.cross(points[faces[i, 1]] - points[faces[i, 0]], points[faces[i, 2]] - points[faces[i, 0]])
        )
        for k in range(3):
            starts[faces[i, k] + 1] += 1
    starts = np.cumsum(starts)
    filled = starts[:-1].copy()
    around = np.empty(3 * count, dtype=np.int64)
    for i in range(count):
        for k in range(3):
            around[filled[faces[i, k]]] = i
            filled[faces[i, k]] += 1
    min_cosine = np.cos(np.deg2rad(CREASE_DEG))
    smooth = np.empty((count, 3, 3), dtype=np.float32)
    for i in range(count):
        for k in range(3):
            x, y, z = 0.0, 0.0, 0.0
            for other in around[starts[faces[i, k]] : starts[faces[i, k] + 1]]:
                a, b = normals[i], normals[other]
                if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > min_cosine:
                    x, y, z = x + areas[other] * b[0], y + areas[other] * b[1], z + areas[other] * b[2]
            size = np.sqrt(x * x + y * y + z * z) + 1e-30
            smooth[i, k, 0], smooth[i, k, 1], smooth[i, k, 2] = x / size, y / size, z / size
    return smooth


def crop_for_shading(
    gray: NDArray[np.uint8], camera: Camera, diameter_mm: float, cam_from_body: Array
) -> ShadingCrop | None:
    """Reduced picture around the part for `refine_by_shading`; None where the part is not in the picture.

    Args:
        gray: (H,W) uint8 of the camera's size.
        camera: camera of the picture. Its distortion moves the part as a whole; within the part it is neglected.
        diameter_mm: diameter of the part.
        cam_from_body: (4,4) rough pose.
    """
    place = cam_from_body[:3, 3]
    center = camera.project(place)
    if place[2] <= 0.0 or not np.all(np.isfinite(center)):
        return None
    radius_px = 0.5 * diameter_mm * camera.fx / float(np.linalg.norm(place))
    limits = np.array([camera.width, camera.height])
    first = np.clip(np.floor(center - REACH * radius_px), 0, limits).astype(int)
    last = np.clip(np.ceil(center + REACH * radius_px), 0, limits).astype(int)
    scale = min(1.0, RADIUS_PX / radius_px)
    size = np.round(scale * (last - first)).astype(int)
    if np.any(size < 2 * RIM_PX + 4):
        return None
    zoom = size / (last - first)
    crop = gray[first[1] : last[1], first[0] : last[0]]
    bright = cv2.resize(crop, tuple(size.tolist()), interpolation=cv2.INTER_AREA).astype(np.float32)
    focal_px = zoom * (camera.fx, camera.fy)
    return ShadingCrop(bright, focal_px, (center - first + 0.5) * zoom - 0.5 - focal_px * place[:2] / place[2])


@kernel
def refine_by_shading(
    crop: ShadingCrop,
    surface: Surface,
    corners: NDArray[np.float32],
    diameter_mm: float,
    cam_from_body: NDArray[np.float64],
    information: NDArray[np.float64],
    gain: float,
    rounds: int,
) -> ShadedPose:
    """Refine a pose by the shading of the part's surface, see `ShadedPose`.

    Args:
        crop: `ShadingCrop` of the picture.
        surface: `Surface` of the part, in the body frame.
        corners: (F,3,3) see `corner_normals`.
        diameter_mm: diameter of the part.
        cam_from_body, information: (4,4) the best pose by edges and colours, and its (6,6) information.
        gain: weight of the shading relative to that information.
        rounds: updates of the pose.

    Returns:
        The pose and information as they were, with -1, where too little of the surface is visible or the pose is not
        determined.
    """
    bright, focal_px, middle_px = crop.bright, crop.focal_px, crop.center_px
    pose = cam_from_body.copy()
    best = information.copy()
    light = np.zeros(COEFFICIENTS)
    explained = -1.0
    drawn = np.empty((4, bright.shape[0], bright.shape[1]), dtype=np.float32)
    face_ids = np.empty(bright.shape, dtype=np.int32)
    center_px = np.empty(2)
    for _ in range(rounds):
        if pose[2, 3] <= 0.0:
            return ShadedPose(cam_from_body.copy(), information.copy(), -1.0)
        for k in range(2):
            center_px[k] = middle_px[k] + focal_px[k] * pose[k, 3] / pose[2, 3]
        draw_surface(surface, pose, focal_px, center_px, diameter_mm, drawn, face_ids)
        _smooth_normals(
            drawn,
            face_ids,
            surface,
            corners=corners,
            pose=pose,
            focal_px=focal_px,
            middle_px=middle_px,
            diameter_mm=diameter_mm,
        )
        places = _inner_pixels(drawn, face_ids)
        if len(places) < MIN_PIXELS:
            return ShadedPose(cam_from_body.copy(), information.copy(), -1.0)
        values = np.empty(len(places))
        functions = np.empty((len(places), COEFFICIENTS))
        for i in range(len(places)):
            v, u = places[i]
            values[i] = bright[v, u]
            _harmonics(drawn[0, v, u], drawn[1, v, u], drawn[2, v, u], functions[i])
        light, weights = _fit_light(values, functions, light, explained >= 0.0)
        motion = _jacobian(
            places,
            light,
            drawn,
            face_ids=face_ids,
            pose=pose,
            focal_px=focal_px,
            middle_px=middle_px,
            diameter_mm=diameter_mm,
        )
        hessian, gradient, explained = _reduce_system(motion, functions, values, weights, light)
        best = information + gain * hessian
        if not _is_determined(best):
            return ShadedPose(cam_from_body.copy(), information.copy(), -1.0)
        slope = np.dot(information, relative_twist(cam_from_body, pose)) + gain * gradient
        step = -np.linalg.solve(best, slope)
        turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if turn > MAX_TURN_RAD:
            step *= MAX_TURN_RAD / turn
        pose = apply_twist(pose, step)
    return ShadedPose(pose, best, explained)


@kernel
def _is_determined(information: NDArray[np.float64]) -> bool:
    """Whether information (6,6), normalised to a unit diagonal, determines all six directions."""
    sizes = np.sqrt(np.maximum(np.diag(information), 0.0))
    if not np.all(np.isfinite(information)) or sizes.min() == 0.0:
        return False
    return np.linalg.eigvalsh(information / np.outer(sizes, sizes))[0] > MIN_RELATIVE_INFORMATION


@kernel
def _smooth_normals(
    drawn: NDArray[np.float32],
    face_ids: NDArray[np.int32],
    surface: Surface,
    corners: NDArray[np.float32],
    pose: NDArray[np.float64],
    focal_px: NDArray[np.float64],
    middle_px: NDArray[np.float64],
    diameter_mm: float,
) -> None:
    """Replace the normals of the faces by interpolated normals of their corners (Phong, CACM 1975), in place."""
    points, faces = surface[0], surface[1]
    place, normal = np.empty(3), np.empty(3)
    for v in range(face_ids.shape[0]):
        for u in range(face_ids.shape[1]):
            face = face_ids[v, u]
            if face < 0:
                continue
            depth = pose[2, 3] + 0.5 * diameter_mm * drawn[3, v, u]
            x = (u - middle_px[0]) / focal_px[0] * depth - pose[0, 3]
            y = (v - middle_px[1]) / focal_px[1] * depth - pose[1, 3]
            z = depth - pose[2, 3]
            for k in range(3):
                place[k] = pose[0, k] * x + pose[1, k] * y + pose[2, k] * z
            a, b, c = points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]]
            bb, bc, cc, pb, pc = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                to_b, to_c, to_p = b[k] - a[k], c[k] - a[k], place[k] - a[k]
                bb, bc, cc = bb + to_b * to_b, bc + to_b * to_c, cc + to_c * to_c
                pb, pc = pb + to_p * to_b, pc + to_p * to_c
            size = bb * cc - bc * bc
            if size <= 0.0:
                continue
            at_b = min(max((cc * pb - bc * pc) / size, 0.0), 1.0)
            at_c = min(max((bb * pc - bc * pb) / size, 0.0), 1.0 - at_b)
            own = corners[face]
            for k in range(3):
                normal[k] = (1.0 - at_b - at_c) * own[0, k] + at_b * own[1, k] + at_c * own[2, k]
            x = pose[0, 0] * normal[0] + pose[0, 1] * normal[1] + pose[0, 2] * normal[2]
            y = pose[1, 0] * normal[0] + pose[1, 1] * normal[1] + pose[1, 2] * normal[2]
            z = -(pose[2, 0] * normal[0] + pose[2, 1] * normal[1] + pose[2, 2] * normal[2])
            size = np.sqrt(x * x + y * y + z * z)
            if size < 1e-6:
                continue
            # Faces are drawn with normals that point to the camera.
            if x * drawn[0, v, u] + y * drawn[1, v, u] + z * drawn[2, v, u] < 0.0:
                size = -size
            drawn[0, v, u], drawn[1, v, u], drawn[2, v, u] = x / size, y / size, z / size


@kernel
def _inner_pixels(drawn: NDArray[np.float32], face_ids: NDArray[np.int32]) -> NDArray[np.int64]:
    """Rows and columns (N,2) of the pixels inside the surface, away from its border, jumps in depth and edges."""
    height, width = face_ids.shape
    places = np.empty((height * width, 2), dtype=np.int64)
    count = 0
    for v in range(RIM_PX, height - RIM_PX):
        for u in range(RIM_PX, width - RIM_PX):
            if face_ids[v, u] < 0 or face_ids[v - RIM_PX, u] < 0 or face_ids[v + RIM_PX, u] < 0:
                continue
            is_inner = True
            for y in range(v - RIM_PX, v + RIM_PX + 1):
                for x in range(u - RIM_PX, u + RIM_PX + 1):
                    jump = abs(drawn[3, y, x] - drawn[3, v, u])
                    cosine = 0.0
                    for k in range(3):
                        cosine += drawn[k, y, x] * drawn[k, v, u]
                    if face_ids[y, x] < 0 or jump > MAX_DEPTH_STEP * (abs(y - v) + abs(x - u)) or cosine < SMOOTH_COS:
                        is_inner = False
            if is_inner:
                places[count, 0], places[count, 1] = v, u
                count += 1
    return places[:count]


@kernel(inline=True)
def _harmonics(x: float | np.float32, y: float | np.float32, z: float | np.float32, out: NDArray[np.float64]) -> None:
    """Write the spherical harmonics of a normal (x right, y down, z towards the camera) to ``out`` (9,)."""
    out[0], out[1], out[2], out[3] = 1.0, x, y, z
    out[4], out[5], out[6], out[7], out[8] = x * y, x * z, y * z, x * x - y * y, 3.0 * z * z - 1.0


@kernel
def _fit_light(
    values: NDArray[np.float64], functions: NDArray[np.float64], light: NDArray[np.float64], is_known: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Light (9,) that explains grey levels (N,) best, and their robust weights (N,) (Geman & McClure).

    Args:
        values: (N,) grey levels.
        functions: (N,9) harmonics of their normals.
        light: (9,) last estimate, from which the first weights are computed if ``is_known``.
    """
    weights = np.ones(len(values))
    if is_known:
        _weigh(values - np.dot(functions, light), weights)
    for _ in range(LIGHT_ROUNDS):
        weighted = functions * weights.reshape(-1, 1)
        products, sums = np.dot(weighted.T, functions), np.dot(weighted.T, values)
        total = weights.sum()
        for k in range(COEFFICIENTS):
            products[k, k] += (LIGHT_PRIOR if k > 0 else MEAN_PRIOR) * total
        light = np.linalg.solve(products, sums)
        _weigh(values - np.dot(functions, light), weights)
    return light, weights


@kernel
def _weigh(residuals: NDArray[np.float64], weights: NDArray[np.float64]) -> None:
    """Fill the robust weights (N,) of residuals (N,)."""
    scale = MIN_DEVIATION + OUTLIER_SCALE * np.median(np.abs(residuals))
    for i in range(len(residuals)):
        weights[i] = 1.0 / (1.0 + (residuals[i] / scale) ** 2) ** 2


@kernel
def _jacobian(
    places: NDArray[np.int64],
    light: NDArray[np.float64],
    drawn: NDArray[np.float32],
    face_ids: NDArray[np.int32],
    pose: NDArray[np.float64],
    focal_px: NDArray[np.float64],
    middle_px: NDArray[np.float64],
    diameter_mm: float,
) -> NDArray[np.float64]:
    """Derivative (N,6) of the brightness at each pixel with respect to the twist, see `gauss_newton`.

    A moved surface shows another of its points at a pixel, and the normal of that point is turned.
    """
    height, width = face_ids.shape
    shading = np.zeros((height, width))
    functions = np.empty(COEFFICIENTS)
    for v in range(height):
        for u in range(width):
            if face_ids[v, u] >= 0:
                _harmonics(drawn[0, v, u], drawn[1, v, u], drawn[2, v, u], functions)
                for k in range(COEFFICIENTS):
                    shading[v, u] += light[k] * functions[k]
    jacobian = np.empty((len(places), 6))
    in_camera = np.empty((3, 3))
    moved, point, slope, normal = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(places)):
        v, u = places[i]
        right = 0.5 * (shading[v, u + 1] - shading[v, u - 1]) * focal_px[0]
        down = 0.5 * (shading[v + 1, u] - shading[v - 1, u]) * focal_px[1]
        x, y, z = drawn[0, v, u], drawn[1, v, u], drawn[2, v, u]
        depth = pose[2, 3] + 0.5 * diameter_mm * drawn[3, v, u]
        along_x, along_y = (u - middle_px[0]) / focal_px[0], (v - middle_px[1]) / focal_px[1]
        # Columns in the camera's frame: derivative by the point, the point itself, derivative by the normal.
        in_camera[0, 0], in_camera[1, 0] = -right / depth, -down / depth
        in_camera[2, 0] = (right * along_x + down * along_y) / depth
        in_camera[0, 1], in_camera[1, 1] = along_x * depth - pose[0, 3], along_y * depth - pose[1, 3]
        in_camera[2, 1] = depth - pose[2, 3]
        in_camera[0, 2] = light[1] + light[4] * y + light[5] * z + 2.0 * light[7] * x
        in_camera[1, 2] = light[2] + light[4] * x + light[6] * z - 2.0 * light[7] * y
        in_camera[2, 2] = -(light[3] + light[5] * x + light[6] * y + 6.0 * light[8] * z)
        for a in range(3):
            moved[a] = pose[0, a] * in_camera[0, 0] + pose[1, a] * in_camera[1, 0] + pose[2, a] * in_camera[2, 0]
            point[a] = pose[0, a] * in_camera[0, 1] + pose[1, a] * in_camera[1, 1] + pose[2, a] * in_camera[2, 1]
            slope[a] = pose[0, a] * in_camera[0, 2] + pose[1, a] * in_camera[1, 2] + pose[2, a] * in_camera[2, 2]
            normal[a] = pose[0, a] * x + pose[1, a] * y - pose[2, a] * z
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            jacobian[i, a] = point[b] * moved[c] - point[c] * moved[b] + normal[b] * slope[c] - normal[c] * slope[b]
            jacobian[i, 3 + a] = moved[a]
    return jacobian


@kernel
def _reduce_system(
    motion: NDArray[np.float64],
    functions: NDArray[np.float64],
    values: NDArray[np.float64],
    weights: NDArray[np.float64],
    light: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """System (6,6), (6,) of the pose with the light eliminated, and the share of the variance that is explained.

    The system is divided by the residual variance of the brightness.
    """
    left = values - np.dot(functions, light)
    total = weights.sum()
    weighted = motion * weights.reshape(-1, 1)
    hessian, gradient = np.dot(weighted.T, motion), -np.dot(weighted.T, left)
    across = np.dot(weighted.T, functions)
    weighted = functions * weights.reshape(-1, 1)
    products, sums = np.dot(weighted.T, functions), np.dot(weighted.T, left)
    for k in range(COEFFICIENTS):
        prior = LIGHT_PRIOR * total if k > 0 else MEAN_PRIOR * total
        products[k, k] += prior
        sums[k] -= prior * light[k]
    solved = np.linalg.solve(products, np.ascontiguousarray(across.T))
    mean = (weights * values).sum() / total
    variance = MIN_DEVIATION**2 + (weights * left * left).sum() / total
    spread = MIN_DEVIATION**2 + (weights * (values - mean) ** 2).sum() / total
    explained = 1.0 - variance / spread
    # A surface whose brightness is explained badly is hardly the part.
    share = max(explained, 0.0) ** 2 / variance
    hessian = share * (hessian - np.dot(across, solved))
    gradient = share * (gradient + np.dot(solved.T, sums))
    return hessian, gradient, explained
