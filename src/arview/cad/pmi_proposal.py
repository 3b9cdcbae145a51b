"""A part file proposed from the PMI of a STEP file: datums, features, characteristics, and what it cannot express."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

from arview.cad.characteristics_table import MAXIMUM_MARK, ROUND, WITH_LIMITS
from arview.cad.formats.pmi import Pmi, PmiRequirement, read_pmi
from arview.cad.part import Datum, Part
from arview.cad.pmi_features import PmiFeatures
from arview.errors import InputError

KINDS = {
    "Position": "position",
    "ProfileOfSurface": "profile",
    "Flatness": "flatness",
    "Perpendicularity": "perpendicularity",
    "Parallelism": "parallelism",
    "Angularity": "angularity",
    "Size_Diameter": "size",
    "Location_LinearDistance": "distance",
}
"""Kinds of characteristics by the names of OpenCASCADE."""
MODIFIERS = {
    "theoretical": "it is theoretically exact, so without limits",
    "auxiliary": "it is for information only",
    "Tangent_Plane": "it is of the tangent plane",
}
"""What modifiers mean that a characteristic cannot express; others are named as OpenCASCADE calls them."""
EXPRESSED = ("M", "L", "All_Around", "Free_State", "EnvelopeRequirement")
"""Modifiers that a characteristic expresses, that only tell faces, or that hold for a part as a photo shows it."""


def propose_part(part: Part) -> str:
    """A part file (TOML) with what the PMI of the part's STEP file requires.

    Comments at its beginning say what was found, and each requirement that is not proposed, with the reason.

    Args:
        part: of a part file or CAD file, in the unit of the CAD file.

    Raises:
        InputError: the CAD file is no STEP file; and as `read_pmi`.
        MissingDependencyError: without OCP.
    """
    pmi, names = read_pmi(part.cad_path), [settings.name for settings in part.settings]
    proposal = _Proposal(part, pmi)
    rows = [row for requirement in (*pmi.dimensions, *pmi.tolerances) for row in proposal.rows(requirement)]
    datums = [one for found in proposal.datums.values() if not isinstance(found, str) for one in found]
    used = {name for row in rows for name in ([row["of"]] if isinstance(row["of"], str) else row["of"])}
    features = [replace(one, label=label) for one, label in proposal.features.labels.items() if label in used]
    tables: list[tuple[str, dict[str, Any]]] = [
        ("[part]", {"name": part.name, "cad": part.cad_path.name}),
        *(
            (f"[components.{_key(name)}]", {"role": "base"})
            for name in names
            if len(names) == 1 or name in {one.component for one in datums}
        ),
        *((f"[datums.{_key(one.label)}]", _feature_row(one)) for one in datums),
        *((f"[features.{_key(one.label)}]", _feature_row(one)) for one in features if one not in datums),
        *(("[[characteristics]]", row) for row in rows),
    ]
    lines = [f"# {text}" for text in (*_summary(pmi, part.cad_path.name, len(rows)), *proposal.remarks)]
    return "\n".join([*lines, *(_table(head, row) for head, row in tables), ""])


class _Proposal:
    """Datums, features and characteristics of one part; ``remarks`` say what was left out, and why.

    ``datums`` has the features of each datum by its name, or why it has none.
    """

    def __init__(self, part: Part, pmi: Pmi) -> None:
        self.file, self.pmi = part.cad_path.name, pmi
        self.features = PmiFeatures(part)
        self.remarks: list[str] = []
        self._sizes: set[str] = set()
        self._frames: set[tuple[object, ...]] = set()
        self._numbers = count(1)
        # The frame with most datums tells their order of precedence.
        frames = sorted((one.datums for one in pmi.tolerances), key=len, reverse=True)
        self.datums = {name: self._datum(name) for name in dict.fromkeys(datum[0] for one in frames for datum in one)}

    def rows(self, requirement: PmiRequirement) -> list[dict[str, Any]]:
        """Tables [[characteristics]] of a dimension or tolerance; none and a remark where it cannot be expressed."""
        words = " ".join([requirement.kind, f"{requirement.value_mm or 0.0:g}", *requirement.modifiers])
        try:
            return list(self._rows(requirement, f"{requirement.name} ({words})"))
        except InputError as error:
            self.remarks.append(f"left out: {requirement.name} ({words}): {error}")
            return []

    def _rows(self, requirement: PmiRequirement, name: str) -> Iterator[dict[str, Any]]:
        kind = KINDS.get(requirement.kind, "")
        words = [MODIFIERS.get(word, word) for word in requirement.modifiers if word not in EXPRESSED]
        if not kind or words:
            raise InputError(", ".join(words) or "a part file has no such characteristic")
        shapes = [shape for shape in requirement.shapes if kind != "profile" or shape.kind == "plane"]
        features, others = self.features.of(shapes), self.features.of(requirement.others)
        frame = self._frame(requirement)
        if problem := self._problem(kind, requirement, features, others, frame):
            raise InputError(problem)
        self._frames.add((kind, requirement.shapes, requirement.modifiers))
        if curved := len(requirement.shapes) - len(shapes):
            self.remarks.append(f"left out: {curved} curved faces of {name}: a profile is of flat faces in a part file")
        own = {
            **dict(zip(("min_mm", "max_mm"), requirement.limits_mm or (), strict=False)),
            **({} if kind in WITH_LIMITS else {"tolerance_mm": requirement.value_mm}),
            **({"datums": frame} if frame else {}),
            **({"at_maximum_material": True} if "M" in requirement.modifiers else {}),
            **({"at_least_material": True} if "L" in requirement.modifiers else {}),
        }
        # The profile of one flat face without datums is its flatness.
        kind = "flatness" if kind == "profile" and not frame else kind
        for group in [[*features, *others]] if kind in ("position", "distance") else [[one] for one in features]:
            of = [feature.label for feature in group]
            self._sizes |= set(of) if kind == "size" else set()
            text = f"{kind} of {' and '.join(of[:2])}" + (f" and {len(of) - 2} more" if of[2:] else "")
            yield {
                "name": f"{next(self._numbers)} {text}",
                "kind": kind,
                "of": of if of[1:] else of[0],
                **own,
                "source": f"PMI of {self.file}: {name}",
            }

    def _problem(
        self,
        kind: str,
        requirement: PmiRequirement,
        features: Sequence[Datum],
        others: Sequence[Datum],
        frame: Sequence[str],
    ) -> str:
        """Why a characteristic of a part file cannot express a requirement; empty where it can."""
        flat_count = sum(one.feature == "plane" for one in features)
        is_round = all(one.feature in ROUND for one in features)
        is_whole, is_located = kind == "profile" and not frame, kind not in (*WITH_LIMITS, "profile", "flatness")
        datums = [label.removesuffix(MAXIMUM_MARK) for label in frame]
        sized = [
            *(label for label in datums if f"{label}{MAXIMUM_MARK}" in frame),
            *(one.label for one in features if {"M", "L"} & set(requirement.modifiers)),
        ]
        problems = {
            "it is linked to no face that such a characteristic can be about": not features,
            "it has no limits, or signs that are not clear": (
                kind in WITH_LIMITS
                and not (requirement.limits_mm and requirement.limits_mm[0] < requirement.limits_mm[1])
            ),
            "a size is of round faces": kind == "size" and not is_round,
            f"it is between {len(features)} and {len(others)} features, and a distance is of two": (
                kind == "distance" and [len(features), len(others)] != [1, 1]
            ),
            "its zone is 0": kind not in WITH_LIMITS and not requirement.value_mm,
            "it is of flat faces only in a part file": kind == "flatness" and flat_count < len(features),
            "without datums it is one zone for all its faces": (
                is_whole and (len(features) > 1 or any(shape.kind != "plane" for shape in requirement.shapes))
            ),
            "it is of the middle plane of faces, which is no feature of a part file": is_located and flat_count > 1,
            "its zone is between planes whose direction is not said": (
                is_located and not flat_count and not (is_round and requirement.zone == "Diameter")
            ),
            "a flat face has a zone between planes": bool(flat_count) and requirement.zone != "None",
            "it names no datum, and in a part file it would refer to all": is_located and not frame,
            "it is of a common datum of several features": (
                len({order for _, order, _ in requirement.datums}) < len(requirement.datums)
            ),
            "it is of its own datum": any(one.label in datums for one in features),
            f"maximum or least material without limits of the size of {' and '.join(sized[:2])}": not self._sizes
            >= {*sized},
            "it is a further frame of these faces, as the lower one of a composite tolerance": (
                (kind, requirement.shapes, requirement.modifiers) in self._frames and kind not in WITH_LIMITS
            ),
        }
        return next((text for text, is_so in problems.items() if is_so), "")

    def _frame(self, requirement: PmiRequirement) -> list[str]:
        """Labels of the datums of a tolerance, in order of precedence, with the mark of maximum material."""
        frame: list[str] = []
        for name, _, words in requirement.datums:
            found = self.datums[name]
            if isinstance(found, str) or not set(words) <= {"MaximumMaterialRequirement"}:
                raise InputError(f"datum {name}: {found if isinstance(found, str) else ', '.join(words)}")
            frame += [feature.label + (MAXIMUM_MARK if words else "") for feature in found]
        return frame

    def _datum(self, name: str) -> list[Datum] | str:
        """The feature of a datum, or those of its targets; or why there is none."""
        targets = {key: one for key, one in self.pmi.targets.items() if key.rstrip("0123456789") == name}
        kinds = {target.kind for target in targets.values()}
        is_plane = len(targets) == 1 and kinds != {"point"}
        try:
            found = [self.features.at(target, is_plane) for target in targets.values()]
            found = found or self.features.of(self.pmi.datums[name])
        except InputError as error:
            return str(error)
        if len(found) != max(1, len(targets)):
            return f"it is {len(found)} features, as a pattern or the middle plane of faces, and a part file has one"
        if kinds - {"point"}:
            self.remarks.append(f"datum {name}: {'a plane' if is_plane else 'a point'} stands for each target area")
        return [self.features.labelled(*pair) for pair in zip(found, targets or [name], strict=True)]


def _summary(pmi: Pmi, file: str, row_count: int) -> list[str]:
    """What a file holds, in a few lines."""
    dimensions, tolerances, references = pmi.counts
    if pmi.dimensions or tolerances:
        return [
            f"PMI of {file}: {dimensions} dimensions ({pmi.drawn_dimensions} of them only drawn), "
            f"{tolerances} geometric tolerances, {references} references to datums",
            f"{row_count} characteristics are proposed; check them against the drawing",
        ]
    drawn = pmi.drawn_count or dimensions
    lack = f"only drawn, {drawn} annotations for people to read" if drawn else "none"
    return [f"PMI of {file}: {lack}; export AP242 with semantic PMI, or write the part file by hand"]


def _table(head: str, row: dict[str, Any]) -> str:
    """A table of TOML, of which JSON is a part for texts, numbers, truth and lists of them."""
    return "\n".join(["", head, *(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in row.items())])


def _feature_row(feature: Datum) -> dict[str, Any]:
    return {
        "feature": feature.feature,
        "component": feature.component,
        "point_mm": feature.point_in_model,
        "normal" if feature.feature in ("plane", "point") else "axis": feature.direction_in_model,
        **({"diameter_mm": feature.diameter_mm} if feature.diameter_mm else {}),
    }


def _key(name: str) -> str:
    """A name as a key of TOML, in quotes where it has other letters than those of a plain key."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
