"""Positions of components in a dense cloud in the frame of the CAD: cropping, registration, undetermined directions.

Each component is registered to its exact CAD surface, twice: first with all others at their nominal positions, then
with the neighbours where they were found.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from arview.cad import Component, Model, Part
from arview.core.fits import orthogonal_complement, row_space
from arview.errors import InputError
from arview.geometry import Array, apply, invert, rigid
from arview.measurement.cloud.enlarged import enlarged, enlargement, reduced
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.cloud.placing import check_belongs
from arview.measurement.cloud.points import CloudPoints, prepare_cloud, typical_spacing
from arview.measurement.cloud.registration import (
    Registration,
    RegistrationOptions,
    move_about,
    register_from_starts,
    register_to_surface,
    twist_about,
)
from arview.measurement.cloud.visibility import SurfaceVisibility
from arview.measurement.types import Move, NotMeasured
from arview.reconstruction import DenseCloud, PosedPhoto

BAND_MM = 5.0
"""Distance from its nominal surface within which a component's points are searched for; larger displacements are not
found, and much larger bands include the neighbours."""
GRID_MM = 0.5
"""Cell of the grid on which the cloud is averaged; neighbouring points hold no more information."""
JOINT_MM = 2.0
"""Points nearer to another component are left out: weld beads, and points of that component. For a flat component at
most a quarter of its height."""
MIN_PHOTOS = 2
"""A piece of surface counts as visible when this many photos show it; two photos make a point."""
MIN_SUPPORT = 0.45
"""Share of its visible surface that fitting points must cover for a component to be measured."""
MIN_FITTING = 0.7
"""Share of the points near it that must fit; otherwise it is something else."""
MAX_NOISE_MM = 0.7
"""Largest spread of the residuals for points that are a surface of this component."""
DOUBT_WIDTH_MM = 0.4
"""Width of the kernel in a second fit, whose difference is added to the covariance."""
MAX_STD_MM = 0.5
"""Directions with a larger standard deviation are undetermined."""
MISSING_SHARE = 0.2
"""A component is missing when a smaller share of its visible surface has a point within the band."""
MIN_POINTS = 60
"""Points of a component needed to measure it."""
RIVAL_COST = 1.5
"""A second minimum is reported when its cost is less than this many times the best one's."""
SCANNED_MM = 6.0
"""Without photos, surface farther from every point of the cloud was not scanned, and is not expected."""
RIVAL_MM = 0.2
"""Minima nearer to each other are one, and not reported."""
REGISTRATION = RegistrationOptions(min_width_mm=0.1, threshold_mm=1e-3, threshold_deg=1e-3)
"""Options of the solver."""


@dataclass(frozen=True)
class CloudComponent:
    """A component with its surroundings, as it is measured in a cloud.

    Attributes:
        component, surface: at nominal.
        others: surface of the components within reach of it, or None.
        samples: (S,3) even samples of what the photos can see of it.
        contact: (C,3) samples where it touches others.
        usable_faces: (F,) faces that the photos can see.
        spins: (K,6) motions about the centre, rotations scaled by ``radius_mm``, that leave its shape unchanged.
        joint_mm: as `JOINT_MM`, and of a flat component at most a quarter of its height.
        spacing_mm: distance between neighbouring points of the cloud.
        unit: mm in one unit of all these lengths, below 1 for a part that was enlarged.
    """

    component: Component
    surface: MeshSurface
    others: MeshSurface | None
    samples: Array
    contact: Array
    usable_faces: NDArray[np.bool_]
    spins: Array
    joint_mm: float
    spacing_mm: float = 0.0
    unit: float = 1.0

    @property
    def reach_mm(self) -> float:
        """Distance within which a point of the cloud shows a piece of surface."""
        return max(1.0, 2.0 * GRID_MM, 1.5 * self.spacing_mm)

    @property
    def center(self) -> Array:
        """(3,) centre of the bounding box, mm."""
        return self.component.bounds_in_model.mean(axis=0)

    @property
    def radius_mm(self) -> float:
        """Half the diagonal of the bounding box."""
        return 0.5 * float(np.linalg.norm(np.ptp(self.component.bounds_in_model, axis=0)))


def measure_components_in_cloud(
    cloud: DenseCloud,
    model: Model,
    part: Part,
    photos: Sequence[PosedPhoto] = (),
    names: Sequence[str] | None = None,
) -> list[Move | NotMeasured]:
    """Measure the moves of the components to be inspected, in the order of the model.

    Args:
        cloud: in mm, in the frame of the CAD, after alignment to the datums.
        model: the nominal CAD.
        part: roles and symmetries.
        photos: with ``cam_from_scan`` in the same frame, for what is visible; without them everything counts as visible
            that does not touch another component.
        names: components to measure; default: those to be inspected.

    Raises:
        InputError: the cloud is empty, far from the CAD, of another part, or mirrored.
    """
    by = enlargement(model)
    if by > 1.0:
        cloud, model, part, photos = enlarged(cloud, model, part, photos, by)
    box = model.bounds_in_model + np.array([[-BAND_MM], [BAND_MM]])
    points = prepare_cloud(cloud, box, GRID_MM, MIN_POINTS)
    check_belongs(points, model, BAND_MM)
    views = SurfaceVisibility(model, photos) if photos else None
    spacing = typical_spacing(points)
    # One thread for BLAS: the matrices are small, and the work is parallel over components.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as threads:
        components = list(threads.map(lambda name: cloud_component(name, model, part, views), names or part.inspected))
        if views is None:
            components = _only_scanned(components, points)
        components = [replace(c, spacing_mm=spacing, unit=1.0 / by) for c in components]
        first = list(threads.map(lambda c: _measure(c, points, None), components))
        places = {m.component: m.measured_from_nominal for m in first if isinstance(m, Move)}

        def again(index: int) -> Move | NotMeasured:
            c, found = components[index], first[index]
            if not isinstance(found, Move) or not _has_moved_neighbour(c, model, first):
                return found
            moved = replace(c, others=_around(c.component, model, places))
            return _measure(moved, points, found.nominal_from_measured)

        second = list(threads.map(again, range(len(components))))
        named = threads.map(
            lambda i: _with_swapped_name(second[i], components[i], components, points), range(len(second))
        )
        return [reduced(one, by) if isinstance(one, Move) else one for one in named]


def spin_moves(component: Component, surface: MeshSurface, part: Part | None, min_information: float = 1e-4) -> Array:
    """(K,6) orthonormal motions about the centre of a component's bounding box that leave its shape unchanged.

    These are motions along which the whole surface slides within itself (Gelfand & Guibas, SGP 2004), and the
    continuous symmetry declared in the part file. Rotations are scaled by half the diagonal of the box.
    """
    center = component.bounds_in_model.mean(axis=0)
    radius_mm = 0.5 * float(np.linalg.norm(np.ptp(component.bounds_in_model, axis=0)))
    samples, _ = surface.spread(3000)
    normals = surface.closest(samples).normals
    rows = np.hstack([np.cross(samples - center, normals) / radius_mm, normals])
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    moves = vectors[:, values < min_information].T
    known = part.component_settings(component.name).symmetry if part is not None else None
    if known is not None and known.order is None:
        axis = np.array(known.axis_in_model)
        declared = np.concatenate([radius_mm * axis, np.cross(axis, center - np.array(known.through_in_model))])
        moves = np.concatenate([moves, declared[None] / np.linalg.norm(declared)])
    return row_space(moves, 0.1)


def cloud_component(name: str, model: Model, part: Part | None, views: SurfaceVisibility | None) -> CloudComponent:
    """A component with what the photos can see of it, and with its neighbours at nominal."""
    component = model.component(name)
    surface = MeshSurface(component.vertices_in_model, component.faces)
    others = _around(component, model, {})
    spacing = max(GRID_MM, 0.3, float(np.sqrt(surface.areas.sum() / 4000.0)))
    spread, of_face = surface.sample(spacing)
    tried = np.concatenate([spread, surface.triangles.mean(axis=1)])
    faces = np.concatenate([of_face, np.arange(len(surface.faces))])
    to_others = np.full(len(tried), np.inf)
    if others is not None:
        closest = others.closest(tried, 10.0 * max(JOINT_MM, 1.0))
        to_others = np.where(closest.faces >= 0, np.abs(closest.distances), np.inf)
    touches = to_others < 0.2
    seen = ~touches
    if views is not None:
        seen &= views.count(tried, surface.face_normals[faces]) >= MIN_PHOTOS
    height = float(np.max(to_others[np.isfinite(to_others)], initial=0.0)) if others is not None else np.inf
    joint = min(JOINT_MM, 0.25 * height)
    usable = np.zeros(len(surface.faces), dtype=bool)
    usable[faces[seen]] = True
    is_spread = np.arange(len(tried)) < len(spread)
    return CloudComponent(
        component,
        surface,
        others,
        samples=tried[is_spread & seen & (to_others > joint)],
        contact=tried[is_spread & touches],
        usable_faces=usable,
        spins=spin_moves(component, surface, part),
        joint_mm=joint,
    )


def _only_scanned(components: Sequence[CloudComponent], points: CloudPoints) -> list[CloudComponent]:
    """The components with those samples that have any point of the cloud near them.

    Samples of a component of which nothing was scanned are all kept: it is missing, or not covered.
    """
    from scipy.spatial import cKDTree

    tree, out = cKDTree(points.points), []
    for c in components:
        near = np.isfinite(tree.query(c.samples, distance_upper_bound=SCANNED_MM)[0]) if len(c.samples) else []
        out.append(replace(c, samples=c.samples[near]) if np.count_nonzero(near) > 0.1 * len(c.samples) else c)
    return out


def _around(component: Component, model: Model, places: dict[str, Array]) -> MeshSurface | None:
    """Surface of the components near one, each at its measured place or at nominal; None without neighbours."""
    reach = 2.0 * BAND_MM + JOINT_MM
    low, high = component.bounds_in_model[0] - reach, component.bounds_in_model[1] + reach
    vertices, faces, groups, offset = [], [], [], 0
    for index, other in enumerate(model.components):
        if other.name == component.name:
            continue
        bounds = other.bounds_in_model
        if (bounds[1] < low).any() or (bounds[0] > high).any():
            continue
        at = other.vertices_in_model
        vertices.append(apply(places[other.name], at) if other.name in places else at)
        faces.append(other.faces + offset)
        groups.append(np.full(len(other.faces), index))
        offset += len(at)
    if not vertices:
        return None
    return MeshSurface(np.concatenate(vertices), np.concatenate(faces), np.concatenate(groups))


def _has_moved_neighbour(c: CloudComponent, model: Model, found: Sequence[Move | NotMeasured]) -> bool:
    """Whether a neighbour is displaced so far that different points must be left out because of it."""
    low, high = c.component.bounds_in_model
    for one in found:
        if not isinstance(one, Move) or one.component == c.component.name:
            continue
        corners = model.component(one.component).bounds_in_model
        reach = 2.0 * BAND_MM + JOINT_MM
        is_near = bool((corners[1] > low - reach).all() and (corners[0] < high + reach).all())
        if is_near and np.linalg.norm(one.twist * ([one.radius_mm] * 3 + [1.0] * 3)) > 0.1 * JOINT_MM:
            return True
    return False


def _measure(c: CloudComponent, cloud: CloudPoints, start: Array | None) -> Move | NotMeasured:
    """Move of one component, or why there is none; ``start`` (4,4) is nominal_from_measured, None tries several."""
    name = c.component.name
    if len(c.samples) == 0:
        return NotMeasured(name, "cloud", "none of its surface is visible in the photos")
    near, own = crop_component(c, cloud)
    missing = _missing(c, near, own)
    if missing is not None:
        return missing
    if len(own) < MIN_POINTS:
        return NotMeasured(name, "cloud", _too_few(c, len(own)))
    try:
        fit = _register(c, own, start)
    except InputError as error:
        return NotMeasured(name, "cloud", str(error).removeprefix("registration: "))
    support = _covered(apply(invert(fit.surface_from_points), c.samples), own.points, c.reach_mm, fit)
    fitting = float(np.mean(fit.weights > 0.1))
    found = f"{100 * support:.0f} % of its visible surface found, {100 * fitting:.0f} % of the points there fit it"
    if fit.sigma_mm > MAX_NOISE_MM or (support < MIN_SUPPORT and fitting < MIN_FITTING):
        reason = (
            "what stands there does not have its shape: fallen over, bent, another component, or badly reconstructed"
        )
        return NotMeasured(name, "cloud", f"{reason} ({found}, residuals {fit.sigma_mm * c.unit:.2g} mm)")
    if support < MIN_SUPPORT:
        return NotMeasured(name, "cloud", f"too little of it is where it should be: fallen over, or hidden ({found})")
    return _move(c, fit, support)


def _too_few(c: CloudComponent, count: int) -> str:
    """Why a component has too few points: the cloud is too coarse for it, or does not show it."""
    if c.surface.areas.sum() < 2.0 * MIN_POINTS * c.spacing_mm**2:
        apart = f"{c.spacing_mm * c.unit:.2g} mm"
        return f"the points are too far apart for it, {apart}: {count} of them are on it, {MIN_POINTS} are needed"
    return f"only {count} points of it are in the cloud; {MIN_POINTS} are needed"


def crop_component(c: CloudComponent, cloud: CloudPoints) -> tuple[CloudPoints, CloudPoints]:
    """Points around the component, and those of them that may belong to it."""
    low, high = c.component.bounds_in_model[0] - BAND_MM, c.component.bounds_in_model[1] + BAND_MM
    near = cloud.only(np.all((cloud.points >= low) & (cloud.points <= high), axis=1))
    is_own = c.surface.closest(near.points, BAND_MM).faces >= 0
    if c.others is not None:
        is_own &= c.others.closest(near.points, c.joint_mm).faces < 0
    return near, near.only(is_own)


def _missing(c: CloudComponent, near: CloudPoints, own: CloudPoints) -> NotMeasured | None:
    """The finding that the component is missing, or not covered, if hardly any point is near its place; else None."""
    if _covered(c.samples, own.points, BAND_MM) >= MISSING_SHARE and len(own) >= MIN_POINTS // 3:
        return None
    name = c.component.name
    # The surfaces of others on which it stands are only visible when it is absent.
    behind = _covered(c.contact, near.points, c.reach_mm) if len(c.contact) else 0.0
    if behind > 0.4:
        return NotMeasured(
            name,
            "cloud",
            f"missing: no surface where it should be, and {100 * behind:.0f} % of what it would cover is seen",
            is_missing=True,
        )
    return NotMeasured(name, "cloud", f"not covered by the cloud: {len(own)} points near its place")


def _covered(samples: Array, points: Array, reach_mm: float, fit: Registration | None = None) -> float:
    """Share of samples with a point (of those that the fit used) within reach."""
    from scipy.spatial import cKDTree

    if fit is not None:
        points = points[fit.weights > 0.1]
    if len(points) == 0 or len(samples) == 0:
        return 0.0
    distance, _ = cKDTree(points).query(samples, distance_upper_bound=reach_mm)
    return float(np.mean(np.isfinite(distance)))


def _register(c: CloudComponent, own: CloudPoints, start: Array | None) -> Registration:
    """Register the component's points to its surface, excluding undetermined directions one after the other."""
    radius, scales = c.radius_mm, np.array([c.radius_mm] * 3 + [1.0] * 3)
    options = replace(REGISTRATION, first_distance_mm=BAND_MM, min_points=min(MIN_POINTS, 50))
    given: dict[str, Any] = {"center": c.center, "radius_mm": radius, "usable_faces": c.usable_faces}
    fixed = c.spins
    starts = _starts(c.center, radius, BAND_MM) if start is None else [start]
    for _ in range(6):
        free = orthogonal_complement(fixed) / scales
        fit = register_from_starts(
            own.points,
            c.surface,
            starts,
            normals=own.normals,
            point_weights=1.0 / own.sigma**2,
            options=options,
            free=free,
            **given,
        )
        values, vectors = np.linalg.eigh(fit.covariance * np.outer(scales, scales))
        loose = vectors[:, values > MAX_STD_MM**2].T
        unknown = np.concatenate([fit.undetermined, loose])
        if len(unknown) == 0:
            break
        fixed = np.concatenate([fixed, unknown])
        if len(fixed) >= 6:
            raise InputError("registration: the points determine no move of it")
    # The influence of the kernel's width on the result is part of its uncertainty.
    wide = replace(options, min_width_mm=DOUBT_WIDTH_MM, noise_points=0)
    other = register_to_surface(
        own.points,
        c.surface,
        fit.surface_from_points,
        normals=own.normals,
        point_weights=1.0 / own.sigma**2,
        options=wide,
        free=free,
        **given,
    )
    doubt = other.twist - fit.twist
    return replace(fit, covariance=fit.covariance + np.outer(doubt, doubt))


def _starts(center: Array, radius: float, band_mm: float) -> list[Array]:
    """Identity, and half the band along each axis combined with a rotation about the next one, both ways."""
    twists = [np.zeros(6)]
    for axis in range(3):
        for sign in (-1.0, 1.0):
            twist = np.zeros(6)
            twist[3 + axis], twist[(axis + 1) % 3] = 0.5 * sign * band_mm, 0.5 * sign * min(band_mm / radius, 0.2)
            twists.append(twist)
    return [move_about(center, twist) for twist in twists]


def _move(c: CloudComponent, fit: Registration, support: float) -> Move:
    """The registration as a move, with notes about what may be wrong."""
    scales = np.array([c.radius_mm] * 3 + [1.0] * 3)
    undetermined = orthogonal_complement(fit.free)
    determined = np.eye(6) - undetermined.T @ undetermined
    twist = determined @ (twist_about(c.center, invert(fit.surface_from_points)) * scales) / scales
    covariance = determined @ (fit.covariance * np.outer(scales, scales)) @ determined / np.outer(scales, scales)
    notes = []
    if not fit.converged:
        notes.append(f"did not converge in {fit.iterations} iterations")
    if fit.runner_up is not None and fit.runner_up_cost is not None and fit.runner_up_cost < RIVAL_COST:
        # Minima that differ along what is undetermined only, such as the turn of a round post, are one.
        other = determined @ (twist_about(c.center, invert(fit.runner_up)) * scales) - twist * scales
        if np.linalg.norm(other) > RIVAL_MM:
            apart_mm = float(np.linalg.norm(other)) * c.unit
            notes.append(f"fits nearly as well {apart_mm:.2f} mm away (cost × {fit.runner_up_cost:.2f})")
    if np.linalg.norm(twist[3:]) > 0.9 * BAND_MM:
        notes.append(f"at the limit of the searched band of {BAND_MM * c.unit:.2g} mm")
    if support < 0.6:
        notes.append(f"only {100 * support:.0f} % of its visible surface is in the cloud")
    return Move(
        component=c.component.name,
        method="cloud",
        center_in_model=c.center,
        twist=twist,
        covariance=covariance,
        undetermined=undetermined,
        radius_mm=c.radius_mm,
        used=int(np.count_nonzero(fit.weights > 0.1)),
        residual_mm=fit.sigma_mm,
        support=support,
        notes=tuple(notes),
    )


def _with_swapped_name(
    found: Move | NotMeasured,
    c: CloudComponent,
    all_of_them: Sequence[CloudComponent],
    cloud: CloudPoints,
) -> Move | NotMeasured:
    """Add to a component that did not fit the name of another one whose shape does: the two may be swapped."""
    if isinstance(found, Move) or found.is_missing or "shape" not in found.reason or c.others is None:
        return found
    foot, tried = c.others.closest(c.center[None]).points[0], [c]
    for other in all_of_them:
        if other.others is None or any(_same_shape(other, done) for done in tried):
            continue
        tried.append(other)
        there = rigid(np.eye(3), foot - other.others.closest(other.center[None]).points[0])
        vertices = apply(there, other.component.vertices_in_model)
        trial = replace(
            other,
            component=Component(c.component.name, vertices, other.component.faces),
            others=c.others,
            surface=MeshSurface(vertices, other.component.faces),
            samples=apply(there, other.samples),
            contact=apply(there, other.contact),
        )
        if isinstance(_measure(trial, cloud, np.eye(4)), Move):
            return replace(found, reason=f"{found.reason}; it has the shape of {other.component.name}: swapped?")
    return found


def _same_shape(a: CloudComponent, b: CloudComponent) -> bool:
    """Whether two components have equal bounding boxes and areas."""
    sizes = [np.sort(np.ptp(c.component.bounds_in_model, axis=0)) for c in (a, b)]
    return (
        bool(np.allclose(sizes[0], sizes[1], atol=0.1))
        and abs(a.surface.areas.sum() / b.surface.areas.sum() - 1.0) < 0.01
    )
