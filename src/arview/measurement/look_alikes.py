"""Components that change places where a symmetric part fits a cloud in several ways, so that none has a sure name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arview.cad import Model, Part, find_symmetries
from arview.geometry import Array, exp_so3
from arview.inspection import ComponentDeviation, Finding, Verdict
from arview.measurement.seen_from import with_hidden

MAX_UNMATCHED = 1e-3
"""Share of the surface, of the part and of each component, that a symmetry may move off it."""
SAME_PLACE = 0.01
"""Distance of the centres of two components that change places, over the diameter of the part."""
MAX_WAYS = 60
"""Largest number of rotations of a body that is not round."""


def with_unsure_names(records: Sequence[ComponentDeviation], part: Part) -> tuple[list[ComponentDeviation], list[str]]:
    """The records of a part that was found by the shape of a cloud alone, and warnings about its symmetries.

    Where components change places in a rotation that fits as well, and their verdicts differ, which of them it is stays
    undecided. Where all have the same verdict, it holds whichever is which. Symmetries that the part file declares do
    not matter, and are not told.
    """
    turns = _rotations(part)
    center_of = {c.name: c.bounds_in_model.mean(axis=0) for c in part.model.components}
    near_mm = SAME_PLACE * part.model.diameter_mm
    groups: dict[str, set[str]] = {}
    for name, center in center_of.items():
        images = [turn[:3, :3] @ center + turn[:3, 3] for turn in turns]
        groups[name] = {
            other for other, at in center_of.items() if any(np.linalg.norm(at - one) < near_mm for one in images)
        }
    moving = sorted({", ".join(sorted(group)) for group in groups.values() if len(group) > 1})
    if not moving:
        return list(records), []
    failing = sum(record.verdict is Verdict.FAIL and len(groups[record.name]) > 1 for record in records)
    warnings = [
        f"the cloud fits the CAD in {len(turns)} ways alike, in which components change places ({'; '.join(moving)};"
        f" {failing or 'none'} of them beyond tolerance): their names are not known by its shape; if they"
        " do not matter, declare the rotation as [[symmetry]]"
    ]
    found = []
    for record in records:
        alike = [one for one in records if one.name in groups[record.name]]
        kinds = {(one.verdict, one.finding) for one in alike}
        if len(kinds) > 1:
            record = _unsure(
                record,
                f"it may be any of {', '.join(one.name for one in alike)}: the part fits in {len(turns)} ways alike",
            )
        found.append(record)
    return found, warnings


def _unsure(record: ComponentDeviation, note: str) -> ComponentDeviation:
    """The record without a verdict on its name; a missing one is not seen, because another may be missing."""
    if record.finding is Finding.MISSING:
        return with_hidden(record, note)
    details = record.details and replace(record.details, notes=(note, *record.details.notes))
    is_decided = record.verdict in (Verdict.PASS, Verdict.FAIL)
    return replace(record, verdict=Verdict.UNDECIDED if is_decided else record.verdict, details=details)


def _rotations(part: Part) -> list[Array]:
    """All rotations (4,4) that map a part onto itself and are not declared, the identity first."""
    model: Model = part.model
    vertices, faces, groups = model.mesh
    found = find_symmetries(vertices, faces.astype(np.int64), groups.astype(np.int64), near_share=0.0)
    centers = np.array([component.bounds_in_model.mean(axis=0) for component in model.components])
    steps = []
    for one in found:
        rotation, order = one.symmetry, one.symmetry.order
        worst = max(one.unmatched_share, float(np.max(one.unmatched_of_group, initial=0.0)))
        declared = [other for other in part.symmetries if other.is_same_axis(rotation)]
        if order is None or not one.is_exact or worst > MAX_UNMATCHED:
            continue
        if any(other.order is None or other.order % order == 0 for other in declared):
            continue
        turn, through = np.eye(4), np.array(rotation.through_in_model)
        turn[:3, :3] = exp_so3(2.0 * np.pi / order * np.array(rotation.axis_in_model))
        turn[:3, 3] = through - turn[:3, :3] @ through
        images = centers @ turn[:3, :3].T + turn[:3, 3]
        apart = np.linalg.norm(images[:, None] - centers[None], axis=2).min(axis=1)
        if apart.max() < SAME_PLACE * model.diameter_mm:  # a small component without its like settles it
            steps.append(turn)
    turns = [np.eye(4)]
    for turn in turns:  # the list grows while it is read, until every product is in it
        for step in steps:
            product = step @ turn
            if len(turns) < MAX_WAYS and all(np.abs(product - other)[:3, :3].max() > 1e-3 for other in turns):
                turns.append(product)
    return turns
