"""Check of a sample's truth: CAD edges are projected into a picture, and the nearest edges of the picture found."""

from __future__ import annotations

import cv2
import numpy as np

REACH_PX = 6.0


def crease_points(meshes, base: str, lowest_mm: float = 2.5) -> np.ndarray:
    """(N,2,3) points and unit directions every 2 mm along the sharp edges of name → vertices, faces.

    Edges below ``lowest_mm`` are hidden by weld beads and left out, except those of the ``base`` itself.
    """
    points = []
    for name, (vertices, faces) in meshes.items():
        _, index = np.unique(np.round(vertices, 4), axis=0, return_inverse=True)
        corner = vertices[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        sides: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        for face, triple in enumerate(faces):
            for k in range(3):
                a, b = int(triple[k]), int(triple[(k + 1) % 3])
                key = tuple(sorted((int(index.ravel()[a]), int(index.ravel()[b]))))
                sides.setdefault(key, []).append((a, b, face))
        for users in sides.values():
            if len(users) != 2 or normal[users[0][2]] @ normal[users[1][2]] > 0.8:
                continue
            start, end = vertices[users[0][0]], vertices[users[0][1]]
            if name != base and max(start[2], end[2]) < lowest_mm:
                continue
            length = np.linalg.norm(end - start)
            count = max(1, int(length / 2))
            for t in (np.arange(count) + 0.5) / count:
                points.append((start + t * (end - start), (end - start) / length))
    return np.array(points)


def projected(points, cam_from_model, matrix, distortion):
    """Pixels (N,2) of crease points and the unit normals (N,2) of their edges in the picture."""
    turn, _ = cv2.Rodrigues(cam_from_model[:3, :3])

    def project(at):
        at = np.ascontiguousarray(at)
        return cv2.projectPoints(at, turn, cam_from_model[:3, 3], matrix, distortion)[0][:, 0]

    pixel = project(points[:, 0])
    along = project(points[:, 0] + 0.5 * points[:, 1]) - pixel
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return pixel, np.column_stack([-along[:, 1], along[:, 0]])


def common_shift(offset, normal):
    """(2,) shift of the picture against the projection, by robust least squares over all normals."""
    shift = np.zeros(2)
    for _ in range(10):
        weight = 1.0 / (1.0 + ((offset - normal @ shift) / 0.5) ** 2)
        shift = np.linalg.solve((normal * weight[:, None]).T @ normal, (normal * weight[:, None]).T @ offset)
    return shift


def gradient_offsets(picture, pixel, normal):
    """Signed distance (px) along each normal to the nearest strong gradient peak, and its strength."""
    gray = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 0.8)
    step = np.arange(-REACH_PX, REACH_PX + 0.01, 0.25)
    at = pixel[:, None] + step[None, :, None] * normal[:, None]
    profile = cv2.remap(gray, at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_CUBIC)
    slope = np.abs(np.gradient(profile, 0.25, axis=1))
    # A distant peak counts less, so that a neighbouring edge is not taken.
    score = slope * np.exp(-((step / 3.0) ** 2))
    best = np.clip(score.argmax(axis=1), 1, len(step) - 2)
    rows = np.arange(len(pixel))
    left, middle, right = (slope[rows, best + k] for k in (-1, 0, 1))
    curve = left - 2 * middle + right
    fine = np.where(np.abs(curve) > 1e-6, 0.5 * (left - right) / np.where(curve == 0, 1, curve), 0)
    return step[best] + np.clip(fine, -1, 1) * 0.25, middle
