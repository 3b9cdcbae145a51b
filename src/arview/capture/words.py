"""What guided capture says: where to go next, seen from where the camera is, and why no photo is taken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from arview.geometry import Array, apply

NOT_TRACKED = "part not tracked"
UNCERTAIN = "pose uncertain"
AMBIGUOUS = "view is ambiguous: move on"
OTHER_SPECIMEN = "this may be another part"
CLOSER = "closer"
FARTHER = "farther away"
NOT_INSIDE = "bring the whole part into the picture"
HOLD_STILL = "hold still"
NOT_SHARP = "not sharp yet: hold still"
OUT_OF_FOCUS = "out of focus: tap on the part, or clean the lens"
ALREADY_TAKEN = "already taken from here: move on"
LITTLE_GAIN = "little to gain from here: move on"
TAKING = "taking the photo"
TOO_SOON = "wait a moment"
ENOUGH = "enough photos"

OTHER_SIDE_DEG = 110.0
"""Angle between two directions of the part from which one is said to be on its other side."""
MAX_SIDES = 2
"""Sides that a text names."""
MAX_NAMES = 2
"""Components that a text names; of more only the number is given."""


def side_of(cam_from_model: Array, eye_in_model: Array, center_in_model: Array) -> str:
    """Where another camera place (3,) is, for a person who looks through a camera at a pose (4,4) at the part.

    Left, right, above and below are those of the picture.
    """
    here = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3] - center_in_model
    there = eye_in_model - center_in_model
    cosine = float(here @ there / max(float(np.linalg.norm(here) * np.linalg.norm(there)), 1e-12))
    if cosine < np.cos(np.deg2rad(OTHER_SIDE_DEG)):
        return "the other side"
    x, y, _ = apply(cam_from_model, eye_in_model)
    if abs(x) >= abs(y):
        return "the left" if x < 0 else "the right"
    return "above" if y < 0 else "below"


def more_text(count: int, sides: Sequence[str]) -> str:
    """How many photos are still wanted and from where, e.g. ``6 more from the left``.

    Args:
        count: of photos.
        sides: of each of them, the next first; empty where the part is not in view.
    """
    counts = Counter(sides)
    if not counts:
        return f"{count} more photo{'s' * (count != 1)}"
    if len(counts) == 1:
        return f"{count} more from {sides[0]}"
    named = [f"{number} from {side}" for side, number in counts.most_common(MAX_SIDES)]
    return f"{count} more: {', '.join(named)}"


def hidden_text(names: Sequence[str]) -> str:
    """Which components that lack photos are hidden from here; empty for none."""
    if not names:
        return ""
    if len(names) > MAX_NAMES:
        return f"{len(names)} components are hidden from here"
    return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} hidden from here"
