"""What guided capture says: where to go next, seen from where the camera is, and why no photo is taken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from arview.core.messages import Message, Phrase
from arview.geometry import Array, apply

NOT_TRACKED = Phrase("capture.not_tracked", "part not tracked")
UNCERTAIN = Phrase("capture.uncertain", "pose uncertain")
AMBIGUOUS = Phrase("capture.ambiguous", "view is ambiguous: move on")
OTHER_SPECIMEN = Phrase("capture.other_specimen", "this may be another part")
CLOSER = Phrase("capture.closer", "closer")
FARTHER = Phrase("capture.farther", "farther away")
NOT_INSIDE = Phrase("capture.not_inside", "bring the whole part into the picture")
HOLD_STILL = Phrase("capture.hold_still", "hold still")
NOT_SHARP = Phrase("capture.not_sharp", "not sharp yet: hold still")
OUT_OF_FOCUS = Phrase("capture.out_of_focus", "out of focus: tap on the part, or clean the lens")
ALREADY_TAKEN = Phrase("capture.already_taken", "already taken from here: move on")
LITTLE_GAIN = Phrase("capture.little_gain", "little to gain from here: move on")
TAKING = Phrase("capture.taking", "taking the photo")
TOO_SOON = Phrase("capture.too_soon", "wait a moment")
ENOUGH = Phrase("capture.enough", "enough photos")

ENOUGH_OF = Phrase("capture.enough_of", "enough photos: {count}")
MORE_ONE = Phrase("capture.more_one", "{count} more photo")
MORE = Phrase("capture.more", "{count} more photos")
MORE_FROM = Phrase("capture.more_from", "{count} more from {side}")
MORE_OF = Phrase("capture.more_of", "{count} more: {sides}")
FROM = Phrase("capture.from", "{count} from {side}")
LEFT = Phrase("capture.left", "the left")
RIGHT = Phrase("capture.right", "the right")
ABOVE = Phrase("capture.above", "above")
BELOW = Phrase("capture.below", "below")
OTHER_SIDE = Phrase("capture.other_side", "the other side")
HIDDEN_ONE = Phrase("capture.hidden_one", "{name} is hidden from here")
HIDDEN_TWO = Phrase("capture.hidden_two", "{first} and {second} are hidden from here")
HIDDEN_MANY = Phrase("capture.hidden_many", "{count} components are hidden from here")
BOTH = Phrase("capture.both", "{first}; {second}")
OTHER_SIDES = Phrase("capture.other_sides", "more from other sides")
HIDDEN = Phrase("capture.hidden", "hidden from here; {lacking}")
NEVER_SEEN = Phrase("capture.never_seen", "other components hide it from every direction asked for")

OTHER_SIDE_DEG = 110.0
"""Angle between two directions of the part from which one is said to be on its other side."""
MAX_SIDES = 2
"""Sides that a text names."""
MAX_NAMES = 2
"""Components that a text names; of more only the number is given."""


def side_of(cam_from_model: Array, eye_in_model: Array, center_in_model: Array) -> Phrase:
    """Where another camera place (3,) is, for a person who looks through a camera at a pose (4,4) at the part.

    Left, right, above and below are those of the picture.
    """
    here = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3] - center_in_model
    there = eye_in_model - center_in_model
    cosine = float(here @ there / max(float(np.linalg.norm(here) * np.linalg.norm(there)), 1e-12))
    if cosine < np.cos(np.deg2rad(OTHER_SIDE_DEG)):
        return OTHER_SIDE
    x, y, _ = apply(cam_from_model, eye_in_model)
    if abs(x) >= abs(y):
        return LEFT if x < 0 else RIGHT
    return ABOVE if y < 0 else BELOW


def more_message(count: int, sides: Sequence[Phrase]) -> Message:
    """How many photos are still wanted and from where, e.g. ``6 more from the left``.

    Args:
        count: of photos.
        sides: of each of them, the next first; empty where the part is not in view.
    """
    counts = Counter(sides)
    if not counts:
        return (MORE_ONE if count == 1 else MORE)(count=count)
    if len(counts) == 1:
        return MORE_FROM(count=count, side=sides[0]())
    named = tuple(FROM(count=number, side=side()) for side, number in counts.most_common(MAX_SIDES))
    return MORE_OF(count=count, sides=named)


def hidden_message(names: Sequence[str]) -> Message | None:
    """Which components that lack photos are hidden from here; None where none is."""
    if not names:
        return None
    if len(names) > MAX_NAMES:
        return HIDDEN_MANY(count=len(names))
    return HIDDEN_ONE(name=names[0]) if len(names) == 1 else HIDDEN_TWO(first=names[0], second=names[1])


def lacking_message(photos: int, is_hidden: bool) -> Message:
    """What one component lacks: a number of photos, or of none other directions; and whether it is hidden from here."""
    lacking = OTHER_SIDES() if photos <= 0 else (MORE_ONE if photos == 1 else MORE)(count=photos)
    return HIDDEN(lacking=lacking) if is_hidden else lacking
