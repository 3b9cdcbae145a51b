"""Choice of the views of a video for calibration: sharp, still, and together with the most information on the camera.

Each view carries information on the intrinsics, with its own pose unknown; views are chosen one after the other such
that the determinant of the information grows most (D-optimal design, Fedorov 1972). This prefers tilted views, views
near the picture's corners and views at different distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from arview.calibration.board_view import BoardView
from arview.calibration.projection import PARAMETERS_OF, CalibratedLens, intrinsics_of, pose_of_board
from arview.calibration.solve import MIN_VIEWS, information, solve
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array

MAX_ERROR_RATIO = 2.0
"""Largest expected error (blur, motion) of a view, relative to the median."""
MIN_SEPARATION = 0.02
"""Share of the picture's diagonal; of views nearer to each other the better one is kept."""
INITIAL_VIEWS = 25
"""Views for the first camera, with which the information of all views is computed."""


@dataclass(frozen=True)
class ChoiceOptions:
    """Number of views, and which views are excluded from the choice."""

    max_views: int = 40  # more reduce the noise, but not the errors of the lens model
    candidates: int = 160  # views from which the choice is made

    def __post_init__(self) -> None:
        if self.max_views < MIN_VIEWS or self.candidates < self.max_views:
            raise InputError(f"choice of views: expected at least {MIN_VIEWS} views, chosen from no fewer candidates")


def choose_views(
    views: Sequence[BoardView],
    width: int,
    height: int,
    options: ChoiceOptions | None = None,
    lens: CalibratedLens = CalibratedLens.BROWN,
) -> tuple[list[BoardView], dict[str, str]]:
    """The views to calibrate from, in their order, and why others are left out, by name.

    Args:
        views: all views of the board.
        width, height: of the sensor's picture, px.
        options: see `ChoiceOptions`.
        lens: model of the lens.

    Raises:
        InputError: no camera explains the views at all.
    """
    options = options or ChoiceOptions()
    if len(views) <= options.max_views:
        return list(views), {}
    rejected: dict[str, str] = {}
    expected = np.array([view.sigma_px for view in views])
    limit = MAX_ERROR_RATIO * float(np.median(expected))
    outlines = [_outline(view) for view in views]
    kept: list[int] = []
    diagonal = float(np.hypot(width, height))
    for i in np.argsort(expected):
        name = views[i].name
        if expected[i] > limit:
            rejected[name] = "is blurred, or the board moves"
        elif any(np.max(np.abs(outlines[i] - outlines[k])) < MIN_SEPARATION * diagonal for k in kept):
            rejected[name] = "shows the board where a better view has it"
        elif len(kept) < options.candidates:
            kept.append(int(i))
        else:
            rejected[name] = "there are better views"
    if len(kept) > options.max_views:
        chosen = _max_information([views[i] for i in kept], [outlines[i] for i in kept], (width, height), options, lens)
        rejected |= {views[i].name: "adds little to the others" for k, i in enumerate(kept) if k not in chosen}
        kept = [kept[k] for k in chosen]
    return [views[i] for i in sorted(kept)], rejected


def _max_information(
    views: list[BoardView],
    outlines: list[Array],
    size: tuple[int, int],
    options: ChoiceOptions,
    lens: CalibratedLens,
) -> list[int]:
    """Indices of the views that together have the most information, chosen greedily."""
    camera = solve([views[k] for k in _spread(outlines, INITIAL_VIEWS)], *size, lens=lens).camera
    shares = np.array([_information(view, camera) for view in views])
    # Prior information: the order of magnitude of the intrinsics.
    side = float(max(size))
    spread = {"fx": side, "fy": side, "cx": 0.2 * side, "cy": 0.2 * side, "p1": 0.05, "p2": 0.05}
    known = np.diag([spread.get(name, 1.0) ** -2.0 for name in PARAMETERS_OF[lens]])
    chosen: list[int] = []
    for _ in range(options.max_views):
        gain = np.linalg.slogdet(known + shares)[1]
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        known = known + shares[best]
    return chosen


def _information(view: BoardView, camera: Camera) -> Array:
    """(P,P) information on the intrinsics of one view, with its pose unknown; none where no pose is found."""
    pose = pose_of_board(view.points_in_board, view.pixels, camera)
    if pose is None:
        return np.zeros((len(intrinsics_of(camera)),) * 2)
    return information(view, camera, pose)[0] / view.sigma_px**2


def _outline(view: BoardView) -> Array:
    """(4,2) px of the corners of a 200 mm square of the board, by a homography: a summary of the board's pose."""
    found, _ = cv2.findHomography(view.points_in_board[:, :2], view.pixels)
    square = np.array([[[0.0, 0.0], [200.0, 0.0], [200.0, 200.0], [0.0, 200.0]]])
    if found is None:
        return np.asarray(view.pixels[[0, -1, 0, -1]])
    return np.asarray(cv2.perspectiveTransform(square, found)[0])


def _spread(outlines: list[Array], count: int) -> list[int]:
    """Indices of views far apart from each other: each is the one farthest from those before."""
    flat = np.array([outline.ravel() for outline in outlines])
    chosen = [0]
    distance = np.linalg.norm(flat - flat[0], axis=1)
    while len(chosen) < min(count, len(flat)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
    return chosen
