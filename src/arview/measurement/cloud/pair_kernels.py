"""Compiled steps of the search by pairs of oriented points: hypotheses, their scores, and their refinement.

Poses are rows of 12 numbers: the rotation by rows, then the translation. The surface is a *distance field*: nodes of a
grid near it hold the signed distance, the normal and a weight; between nodes the distance follows along the normal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel


@kernel
def hypotheses(
    scene: NDArray[np.float64],
    scene_normals: NDArray[np.float64],
    pairs: NDArray[np.int64],
    model: NDArray[np.float64],
    model_normals: NDArray[np.float64],
    matches: NDArray[np.int64],
    min_cosine: float,
) -> NDArray[np.float64]:
    """(K,12) poses that put pairs of scene points on pairs of model points, NaN where the connecting lines disagree.

    Args:
        scene, scene_normals: (N,3).
        pairs: (K,2) indices of scene points.
        model, model_normals: (M,3).
        matches: (K,2) indices of model points.
        min_cosine: of the angle between the connecting lines after the normals are aligned.
    """
    out = np.full((len(pairs), 12), np.nan)
    a, b = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(pairs)):
        for frame, normals, index in ((a, scene_normals, pairs[k]), (b, model_normals, matches[k])):
            # Sum and difference of two unit vectors are orthogonal.
            for c in range(3):
                frame[0, c] = normals[index[0], c] + normals[index[1], c]
                frame[1, c] = normals[index[0], c] - normals[index[1], c]
            for r in range(2):
                length = np.sqrt(frame[r, 0] ** 2 + frame[r, 1] ** 2 + frame[r, 2] ** 2) + 1e-12
                for c in range(3):
                    frame[r, c] /= length
            frame[2, 0] = frame[0, 1] * frame[1, 2] - frame[0, 2] * frame[1, 1]
            frame[2, 1] = frame[0, 2] * frame[1, 0] - frame[0, 0] * frame[1, 2]
            frame[2, 2] = frame[0, 0] * frame[1, 1] - frame[0, 1] * frame[1, 0]
        rotation = b.T @ a
        along = scene[pairs[k, 1]] - scene[pairs[k, 0]]
        target = model[matches[k, 1]] - model[matches[k, 0]]
        turned = rotation @ along
        cosine = np.dot(turned, target) / (np.sqrt(np.dot(turned, turned) * np.dot(target, target)) + 1e-12)
        if cosine < min_cosine:
            continue
        middle = 0.5 * (scene[pairs[k, 0]] + scene[pairs[k, 1]])
        shift = 0.5 * (model[matches[k, 0]] + model[matches[k, 1]]) - rotation @ middle
        for r in range(3):
            for c in range(3):
                out[k, 3 * r + c] = rotation[r, c]
            out[k, 9 + r] = shift[r]
    return out


@kernel
def _moved(pose: NDArray[np.float64], point: NDArray[np.float64]) -> tuple[float, float, float]:
    """A point (3,) moved by a pose (12,): the rotation by rows, then the translation."""
    x, y, z = point[0], point[1], point[2]
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
        pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
        pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
    )


@kernel
def _nearest_node(
    x: float,
    y: float,
    z: float,
    nodes: NDArray[np.int32],
    field: NDArray[np.float32],
    low: NDArray[np.float64],
    cell: float,
) -> tuple[int, float]:
    """Index into ``field`` of the node nearest to a place, and the signed distance there; -1 away from the surface.

    The distance of the node is carried to the place along the normal. Arguments are those of `scores`.
    """
    u = int(np.floor((x - low[0]) / cell + 0.5))
    v = int(np.floor((y - low[1]) / cell + 0.5))
    w = int(np.floor((z - low[2]) / cell + 0.5))
    if u < 0 or v < 0 or w < 0 or u >= nodes.shape[0] or v >= nodes.shape[1] or w >= nodes.shape[2]:
        return -1, 0.0
    node = nodes[u, v, w]
    if node < 0:
        return -1, 0.0
    nx, ny, nz = field[node, 1], field[node, 2], field[node, 3]
    return node, field[node, 0] + (
        nx * (x - low[0] - u * cell) + ny * (y - low[1] - v * cell) + nz * (z - low[2] - w * cell)
    )


@kernel
def _cosine(
    pose: NDArray[np.float64], normal: NDArray[np.float64], node: NDArray[np.float32], is_oriented: bool
) -> float:
    """Cosine between a normal (3,) moved by a pose (12,) and that of a node (5,); without a sign if not oriented."""
    a, b, c = normal[0], normal[1], normal[2]
    cosine = (
        node[1] * (pose[0] * a + pose[1] * b + pose[2] * c)
        + node[2] * (pose[3] * a + pose[4] * b + pose[5] * c)
        + node[3] * (pose[6] * a + pose[7] * b + pose[8] * c)
    )
    return cosine if is_oriented else abs(cosine)


@kernel
def scores(
    poses: NDArray[np.float64],
    of_pose: NDArray[np.int64],
    lists: NDArray[np.int64],
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    point_weights: NDArray[np.float64],
    nodes: NDArray[np.int32],
    field: NDArray[np.float32],
    low: NDArray[np.float64],
    cell: float,
    reach: float,
    is_oriented: bool,
) -> NDArray[np.float64]:
    """(K,) scores of poses: weights of the points on the surface, less half of those inside of it.

    Args:
        poses: (K,12) model_from_scene.
        of_pose: (K,) row of ``lists`` for each pose.
        lists: (L,J) indices of the points on which a pose is scored.
        points, normals: (N,3).
        point_weights: (N,).
        nodes: (X,Y,Z) index into ``field``, -1 away from the surface.
        field: (F,5) signed distance, normal, weight.
        low: (3,) first node.
        cell: distance of the nodes.
        reach: distance within which a point is on the surface.
        is_oriented: normals point outward; else either sign counts.
    """
    out = np.zeros(len(poses))
    for k in range(len(poses)):
        p = poses[k]
        if np.isnan(p[0]):
            continue
        total = 0.0
        for j in range(lists.shape[1]):
            i = lists[of_pose[k], j]
            if i < 0:
                break
            mx, my, mz = _moved(p, points[i])
            node, distance = _nearest_node(mx, my, mz, nodes, field, low, cell)
            if node < 0:
                continue
            if distance < -reach:
                total -= 0.5 * point_weights[i] * field[node, 4]
                continue
            if distance > reach:
                continue
            cosine = _cosine(p, normals[i], field[node], is_oriented)
            if cosine > 0.7:
                total += point_weights[i] * field[node, 4] * (1.0 - (distance / reach) ** 2)
        out[k] = total
    return out


@kernel
def refined(
    poses: NDArray[np.float64],
    of_pose: NDArray[np.int64],
    lists: NDArray[np.int64],
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    point_weights: NDArray[np.float64],
    nodes: NDArray[np.int32],
    field: NDArray[np.float32],
    low: NDArray[np.float64],
    cell: float,
    reaches: NDArray[np.float64],
    size: float,
    is_oriented: bool,
) -> NDArray[np.float64]:
    """(K,12) poses after Gauss-Newton steps on the distances in the field, one for each of the shrinking ``reaches``.

    The other arguments are those of `scores`; ``size`` converts rotations to the unit of the points.
    """
    out = poses.copy()
    for k in range(len(poses)):
        for step in range(len(reaches)):
            reach = reaches[step]
            p = out[k]
            hessian, gradient, row = np.zeros((6, 6)), np.zeros(6), np.empty(6)
            count = 0
            for j in range(lists.shape[1]):
                i = lists[of_pose[k], j]
                if i < 0:
                    break
                mx, my, mz = _moved(p, points[i])
                node, distance = _nearest_node(mx, my, mz, nodes, field, low, cell)
                if node < 0:
                    continue
                if abs(distance) > reach:
                    continue
                cosine = _cosine(p, normals[i], field[node], is_oriented)
                if cosine < 0.5:
                    continue
                nx, ny, nz = field[node, 1], field[node, 2], field[node, 3]
                row[0], row[1], row[2] = my * nz - mz * ny, mz * nx - mx * nz, mx * ny - my * nx
                row[3], row[4], row[5] = nx * size, ny * size, nz * size
                weight = point_weights[i] * field[node, 4] * (1.0 - (distance / reach) ** 2) ** 2
                for r in range(6):
                    gradient[r] += weight * row[r] * distance
                    for s in range(6):
                        hessian[r, s] += weight * row[r] * row[s]
                count += 1
            if count < 12:
                break
            trace = 0.0
            for r in range(6):
                trace += hessian[r, r]
            for r in range(6):
                hessian[r, r] += 1e-4 * trace
            twist = -np.linalg.solve(hessian, gradient)
            _move(out[k], twist, size)
    return out


@kernel
def _move(pose: NDArray[np.float64], twist: NDArray[np.floating], size: float) -> None:
    """Apply a twist, rotations first, on the left of a pose (12,); large rotations are shortened."""
    angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2)
    if angle > 0.2:
        twist = twist * (0.2 / angle)
        angle = 0.2
    s1 = np.sin(angle) / angle if angle > 1e-9 else 1.0
    s2 = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-9 else 0.5
    cross = np.zeros((3, 3))
    cross[0, 1], cross[0, 2], cross[1, 2] = -twist[2], twist[1], -twist[0]
    cross[1, 0], cross[2, 0], cross[2, 1] = twist[2], -twist[1], twist[0]
    turn = np.eye(3) + s1 * cross + s2 * (cross @ cross)
    rotation, shift = np.empty((3, 3)), np.empty(3)
    for r in range(3):
        for c in range(3):
            rotation[r, c] = pose[3 * r + c]
        shift[r] = pose[9 + r]
    rotation = turn @ rotation
    shift = turn @ shift
    for r in range(3):
        for c in range(3):
            pose[3 * r + c] = rotation[r, c]
        pose[9 + r] = shift[r] + twist[3 + r] * size
