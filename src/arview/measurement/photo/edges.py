"""A component's CAD edges and silhouettes, fitted to steps of brightness in all photos at once.

This needs no texture. Steps are searched along the normals of predicted edges (Harris, RAPID 1990; robust and with
several hypotheses: Drummond & Cipolla 2002; Vacchetti, Lepetit & Fua 2004), hidden edges are removed with the z-buffer,
and one rigid motion of the component in space is fitted to all steps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arview.cad import make_model
from arview.core.kernel import kernel
from arview.geometry import Array, apply, invert, rigid
from arview.measurement.photo.component import MeasuredComponent
from arview.measurement.photo.edge_offsets import HALF_SLOPE, EdgeOffsets, edge_offsets, edge_rays, steps_across
from arview.measurement.photo.fit import RigidFit, fit_rigid, move_rows
from arview.measurement.photo.options import UNDETERMINED_MM
from arview.measurement.photo.patches import near_others
from arview.measurement.photo.rival_edges import EdgePoints, rival_offsets_px
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Move, NotMeasured
from arview.rendering import EDGE_CREASE, EDGE_SILHOUETTE, sample_visible_edges
from arview.rendering.mesh_edges import mesh_edges

CAPTURE_MM = 5.0
"""Largest displacement that the first round finds."""
REACHES_PX: tuple[float, ...] = (6.0, 4.5, 3.5, 3.0, 3.0, 3.0)
"""Search range across the edges in each round."""
SPACING_PX = 3.0
"""Distance between samples along an edge."""
MAX_POINTS = 3000
"""Edge points of one component in all photos; more are redundant."""
MIN_SIGMA_PX = 0.05
"""Lower bound of the residuals' standard deviation: lens, tessellation, pixel response."""
MAX_DARK_SHIFT_PX = 0.2
"""Largest common shift of all edges towards the dark side: tone curve, glare."""
MIN_POINTS = 40
"""Edge points that a measurement needs."""
MIN_DIRECTION = 0.2
"""Share of a direction's information that must agree for it to be determined."""
MIN_SUPPORT = 0.25
"""Share of predicted points with a step at the fitted place, beyond chance."""
SMALL_SUPPORT = 0.2
"""The same for a small component, in addition: its few edges are found in any texture more easily."""
FIRST_RIVAL_PX = 3.0
"""In the first rounds, points with another edge nearer beside them are left out."""
RIVAL_PX = 2.0
"""In the last rounds, points with another edge nearer beside them are left out: blur merges nearer steps."""
RIVAL_REACH_PX = 6.0
"""An edge farther than this is no rival: the last rounds search half as far."""
FINE_ROUNDS = 3
"""Number of the last rounds."""
FLANKED_PX = 0.5
"""Systematic standard deviation where all edges have others beside them: half their gap."""
SMALL_PX, SMALL_SIZES_PX = 0.15, (30.0, 90.0)
"""The same of a small component, whose few edges lie all in the same light and on the same roundings, or of one
measured by edges at its joints; and the diagonals between which it decreases to nothing."""
WEAK_SUPPORT, WEAK_PX = 0.5, 3.0
"""Support below which what hides the edges may have taken their place, and the standard deviation by the lack of it."""
SYSTEMATIC_PX = 0.03
"""Standard deviation of a common shift of all edges of a component: chamfers, light."""


def pose_gain(views: PhotoViews, fit: RigidFit, view: NDArray[np.int64], rows: Array) -> Array:
    """(6,6M) derivative of a fitted twist by the poses, from that of each point (N,6) by the pose of its own photo."""
    result = np.zeros((6, 6 * len(views.cameras)))
    for v in np.unique(view):
        of = view == v
        result[:, 6 * v : 6 * v + 6] = fit.gain[:, of] @ rows[of]
    return result


class ComponentEdges:
    """Measurement of one component by its edges."""

    def __init__(self, body: MeasuredComponent) -> None:
        self.body, self.views = body, body.views
        self._edges = mesh_edges(make_model(body.shape.name, (body.shape,)), CREASE_DEG)
        self._predicted: tuple[Array, EdgePoints, Array] | None = None
        self._clear = (0.0, 0.0)

    def measure(self, start: Array | None = None, is_near: bool = False) -> Move | NotMeasured:
        """Measure the component's move.

        Args:
            start: (4,4) its approximate place; None searches around nominal.
            is_near: the start is right within two pixels.
        """
        place = np.eye(4) if start is None else start
        flanked = self._choose_clear(place)
        edges = self.predicted(place, self._clear[0])
        if len(edges.points) < MIN_POINTS or len(np.unique(edges.view)) < 3:
            return NotMeasured(
                self.body.shape.name,
                "edges",
                "fewer than 3 photos show enough of its edges; take more photos of it",
                is_unseen=True,
            )
        # Start on reduced pictures where a pixel is much smaller than the displacements searched for.
        levels = [k for k in (2, 1) if self.body.px_mm * 2.0**k < 0.6]
        rounds = [(k, 6.0) for k in levels] + [(0, reach) for reach in REACHES_PX]
        rounds = rounds[-FINE_ROUNDS:] if is_near else rounds
        if start is None:
            place = self._capture(edges, levels[0] if levels else 0)
        dark_mm = 0.0
        for turn, (level, reach_px) in enumerate(rounds):
            # Between near edges the nearest step is the right one only once the place is known well; a step beyond the
            # middle between an edge and its rival is the rival's.
            is_fine = turn >= len(rounds) - FINE_ROUNDS
            edges, gaps_px = self._clear_of(place, self._clear[is_fine])
            rivals = np.hypot(*gaps_px.T)
            found = edge_offsets(edges, apply(place, self.body.center), self.views, reach_px, level, gaps_px=gaps_px)
            ok = found.seen & (found.slopes != 0.0)
            if is_fine:
                ok &= np.abs(found.offsets_mm) < 0.5 * rivals * found.mm_per_px
            if np.count_nonzero(ok) < MIN_POINTS:
                return NotMeasured(
                    self.body.shape.name,
                    "edges",
                    f"only {np.count_nonzero(ok)} of {len(ok)} points of its edges are seen in the photos",
                    support=self._support(edges, place),
                )
            before, dark_before_mm = place, dark_mm
            fit, dark_mm = self._fit(edges, found, ok, place, dark_mm, is_last=False)
            place = self.body.moved(place, fit.twist)
            step = self.body.size_mm(fit.twist)
            if turn >= len(rounds) - 3 and step < 0.002:
                break
        fit, _ = self._fit(edges, found, ok, before, dark_before_mm)
        place = self.body.moved(before, fit.twist)
        support = self._support(edges, place)
        used = int(np.count_nonzero(fit.weights > 0.1))
        size_px = 2.0 * self.body.radius_mm / self.body.px_mm
        small = float(np.interp(size_px, SMALL_SIZES_PX, (1.0, 0.0)))
        min_support = MIN_SUPPORT + SMALL_SUPPORT * small
        if support < min_support or used < MIN_POINTS or len(fit.undetermined) == 6:
            return NotMeasured(
                self.body.shape.name,
                "edges",
                f"its edges are not seen where they should be: {100 * support:.0f} % more than by chance",
                support=support,
            )
        by_poses = pose_gain(self.views, fit, edges.view[ok], found.pose_rows[ok])
        small = 1.0 if self.body.uses_joints else small
        weak = max(WEAK_SUPPORT - support, 0.0)
        systematic_px = float(np.linalg.norm([SYSTEMATIC_PX, FLANKED_PX * flanked, SMALL_PX * small, WEAK_PX * weak]))
        # Edges of one kind have steps of one kind beside them, so that they are all shifted the same way.
        merged = _RIVAL_HEIGHT_STD * fit.gain @ found.merged_mm[ok]
        return self.body.move("edges", fit, by_poses, place, systematic_px * self.body.px_mm, support, merged)

    def _choose_clear(self, place: Array) -> float:
        """Set the least distances of rivals in first and last rounds; return the share of points that are flanked.

        Edges that another one runs beside are left out where the others suffice; else they are all used.
        """
        for clear in ((FIRST_RIVAL_PX, RIVAL_PX), (RIVAL_PX, RIVAL_PX)):
            if all(self._suffices(self.predicted(place, one)) for one in clear):
                self._clear = clear
                return 0.0
        self._clear = (0.0, 0.0)
        every = len(self.predicted(place).points)
        return 1.0 - len(self.predicted(place, RIVAL_PX).points) / max(1, every)

    def _suffices(self, edges: EdgePoints) -> bool:
        """Whether there are enough edge points, in enough photos."""
        return len(edges.points) >= 2 * MIN_POINTS and len(np.unique(edges.view)) >= 3

    def predicted(self, place: Array, clear_px: float = 0.0) -> EdgePoints:
        """Edge points that the photos should show with the component at a place; joints with others are left out.

        For a place that hardly differs from the previous one, the same points are moved along instead of rendered
        again.

        Args:
            place: (4,4) of the component.
            clear_px: points beside which another edge of the component runs nearer than this are left out.
        """
        return self._clear_of(place, clear_px)[0]

    def _clear_of(self, place: Array, clear_px: float) -> tuple[EdgePoints, Array]:
        """The points of `predicted`, and (N,2) the offset of the nearest edge beside each, px; inf if far."""
        edges, gaps_px = self._all_predicted(place)
        kept, count = np.flatnonzero(np.hypot(*gaps_px.T) >= clear_px), MAX_POINTS
        kept = kept[:: int(np.ceil(len(kept) / count))] if len(kept) > count else kept
        return edges.of(kept), gaps_px[kept]

    def _all_predicted(self, place: Array) -> tuple[EdgePoints, Array]:
        """All edge points at a place, and (N,2) offset of the nearest edge beside each, px."""
        if self._predicted is not None and self.body.is_same(self._predicted[0], place):
            before, edges, gaps_px = self._predicted
            step = place @ invert(before)
            return EdgePoints(apply(step, edges.points), edges.tangents @ step[:3, :3].T, edges.view), gaps_px
        corners = apply(place, self.body.corners)
        points, tangents, views = [], [], []
        stands = self.views.places.get(self.body.index)
        moved = None if stands is not None and self.body.is_same(stands, place) else self.body.index
        for view in range(len(self.views.cameras)):
            window = self.views.window(view, moved, place, corners)
            if window.inverse_depth.size < 9 or not (window.ids == self.body.index).any():
                continue
            depth = np.zeros(window.inverse_depth.shape, dtype=np.float32)
            np.divide(1.0, window.inverse_depth, out=depth, where=window.inverse_depth > 0)
            fx, fy, cx, cy = window.lens
            lens = (fx, fy, cx - window.origin[0], cy - window.origin[1])
            found = sample_visible_edges(self._edges, self.views.cam_from_model[view] @ place, lens, depth, SPACING_PX)
            good = (found.kinds & (EDGE_CREASE | EDGE_SILHOUETTE)) > 0
            points.append(found.points_in_model[good])
            tangents.append(found.tangents_in_model[good])
            views.append(np.full(np.count_nonzero(good), view))
        if not points:
            return EdgePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=np.int64)), np.zeros((0, 2))
        # Edges at joints are rivals too: the photos show them.
        nominal = np.concatenate(points)
        edges = EdgePoints(
            apply(place, nominal), np.concatenate(tangents) @ place[:3, :3].T, np.concatenate(views).astype(np.int64)
        )
        gaps_px = rival_offsets_px(edges, self.views, RIVAL_REACH_PX)
        apart = ~near_others(nominal, self.views.model, self.body.index, self.body.joint_mm)
        self._predicted = (place, edges.of(apart), gaps_px[apart])
        return self._predicted[1:]

    def _capture(self, edges: EdgePoints, level: int) -> Array:
        """Place within the capture range at which most edges have a step: all steps found vote for translations."""
        some = edges.of(np.arange(0, len(edges.points), max(1, len(edges.points) // 800)))
        px_mm = self.body.px_mm * 2.0**level
        found = edge_offsets(some, self.body.center, self.views, CAPTURE_MM / px_mm + 2.0, level)
        shifts = self.body.shifts(CAPTURE_MM)
        weight = np.abs(found.strengths) / (np.abs(found.strengths) + HALF_SLOPE)
        # Strongest first, so that poor shifts are given up early.
        order = np.argsort(-weight.max(axis=1), kind="stable")
        order = order[weight[order].max(axis=1) > 0.0]
        votes = _vote(
            found.hypotheses_mm[order], weight[order], found.directions[order], shifts, max(0.4, 1.2 * px_mm), 0.99
        )
        if not votes.max() > 0.0:  # nothing but plain surface where it should be
            return np.eye(4)
        best = shifts[np.flatnonzero(votes > 0.99 * votes.max())[0]]
        return rigid(np.eye(3), best)

    def _fit(
        self,
        edges: EdgePoints,
        found: EdgeOffsets,
        ok: NDArray[np.bool_],
        place: Array,
        dark_mm: float,
        is_last: bool = True,
    ) -> tuple[RigidFit, float]:
        """Fit with all edges shifted to the dark side by ``dark_mm``; also return the shift for the next round."""
        size, slope = found.mm_per_px[ok], found.slopes[ok]
        sigmas = _SIGMA_PX * size * np.sqrt((np.abs(slope) + HALF_SLOPE) / np.abs(slope))
        center = apply(place, self.body.center)
        rows = move_rows(edges.points[ok], found.directions[ok], center)
        dark = np.sign(slope)
        fit = fit_rigid(
            rows,
            found.offsets_mm[ok] - dark * dark_mm,
            sigmas,
            free=self.body.free_at(place),
            radius_mm=self.body.radius_mm,
            undetermined_mm=UNDETERMINED_MM,
            places=edges.points[ok] / (4.0 * self.body.px_mm),
            min_sigma=MIN_SIGMA_PX / _SIGMA_PX,
            searched_rows=move_rows(edges.points[found.seen], found.directions[found.seen], center),
            min_support=MIN_DIRECTION,
            max_pairs=len(ok) if is_last else _FEW_PAIRS,
        )
        left = found.offsets_mm[ok] - rows @ fit.twist
        limit = MAX_DARK_SHIFT_PX * self.body.px_mm
        # The denominator holds a weak prior at zero.
        shift = float(np.sum(fit.weights * dark * left) / (1.05 * np.sum(fit.weights) + 1.0))
        return fit, float(np.clip(shift, -limit, limit))

    def _support(self, edges: EdgePoints, place: Array) -> float:
        """Share of predicted points with a step within one pixel, beyond what is found by chance beside the edges."""
        rays, shares = edge_rays(edges, apply(place, self.body.center), self.views, 0), []
        for shift_px in (0.0, -7.0, 7.0):
            found = steps_across(rays, edges.view, self.views, 3.0, 0, shift_px)
            near = found.seen & (found.slopes != 0.0) & (np.abs(found.offsets_mm) < found.mm_per_px)
            shares.append(int(np.count_nonzero(near)) / max(1, int(np.count_nonzero(found.seen))))
        chance = min(0.5 * (shares[1] + shares[2]), 0.9)
        return max(0.0, (shares[0] - chance) / (1.0 - chance))


CREASE_DEG = 35.0
"""Faces that meet at a larger angle form an edge; smaller angles are facets of a curved surface."""
_RIVAL_HEIGHT_STD = float(1.0 / np.sqrt(3.0))
"""Standard deviation of the height of a step beside another one, in heights of that one: anything from -1 to 1."""
_FEW_PAIRS = 700
"""Points used to estimate the correlation of errors while the place is still being refined."""
_SIGMA_PX = 0.3
"""Standard deviation assumed for a strong step; the scale that the residuals show replaces it."""


@kernel(numpy_errors=True)
def _vote(
    hypotheses: NDArray[np.float64],
    weights: NDArray[np.float64],
    directions: NDArray[np.float64],
    shifts: NDArray[np.float64],
    width: float,
    share: float,
) -> NDArray[np.float64]:
    """Sum over edge points of the best step near the place to which each shift moves the edge.

    Args:
        hypotheses: (N,K) positions of steps along the directions, mm.
        weights: (N,K) of the steps, 0 = no step.
        directions: (N,3) unit.
        shifts: (T,3) candidate translations, mm.
        width: distance at which a step no longer counts, mm.
        share: a shift is abandoned once it cannot reach this share of the best vote so far.

    Returns:
        (T,) votes; those of abandoned shifts are incomplete.
    """
    votes = np.zeros(shifts.shape[0])
    rest = np.zeros(hypotheses.shape[0] + 1)
    for i in range(hypotheses.shape[0] - 1, -1, -1):
        rest[i] = rest[i + 1] + weights[i].max()
    highest = 0.0
    for t in range(shifts.shape[0]):
        total = 0.0
        for i in range(hypotheses.shape[0]):
            if total + rest[i] < share * highest:
                break
            along = 0.0
            for k in range(3):
                along += directions[i, k] * shifts[t, k]
            best = 0.0
            for k in range(hypotheses.shape[1]):
                off = (hypotheses[i, k] - along) / width
                if weights[i, k] > 0.0 and abs(off) < 1.0:
                    best = max(best, weights[i, k] * (1.0 - off * off))
            total += best
        votes[t] = total
        highest = max(highest, total)
    return votes
