"""Where to stand for the photos of a part: viewpoints in the declared range, and what each component is seen from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad.check import GUESSED_CAMERA
from arview.cad.part import Part
from arview.cad.tolerance_check import ToleranceCheckOptions
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, look_at
from arview.rendering.renderers import ZBufferRenderer

MIN_VISIBLE_PX = 60
"""Pixels of a component, in the small pictures of the plan, from which a photo counts as one that shows it."""
PLAN_WIDTH_PX = 480
"""Width of those pictures."""
MIN_PHOTOS_OF_COMPONENT = 4
"""Photos that must show a component for a place with a small U."""


def photo_plan(part: Part, count: int, camera: Camera | None = None) -> dict[str, Any]:
    """A plan of photos: two rings at two elevations of the declared range, evenly spread in azimuth.

    The expected U is that of `arview check`: a share of a pixel at the photo's distance, larger where few photos or a
    narrow spread of directions show a component (the error of a triangulated point falls with the square root of the
    photos and with the sine of the angle between them).

    Args:
        part: as it is set up.
        count: of the photos, 4 to 96.
        camera: of the photos; None: one of 66° with 4000 px.

    Raises:
        InputError: another number of photos.
    """
    if not 4 <= count <= 96:
        raise InputError(f"count: {count} photos, expected 4 to 96")
    camera = camera or GUESSED_CAMERA
    model, view_range = part.model, part.effective_view_range.for_camera(camera, part.model.diameter_mm)
    distance_mm = max(view_range.distance_mm[0], min(view_range.distance_mm[1], _fitting_mm(camera, model.diameter_mm)))
    eyes = []
    places = []
    for azimuth, elevation in _ring_angles(part, count):
        direction = view_range.direction(azimuth, elevation)
        eyes.append(model.center_in_model + distance_mm * direction)
        places.append({"azimuth_deg": azimuth, "elevation_deg": elevation, "direction": direction.tolist()})
    scale = PLAN_WIDTH_PX / camera.width
    small = camera.scaled(PLAN_WIDTH_PX, max(1, round(camera.height * scale)))
    renderer = ZBufferRenderer(model, small)
    up = view_range.up_in_model
    seen = np.zeros((count, len(model.components)), dtype=bool)
    for index, eye in enumerate(eyes):
        ids = renderer.render(look_at(eye, model.center_in_model, up)).component_ids
        pixels = np.bincount(ids[ids >= 0], minlength=len(model.components))
        seen[index] = pixels >= MIN_VISIBLE_PX
    options = ToleranceCheckOptions()
    mm_per_px = distance_mm / camera.fx
    return {
        "distance_mm": distance_mm,
        "photos": places,
        "components": [
            _component_row(
                component.name,
                np.flatnonzero(seen[:, index]).astype(np.int64),
                eyes,
                component.centroid_in_model,
                count,
            )
            | {"expected_U_mm": _expected_u_mm(seen[:, index], eyes, component.centroid_in_model, mm_per_px, options)}
            for index, component in enumerate(model.components)
        ],
    }


def _fitting_mm(camera: Camera, diameter_mm: float) -> float:
    """Distance at which a part spans nine tenths of the picture's smaller side."""
    return camera.fx * diameter_mm / (0.9 * min(camera.width, camera.height))


def _ring_angles(part: Part, count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of each photo: alternately on a lower and an upper ring."""
    view_range = part.effective_view_range
    low, high = view_range.elevation_deg
    low, high = max(low, 15.0) if high > 15.0 else low, min(high, 75.0) if low < 75.0 else high
    rings = (low + 0.3 * (high - low), low + 0.75 * (high - low))
    start, end = view_range.azimuth_deg
    step = min(end - start, 360.0) / count
    return [(start + (index + 0.5) * step, rings[index % 2]) for index in range(count)]


def _component_row(name: str, photos: NDArray[np.int64], eyes: list[Array], place: Array, count: int) -> dict[str, Any]:
    few = len(photos) < MIN_PHOTOS_OF_COMPONENT
    return {
        "name": name,
        "photos": photos.tolist(),
        "spread_deg": _spread_deg([eyes[index] for index in photos], place),
        "remark": f"seen in {len(photos)} of {count} photos only: take some from where it is not hidden" if few else "",
    }


def _spread_deg(eyes: list[Array], place: Array) -> float:
    """Largest angle between the directions from a place to some cameras."""
    if len(eyes) < 2:
        return 0.0
    rays = np.stack(eyes) - place
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.rad2deg(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))


def _expected_u_mm(
    is_seen: Array, eyes: list[Array], place: Array, mm_per_px: float, options: ToleranceCheckOptions
) -> float | None:
    """U to be expected of a component's place; None where too few photos show it."""
    photos = np.flatnonzero(is_seen)
    if len(photos) < 2:
        return None
    spread = np.deg2rad(min(_spread_deg([eyes[index] for index in photos], place), 90.0))
    if spread < 1e-3:
        return None
    return float(options.expected_u_px * mm_per_px * np.sqrt(max(24.0 / len(photos), 0.25)) / np.sin(spread))
