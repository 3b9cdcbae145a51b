"""Groups of photos that are placed among each other, but not, or too weakly, relative to the others.

Two groups of photos that share no point have no common frame: bundle adjustment leaves the move of one against the
other at whatever it was, and every quantity measured across both is undetermined. The same holds, less visibly, where a
few points join them. Groups are found on the graph of shared points, and by the covariance of the adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from arview.geometry import Array
from arview.reconstruction.adjustment.covariance import gauge_of
from arview.reconstruction.types import SparseModel

Members = tuple[int, ...]


MIN_SHARED_POINTS = 15
"""Points that two groups of photos share; fewer can be due to chance."""
MAX_RELATIVE_PX = 1.0
"""Standard deviation of one side's view of the other; more is not a common frame."""
POINTS_OF_PHOTO = 60
"""Points of a photo in which ``MAX_RELATIVE_PX`` is evaluated."""


def linked_groups(sparse: SparseModel) -> tuple[Members, ...]:
    """Indices of the photos of each group, the group with most photos (then most points) first.

    The photos are cut where the fewest points join them, as long as the parts share too few points or the covariance
    of the poses leaves one part free to move against the other.
    """
    shared = shared_points(sparse)
    groups: list[Members] = []
    pending = [tuple(range(len(sparse.photos)))]
    while pending:
        members = pending.pop()
        parts = _weakest_cut(sparse, shared, members)
        if parts is None:
            groups.append(members)
        else:
            pending += parts
    counts = {members: _points_of(sparse, members) for members in groups}
    return tuple(sorted(groups, key=lambda members: (-len(members), -counts[members], members)))


def shared_points(sparse: SparseModel) -> NDArray[np.int64]:
    """(M,M) number of points that two photos both see; the diagonal holds the points of each."""
    shape = (len(sparse.points_in_scan), len(sparse.photos))
    seen = scipy.sparse.coo_matrix(
        (np.ones(len(sparse.observed_point), dtype=np.int64), (sparse.observed_point, sparse.observed_photo)), shape
    ).tocsr()
    seen.data[:] = 1  # a point may be observed twice in a photo
    return np.asarray((seen.T @ seen).toarray(), dtype=np.int64)


def _weakest_cut(sparse: SparseModel, shared: NDArray[np.int64], members: Members) -> list[Members] | None:
    """Two parts of some photos that are not placed relative to each other; None if there are none."""
    if len(members) < 2:
        return None
    index = np.array(members)
    weights = shared[np.ix_(index, index)].astype(np.float64)
    np.fill_diagonal(weights, 0.0)
    # The maximum spanning tree; zero weights stay out of the graph.
    tree = scipy.sparse.csgraph.minimum_spanning_tree(scipy.sparse.csr_matrix(np.where(weights > 0, -weights, 0.0)))
    count, labels = scipy.sparse.csgraph.connected_components(tree, directed=False)
    if count > 1:
        return [tuple(index[labels == label].tolist()) for label in range(count)]
    cuts = []
    for edge in zip(*tree.nonzero(), strict=True):
        one = _side(tree, edge)
        cuts.append(
            (len(_seen_by_both(sparse, index[one], index[~one])), [tuple(index[s].tolist()) for s in (one, ~one)])
        )
    # The cut with the fewest points is the weak link: others on either side of it are loose for its sake only.
    for across, parts in sorted(cuts):
        if across < MIN_SHARED_POINTS or relative_px(sparse, parts) > MAX_RELATIVE_PX:
            return parts
    return None


def _side(tree: scipy.sparse.csr_matrix, edge: tuple[int, int]) -> NDArray[np.bool_]:
    """Vertices on one side of an edge of a tree."""
    cut = tree.tolil(copy=True)
    cut[edge] = 0.0
    cut = cut.tocsr()
    cut.eliminate_zeros()
    _, labels = scipy.sparse.csgraph.connected_components(cut, directed=False)
    return np.asarray(labels == labels[edge[0]])


def _seen_by_both(sparse: SparseModel, ones: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.int32]:
    """Points that photos of both sides see."""
    first, second = (sparse.observed_point[np.isin(sparse.observed_photo, side)] for side in (ones, others))
    return np.intersect1d(first, second)


def _points_of(sparse: SparseModel, members: Sequence[int]) -> int:
    return len(np.unique(sparse.observed_point[np.isin(sparse.observed_photo, members)]))


def relative_px(sparse: SparseModel, parts: Sequence[Members]) -> float:
    """Standard deviation in px by which the smaller part, as a whole, can move against the larger one.

    The joint covariance is expressed in the frame of the larger part (S-transformation, Baarda 1973). The common move
    of the smaller part's cameras is then seen as a shift of the points in its photos.
    """
    if sparse.pose_covariance is None:
        return 0.0
    larger, smaller = sorted(parts, key=len, reverse=True)
    entries = [np.concatenate([np.arange(6 * i, 6 * i + 6) for i in part]) for part in (larger, smaller)]
    members = np.concatenate(entries)
    gauge, weights = gauge_of(sparse)
    # What a wrong principal point or focal length does to all cameras alike leaves the pixels where they are. Only the
    # photos of the two parts count: others may be free to move against them.
    lens, weighed = _lens_modes(sparse)[members], weights[members]
    project = np.eye(len(members)) - (lens @ np.linalg.pinv(lens * weighed[:, None])) * weighed[None, :]
    # Moves of the smaller part against the larger one, by least squares; a lone photo has no scale.
    rows = (np.arange(len(entries[0])), len(entries[0]) + np.arange(len(entries[1])))
    relative = np.zeros((7, len(members)))
    for sign, row, entry in zip((-1.0, 1.0), rows, entries, strict=True):
        inverse = np.linalg.pinv(gauge[entry] * weights[entry, None], rcond=1e-9) * weights[None, entry]
        relative[:, row] += sign * inverse
    relative = relative @ project
    covariance = relative @ sparse.pose_covariance[np.ix_(members, members)] @ relative.T
    total, count = 0.0, 0
    for i in smaller:
        photo = sparse.photos[i]
        seen = np.flatnonzero(sparse.observed_photo == i)
        seen = seen[:: max(1, len(seen) // POINTS_OF_PHOTO)]
        in_cam = sparse.points_in_scan[sparse.observed_point[seen]] @ photo.cam_from_scan[:3, :3].T
        in_cam = in_cam + photo.cam_from_scan[:3, 3]
        jacobian = _pixel_moves(in_cam, photo.camera.fx) @ gauge[6 * i : 6 * i + 6]
        total += float(np.einsum("nij,jk,nik->", jacobian, covariance, jacobian))
        count += len(seen)
    return float(np.sqrt(max(total, 0.0) / max(1, 2 * count)))


def _lens_modes(sparse: SparseModel) -> Array:
    """(6M,10) left twists of all photos by which errors of the intrinsics are compensated, and the seven of the gauge.

    A shift of the principal point is compensated by a common turn about the cameras' x and y axes, a focal length by
    moves along the viewing directions in proportion to the depth.
    """
    modes = np.zeros((6 * len(sparse.photos), 3))
    for i, photo in enumerate(sparse.photos):
        points = sparse.points_in_scan[sparse.observed_point[sparse.observed_photo == i]]
        depth = np.median(points @ photo.cam_from_scan[2, :3]) + photo.cam_from_scan[2, 3] if len(points) else 0.0
        modes[6 * i, 0] = modes[6 * i + 1, 1] = 1.0
        modes[6 * i + 5, 2] = depth
    return np.hstack([modes, gauge_of(sparse)[0]])


def _pixel_moves(in_cam: Array, focal_px: float) -> Array:
    """(N,2,6) derivative of the pixels of points (N,3) in the camera's frame by a left twist of its pose."""
    x, y, z = in_cam.T
    z = np.maximum(z, 1e-9)
    zero, one = np.zeros_like(z), np.ones_like(z)
    rows = [
        [-x * y / z, z + x * x / z, -y, one, zero, -x / z],
        [-z - y * y / z, x * y / z, x, zero, one, -y / z],
    ]
    return np.asarray(np.moveaxis(np.array(rows), 2, 0) * (focal_px / z)[:, None, None])


# --- in words --------------------------------------------------------------------------------------------


def named(names: Sequence[str], shown: int = 6) -> str:
    """Names of a group of photos: runs of consecutive ones of ``names`` are for the caller to make."""
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")


def group_names(order: Sequence[str], members: Sequence[str], shown: int = 4) -> str:
    """A group of photos in words: consecutive photos of ``order`` as "first to last"."""
    place = {name: i for i, name in enumerate(order)}
    runs: list[list[str]] = []
    for name in sorted(members, key=place.__getitem__):
        if runs and place[name] == place[runs[-1][-1]] + 1:
            runs[-1].append(name)
        else:
            runs.append([name])
    words = [run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(run) for run in runs]
    return named(words, shown)


def groups_warning(order: Sequence[str], groups: Sequence[Sequence[str]]) -> str:
    """What the groups are, which one is used, and what to photograph; empty for a single group.

    Args:
        order: names of all photos, in the order in which they were taken.
        groups: names of the photos of each group, the one that is used first.
    """
    if len(groups) < 2:
        return ""
    place = {name: i for i, name in enumerate(order)}
    listed = "; ".join(
        f"{group_names(order, group)} ({len(group)} photo{'s' * (len(group) > 1)}{', used' if i == 0 else ''})"
        for i, group in enumerate(groups)
    )
    bridges = []
    for other in groups[1:]:
        one, two = min(
            ((a, b) for a in groups[0] for b in other), key=lambda pair: abs(place[pair[0]] - place[pair[1]])
        )
        bridges.append(f"{one} and {two}")
    return (
        f"the photos are {len(groups)} groups that share no point, or too few, so their places relative to each other "
        f"are unknown: {listed}; only the first is measured. Take photos every 10 to 20 degrees on the way between "
        f"{named(bridges, 3)}, each showing more than half of what the one before shows"
    )
