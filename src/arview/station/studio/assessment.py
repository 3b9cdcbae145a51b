"""Guide views of the part that is set up: how distinctive each is, what weakens it, and what would help."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from arview import guideviews
from arview.cad import Model, Part, ViewRange, make_model
from arview.rendering import ZBufferRenderer

TILE_PX = 320
"""Side of the picture of a view."""
MAX_LEFT_OUT = 6
"""Components of which it is tried, one at a time, whether the views are better without them."""


@dataclass(frozen=True)
class Assessment:
    """The assessed guide views of a part.

    Attributes:
        views: those by which the part is assessed.
        unique: what was found.
        look_alikes: the part beside each of the parts that it might be taken for.
    """

    views: guideviews.GuideViewSet
    unique: guideviews.Uniqueness
    look_alikes: tuple[guideviews.PartLikeness, ...] = ()

    def describe(self) -> dict[str, Any]:
        """The document of the page: verdict, shares, and a row for each view."""
        views, unique = self.views, self.unique
        weak = self.weak_words()
        rows = zip(
            views.directions.tolist(),
            guideviews.azimuths_deg(views).tolist(),
            guideviews.elevations_deg(views).tolist(),
            unique.distinct_lines.tolist(),
            unique.likeness.tolist(),
            unique.confused_with.tolist(),
            weak,
            strict=True,
        )
        return {
            "is_sufficient": unique.is_sufficient,
            "reason": unique.reason,
            "score": unique.score,
            "plain_share": float(np.mean(unique.distinct_lines < guideviews.PLAIN_LINES)),
            "confusable_share": float(np.mean(unique.likeness >= guideviews.CONFUSABLE_LIKENESS)),
            "most_alike": guideviews.confusable_pair(views, unique),
            "look_alikes": [vars(one) for one in self.look_alikes],
            "views": [
                {
                    "direction": direction,
                    "azimuth_deg": azimuth,
                    "elevation_deg": elevation,
                    "lines": lines,
                    "likeness": None if np.isnan(likeness) else likeness,
                    "confused_with": other if other >= 0 else None,
                    "weak": word,
                }
                for direction, azimuth, elevation, lines, likeness, other, word in rows
            ],
        }

    def weak_words(self) -> list[str]:
        """For each view ``plain``, ``alike`` or nothing."""
        unique = self.unique
        return [
            "plain" if lines < guideviews.PLAIN_LINES else "alike" if likeness >= guideviews.CONFUSABLE_LIKENESS else ""
            for lines, likeness in zip(unique.distinct_lines, unique.likeness, strict=True)
        ]


class Assessments:
    """Assesses the part in a thread of its own, and keeps the last assessment until the part is another one.

    Args:
        others: parts that it might be taken for.
    """

    def __init__(self, others: Sequence[Part] = ()) -> None:
        self._others = list(others)
        self._lock = threading.Lock()
        self._key: tuple[str, ViewRange] | None = None
        self._done: Assessment | None = None
        self._error = ""
        self._drawing = threading.Lock()
        self._renderer: tuple[Assessment, ZBufferRenderer] | None = None

    def of(self, part: Part) -> tuple[Assessment | None, str]:
        """The assessment of a part, or None while it is being made; and the reason why it cannot be made."""
        key = (part.model.source_hash, part.effective_view_range)
        with self._lock:
            if self._key != key:
                self._key, self._done, self._error = key, None, ""
                threading.Thread(target=self._run, args=(part, key), name="arview-studio-views", daemon=True).start()
            return self._done, self._error

    def picture(self, part: Part, index: int) -> bytes | None:
        """PNG of a view with its contour and edge points; None while there is no assessment, or no such view."""
        done, _ = self.of(part)
        if done is None or not 0 <= index < len(done.views):
            return None
        with self._drawing:
            if self._renderer is None or self._renderer[0] is not done:
                camera = done.views.camera.scaled(2 * TILE_PX, 2 * TILE_PX)
                self._renderer = done, ZBufferRenderer(part.model, camera)
            tile = guideviews.view_tile(self._renderer[1], done.views, index, done.unique, TILE_PX)
        _, png = cv2.imencode(".png", cv2.cvtColor(tile, cv2.COLOR_RGB2BGR))
        return png.tobytes()

    def _run(self, part: Part, key: tuple[str, ViewRange]) -> None:
        done, error = None, ""
        try:
            done = assessed(part.model, key[1])
            done = replace(done, look_alikes=tuple(guideviews.compare_parts(part, self._others, done.views)))
        except Exception as failure:  # told on the page
            error = str(failure)
        with self._lock:
            if self._key == key:
                self._done, self._error = done, error


def assessed(model: Model, view_range: ViewRange) -> Assessment:
    """Assess a model over a range of viewpoints.

    Raises:
        InputError: the range puts the camera inside the part.
    """
    views = guideviews.assessed_guide_views(model, view_range)
    return Assessment(views, guideviews.assess(views))


def advice(part: Part, whole: Model) -> list[dict[str, Any]]:
    """Changes that make the guide views of a part better, the best first, each with the score it reaches.

    Tried are: including what is left out, leaving one of the largest components out, and narrower ranges of viewpoints.

    Args:
        part: as it is set up.
        whole: model of the whole CAD file.
    """
    view_range = part.effective_view_range
    now = assessed(part.model, view_range).unique.score
    tried: list[dict[str, Any]] = []

    def attempt(text: str, model: Model, over: ViewRange, edit: dict[str, Any]) -> None:
        score = assessed(model, over).unique.score
        if score > now + 0.02:
            tried.append({"text": text, "score": score, "edit": edit})

    ignored = [settings.name for settings in part.settings if settings.role == "ignore"]
    if ignored:
        edit = {"kind": "component", "names": ignored, "key": "role", "value": "inspect"}
        attempt(f"include {_listed(ignored)}", whole, view_range, edit)
    for name in _largest(part)[:MAX_LEFT_OUT]:
        kept = tuple(component for component in part.model.components if component.name != name)
        edit = {"kind": "component", "names": [name], "key": "role", "value": "ignore"}
        attempt(f"leave out {name}", make_model(part.model.name, kept), view_range, edit)
    for text, elevation in (("only from above", (10.0, 90.0)), ("only from above, not steeply", (15.0, 70.0))):
        low = max(elevation[0], view_range.elevation_deg[0])
        high = min(elevation[1], view_range.elevation_deg[1])
        if low < high and (low, high) != view_range.elevation_deg:
            over = ViewRange(
                view_range.distance_mm, (low, high), view_range.azimuth_deg, view_range.roll_deg, up=view_range.up
            )
            value = {
                "distance_mm": list(over.distance_mm),
                "elevation_deg": [low, high],
                "azimuth_deg": list(over.azimuth_deg),
                "roll_deg": list(over.roll_deg),
            }
            attempt(
                f"look {text}: elevation {low:g} to {high:g}°", part.model, over, {"kind": "view_range", "value": value}
            )
    return sorted(tried, key=lambda row: -float(row["score"]))


def _largest(part: Part) -> list[str]:
    """Components other than the base, the largest first; none where the part would be empty without one."""
    base = {settings.name for settings in part.settings if settings.role == "base"}
    others = [component for component in part.model.components if component.name not in base]
    if len(part.model.components) < 3:
        return []
    sizes = [float(np.linalg.norm(np.ptp(component.vertices_in_model, axis=0))) for component in others]
    return [others[index].name for index in np.argsort(sizes)[::-1]]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
