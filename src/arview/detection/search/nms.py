"""Non-maximum suppression of poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array


@kernel
def select_distinct(
    rotations: NDArray[np.float64],
    positions: NDArray[np.float64],
    reach: NDArray[np.float64],
    cosine: float,
    distance_ratio: float,
    most: int,
) -> NDArray[np.int64]:
    """Indices of at most ``most`` poses, best first as given, none close to a better one.

    Args:
        rotations: (N,3,3), best first.
        positions: (N,3) mm.
        reach: (N,) offset across the line of sight, as a share of the distance, within which poses are close.
        cosine: of the angle within which rotations are close.
        distance_ratio: ratio within which distances are close.
        most: number of indices returned at most.
    """
    chosen = np.empty(most, dtype=np.int64)
    count = 0
    total = rotations.shape[0]
    if total == 0:
        return chosen[:0]
    # Chosen poses are linked by the cell they lie in; only those of neighbouring cells are compared.
    x, y = positions[:, 0] / positions[:, 2], positions[:, 1] / positions[:, 2]
    low_x, low_y = x.min(), y.min()
    cell = max(reach.max(), (x.max() - low_x) / 100.0, (y.max() - low_y) / 100.0, 1e-9)
    columns, rows = int((x.max() - low_x) / cell) + 3, int((y.max() - low_y) / cell) + 3
    head = np.full((rows, columns), -1, dtype=np.int64)
    following = np.empty(total, dtype=np.int64)
    for i in range(total):
        column, row = int((x[i] - low_x) / cell) + 1, int((y[i] - low_y) / cell) + 1
        is_near = False
        for around in range(9):
            j = head[row + around // 3 - 1, column + around % 3 - 1]
            while j >= 0:
                if abs(x[i] - x[j]) < reach[j] and abs(y[i] - y[j]) < reach[j]:
                    ratio = positions[i, 2] / positions[j, 2]
                    if ratio <= distance_ratio and ratio * distance_ratio >= 1.0:
                        trace = 0.0
                        for a in range(3):
                            for b in range(3):
                                trace += rotations[i, a, b] * rotations[j, a, b]
                        if 0.5 * (trace - 1.0) >= cosine:
                            is_near = True
                            break
                j = following[j]
            if is_near:
                break
        if not is_near:
            following[i] = head[row, column]
            head[row, column] = i
            chosen[count] = i
            count += 1
            if count == most:
                break
    return chosen[:count]


def distinct_poses(
    scores: Array, poses: Array, diameter_mm: float, separation_deg: float, count: int, limit: int | None = None
) -> tuple[Array, Array]:
    """The best of some poses (N,4,4), best first, none closer to a better one than a separation.

    Args:
        scores, poses: (N,) and (N,4,4).
        diameter_mm: of the part.
        separation_deg: angle within which poses are close; 1° corresponds to 1 % of the diameter and of the distance.
        count: of poses returned at most.
        limit: number of best poses that are compared at most.
    """
    order = np.argsort(-scores, kind="stable")[:limit]
    scores, poses = scores[order], poses[order]
    share = 0.01 * separation_deg
    chosen = select_distinct(
        np.ascontiguousarray(poses[:, :3, :3]),
        np.ascontiguousarray(poses[:, :3, 3]),
        np.full(len(poses), share * diameter_mm) / poses[:, 2, 3],
        np.cos(np.deg2rad(separation_deg)),
        1.0 + share,
        count,
    )
    return scores[chosen], np.ascontiguousarray(poses[chosen])
