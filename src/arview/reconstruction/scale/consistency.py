"""Check that the reconstruction has the shape of the CAD, which placed photos and small residuals do not prove."""

from __future__ import annotations

import numpy as np

from arview.cad import Model
from arview.core.parallel import pool
from arview.geometry import Array, apply
from arview.reconstruction.scale.cad import CadFind
from arview.reconstruction.scale.similarity import Similarity
from arview.reconstruction.scale.types import Consistency
from arview.reconstruction.types import SparseModel
from arview.rendering import ZBufferRenderer

MAX_SIDE_PX = 600
"""Longer side at which the CAD is rendered for the check of the points."""
NEAR_SHARE = 0.006
"""Distance, in diameters of the part, below which points lie on the CAD's surface; it allows for rough surfaces and
displaced components."""
RIM_PX = 3
"""Points this near to an outline, in rendered px, may belong to what is behind it."""
MIN_PHOTOS = 3
"""Points observed in fewer photos are often wrong matches."""
MIN_POINTS = 60
"""Points on the part that the check of the points needs."""
MIN_NEAR = 0.6
"""Smallest share of points near the surface."""
MAX_BEHIND = 0.15
"""Largest share of points behind the surface."""
MIN_EDGES = 0.25
"""Smallest share of edges found beyond chance, in the median photo."""
MIN_NEAR_IN_PART = 0.9
"""Share of points near the surface from which a part that is mostly hidden is consistent, too."""
CLEAR_EDGES = 0.6
MIN_CLEAR = 2
"""A part that is mostly hidden needs this many components of which a share of ``CLEAR_EDGES`` of the edges is found."""
MIN_RELATIVE_EDGES = 0.45
"""Share of edges found in one photo, relative to the median photo; a photo below does not fit."""
MAX_MISFITS = 0.1
"""Largest share of photos that do not fit."""


def check_consistency(
    sparse: SparseModel,
    model: Model,
    found: CadFind,
    similarity: Similarity,
) -> Consistency:
    """Check the edges of the CAD in every photo, and the sparse points against the CAD's surface.

    Args:
        sparse: the reconstruction, in an arbitrary unit.
        model: the CAD.
        found: the CAD as it was found in the photos.
        similarity: the similarity to check.
    """
    support = found.refiner.support(similarity)
    usual = float(np.nanmedian(support.by_view))
    is_misfit = support.by_view < MIN_RELATIVE_EDGES * usual
    misfits = tuple(v.name for v, bad in zip(found.refiner.views, is_misfit, strict=True) if bad)
    offsets = points_before_surface(sparse, model, similarity)
    tolerance_mm = NEAR_SHARE * model.diameter_mm
    near = float(np.mean(np.abs(offsets) < tolerance_mm)) if len(offsets) >= MIN_POINTS else None
    behind = float(np.mean(offsets < -tolerance_mm)) if len(offsets) >= MIN_POINTS else None
    against = []
    # Where much of the part is hidden, the points on what is seen must lie on the CAD instead.
    clear = int(np.sum(support.by_component >= CLEAR_EDGES))
    is_in_part = clear >= MIN_CLEAR and near is not None and near >= MIN_NEAR_IN_PART
    if usual < MIN_EDGES and not is_in_part:
        against.append(
            f"only {100 * support.share:.0f} % of the CAD's edges are where they should be "
            f"({100 * support.chance:.0f} % would be by chance)"
        )
    if len(misfits) > MAX_MISFITS * len(is_misfit):
        names = ", ".join(misfits[:5]) + (" …" if len(misfits) > 5 else "")
        against.append(f"{len(misfits)} of {len(is_misfit)} photos do not fit the CAD where the others do: {names}")
    if near is not None and behind is not None and (near < MIN_NEAR or behind > MAX_BEHIND):
        against.append(
            f"of the points on the part only {100 * near:.0f} % lie within {tolerance_mm:.1f} mm of the CAD's surface, "
            f"{100 * behind:.0f} % lie behind it"
        )
    if against:
        reason = "the reconstruction does not have the CAD's shape: " + "; ".join(against)
    else:
        reason = f"{100 * support.share:.0f} % of the CAD's edges found in {len(is_misfit)} photos"
        if near is not None:
            reason += f", {100 * near:.0f} % of {len(offsets)} points within {tolerance_mm:.1f} mm of its surface"
    return Consistency(
        not against,
        reason,
        support.share,
        edges_by_chance=support.chance,
        residual_px=found.fit.sigma_px,
        points_near=near,
        points_behind=behind,
        misfits=misfits,
    )


def points_before_surface(sparse: SparseModel, model: Model, similarity: Similarity) -> Array:
    """Signed distances (N,) in mm by which sparse points on the part lie in front of the CAD's surface.

    Negative values are behind the surface, where nothing is visible if the CAD is right. Each value is the median over
    the photos that see the point on the part; points are left out if more than half of their photos see them off the
    part.
    """
    points = similarity.points_in_model(sparse.points_in_scan)

    def offsets_in(index: int) -> tuple[Array, Array]:
        photo = sparse.photos[index]
        shrink = min(1.0, MAX_SIDE_PX / max(photo.camera.width, photo.camera.height))
        camera = photo.camera.without_distortion().scaled(
            round(photo.camera.width * shrink), round(photo.camera.height * shrink)
        )
        pose = similarity.cam_from_model(photo.cam_from_scan)
        depth = ZBufferRenderer(model, camera).render(pose).depth_mm
        which = sparse.observed_point[sparse.observed_photo == index]
        in_cam = apply(pose, points[which])
        pixels = camera.project(in_cam)
        ok = np.all(np.isfinite(pixels) & (pixels >= RIM_PX), axis=1)
        ok &= np.all(pixels < np.array([camera.width, camera.height]) - RIM_PX - 1, axis=1)
        before = np.full(len(which), np.nan)
        u, v = np.round(pixels[ok]).astype(np.intp).T
        around = [depth[v + dv, u + du] for dv in (-RIM_PX, 0, RIM_PX) for du in (-RIM_PX, 0, RIM_PX)]
        lowest, highest = np.min(around, axis=0), np.max(around, axis=0)
        # A point between the nearest and the farthest surface around its pixel counts as on it: steps and slopes.
        z = in_cam[ok, 2]
        gap = np.where(z < lowest, lowest - z, np.where(z > highest, highest - z, 0.0))
        before[ok] = np.where(lowest > 0, gap, np.nan)
        return which, before

    seen = list(pool().map(offsets_in, range(len(sparse.photos))))
    if not seen:
        return np.zeros(0)
    which, before = np.concatenate([s[0] for s in seen]), np.concatenate([s[1] for s in seen])
    is_on = np.isfinite(before)
    on, total = np.bincount(which[is_on], minlength=len(points)), np.bincount(which, minlength=len(points))
    kept = is_on & (on >= 2)[which] & (total >= MIN_PHOTOS)[which] & (2 * on >= total)[which]
    order = np.lexsort((before[kept], which[kept]))
    values, owners = before[kept][order], which[kept][order]
    starts = np.flatnonzero(np.r_[True, owners[1:] != owners[:-1]]) if len(owners) else np.zeros(0, dtype=np.intp)
    counts = np.diff(np.r_[starts, len(owners)])
    return np.asarray(values[starts + counts // 2]) if len(owners) else np.zeros(0)
