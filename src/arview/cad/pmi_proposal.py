"""A part file proposed from the PMI of a STEP file: datums, features, characteristics, and what it cannot express."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

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
    "L": "least material, which a part file does not have",
    "theoretical": "it is theoretically exact, so without limits",
    "auxiliary": "it is for information only",
    "Tangent_Plane": "it is of the tangent plane",
}
"""What modifiers mean that a characteristic cannot express; others are named as OpenCASCADE calls them."""
EXPRESSED = ("M", "All_Around", "Free_State", "EnvelopeRequirement")
"""Modifiers that a characteristic expresses, that only tell faces, or that hold for a part as a photo shows it."""
MAXIMUM_MATERIAL = "MaximumMaterialRequirement"
AREAS = ("circle", "rectangle", "area")
"""Datum targets that are areas."""
NO_PMI = "none. Export AP242 with semantic PMI, or write the part file by hand."

Row = dict[str, Any]


def propose_part(part: Part) -> str:
    """A part file (TOML) with what the PMI of the part's STEP file requires.

    Comments at its beginning say what was found, and each requirement that is not proposed, with the reason.

    Args:
        part: of a part file or CAD file, in the unit of the CAD file.

    Raises:
        InputError: the CAD file is no STEP file; and as `read_pmi`.
        MissingDependencyError: without OCP.
    """
    pmi = read_pmi(part.cad_path)
    proposal = _Proposal(part, pmi)
    rows = [row for requirement in (*pmi.dimensions, *pmi.tolerances) for row in proposal.rows(requirement)]
    datums = [one for found in proposal.datums.values() if not isinstance(found, str) for one in found]
    used = {name for row in rows for name in ([row["of"]] if isinstance(row["of"], str) else row["of"])}
    names = [settings.name for settings in part.settings]
    bases = [name for name in names if len(names) == 1 or name in {one.component for one in datums}]
    lines = [f"# {line}" for line in (*_summary(pmi, part.cad_path.name, len(rows)), *proposal.remarks)]
    lines += ["", *_table("[part]", {"name": part.name, "cad": part.cad_path.name})]
    for name in bases:
        lines += _table(f"[components.{_key(name)}]", {"role": "base"})
    for feature in dict.fromkeys((*datums, *(one for one in proposal.features.found if one.label in used))):
        lines += _table(
            f"[{'datums' if feature in datums else 'features'}.{_key(feature.label)}]", _feature_row(feature)
        )
    for row in rows:
        lines += _table("[[characteristics]]", row)
    return "\n".join(lines)


class _Proposal:
    """Datums, features and characteristics of one part; ``remarks`` say what was left out, and why.

    ``datums`` has the features of each datum by its letter and the place of its part, or why it has none.
    """

    def __init__(self, part: Part, pmi: Pmi) -> None:
        self.file = part.cad_path.name
        self.pmi = pmi
        self.features = PmiFeatures(part)
        self.datums: dict[tuple[str, int], list[Datum] | str] = {}
        self.remarks: list[str] = []
        self._sizes: set[str] = set()
        self._frames: set[tuple[object, ...]] = set()
        self._names: Counter[str] = Counter()
        # The frame with most datums tells their order of precedence.
        for tolerance in sorted(pmi.tolerances, key=lambda one: (one.place, -len(one.datums))):
            for letter, _, _ in tolerance.datums:
                if (letter, tolerance.place) not in self.datums:
                    self.datums[letter, tolerance.place] = self._datum(letter, tolerance.place)

    def rows(self, requirement: PmiRequirement) -> list[Row]:
        """Tables [[characteristics]] of a dimension or tolerance; none and a remark where it cannot be expressed."""
        name = f"{_line(requirement.name)} ({requirement.kind} {requirement.value_mm or 0.0:g})"
        try:
            return list(self._rows(requirement, f"PMI of {_line(self.file)}: {name}"))
        except InputError as error:
            self.remarks.append(f"left out: {name}: {error}")
            return []

    def _rows(self, requirement: PmiRequirement, source: str) -> Iterator[Row]:
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
            self.remarks.append(
                f"left out: {curved} curved faces of {_line(requirement.name)}; a profile is of flat ones"
            )
        low, high = requirement.limits_mm or (None, None)
        own = {"min_mm": low, "max_mm": high} if kind in WITH_LIMITS else {"tolerance_mm": requirement.value_mm}
        # The profile of one flat face without datums is its flatness.
        own |= {"datums": frame} if frame else {} if kind in WITH_LIMITS else {"kind": "flatness"}
        own |= {"at_maximum_material": True} if "M" in requirement.modifiers else {}
        for group in [[*features, *others]] if kind in ("position", "distance") else [[one] for one in features]:
            labels = [feature.label for feature in group]
            self._sizes |= set(labels) if kind == "size" else set()
            text = f"{kind} of {' and '.join(labels[:2])}" + (f" and {len(labels) - 2} more" if labels[2:] else "")
            self._names[text] += 1
            name = f"{text} ({self._names[text]})" if self._names[text] > 1 else text
            of = labels if len(labels) > 1 else labels[0]
            yield {"name": name, "kind": kind, "of": of} | own | {"source": source}

    def _problem(
        self,
        kind: str,
        requirement: PmiRequirement,
        features: Sequence[Datum],
        others: Sequence[Datum],
        frame: Sequence[str],
    ) -> str:
        """Why a characteristic of a part file cannot express a requirement; empty where it can."""
        low, high = requirement.limits_mm or (0.0, 0.0)
        flat = [one for one in features if one.feature == "plane"]
        is_round = all(one.feature in ROUND for one in features)
        is_whole = kind == "profile" and not frame
        is_located = kind not in (*WITH_LIMITS, "profile", "flatness")
        datums = [label.removesuffix(MAXIMUM_MARK) for label in frame]
        sized = [label.removesuffix(MAXIMUM_MARK) for label in frame if label.endswith(MAXIMUM_MARK)]
        sized += [one.label for one in features if "M" in requirement.modifiers]
        problems = {
            "it is linked to no face that a characteristic can be about": not features,
            "it has no limits, or signs that are not clear": kind in WITH_LIMITS and low >= high,
            "a size is of round faces": kind == "size" and not is_round,
            f"it is between {len(features)} and {len(others)} features, and a distance is of two": (
                kind == "distance" and [len(features), len(others)] != [1, 1]
            ),
            "its faces are not parallel": kind == "distance" and not _are_parallel([*flat, *others]),
            "its zone is 0": kind not in WITH_LIMITS and not requirement.value_mm,
            "it is of flat faces only in a part file": kind == "flatness" and len(flat) < len(features),
            "without datums it is one zone for all its faces": is_whole
            and len({*requirement.shapes}) > 1 < len(features),
            "without datums its curved faces are of the same zone": is_whole and len(flat) < len(requirement.shapes),
            "it is of the middle plane of faces, which is no feature of a part file": is_located and len(flat) > 1,
            "its zone is between planes whose direction is not said": (
                is_located and not flat and not (is_round and requirement.zone == "Diameter")
            ),
            "it names no datum, and in a part file it would refer to all": is_located and not frame,
            "it is of a common datum of several features": (
                len({order for _, order, _ in requirement.datums}) < len(requirement.datums)
            ),
            "it is of its own datum": any(one.label in datums for one in features),
            f"maximum material without limits of the size of {' and '.join(sized[:2])}": not self._sizes >= {*sized},
            "it is a further frame of these faces, as the lower one of a composite tolerance": (
                (kind, requirement.shapes, requirement.modifiers) in self._frames and kind not in WITH_LIMITS
            ),
        }
        return next((text for text, is_so in problems.items() if is_so), "")

    def _frame(self, requirement: PmiRequirement) -> list[str]:
        """Labels of the datums of a tolerance, in order of precedence, with the mark of maximum material."""
        frame: list[str] = []
        for letter, _, words in requirement.datums:
            found = self.datums[letter, requirement.place]
            others = [word for word in words if word != MAXIMUM_MATERIAL]
            if isinstance(found, str) or others:
                raise InputError(f"datum {letter}: {found if isinstance(found, str) else ', '.join(others)}")
            frame += [feature.label + (MAXIMUM_MARK if words else "") for feature in found]
        return frame

    def _datum(self, letter: str, place: int) -> list[Datum] | str:
        """The feature of a datum, or those of its targets; or why there is none."""
        targets = {name: one for name, one in self.pmi.targets.items() if name.rstrip("0123456789") == letter}
        kinds, places = {target.kind for target in targets.values()}, self.pmi.datums.get(letter, ())
        is_plane = len(targets) == 1 and kinds <= set(AREAS)
        if not kinds <= {"point", *AREAS}:
            return f"its targets are of the kind {' and '.join(sorted(kinds))}, and a part file has points"
        suffix = f"_{place + 1}" if place else ""
        try:
            found = [self.features.at(target, name + suffix, is_plane) for name, target in targets.items()]
            found = found or self.features.of(places[place] if place < len(places) else (), letter + suffix)
        except InputError as error:
            return str(error)
        if kinds - {"point"}:
            self.remarks.append(
                f"datum {letter}: {'its plane' if is_plane else 'the middle of each'} stands for target areas"
            )
        if targets or len(found) == 1:
            return found
        what = "the middle plane of faces" if {one.feature for one in found} == {"plane"} else f"{len(found)} features"
        return f"it is {what}, and a part file has one face" if found else "it is linked to no face"


def _summary(pmi: Pmi, file: str, count: int) -> list[str]:
    """What a file holds, in a few lines."""
    dimensions, tolerances, references = pmi.counts
    meant = sum(one.place == 0 for one in pmi.dimensions)
    if meant or tolerances:
        return [
            f"PMI of {file}: {dimensions} dimensions ({dimensions - meant} of them only drawn), {tolerances} geometric "
            f"tolerances, {references} references to datums",
            f"{count} characteristics are proposed; check them against the drawing.",
        ]
    drawn = f"only drawn, {pmi.drawn_count or dimensions} annotations that people can read; export semantic PMI (AP242)"
    return [f"PMI of {file}: {drawn if pmi.drawn_count or dimensions else NO_PMI}"]


def _are_parallel(features: Sequence[Datum]) -> bool:
    """Whether the faces among two features have one normal; True where these are no two faces."""
    normals = np.array([one.direction_in_model for one in features if one.feature == "plane"])
    return len(normals) < 2 or float(np.linalg.norm(np.cross(normals[0], normals[1]))) < 1e-2


def _feature_row(feature: Datum) -> Row:
    row: Row = {"feature": feature.feature, "component": feature.component, "point_mm": list(feature.point_in_model)}
    row["normal" if feature.feature in ("plane", "point") else "axis"] = list(feature.direction_in_model)
    return row | ({} if feature.diameter_mm is None else {"diameter_mm": feature.diameter_mm})


def _table(head: str, row: Row) -> list[str]:
    """A table of TOML, of which JSON is a part for texts, numbers, truth and lists of them."""
    return [head, *(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in row.items()), ""]


def _key(name: str) -> str:
    """A name as a key of TOML, in quotes where it has other letters than those of a plain key."""
    is_plain = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if is_plain else json.dumps(name, ensure_ascii=False)


def _line(text: str) -> str:
    """A text in one line without control characters."""
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()
