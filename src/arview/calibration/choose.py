"""Which views of a video to calibrate from: sharp, still, and together telling most about the camera.

Each view brings information on the intrinsics, its own pose taken as unknown; views are taken one after the other so
that the determinant of what is known grows most (D-optimal design, Fedorov 1972). Tilted views, views near the
picture's corners and views from other distances come out first by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from arview.calibration.solve import SolveOptions, information, solve
from arview.calibration.views import BoardView
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array, rigid


@dataclass(frozen=True)
class ChoiceOptions:
    """How many views, and which are not worth looking at."""

    most: int = 40  # more make the noise smaller, but not what the model of the lens leaves out
    worse: float = 2.0  # times the median expected error of a corner (blur, motion): left out
    apart: float = 0.02  # of the diagonal: views nearer to each other show the same, the better one stays
    candidates: int = 160  # views the choice is made from
    first: int = 25  # views of the first camera, by which the information of the others is told

    def __post_init__(self) -> None:
        if self.most < SolveOptions.min_views or self.candidates < self.most or not self.worse > 1:
            raise InputError(f"choice of views: expected at least {SolveOptions.min_views} views and worse above 1")


def choose_views(
    views: Sequence[BoardView], width: int, height: int, options: ChoiceOptions | None = None
) -> tuple[list[BoardView], dict[str, str]]:
    """The views to calibrate from, in their order, and in words why others are left out.

    Raises:
        InputError: no camera explains the views at all.
    """
    options = options or ChoiceOptions()
    if len(views) <= options.most:
        return list(views), {}
    rejected: dict[str, str] = {}
    expected = np.array([view.sigma_px for view in views])
    limit = options.worse * float(np.median(expected))
    outlines = [_outline(view) for view in views]
    kept: list[int] = []
    diagonal = float(np.hypot(width, height))
    for i in np.argsort(expected):
        name = views[i].name
        if expected[i] > limit:
            rejected[name] = "is blurred, or the board moves in it"
        elif any(np.max(np.abs(outlines[i] - outlines[k])) < options.apart * diagonal for k in kept):
            rejected[name] = "shows the board where a better view has it"
        elif len(kept) < options.candidates:
            kept.append(int(i))
        else:
            rejected[name] = "there are better views"
    if len(kept) > options.most:
        chosen = _max_information([views[i] for i in kept], [outlines[i] for i in kept], width, height, options)
        rejected |= {views[i].name: "adds little to the others" for k, i in enumerate(kept) if k not in chosen}
        kept = [kept[k] for k in chosen]
    return [views[i] for i in sorted(kept)], rejected


def _max_information(
    views: list[BoardView], outlines: list[Array], width: int, height: int, options: ChoiceOptions
) -> list[int]:
    camera = solve([views[k] for k in _spread(outlines, options.first)], width, height).camera
    shares = np.array([_information(view, camera) for view in views])
    # What is known before any view: the order of magnitude of a lens.
    side = float(max(width, height))
    known = np.diag(1.0 / np.array([side, side, 0.2 * side, 0.2 * side, 1.0, 1.0, 0.05, 0.05, 1.0]) ** 2)
    chosen: list[int] = []
    for _ in range(options.most):
        gain = np.linalg.slogdet(known + shares)[1]
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        known = known + shares[best]
    return chosen


def _information(view: BoardView, camera: Camera) -> Array:
    _, turn, shift = cv2.solvePnP(view.points_in_board, view.pixels, camera.matrix, camera.dist)
    pose = rigid(cv2.Rodrigues(turn)[0], np.asarray(shift).ravel())
    return information(view, camera, pose)[0] / view.sigma_px**2


def _outline(view: BoardView) -> Array:
    """(4,2) px where the corners of a 200 mm square of the board are, by a homography: where and how it is held."""
    found, _ = cv2.findHomography(view.points_in_board[:, :2], view.pixels)
    square = np.array([[[0.0, 0.0], [200.0, 0.0], [200.0, 200.0], [0.0, 200.0]]])
    if found is None:
        return np.asarray(view.pixels[[0, -1, 0, -1]])
    return np.asarray(cv2.perspectiveTransform(square, found)[0])


def _spread(outlines: list[Array], count: int) -> list[int]:
    """Views far apart from each other: each the farthest from those before."""
    flat = np.array([outline.ravel() for outline in outlines])
    chosen = [0]
    distance = np.linalg.norm(flat - flat[0], axis=1)
    while len(chosen) < min(count, len(flat)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
    return chosen
