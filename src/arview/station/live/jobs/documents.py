"""What pages are told of jobs: rows of the list, and one job with all that is known of it."""

from __future__ import annotations

import logging
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from arview import overlay
from arview.core.messages import with_messages
from arview.errors import ArviewError
from arview.inspection import Inspection, Verdict, overall_verdict, verdict_sentence
from arview.quality import decisions
from arview.quality.rework import instruction_document, make_instructions
from arview.station import walk
from arview.station.live.jobs.board import JobBoard
from arview.station.live.jobs.desk import JobDesk
from arview.station.live.jobs.subject import is_open
from arview.station.live.stream.documents import Document
from arview.station.walk.merged import merged

logger = logging.getLogger("arview.station.live")


def job_row(job: walk.JobFolder, board: JobBoard, part: int | None) -> Document:
    """A job in the list."""
    state, photos = job.state(), job.photos()
    verdict = state.verdict
    if verdict is None and not is_open(state) and (inspection := board.inspection(job)) is not None:
        verdict = str(overall_verdict(inspection))
    return {
        "id": job.id,
        "part": part,
        "part_name": job.document["part_name"],
        "serial": job.serial,
        "created": job.document["created"],
        "stage": state.stage,
        "verdict": verdict,
        "photos": len(photos),
        "parent": None if job.parent is None else job.parent.id,
        "is_ended": job.is_ended,
    }


def job_document(job: walk.JobFolder, desk: JobDesk) -> Document:
    """A job with its state, photos, numbers, instructions and decisions."""
    board, number, ended = desk.board, desk.part_of(job), job.ended
    inspection = board.inspection(job)
    document = {
        key: value for key, value in job.document.items() if key not in ("format", "version", "part", "frozen_part")
    }
    told: Document = {
        **document,
        "id": job.id,
        "part": number,
        "state": job.state().document(),
        "is_ended": job.is_ended,
        "photos": [photo.name for photo in job.photos()],
        "attachments": decisions.attached_photos((job.parent or job).path),
        "uploads": [
            {"upload": one.name, "bytes": one.bytes, "offset": one.offset} for one in board.uploads(job).listed()
        ],
        "worker": desk.workers.state(job.id),
        "measuring_s": None if ended is None else (datetime.now(UTC) - ended).total_seconds(),
        "expected_s": board.expected_s(job),
        "faults": list(job.faults()),
        "inspection": None if inspection is None else inspection_document(inspection),
        "rework": rework(job, desk),
        **_decisions(job, inspection),
        "rechecks": [one.id for one in job.rechecks()],
        "before_after": _before_after(job),
    }
    return with_messages(told)


def rework(job: walk.JobFolder, desk: JobDesk) -> list[Document]:
    """Instructions for the components that are out of tolerance; of a measured job whose part is shown here."""
    part, inspection = desk.part(job), desk.board.inspection(job)
    if part is None or inspection is None or is_open(job.state()):
        return []
    try:
        return [instruction_document(one) for one in make_instructions(part, inspection)]
    except ArviewError as error:
        logger.warning("%s: %s", job.id, error)
        return []


def inspection_document(inspection: Inspection) -> Document:
    """What was measured, in the words of the labels."""
    return {
        "created": inspection.created.isoformat().replace("+00:00", "Z"),
        "verdict": str(overall_verdict(inspection)),
        "sentence": verdict_sentence(inspection),
        "note": inspection.provenance.note,
        "components": [
            {
                "name": one.name,
                "verdict": str(one.verdict),
                "value_text": overlay.value_text(one),
                "detail_text": overlay.detail_text(one),
                "distance_mm": one.distance_mm,
                "uncertainty_mm": one.uncertainty_mm,
                "tolerance_mm": one.tolerance_mm,
                "displacement_mm": one.displacement_mm,
                "tilt_deg": one.tilt_deg,
                "twist_deg": one.twist_deg,
            }
            for one in inspection.components
        ],
    }


def _decisions(job: walk.JobFolder, inspection: Inspection | None) -> Document:
    """The log of decisions, and what people decided together."""
    entries = decisions.log_of(job.path).content().entries
    record: dict[str, Any] | None = None
    if inspection is not None and (job.path / "inspection.json").is_file():
        try:
            record = decisions.state_document(decisions.state_of_record(job.path))
        except ArviewError as error:
            record = {"sentence": str(error), "is_released": False, "signature": None, "faults": [str(error)]}
    signature = None if record is None else record["signature"]
    return {
        "decisions": [decisions.decision_document(one) for one in entries],
        "signed": signature if signature is not None and not signature["void"] else None,
        "record": record,
    }


def _before_after(job: walk.JobFolder) -> list[Document]:
    """Components of a re-check before it and now; empty for a first measurement."""
    if job.components is None:
        return []
    try:
        rows = [asdict(one) for one in walk.before_after(job)]
        known = merged(job) if not rows else None
    except ArviewError as error:
        logger.warning("%s: %s", job.id, error)
        return []
    if known is None:
        return rows
    before = [one for name in job.components if (one := known.inspection.find(name)) is not None]
    return [
        asdict(walk.BeforeAfter(one.name, one.distance_mm, None, one.verdict, Verdict.NOT_MEASURED)) for one in before
    ]
