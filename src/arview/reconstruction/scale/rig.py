"""A part under fixed cameras whose poses are known in mm, and which of these cameras is no longer where it was.

Each camera is asked alone where it sees the part's edges. While they do not agree, the one is left
out without which the others agree best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import numpy as np

from arview.cad import Part
from arview.camera import Camera
from arview.core.fits import robust_sigma, tukey_weights
from arview.errors import InputError
from arview.geometry import Array, apply, exp_se3, invert, log_se3, orthonormalise, rigid
from arview.guideviews import GuideViewOptions, cached_guide_views
from arview.reconstruction.intake.reading import read_photo
from arview.reconstruction.scale.cad import (
    DETECT_WIDTH_PX,
    FOUND_QUALITY,
    SPANS,
    SUBDIVISIONS,
    CadFind,
    CadOptions,
    NotFound,
    base_names,
    find_cad,
    make_view,
    search_ranges,
    shrunk,
)
from arview.reconstruction.scale.find import read_file, scale_of_cad
from arview.reconstruction.scale.refine import CadEdgePoints, Fit, JointRefiner, ScaleView
from arview.reconstruction.scale.similarity import Similarity
from arview.reconstruction.scale.types import ScaleEvidence, ScaleResult
from arview.reconstruction.types import PosedPhoto, SparseModel

MOVED_PX = 0.35
"""Shift of the edges from which a camera has moved; shadows and rounded edges shift them by less."""
CHECK_REACHES_PX = (9.0, 5.0, 3.0, 3.0)
"""Search range across the edges in each round of looking where a camera sees the base."""
MIN_EDGE_POINTS = 40
"""Edge points that say where a camera sees the part."""
MIN_SHARE = 0.4
"""Share of the edges that a camera must show, and of the median camera's share beyond chance."""
NEAR_SHARE = 0.6
"""Share of a component's edges within a pixel and a half of where the fit has them, from which it is there."""
RIG_ROUNDS = 3
"""Rounds in which cameras are placed by the part; the components' displacements settle with them."""
MIN_LEFT = 2
"""Cameras that must agree for another one to have moved."""
_DAMPING = np.repeat([1e4, 1.0], 3)
"""Inverse variances of a camera's error before it is looked at: 10 mrad and 1 mm at the part, 1/rad² and 1/mm²."""


@dataclass(frozen=True)
class CameraShift:
    """Where one camera sees the part, compared with where the others have it.

    Attributes:
        name: of the camera.
        shift_px: root mean square shift of the edges in its picture; None: it does not show them.
        model_twist: (6,) rad and mm by which the part would have to move, about its centre, to be where it sees it.
        covariance: (6,6) of ``model_twist``.
    """

    name: str
    shift_px: float | None
    model_twist: Array
    covariance: Array

    @property
    def px(self) -> float:
        """The shift; infinite where the picture does not show the part."""
        return inf if self.shift_px is None else self.shift_px

    @property
    def text(self) -> str:
        """What is said of the camera if it has moved."""
        if self.shift_px is None:
            return f"camera {self.name}: does not show the part where the other cameras have it: covered, or moved far"
        return f"camera {self.name} has moved: it sees the part {self.shift_px:.1f} px from where the others have it"


@dataclass(frozen=True)
class RigPlacement:
    """A part under a rig.

    Attributes:
        scale: scale and frame, with a warning for each camera that has moved.
        found: the fit, from which the next part is found faster; None: the part was not found.
        moved: cameras that are not where they were calibrated, or whose picture does not show the part.
    """

    scale: ScaleResult
    found: CadFind | None
    moved: tuple[CameraShift, ...] = ()

    @property
    def near_places(self) -> dict[str, Array]:
        """(4,4) measured_from_nominal of the components whose edges are mostly seen where the fit has them."""
        if self.found is None:
            return {}
        fit, refiner = self.found.fit, self.found.refiner
        shares = refiner.support(fit.similarity, [_displaced(one, fit) for one in fit.samples]).by_component
        return {
            component.name: rigid(np.eye(3), shift_mm)
            for component, shift_mm, share in zip(refiner.model.components, fit.displacements_mm, shares, strict=True)
            if share >= NEAR_SHARE
        }


def place_on_rig(
    sparse: SparseModel, part: Part, known: ScaleEvidence, before: RigPlacement | None = None
) -> RigPlacement:
    """Where a part lies under a rig, by the cameras that agree.

    Args:
        sparse: one photo for each camera, with its calibrated pose in mm; no points.
        part: to be found.
        known: the scale of the rig: 1 and its relative standard deviation.
        before: the last part, from which this one is found faster.
    """
    found = _found(sparse.photos, part, before)
    if not isinstance(found, CadFind):
        return RigPlacement(scale_of_cad(sparse, part, found, [known], []), None)
    kept, moved = without_moved(found)
    left = {view.name for view in kept.refiner.views}
    agreeing = replace(sparse, photos=tuple(photo for photo in sparse.photos if photo.name in left))
    return RigPlacement(scale_of_cad(agreeing, part, kept, [known], [one.text for one in moved]), kept, moved)


def _found(photos: Sequence[PosedPhoto], part: Part, before: RigPlacement | None) -> CadFind | NotFound:
    """The part by all cameras; if these contradict each other, by all but those that had moved, or but one."""
    last = None if before is None else before.found
    found = find_cad(photos, read_file, part, CadOptions(), before=last)
    suspects = [{one.name for one in before.moved}] if before is not None and before.moved else []
    for out in [*suspects, *({photo.name} for photo in photos)]:
        some = [photo for photo in photos if photo.name not in out]
        if isinstance(found, CadFind) or not found.is_contradiction or len(some) < MIN_LEFT:
            break
        found = find_cad(some, read_file, part, CadOptions(), before=last)
    if not isinstance(found, CadFind) or len(found.refiner.views) == len(photos):
        return found
    return _fitted(found, _views_of(photos), refits=False)


def without_moved(found: CadFind) -> tuple[CadFind, tuple[CameraShift, ...]]:
    """The fit to the cameras that agree, and those that do not."""
    views, by_view = found.refiner.views, found.support.by_view
    usual = float(np.nanmedian(by_view))
    clear = [view for view, share in zip(views, by_view, strict=True) if share >= MIN_SHARE * usual]
    kept = found if len(clear) in (len(views), *range(MIN_LEFT)) else _fitted(found, clear)
    shifts = _shifts(kept)
    while _worst_px(shifts) >= MOVED_PX and len(shifts) > MIN_LEFT:
        fewer: list[tuple[CadFind, dict[str, CameraShift]]] = []
        for name in sorted(shifts, key=lambda name: (shifts[name].px, name), reverse=True):
            fit = _fitted(kept, [view for view in kept.refiner.views if view.name != name])
            fewer.append((fit, _shifts(fit)))
            if _worst_px(fewer[-1][1]) < MOVED_PX:
                break
        kept, shifts = min(fewer, key=lambda one: _worst_px(one[1]))
    out = {view.name: camera_shift(kept, view) for view in views if view.name not in shifts}
    if back := [name for name, shift in out.items() if shift.px < MOVED_PX and _worst_px(shifts) < MOVED_PX]:
        # A camera that was left out before the right one was agrees after all.
        kept = _fitted(kept, [view for view in views if view.name in shifts or view.name in back])
        shifts = _shifts(kept)
        out = {view.name: camera_shift(kept, view) for view in views if view.name not in shifts}
    # Two cameras that contradict each other do not say which of them has moved.
    if _worst_px(shifts) >= MOVED_PX:
        out |= shifts
    return kept, tuple(out[view.name] for view in views if view.name in out)


def _shifts(found: CadFind) -> dict[str, CameraShift]:
    """`camera_shift` of each camera of a fit, by its name."""
    return {view.name: camera_shift(found, view) for view in found.refiner.views}


def _worst_px(shifts: Mapping[str, CameraShift]) -> float:
    """The largest shift."""
    return max(shift.px for shift in shifts.values())


def _views_of(photos: Sequence[PosedPhoto]) -> list[ScaleView]:
    """The pictures of the cameras, from their files."""
    return [make_view(photo, read_file(photo), CadOptions().max_side_px) for photo in photos]


def _fitted(found: CadFind, views: Sequence[ScaleView], refits: bool = True) -> CadFind:
    """The fit to some views, or without ``refits`` how these support the fit as it is."""
    refiner = JointRefiner(found.refiner.model, found.refiner.base, views)
    if not refits:
        return replace(found, refiner=refiner, support=refiner.support(found.fit.similarity))
    fit = refiner.refine(found.fit.similarity)
    return replace(found, fit=fit, support=refiner.support(fit.similarity, fit.samples), refiner=refiner)


def camera_shift(found: CadFind, view: ScaleView) -> CameraShift:
    """Where a camera alone sees the part, with each component where all cameras together have it.

    The components are taken along because the edges of the base are often hidden, and then leave directions free.
    """
    refiner, similarity, center = found.refiner, found.fit.similarity, found.refiner.center
    pose = similarity.cam_from_model(view.cam_from_scan)
    samples = _displaced(refiner.samples(view, pose), found.fit)
    none = CameraShift(view.name, None, np.zeros(6), np.diag(1.0 / _DAMPING))
    total, covariance = np.eye(4), none.covariance
    for reach_px in CHECK_REACHES_PX:
        measured = refiner.measure(view, samples, pose @ _about(total, center), reach_px)
        if len(measured.offsets) < MIN_EDGE_POINTS:
            return none
        sigma_px = max(0.3, robust_sigma(measured.offsets - np.median(measured.offsets)))
        weights = tukey_weights(measured.offsets / (2.0 * sigma_px)) / sigma_px**2
        rows = np.delete(measured.rows, 6, axis=1)  # the scale is that of the rig
        hessian = (rows * weights[:, None]).T @ rows
        hessian += np.diag([*_DAMPING, 100.0])  # a common shift of all edges to the dark side: 0.1 px
        covariance = np.asarray(np.linalg.inv(hessian))
        total = total @ exp_se3((covariance @ (rows.T @ (weights * measured.offsets)))[:6])
    if measured.found.sum() < MIN_SHARE * measured.searched.sum():
        return none
    before, after = (view.camera.project(apply(at, samples.points)) for at in (pose, pose @ _about(total, center)))
    shift_px = float(np.sqrt(np.nanmean(np.sum((after - before) ** 2, axis=1))))
    return CameraShift(view.name, shift_px, log_se3(total), covariance[:6, :6] * 25.0)


def _displaced(samples: CadEdgePoints, fit: Fit) -> CadEdgePoints:
    """Edge points with each component where the fit has it."""
    return replace(samples, points=samples.points + fit.displacements_mm[samples.component])


@dataclass(frozen=True)
class CamerasFromPart:
    """Fixed cameras placed by the part that they see, in the frame of the model.

    Attributes:
        cams_from_rig: (M,4,4) mm.
        covariance: (6M,6M) of their left twists.
        scale_std: relative standard uncertainty of lengths.
        residuals_px: of each camera: mean shift of the part's edges over the shots.
    """

    cams_from_rig: Array
    covariance: Array
    scale_std: float
    residuals_px: tuple[float, ...]


def cameras_from_part(
    shots: Sequence[Mapping[str, Path]], cameras: Mapping[str, Camera], part: Part
) -> CamerasFromPart:
    """Place fixed cameras by the part: in the first shot by its pose in each picture, then by its edges in all shots.

    Args:
        shots: the picture of each camera; the part may lie at another place in each.
        cameras: their intrinsics.
        part: that they see.

    Raises:
        InputError: a picture does not show the part where the others have it, or the part is not found.
    """
    names = tuple(cameras)
    poses = {name: _pose_of_part(shots[0][name], cameras[name], part, name) for name in names}
    covariance = np.zeros((6 * len(names), 6 * len(names)))
    scale_std = 0.0
    residuals = dict.fromkeys(names, 0.0)
    for _ in range(RIG_ROUNDS):
        information = {name: np.zeros((6, 6)) for name in names}
        pulls = {name: np.zeros(6) for name in names}
        residuals = dict.fromkeys(names, 0.0)
        for number, shot in enumerate(shots):
            photos = [PosedPhoto(name, shot[name], cameras[name], poses[name]) for name in names]
            found = _fit_of_shot(photos, part, is_first=number == 0)
            scale_std = float(np.sqrt(found.fit.covariance[6, 6]))
            for view in found.refiner.views:
                shift = camera_shift(found, view)
                if shift.shift_px is None:
                    raise InputError(f"{shot[view.name]}: does not show the part where the other cameras have it")
                turned = _adjoint(found.fit.similarity.cam_from_model(view.cam_from_scan), found.refiner.center)
                own = np.linalg.inv(turned @ shift.covariance @ turned.T)
                information[view.name] += own
                pulls[view.name] += own @ (turned @ shift.model_twist)
                residuals[view.name] += shift.shift_px / len(shots)
        for m, name in enumerate(names):
            covariance[6 * m : 6 * m + 6, 6 * m : 6 * m + 6] = np.linalg.inv(information[name])
            poses[name] = orthonormalise(exp_se3(np.linalg.solve(information[name], pulls[name])) @ poses[name])
    return CamerasFromPart(
        np.array([poses[name] for name in names]), covariance, scale_std, tuple(residuals[name] for name in names)
    )


def _pose_of_part(path: Path, camera: Camera, part: Part, name: str) -> Array:
    """``cam_from_model`` of the part in one picture."""
    from arview.detection import Detector

    small, image = shrunk(camera, read_photo(path), DETECT_WIDTH_PX)
    for view_range in search_ranges(part, [camera], SPANS):
        views = cached_guide_views(part.model, view_range, GuideViewOptions(subdivisions=SUBDIVISIONS))
        found = Detector(views, small).detect(image, 1)
        if found and found[0].quality >= FOUND_QUALITY:
            return found[0].cam_from_model
    raise InputError(f"{path}: the part is not found in the picture of the camera {name}")


def _fit_of_shot(photos: Sequence[PosedPhoto], part: Part, is_first: bool) -> CadFind:
    """The part in one shot; in the first one it lies where the rig's frame is."""
    if is_first:
        refiner = JointRefiner(part.model, base_names(part), _views_of(photos))
        fit = refiner.refine(Similarity(1.0, np.eye(4)))
        return CadFind(fit, refiner.support(fit.similarity), refiner, "", (), np.zeros((0, 3, 3)))
    found = find_cad(photos, read_file, part, CadOptions())
    if isinstance(found, NotFound):
        raise InputError(f"{photos[0].path}: the part is not found in this shot: {found.reason}")
    return found


def _adjoint(cam_from_model: Array, center: Array) -> Array:
    """(6,6) from a twist about the model's centre, right of a pose, to the same twist left of it."""
    rotation, shift = cam_from_model[:3, :3], apply(cam_from_model, center)
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = np.cross(shift, rotation, axisb=0, axisc=0)
    return result


def _about(motion: Array, center: Array) -> Array:
    """A motion (4,4) about a point of the model."""
    to_center = rigid(np.eye(3), center)
    return np.asarray(to_center @ motion @ invert(to_center))
