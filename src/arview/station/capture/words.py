"""What guided capture says: where to go next, seen from where the camera is, and why no photo is taken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from arview.core.messages import Message, sentence
from arview.geometry import Array, apply

OTHER_SIDE_DEG = 110.0
"""Angle between two directions of the part from which one is said to be on its other side."""
MAX_SIDES = 2
"""Sides that a text names; photos from others are counted together."""
MAX_NAMES = 2
"""Components that a text names; of more only the number is given."""


def side_of(cam_from_model: Array, eye_in_model: Array, center_in_model: Array) -> Message:
    """Where another camera place (3,) is, for a person who looks through a camera at a pose (4,4) at the part.

    Left, right, above and below are those of the picture.
    """
    here = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3] - center_in_model
    there = eye_in_model - center_in_model
    cosine = float(here @ there / max(float(np.linalg.norm(here) * np.linalg.norm(there)), 1e-12))
    if cosine < np.cos(np.deg2rad(OTHER_SIDE_DEG)):
        return sentence("capture.other_side")
    x, y, _ = apply(cam_from_model, eye_in_model)
    if abs(x) >= abs(y):
        return sentence("capture.left" if x < 0 else "capture.right")
    return sentence("capture.above" if y < 0 else "capture.below")


def more_message(count: int, sides: Sequence[Message]) -> Message:
    """How many photos are still wanted and from where, e.g. ``6 more from the left``.

    Args:
        count: of photos.
        sides: of each of them, the next first; empty where the part is not in view.
    """
    counts = Counter(sides)
    if not counts:
        return sentence("capture.more_one" if count == 1 else "capture.more", count=count)
    if len(counts) == 1:
        return sentence("capture.more_from", count=count, side=sides[0])
    common = counts.most_common(MAX_SIDES)
    named = tuple(sentence("capture.from", count=number, side=side) for side, number in common)
    if rest := count - sum(number for _, number in common):
        named += (sentence("capture.from_others", count=rest),)
    return sentence("capture.more_of", count=count, sides=named)


def hidden_message(names: Sequence[str]) -> Message | None:
    """Which components that lack photos are hidden from here; None where none is."""
    if not names:
        return None
    if len(names) > MAX_NAMES:
        return sentence("capture.hidden_many", count=len(names))
    if len(names) == 1:
        return sentence("capture.hidden_one", name=names[0])
    return sentence("capture.hidden_two", first=names[0], second=names[1])


def lacking_message(photos: int, is_hidden: bool) -> Message:
    """What one component lacks: a number of photos, or of none other directions; and whether it is hidden from here."""
    if photos <= 0:
        lacking = sentence("capture.other_sides")
    else:
        lacking = sentence("capture.more_one" if photos == 1 else "capture.more", count=photos)
    return sentence("capture.hidden", lacking=lacking) if is_hidden else lacking
