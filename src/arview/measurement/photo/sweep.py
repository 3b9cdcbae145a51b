"""Object-space sweep: the offset along its normal at which a surface looks alike in the photos.

This is plane sweeping (Collins, CVPR 1996; Gallup et al., CVPR 2007) with one patch of the CAD surface for each sample
in place of a plane. Each sample measures its offset along its normal; together they give the motion of the component,
as in point-to-plane registration (Chen & Medioni 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad import Samples, sample_surface
from arview.geometry import Array, apply
from arview.measurement.photo.component import MeasuredComponent
from arview.measurement.photo.fit import RigidFit, fit_rigid, move_rows
from arview.measurement.photo.kernels import choose_views, sweep_scores, vote_shifts
from arview.measurement.photo.options import UNDETERMINED_MM
from arview.measurement.photo.patches import (
    cut_patches,
    face_normals,
    near_edges,
    near_others,
    shades_of,
    tangents_of,
)
from arview.measurement.photo.views import PhotoViews
from arview.measurement.types import Move, NotMeasured
from arview.rendering import RayCaster

SAMPLES = 1000
"""Samples on a component's surface; more of them overlap and add cost without information."""
PATCH_PX = 13
"""Width of a patch: smaller ones are noisy, larger ones bridge the edges of small parts."""
PATCH_POINTS = 9
"""Points across a patch; a spacing of 1.5 px loses nothing and halves the time."""
SWEEP_EDGE_PX = 4.0
"""Samples nearer to a sharp edge are dropped: blur mixes them with what lies beyond."""
SAMPLE_SPACING_PX = 5.0
"""Spacing of the samples: about half a patch, so that each surface point lies in four patches."""
MAX_VIEWS = 7
"""Photos in which a sample is compared."""
MIN_VIEWS = 3
"""Photos in which a sample must be seen; of fewer, two may agree by chance."""
MIN_COSINE = 0.35
"""Smallest cosine between view and surface normal: 70°."""
CAPTURE_MM = 5.0
"""Largest displacement that the coarse round finds."""
FINE_RANGE_PX = 3.0
"""Search range of the first fine round; it narrows from round to round."""
ROUNDS = 5
"""Largest number of rounds; patches are cut anew at the moved place."""
CONVERGED_MM = 0.003
"""A smaller step ends the rounds."""
MIN_SCORE = 0.55
"""Mean correlation of a sample's views below which it is ignored."""
MIN_CONTRAST = 1.5
"""Standard deviation of a patch in grey levels below which it is noise."""
MAX_SIGMA_MM = 0.3
"""Largest standard deviation of one sample."""
MIN_SIGMA_MM = 0.015
"""Lower bound of a sample's standard deviation: form, lens, tessellation."""
MIN_SAMPLES = 25
"""Agreeing samples that a measurement needs."""
MIN_SUPPORT = 0.15
"""Share of the visible samples that must agree."""
MIN_DIRECTION = 0.2
"""Share of a direction's information that must agree for it to be determined."""
SYSTEMATIC_MM = 0.004
"""Standard deviation common to the whole component that residuals do not show."""
SYSTEMATIC_SHARE = 0.25
"""Share of the residuals that is common to all: reflections, shadows, blur at edges."""

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class SweepOffsets:
    """Result of a sweep for each sample.

    Attributes:
        offsets_mm: (N,) along the normal, from the sample to the surface that the photos show.
        variances_mm2: (N,) due to image noise alone; neighbouring samples share pixels, so their errors are correlated.
        is_ok: (N,) which samples gave a valid offset; the values of the others are meaningless.
        scores: (N,) mean correlation of the views at the peak.
        views: (N,V) photos that were compared, -1 for none.
    """

    offsets_mm: Array
    variances_mm2: Array
    is_ok: NDArray[np.bool_]
    scores: Array
    views: Indices


def sweep_offsets(
    samples_in_model: Array,
    normals: Array,
    views: PhotoViews,
    reach_mm: float,
    component: int | None = None,
    removed: int | None = None,
) -> SweepOffsets:
    """Measure the offset along the normal of samples of nearly flat surfaces, e.g. of a datum plane.

    Args:
        samples_in_model: (N,3) mm.
        normals: (N,3) unit, outwards.
        views: the photos. Occlusion is computed from the model at its nominal place.
        reach_mm: search range to either side.
        component: index of the component to which the samples belong: patches follow its surface. None: flat patches.
        removed: index of a component that is assumed to be absent.
    """
    samples = Samples(np.ascontiguousarray(samples_in_model), np.ascontiguousarray(normals))
    px_mm = views.mm_per_px(samples.points.mean(axis=0))
    caster, faces = None, None
    if component is not None:
        part = views.model.components[component]
        caster, faces = RayCaster(part.vertices_in_model, part.faces), face_normals(part)
    patches, is_on = cut_patches(samples, caster, faces, PATCH_POINTS, PATCH_PX / PATCH_POINTS * px_mm)
    chosen = pick_views(views, samples, component, removed=removed)
    steps = _steps(reach_mm, 0.4 * px_mm)
    scores, count, chosen = agreeing_scores(
        patches,
        is_on,
        shades_of(is_on),
        normals=samples.normals,
        steps=steps,
        chosen=chosen,
        views=views,
        min_contrast=1.5,
    )
    return _peaks(scores, count, steps, is_on.sum(axis=1), chosen)


def pick_views(
    views: PhotoViews,
    samples: Samples,
    component: int | None = None,
    place: Array | None = None,
    removed: int | None = None,
) -> Indices:
    """Choose the photos in which most of a sample's patch is visible.

    Args:
        views: the photos.
        samples: surface points with normals.
        component: index of the component to which the samples belong, or None.
        place: (4,4) of that component; default nominal.
        removed: index of a component that hides nothing.

    Returns:
        (N,V) indices of photos, -1 for none.
    """
    if not len(samples.points):
        return np.full((0, MAX_VIEWS), -1, dtype=np.int64)
    first, second = tangents_of(samples.normals)
    lift = samples.points + 0.05 * samples.normals
    # Points half-way to the patch's corners: near an edge patches extend beyond the surface, which does not matter.
    half_mm = 0.25 * PATCH_PX * views.mm_per_px(samples.points.mean(axis=0))
    groups = np.stack([lift, *(lift + half_mm * (a * first + b * second) for a, b in _CORNERS)], axis=1)
    toward = views.centres[None] - samples.points[:, None]
    toward /= np.linalg.norm(toward, axis=2, keepdims=True)
    cosines = np.einsum("nmx,nx->nm", toward, samples.normals)
    visible = np.zeros(cosines.shape, dtype=bool)
    scene = component if removed is None else -1 - removed
    for view in range(len(views.cameras)):
        facing = np.flatnonzero(cosines[:, view] > MIN_COSINE)
        if len(facing):
            window = views.window(view, scene, np.eye(4) if place is None else place, groups[facing].reshape(-1, 3))
            # The centre must show the component itself; the corners must not be hidden.
            own = views.visible(view, window, groups[facing, :1], -1 if component is None else component)
            visible[facing, view] = own & views.visible(view, window, groups[facing])
    middle = toward.mean(axis=0)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return np.asarray(choose_views(visible, cosines, middle, MAX_VIEWS))


_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_MIN_SIMILARITY = 0.35
"""Correlation with the mean of the other views below which a view is dropped."""


def without_outliers(
    chosen: Indices,
    scores: NDArray[np.float32],
    similarity: NDArray[np.float32],
    min_similarity: float = _MIN_SIMILARITY,
) -> Indices:
    """Drop views that differ from the others at the peak (highlights, occlusion), where three views remain.

    Args:
        chosen: (N,V) photos, -1 for none.
        scores: (N,S) mean correlations.
        similarity: (N,S,V) correlation of each view with the mean of the others.
        min_similarity: correlation below which a view is dropped.
    """
    best = np.argmax(scores, axis=1)
    own = similarity[np.arange(len(best)), best]
    kept = np.where(own >= min_similarity, chosen, -1)
    enough = np.count_nonzero(kept >= 0, axis=1) >= 3
    return np.where(enough[:, None], kept, chosen)


def agreeing_scores(
    patches: Array,
    is_on: NDArray[np.bool_],
    shades: Array,
    normals: Array,
    steps: Array,
    chosen: Indices,
    views: PhotoViews,
    min_contrast: float,
) -> tuple[NDArray[np.float32], NDArray[np.int8], Indices]:
    """Sweep, drop the views that differ from the others, and sweep those samples again.

    Args:
        patches, is_on, shades, normals, steps, min_contrast: see `sweep_scores`.
        chosen: (N,V) photos, -1 for none.
        views: the photos.

    Returns:
        scores (N,S), numbers of views (N,S), and the views (N,V) that remain.
    """
    stack = views.levels[0]
    scores, count, similarity = sweep_scores(
        patches, is_on, shades, normals=normals, steps=steps, views=chosen, stack=stack, min_contrast=min_contrast
    )
    kept = without_outliers(chosen, scores, similarity)
    changed = np.flatnonzero((kept != chosen).any(axis=1))
    scores[changed], count[changed], _ = sweep_scores(
        patches[changed],
        is_on[changed],
        shades[changed],
        normals=normals[changed],
        steps=steps,
        views=kept[changed],
        stack=stack,
        min_contrast=min_contrast,
    )
    return scores, count, kept


def _steps(reach_mm: float, step_mm: float) -> Array:
    """Equally spaced offsets from at least -reach to +reach, mm, with zero in the middle."""
    count = max(2, int(np.ceil(reach_mm / step_mm)))
    return np.asarray(np.arange(-count, count + 1) * step_mm, dtype=np.float64)


def _peaks(
    scores: NDArray[np.float32], count: NDArray[np.int8], steps: Array, on: Array, chosen: Indices
) -> SweepOffsets:
    """Sub-pixel position of the best score by a parabola, with its variance.

    The sum of squared differences of m views from their mean is (m - 1)(1 - score). Its second derivative, and the
    pixel variance that its minimum shows, give the variance of the position.
    """
    n, pitch = len(scores), steps[1] - steps[0]
    best, rows = np.clip(np.argmax(scores, axis=1), 1, len(steps) - 2), np.arange(n)
    a, b, c = (scores[rows, best + k].astype(np.float64) for k in (-1, 0, 1))
    bend = a - 2.0 * b + c
    is_peak = (b >= a) & (b >= c) & (bend < 0) & (a > -1.0) & (c > -1.0)
    bend = np.where(is_peak, bend, -1.0)
    offsets = steps[best] + 0.5 * pitch * (a - c) / bend
    views = count[rows, best].astype(np.float64)
    freedom = np.maximum(views - 1.0, 1.0) * np.maximum(on - 4.0, 1.0)  # neighbouring pixels of a patch are correlated
    variances = 2.0 * (1.0 - np.minimum(b, 0.999)) / freedom / (-bend / pitch**2)
    is_ok = is_peak & (b > MIN_SCORE) & (views >= MIN_VIEWS) & (variances < MAX_SIGMA_MM**2)
    is_ok &= on >= 0.4 * PATCH_POINTS**2
    return SweepOffsets(np.where(is_peak, offsets, 0.0), variances, is_ok, b, chosen)


def pose_rows(views: PhotoViews, samples: Samples, chosen: Indices) -> Array:
    """(N,6M) derivative of a sample's offset by the twists of the poses: that of a point triangulated in its views."""
    count, moment = len(views.cameras), np.zeros((len(samples.points), 3, 3))
    parts = []
    for view in range(count):
        of = np.flatnonzero((chosen == view).any(axis=1))
        if not len(of):
            continue
        pose, camera = views.cam_from_model[view], views.cameras[view]
        x, y, z = apply(pose, samples.points[of]).T
        zero = np.zeros_like(x)
        by_cam = camera.fx * np.stack(
            [np.stack([1 / z, zero, -x / z**2], axis=1), np.stack([zero, 1 / z, -y / z**2], axis=1)], axis=1
        )
        by_model = by_cam @ pose[:3, :3]
        moment[of] += np.swapaxes(by_model, 1, 2) @ by_model
        # A left twist (rotation w, translation t) moves a point x in the camera by w × x + t.
        turned = np.stack(
            [np.stack([zero, z, -y], axis=1), np.stack([-z, zero, x], axis=1), np.stack([y, -x, zero], axis=1)], axis=1
        )
        by_twist = np.concatenate([by_cam @ turned, by_cam], axis=2)
        parts.append((view, of, np.swapaxes(by_model, 1, 2) @ by_twist))
    inverse = np.linalg.pinv(moment)
    result = np.zeros((len(samples.points), 6 * count))
    for view, of, mixed in parts:
        result[of, 6 * view : 6 * view + 6] = -np.einsum("nx,nxy,nyk->nk", samples.normals[of], inverse[of], mixed)
    return result


class ComponentSweep:
    """The sweep of one component; samples and patches are cut at its nominal place and moved with it."""

    def __init__(self, body: MeasuredComponent) -> None:
        self.body, self.views = body, body.views
        samples = sample_surface(body.shape, SAMPLE_SPACING_PX * body.px_mm, SAMPLES)
        apart = ~near_others(samples.points, self.views.model, body.index, body.joint_mm)
        apart &= ~near_edges(samples.points, body.shape, SWEEP_EDGE_PX * body.px_mm)
        self.samples = samples.of(apart)
        self.patch_mm = PATCH_PX * body.px_mm
        self._caster = RayCaster(body.shape.vertices_in_model, body.shape.faces)
        self._faces = face_normals(body.shape)
        self._picked: list[tuple[Array, Indices]] = []

    def measure(self, starts: Sequence[Array] = ()) -> Move | NotMeasured:
        """Measure the component's move.

        Args:
            starts: places (4,4) to try besides the one that the coarse round finds.
        """
        chosen = self._pick(np.eye(4))
        seen = np.count_nonzero(chosen >= 0, axis=1) >= MIN_VIEWS
        if np.count_nonzero(seen) < MIN_SAMPLES:
            return NotMeasured(
                self.body.shape.name,
                "sweep",
                f"fewer than {MIN_VIEWS} photos show it well enough; take more photos of it",
                is_unseen=True,
            )
        patches, is_on = self._cut(PATCH_POINTS, PATCH_PX / PATCH_POINTS * self.body.px_mm)
        shades, places = shades_of(is_on), [self._coarse(chosen, seen), *starts]
        place = max(places, key=lambda p: self._similarity(p, patches, is_on, shades)) if starts else places[0]
        fit: RigidFit | None = None
        range_px = FINE_RANGE_PX
        for turn in range(ROUNDS):
            chosen = self._pick(place)
            steps = _steps(range_px * self.body.px_mm, 0.4 * self.body.px_mm)
            moved = Samples(apply(place, self.samples.points), self.samples.normals @ place[:3, :3].T)
            shaped = apply(place, patches)
            scores, count, chosen = agreeing_scores(
                shaped,
                is_on,
                shades,
                normals=moved.normals,
                steps=steps,
                chosen=chosen,
                views=self.views,
                min_contrast=MIN_CONTRAST,
            )
            found = _peaks(scores, count, steps, is_on.sum(axis=1), chosen)
            ok = found.is_ok
            seen = np.count_nonzero(chosen >= 0, axis=1) >= MIN_VIEWS
            if np.count_nonzero(ok) < MIN_SAMPLES:
                return self._not(
                    f"weak texture: only {np.count_nonzero(ok)} of {np.count_nonzero(seen)} samples of its surface "
                    "could be matched between the photos"
                )
            fit = self._fit(moved, found, seen, place)
            place = self.body.moved(place, fit.twist)
            step = self.body.size_mm(fit.twist)
            if turn >= 1 and step < CONVERGED_MM:
                break
            range_px = max(1.6, min(range_px, 0.6 * range_px + 2.0 * step / self.body.px_mm))
        assert fit is not None
        used = int(np.count_nonzero(fit.weights > 0.1))
        support = used / max(1, int(np.count_nonzero(seen)))
        if support < MIN_SUPPORT or used < MIN_SAMPLES:
            return self._not(f"weak texture, or missing: only {100 * support:.0f} % of its surface agrees on a place")
        if len(fit.undetermined) == 6:
            return self._not("weak texture: too little of its surface agrees on a place in any direction")
        by_poses = fit.gain @ pose_rows(self.views, moved.of(ok), found.views[ok])
        systematic_mm = float(np.hypot(SYSTEMATIC_MM, SYSTEMATIC_SHARE * fit.residual_mm))
        return self.body.move("sweep", fit, by_poses, place, systematic_mm, support)

    def _similarity(self, place: Array, patches: Array, is_on: NDArray[np.bool_], shades: Array) -> float:
        """Sum of the samples' scores above 0.3 at a place, within a pixel along the normals; for comparing starts."""
        steps = 0.7 * self.body.px_mm * np.arange(-1.0, 2.0)
        normals = self.samples.normals @ place[:3, :3].T
        scores, _, _ = sweep_scores(
            apply(place, patches),
            is_on,
            shades,
            normals=normals,
            steps=steps,
            views=self._pick(place),
            stack=self.views.levels[0],
            min_contrast=1.5,
        )
        return float(np.maximum(scores.max(axis=1) - 0.3, 0.0).sum())

    def _pick(self, place: Array) -> Indices:
        """Photos for a place; those of an earlier place that hardly differs are used again."""
        for before, chosen in self._picked:
            if self.body.is_same(before, place):
                return chosen
        moved = Samples(apply(place, self.samples.points), self.samples.normals @ place[:3, :3].T)
        chosen = pick_views(self.views, moved, self.body.index, place)
        self._picked.append((place, chosen))
        return chosen

    def _cut(self, width: int, spacing_mm: float) -> tuple[Array, NDArray[np.bool_]]:
        """Patches on the component's surface, without what is near other components or sharp edges."""
        patches, is_on = cut_patches(self.samples, self._caster, self._faces, width, spacing_mm)
        points = patches[is_on]
        apart = ~near_others(points, self.views.model, self.body.index, self.body.joint_mm)
        is_on[is_on] = apart & ~near_edges(points, self.body.shape, SWEEP_EDGE_PX * self.body.px_mm)
        return patches, is_on

    def _coarse(self, chosen: Indices, seen: NDArray[np.bool_]) -> Array:
        """Place within the capture range at which most samples look alike: votes for translations, then a fit."""
        # Choose the resolution such that the range has about forty steps, with patches of matching size.
        level = int(np.clip(np.round(np.log2(0.4 / self.body.px_mm)) + 1, 1, 2))
        coarse_mm = self.body.px_mm * 2**level
        patches, is_on = self._cut(7, coarse_mm)
        steps = _steps(CAPTURE_MM + coarse_mm, 0.6 * coarse_mm)
        normals = self.samples.normals
        scores, _, _ = sweep_scores(
            patches,
            is_on,
            shades_of(is_on),
            normals=normals,
            steps=steps,
            views=chosen,
            stack=self.views.levels[level],
            min_contrast=1.0,
        )
        shifts = self.body.shifts(CAPTURE_MM)
        votes = vote_shifts(scores[seen], steps, normals[seen], shifts, 0.3)
        # Of equal votes the nearest shift wins, because sliding a surface within itself changes nothing.
        best = shifts[np.flatnonzero(votes > votes.max() - 0.005 * abs(votes.max()) - 1e-9)[0]]
        twist = np.concatenate([np.zeros(3), best])
        rows = move_rows(self.samples.points, normals, self.body.center)
        for reach_mm in (3.0 * coarse_mm, 2.0 * coarse_mm, 2.0 * coarse_mm):
            near = np.where(np.abs(steps[None] - (rows @ twist)[:, None]) < reach_mm, scores, -1.0)
            found = _peaks(near, np.full(near.shape, 3), steps, is_on.sum(axis=1), chosen)
            ok = seen & (found.scores > 0.5) & (found.variances_mm2 < 1.0)
            if np.count_nonzero(ok) < MIN_SAMPLES:
                break
            sigmas = np.full(np.count_nonzero(ok), 0.3 * coarse_mm)
            twist = fit_rigid(
                rows[ok],
                found.offsets_mm[ok],
                sigmas,
                free=self.body.free,
                radius_mm=self.body.radius_mm,
                undetermined_mm=UNDETERMINED_MM,
                places=self._places(self.samples.of(ok)),
                min_sigma=0.3,
            ).twist
        return self.body.moved(np.eye(4), twist)

    def _fit(self, moved: Samples, found: SweepOffsets, seen: NDArray[np.bool_], place: Array) -> RigidFit:
        """Fit the component's motion to the offsets of the moved samples."""
        ok = found.is_ok
        rows = move_rows(moved.points, moved.normals, apply(place, self.body.center))
        return fit_rigid(
            rows[ok],
            found.offsets_mm[ok],
            np.sqrt(found.variances_mm2[ok] + MIN_SIGMA_MM**2),
            free=self.body.free_at(place),
            radius_mm=self.body.radius_mm,
            undetermined_mm=UNDETERMINED_MM,
            places=self._places(moved.of(ok)),
            min_sigma=0.3,
            searched_rows=rows[seen],
            min_support=MIN_DIRECTION,
        )

    def _places(self, samples: Samples) -> Array:
        """(N,6) positions in patch widths and scaled normals, so that faces of different orientation are far apart."""
        return np.concatenate([samples.points / self.patch_mm, 8.0 * samples.normals], axis=1)

    def _not(self, reason: str) -> NotMeasured:
        return NotMeasured(self.body.shape.name, "sweep", reason)
