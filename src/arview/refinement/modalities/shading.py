"""Shading modality: the brightness of a part's surface says how it is turned where its outline hardly does.

The outline of a smooth part turns little with the part; the bright and dark places of its surface do. Under far lights
the brightness of a matt surface is a quadratic function of its normal (Basri and Jacobs, "Lambertian reflectance and
linear subspaces", PAMI 2003). Its nine coefficients, the light, are unknown; they are found together with the pose, and
only what no other light could explain as well moves the pose. Own here: the Gauss–Newton system of both, reduced to
the pose and added to what edges and colours know of it; shine, print and what hides the part are outliers.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.guideviews.surface import Surface, draw_surface
from arview.refinement.gauss_newton import apply_twist, relative_twist

COEFFICIENTS = 9
"""Of a light: spherical harmonics up to the second order, in the camera's frame, y down and z towards the camera."""
RADIUS_PX = 26.0
"""Half the part's diameter in the picture that is looked at; nothing is enlarged."""
REACH = 1.15
"""It shows so much around the part, in half diameters."""
RIM_PX = 2
"""So near to the surface's end, or to a jump in depth, its pixels are not looked at."""
JUMP = 0.12
"""In half diameters per pixel."""
SMOOTH_COS = 0.2
"""Nor where the surface turns by more over that way: beside an edge brightness says less than the edge itself."""
FEWEST_PIXELS = 60
"""Of fewer nothing is told."""
GAIN = 5.0
"""Of the system beside those of edges and colours, by the variance of what is left of the brightness."""
PRIOR = 1e-4
"""Of every pixel so much speaks for no shading: few normals leave some of a light open."""
OUTLYING = 2.0
"""Median deviations at which a pixel counts a quarter."""
ROUNDS, FITS = 4, 3
"""Of the pose; of the light before each, with what it does not explain counting less and less."""
LARGEST_TURN_RAD = 0.12
"""Of one round."""
LEAST_DEVIATION = 1.0
"""Grey levels: nothing is explained better than this."""
LEAST_DETERMINED = 1e-9
"""Least information along any direction, against that along the others, with which a pose is moved."""


CREASE_DEG = 40.0
"""Surfaces that meet at more than this have an edge between them."""
LEAST_CURVED, FLAT_DEG = 0.2, 0.5
"""With less of its surface curved, by more than that angle from face to face, a part's shading is not looked at: flat
faces tell nothing that the light could not be the reason of."""


class LookedAt(NamedTuple):
    """The part of a picture that a pose shows the part in, made small.

    Attributes:
        bright: (H,W) float32 grey levels.
        focal_px: (2,) of it; center_px: (2,) the principal point.
    """

    bright: NDArray[np.float32]
    focal_px: Array
    center_px: Array


def curved_share(surface: Surface) -> float:
    """Share of a surface's area in faces that another one joins at an angle that is neither flat nor an edge."""
    points, faces, normals = (np.asarray(part, dtype=np.float64) for part in surface[:3])
    corners = faces.astype(np.int64)
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    owners = np.tile(np.arange(len(corners)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owners = edges[order], owners[order]
    joined = np.flatnonzero(np.all(edges[1:] == edges[:-1], axis=1))
    one, other = owners[joined], owners[joined + 1]
    cosine = np.abs(np.sum(normals[one] * normals[other], axis=1))
    is_curved = (cosine < np.cos(np.deg2rad(FLAT_DEG))) & (cosine > np.cos(np.deg2rad(CREASE_DEG)))
    curved = np.unique(np.concatenate([one[is_curved], other[is_curved]]))
    a, b, c = points[corners].transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float(areas[curved].sum() / max(areas.sum(), 1e-12))


@kernel
def corner_normals(surface):  # type: ignore[no-untyped-def]
    """Unit normals (F,3,3) float32 at the corners of a surface's faces: the mean of those around that go on smoothly.

    Weighted by area; faces that meet at more than CREASE_DEG do not count as one surface.
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
    least = np.cos(np.deg2rad(CREASE_DEG))
    smooth = np.empty((count, 3, 3), dtype=np.float32)
    for i in range(count):
        for k in range(3):
            x, y, z = 0.0, 0.0, 0.0
            for other in around[starts[faces[i, k]] : starts[faces[i, k] + 1]]:
                a, b = normals[i], normals[other]
                if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > least:
                    x, y, z = x + areas[other] * b[0], y + areas[other] * b[1], z + areas[other] * b[2]
            size = np.sqrt(x * x + y * y + z * z) + 1e-30
            smooth[i, k, 0], smooth[i, k, 1], smooth[i, k, 2] = x / size, y / size, z / size
    return smooth


def look_at(gray: NDArray[np.uint8], camera: Camera, diameter_mm: float, cam_from_body: Array) -> LookedAt | None:
    """What `shade` looks at; None where the part is not in the picture.

    Args:
        gray: (H,W) of the camera's size.
        camera: of it; its distortion counts by the place of the part's centre, not within the part.
        diameter_mm: of the part.
        cam_from_body: (4,4), roughly.
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
    return LookedAt(bright, focal_px, (center - first + 0.5) * zoom - 0.5 - focal_px * place[:2] / place[2])


@kernel
def shade(  # type: ignore[no-untyped-def]
    bright, focal_px, middle_px, surface, corners, diameter_mm, cam_from_body, information, gain
):
    """A pose refined by the shading of the part's surface, beside what else is known of it.

    Args:
        bright, focal_px, middle_px: see `LookedAt`.
        surface: of the part, a `Surface` about the origin of the body; corners: see `corner_normals`.
        diameter_mm: of the part.
        cam_from_body: (4,4); information: (6,6) of it, from edges and colours, that it is the best of.
        gain: of the shading beside that.

    Returns:
        ``cam_from_body`` (4,4) and information (6,6) with the shading's, and the share of the brightness of the
        surface that is explained; as before, and -1, where too little of the surface is seen, or nothing determines
        the pose.
    """
    pose = cam_from_body.copy()
    best = information.copy()
    light = np.zeros(COEFFICIENTS)
    explained = -1.0
    drawn = np.empty((4, bright.shape[0], bright.shape[1]), dtype=np.float32)
    face_ids = np.empty(bright.shape, dtype=np.int32)
    center_px = np.empty(2)
    for _ in range(ROUNDS):
        if pose[2, 3] <= 0.0:
            return cam_from_body.copy(), information.copy(), -1.0
        for k in range(2):
            center_px[k] = middle_px[k] + focal_px[k] * pose[k, 3] / pose[2, 3]
        draw_surface(surface, pose, focal_px, center_px, diameter_mm, drawn, face_ids)
        _smooth(drawn, face_ids, surface, corners, pose, focal_px, middle_px, diameter_mm)
        places = _inner_places(drawn, face_ids)
        if len(places) < FEWEST_PIXELS:
            return cam_from_body.copy(), information.copy(), -1.0
        values = np.empty(len(places))
        functions = np.empty((len(places), COEFFICIENTS))
        for i in range(len(places)):
            v, u = places[i]
            values[i] = bright[v, u]
            _functions(drawn[0, v, u], drawn[1, v, u], drawn[2, v, u], functions[i])
        light, weights = _fitted_light(values, functions, light, explained >= 0.0)
        motion = _motion(places, light, drawn, face_ids, pose, focal_px, middle_px, diameter_mm)
        hessian, gradient, explained = _reduced(motion, functions, values, weights, light)
        best = information + gain * hessian
        if not _determines(best):
            return cam_from_body.copy(), information.copy(), -1.0
        slope = np.dot(information, relative_twist(cam_from_body, pose)) + gain * gradient
        step = -np.linalg.solve(best, slope)
        turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if turn > LARGEST_TURN_RAD:
            step *= LARGEST_TURN_RAD / turn
        pose = apply_twist(pose, step)
    return pose, best, explained


@kernel
def _determines(information):  # type: ignore[no-untyped-def]
    """Whether information (6,6) leaves no direction open, its units taken out of it."""
    sizes = np.sqrt(np.maximum(np.diag(information), 0.0))
    if not np.all(np.isfinite(information)) or sizes.min() == 0.0:
        return False
    return np.linalg.eigvalsh(information / np.outer(sizes, sizes))[0] > LEAST_DETERMINED


@kernel
def _smooth(drawn, face_ids, surface, corners, pose, focal_px, middle_px, diameter_mm):  # type: ignore[no-untyped-def]
    """Replace the normals of faces by those between the normals of their corners (Phong, CACM 1975)."""
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
            # Faces are drawn as if their normals pointed to the camera.
            if x * drawn[0, v, u] + y * drawn[1, v, u] + z * drawn[2, v, u] < 0.0:
                size = -size
            drawn[0, v, u], drawn[1, v, u], drawn[2, v, u] = x / size, y / size, z / size


@kernel
def _inner_places(drawn, face_ids):  # type: ignore[no-untyped-def]
    """Rows and columns (N,2) of the pixels looked at."""
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
                    if face_ids[y, x] < 0 or jump > JUMP * (abs(y - v) + abs(x - u)) or cosine < SMOOTH_COS:
                        is_inner = False
            if is_inner:
                places[count, 0], places[count, 1] = v, u
                count += 1
    return places[:count]


@kernel(inline=True)
def _functions(x, y, z, out):  # type: ignore[no-untyped-def]
    """Write what a light's coefficients belong to, at a normal: right, down, towards the camera."""
    out[0], out[1], out[2], out[3] = 1.0, x, y, z
    out[4], out[5], out[6], out[7], out[8] = x * y, x * z, y * z, x * x - y * y, 3.0 * z * z - 1.0


@kernel
def _fitted_light(values, functions, light, is_known):  # type: ignore[no-untyped-def]
    """The light (9,) that explains grey levels (N,) best, and what each of them counts (N,); see `PRIOR`.

    Weights are Geman and McClure's, at twice the mean deviation.
    """
    weights = np.ones(len(values))
    if is_known:
        _weigh(values - np.dot(functions, light), weights)
    for _ in range(FITS):
        weighted = functions * weights.reshape(-1, 1)
        products, sums = np.dot(weighted.T, functions), np.dot(weighted.T, values)
        total = weights.sum()
        for k in range(COEFFICIENTS):
            products[k, k] += (PRIOR if k > 0 else 1e-9) * total
        light = np.linalg.solve(products, sums)
        _weigh(values - np.dot(functions, light), weights)
    return light, weights


@kernel
def _weigh(left, weights):  # type: ignore[no-untyped-def]
    scale = LEAST_DEVIATION + OUTLYING * np.median(np.abs(left))
    for i in range(len(left)):
        weights[i] = 1.0 / (1.0 + (left[i] / scale) ** 2) ** 2


@kernel
def _motion(places, light, drawn, face_ids, pose, focal_px, middle_px, diameter_mm):  # type: ignore[no-untyped-def]
    """By how much the brightness at each place changes with each part of a twist (N,6), see `solver`.

    A place shows another point of the surface then, and that point's normal is turned.
    """
    height, width = face_ids.shape
    shading = np.zeros((height, width))
    functions = np.empty(COEFFICIENTS)
    for v in range(height):
        for u in range(width):
            if face_ids[v, u] >= 0:
                _functions(drawn[0, v, u], drawn[1, v, u], drawn[2, v, u], functions)
                for k in range(COEFFICIENTS):
                    shading[v, u] += light[k] * functions[k]
    jacobian = np.empty((len(places), 6))
    seen = np.empty((3, 3))
    moved, point, slope, normal = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(places)):
        v, u = places[i]
        right = 0.5 * (shading[v, u + 1] - shading[v, u - 1]) * focal_px[0]
        down = 0.5 * (shading[v + 1, u] - shading[v - 1, u]) * focal_px[1]
        x, y, z = drawn[0, v, u], drawn[1, v, u], drawn[2, v, u]
        depth = pose[2, 3] + 0.5 * diameter_mm * drawn[3, v, u]
        along_x, along_y = (u - middle_px[0]) / focal_px[0], (v - middle_px[1]) / focal_px[1]
        # In the camera's frame: what the point's motion changes, where it is, what the normal's turn changes, and it.
        seen[0, 0], seen[1, 0] = -right / depth, -down / depth
        seen[2, 0] = (right * along_x + down * along_y) / depth
        seen[0, 1], seen[1, 1] = along_x * depth - pose[0, 3], along_y * depth - pose[1, 3]
        seen[2, 1] = depth - pose[2, 3]
        seen[0, 2] = light[1] + light[4] * y + light[5] * z + 2.0 * light[7] * x
        seen[1, 2] = light[2] + light[4] * x + light[6] * z - 2.0 * light[7] * y
        seen[2, 2] = -(light[3] + light[5] * x + light[6] * y + 6.0 * light[8] * z)
        for a in range(3):
            moved[a] = pose[0, a] * seen[0, 0] + pose[1, a] * seen[1, 0] + pose[2, a] * seen[2, 0]
            point[a] = pose[0, a] * seen[0, 1] + pose[1, a] * seen[1, 1] + pose[2, a] * seen[2, 1]
            slope[a] = pose[0, a] * seen[0, 2] + pose[1, a] * seen[1, 2] + pose[2, a] * seen[2, 2]
            normal[a] = pose[0, a] * x + pose[1, a] * y - pose[2, a] * z
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            jacobian[i, a] = point[b] * moved[c] - point[c] * moved[b] + normal[b] * slope[c] - normal[c] * slope[b]
            jacobian[i, 3 + a] = moved[a]
    return jacobian


@kernel
def _reduced(motion, functions, values, weights, light):  # type: ignore[no-untyped-def]
    """The system (6,6), (6,) of the pose after the light was taken out of it, and the share that is explained.

    In units of the variance of what the light leaves.
    """
    left = values - np.dot(functions, light)
    total = weights.sum()
    weighted = motion * weights.reshape(-1, 1)
    hessian, gradient = np.dot(weighted.T, motion), -np.dot(weighted.T, left)
    across = np.dot(weighted.T, functions)
    weighted = functions * weights.reshape(-1, 1)
    products, sums = np.dot(weighted.T, functions), np.dot(weighted.T, left)
    for k in range(COEFFICIENTS):
        prior = PRIOR * total if k > 0 else 1e-9 * total
        products[k, k] += prior
        sums[k] -= prior * light[k]
    solved = np.linalg.solve(products, np.ascontiguousarray(across.T))
    mean = (weights * values).sum() / total
    variance = LEAST_DEVIATION**2 + (weights * left * left).sum() / total
    spread = LEAST_DEVIATION**2 + (weights * (values - mean) ** 2).sum() / total
    explained = 1.0 - variance / spread
    # What is explained badly is hardly the part.
    share = max(explained, 0.0) ** 2 / variance
    hessian = share * (hessian - np.dot(across, solved))
    gradient = share * (gradient + np.dot(solved.T, sums))
    return hessian, gradient, explained
