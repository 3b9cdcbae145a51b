"""Signed distances of a cloud to the CAD, in all and by component: statistics, coloured PLY and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.core.atomic import write_file
from arview.core.fits import robust_sigma
from arview.errors import InputError
from arview.geometry import Array, apply, look_at
from arview.inspection import DistanceStatistics
from arview.measurement.cloud.mesh_surface import MeshSurface
from arview.measurement.plot import Chart, Picture
from arview.reconstruction import DenseCloud

_BINS = 400
"""Bins of the histogram from which the width at half maximum is taken."""
_WHOLE = "all"
"""Name of the statistics of the whole cloud."""
COLOR_STOPS = np.array(
    [[33, 60, 160], [80, 170, 230], [225, 235, 225], [245, 170, 60], [180, 30, 30]], dtype=np.float64
)
"""RGB colours from −limit to +limit."""
_FIELDS = ("x", "y", "z", "distance_mm", "red", "green", "blue")
_VERTEX = np.dtype([(name, "<f4" if index < 4 else "u1") for index, name in enumerate(_FIELDS)])
_PROPERTIES = [f"property {'float' if index < 4 else 'uchar'} {name}" for index, name in enumerate(_FIELDS)]


@dataclass(frozen=True)
class DistanceMap:
    """Points within reach of the CAD and their distances.

    Attributes:
        points_in_model: (N,3) mm.
        distances: (N,) signed, positive outside, mm.
        components: (N,) index of the nearest component, -1 if unknown.
        reach_mm: points farther away were left out.
        statistics: of the whole cloud, then of each component.
    """

    points_in_model: Array
    distances: Array
    components: NDArray[np.int64]
    reach_mm: float
    statistics: tuple[DistanceStatistics, ...]


def distance_map(
    cloud: DenseCloud, model: Model, places: Mapping[str, Array] | None = None, reach_mm: float = 3.0
) -> DistanceMap:
    """Signed distances of a cloud in mm, in the frame of the CAD, to the model's surface.

    Args:
        cloud: of the part.
        model: the nominal CAD.
        places: (4,4) ``measured_from_nominal`` by component, to see form errors without displacements; default none.
        reach_mm: points farther from every surface are left out.

    Raises:
        InputError: no point is within reach.
    """
    places = places or {}
    vertices = [apply(places.get(c.name, np.eye(4)), c.vertices_in_model) for c in model.components]
    _, faces, groups = model.mesh
    surface = MeshSurface(np.concatenate(vertices), faces, groups)
    points = np.asarray(cloud.points, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    closest = surface.closest(points, reach_mm)
    near = closest.faces >= 0
    if not near.any():
        raise InputError(f"distance map: none of {len(points)} points is within {reach_mm:g} mm of the CAD")
    distances, components = closest.distances[near], surface.groups[closest.faces[near]]
    rows = [_statistics(_WHOLE, distances, reach_mm)]
    for index, component in enumerate(model.components):
        if np.count_nonzero(components == index) > 1:
            rows.append(_statistics(component.name, distances[components == index], reach_mm))
    return DistanceMap(points[near], distances, components, reach_mm, tuple(rows))


def write_distance_ply(distances: DistanceMap, path: Path, limit_mm: float = 1.0) -> None:
    """Write binary PLY with x y z distance_mm red green blue; colours run from −limit (blue) to +limit (red).

    Raises:
        OutputError: the file cannot be written.
    """
    rows = np.zeros(len(distances.points_in_model), dtype=_VERTEX)
    values = [*distances.points_in_model.T, distances.distances, *_colors(distances.distances, limit_mm).T]
    for name, value in zip(_FIELDS, values, strict=True):
        rows[name] = value
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *_PROPERTIES, "end_header", ""]
    write_file(path, "\n".join(header).encode() + rows.tobytes())


def read_distance_ply(path: Path, reach_mm: float, statistics: tuple[DistanceStatistics, ...]) -> DistanceMap:
    """Read a map that `write_distance_ply` wrote; the file does not hold the components, which are -1.

    Raises:
        InputError: the file cannot be read, is truncated or has other properties.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    header, found, body = data.partition(b"end_header\n")
    lines = header.decode("ascii", "replace").split("\n")
    if not found or lines[0] != "ply" or [line for line in lines if line.startswith("property ")] != _PROPERTIES:
        raise InputError(f"{path}: is not a distance map written by arview")
    count = next((int(line.split()[2]) for line in lines if line.startswith("element vertex ")), -1)
    if len(body) != count * _VERTEX.itemsize:
        raise InputError(f"{path}: is truncated; measure again")
    rows = np.frombuffer(body, dtype=_VERTEX)
    points = np.stack([rows[name] for name in "xyz"], axis=-1).astype(np.float64)
    return DistanceMap(points, rows["distance_mm"].astype(np.float64), np.full(count, -1), reach_mm, statistics)


def histogram_picture(distances: DistanceMap, model: Model, component: str | None = None) -> Picture:
    """Histogram of the distances of a component, or of all, with its statistics, as (H,W,3) uint8 RGB."""
    name = component or _WHOLE
    row = next((item for item in distances.statistics if item.name == name), None)
    if row is None:
        raise InputError(f"distance map: no points of {name!r}")
    mine = (
        np.ones(len(distances.distances), bool)
        if component is None
        else (distances.components == model.index(component))
    )
    span = min(distances.reach_mm, max(6.0 * row.fwhm_mm, 0.05))
    edges = np.linspace(row.median_mm - span, row.median_mm + span, 81)
    count, _ = np.histogram(distances.distances[mine], edges)
    chart = Chart(
        f"{name}: mean {row.mean_mm:+.3f}, sigma {row.sigma_mm:.3f}, FWHM {row.fwhm_mm:.3f} mm",
        f"signed distance of {row.count} points to the CAD / mm",
        "points",
    )
    chart.add(0.5 * (edges[1:] + edges[:-1]), count, "", "bars")
    return chart.draw()


def map_picture(
    distances: DistanceMap,
    direction: tuple[float, float, float] = (0.6, -0.8, 1.0),
    limit_mm: float = 1.0,
    width: int = 1200,
    height: int = 900,
) -> Picture:
    """The points in their colours in parallel projection from a direction, with a scale, as (H,W,3) uint8 RGB."""
    points = distances.points_in_model
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    eye = middle + np.array(direction) / np.linalg.norm(direction) * 1000.0
    seen = apply(look_at(eye, middle, [0.0, 0.0, 1.0]), points)
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    scale = 0.94 * float(min((width - 110) / (high[0] - low[0] + 1e-9), height / (high[1] - low[1] + 1e-9)))
    place = (seen[:, :2] - 0.5 * (low + high)) * scale + [0.5 * (width - 110), 0.5 * height]
    image = np.full((height, width, 3), 255, dtype=np.uint8)
    order = np.argsort(-seen[:, 2])  # far points first, so that near ones are drawn over them
    u, v = np.floor(place[order]).astype(int).T
    colors = _colors(distances.distances, limit_mm)[order]
    size = 2 if len(points) > 200_000 else 3
    for du in range(size):
        for dv in range(size):
            inside = (u + du >= 0) & (u + du < width) & (v + dv >= 0) & (v + dv < height)
            image[v[inside] + dv, u[inside] + du] = colors[inside]
    bar = _colors(np.linspace(limit_mm, -limit_mm, 400), limit_mm)
    top = (height - 400) // 2
    image[top : top + 400, width - 95 : width - 70] = bar[:, None]
    for value in np.linspace(-limit_mm, limit_mm, 5):
        row = round(top + 200 - 200 * value / limit_mm)
        cv2.putText(image, f"{value:+.2g}", (width - 64, row + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1)
    cv2.putText(image, "mm", (width - 92, top - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1)
    return image


def _statistics(name: str, distances: Array, reach_mm: float) -> DistanceStatistics:
    """Statistics of some distances."""
    return DistanceStatistics(
        name,
        len(distances),
        float(distances.mean()),
        float(distances.std()),
        float(np.median(distances)),
        full_width_at_half_maximum(distances, reach_mm),
    )


def full_width_at_half_maximum(values: Array, reach: float) -> float:
    """Width of the peak of a smoothed histogram of values (N,) at half its height."""
    spread = robust_sigma(values - np.median(values))
    span = min(reach, max(6.0 * spread, 1e-4))
    edges = np.linspace(np.median(values) - span, np.median(values) + span, _BINS + 1)
    count, _ = np.histogram(values, edges)
    # Silverman's bandwidth for the core; the widening of a Gaussian by the smoothing is subtracted at the end.
    width = 0.9 * spread * len(values) ** -0.2 / (edges[1] - edges[0])
    reach_bins = int(np.ceil(4.0 * width)) + 1
    kernel = np.exp(-0.5 * (np.arange(-reach_bins, reach_bins + 1) / max(width, 0.3)) ** 2)
    smooth = np.convolve(count, kernel / kernel.sum(), mode="same")
    peak = int(np.argmax(smooth))
    half = 0.5 * smooth[peak]
    below = np.flatnonzero(smooth < half)
    left, right = below[below < peak], below[below > peak]
    if len(left) == 0 or len(right) == 0:
        return float(edges[-1] - edges[0])
    a, b = left[-1], right[0]
    start = a + (half - smooth[a]) / (smooth[a + 1] - smooth[a])
    end = b - (half - smooth[b]) / (smooth[b - 1] - smooth[b])
    full = (end - start) * (edges[1] - edges[0])
    smoothing = 2.3548 * max(width, 0.3) * (edges[1] - edges[0])
    return float(np.sqrt(max(full**2 - smoothing**2, 0.0)))


def _colors(distances: Array, limit_mm: float) -> NDArray[np.uint8]:
    """(N,3) uint8 RGB of distances."""
    share = np.clip(0.5 + 0.5 * distances / limit_mm, 0.0, 1.0)
    places = np.linspace(0.0, 1.0, len(COLOR_STOPS))
    return np.stack([np.interp(share, places, COLOR_STOPS[:, k]) for k in range(3)], axis=-1).astype(np.uint8)
