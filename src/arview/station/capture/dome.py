"""CaptureDome: directions around a part from which photos can be taken, and what each of them shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview import reconstruction
from arview.cad import Part, ViewRange
from arview.camera import Camera
from arview.core.checks import check_type
from arview.geometry import Array, look_at
from arview.station.capture.information import Views, focal_px
from arview.station.capture.options import CaptureOptions

CELLS_PER_PHOTO = 1.8
"""Directions of the dome per wanted photo."""
CELL_DEG = (8.0, 24.0)
"""Smallest and largest distance of neighbouring directions."""
ELEVATION_DEG = (15.0, 75.0)
"""Elevations that are asked for where the part's range of views goes further."""
FILL = (1.06, 0.55)
"""The part's diameter over the picture's shorter side at the nearest and the farthest distance."""

FITTING_FILL = 0.9
"""Share of the picture's shorter side that the part's diameter spans at the distance of a plan of photos."""


def fitting_distance_mm(camera: Camera, diameter_mm: float, fill: float = FITTING_FILL) -> float:
    """Distance at which a part spans a share of the picture's shorter side."""
    return camera.fx * diameter_mm / (fill * min(camera.width, camera.height))


@dataclass(frozen=True)
class CaptureDome:
    """Directions of photos: rings of elevation in the part's range of views.

    Attributes:
        angles_deg: (N,2) azimuth and elevation of each cell, in the frame of `ViewRange`.
        directions: (N,3) unit vectors of the model from the part's centre.
        cell_deg: distance of neighbouring cells.
        distance_mm: nearest and farthest distance of a photo.
        views: what a photo from the middle of each cell shows, by a rendering, and tells.
    """

    angles_deg: Array
    directions: Array
    cell_deg: float
    distance_mm: tuple[float, float]
    views: Views

    @classmethod
    def of(cls, part: Part, camera: Camera, options: CaptureOptions | None = None) -> CaptureDome:
        """The dome of a part for a camera; a small picture of the model is rendered for each cell.

        Args:
            part: with its range of views.
            camera: of the stream.
            options: see `CaptureOptions`.
        """
        check_type(part, Part, "CaptureDome: part")
        check_type(camera, Camera, "CaptureDome: camera")
        options = options or CaptureOptions()
        camera = camera.without_distortion()
        model = part.model
        view_range = part.effective_view_range.for_camera(camera, model.diameter_mm)
        angles, cell_deg = _cells(view_range, options)
        directions = np.array([view_range.direction(azimuth, elevation) for azimuth, elevation in angles])
        distance_mm = _ring(view_range, camera, model.diameter_mm)
        middle_mm = float(np.sqrt(distance_mm[0] * distance_mm[1]))
        eyes = model.center_in_model + middle_mm * directions
        up = view_range.up_in_model
        seen = np.array(
            [reconstruction.components_seen(model, camera, look_at(eye, model.center_in_model, up)) for eye in eyes]
        )
        focal = focal_px(camera) * options.photo_px_per_px
        views = Views.of(component_points(part), seen, eyes, focal)
        return cls(angles, directions, cell_deg, distance_mm, views)

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """(N,C) which components a photo from each cell shows."""
        return self.views.is_seen

    def nearest(self, direction: Array) -> int:
        """Index of the cell nearest to a direction (3,)."""
        return int(np.argmax(self.directions @ direction))

    def layout(self, wanted_photos: int) -> dict[str, Any]:
        """Cells and distances for a page that draws the dome."""
        return {
            "cells": [
                {
                    "azimuth_deg": round(float(azimuth), 2),
                    "elevation_deg": round(float(elevation), 2),
                    "direction_in_model": [round(float(value), 5) for value in direction],
                }
                for (azimuth, elevation), direction in zip(self.angles_deg, self.directions, strict=True)
            ],
            "cell_deg": round(self.cell_deg, 2),
            "distance_mm": [round(value, 1) for value in self.distance_mm],
            "wanted_photos": wanted_photos,
        }


def component_points(part: Part) -> Array:
    """(C,3) centre of mass of each component, mm."""
    return np.array([component.centroid_in_model for component in part.model.components])


def asked_elevation_deg(view_range: ViewRange, limits_deg: tuple[float, float]) -> tuple[float, float]:
    """Elevations from which photos are asked for: the declared ones, within limits as far as the range reaches them."""
    low, high = view_range.elevation_deg
    least, most = limits_deg
    return max(low, least) if high > least else low, min(high, most) if low < most else high


def _cells(view_range: ViewRange, options: CaptureOptions) -> tuple[Array, float]:
    """(N,2) azimuth and elevation of the cells, and their distance, so that there are enough for the photos wanted."""
    low, high = asked_elevation_deg(view_range, ELEVATION_DEG)
    start, end = view_range.azimuth_deg
    is_round = end - start >= 360.0
    width_deg = min(end - start, 360.0)
    area = width_deg * np.rad2deg(np.sin(np.deg2rad(high)) - np.sin(np.deg2rad(low)))
    cell_deg = float(np.clip(np.sqrt(area / (CELLS_PER_PHOTO * options.wanted_photos)), *CELL_DEG))
    rings = max(1, round((high - low) / cell_deg))
    cells = []
    for ring in range(rings):
        elevation = low + (ring + 0.5) * (high - low) / rings
        count = max(1, round(width_deg * np.cos(np.deg2rad(elevation)) / cell_deg))
        # Rings are offset against each other, so that photos of two rings are not one above the other.
        offset = 0.25 + 0.5 * (ring % 2) if is_round else 0.5
        cells += [(start + (index + offset) * width_deg / count, elevation) for index in range(count)]
    return np.array(cells), cell_deg


def _ring(view_range: ViewRange, camera: Camera, diameter_mm: float) -> tuple[float, float]:
    """Nearest and farthest distance of a photo: the part large in the picture, within the range of views."""
    low, high = view_range.distance_mm
    near, far = (fitting_distance_mm(camera, diameter_mm, fill) for fill in FILL)
    near, far = float(np.clip(near, low, high)), float(np.clip(far, low, high))
    if far < 1.1 * near:  # the declared range is nearer or farther than the picture would want it
        near, far = max(low, 0.75 * far), min(high, 1.33 * near)
    return near, max(far, near)
