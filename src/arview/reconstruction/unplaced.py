"""Why photos could not be placed, in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from arview.reconstruction.features import Features
from arview.reconstruction.matching import Matches
from arview.reconstruction.types import Photo

Pair = tuple[int, int]

FEW_FEATURES = 200
"""A photo with fewer features is blurred, or shows only bare surfaces."""


def unplaced_photos(
    photos: Sequence[Photo],
    features: Sequence[Features],
    pairs: dict[Pair, Matches],
    groups: Sequence[Sequence[str]],
) -> list[tuple[str, str]]:
    """(name, reason) of every photo that is not in the first group."""
    placed = set(groups[0])
    reasons = []
    for index, photo in enumerate(photos):
        if photo.name in placed:
            continue
        partners = {photos[other].name for pair in pairs for other in pair if index in pair and other != index}
        group = set(next((names for names in groups[1:] if photo.name in names), ()))
        if len(features[index]) < FEW_FEATURES:
            reason = f"only {len(features[index])} features: blurred, too dark, or nothing but bare surfaces in view"
        elif len(group) > 1:
            company = _some(group - {photo.name})
            reason = f"has points in common only with {company}, but none, or too few, with the {len(placed)} used"
        elif not partners:
            reason = "nothing in common with the other photos: another part, or a view too far from the others"
        elif not partners & placed:
            reason = f"has something in common only with {_some(partners)}, but not with the other {len(placed)}"
        else:
            reason = "too little in common with the placed photos: take more photos between this view and theirs"
        reasons.append((photo.name, reason))
    return reasons


def _some(names: Iterable[str]) -> str:
    """The first few of some names, for a message."""
    listed = sorted(names)
    return ", ".join(listed[:3]) + (f" and {len(listed) - 3} more" if len(listed) > 3 else "")


def why_nothing(photos: Sequence[Photo], features: Sequence[Features], pairs: dict[Pair, Matches]) -> str:
    """Why no three photos could be placed together, and what to do."""
    poor = [photo.name for photo, found in zip(photos, features, strict=True) if len(found) < FEW_FEATURES]
    if 2 * len(poor) > len(photos):
        return (
            f"photos: {len(poor)} of {len(photos)} show almost no texture ({_some(poor)}); better light, or a "
            "patterned mat or printed sheets around the part, give features"
        )
    if not pairs:
        return (
            f"photos: no two of the {len(photos)} have enough in common; take them 10 to 20 degrees apart, all of the "
            "same part in one place"
        )
    return (
        f"photos: no three of the {len(photos)} could be placed together ({len(pairs)} pairs have features in common); "
        "take more, 10 to 20 degrees apart, moving the camera sideways rather than turning it"
    )
