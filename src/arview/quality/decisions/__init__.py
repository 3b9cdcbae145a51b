"""Decisions by people about an inspection: an append-only log, sign-off, and what they say of the part together."""

from arview.quality.decisions.attachments import attach_photo, attached_photos, is_attachment
from arview.quality.decisions.entry import Decision, decision_document
from arview.quality.decisions.folder import (
    decide_component,
    decisions_path,
    log_of,
    sign_inspection,
    state_of_record,
    tick_step,
)
from arview.quality.decisions.log import DecisionLog
from arview.quality.decisions.record import RecordState, Signature, record_state, state_document
from arview.quality.decisions.table import decisions_csv

__all__ = [
    "Decision",
    "DecisionLog",
    "RecordState",
    "Signature",
    "attach_photo",
    "attached_photos",
    "decide_component",
    "decision_document",
    "decisions_csv",
    "decisions_path",
    "is_attachment",
    "log_of",
    "record_state",
    "sign_inspection",
    "state_document",
    "state_of_record",
    "tick_step",
]
