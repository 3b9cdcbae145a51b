"""Phrases: the sentences that pages in other languages say in their own words, and how they are found in a text.

Tracking, drawing, inspection and worker say what they have to say in English, for files, terminals and pages alike. Of
what goes to a page, the sentences listed here are recognised, and their key and values are sent along.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any

from arview.core.messages import Message, Phrase, recognised

_EDGES = ("left", "right", "upper", "lower")
_RANGE = "seen from outside the declared range: azimuth {azimuth}°, elevation {elevation}°"
_TURNED = "turned outside the declared range: roll {roll}°, declared {first} to {last}°"
_GUESSED = "focal length not determined by these views: the guess of {guessed} px is kept; show the part from near and "
_OTHER_CODE = "the code on this part says {serial}, the inspection is of {inspected}"
_ALL_DIRECTIONS = "from several sides"

TRACKING = (
    Phrase("tracking.align", "align the part with the outline"),
    Phrase("tracking.nothing_from_to", "nothing like the part in view, {low} to {high} mm away"),
    Phrase("tracking.outline_share", "only {share} % of the outline found"),
    Phrase("tracking.dark", "too dark"),
    Phrase("tracking.bright", "overexposed"),
    Phrase("tracking.blurred", "blurred"),
    Phrase("tracking.no_edges", "low contrast: hardly an edge in the picture"),
    Phrase("tracking.contrast", "low contrast of the part against its background"),
    Phrase("tracking.far", "too far: about {distance} mm, declared up to {limit} mm"),
    Phrase("tracking.near", "too near: about {distance} mm, declared from {limit} mm"),
    Phrase("tracking.small", "too far: the part spans only {span} px"),
    Phrase("tracking.large", "too near: the part does not fit in the picture"),
    Phrase("tracking.outside", _RANGE),
    Phrase("tracking.turned", _TURNED),
    *(Phrase(f"tracking.left_at_{edge}", f"the part left the picture at the {edge} edge") for edge in _EDGES),
    Phrase("tracking.left", "the part left the picture"),
    Phrase("tracking.fast", "the part moved too fast"),
    Phrase("tracking.hidden", "the part is hidden or moved too fast"),
    *(Phrase(f"tracking.partly_{edge}", f"partly outside the picture at the {edge} edge") for edge in _EDGES),
    Phrase("tracking.mismatch", "mismatch: {name} not seen where expected"),
    Phrase("tracking.in_doubt", "in doubt: {names}"),
    Phrase("tracking.not_verified_many", "not yet verified: {count} components"),
    Phrase("tracking.not_verified", "not yet verified: {names}"),
    Phrase("tracking.other_first", "another part is searched for first"),
)
IDENTITY = (
    Phrase("identity.checking", "checking that this is the part that was followed before"),
    Phrase("identity.another", "another part of this kind is in view; confirm that this is the one"),
    Phrase("identity.moved", "this part is not where the last one was; confirm that this is the one"),
    Phrase("identity.not_found", "no part of this kind found at {place} in frame {frame}; confirm the part"),
    Phrase("identity.belongs", "the labels belong to the part at {place} in frame {frame}"),
    Phrase("identity.code", _OTHER_CODE),
    Phrase("identity.withheld_of", "Labels withheld: this is {serial}"),
    Phrase("identity.withheld", "Labels withheld"),
)
LABELS = (
    Phrase("label.missing", "MISSING"),
    Phrase("label.displaced", "DISPLACED"),
    Phrase("label.unverified", "NOT VERIFIED"),
    Phrase("label.uncertain", "UNCERTAIN"),
    Phrase("label.withheld", "WITHHELD"),
    Phrase("label.seen", "SEEN"),
    Phrase("verdict.pass", "PASS"),
    Phrase("verdict.fail", "FAIL"),
    Phrase("verdict.undecided", "UNDECIDED"),
    Phrase("verdict.measured", "MEASURED"),
    Phrase("verdict.not_measured", "NOT MEASURED"),
    Phrase("label.away", "≈ {distance} away"),
    Phrase("label.turned", "turned {angle}°"),
    Phrase("label.changed", "changed since measured"),
    Phrase("label.as_measured", "as measured"),
    Phrase("label.seen_changed", "seen now: changed since measured"),
    Phrase("label.measured_unverified", "measured, not verified here"),
    Phrase("label.measured_uncertain", "measured, evidence here conflicts"),
    Phrase("label.not_verified", "not verified here"),
    Phrase("label.conflicts", "evidence here conflicts"),
    Phrase("label.hidden", "hidden by something"),
    Phrase("label.one_of_two", "one of two places"),
    Phrase("label.one_of", "one of {count} places"),
    Phrase("label.measured_on", "measured on {serial}, not on this one"),
    Phrase("label.was_missing", "missing"),
    Phrase("label.undetermined", "undetermined"),
    Phrase("legend.missing", "missing here"),
    Phrase("legend.displaced", "displaced: CAD place and where it is"),
    Phrase("legend.withheld", "another specimen: nothing measured is shown"),
    Phrase("complete.yes", "COMPLETE"),
    Phrase("complete.open", "NOT YET CHECKED"),
    Phrase("complete.both", "INCOMPLETE: {missing} missing, {displaced} displaced"),
    Phrase("complete.missing", "INCOMPLETE: {missing} missing"),
    Phrase("complete.displaced", "INCOMPLETE: {displaced} displaced"),
    Phrase("complete.no", "INCOMPLETE"),
)
AGES = (
    Phrase("told.label_age_days", "measured {count} d ago"),
    Phrase("told.label_age_hours", "measured {count} h ago"),
    Phrase("told.label_age_minutes", "measured {count} min ago"),
    Phrase("told.label_future", "measured in the future"),
    Phrase("told.old_days", "measured {count} d ago: measure again"),
    Phrase("told.old_hours", "measured {count} h ago: measure again"),
    Phrase("told.old_minutes", "measured {count} min ago: measure again"),
)
NOTICES = (
    Phrase("told.inspection_none", "no inspection: nothing has been measured"),
    Phrase("told.inspection_rough", "first numbers: they are provisional"),
    Phrase("told.inspection_serial", "the inspection is of {serial}, this part is {own}"),
    Phrase("told.inspection_no_serial", "the inspection is without a serial number, this part is {own}"),
    Phrase("told.camera_guessed", "camera not calibrated: distances to the part are only rough"),
    Phrase("told.focal", "focal length estimated: {focal} ± {u} px (guessed {guessed})"),
    Phrase("told.focal_open", _GUESSED + _ALL_DIRECTIONS),
    Phrase("told.scaled", "pictures arrive at {share} of their size"),
    Phrase("told.damaged", "pictures arrive damaged: their frame counter cannot be read"),
    Phrase("told.restarted", "the tracking failed and was restarted {count} times"),
    Phrase("told.same_picture", "the camera delivers the same picture again and again"),
    Phrase("told.camera_silent", "the camera delivers no picture for {seconds} s"),
    Phrase("told.first_picture", "waiting for the first picture"),
    Phrase("told.no_picture", "no picture for {seconds} s"),
    Phrase("told.loading", "the part is being loaded"),
)
WORKER = (
    Phrase("walk.starting", "starting"),
    Phrase("walk.waiting", "waiting for photos"),
    Phrase("walk.photos", "{count} photos"),
    Phrase("walk.provisional", "{count} photos; provisional numbers from {placed}"),
    Phrase("walk.measuring", "measuring"),
    Phrase("walk.first", "reading the first measurement"),
)
TEXT_KEYS = frozenset(
    ("text", "reason", "remark", "title", "value", "word", "notes", "value_text", "mismatches", "completeness")
)
"""Keys of a document whose values are texts for a person."""
CATALOGUE = (*TRACKING, *IDENTITY, *LABELS, *AGES, *NOTICES, *WORKER)
"""All of them; of two that match a text, the first one is taken."""


def messages_of(texts: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Key and values of those texts that are in the catalogue, by the text: ``messages`` of the protocol.

    A text of several sentences that ``; `` divides is looked up as a whole, else by its sentences.
    """
    found = {}
    for text in dict.fromkeys(texts):
        whole = _message(text) if text else None
        for one, message in [(text, whole)] if whole else [(one, _message(one)) for one in text.split("; ")]:
            if message is not None:
                found[one] = message.document()
    return found


def texts_of(document: Any) -> Iterator[str]:
    """The texts of a document that a person reads: those of the keys `TEXT_KEYS`."""
    if isinstance(document, list):
        for one in document:
            yield from texts_of(one)
    elif isinstance(document, dict):
        for key, value in document.items():
            if key in TEXT_KEYS:
                yield from value if isinstance(value, list) else [value] if isinstance(value, str) else []
            if isinstance(value, dict | list):
                yield from texts_of(value)


def with_messages(document: dict[str, Any]) -> dict[str, Any]:
    """A document with the ``messages`` for its texts, if there are any."""
    messages = messages_of(texts_of(document))
    return {**document, "messages": messages} if messages else document


@lru_cache(maxsize=2048)
def _message(text: str) -> Message | None:
    return recognised(text, CATALOGUE)
