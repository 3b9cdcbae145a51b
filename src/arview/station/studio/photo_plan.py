"""Where to stand for the photos of a part: viewpoints in the declared range, and what each component is seen from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview import reconstruction
from arview.cad import GUESSED_CAMERA, Part
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, look_at
from arview.station import capture

MIN_PHOTOS_OF_COMPONENT = 4
"""Photos that must show a component for a place with a small U."""


def photo_plan(part: Part, count: int, camera: Camera | None = None) -> dict[str, Any]:
    """A plan of photos: two rings at two elevations of the declared range, evenly spread in azimuth.

    The expected U is that of guided capture, see `arview.station.capture.information`.

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
    fitting_mm = capture.fitting_distance_mm(camera, model.diameter_mm)
    distance_mm = max(view_range.distance_mm[0], min(view_range.distance_mm[1], fitting_mm))
    angles = _ring_angles(part, count)
    directions = np.array([view_range.direction(azimuth, elevation) for azimuth, elevation in angles])
    eyes = model.center_in_model + distance_mm * directions
    up = view_range.up_in_model
    seen = np.array(
        [reconstruction.components_seen(model, camera, look_at(eye, model.center_in_model, up)) for eye in eyes]
    )
    points = capture.component_points(part)
    expected_mm = capture.expanded_uncertainty(
        capture.KnownViews(capture.Views.of(points, seen, eyes, capture.focal_px(camera))).information()
    )
    return {
        "distance_mm": distance_mm,
        "photos": [
            {"azimuth_deg": azimuth, "elevation_deg": elevation, "direction": direction.tolist()}
            for (azimuth, elevation), direction in zip(angles, directions, strict=True)
        ],
        "components": [
            _component_row(component.name, np.flatnonzero(seen[:, index]), eyes - points[index], count)
            | {"expected_U_mm": float(expected_mm[index]) if seen[:, index].sum() >= 2 else None}
            for index, component in enumerate(model.components)
        ],
    }


def _ring_angles(part: Part, count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation of each photo: alternately on a lower and an upper ring."""
    view_range = part.effective_view_range
    low, high = capture.asked_elevation_deg(view_range, capture.ELEVATION_DEG)
    rings = (low + 0.3 * (high - low), low + 0.75 * (high - low))
    start, end = view_range.azimuth_deg
    step = min(end - start, 360.0) / count
    return [(start + (index + 0.5) * step, rings[index % 2]) for index in range(count)]


def _component_row(name: str, photos: NDArray[np.int64], rays: Array, count: int) -> dict[str, Any]:
    """A component, the photos that show it and how far these are apart, by the rays (N,3) to all photos."""
    few = len(photos) < MIN_PHOTOS_OF_COMPONENT
    return {
        "name": name,
        "photos": photos.tolist(),
        "spread_deg": reconstruction.spread_deg(rays[photos]),
        "remark": f"seen in {len(photos)} of {count} photos only: take some from where it is not hidden" if few else "",
    }
