"""The part that is set up in the studio: its text, the part that the text describes, and the edits of the page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import (
    Datum,
    FoundSymmetry,
    LoadedCad,
    Model,
    Part,
    PickedFeature,
    Symmetry,
    check_part,
    find_part_file,
    find_symmetries,
    load_cad,
    part_from_text,
    pick_features,
)
from arview.errors import InputError
from arview.station.studio.part_text import PartText, Plain

COMPONENT_KEYS = ("role", "color", "position_tolerance_mm", "angle_tolerance_deg", "point")
"""Keys of a component that the page can set."""
PART_KEYS = ("name", "serial", "serial_pattern", "up", "unit")
"""Keys of [part] that the page can set."""


class StudioDocument:
    """A part file being edited. Every edit is checked as the whole file would be; one that is refused changes nothing.

    Attributes:
        path: the part file, which need not exist yet.
        text: its text.
        part: the part that the text describes.
        cad: model of the whole CAD file, ignored components included.

    Raises:
        InputError: the part file or CAD file cannot be read.
    """

    def __init__(self, path: str | Path, unit: str | None = None) -> None:
        found = find_part_file(path)
        self._load = lru_cache(maxsize=4)(load_cad)
        self._lock = threading.RLock()
        if found.suffix.lower() == ".toml":
            self.path, self.text = found, PartText.read(found)
        else:
            self.path, self.text = _free_path(found), PartText.for_cad(found.name, unit)
        self.part = self._parsed(self.text.text)
        self.cad = self._whole_model()

    def describe(self) -> dict[str, Any]:
        """What the page shows of the part: see `arview.station.studio.app`."""
        with self._lock:
            part, text = self.part, self.text
            ignored = {settings.name for settings in part.settings if settings.role == "ignore"}
            view_range = part.effective_view_range
            return {
                "name": part.name,
                "path": str(self.path),
                "cad": part.cad_path.name,
                "revision": text.revision,
                "is_saved": text.is_saved,
                "can_undo": text.can_undo,
                "can_redo": text.can_redo,
                "text": text.text,
                "serial": part.serial,
                "up": part.up,
                "unit": text.value(("part", "unit")),
                "model_hash": part.model.source_hash,
                "diameter_mm": part.model.diameter_mm,
                "center_mm": part.model.center_in_model.tolist(),
                "components": [
                    {
                        "index": index,
                        "name": settings.name,
                        "path": list(part.paths[index] if part.paths else ()) or [settings.name],
                        "role": settings.role,
                        "color": "#" + "".join(f"{round(255 * value):02x}" for value in component.color),
                        "position_tolerance_mm": settings.position_tolerance_mm,
                        "angle_tolerance_deg": settings.angle_tolerance_deg,
                        "point": settings.point if isinstance(settings.point, str) else list(settings.point),
                        "size_mm": np.ptp(component.vertices_in_model, axis=0).tolist(),
                        "faces": len(component.faces),
                    }
                    for index, (settings, component) in enumerate(
                        zip(part.settings, self._drawn_components(ignored), strict=True)
                    )
                ],
                "datums": [_datum_row(datum) for datum in part.datums],
                "features": [_datum_row(feature) for feature in part.features],
                "view_range": {
                    "is_declared": part.view_range is not None,
                    "distance_mm": list(view_range.distance_mm),
                    "elevation_deg": list(view_range.elevation_deg),
                    "azimuth_deg": list(view_range.azimuth_deg),
                    "roll_deg": list(view_range.roll_deg),
                },
                "symmetries": [_symmetry_row(symmetry) for symmetry in part.symmetries],
            }

    def findings(self) -> list[dict[str, str]]:
        """The remarks of `arview check`: severity and text."""
        return [{"severity": one.severity, "text": one.text} for one in check_part(self.part).findings]

    def found_symmetries(self) -> list[dict[str, Any]]:
        """Symmetries of the geometry: exact ones, and near ones with what breaks them."""
        model = self.part.model
        vertices, faces, owners = model.mesh
        found = find_symmetries(vertices, faces.astype(np.int64), owners.astype(np.int64))
        return [_found_row(one, model) for one in found]

    def pick(self, component: str, face: int, point_mm: Sequence[float]) -> list[dict[str, Any]]:
        """Features at a point, as datums without a label.

        Raises:
            InputError: no such component or face, or no point.
        """
        point = np.asarray(point_mm, dtype=np.float64)
        if point.shape != (3,) or not np.all(np.isfinite(point)):
            raise InputError("point_mm: expected three numbers")
        picked = self.cad.component(component)
        return [_picked_row(component, one) for one in pick_features(picked, face, point)]

    def edit(self, change: Mapping[str, Any]) -> None:
        """Carry out an edit of the page.

        ``kind`` is one of: ``component`` (names or selectors, key, value), ``part`` (key, value), ``view_range``
        (value: table or null), ``datum`` and ``feature`` (label, value: table or null), ``symmetries`` (value: tables),
        ``text`` (value).

        Raises:
            InputError: the edit is unknown, or the part file would not be valid with it.
        """
        edits: dict[str, Callable[[Mapping[str, Any]], str]] = {
            "component": self._component_text,
            "part": lambda c: self.text.with_value(("part", _one_of(c, "key", PART_KEYS)), c.get("value")),
            "view_range": lambda c: self.text.with_value(("view_range",), _rounded(c.get("value"))),
            "datum": lambda c: self.text.with_value(("datums", _label(c)), _rounded(c.get("value"))),
            "feature": lambda c: self.text.with_value(("features", str(c.get("label"))), _rounded(c.get("value"))),
            "symmetries": lambda c: self.text.with_list("symmetry", _rounded(_tables(c.get("value")))),
            "text": lambda c: str(c.get("value", "")),
        }
        with self._lock:
            changed = edits[_one_of(change, "kind", tuple(edits))](change)
            part = self._parsed(changed)
            self.text.change(changed)
            self.part = part

    def undo(self) -> bool:
        """Undo the last edit; False when there is none."""
        return self._step(self.text.undo)

    def redo(self) -> bool:
        """Do the last undone edit again; False when there is none."""
        return self._step(self.text.redo)

    def save(self) -> Path:
        """Write the part file, atomically.

        Raises:
            OutputError: it cannot be written.
        """
        with self._lock:
            self.text.save(self.path)
        return self.path

    def _step(self, move: Callable[[], bool]) -> bool:
        with self._lock:
            has_moved = move()
            if has_moved:
                self.part = self._parsed(self.text.text)
            return has_moved

    def _component_text(self, change: Mapping[str, Any]) -> str:
        names = change.get("names")
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError("names: expected a list of component names")
        key, value = _one_of(change, "key", COMPONENT_KEYS), change.get("value")
        text = self.text
        for name in names:
            text = PartText(text.with_value(("components", name, key), value))
        return text.text

    def _parsed(self, text: str) -> Part:
        return part_from_text(text, self.path, load=self._load)

    def _whole_model(self) -> Model:
        return self._loaded().model

    def _loaded(self) -> LoadedCad:
        """The CAD file as the part file reads it, kept from the parsing."""
        calls: list[LoadedCad] = []

        def load(*arguments: Any) -> LoadedCad:
            calls.append(self._load(*arguments))
            return calls[-1]

        part_from_text(self.text.text, self.path, load=load)
        return calls[-1]

    def _drawn_components(self, ignored: set[str]) -> list[Any]:
        """The components of the CAD with the colours of the part file."""
        return [
            component if component.name in ignored else self.part.model.component(component.name)
            for component in self.cad.components
        ]


def _free_path(cad: Path) -> Path:
    """Name of a new part file beside a CAD file that takes nothing's place."""
    for name in ("part.toml", f"{cad.stem}.toml"):
        if not (cad.parent / name).exists():
            return cad.parent / name
    raise InputError(f"{cad}: part.toml and {cad.stem}.toml exist beside it; open the part file instead")


def _one_of(change: Mapping[str, Any], key: str, allowed: tuple[str, ...]) -> str:
    value = change.get(key)
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{key}: expected one of {', '.join(allowed)}")
    return value


def _label(change: Mapping[str, Any]) -> str:
    label = change.get("label")
    if not isinstance(label, str) or not (len(label) == 1 and "A" <= label <= "Z"):
        raise InputError("label: expected a letter from A to Z")
    return label


def _tables(value: Any) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        raise InputError("value: expected a list of tables")
    return value


def _rounded(value: Any) -> Any:
    """Numbers as a person would write them: six decimals are nanometres."""
    if isinstance(value, float):
        return round(value, 6) + 0.0
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return {key: _rounded(one) for key, one in value.items()} if isinstance(value, dict) else value


def _direction_key(feature: str) -> str:
    return "normal" if feature in ("plane", "point") else "axis"


def _datum_row(datum: Datum) -> dict[str, Any]:
    return {
        "label": datum.label,
        "feature": datum.feature,
        "component": datum.component,
        "point_mm": list(datum.point_in_model),
        "direction": list(datum.direction_in_model),
        "diameter_mm": datum.diameter_mm,
        "locks": list(datum.locks),
    }


def _picked_row(component: str, picked: PickedFeature) -> dict[str, Any]:
    """A picked feature, with the table of the part file that makes it a datum."""
    table: dict[str, Plain] = {
        "feature": picked.feature,
        "component": component,
        "point_mm": [round(float(value), 6) + 0.0 for value in picked.point_in_model],
        _direction_key(picked.feature): [round(float(value), 9) + 0.0 for value in picked.direction_in_model],
    }
    if picked.diameter_mm is not None:
        table["width_mm" if picked.feature == "slot" else "diameter_mm"] = round(picked.diameter_mm, 6)
    return {"datum": table, "size_mm": picked.size_mm, "distance_mm": picked.distance_mm}


def _symmetry_row(symmetry: Symmetry) -> dict[str, Any]:
    return {
        "axis": list(symmetry.axis_in_model),
        "through_mm": list(symmetry.through_in_model),
        "order": symmetry.order or "continuous",
        "text": symmetry.describe(),
    }


def _found_row(found: FoundSymmetry, model: Model) -> dict[str, Any]:
    breaking = [
        component.name
        for component, share in zip(model.components, found.unmatched_of_group, strict=True)
        if share > 0.1
    ]
    return {**_symmetry_row(found.symmetry), "is_exact": found.is_exact, "broken_by": breaking}
