"""What is known of a specimen now: the first measurement, and what was checked again since."""

from __future__ import annotations

from dataclasses import dataclass, replace

from arview.cad import Model
from arview.core.messages import joined, sentence
from arview.inspection import ComponentDeviation, Inspection, Verdict
from arview.station.walk.job import JobFolder


@dataclass(frozen=True)
class BeforeAfter:
    """A component before and after it was put right; distances in mm, None where there is none."""

    name: str
    before_mm: float | None
    after_mm: float | None
    verdict_before: Verdict
    verdict_after: Verdict


@dataclass(frozen=True)
class MergedInspection:
    """The newest value of each component.

    Attributes:
        inspection: the first measurement with the components that were checked again in their place.
        origins: for each component the id of the job that measured it.
    """

    inspection: Inspection
    origins: dict[str, str]


def before_after(recheck: JobFolder, model: Model | None = None) -> tuple[BeforeAfter, ...]:
    """The components of a re-check beside their values before it; empty while it is not measured.

    Raises:
        InputError, MismatchError: an inspection is damaged, or belongs to another model.
    """
    parent = recheck.parent
    after = recheck.inspection(model)
    if parent is None or after is None:
        return ()
    earlier = [one for one in parent.rechecks() if one.path.name < recheck.path.name]
    before = {one.name: one for one in _merged(parent, earlier, model).inspection.components}
    return tuple(
        BeforeAfter(one.name, before[one.name].distance_mm, one.distance_mm, before[one.name].verdict, one.verdict)
        for one in after.components
        if one.name in (recheck.components or ()) and one.name in before
    )


def merged(job: JobFolder, model: Model | None = None) -> MergedInspection | None:
    """The newest value of each component of a job; None while the first measurement is not finished.

    Raises:
        InputError, MismatchError: an inspection is damaged, or belongs to another model.
    """
    first = job.parent or job
    return _merged(first, first.rechecks(), model) if first.inspection(model) is not None else None


def _merged(first: JobFolder, rechecks: list[JobFolder], model: Model | None) -> MergedInspection:
    inspection = first.inspection(model)
    assert inspection is not None
    newest: dict[str, ComponentDeviation] = {one.name: one for one in inspection.components}
    origins = dict.fromkeys(newest, first.id)
    notes = []
    for recheck in rechecks:
        found = recheck.inspection(model)
        if found is None or recheck.state().stage != "done":
            continue
        for one in found.components:
            if one.name in (recheck.components or ()) and one.name in newest:
                newest[one.name], origins[one.name] = one, recheck.id
        notes.append(
            sentence(
                "walk.checked_again",
                names=", ".join(recheck.components or ()),
                time=f"{found.created:%Y-%m-%d %H:%M} UTC",
            )
        )
    components = tuple(newest[one.name] for one in inspection.components)
    note = joined([inspection.provenance.note, *notes])
    checked = {name for name, origin in origins.items() if origin != first.id}
    characteristics = tuple(
        replace(one, value_mm=None, uncertainty_mm=None, verdict=Verdict.NOT_MEASURED, reason=sentence("walk.stale"))
        if checked & set(one.components)
        else one
        for one in inspection.characteristics
    )
    whole = replace(
        inspection,
        components=components,
        characteristics=characteristics,
        provenance=replace(inspection.provenance, note=note),
    )
    return MergedInspection(whole, origins)
