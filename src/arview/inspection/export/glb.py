"""The deviations as glTF 2.0 (GLB): components at their design and measured poses, with displacement arrows."""

from __future__ import annotations

from typing import Any

import numpy as np

from arview.cad import Component, Model
from arview.geometry import Array
from arview.inspection.fingerprint import fingerprint
from arview.inspection.record import ComponentDeviation, Finding, Inspection, Verdict
from arview.inspection.rounding import decimals_beside_limit, decimals_of

_GHOST, _CONTEXT, _ARROW = (0.62, 0.68, 0.76, 0.3), (0.45, 0.49, 0.54, 1.0), (0.02, 0.02, 0.03, 1.0)
_COLORS = {
    Verdict.PASS: (0.07, 0.50, 0.36, 1.0),
    Verdict.FAIL: (0.76, 0.18, 0.17, 1.0),
    Verdict.UNDECIDED: (0.80, 0.52, 0.05, 1.0),
    Verdict.MEASURED: (0.14, 0.40, 0.70, 1.0),
    Verdict.NOT_MEASURED: (0.36, 0.42, 0.50, 1.0),
}
"""Colours of the components: sRGB and opacity."""
_M_PER_MM = 1e-3
_ARROW_SHARE = 0.14
"""Length of the longest arrow as a fraction of the diameter of the model."""
_ROUND_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def to_glb(inspection: Inspection, model: Model, arrow_scale: float | None = None, sha256: str | None = None) -> bytes:
    """A scene in metres with the nodes ``design``, ``measured`` and ``arrows``, each with a node for each component.

    +Y of glTF is +Z of the model. The ``extras`` of a node hold verdict, displacement (null where undetermined),
    distance, U and tolerance; those of the scene hold the fingerprint of the inspection.

    Args:
        inspection: the inspection.
        model: the CAD model.
        arrow_scale: exaggeration of the arrows; default: a round number chosen by the largest displacement.
        sha256: fingerprint of the file the inspection was read from; default: that of the inspection.

    Raises:
        MismatchError: the inspection belongs to another model.
    """
    import trimesh

    inspection.check_model(model)
    scale = arrow_scale or _arrow_scale(inspection, model)
    scene = trimesh.Scene(base_frame="world", metadata={"inspection_sha256": sha256 or fingerprint(inspection)})
    upright = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
    scene.graph.update("model", "world", matrix=upright)
    for group in ("design", "measured", "arrows"):
        scene.graph.update(group, "model", matrix=np.eye(4))
    for component in model.components:
        deviation = inspection.find(component.name)
        color = _CONTEXT if deviation is None else _GHOST
        _add_node(scene, f"design/{component.name}", "design", _mesh(component, color), np.eye(4), {})
        if deviation is None:
            continue
        extras = _extras(deviation)
        place = None if deviation.details is None else deviation.details.measured_from_nominal
        if place is not None and deviation.finding is not Finding.MISSING:
            moved = np.array(place)
            moved[:3, 3] *= _M_PER_MM
            solid = _mesh(component, _COLORS[deviation.verdict])
            _add_node(scene, f"measured/{component.name}", "measured", solid, moved, extras)
        stated = None if deviation.details is None else deviation.details.center_mm
        tail = component.bounds_in_model.mean(axis=0) if stated is None else np.array(stated)
        arrow = _arrow(deviation, tail, scale, 0.008 * model.diameter_mm)
        if arrow is not None:
            _add_node(scene, f"arrows/{component.name}", "arrows", arrow, np.eye(4), extras | {"times": scale})
    return bytes(scene.export(file_type="glb"))


def _add_node(scene: Any, name: str, parent: str, mesh: Any, matrix: Array, extras: dict[str, Any]) -> None:
    scene.add_geometry(
        mesh, node_name=name, geom_name=name, parent_node_name=parent, transform=matrix, metadata=extras or None
    )


def _mesh(component: Component, color: tuple[float, float, float, float]) -> Any:
    """The mesh of a component in metres, with flat shading."""
    import trimesh

    corners = component.vertices_in_model[component.faces].reshape(-1, 3) * _M_PER_MM
    faces = np.arange(len(corners)).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh.visual = trimesh.visual.TextureVisuals(material=_material(color))
    return mesh


def _material(color: tuple[float, float, float, float]) -> Any:
    from trimesh.visual.material import PBRMaterial

    rgb = np.array(color[:3])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return PBRMaterial(
        baseColorFactor=[*linear.tolist(), color[3]],
        metallicFactor=0.0,
        roughnessFactor=0.8,
        doubleSided=True,
        alphaMode="BLEND" if color[3] < 1.0 else "OPAQUE",
    )


def _arrow(deviation: ComponentDeviation, tail: Array, scale: float, width_mm: float) -> Any:
    """An arrow from the design position along the determined displacement; None if that is within U of zero."""
    import trimesh

    if deviation.distance_mm is None or deviation.distance_mm <= (deviation.uncertainty_mm or 0.0):
        return None
    along = np.array([value or 0.0 for value in deviation.displacement_mm]) * scale
    length = float(np.linalg.norm(along))
    head = min(4.0 * width_mm, 0.6 * length)
    shaft = trimesh.creation.cylinder(radius=0.5 * width_mm, segment=[[0, 0, 0], [0, 0, length - head]], sections=16)
    tip = trimesh.creation.cone(radius=1.4 * width_mm, height=head, sections=24)
    tip.apply_translation([0.0, 0.0, length - head])
    arrow = trimesh.util.concatenate([shaft, tip])
    arrow.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], along / length))
    arrow.apply_translation(tail)
    arrow.apply_scale(_M_PER_MM)
    arrow.visual = trimesh.visual.TextureVisuals(material=_material(_ARROW))
    return arrow


def _extras(one: ComponentDeviation) -> dict[str, Any]:
    decimals = decimals_of(one.uncertainty_mm)
    return {
        "verdict": one.verdict.value,
        "displacement_mm": [None if value is None else round(value, decimals) for value in one.displacement_mm],
        "distance_mm": None
        if one.distance_mm is None
        else round(one.distance_mm, decimals_beside_limit(one.distance_mm, one.uncertainty_mm, one.tolerance_mm)),
        "uncertainty_mm": None if one.uncertainty_mm is None else round(one.uncertainty_mm, decimals),
        "tolerance_mm": one.tolerance_mm,
    }


def _arrow_scale(inspection: Inspection, model: Model) -> float:
    longest = max((one.distance_mm or 0.0 for one in inspection.components), default=0.0)
    fitting = [scale for scale in _ROUND_SCALES if scale * longest <= _ARROW_SHARE * model.diameter_mm]
    return float(fitting[-1] if fitting else _ROUND_SCALES[0])
