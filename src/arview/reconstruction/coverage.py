"""Coverage guidance: from how many photos and directions each component is seen, and where photos are missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arview.cad import Model
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, apply, look_at
from arview.rendering import ZBufferRenderer, rasterise

MAX_SIDE_PX = 400
"""Longer side of the rendered pictures; a component of 1 % of the width still has 16 px."""
MIN_PX = 12
"""Visible pixels at the rendered size below which nothing on a component can be matched."""
MIN_SHARE = 0.3
"""Visible share of a component's own silhouette that counts as seen."""
DIRECTION_DEG = 15.0
"""Views that differ by less count as one direction."""
PHOTOS_WANTED = 4
"""Photos of a component: one more than the minimum that can contradict each other."""
DIRECTIONS_WANTED = 3
"""Directions from which a component is seen: two determine a distance, the third confirms it."""
ONE_SIDE_DEG = 40.0
"""If no two views of the part differ by more, depth is poorly known."""
ALONE_DEG = 35.0
"""A photo farther than this from its nearest neighbour cannot be matched well."""
GAP_DEG = 150.0
"""Azimuth range without photos that is reported."""
UPRIGHT_SPREAD, UPRIGHT_SHARE = 0.2, 0.5
"""Mean size of the second direction of the cameras' rights from which they have an axis, and largest share of the third
in it for cameras that are held upright."""
TRIED_DIRECTIONS = 80
"""Directions, about 22° apart, from which a poorly seen component is searched for in the CAD."""


@dataclass(frozen=True)
class ComponentCoverage:
    """Coverage of one component.

    Attributes:
        name: of the component.
        photos: indices of the poses from which it is seen.
        directions: number of its viewing directions that differ by more than ``DIRECTION_DEG``.
        spread_deg: largest angle between two of its viewing directions.
        gap_deg: largest range of azimuth, about the axis of the photos' orbit, without a photo of it; 360 if there is
            none.
    """

    name: str
    photos: tuple[int, ...]
    directions: int
    spread_deg: float
    gap_deg: float


@dataclass(frozen=True)
class Coverage:
    """Coverage of each component, and advice as messages (empty if nothing is missing)."""

    components: tuple[ComponentCoverage, ...]
    advice: tuple[str, ...]


def coverage(
    model: Model,
    views: Sequence[tuple[Camera, Array]],
    names: Sequence[str] | None = None,
) -> Coverage:
    """From how many photos and directions each component is seen without being hidden by others.

    Args:
        model: the nominal CAD.
        views: (camera, ``cam_from_model`` (4,4)) of each photo.
        names: of the photos, for the advice; default: numbers from 1.

    Raises:
        InputError: there are no views, or the number of names differs.
    """
    if not views:
        raise InputError("coverage: no camera poses given; place the photos first")
    names = [f"photo {number}" for number in range(1, len(views) + 1)] if names is None else names
    if len(names) != len(views):
        raise InputError(f"coverage: {len(names)} names for {len(views)} camera poses")
    centres = np.array([-pose[:3, :3].T @ pose[:3, 3] for _, pose in views])
    axis = _orbit_axis(unit(centres - model.center_in_model), np.array([pose[0, :3] for _, pose in views]))
    seen = np.array([components_seen(model, camera, pose) for camera, pose in views])
    components = []
    for index, component in enumerate(model.components):
        photos = np.flatnonzero(seen[:, index])
        directions = unit(centres[photos] - component.bounds_in_model.mean(axis=0))
        components.append(
            ComponentCoverage(
                component.name,
                tuple(int(photo) for photo in photos),
                count_separated(directions, DIRECTION_DEG),
                spread_deg(directions),
                _gap(directions, axis)[0],
            )
        )
    advice = _advice_on_part(model, names, centres, axis)
    advice += _advice_on_components(model, components, views[0][0], centres, axis)
    return Coverage(tuple(components), tuple(advice))


def components_seen(model: Model, camera: Camera, cam_from_model: Array) -> list[bool]:
    """For each component of a model, whether a photo at a pose (4,4) shows enough of it, by a small rendering."""
    scale = min(1.0, MAX_SIDE_PX / max(camera.width, camera.height))
    small = camera.scaled(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    ids = ZBufferRenderer(model, small).render(cam_from_model).component_ids
    visible = np.bincount(ids[ids >= 0], minlength=len(model.components))
    result = []
    for component, pixels in zip(model.components, visible, strict=True):
        enough = bool(pixels >= MIN_PX)
        if enough:
            points = apply(cam_from_model, component.vertices_in_model)
            _, faces = rasterise(
                points,
                component.faces,
                small.fx,
                fy=small.fy,
                cx=small.cx,
                cy=small.cy,
                width=small.width,
                height=small.height,
            )
            enough = bool(pixels >= MIN_SHARE * np.count_nonzero(faces >= 0))
        result.append(enough)
    return result


def _advice_on_part(model: Model, names: Sequence[str], centres: Array, axis: Array) -> list[str]:
    """Advice about directions from which the whole part should be photographed."""
    directions = unit(centres - model.center_in_model)
    spread = spread_deg(directions)
    if spread < ONE_SIDE_DEG:
        return [
            f"all photos are taken from one side (within {spread:.0f}°): depth is poorly known; walk around the "
            "part, or at least a quarter of the way"
        ]
    advice = []
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -1.0)
    nearest_deg = np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)))
    for photo in np.flatnonzero(nearest_deg > ALONE_DEG):
        advice.append(
            f"{names[int(photo)]} overlaps too little with the others (the nearest was taken {nearest_deg[photo]:.0f}° "
            "away); add photos between them"
        )
    gap_deg, towards = _gap(directions, axis)
    if gap_deg > GAP_DEG:
        advice.append(f"no photo within {gap_deg:.0f}° around the side {_named(towards)}; take some from there")
    return advice


def _advice_on_components(
    model: Model,
    components: Sequence[ComponentCoverage],
    camera: Camera,
    centres: Array,
    axis: Array,
) -> list[str]:
    """Advice about components that are seen in too few photos or from too few directions."""
    poor = [
        index
        for index, covered in enumerate(components)
        if len(covered.photos) < PHOTOS_WANTED or covered.directions < DIRECTIONS_WANTED
    ]
    if not poor:
        return []
    # Directions from which each component would be visible: cameras all around, at the distance of the photos.
    distance_mm = float(np.median(np.linalg.norm(centres - model.center_in_model, axis=1)))
    tried = model.center_in_model + distance_mm * _sphere(TRIED_DIRECTIONS)
    up = np.array([0.0, 0.0, 1.0])
    visible = np.array([components_seen(model, camera, look_at(eye, model.center_in_model, up)) for eye in tried])
    lowest = float((unit(centres - model.center_in_model) @ axis).min())
    in_reach = unit(tried - model.center_in_model) @ axis >= lowest - 0.1

    advice = []
    for index in poor:
        covered, middle = components[index], model.components[index].bounds_in_model.mean(axis=0)
        if covered.photos:
            photos, directions = _count(len(covered.photos), "photo"), _count(covered.directions, "direction")
            state = f"{covered.name} is seen in {photos} from {directions} only"
        else:
            state = f"{covered.name} is seen in no photo"
        where = visible[:, index] & in_reach if np.any(visible[:, index] & in_reach) else visible[:, index]
        if not where.any():
            advice.append(f"{state}; other components hide it from every side, so it cannot be measured in photos")
            continue
        candidates = unit(tried[where] - middle)
        taken = unit(centres[list(covered.photos)] - middle)
        nearest = (candidates @ taken.T).max(axis=1) if len(taken) else -(candidates @ axis)
        missing = max(PHOTOS_WANTED - len(covered.photos), DIRECTIONS_WANTED - covered.directions)
        side = _named(unit(tried[where][np.argmin(nearest)] - model.center_in_model))
        advice.append(f"{state}; take {missing} more of it, for example from the side {side}")
    return advice


def _sphere(count: int) -> Array:
    """Directions (count,3) spread evenly over the sphere (Fibonacci lattice)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1)


def _orbit_axis(directions: Array, rights: Array) -> Array:
    """The axis about which the photos were taken, on their side of the part.

    It is upright in all pictures: across the right of each camera (N,3), in the model frame. Where these hardly differ,
    or the cameras were turned, it is the normal of the best plane through the directions (N,3) of the photos; those of
    photos from one side lie in a plane across the line of sight, which is no orbit.
    """
    mean = directions.mean(axis=0)
    _, sizes, ways = np.linalg.svd(rights, full_matrices=True)
    if len(sizes) == 3 and sizes[1] > UPRIGHT_SPREAD * np.sqrt(len(rights)) and sizes[2] < UPRIGHT_SHARE * sizes[1]:
        axis = ways[2]
    elif len(directions) < 3:
        return unit(mean)
    else:
        axis = np.linalg.svd(directions - mean)[2][2]
    return np.asarray(axis if axis @ mean >= 0 else -axis)


def count_separated(directions: Array, apart_deg: float) -> int:
    """Number of directions (N,3) left when those within an angle of one already kept are dropped."""
    kept: list[Array] = []
    for direction in directions:
        if all(direction @ other < math.cos(math.radians(apart_deg)) for other in kept):
            kept.append(direction)
    return len(kept)


def spread_deg(directions: Array) -> float:
    """Largest angle between two directions (N,3) of any length."""
    if len(directions) < 2:
        return 0.0
    rays = unit(directions)
    return math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0))))


def _gap(directions: Array, axis: Array) -> tuple[float, Array]:
    """Largest range of azimuth about ``axis`` without a direction, in degrees, and the unit vector to its middle."""
    across = unit(np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0]))
    up = np.cross(axis, across)
    off_axis = directions[np.linalg.norm(np.cross(directions, axis), axis=1) > math.sin(math.radians(5.0))]
    if len(off_axis) == 0:
        return 360.0, across
    azimuth = np.sort(np.arctan2(off_axis @ up, off_axis @ across))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    middle = azimuth[widest] + 0.5 * gaps[widest]
    return math.degrees(gaps[widest]), math.cos(middle) * across + math.sin(middle) * up


def _named(direction: Array) -> str:
    """A direction in terms of the model's axes, e.g. ``+x −y``."""
    words = [
        f"{'+' if value > 0 else '−'}{name}" for name, value in zip("xyz", direction, strict=True) if abs(value) > 0.38
    ]
    return " ".join(words) + " of the model"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def unit(vectors: Array) -> Array:
    """Vectors (...,3) of length 1 in the same directions."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
