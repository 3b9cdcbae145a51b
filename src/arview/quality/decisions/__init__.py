"""Decisions by people about an inspection: an append-only log, sign-off, and what they say of the part together."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.quality.decisions.attachments import attach_photo as attach_photo
    from arview.quality.decisions.attachments import attached_photos as attached_photos
    from arview.quality.decisions.attachments import is_attachment as is_attachment
    from arview.quality.decisions.entry import FIRST as FIRST
    from arview.quality.decisions.entry import Decision as Decision
    from arview.quality.decisions.entry import decision_document as decision_document
    from arview.quality.decisions.entry import line_of as line_of
    from arview.quality.decisions.entry import stamp as stamp
    from arview.quality.decisions.folder import decide_component as decide_component
    from arview.quality.decisions.folder import decisions_path as decisions_path
    from arview.quality.decisions.folder import first_inspection as first_inspection
    from arview.quality.decisions.folder import inspection_path as inspection_path
    from arview.quality.decisions.folder import log_of as log_of
    from arview.quality.decisions.folder import photo_path as photo_path
    from arview.quality.decisions.folder import rechecks_of as rechecks_of
    from arview.quality.decisions.folder import sign_inspection as sign_inspection
    from arview.quality.decisions.folder import state_of_record as state_of_record
    from arview.quality.decisions.folder import tick_step as tick_step
    from arview.quality.decisions.log import DecisionLog as DecisionLog
    from arview.quality.decisions.log import LogContent as LogContent
    from arview.quality.decisions.log import acting_device as acting_device
    from arview.quality.decisions.record import Recheck as Recheck
    from arview.quality.decisions.record import RecordState as RecordState
    from arview.quality.decisions.record import Signature as Signature
    from arview.quality.decisions.record import record_state as record_state
    from arview.quality.decisions.record import state_document as state_document
    from arview.quality.decisions.table import decided_cells as decided_cells
    from arview.quality.decisions.table import decision_word as decision_word
    from arview.quality.decisions.table import decisions_csv as decisions_csv

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "attachments": (
            "attach_photo",
            "attached_photos",
            "is_attachment",
        ),
        "entry": (
            "Decision",
            "FIRST",
            "decision_document",
            "line_of",
            "stamp",
        ),
        "folder": (
            "decide_component",
            "decisions_path",
            "first_inspection",
            "inspection_path",
            "log_of",
            "photo_path",
            "rechecks_of",
            "sign_inspection",
            "state_of_record",
            "tick_step",
        ),
        "log": (
            "DecisionLog",
            "LogContent",
            "acting_device",
        ),
        "record": (
            "Recheck",
            "RecordState",
            "Signature",
            "record_state",
            "state_document",
        ),
        "table": (
            "decided_cells",
            "decision_word",
            "decisions_csv",
        ),
    },
)
