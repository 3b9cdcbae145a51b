"""Contact sheet of a guide-view set: the features of its views, and which views are weak."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.errors import InputError
from arview.geometry import apply
from arview.guideviews.findings import azimuths_deg, confusable_pair, elevations_deg
from arview.guideviews.uniqueness import CONFUSABLE_LIKENESS, PLAIN_LINES, Uniqueness, assess
from arview.guideviews.views import GuideViewSet
from arview.rendering import EDGE_SHARP, ZBufferRenderer

PAPER = (250, 250, 250)
INK = (40, 40, 40)
CONTOUR_COLOR = (0, 150, 60)
SHARP_COLOR = (215, 35, 30)
EDGE_COLOR = (60, 110, 235)
PLAIN_COLOR = (190, 120, 0)
CONFUSABLE_COLOR = (150, 30, 140)
"""RGB of a view that may be confused with another one."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def contact_sheet(
    model: Model,
    views: GuideViewSet,
    columns: int = 8,
    tile_px: int = 160,
    max_views: int = 48,
    unique: Uniqueness | None = None,
) -> NDArray[np.uint8]:
    """A picture (H,W,3) uint8 RGB of evenly chosen views.

    Each tile shows the shaded part with its contour points in green, design edges in red and other edges in blue, and
    below it azimuth, elevation, the number of distinct lines and the likeness to the most similar view from another
    side. Plain and confusable views have a frame and a label.

    Args:
        model: the model of the views.
        views: the set.
        columns: tiles in a row.
        tile_px: side of the picture in a tile, at least 100.
        max_views: largest number of tiles.
        unique: assessment of these views, if there is one already.

    Raises:
        InputError: a size is too small.
    """
    if columns < 1 or tile_px < 100 or max_views < 1:
        raise InputError(f"contact sheet: columns {columns}, tile_px {tile_px}, max_views {max_views}: too small")
    unique = assess(views) if unique is None else unique
    order = np.lexsort((azimuths_deg(views), -np.round(elevations_deg(views) / 15.0)))
    count = min(max_views, len(views))
    chosen = order[((np.arange(count) + 0.5) * len(views) / count).astype(np.intp)]
    renderer = ZBufferRenderer(model, views.camera.scaled(2 * tile_px, 2 * tile_px))
    tiles = [view_tile(renderer, views, int(index), unique, tile_px) for index in chosen]
    columns = min(columns, count)
    height, width = tiles[0].shape[:2]
    rows = -(-count // columns)
    gap = 6
    head = _head(views, unique, count, columns * (width + gap) + gap)
    sheet = np.full((head.shape[0] + rows * (height + gap) + gap, head.shape[1], 3), PAPER, dtype=np.uint8)
    sheet[: head.shape[0]] = head
    for place, tile in enumerate(tiles):
        top = head.shape[0] + gap + (place // columns) * (height + gap)
        left = gap + (place % columns) * (width + gap)
        sheet[top : top + height, left : left + width] = tile
    return sheet


def view_tile(
    renderer: ZBufferRenderer, views: GuideViewSet, index: int, unique: Uniqueness, tile_px: int
) -> NDArray[np.uint8]:
    """A tile (tile_px + caption, tile_px, 3): one view and its caption."""
    view = views.view(index)
    camera = renderer.camera
    rendering = renderer.render(view.cam_from_model)
    picture = cv2.cvtColor(rendering.shaded(camera), cv2.COLOR_GRAY2RGB)
    f = view.features
    sharp = (f.edge_kinds & EDGE_SHARP) > 0
    for points, color in (
        (f.edge_points[~sharp], EDGE_COLOR),
        (f.edge_points[sharp], SHARP_COLOR),
        (f.contour_points, CONTOUR_COLOR),
    ):
        pixels = camera.project(apply(view.cam_from_model, points))
        for u, v in np.round(pixels * 8.0).astype(int):
            cv2.circle(picture, (int(u), int(v)), 11, color, -1, cv2.LINE_AA, 3)
    picture = cv2.resize(picture, (tile_px, tile_px), interpolation=cv2.INTER_AREA)

    words, frame = [], None
    if unique.distinct_lines[index] < PLAIN_LINES:
        words.append("PLAIN")
        frame = PLAIN_COLOR
    if unique.likeness[index] >= CONFUSABLE_LIKENESS:
        words.append("ALIKE")
        frame = CONFUSABLE_COLOR
    tile = np.full((tile_px + 34, tile_px, 3), 255, dtype=np.uint8)
    tile[:tile_px] = picture
    azimuth, elevation = round(azimuths_deg(views)[index]), round(elevations_deg(views)[index])
    likeness = unique.likeness[index]
    likeness_text = "-" if np.isnan(likeness) else f"{likeness:.2f}"
    _write(tile, f"az {azimuth} el {elevation}", (5, tile_px + 12), 0.36, INK)
    _write(tile, f"{unique.distinct_lines[index]:.0f} lines, like {likeness_text}", (5, tile_px + 27), 0.36, INK)
    cv2.rectangle(tile, (0, 0), (tile.shape[1] - 1, tile.shape[0] - 1), (215, 215, 215), 1)
    if frame is not None:
        cv2.rectangle(tile, (1, 1), (tile.shape[1] - 2, tile.shape[0] - 2), frame, 3)
        text = " ".join(words)
        (width, height), _ = cv2.getTextSize(text, _FONT, 0.36, 1)
        cv2.rectangle(tile, (0, 0), (width + 9, height + 9), frame, -1)
        _write(tile, text, (5, height + 4), 0.36, (255, 255, 255))
    return tile


def _head(views: GuideViewSet, unique: Uniqueness, shown: int, width: int) -> NDArray[np.uint8]:
    """Title, verdict and legend, with line breaks at the width."""
    scale = 0.42
    lines = [
        f"{views.model_name}: {shown} of {len(views)} guide views, "
        f"uniqueness {unique.score:.2f} (share of views neither plain nor alike)",
        unique.reason,
        confusable_pair(views, unique).replace("°", ""),
    ]
    broken = [piece for line in lines for piece in _wrapped(line, width - 16, scale)]
    entries = [
        (CONTOUR_COLOR, "contour points"),
        (SHARP_COLOR, "design edges"),
        (EDGE_COLOR, "other edges"),
        (PLAIN_COLOR, f"PLAIN: fewer than {PLAIN_LINES:.0f} distinct lines"),
        (CONFUSABLE_COLOR, f"ALIKE: likeness {CONFUSABLE_LIKENESS:.2f} or more to a view from elsewhere"),
    ]
    places, left, row = [], 8, 0
    for color, text in entries:
        span = cv2.getTextSize(text, _FONT, scale, 1)[0][0] + 34
        if left > 8 and left + span > width:
            left, row = 8, row + 1
        places.append((color, text, left, row))
        left += span
    head = np.full((18 * (len(broken) + row + 1) + 10, width, 3), PAPER, dtype=np.uint8)
    for number, line in enumerate(broken):
        _write(head, line, (8, 18 * (number + 1)), scale, INK)
    for color, text, left, row in places:
        base = 18 * (len(broken) + 1 + row)
        cv2.circle(head, (left + 5, base - 4), 5, color, -1, cv2.LINE_AA)
        _write(head, text, (left + 15, base), scale, INK)
    return head


def _wrapped(text: str, width: int, scale: float) -> list[str]:
    """The text in lines no wider than width px."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and cv2.getTextSize(longer, _FONT, scale, 1)[0][0] <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _write(
    image: NDArray[np.uint8], text: str, place: tuple[int, int], scale: float, color: tuple[int, int, int]
) -> None:
    """Write text, without the characters that the fonts of OpenCV do not have."""
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(image, plain, place, _FONT, scale, color, 1, cv2.LINE_AA)
