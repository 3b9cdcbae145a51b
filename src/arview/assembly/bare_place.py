"""What one picture shows at the place of a component: the bare base, or something else.

A component whose edges are not found is absent or occluded. Where it is absent, the picture shows what it would hide:
the surface of the components that are known to be there, in the colours of the same faces beside it. A hand or a tool
has other colours, and also interrupts the edges around.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.assembly.edge_support import FoundPoints
from arview.core.fits import robust_sigma
from arview.geometry import Array
from arview.guideviews import Surface, draw_surface
from arview.refinement import project

BORDER_PX = 2
"""Pixels this near to a drawn edge are not compared, because the pose is not exact."""
MIN_PIXELS = 12
"""Pixels of a place, or of a reference, with fewer of which it says nothing."""
REACH_PX = (10.0, 40.0)
"""Smallest and largest distance from a place at which the same face is its reference."""
BRIDGED_PX = 6.0
"""Pixels beside a place, many of them near an edge and not compared, that do not part it from what goes on there."""
NORMAL_STEPS = 4.0
"""Steps per unit in which normals are rounded to group pixels into faces."""
MAX_DEVIATIONS = 3.0
"""Standard deviations up to which a pixel has the colour of its reference."""
NOISE = 3.0
"""Smallest standard deviation in grey levels."""
SHADING = 0.04
"""Share of the brightness that is added to ``NOISE``."""
MAX_NOISE = 16.0
"""Largest standard deviation; on a base with more texture few pixels match."""
MAX_SMOOTHER = 2.0
"""Factor by which the brightness of a place may vary less than that of its reference."""
MIN_BEHIND = 6
"""Edge points behind a place with fewer of which nothing is known."""
AROUND_PX = 60.0
"""Distance from a place up to which edge points are around it."""
AROUND_POINTS = 24
"""Points around a place that count, the nearest."""
MIN_AROUND = 8
"""With fewer of them nothing is known."""


class BarePlaces(NamedTuple):
    """What is seen at the place of each component; all (C,), -1 where too little can be compared.

    Attributes:
        bare: share of the pixels that have the colour of the surface that the component would hide.
        coverage: share of the component's pixels that can be compared; the others have no such surface behind them.
        ring: share of the reference pixels beside the place that have the colour of their face elsewhere.
        around: share of trusted components' edge points near the place that lie on image edges.
        behind: the same of the base's edge points that the component would hide.
        extent: how far what is not as it should be goes on beside the place, in reaches of the reference.
    """

    bare: Array
    coverage: Array
    ring: Array
    around: Array
    behind: Array
    extent: Array


class _Colours(NamedTuple):
    """Median and standard deviation (3,) of brightness and two colour differences of some pixels."""

    median: Array
    deviation: Array


class _Drawing(NamedTuple):
    """Component (H,W) that is seen, -1: none, a number for it and its normal (H,W), and the rounded normals (3,H,W)."""

    owners: NDArray[np.int16]
    faces: NDArray[np.int64]
    normals: NDArray[np.int64]


class BarePlaceMeter:
    """Measures `BarePlaces` in pictures of one part.

    Args:
        surface: of the part, about its centre.
        count: of its components.
        diameter_mm: of the part.
    """

    def __init__(self, surface: Surface, count: int, diameter_mm: float) -> None:
        self._surface, self._count, self._diameter_mm = surface, count, diameter_mm

    def measure(
        self,
        image: NDArray[np.uint8],
        cam_from_body: Array,
        intrinsics: Array,
        is_wanted: NDArray[np.bool_],
        is_trusted: NDArray[np.bool_],
        is_absent: NDArray[np.bool_],
        edge_points: FoundPoints,
        behind: FoundPoints,
    ) -> BarePlaces:
        """What is seen at the places of some components.

        Args:
            image: (H,W,3) RGB, the picture around the part.
            cam_from_body: (4,4) pose about the model's centre.
            intrinsics: (10,) of the picture; of its distortion only the shift of the part's centre is used.
            is_wanted: (C,) components whose place is looked at.
            is_trusted: (C,) components that are there.
            is_absent: (C,) components that are not there: they hide nothing.
            edge_points: of trusted components.
            behind: of the base alone.
        """
        places = BarePlaces(*np.full((6, self._count), -1.0))
        if not is_wanted.any():
            return places
        shape = image.shape[:2]
        nominal = self._draw(cam_from_body, intrinsics, shape, ~is_absent | is_wanted)
        bare = self._draw(cam_from_body, intrinsics, shape, is_trusted)
        smooth = _opponent_colours(cv2.GaussianBlur(image, (3, 3), 0))
        is_sure = (nominal.owners == bare.owners) & (bare.owners >= 0) & (nominal.faces == bare.faces)
        is_sure &= _is_inner(nominal, BORDER_PX)
        is_inner = _is_inner(bare, BORDER_PX)
        colours = self._face_colours(smooth, bare.faces, is_sure)
        for c in np.flatnonzero(is_wanted):
            place = nominal.owners == c
            rows, columns = np.flatnonzero(place.any(axis=1)), np.flatnonzero(place.any(axis=0))
            if len(rows) == 0:
                continue
            margin = int(AROUND_PX)
            low = np.maximum([rows[0] - margin, columns[0] - margin], 0)
            window = np.s_[low[0] : rows[-1] + margin + 1, low[1] : columns[-1] + margin + 1]
            distance = cv2.distanceTransform((~place[window]).astype(np.uint8), cv2.DIST_L2, 3)
            places.around[c] = self._around(distance, edge_points, low[::-1])
            places.behind[c] = self._behind(place, behind)
            inside = cv2.erode(place[window].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            inside = inside if np.count_nonzero(inside) >= MIN_PIXELS else place[window]
            compared = inside & is_inner[window] & (bare.owners[window] >= 0)
            places.coverage[c] = np.count_nonzero(compared) / max(int(np.count_nonzero(inside)), 1)
            if np.count_nonzero(compared) >= MIN_PIXELS:
                places.bare[c], places.ring[c], places.extent[c] = self._compare(
                    smooth[window], bare.faces[window], compared, is_sure[window], distance, colours
                )
        return places

    def _draw(
        self, cam_from_body: Array, intrinsics: Array, shape: tuple[int, ...], is_drawn: NDArray[np.bool_]
    ) -> _Drawing:
        """The surface of some components."""
        surface, (height, width) = self._surface, shape[:2]
        if not is_drawn.all():
            kept = is_drawn[surface.component]
            surface = surface._replace(
                faces=surface.faces[kept], normals=surface.normals[kept], component=surface.component[kept]
            )
        drawn = np.empty((4, height, width), dtype=np.float32)
        face_ids = np.empty((height, width), dtype=np.int32)
        x, y, z = cam_from_body[:3, 3].tolist()
        origin = np.array(project(x, y, z, intrinsics))
        draw_surface(surface, cam_from_body, intrinsics[:2], origin, self._diameter_mm, drawn, face_ids)
        steps = NORMAL_STEPS
        rounded = np.round(steps * drawn[:3]).astype(np.int64) + 8
        owners = np.where(face_ids >= 0, surface.component[face_ids], -1).astype(np.int16)
        faces = ((owners.astype(np.int64) * 32 + rounded[0]) * 32 + rounded[1]) * 32 + rounded[2]
        return _Drawing(owners, np.where(owners >= 0, faces, -1), rounded)

    def _face_colours(
        self, image: NDArray[np.float32], faces: NDArray[np.int64], is_sure: NDArray[np.bool_]
    ) -> dict[int, _Colours]:
        """Colours of each face of which enough is surely seen."""
        if not is_sure.any():
            return {}
        numbers, pixels = faces[is_sure], image[is_sure]
        order = np.argsort(numbers, kind="stable")
        values, starts = np.unique(numbers[order], return_index=True)
        groups = np.split(pixels[order], starts[1:])
        enough = 3 * MIN_PIXELS
        return {
            int(value): self._colours(group)
            for value, group in zip(values, groups, strict=True)
            if len(group) >= enough
        }

    def _colours(self, pixels: NDArray[np.float32]) -> _Colours:
        pixels = pixels[:: max(1, len(pixels) // 2000)]
        median = np.median(pixels.astype(np.float64), axis=0)
        deviation = np.array([robust_sigma(channel) for channel in (pixels - median).T])
        return _Colours(median, np.clip(deviation, NOISE + SHADING * abs(float(median[0])), MAX_NOISE))

    def _compare(
        self,
        image: NDArray[np.float32],
        faces: NDArray[np.int64],
        compared: NDArray[np.bool_],
        is_sure: NDArray[np.bool_],
        distance: NDArray[np.float32],
        colours: dict[int, _Colours],
    ) -> tuple[float, float, float]:
        """Shares `bare` and `ring` of one place, weighted by the pixels of the faces behind it, and its `extent`; -1
        without reference.

        Args:
            image, faces, compared, is_sure, distance: (H,W) around the place: colours, faces behind it, its pixels,
                pixels that surely show their face, distance from the place.
            colours: of each face.
        """
        reach = float(np.clip(0.8 * np.sqrt(np.count_nonzero(compared)), *REACH_PX))
        beside = is_sure & (distance > 2.0) & (distance < reach)
        bare, like, ring, ringed, weight = 0.0, 0.0, 0.0, 0.0, 0.0
        strange = (distance < BRIDGED_PX).astype(np.uint8)
        values, counts = np.unique(faces[compared], return_counts=True)
        for value, count in zip(values, counts, strict=True):
            everywhere = colours.get(int(value))
            if everywhere is None:
                continue
            is_near = beside & (faces == value)
            near = image[is_near]
            used = everywhere
            if len(near) >= MIN_PIXELS:
                is_like = _is_like(near, everywhere, MAX_DEVIATIONS)
                strange[is_near] = ~is_like
                ring += count * float(np.mean(is_like))
                ringed += count
                local = self._colours(near)
                apart = np.abs(local.median - everywhere.median) / everywhere.deviation
                used = local if apart.max() < MAX_DEVIATIONS else everywhere
            pixels = image[compared & (faces == value)]
            is_like = _is_like(pixels, used, MAX_DEVIATIONS)
            like += count * float(np.mean(is_like))
            bare += count * float(np.mean(is_like)) * self._texture_match(pixels, everywhere)
            weight += count
        if weight < max(MIN_PIXELS, 0.3 * np.count_nonzero(compared)):
            return -1.0, -1.0, -1.0
        # Single pixels of another colour are noise; a hand or a tool is connected with the place, and goes on.
        joined = cv2.connectedComponents(cv2.morphologyEx(strange, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))[1]
        goes_on = distance[np.isin(joined, joined[(distance == 0.0) & (joined > 0)])]
        # What differs in its texture alone has no border.
        extent = 1.0 if like > 0.5 * weight > bare else float(np.max(goes_on, initial=0.0)) / reach
        return bare / weight, ring / ringed if ringed > 0 else -1.0, extent

    def _texture_match(self, pixels: NDArray[np.float32], colours: _Colours) -> float:
        """1 where the brightness of some pixels (N,3) varies like that of their face, less where it is smoother."""
        deviation = robust_sigma(pixels[:, 0] - np.median(pixels[:, 0])) + 1.0
        reference = float(colours.deviation[0])
        if reference < 2.0 * NOISE:
            return 1.0
        return float(np.clip(MAX_SMOOTHER * deviation / reference, 0.0, 1.0))

    def _behind(self, place: NDArray[np.bool_], points: FoundPoints) -> float:
        """Share of edge points inside a place (H,W) that were found; -1 where there are too few."""
        pixels = np.round(points.pixels).astype(np.intp)
        is_inside = place[pixels[:, 1], pixels[:, 0]]
        if np.count_nonzero(is_inside) < MIN_BEHIND:
            return -1.0
        return float(np.mean(points.is_found[is_inside]))

    def _around(self, distance: NDArray[np.float32], edge_points: FoundPoints, corner: NDArray[np.intp]) -> float:
        """Share of the nearest trusted edge points that were found; -1 where there are too few."""
        pixels, is_found = edge_points.pixels, edge_points.is_found
        places = np.round(pixels).astype(np.intp) - corner
        inside = ((places >= 0) & (places < distance.shape[::-1])).all(axis=1)
        away = distance[places[inside, 1], places[inside, 0]]
        near = away < AROUND_PX
        if np.count_nonzero(near) < MIN_AROUND:
            return -1.0
        nearest = np.argsort(away[near], kind="stable")[:AROUND_POINTS]
        return float(np.mean(is_found[inside][near][nearest]))


def _opponent_colours(image: NDArray[Any]) -> NDArray[np.float32]:
    """(H,W,3) brightness, red less green and yellow less blue: a texture varies mostly in brightness."""
    red, green, blue = np.moveaxis(np.asarray(image, dtype=np.float32), 2, 0)
    return np.stack([(red + green + blue) / 3.0, red - green, 0.5 * (red + green) - blue], axis=2)


def _is_like(pixels: NDArray[np.float32], colours: _Colours, max_deviations: float) -> NDArray[np.bool_]:
    """(N,) which of some pixels (N,3) have the colours."""
    apart = np.max(np.abs(pixels - colours.median) / colours.deviation, axis=1)
    return np.asarray(apart < max_deviations)


def _is_inner(drawing: _Drawing, border_px: int) -> NDArray[np.bool_]:
    """Pixels (H,W) not near a border between components or an edge between faces."""
    owners, normals = drawing.owners, drawing.normals
    is_border = np.zeros(owners.shape, dtype=np.uint8)
    for before, after in ((np.s_[..., :-1, :], np.s_[..., 1:, :]), (np.s_[..., :-1], np.s_[..., 1:])):
        turn = np.abs(normals[before] - normals[after]).max(axis=0)
        is_border[before] |= (owners[before] != owners[after]) | (turn > 1)
    kernel = np.ones((2 * border_px + 1, 2 * border_px + 1), np.uint8)
    return np.asarray(cv2.dilate(is_border, kernel) == 0)
