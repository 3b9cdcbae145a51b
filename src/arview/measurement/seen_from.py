"""From how many photos and directions a component was seen, and what follows for its measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from arview import reconstruction
from arview.cad import Model
from arview.inspection import ComponentDeviation, Details, Finding, ForeignReport, MeasuredPresence, Verdict
from arview.reconstruction import Consistency, SparseModel
from arview.reconstruction.coverage import coverage

HIDDEN_EDGES = 0.25
"""Share of the CAD's edges, beyond chance, below which most of the part is hidden."""
MOSTLY_HIDDEN = "nothing of it is seen, and as most of the part is hidden, whether it is missing cannot be told"
UNDER_FOREIGN = "a foreign object lies on its place, so what is seen there may be of that; take it away, measure again"
FOREIGN_MARGIN_MM = 4.0
"""Margin about a foreign object in which the middle of a component is covered: its cloud ends before its rim."""


@dataclass(frozen=True)
class SeenFrom:
    """Photos and directions from which each component is seen, and the options by which they are few."""

    components: Mapping[str, reconstruction.ComponentCoverage]


def seen_from(sparse: SparseModel, model: Model) -> SeenFrom:
    """What the photos show of each component; nothing without photos.

    Args:
        sparse: the photos, in the frame of the model.
        model: the nominal CAD.
    """
    if not sparse.photos:
        return SeenFrom({})
    found = coverage(model, [(photo.camera, photo.cam_from_scan) for photo in sparse.photos])
    return SeenFrom({one.name: one for one in found.components})


def with_seen_from(record: ComponentDeviation, seen: SeenFrom) -> ComponentDeviation:
    """The record with the number of photos that show the component, and why its U is wide if they are too few."""
    covered = seen.components.get(record.name)
    if covered is None or record.details is None:
        return record
    note = _few(covered, record.distance_mm is not None)
    notes = (*record.details.notes, *((note,) if note else ()))
    return replace(record, details=replace(record.details, photos=len(covered.photos), notes=notes))


def is_mostly_hidden(consistency: Consistency) -> bool:
    """Whether most of the CAD's edges are hidden in the photos, although what is seen of the part fits."""
    share, chance = consistency.edges_found, consistency.edges_by_chance
    if share is None or chance is None:
        return False
    return (share - chance) / (1.0 - min(chance, 0.95)) < HIDDEN_EDGES


def is_covered(center_mm: Sequence[float], foreign: Sequence[ForeignReport]) -> bool:
    """Whether one of the foreign objects lies on the place of a component, with its centre in the same frame."""
    return any(
        bool(np.all(np.abs(np.subtract(center_mm, one.center_mm)) < 0.5 * np.array(one.size_mm) + FOREIGN_MARGIN_MM))
        for one in foreign
    )


def with_covered(record: ComponentDeviation) -> ComponentDeviation:
    """The record of a component under a foreign object: what is not right there was measured on that object."""
    if record.verdict in (Verdict.PASS, Verdict.NOT_MEASURED) or record.details is None:
        return record
    old = record.details
    return ComponentDeviation(
        record.name,
        (None, None, None),
        None,
        (False,) * 6,
        None,
        record.tolerance_mm,
        Verdict.NOT_MEASURED,
        details=Details(old.center_mm, old.measurand, photos=old.photos, notes=(UNDER_FOREIGN, *old.notes)),
        presence=MeasuredPresence.NOT_SEEN,
    )


def with_hidden(record: ComponentDeviation, note: str) -> ComponentDeviation:
    """The record of a component that something hides: without a trace it is not seen, not missing.

    ``note`` says why.
    """
    if record.finding is not Finding.MISSING or record.details is None:
        return record
    details = replace(record.details, notes=(note, *record.details.notes))
    return replace(
        record, verdict=Verdict.NOT_MEASURED, finding=None, presence=MeasuredPresence.NOT_SEEN, details=details
    )


def _few(covered: reconstruction.ComponentCoverage, is_measured: bool) -> str:
    """Why the photos of a component are too few; empty if they are not."""
    photos = len(covered.photos)
    if photos == 0:
        return "no photo shows enough of it: other components hide it, or it is outside the pictures"
    if photos >= reconstruction.PHOTOS_WANTED and covered.directions >= reconstruction.DIRECTIONS_WANTED:
        return ""
    places = f"{covered.directions} direction{'s' * (covered.directions != 1)}"
    text = f"only {photos} photo{'s' * (photos != 1)} from {places} show{'s' * (photos == 1)} it"
    if photos > 1:
        text += f", at most {covered.spread_deg:.0f}° apart"
    wide = ", so its U is wide" if is_measured else ""
    return f"{text}{wide}; take more from other sides"
