"""CaptureAdvice: what guided capture says of one frame, and its form for a page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from arview.core.messages import with_messages

RingDistance = Literal["near", "good", "far"]
"""Distance of the camera: nearer than the ring of good distances, on it, or farther."""


@dataclass(frozen=True)
class CellState:
    """One direction of the dome.

    Attributes:
        azimuth_deg, elevation_deg: in the frame of the part's range of views.
        is_filled: a photo was taken from there.
        is_wanted: one of the photos still to be taken should be taken from there.
    """

    azimuth_deg: float
    elevation_deg: float
    is_filled: bool
    is_wanted: bool


@dataclass(frozen=True)
class ComponentNeed:
    """What the photos so far show of one component, and what is lacking.

    Attributes:
        name: of the component.
        photos: that show it.
        directions: of these that differ.
        predicted_u_mm: expanded uncertainty (k = 2) to be expected from them; None with fewer than two.
        is_enough: whether nothing more is asked for.
        text: what is lacking, or empty.
    """

    name: str
    photos: int
    directions: int
    predicted_u_mm: float | None
    is_enough: bool
    text: str = ""


@dataclass(frozen=True)
class CaptureAdvice:
    """What to do at one frame.

    Attributes:
        takes: take a photo now; stays true until the photo is reported as taken or failed.
        take_id: grows with each photo that is asked for, so that none is taken twice.
        text: where to go next.
        reason: why no photo is taken at this frame; empty when one is.
        progress: 0–1.
        is_enough: whether the photos suffice.
        photos: taken so far.
        cells: of the dome.
        distance: see `RingDistance`.
        components: what each of them lacks, in the order of the model.
        revision: grows when a component or a cell has changed.
    """

    takes: bool
    take_id: int
    text: str
    reason: str
    progress: float
    is_enough: bool
    photos: int
    cells: tuple[CellState, ...]
    distance: RingDistance
    components: tuple[ComponentNeed, ...]
    revision: int = 0


def capture_document(advice: CaptureAdvice, job: str = "", has_components: bool = True) -> dict[str, Any]:
    """The advice as a document for a page.

    Args:
        advice: of one frame.
        job: id of the job that the photos belong to.
        has_components: whether the rows of the components are in it; they are large and change with each photo only.
    """
    document: dict[str, Any] = {
        "job": job,
        "take_id": advice.take_id,
        "takes": advice.takes,
        "text": advice.text,
        "reason": advice.reason,
        "progress": round(advice.progress, 3),
        "is_enough": advice.is_enough,
        "photos": advice.photos,
        "distance": advice.distance,
        "cells": "".join("1" if one.is_filled else "2" if one.is_wanted else "0" for one in advice.cells),
    }
    if has_components:
        document["components"] = [
            {
                "index": index,
                "photos": one.photos,
                "U_mm": None if one.predicted_u_mm is None else round(one.predicted_u_mm, 4),
                "is_enough": one.is_enough,
                "text": one.text,
            }
            for index, one in enumerate(advice.components)
        ]
    return with_messages(document)
