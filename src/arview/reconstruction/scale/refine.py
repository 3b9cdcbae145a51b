"""Joint refinement: one similarity ``model_from_scan`` from the CAD's edges in all photos at once.

The relative poses of the photos are those of the reconstruction; seven unknowns are left (rotation, translation,
scale), found by Gauss-Newton on the distances between projected CAD edges and steps of brightness. A component that
is not where the CAD says would pull them along, so each but the base has a displacement of its own, held near zero
by a heavy-tailed prior (Lange, Little & Taylor 1989) whose width the components themselves say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.core.parallel import pool
from arview.core.subpixel_edges import choose_steps, find_steps
from arview.geometry import Array, apply
from arview.guideviews.mesh_edges import EDGE_SHARP, EDGE_SILHOUETTE, mesh_edges, sample_visible_edges
from arview.reconstruction.scale.similarity import Similarity
from arview.rendering.renderers import ZBufferRenderer


@dataclass(frozen=True)
class ScaleView:
    """A photo as the refinement sees it.

    Attributes:
        name: of the photo.
        camera: of ``gray``, with distortion.
        gray: (H,W) float32, linear light, a little smoothed.
        cam_from_scan: (4,4), unit of the reconstruction.
    """

    name: str
    camera: Camera
    gray: NDArray[np.float32]
    cam_from_scan: Array


@dataclass(frozen=True)
class RefineOptions:
    """Options of the joint refinement.

    Attributes:
        rough_reaches_px, reaches_px: how far edges are looked for, round by round, in px of the views; first in a few.
        spacing_px: between samples along an edge, in px of the views.
        drawn_width_px: longer side at which hidden edges are found out; finer shows little more.
        half_width_px: profiles are averaged so far along the edge.
        threshold: weakest step, grey levels of 255 per px in linear light.
        half_slope: a step of this slope counts half.
        contact_px: an edge this near to a surface of another component, in px drawn, is a joint (and often a weld).
        min_sigma_px: residuals are never taken to be better than this: lens, tessellation, pixel response.
        near_px, beside_px: a step so near bears an edge out; chance is counted so far beside it.
        dark_shift_px: how far all edges may be shifted towards the dark side (1 σ): tone curve, glare.
        min_displacement_mm: width of the prior on displacements of components, at least.
        base_sigma_mm: how far the edges of the base may mislead (shadows below, a bench of the same colour).
        systematic_px: what all edges may be off together (chamfers, tone curve), for the uncertainty.
    """

    rough_reaches_px: tuple[float, ...] = (12.0, 10.0, 7.0, 5.0)
    reaches_px: tuple[float, ...] = (7.0, 5.0, 3.5, 3.0, 3.0, 3.0)
    spacing_px: float = 6.0
    drawn_width_px: int = 800
    half_width_px: float = 3.0
    threshold: float = 1.0
    half_slope: float = 6.0
    contact_px: float = 3.0
    min_sigma_px: float = 0.1
    near_px: float = 1.5
    beside_px: float = 9.0
    dark_shift_px: float = 0.1
    min_displacement_mm: float = 0.05
    base_sigma_mm: float = 0.05
    systematic_px: float = 0.05


@dataclass(frozen=True)
class Fit:
    """The joint refinement's result.

    Attributes:
        similarity: at the optimum.
        covariance: (7,7) of the step that `Similarity.moved` takes, from residuals that are alike along an edge, in a
            photo and in a component.
        sigma_px: robust standard deviation of the edges' offsets.
        displacements_mm: (C,3) of the components, in the model; zero for the base.
        samples: of each view, for looking again.
    """

    similarity: Similarity
    covariance: Array
    sigma_px: float
    displacements_mm: Array
    samples: list[EdgeSamples]


@dataclass(frozen=True)
class Support:
    """How well a similarity is borne out.

    Attributes:
        by_view, by_component: share of edge points with a step of brightness where predicted, less what chance gives:
            0 = as much as beside the edges, 1 = all; NaN where nothing was looked at.
        share, chance: of all points: with a step at the edge, and beside it.
        is_base: (C,) which components define the frame.
    """

    by_view: Array
    by_component: Array
    share: float
    chance: float
    is_base: NDArray[np.bool_]

    @property
    def score(self) -> float:
        """Mean of the components' shares: for comparing similarities of the same photos."""
        return _mean(self.by_component)

    @property
    def base_score(self) -> float:
        """The same of the base: the others may be displaced."""
        return _mean(self.by_component[self.is_base])


@dataclass(frozen=True)
class EdgeSamples:
    """Visible CAD edge points of one view: (N,3) points and unit tangents in the model, component, feature (N,)."""

    points: Array
    tangents: Array
    component: NDArray[np.int32]
    feature: NDArray[np.int64]


@dataclass(frozen=True)
class EdgeResiduals:
    """What one view says.

    Attributes:
        rows: (M,8) of the Jacobian: twist, d log(scale), and the step's sign: the shift of all edges to the dark side.
        offsets: (M,) px from the predicted edge to the step.
        component, feature: (M,) of which each is.
        looked, found: (C,) points inside the picture, and those with a step near them.
    """

    rows: Array
    offsets: Array
    component: NDArray[np.int32]
    feature: NDArray[np.int64]
    looked: NDArray[np.int64]
    found: NDArray[np.int64]


class JointRefiner:
    """Refines similarities of one model and some views; what it needs of the model is made once."""

    def __init__(self, model: Model, base: Sequence[str], views: Sequence[ScaleView], options: RefineOptions) -> None:
        self.model = model
        self.views = tuple(views)
        self.options = options
        self.center = model.center_in_model
        self._edges = mesh_edges(model)
        self._is_base = np.array([component.name in base for component in model.components])

    def samples(self, view: ScaleView, cam_from_model: Array) -> EdgeSamples:
        """Edge points that the view shows, without joints of components and folds of curved surfaces."""
        o = self.options
        shrink = min(1.0, o.drawn_width_px / max(view.camera.width, view.camera.height))
        drawn = view.camera.without_distortion().scaled(
            round(view.camera.width * shrink), round(view.camera.height * shrink)
        )
        rendering = ZBufferRenderer(self.model, drawn).render(cam_from_model)
        lens = (drawn.fx, drawn.fy, drawn.cx, drawn.cy)
        found = sample_visible_edges(self._edges, cam_from_model, lens, rendering.depth_mm, o.spacing_px * shrink)
        depth = apply(cam_from_model, found.points_in_model)[:, 2]
        normals = self._normals(drawn, cam_from_model, found.points_in_model, found.tangents_in_model)
        is_good = (found.kinds & (EDGE_SHARP | EDGE_SILHOUETTE)) > 0
        for side in (-o.contact_px, o.contact_px):
            u, v = np.round(found.pixels + side * normals).astype(np.intp).T
            u, v = np.clip(u, 0, drawn.width - 1), np.clip(v, 0, drawn.height - 1)
            other = rendering.component_ids[v, u]
            is_near = np.abs(rendering.depth_mm[v, u] - depth) < 2.0 * o.contact_px * depth / drawn.fx
            is_good &= ~((other >= 0) & (other != found.component) & is_near)
        points, tangents, component = (
            found.points_in_model[is_good], found.tangents_in_model[is_good], found.component[is_good]
        )  # fmt: skip
        return EdgeSamples(points, tangents, component, self._features(points, tangents, component))

    def rough(self, start: Similarity) -> tuple[Similarity, Support]:
        """A similarity refined from far, by all components or by the base alone, whichever finds the base better."""
        tried = []
        for components in (np.ones_like(self._is_base), self._is_base):
            fit = self.refine(start, self.options.rough_reaches_px, components)
            tried.append((fit.similarity, self.support(fit.similarity)))
            if self._is_base.all():
                break
        return max(tried, key=lambda pair: pair[1].base_score)

    def refine(
        self,
        start: Similarity,
        reaches_px: Sequence[float] | None = None,
        components: NDArray[np.bool_] | None = None,
    ) -> Fit:
        """The similarity that the edges of all views agree on, from a near one; of some ``components`` (C,) only."""
        o = self.options
        reaches = reaches_px or o.reaches_px
        similarity, samples = start, self.sample_all(start, components)
        displacements = np.zeros((len(self._is_base), 3))
        for index, reach_px in enumerate(reaches):
            if index == len(reaches) - 2:
                samples = self.sample_all(similarity, components)
            measured = self.measure_all(similarity, samples, reach_px)
            system = _JointSystem(measured, displacements, self._is_base, o)
            step, displacements = system.solve()
            similarity = similarity.moved(step, self.center)
        covariance = system.covariance() + self._systematic(similarity, samples)
        return Fit(similarity, covariance, system.sigma_px, displacements, samples)

    def _systematic(self, similarity: Similarity, samples: Sequence[EdgeSamples]) -> Array:
        """(7,7) covariance of what residuals do not show: that all edges lie a little off, outwards or to one side."""
        points = np.concatenate([s.points for s in samples]) - self.center
        if not len(points):
            return np.zeros((7, 7))
        radius_mm = float(np.sqrt(np.mean(np.sum(points * points, axis=1))))
        pixels = [
            apply(similarity.cam_from_model(view.cam_from_scan), self.center)[2] / view.camera.fx for view in self.views
        ]
        sigma_mm = self.options.systematic_px * float(np.median(pixels))
        shift_mm = float(np.hypot(sigma_mm, self.options.base_sigma_mm))
        return np.diag(np.repeat([sigma_mm / radius_mm, shift_mm, sigma_mm / radius_mm], [3, 3, 1]) ** 2)

    def support(self, similarity: Similarity, samples: Sequence[EdgeSamples] | None = None) -> Support:
        """How many predicted edges the views show, against how many they show beside them."""
        o = self.options
        samples = samples or self.sample_all(similarity)
        counts = []
        for shift_px in (0.0, -o.beside_px, o.beside_px):
            measured = self.measure_all(similarity, samples, 2.0 * o.near_px, shift_px)
            counts.append([np.stack([m.looked for m in measured]), np.stack([m.found for m in measured])])
        (looked, found), (left, by_left), (right, by_right) = counts

        def contrast(axis: int) -> Array:
            with np.errstate(invalid="ignore", divide="ignore"):
                share = found.sum(axis) / np.where(looked.sum(axis) >= 10, looked.sum(axis), np.nan)
                chance = (by_left + by_right).sum(axis) / (left + right).sum(axis)
                return np.asarray((share - chance) / (1.0 - np.minimum(chance, 0.95)))

        chance = (by_left + by_right).sum() / max(1, (left + right).sum())
        return Support(
            contrast(1), contrast(0), float(found.sum() / max(1, looked.sum())), float(chance), self._is_base
        )

    def measure(
        self, view: ScaleView, samples: EdgeSamples, cam_from_model: Array, reach_px: float, shift_px: float = 0.0
    ) -> EdgeResiduals:
        """Steps of brightness near the predicted edges, and how these move with a step of the similarity.

        With ``shift_px`` it is looked beside the edges: what is found there is chance.
        """
        o = self.options
        in_cam = apply(cam_from_model, samples.points)
        pixels = view.camera.project(in_cam)
        normals = self._normals(view.camera, cam_from_model, samples.points, samples.tangents)
        all_offsets, all_slopes, seen = find_steps(
            view.gray, pixels + shift_px * normals, normals, reach_px, o.half_width_px, o.threshold
        )
        offsets, slopes = choose_steps(all_offsets, all_slopes, 0.4 * reach_px, o.half_slope)
        is_found = seen & (slopes != 0.0)
        # Through the lens by differences: of one micrometre per mm of depth.
        delta = 1e-6 * in_cam[:, 2:]
        by_cam = np.stack([
            np.sum((view.camera.project(in_cam + delta * axis) - pixels) * normals, axis=1) / delta[:, 0]
            for axis in np.eye(3)
        ], axis=1)  # fmt: skip
        by_model = by_cam @ cam_from_model[:3, :3]
        rows = np.concatenate([
            np.cross(samples.points - self.center, by_model), by_model,
            (by_cam @ apply(cam_from_model, self.center))[:, None], np.sign(slopes)[:, None],
        ], axis=1)  # fmt: skip
        count = len(self._is_base)
        return EdgeResiduals(
            rows[is_found], offsets[is_found], samples.component[is_found], samples.feature[is_found],
            np.bincount(samples.component[seen], minlength=count),
            np.bincount(samples.component[is_found & (np.abs(offsets) < 0.5 * reach_px)], minlength=count),
        )  # fmt: skip

    def measure_all(
        self, start: Similarity, samples: Sequence[EdgeSamples], reach_px: float, shift_px: float = 0.0
    ) -> list[EdgeResiduals]:
        """`measure` of every view."""

        def one(pair: tuple[ScaleView, EdgeSamples]) -> EdgeResiduals:
            return self.measure(pair[0], pair[1], start.cam_from_model(pair[0].cam_from_scan), reach_px, shift_px)

        return list(pool().map(one, zip(self.views, samples, strict=True)))

    def sample_all(self, start: Similarity, components: NDArray[np.bool_] | None = None) -> list[EdgeSamples]:
        """`samples` of every view, of some ``components`` (C,) only."""

        def one(view: ScaleView) -> EdgeSamples:
            found = self.samples(view, start.cam_from_model(view.cam_from_scan))
            if components is None:
                return found
            of = components[found.component]
            return EdgeSamples(found.points[of], found.tangents[of], found.component[of], found.feature[of])

        return list(pool().map(one, self.views))

    @staticmethod
    def _normals(camera: Camera, cam_from_model: Array, points: Array, tangents: Array) -> Array:
        """(N,2) unit normals of the edges in the picture."""
        in_cam = apply(cam_from_model, points)
        along = camera.project(in_cam + 1e-4 * in_cam[:, 2:] * (tangents @ cam_from_model[:3, :3].T))
        along -= camera.project(in_cam)
        with np.errstate(invalid="ignore"):
            along /= np.linalg.norm(along, axis=1, keepdims=True)
        return np.asarray(np.stack([-along[:, 1], along[:, 0]], axis=1))

    def _features(self, points: Array, tangents: Array, component: NDArray[np.int32]) -> NDArray[np.int64]:
        """One number for all points of a component on the same straight line: errors along it are alike."""
        sign = np.sign(np.take_along_axis(tangents, np.argmax(np.abs(tangents), axis=1)[:, None], axis=1))
        direction = np.round(4.0 * tangents * sign).astype(np.int64)
        foot = points - self.center - np.sum((points - self.center) * tangents, axis=1, keepdims=True) * tangents
        place = np.round(foot / (0.02 * self.model.diameter_mm)).astype(np.int64)
        key = np.concatenate([component[:, None], direction, place], axis=1)
        return np.asarray(key @ np.array([1, 7, 67, 641, 6113, 1000003, 160005571], dtype=np.int64))


def _mean(values: Array) -> float:
    """Of those that are numbers; 0 without any."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else 0.0


class _JointSystem:
    """The equations of one round: 8 common unknowns, 3 more for each component that may be displaced."""

    def __init__(
        self, measured: Sequence[EdgeResiduals], displacements: Array, is_base: NDArray[np.bool_], o: RefineOptions
    ) -> None:
        self.rows = np.concatenate([m.rows for m in measured])
        self.offsets = np.concatenate([m.offsets for m in measured])
        self.component = np.concatenate([m.component for m in measured])
        self.feature = np.concatenate([m.feature for m in measured])
        self.view = np.repeat(np.arange(len(measured)), [len(m.offsets) for m in measured])
        self.is_base = is_base
        # What is left over when each component is where it was last seen to be.
        left = self.offsets - np.sum(self.rows[:, 3:6] * displacements[self.component], axis=1)
        self.sigma_px = max(o.min_sigma_px, 1.4826 * float(np.median(np.abs(left))) if len(left) else np.inf)
        self.weights = np.clip(1.0 - (left / (4.685 * self.sigma_px)) ** 2, 0.0, None) ** 2 / self.sigma_px**2
        moving = np.linalg.norm(displacements[~is_base], axis=1)
        width_mm = max(o.min_displacement_mm, 0.6 * float(np.median(moving)) if len(moving) else 0.0)
        # Student's t with one degree of freedom in three dimensions.
        self.prior = np.where(is_base, 1.0 / o.base_sigma_mm**2, 4.0 / (width_mm**2 + np.sum(displacements**2, axis=1)))
        self.dark_prior = 1.0 / o.dark_shift_px**2

    def solve(self) -> tuple[Array, Array]:
        """Step (7,) of the similarity, and displacements (C,3) of the components."""
        weighted = self.rows * self.weights[:, None]
        hessian, gradient = weighted.T @ self.rows, weighted.T @ self.offsets
        hessian[7, 7] += self.dark_prior
        reduced, right = hessian.copy(), gradient.copy()
        own = {}
        for index in range(len(self.is_base)):
            of = self.component == index
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
            of = self.component == index
            self.projected[of] -= self.rows[of, 3:6] @ inner @ mixed.T
        self.left = self.offsets - self.rows @ solution - np.sum(self.rows[:, 3:6] * displacements[self.component], 1)
        return solution[:7], displacements

    def covariance(self) -> Array:
        """(7,7) of the solution, with errors alike in a photo, along an edge and in a component.

        The cluster-robust estimate (Liang & Zeger 1986), summed over the three ways to group the residuals.
        """
        total = np.zeros((8, 8))
        for labels, rows in (
            (self.view, self.projected), (self.feature, self.projected), (self.component, self.rows)
        ):  # fmt: skip
            groups, inverse = np.unique(labels, return_inverse=True)
            if len(groups) < 2:
                continue
            scores = np.zeros((len(groups), 8))
            np.add.at(scores, inverse, rows * (self.weights * self.left)[:, None])
            total += scores.T @ scores * len(groups) / (len(groups) - 1)
        return np.asarray((self.inverse @ total @ self.inverse)[:7, :7])
