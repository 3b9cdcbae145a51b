"""The scene of the viewer in the page: CAD model, cloud and arrows as JSON."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview import measurement, overlay, reconstruction
from arview.cad import Model
from arview.geometry import Array
from arview.inspection import Inspection, decimals_of
from arview.reconstruction.seen_surface import seen_surface

_STEPS = 65535
"""Steps of the coordinates, which are stored in 16 bits over their bounding box: a metre in steps of 15 µm."""

_REACH_MM = 3.0
"""Points farther from the CAD model have no distance."""


MAX_POINTS = 90_000
"""Points of the cloud in the page."""
MAX_FACES = 400_000
"""Triangles above which the CAD model is omitted, because the page would become slow."""
MARGIN = 0.15
"""Margin around the part, share of its diameter, outside of which the cloud is cut off."""


def make_scene(
    inspection: Inspection,
    model: Model | None,
    cloud: reconstruction.DenseCloud | None,
    distances: measurement.DistanceMap | None,
    sparse: reconstruction.SparseModel | None = None,
) -> dict[str, Any] | None:
    """The scene as a JSON object; None when there is neither CAD model nor cloud. All data are in one frame.

    Surfaces of the CAD that no two photos saw are listed on their own, to be hatched: there the CAD model stands in
    for what the cloud lacks.

    Args:
        inspection: the deviations.
        model: the CAD model, or None.
        cloud: cloud in the colours of the photos, or None.
        distances: distances of a cloud to the CAD model, used if there is no cloud with colours.
        sparse: photos with their poses, or None.
    """
    if model is not None and len(model.mesh[1]) > MAX_FACES:
        model = None
    scene: dict[str, Any] = {"stops": measurement.COLOR_STOPS.tolist(), "components": []}
    if model is not None:
        scene["mesh"] = _mesh(model)
        if sparse is not None and sparse.photos:
            scene["uncovered"] = _uncovered(model, sparse)
        scene["arrow_scale"] = overlay.arrow_scale(inspection, model.diameter_mm, overlay.OverlayOptions())
    points = _points(cloud, model, distances)
    if points is not None:
        scene["cloud"] = points
    if model is None and points is None:
        return None
    names = [c.name for c in model.components] if model is not None else [c.name for c in inspection.components]
    for name in names:
        deviation = inspection.find(name)
        entry: dict[str, Any] = {"name": name, "verdict": None if deviation is None else deviation.verdict.value}
        if deviation is not None:
            details = deviation.details
            place = None if details is None else details.measured_from_nominal
            entry |= {
                "displacement": list(deviation.displacement_mm),
                "distance": deviation.distance_mm,
                "uncertainty": deviation.uncertainty_mm,
                "digits": decimals_of(deviation.uncertainty_mm),
                "missing": deviation.finding is not None,
                "place": None if place is None else np.array(place).ravel().tolist(),
            }
        if model is not None:
            stated = None if deviation is None or deviation.details is None else deviation.details.center_mm
            middle = model.component(name).bounds_in_model.mean(axis=0).tolist()
            entry["center"] = middle if stated is None else list(stated)
        scene["components"].append(entry)
    scene["foreign"] = [
        {"center": list(one.center_mm), "size": list(one.size_mm), "text": one.text}
        for one in inspection.foreign_objects
    ]
    return scene


def scene_json(scene: dict[str, Any]) -> str:
    """The scene as JSON text without ``<``, so that it can be embedded in a script element."""
    return json.dumps(_rounded(scene), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _mesh(model: Model) -> dict[str, Any]:
    vertices, faces, owner = model.mesh
    ranges = []
    for index in range(len(model.components)):
        mine = np.flatnonzero(owner == index)
        ranges.append([int(mine[0]), int(mine[-1]) + 1])
    return {**_packed(vertices), "faces": _text(faces.astype("<u4")), "ranges": ranges}


def _uncovered(model: Model, sparse: reconstruction.SparseModel) -> dict[str, Any]:
    """Pieces of the surface that no two photos saw, three corners each, and their share of each component's surface."""
    surface = seen_surface(model, [(photo.camera, photo.cam_from_scan) for photo in sparse.photos])
    corners = surface.corners[~surface.is_seen].reshape(-1, 3)
    shares = [round(1.0 - surface.share_of(index), 4) for index in range(len(model.components))]
    return {**(_packed(corners) if len(corners) else {"points": ""}), "shares": shares}


def _points(
    cloud: reconstruction.DenseCloud | None, model: Model | None, distances: measurement.DistanceMap | None
) -> dict[str, Any] | None:
    """A random sample of the points near the part, with colours and distances as far as they are known."""
    rng = np.random.default_rng(0)
    if cloud is not None:
        points = np.asarray(cloud.points, dtype=np.float64)
        keep = np.isfinite(points).all(axis=1)
        if model is not None:
            reach = MARGIN * model.diameter_mm
            low, high = model.bounds_in_model
            keep &= ((points > low - reach) & (points < high + reach)).all(axis=1)
        chosen = _choice(np.flatnonzero(keep), MAX_POINTS, rng)
        if len(chosen) == 0:
            return None
        near: dict[str, Any] = {"colors": _text(np.asarray(cloud.colors[chosen], dtype="u1"))}
        if model is not None:
            near["distances"] = _text(_distances_um(points[chosen], model))
        return {**_packed(points[chosen]), **near, "of": len(points)}
    if distances is not None:
        chosen = _choice(np.arange(len(distances.distances)), MAX_POINTS, rng)
        um = np.round(1000.0 * distances.distances[chosen]).clip(-32767, 32767).astype("<i2")
        return {**_packed(distances.points_in_model[chosen]), "distances": _text(um), "of": len(distances.distances)}
    return None


def _distances_um(points: Array, model: Model) -> NDArray[np.int16]:
    """Signed distances of the points in µm; −32768 for points far from the CAD model."""
    closest = measurement.MeshSurface(*model.mesh).closest(points, _REACH_MM)
    um = np.where(closest.faces >= 0, np.round(1000.0 * closest.distances).clip(-32767, 32767), -32768)
    return np.asarray(um.astype("<i2"))


def _choice(indices: NDArray[np.int64], limit: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return indices if len(indices) <= limit else np.sort(rng.choice(indices, limit, replace=False))


def _packed(points: Array) -> dict[str, Any]:
    """Points (N,3) with coordinates of 16 bits over their bounding box."""
    low, high = points.min(axis=0), points.max(axis=0)
    step = np.maximum(high - low, 1e-6) / _STEPS
    whole = np.round((points - low) / step).astype("<u2")
    return {"low": low.tolist(), "step": step.tolist(), "points": _text(whole)}


def _text(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def _rounded(value: Any) -> Any:
    """Round floats to seven digits to reduce the size of the page."""
    if isinstance(value, float):
        return float(f"{value:.7g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list) else value
