"""Joint refinement of one similarity ``model_from_scan`` from the CAD's edges in all photos.

The relative poses of the photos are those of the reconstruction. The seven unknowns (rotation, translation, scale) are
found by Gauss-Newton on the distances between projected CAD edges and steps of brightness. A component that is not at
its nominal position would bias them, so every component except the base has a displacement of its own, with a
heavy-tailed prior at zero (Lange, Little & Taylor 1989) whose width is estimated from the displacements themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core import subpixel_edges
from arview.core.fits import robust_sigma, tukey_weights
from arview.core.parallel import pool
from arview.geometry import Array, apply
from arview.reconstruction.scale.similarity import Similarity
from arview.rendering import EDGE_SHARP, EDGE_SILHOUETTE, ZBufferRenderer, sample_visible_edges
from arview.rendering.mesh_edges import mesh_edges


@dataclass(frozen=True)
class ScaleView:
    """A photo as the refinement uses it.

    Attributes:
        name: of the photo.
        camera: of ``gray``, with distortion.
        gray: (H,W) float32, in linear light, slightly smoothed.
        cam_from_scan: (4,4), in the unit of the reconstruction.
    """

    name: str
    camera: Camera
    gray: NDArray[np.float32]
    cam_from_scan: Array


ROUGH_REACHES_PX: tuple[float, ...] = (12.0, 10.0, 7.0, 5.0)
"""Search range across the edges in each round from a distant start, in px of the views."""
REACHES_PX: tuple[float, ...] = (7.0, 5.0, 3.5, 3.0, 3.0, 3.0)
"""Search range in each round from a near start."""
SPACING_PX = 6.0
"""Distance between samples along an edge, in px of the views."""
DRAWN_WIDTH_PX = 800
"""Longer side at which hidden edges are determined."""
HALF_WIDTH_PX = 3.0
"""Profiles are averaged over this distance to either side along the edge."""
THRESHOLD = 1.0
"""Weakest step, in grey levels (of 255) per px in linear light."""
HALF_SLOPE = 6.0
"""Slope at which a step has half its full weight."""
CONTACT_PX = 3.0
"""Edges this near to a surface of another component, in rendered px, are joints (and often welds)."""
MIN_SIGMA_PX = 0.1
"""Lower bound of the residuals' standard deviation: lens, tessellation, pixel response."""
NEAR_PX = 1.5
"""Distance up to which a step supports an edge."""
CLEAR_BASE = 0.9
"""Mean share of the base's edges that the others cannot have pulled away from it."""
BESIDE_PX = 9.0
"""Distance beside the edges at which chance is measured."""
DARK_SHIFT_PX = 0.1
"""Standard deviation of a common shift of all edges to the dark side: tone curve, glare."""
MIN_DISPLACEMENT_MM = 0.05
"""Lower bound of the width of the prior on displacements."""
BASE_SIGMA_MM = 0.05
"""Standard deviation of an error of the base's edges: shadows, a bench of the same colour."""
SYSTEMATIC_PX = 0.05
"""Standard deviation of a common error of all edges, for the uncertainty: chamfers, tone curve."""


@dataclass(frozen=True)
class Fit:
    """Result of the joint refinement.

    Attributes:
        similarity: at the optimum.
        covariance: (7,7) of the step of `Similarity.moved`, for residuals that are correlated along an edge, in a photo
            and in a component.
        sigma_px: robust standard deviation of the edges' offsets.
        displacements_mm: (C,3) of the components, in the model; zero for the base.
        samples: edge points of each view, for further measurements.
    """

    similarity: Similarity
    covariance: Array
    sigma_px: float
    displacements_mm: Array
    samples: list[CadEdgePoints]


@dataclass(frozen=True)
class Support:
    """How well the photos support a similarity.

    Attributes:
        by_view, by_component: share of edge points with a step of brightness where predicted, beyond chance: 0 = no
            more than beside the edges, 1 = all; NaN where nothing was searched.
        share, chance: shares over all points, at the edges and beside them.
        is_base: (C,) which components define the frame.
    """

    by_view: Array
    by_component: Array
    share: float
    chance: float
    is_base: NDArray[np.bool_]

    @property
    def score(self) -> float:
        """Mean of the components' shares, for comparing similarities in the same photos."""
        return _mean(self.by_component)

    @property
    def base_score(self) -> float:
        """Mean share of the base, because other components may be displaced."""
        return _mean(self.by_component[self.is_base])


@dataclass(frozen=True)
class CadEdgePoints:
    """Visible CAD edge points of one view.

    Attributes:
        points, tangents: (N,3) points (mm) and unit tangents in the model.
        component: (N,) index.
        feature: (N,) number of the straight line to which the point belongs.
    """

    points: Array
    tangents: Array
    component: NDArray[np.int32]
    feature: NDArray[np.int64]

    def of(self, which: NDArray[np.bool_]) -> CadEdgePoints:
        """The chosen points."""
        return CadEdgePoints(self.points[which], self.tangents[which], self.component[which], self.feature[which])


@dataclass(frozen=True)
class EdgeResiduals:
    """Steps found at the edge points of one view.

    Attributes:
        rows: (M,8) derivatives by the twist and d log(scale), and the sign of the step for a shift to the dark side.
        offsets: (M,) from the predicted edge to the step, px.
        component, feature: (M,) to which each belongs.
        searched, found: (C,) number of points inside the picture, and of those with a step near them.
    """

    rows: Array
    offsets: Array
    component: NDArray[np.int32]
    feature: NDArray[np.int64]
    searched: NDArray[np.int64]
    found: NDArray[np.int64]


class JointRefiner:
    """Refines similarities of one model in some views."""

    def __init__(self, model: Model, base: Sequence[str], views: Sequence[ScaleView]) -> None:
        self.model, self.base = model, tuple(base)
        self.views = tuple(views)
        self.center = model.center_in_model
        self._edges = mesh_edges(model)
        self._is_base = np.array([component.name in base for component in model.components])

    def samples(self, view: ScaleView, cam_from_model: Array) -> CadEdgePoints:
        """Edge points that the view shows, without joints between components and folds of curved surfaces."""
        shrink = min(1.0, DRAWN_WIDTH_PX / max(view.camera.width, view.camera.height))
        drawn = view.camera.without_distortion().scaled(
            round(view.camera.width * shrink), round(view.camera.height * shrink)
        )
        rendering = ZBufferRenderer(self.model, drawn).render(cam_from_model)
        lens = (drawn.fx, drawn.fy, drawn.cx, drawn.cy)
        found = sample_visible_edges(self._edges, cam_from_model, lens, rendering.depth_mm, SPACING_PX * shrink)
        in_cam, _, normals, _ = _projected(drawn, cam_from_model, found.points_in_model, found.tangents_in_model)
        depth = in_cam[:, 2]
        is_good = (found.kinds & (EDGE_SHARP | EDGE_SILHOUETTE)) > 0
        for side in (-CONTACT_PX, CONTACT_PX):
            u, v = np.round(found.pixels + side * normals).astype(np.intp).T
            u, v = np.clip(u, 0, drawn.width - 1), np.clip(v, 0, drawn.height - 1)
            other = rendering.component_ids[v, u]
            is_near = np.abs(rendering.depth_mm[v, u] - depth) < 2.0 * CONTACT_PX * depth / drawn.fx
            is_good &= ~((other >= 0) & (other != found.component) & is_near)
        points, tangents, component = (
            found.points_in_model[is_good],
            found.tangents_in_model[is_good],
            found.component[is_good],
        )
        return CadEdgePoints(points, tangents, component, self._features(points, tangents, component))

    def rough(self, start: Similarity) -> tuple[Similarity, Support]:
        """Refine from a distant start, with all components and with the base alone; keep the one that fits the base
        better.
        """
        tried = []
        for components in (np.ones_like(self._is_base), self._is_base):
            fit = self.refine(start, ROUGH_REACHES_PX, components)
            tried.append((fit.similarity, self.support(fit.similarity)))
            if self._is_base.all() or tried[0][1].base_score > CLEAR_BASE:
                break
        return max(tried, key=lambda pair: pair[1].base_score)

    def refine(
        self,
        start: Similarity,
        reaches_px: Sequence[float] | None = None,
        components: NDArray[np.bool_] | None = None,
    ) -> Fit:
        """Refine from a near start to the similarity on which the edges of all views, or of some ``components`` (C,),
        agree.
        """
        reaches = reaches_px or REACHES_PX
        similarity, samples = start, self.sample_all(start, components)
        displacements = np.zeros((len(self._is_base), 3))
        for index, reach_px in enumerate(reaches):
            if index == len(reaches) - 2:
                samples = self.sample_all(similarity, components)
            measured = self.measure_all(similarity, samples, reach_px)
            system = _JointSystem(measured, displacements, self._is_base)
            step, displacements = system.solve()
            similarity = similarity.moved(step, self.center)
        covariance = system.covariance() + self._systematic(similarity, samples)
        return Fit(similarity, covariance, system.sigma_px, displacements, samples)

    def _systematic(self, similarity: Similarity, samples: Sequence[CadEdgePoints]) -> Array:
        """(7,7) covariance of errors that residuals do not show: all edges a little too far out, or to one side."""
        points = np.concatenate([s.points for s in samples]) - self.center
        if not len(points):
            return np.zeros((7, 7))
        radius_mm = float(np.sqrt(np.mean(np.sum(points * points, axis=1))))
        pixels = [
            apply(similarity.cam_from_model(view.cam_from_scan), self.center)[2] / view.camera.fx for view in self.views
        ]
        sigma_mm = SYSTEMATIC_PX * float(np.median(pixels))
        shift_mm = float(np.hypot(sigma_mm, BASE_SIGMA_MM))
        return np.diag(np.repeat([sigma_mm / radius_mm, shift_mm, sigma_mm / radius_mm], [3, 3, 1]) ** 2)

    def support(self, similarity: Similarity, samples: Sequence[CadEdgePoints] | None = None) -> Support:
        """Share of predicted edges that the views show, compared with the share found beside them."""
        samples = samples or self.sample_all(similarity)
        counts = []
        for shift_px in (0.0, -BESIDE_PX, BESIDE_PX):
            measured = self.measure_all(similarity, samples, 2.0 * NEAR_PX, shift_px)
            counts.append([np.stack([m.searched for m in measured]), np.stack([m.found for m in measured])])
        (searched, found), (left, by_left), (right, by_right) = counts

        def contrast(axis: int) -> Array:
            with np.errstate(invalid="ignore", divide="ignore"):
                share = found.sum(axis) / np.where(searched.sum(axis) >= 10, searched.sum(axis), np.nan)
                chance = (by_left + by_right).sum(axis) / (left + right).sum(axis)
                return np.asarray((share - chance) / (1.0 - np.minimum(chance, 0.95)))

        chance = (by_left + by_right).sum() / max(1, (left + right).sum())
        return Support(
            contrast(1), contrast(0), float(found.sum() / max(1, searched.sum())), float(chance), self._is_base
        )

    def measure(
        self, view: ScaleView, samples: CadEdgePoints, cam_from_model: Array, reach_px: float, shift_px: float = 0.0
    ) -> EdgeResiduals:
        """Find steps of brightness near the predicted edges, and their derivatives by a step of the similarity.

        With ``shift_px`` the search is beside the edges, where steps are found by chance.
        """
        _, pixels, normals, by_cam = _projected(view.camera, cam_from_model, samples.points, samples.tangents)
        all_offsets, all_slopes, seen = subpixel_edges.find_steps(
            view.gray, pixels + shift_px * normals, normals, reach_px, HALF_WIDTH_PX, THRESHOLD
        )
        offsets, slopes = subpixel_edges.choose_steps(all_offsets, all_slopes, 0.4 * reach_px, HALF_SLOPE)
        is_found = seen & (slopes != 0.0)
        by_model = by_cam @ cam_from_model[:3, :3]
        rows = np.concatenate(
            [
                np.cross(samples.points - self.center, by_model),
                by_model,
                (by_cam @ apply(cam_from_model, self.center))[:, None],
                np.sign(slopes)[:, None],
            ],
            axis=1,
        )
        count = len(self._is_base)
        return EdgeResiduals(
            rows[is_found],
            offsets[is_found],
            samples.component[is_found],
            samples.feature[is_found],
            np.bincount(samples.component[seen], minlength=count),
            np.bincount(samples.component[is_found & (np.abs(offsets) < 0.5 * reach_px)], minlength=count),
        )

    def measure_all(
        self, start: Similarity, samples: Sequence[CadEdgePoints], reach_px: float, shift_px: float = 0.0
    ) -> list[EdgeResiduals]:
        """`measure` for every view."""

        def one(pair: tuple[ScaleView, CadEdgePoints]) -> EdgeResiduals:
            return self.measure(pair[0], pair[1], start.cam_from_model(pair[0].cam_from_scan), reach_px, shift_px)

        return list(pool().map(one, zip(self.views, samples, strict=True)))

    def sample_all(self, start: Similarity, components: NDArray[np.bool_] | None = None) -> list[CadEdgePoints]:
        """`samples` of every view, optionally of some ``components`` (C,) only."""

        def one(view: ScaleView) -> CadEdgePoints:
            found = self.samples(view, start.cam_from_model(view.cam_from_scan))
            return found if components is None else found.of(components[found.component])

        return list(pool().map(one, self.views))

    def _features(self, points: Array, tangents: Array, component: NDArray[np.int32]) -> NDArray[np.int64]:
        """(N,) one number for all points of a component on the same straight line, whose errors are correlated."""
        sign = np.sign(np.take_along_axis(tangents, np.argmax(np.abs(tangents), axis=1)[:, None], axis=1))
        direction = np.round(4.0 * tangents * sign).astype(np.int64)
        foot = points - self.center - np.sum((points - self.center) * tangents, axis=1, keepdims=True) * tangents
        place = np.round(foot / (0.02 * self.model.diameter_mm)).astype(np.int64)
        key = np.concatenate([component[:, None], direction, place], axis=1)
        return np.asarray(key @ np.array([1, 7, 67, 641, 6113, 1000003, 160005571], dtype=np.int64))


def _projected(
    camera: Camera, cam_from_model: Array, points: Array, tangents: Array
) -> tuple[Array, Array, Array, Array]:
    """`project_edges` of one camera."""
    lens = np.array([[camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist]])
    return subpixel_edges.project_edges(
        points, tangents, np.zeros(len(points), dtype=np.int64), cam_from_model[None, :3], lens
    )


def _mean(values: Array) -> float:
    """Mean of the finite values; 0 if there are none."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else 0.0


class _JointSystem:
    """Equations of one round: 8 common unknowns, and 3 for each component that may be displaced."""

    def __init__(self, measured: Sequence[EdgeResiduals], displacements: Array, is_base: NDArray[np.bool_]) -> None:
        component = np.concatenate([m.component for m in measured])
        order = np.argsort(component, kind="stable")
        self.component = component[order]
        ends = np.cumsum(np.bincount(component, minlength=len(is_base)))
        self.of = [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]
        self.rows = np.concatenate([m.rows for m in measured])[order]
        self.offsets = np.concatenate([m.offsets for m in measured])[order]
        self.feature = np.concatenate([m.feature for m in measured])[order]
        self.view = np.repeat(np.arange(len(measured)), [len(m.offsets) for m in measured])[order]
        self.is_base = is_base
        # Residuals with each component at the place that the previous round found.
        left = self.offsets - np.sum(self.rows[:, 3:6] * displacements[self.component], axis=1)
        self.sigma_px = max(MIN_SIGMA_PX, robust_sigma(left) if len(left) else np.inf)
        self.weights = tukey_weights(left / self.sigma_px) / self.sigma_px**2
        moving = np.linalg.norm(displacements[~is_base], axis=1)
        width_mm = max(MIN_DISPLACEMENT_MM, 0.6 * float(np.median(moving)) if len(moving) else 0.0)
        # Student's t with one degree of freedom in three dimensions.
        self.prior = np.where(is_base, 1.0 / BASE_SIGMA_MM**2, 4.0 / (width_mm**2 + np.sum(displacements**2, axis=1)))
        self.dark_prior = 1.0 / DARK_SHIFT_PX**2

    def solve(self) -> tuple[Array, Array]:
        """Step (7,) of the similarity, and displacements (C,3) of the components."""
        weighted = self.rows * self.weights[:, None]
        hessian, gradient = weighted.T @ self.rows, weighted.T @ self.offsets
        hessian[7, 7] += self.dark_prior
        reduced, right = hessian.copy(), gradient.copy()
        own = {}
        for index, of in enumerate(self.of):
            mixed = weighted[of].T @ self.rows[of, 3:6]
            inner = np.linalg.inv(mixed[3:6] + self.prior[index] * np.eye(3))
            pull = weighted[of, 3:6].T @ self.offsets[of]
            own[index] = (mixed, inner, pull)
            reduced -= mixed @ inner @ mixed.T
            right -= mixed @ inner @ pull
        self.inverse = np.linalg.pinv(reduced, hermitian=True)
        solution = self.inverse @ right
        displacements = np.zeros((len(self.is_base), 3))
        self.projected = self.rows.copy()
        for index, (mixed, inner, pull) in own.items():
            displacements[index] = inner @ (pull - mixed.T @ solution)
            self.projected[self.of[index]] -= self.rows[self.of[index], 3:6] @ inner @ mixed.T
        self.left = self.offsets - self.rows @ solution - np.sum(self.rows[:, 3:6] * displacements[self.component], 1)
        return solution[:7], displacements

    def covariance(self) -> Array:
        """(7,7) of the solution, with errors correlated within a photo, along an edge and within a component.

        The cluster-robust estimate (Liang & Zeger 1986), summed over these three groupings of the residuals.
        """
        total = np.zeros((8, 8))
        for labels, rows in ((self.view, self.projected), (self.feature, self.projected), (self.component, self.rows)):
            groups, inverse = np.unique(labels, return_inverse=True)
            if len(groups) < 2:
                continue
            scores = np.zeros((len(groups), 8))
            np.add.at(scores, inverse, rows * (self.weights * self.left)[:, None])
            total += scores.T @ scores * len(groups) / (len(groups) - 1)
        return np.asarray((self.inverse @ total @ self.inverse)[:7, :7])
