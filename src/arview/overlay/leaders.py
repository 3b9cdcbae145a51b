"""Leaders: the lines from labels to their components, and a search for places in which they do not cross.

A leader that crosses another one or a label is moved: its label takes the best free place, or it and the label that it
crosses are both taken off and placed again one after the other. Straight leaders of least total length do not cross
(Bekos et al., "Boundary labeling", 2007), so exchanges that shorten them end without crossings where there is room.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.overlay.ghost import CELL_PX

_CROSSING_COST = 1000.0
"""Cost of a crossing; it outweighs all others."""
_COVER_COST = 60.0
"""Cost of a label that covers components with its whole area; a distance of a tenth of the image's height costs 1."""
_REACH_COST = 10.0
"""Cost of a leader across the whole width of the image."""
_MOVE_COST = 1.0
"""Cost of moving a label by a tenth of the image's height."""
_OTHER_SIDE = 2.0
"""The same for a move to the other column, in tenths of the image's height."""
_SWEEPS = 6
"""Sweeps over all labels, at most."""


@dataclass(frozen=True)
class LabelPlaces:
    """Labels in two columns, of which N have a place.

    Attributes:
        x: (N,2) left side of the box in the left and in the right column, px.
        sizes: (N,2) width and height of the box.
        anchors: (N,2) image points of the components.
        sides: (N,) 0 in the left column, 1 in the right one.
        y: (N,) top of the box.
        inertia: (N,) factor of the cost of moving the label.
    """

    x: Array
    sizes: Array
    anchors: Array
    sides: NDArray[np.int64]
    y: Array
    inertia: Array


def leader_points(
    box: tuple[float, float, float, float], is_right: bool, anchor: Array, stub_px: float
) -> list[tuple[float, float]]:
    """Points of a leader from a box (x, y, width, height): sideways with a short stub, else from its top or bottom."""
    x, y, width, height = box
    u, v = float(anchor[0]), float(anchor[1])
    px, py, bend = _port(x, y, width, height=height, side=1 if is_right else 0, u=u, v=v, stub=stub_px)
    return [(px, py), (u, v)] if bend == px else [(px, py), (bend, py), (u, v)]


def count_crossings(places: LabelPlaces, stub_px: float) -> NDArray[np.int64]:
    """(N,N) number of crossings of the leader of one label (row) with leader or box of another (column).

    Boxes that overlap count as a crossing, too.
    """
    return _crossings(places.x, places.sizes, places.anchors, places.sides, places.y, stub_px)


def uncrossed(
    places: LabelPlaces, rows: Array, gap_px: float, stub_px: float, integral: Array, width_px: float
) -> LabelPlaces:
    """Places with fewer crossings, or the same.

    Args:
        places: to begin with.
        rows: (R,) tops that may be tried; the last one is where boxes must end.
        gap_px: between boxes.
        stub_px: length of the horizontal beginning of a leader.
        integral: integral image of the covered area of each cell.
        width_px: of the image.
    """
    sides, y = places.sides.copy(), places.y.astype(np.float64)
    old = np.stack([sides.astype(np.float64), y, places.inertia], axis=1)
    bounds = np.array([gap_px, stub_px, rows[-1], width_px], dtype=np.float64)
    _search(
        places.x, places.sizes, places.anchors, sides=sides, y=y, old=old, rows=rows, bounds=bounds, integral=integral
    )
    return replace(places, sides=sides, y=y)


@kernel
def _port(
    x: float, y: float, width: float, height: float, side: int, u: float, v: float, stub: float
) -> tuple[float, float, float]:
    """Point (x, y) at which the leader leaves the box, and the column at which its stub ends; the same without one."""
    if side == 0:
        px, bend = x + width, x + width + stub
        is_beside = u > bend
    else:
        px, bend = x, x - stub
        is_beside = u < bend
    if is_beside:
        return px, y + 0.5 * min(height, 2.4 * stub), bend
    px = min(max(u, x + 4.0), x + width - 4.0)
    return px, y if v < y + 0.5 * height else y + height, px


@kernel
def _side_of(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> float:
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


@kernel
def _meet(ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float) -> bool:
    """Whether two segments cross, apart from common ends."""
    if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx) or max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
        return False
    p, q = _side_of(ax, ay, bx, by, cx, cy), _side_of(ax, ay, bx, by, dx, dy)
    r, s = _side_of(cx, cy, dx, dy, ax, ay), _side_of(cx, cy, dx, dy, bx, by)
    return p * q < 0.0 and r * s < 0.0


@kernel
def _enters(ax: float, ay: float, bx: float, by: float, x: float, y: float, width: float, height: float) -> bool:
    """Whether a segment enters a box (Liang and Barsky, "A new concept and method for line clipping", 1984)."""
    low, high = 0.0, 1.0
    for axis in range(2):
        start, along = (ax, bx - ax) if axis == 0 else (ay, by - ay)
        first, last = (x + 0.5, x + width - 0.5) if axis == 0 else (y + 0.5, y + height - 0.5)
        if abs(along) < 1e-9:
            if start < first or start > last:
                return False
            continue
        t0, t1 = (first - start) / along, (last - start) / along
        low, high = max(low, min(t0, t1)), min(high, max(t0, t1))
        if low >= high:
            return False
    return True


@kernel
def _pair_crossings(
    xi: float,
    yi: float,
    wi: float,
    hi: float,
    si: int,
    ui: float,
    vi: float,
    xj: float,
    yj: float,
    wj: float,
    hj: float,
    sj: int,
    uj: float,
    vj: float,
    stub: float,
) -> tuple[int, int, int]:
    """Crossings of leader i with leader j, of leader i with box j and of leader j with box i."""
    pi, qi, bi = _port(xi, yi, wi, height=hi, side=si, u=ui, v=vi, stub=stub)
    pj, qj, bj = _port(xj, yj, wj, height=hj, side=sj, u=uj, v=vj, stub=stub)
    leaders = 0
    if (
        _meet(bi, qi, ui, by=vi, cx=bj, cy=qj, dx=uj, dy=vj)
        or _meet(pi, qi, bi, by=qi, cx=bj, cy=qj, dx=uj, dy=vj)
        or _meet(bi, qi, ui, by=vi, cx=pj, cy=qj, dx=bj, dy=qj)
    ):
        leaders = 1
    i_in_j = (
        1
        if _enters(bi, qi, ui, by=vi, x=xj, y=yj, width=wj, height=hj)
        or _enters(pi, qi, bi, by=qi, x=xj, y=yj, width=wj, height=hj)
        else 0
    )
    j_in_i = (
        1
        if _enters(bj, qj, uj, by=vj, x=xi, y=yi, width=wi, height=hi)
        or _enters(pj, qj, bj, by=qj, x=xi, y=yi, width=wi, height=hi)
        else 0
    )
    return leaders, i_in_j, j_in_i


@kernel
def _crossings(
    x: NDArray[np.float64],
    sizes: NDArray[np.float64],
    anchors: NDArray[np.float64],
    sides: NDArray[np.int64],
    y: NDArray[np.float64],
    stub: float,
) -> NDArray[np.int64]:
    count = len(y)
    result = np.zeros((count, count), dtype=np.int64)
    for i in range(count):
        xi, wi, hi = x[i, sides[i]], sizes[i, 0], sizes[i, 1]
        if xi < anchors[i, 0] < xi + wi and y[i] < anchors[i, 1] < y[i] + hi:
            result[i, i] = 1
        for j in range(i):
            leaders, i_in_j, j_in_i = _pair_crossings(
                xi,
                y[i],
                wi,
                hi=hi,
                si=sides[i],
                ui=anchors[i, 0],
                vi=anchors[i, 1],
                xj=x[j, sides[j]],
                yj=y[j],
                wj=sizes[j, 0],
                hj=sizes[j, 1],
                sj=sides[j],
                uj=anchors[j, 0],
                vj=anchors[j, 1],
                stub=stub,
            )
            if (
                xi < x[j, sides[j]] + sizes[j, 0]
                and x[j, sides[j]] < xi + wi
                and y[i] < y[j] + sizes[j, 1]
                and y[j] < y[i] + hi
            ):
                leaders += 1
            result[i, j] = leaders + i_in_j
            result[j, i] = leaders + j_in_i
    return result


@kernel
def _cost(
    i: int,
    side: int,
    top: float,
    x: NDArray[np.float64],
    sizes: NDArray[np.float64],
    anchors: NDArray[np.float64],
    sides: NDArray[np.int64],
    y: NDArray[np.float64],
    is_on: NDArray[np.bool_],
    old: NDArray[np.float64],
    bounds: NDArray[np.float64],
    integral: NDArray[np.float64],
) -> float:
    """Cost of a place of label i beside the others that are on; infinite if it overlaps one.

    ``old`` (N,3): side and top before the search, and inertia. ``bounds``: gap, stub, bottom, width of the image.
    """
    gap, stub, bottom, width_px = bounds
    xi, wi, hi = x[i, side], sizes[i, 0], sizes[i, 1]
    u, v = anchors[i, 0], anchors[i, 1]
    total = 0
    for j in range(len(y)):
        if j == i or not is_on[j]:
            continue
        xj, wj, hj = x[j, sides[j]], sizes[j, 0], sizes[j, 1]
        if xi < xj + wj and xj < xi + wi and top < y[j] + hj + gap and y[j] < top + hi + gap:
            return np.inf
        leaders, i_in_j, j_in_i = _pair_crossings(
            xi,
            top,
            wi,
            hi=hi,
            si=side,
            ui=u,
            vi=v,
            xj=xj,
            yj=y[j],
            wj=wj,
            hj=hj,
            sj=sides[j],
            uj=anchors[j, 0],
            vj=anchors[j, 1],
            stub=stub,
        )
        total += leaders + i_in_j + j_in_i
    if xi < u < xi + wi and top < v < top + hi:
        total += 1
    grid_h, grid_w = integral.shape[0] - 1, integral.shape[1] - 1
    c0, c1 = max(0, min(grid_w, int(xi // CELL_PX))), max(0, min(grid_w, int((xi + wi) // CELL_PX) + 1))
    r0, r1 = max(0, min(grid_h, int(top // CELL_PX))), max(0, min(grid_h, int((top + hi) // CELL_PX) + 1))
    covered = integral[r1, c1] - integral[r0, c1] - integral[r1, c0] + integral[r0, c0]
    span = 0.1 * bottom
    edge = xi + wi if side == 0 else xi
    cost = _COVER_COST * covered / (wi * hi) + ((top + 0.5 * hi - v) / span) ** 2
    cost += _REACH_COST * abs(u - edge) / width_px
    moved = abs(top - old[i, 1]) / span if side == int(old[i, 0]) else _OTHER_SIDE
    cost += _MOVE_COST * old[i, 2] * moved
    return float(cost + _CROSSING_COST * total)


@kernel
def _best_place(
    i: int,
    x: NDArray[np.float64],
    sizes: NDArray[np.float64],
    anchors: NDArray[np.float64],
    sides: NDArray[np.int64],
    y: NDArray[np.float64],
    is_on: NDArray[np.bool_],
    old: NDArray[np.float64],
    rows: NDArray[np.float64],
    bounds: NDArray[np.float64],
    integral: NDArray[np.float64],
) -> tuple[float, int, float]:
    """Least cost of label i over all places, and that place."""
    best, best_side, best_y = np.inf, sides[i], y[i]
    for side in range(2):
        for k in range(len(rows)):
            if rows[k] + sizes[i, 1] > bounds[2]:
                break
            cost = _cost(
                i,
                side,
                rows[k],
                x=x,
                sizes=sizes,
                anchors=anchors,
                sides=sides,
                y=y,
                is_on=is_on,
                old=old,
                bounds=bounds,
                integral=integral,
            )
            if cost < best:
                best, best_side, best_y = cost, side, rows[k]
    return best, best_side, best_y


@kernel
def _place_both(
    i: int,
    j: int,
    x: NDArray[np.float64],
    sizes: NDArray[np.float64],
    anchors: NDArray[np.float64],
    sides: NDArray[np.int64],
    y: NDArray[np.float64],
    is_on: NDArray[np.bool_],
    old: NDArray[np.float64],
    rows: NDArray[np.float64],
    bounds: NDArray[np.float64],
    integral: NDArray[np.float64],
) -> bool:
    """Take labels i and j off and place first i, then j, where that is better; returns whether it was."""
    side_i, y_i, side_j, y_j = sides[i], y[i], sides[j], y[j]
    before = _cost(
        j,
        side_j,
        y_j,
        x=x,
        sizes=sizes,
        anchors=anchors,
        sides=sides,
        y=y,
        is_on=is_on,
        old=old,
        bounds=bounds,
        integral=integral,
    )
    is_on[j] = False
    before += _cost(
        i,
        side_i,
        y_i,
        x=x,
        sizes=sizes,
        anchors=anchors,
        sides=sides,
        y=y,
        is_on=is_on,
        old=old,
        bounds=bounds,
        integral=integral,
    )
    first, sides[i], y[i] = _best_place(
        i,
        x,
        sizes,
        anchors=anchors,
        sides=sides,
        y=y,
        is_on=is_on,
        old=old,
        rows=rows,
        bounds=bounds,
        integral=integral,
    )
    is_on[j] = True
    second, sides[j], y[j] = _best_place(
        j,
        x,
        sizes,
        anchors=anchors,
        sides=sides,
        y=y,
        is_on=is_on,
        old=old,
        rows=rows,
        bounds=bounds,
        integral=integral,
    )
    if first + second < before - 1e-6:
        return True
    sides[i], y[i], sides[j], y[j] = side_i, y_i, side_j, y_j
    return False


@kernel
def _search(
    x: NDArray[np.float64],
    sizes: NDArray[np.float64],
    anchors: NDArray[np.float64],
    sides: NDArray[np.int64],
    y: NDArray[np.float64],
    old: NDArray[np.float64],
    rows: NDArray[np.float64],
    bounds: NDArray[np.float64],
    integral: NDArray[np.float64],
) -> None:
    """Improve sides and tops in place until nothing crosses or no move of one or two labels helps."""
    count = len(y)
    is_on = np.ones(count, dtype=np.bool_)
    for _ in range(_SWEEPS):
        crossings = _crossings(x, sizes, anchors, sides, y, bounds[1])
        if crossings.sum() == 0:
            return
        has_improved = False
        for i in range(count):
            if crossings[i].sum() + crossings[:, i].sum() == 0:
                continue
            now = _cost(
                i,
                sides[i],
                y[i],
                x=x,
                sizes=sizes,
                anchors=anchors,
                sides=sides,
                y=y,
                is_on=is_on,
                old=old,
                bounds=bounds,
                integral=integral,
            )
            cost, side, top = _best_place(
                i,
                x,
                sizes,
                anchors=anchors,
                sides=sides,
                y=y,
                is_on=is_on,
                old=old,
                rows=rows,
                bounds=bounds,
                integral=integral,
            )
            if cost < now - 1e-6:
                sides[i], y[i] = side, top
                has_improved = True
        for i in range(count):
            for j in range(count):
                if (
                    i != j
                    and crossings[i, j] + crossings[j, i] > 0
                    and _place_both(
                        i,
                        j,
                        x,
                        sizes=sizes,
                        anchors=anchors,
                        sides=sides,
                        y=y,
                        is_on=is_on,
                        old=old,
                        rows=rows,
                        bounds=bounds,
                        integral=integral,
                    )
                ):
                    has_improved = True
        if not has_improved:
            return
