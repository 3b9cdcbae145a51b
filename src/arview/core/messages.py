"""Messages: the sentences that arview says of what it sees, each with a key and values, made where the thing is known.

A message is its English text, so that files, terminals and drawings use it as it is; a page in another language finds
its own words by the key.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Union

Value = Union[str, int, "Message", tuple["Message", ...]]
"""A value of a message: a name or number, a message, or a list of messages."""

CATALOGUE = {
    # Why a pose is weak or missing.
    "tracking.align": "align the part with the outline",
    "tracking.nothing_from_to": "nothing like the part in view, {low} to {high} mm away",
    "tracking.outline_share": "only {share} % of the outline found",
    "tracking.dark": "too dark",
    "tracking.bright": "overexposed",
    "tracking.blurred": "blurred",
    "tracking.no_edges": "low contrast: hardly an edge in the picture",
    "tracking.contrast": "low contrast of the part against its background",
    "tracking.far": "too far: about {distance} mm, declared up to {limit} mm",
    "tracking.near": "too near: about {distance} mm, declared from {limit} mm",
    "tracking.small": "too far: the part spans only {span} px",
    "tracking.large": "too near: the part does not fit in the picture",
    "tracking.outside": "seen from outside the declared range: azimuth {azimuth}°, elevation {elevation}°",
    "tracking.turned": "turned outside the declared range: roll {roll}°, declared {first} to {last}°",
    "tracking.left_at_left": "the part left the picture at the left edge",
    "tracking.left_at_right": "the part left the picture at the right edge",
    "tracking.left_at_upper": "the part left the picture at the upper edge",
    "tracking.left_at_lower": "the part left the picture at the lower edge",
    "tracking.left": "the part left the picture",
    "tracking.fast": "the part moved too fast",
    "tracking.hidden": "the part is hidden or moved too fast",
    "tracking.partly_left": "partly outside the picture at the left edge",
    "tracking.partly_right": "partly outside the picture at the right edge",
    "tracking.partly_upper": "partly outside the picture at the upper edge",
    "tracking.partly_lower": "partly outside the picture at the lower edge",
    "tracking.mismatch": "mismatch: {name} not seen where expected",
    "tracking.in_doubt": "in doubt: {names}",
    "tracking.not_verified_many": "not yet verified: {count} components",
    "tracking.not_verified": "not yet verified: {names}",
    "tracking.focal_wrong": "the picture contradicts the focal length of the camera: {seen} px fit, {given} px were "
    "given ({percent} %); give the camera of this mode of the lens",
    "tracking.focal_changed": "the focal length has changed: {seen} px fit now, {given} px before ({percent} %); "
    "zoom, lens and stabiliser must stay as they were calibrated",
    "tracking.other_first": "another part is searched for first",
    # The steps of an assembly.
    "steps.mount": "{number}/{count} mount {names}",
    "steps.named": "{number}/{count} {name}: mount {names}",
    "steps.done": "all {count} steps done",
    "steps.wrong_order": "wrong order: {name} before {others}",
    "steps.wrong_part": "wrong part in the place of {name}",
    "steps.missing": "{name} is gone",
    # Whether the specimen in view is the one that was measured.
    "identity.checking": "checking that this is the part that was followed before",
    "identity.another": "another part of this kind is in view; confirm that this is the one",
    "identity.moved": "this part is not where the last one was; confirm that this is the one",
    "identity.not_found": "no part of this kind found at {place} in frame {frame}; confirm the part",
    "identity.belongs": "the labels belong to the part at {place} in frame {frame}",
    "identity.code": "the code on this part says {serial}, the inspection is of {inspected}",
    "identity.withheld_of": "Labels withheld: this is {serial}",
    "identity.withheld": "Labels withheld",
    # Labels and legend of the overlay.
    "label.missing": "MISSING",
    "label.displaced": "DISPLACED",
    "label.unverified": "NOT VERIFIED",
    "label.uncertain": "UNCERTAIN",
    "label.withheld": "WITHHELD",
    "label.seen": "SEEN",
    "label.next": "NEXT",
    "label.wrong": "WRONG PART",
    "verdict.pass": "PASS",
    "verdict.fail": "FAIL",
    "verdict.undecided": "UNDECIDED",
    "verdict.measured": "MEASURED",
    "verdict.not_measured": "NOT MEASURED",
    # Labels and legend of the overlay.
    "label.away": "≈ {distance} away",
    "label.turned": "turned {angle}°",
    "label.changed": "changed since measured",
    "label.as_measured": "as measured",
    "label.seen_changed": "seen now: changed since measured",
    "label.measured_unverified": "measured, not verified here",
    "label.measured_uncertain": "measured, evidence here conflicts",
    "label.not_verified": "not verified here",
    "label.conflicts": "evidence here conflicts",
    "label.hidden": "hidden by something",
    "label.one_of_two": "one of two places",
    "label.one_of": "one of {count} places",
    "label.measured_on": "measured on {serial}, not on this one",
    "label.was_missing": "missing",
    "label.undetermined": "undetermined",
    "legend.missing": "missing here",
    "legend.displaced": "displaced: CAD place and where it is",
    "legend.next": "to be mounted now",
    "legend.wrong": "another part at its place",
    "legend.withheld": "another specimen: nothing measured is shown",
    "complete.yes": "COMPLETE",
    "complete.open": "NOT YET CHECKED",
    "complete.both": "INCOMPLETE: {missing} missing, {displaced} displaced",
    "complete.missing": "INCOMPLETE: {missing} missing",
    "complete.displaced": "INCOMPLETE: {displaced} displaced",
    "complete.no": "INCOMPLETE",
    # Notices of the station.
    "told.label_age": "measured {age}",
    "told.old": "measured {age}: measure again",
    "told.future": "measured in the future, by {lead}: check the clocks of this machine and of the other",
    "age.days": "{count} d ago",
    "age.hours": "{count} h ago",
    "age.minutes": "{count} min ago",
    "age.now": "just now",
    "age.future": "in the future",
    "told.inspection_none": "no inspection: nothing has been measured",
    "told.inspection_rough": "first numbers: they are provisional",
    "told.inspection_serial": "the inspection is of {serial}, this part is {own}",
    "told.inspection_no_serial": "the inspection is without a serial number, this part is {own}",
    "told.camera_guessed": "camera not calibrated: distances to the part are only rough",
    "told.focal": "focal length estimated: {focal} ± {u} px (guessed {guessed})",
    "told.focal_open": "focal length not determined by these views: the guess of {guessed} px is kept; "
    "show the part from near and from several sides",
    "told.scaled": "pictures arrive at {share} of their size",
    "told.damaged": "pictures arrive damaged: their frame counter cannot be read",
    "told.restarted": "the tracking failed and was restarted {count} times",
    "told.same_picture": "the camera delivers the same picture again and again",
    "told.camera_silent": "the camera delivers no picture for {seconds} s",
    "told.first_picture": "waiting for the first picture",
    "told.no_picture": "no picture for {seconds} s",
    "told.loading": "the part is being loaded",
    # The state of a job.
    "walk.starting": "starting",
    "walk.waiting": "waiting for photos",
    "walk.photos": "{count} photos",
    "walk.provisional": "{count} photos; provisional numbers from {placed}",
    "walk.measuring": "measuring",
    "walk.first": "reading the first measurement",
    "walk.stale": "a component of it was checked again; inspect the whole part for this value",
    "walk.checked_again": "{names} checked again {time}",
    # Guided capture.
    "capture.not_tracked": "part not tracked",
    "capture.uncertain": "pose uncertain",
    "capture.ambiguous": "view is ambiguous: move on",
    "capture.other_specimen": "this may be another part",
    "capture.closer": "closer",
    "capture.farther": "farther away",
    "capture.not_inside": "bring the whole part into the picture",
    "capture.hold_still": "hold still",
    "capture.not_sharp": "not sharp yet: hold still",
    "capture.out_of_focus": "out of focus: tap on the part, or clean the lens",
    "capture.already_taken": "already taken from here: move on",
    "capture.little_gain": "little to gain from here: move on",
    "capture.taking": "taking the photo",
    "capture.too_soon": "wait a moment",
    "capture.enough": "enough photos",
    "capture.more_one": "{count} more photo",
    "capture.more": "{count} more photos",
    "capture.more_from": "{count} more from {side}",
    "capture.more_of": "{count} more: {sides}",
    "capture.from": "{count} from {side}",
    "capture.from_others": "{count} from elsewhere",
    "capture.left": "the left",
    "capture.right": "the right",
    "capture.above": "above",
    "capture.below": "below",
    "capture.other_side": "the other side",
    "capture.hidden_one": "{name} is hidden from here",
    "capture.hidden_two": "{first} and {second} are hidden from here",
    "capture.hidden_many": "{count} components are hidden from here",
    "capture.both": "{first}; {second}",
    "capture.other_sides": "more from other sides",
    "capture.hidden": "hidden from here; {lacking}",
    "capture.never_seen": "other components hide it from every direction asked for",
    # How a component is put right.
    "rework.towards": "towards {target}",
    "rework.away_from": "away from {target}",
    "rework.up": "up",
    "rework.down": "down",
    "rework.up_slope": "up the slope",
    "rework.down_slope": "down the slope",
    "rework.front": "towards the front of the part",
    "rework.back": "towards the back of the part",
    "rework.left": "towards the left of the part",
    "rework.right": "towards the right of the part",
    "rework.arrow": "in the direction of the arrow",
    "rework.about": "{direction}, as the arrow of the drawing shows",
    "rework.unnamed": "a direction without a name",
    "rework.opposite": "opposite to “{name}”",
    "rework.up_from": "up, away from {seat}",
    "rework.down_to": "down, towards {seat}",
    "rework.down_from": "down, away from {seat}",
    "rework.up_to": "up, towards {seat}",
    "rework.out_from": "out, away from {seat}",
    "rework.in_to": "in, towards {seat}",
    "rework.move": "move {amount} mm {direction}",
    "rework.counter_clockwise": "turn {angle}° counter-clockwise {seen}",
    "rework.clockwise": "turn {angle}° clockwise {seen}",
    "rework.seen_above": "seen from above",
    "rework.seen_below": "seen from below",
    "rework.seen_seat": "seen with {seat} behind it",
    "rework.seen_end": "seen from its free end",
    "rework.seen_side": "seen from the side",
    "rework.seen_side_below": "seen from the side, {seat} below",
    "rework.seen_side_edge": "seen from the side, {seat} at the lower edge",
    "rework.degrees": "{angle}° {direction}",
    "rework.tilt": "tilt its free end {parts}",
    "rework.and": "{first} and {second}",
    "rework.then": "{first}, then {second}",
    "rework.both": "{first} {second}",
    "rework.between": "between {component} and {seat}",
    "rework.under": "under {component}",
    "rework.shims_in": "put shims of {amount} mm {under}",
    "rework.shims_out": "take {amount} mm of shims out {under}, or dress the seat by it",
    "rework.shims_side": "put the thicker shims on the side {side}: {slope} mm for 1 m of width",
    "rework.free_shift": "How far it is off {direction}, or the other way, was not determined.",
    "rework.free_twist": "Its turn about its own axis was not determined.",
    "rework.free_tilt": "Its tilt was not determined.",
    "rework.no_move": "Its distance is within its U or the tolerance: no move is asked for.",
    "rework.of_point": "The moves are those of one point: {point}; turn it about that point.",
    "rework.install": "install it",
    "rework.bring": "bring it to its design place",
    "rework.replace": "replace it; it stands wrong: to be right it would have to {what}",
    "rework.on": "on {seat}",
    "rework.beside": "{reach} mm from {name}",
    "rework.place": "{first}, {second}",
    "rework.as_drawn": "as its drawing shows",
    "rework.step_move": "{move}.",
    "rework.adjust_1": "Free {component} as far as its fixing allows.",
    "rework.adjust_2": "Fix {component} again without moving it.",
    "rework.unbolt_1": "Loosen the bolts of {component} until it can be moved; leave them in.",
    "rework.unbolt_2": "Hold {component} in place and tighten the bolts crosswise to their torque.",
    "rework.reweld_1": "Cut the weld of {component} open and protect what is beside it.",
    "rework.reweld_2": "Grind and clean both sides of the joint.",
    "rework.reweld_3": "Clamp and tack {component}, and check its place before the seam is welded.",
    "rework.reweld_4": "Weld the seam and let it cool down before it is measured.",
    "rework.reglue_1": "Take {component} off and remove the old glue from both sides.",
    "rework.reglue_2": "Glue {component} on, hold it in place and let the glue cure before it is measured.",
    "rework.shim_1": "Loosen {component}.",
    "rework.shim_2": "Tighten {component} again; check that no shim sticks out.",
    "rework.bend_1": "Support {component} beside the place that is to be bent.",
    "rework.bend_2": "{move}; go a little further for the springback and let it come back.",
    "rework.replace_1": "Take {component} off and mark it as rejected.",
    "rework.replace_2": "Check that the new one is the right part, and that its seat is clean.",
    "rework.replace_3": "Fit the new one: {place}.",
    "rework.install_1": "Take the right part for {component}, and check that its seat is clean.",
    "rework.install_2": "Put it in its place: {place}.",
    "rework.fix_unbolt": "Bolt it on, crosswise to the torque.",
    "rework.fix_reweld": "Clamp and tack it, check its place, and weld it.",
    "rework.fix_reglue": "Glue it on, hold it in place and let the glue cure.",
    "rework.fix_shim": "Bolt it on with the shims that belong under it.",
    "rework.fix": "Fix it as its drawing says.",
    "rework.last_step": "Check {component} again: a few photos of it are enough.",
    # Points whose displacement is stated, see `arview.inspection.MEASURANDS`.
    "point.volume_centroid": "centre of mass (centroid of the volume)",
    "point.area_centroid": "centre of mass (centroid of the area of a sheet body)",
    "point.seat": "middle of the surface on which it stands",
    "point.axis": "foot of its axis",
    "point.hole": "centre of its hole",
    "point.given": "point named by the part file",
    "point.box_center": "centre of the bounding box",
}
"""The English sentences by key; values stand in braces."""


class Message(str):
    """A text in English that knows what it says.

    Attributes:
        key: by which pages find the sentence in their language; empty for a text of several sentences.
        values: of the sentence, by name.
        parts: the sentences of a text of several.
    """

    key: str
    values: Mapping[str, Value]
    parts: tuple[str, ...]

    def __new__(
        cls, text: str, key: str = "", values: Mapping[str, Value] | None = None, parts: tuple[str, ...] = ()
    ) -> Message:
        """A text with its key and values, or with its parts; see `sentence` and `joined`."""
        message = super().__new__(cls, text)
        message.key, message.values, message.parts = key, values or {}, parts
        return message

    def document(self) -> dict[str, Any]:
        """Key, values and text, for a page."""
        return {"key": self.key, "values": {name: _document(value) for name, value in self.values.items()}}


def sentence(key: str, **values: Value) -> Message:
    """The sentence of a key with its values.

    Raises:
        KeyError: the catalogue has no such sentence, or the sentence has a value that is not given.
    """
    texts = {name: ", ".join(value) if isinstance(value, tuple) else value for name, value in values.items()}
    return Message(CATALOGUE[key].format_map(texts), key, values)


def joined(texts: Iterable[str]) -> str:
    """Several sentences as one text, divided by ``; ``; empty sentences are left out."""
    parts = tuple(text for text in texts if text)
    return parts[0] if len(parts) == 1 else Message("; ".join(parts), parts=parts)


def key_of(text: str) -> str:
    """The key of a message; empty for any other text."""
    return text.key if isinstance(text, Message) else ""


def messages_of(document: Any) -> dict[str, dict[str, Any]]:
    """Key and values of all messages in a document of dictionaries and lists, by their texts."""
    if isinstance(document, Message):
        return {str(document): document.document()} if document.key else messages_of(document.parts)
    inside = document.values() if isinstance(document, dict) else document if isinstance(document, list | tuple) else ()
    return {text: message for value in inside for text, message in messages_of(value).items()}


def with_messages(document: dict[str, Any]) -> dict[str, Any]:
    """A document with the ``messages`` of its texts, if there are any."""
    messages = messages_of(document)
    return {**document, "messages": messages} if messages else document


def _document(value: Value) -> Any:
    if isinstance(value, tuple):
        return [part.document() for part in value]
    return value.document() if isinstance(value, Message) else value
