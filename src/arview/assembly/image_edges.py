"""Thin edges of a picture, and which component's edges pass where.

Thin edges are Canny's (PAMI 1986) without hysteresis, of the channel with the strongest slope.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel

ALIGNED = 14600
"""An edge has the direction of a point's normal when their product, both in 127ths, is above this: within 25°."""
MARKED_PX = 2
"""Pixels around an edge point that are marked as its component's."""
NOBODYS, SHARED = -1, -2
"""Owners of pixels at which no component's edges pass, and those of several."""


class EdgePicture(NamedTuple):
    """A picture and the working memory of its edges.

    Attributes:
        image: (H,W,3) uint8, smoothed.
        slopes: (6,H,W) int16 Sobel slopes to the right and down of each channel, eighths of a grey level per px.
        gradient: (3,H,W) float32, becomes the slope of the strongest channel, its part to the right and down.
        strength: (H,W) uint8, becomes the slope of thin edges in half grey levels per px, 0 elsewhere.
        directions: (2,H,W) int8, becomes 127 times the unit vector along the slope.
        owners: (H,W) int16, becomes the component whose edges pass there.
    """

    image: NDArray[np.uint8]
    slopes: NDArray[np.int16]
    gradient: NDArray[np.float32]
    strength: NDArray[np.uint8]
    directions: NDArray[np.int8]
    owners: NDArray[np.int16]


class EdgePictures:
    """Makes `EdgePicture`s; all share one working memory, which is valid until the next is made."""

    def __init__(self) -> None:
        self._buffers: dict[str, NDArray[Any]] = {}

    def of(self, image: NDArray[np.uint8]) -> EdgePicture:
        """Smooth (H,W,3) RGB and take its slopes; `find_thin_edges` and `mark_owners` fill the rest."""
        shape = image.shape[:2]
        smooth = cv2.GaussianBlur(image, (3, 3), 0, dst=self._buffer("smooth", image.shape, np.uint8))
        slopes = self._buffer("slopes", (6, *shape), np.int16)
        for index, plane in enumerate(cv2.split(smooth)):
            cv2.spatialGradient(plane, dx=slopes[2 * index], dy=slopes[2 * index + 1])
        return EdgePicture(
            image=np.asarray(smooth, dtype=np.uint8),
            slopes=slopes,
            gradient=self._buffer("gradient", (3, *shape), np.float32),
            strength=self._buffer("strength", shape, np.uint8),
            directions=self._buffer("directions", (2, *shape), np.int8),
            owners=self._buffer("owners", shape, np.int16),
        )

    def _buffer(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """An array kept between pictures: allocating it takes longer than the work done in it."""
        size = int(np.prod(shape))
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = np.empty(size, dtype=dtype)
        return self._buffers[name][:size].reshape(shape)


@kernel(fastmath=True)
def find_thin_edges(picture: EdgePicture, min_slope: float) -> None:
    """Fill the gradient, strength and directions of an `EdgePicture` with edges of at least a slope.

    The slope is that of the strongest channel; an edge is thin where it is largest along its own direction.
    """
    slopes, edges, strength, directions = picture.slopes, picture.gradient, picture.strength, picture.directions
    height, width = strength.shape
    for y in range(height):
        for x in range(width):
            du, dv = np.float32(slopes[0, y, x]), np.float32(slopes[1, y, x])
            eu, ev = np.float32(slopes[2, y, x]), np.float32(slopes[3, y, x])
            fu, fv = np.float32(slopes[4, y, x]), np.float32(slopes[5, y, x])
            best, second, third = du * du + dv * dv, eu * eu + ev * ev, fu * fu + fv * fv
            if second > best:
                best, du, dv = second, eu, ev
            if third > best:
                best, du, dv = third, fu, fv
            edges[0, y, x] = np.sqrt(best)
            edges[1, y, x] = du
            edges[2, y, x] = dv
    strength[:] = 0
    size = edges[0]
    lowest = np.float32(8.0 * min_slope)
    # Rows are sliced so that neighbours share an index, and there are no branches: this is vectorised, ten times
    # faster.
    for y in range(2, height - 2):
        up_left, up, up_right = size[y - 1, 1:], size[y - 1, 2:], size[y - 1, 3:]
        left, here, right = size[y, 1:], size[y, 2:], size[y, 3:]
        down_left, down, down_right = size[y + 1, 1:], size[y + 1, 2:], size[y + 1, 3:]
        along_u, along_v, found = edges[1, y, 2:], edges[2, y, 2:], strength[y, 2:]
        direction_u, direction_v = directions[0, y, 2:], directions[1, y, 2:]
        for x in range(width - 4):
            a, b, c, d = up_left[x], up[x], up_right[x], left[x]
            e, f, g, h = right[x], down_left[x], down[x], down_right[x]
            m, du, dv = here[x], along_u[x], along_v[x]
            size_u, size_v = abs(du), abs(dv)
            is_falling, is_flat = du * dv > 0, size_u > size_v
            large, small = max(size_u, size_v), min(size_u, size_v)
            # Slopes on both sides across the edge, interpolated between two pixels each.
            forward = (h if is_falling else (c if is_flat else f)) * small + (e if is_flat else g) * (large - small)
            backward = (a if is_falling else (f if is_flat else c)) * small + (d if is_flat else b) * (large - small)
            is_edge = (m * large >= forward) & (m * large > backward) & (m >= lowest)
            value = min(np.float32(255.0), np.float32(0.25) * m)
            found[x] = np.uint8(np.int32(value if is_edge else np.float32(0.0)))
            unit = np.float32(127.0) / max(m, np.float32(1.0))
            direction_u[x] = np.int8(np.int32(du * unit))
            direction_v[x] = np.int8(np.int32(dv * unit))


@kernel
def mark_owners(
    pixels: NDArray[np.float64],
    depths: NDArray[np.float64],
    component: NDArray[np.int16],
    is_left_out: NDArray[np.bool_],
    owners: NDArray[np.int16],
) -> None:
    """Set ``owners`` (H,W) int16 to the component whose edges pass within two pixels, or `NOBODYS` or `SHARED`.

    Edges of components that are left out (C,) are nobody's.
    """
    height, width = owners.shape
    owners[:] = NOBODYS
    for i in range(pixels.shape[0]):
        if depths[i] <= 0 or is_left_out[component[i]]:
            continue
        x0, y0 = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        for y in range(max(0, y0 - MARKED_PX), min(height, y0 + MARKED_PX + 1)):
            for x in range(max(0, x0 - MARKED_PX), min(width, x0 + MARKED_PX + 1)):
                if owners[y, x] == NOBODYS:
                    owners[y, x] = component[i]
                elif owners[y, x] != component[i]:
                    owners[y, x] = SHARED


@kernel
def strength_at(
    directions: NDArray[np.int8],
    strength: NDArray[np.uint8],
    owners: NDArray[np.int16],
    c: int,
    places: NDArray[np.int64],
    normal: NDArray[np.int64],
    dx: int,
    dy: int,
    lowest: int,
) -> Any:
    """Strongest edge within 25° of a normal at three places (3,2), shifted; edges of other components do not count.

    ``normal`` (2,) is in 127ths. Edges at pixels of nobody count; those at shared ones only if ``lowest`` is
    `SHARED`. There are no branches on the edges, because they cannot be predicted.
    """
    height, width = strength.shape
    best = np.int64(0)
    for t in range(3):
        x, y = places[t, 0] + dx, places[t, 1] + dy
        if x < 0 or y < 0 or x >= width or y >= height:
            continue
        owner = owners[y, x]
        along = abs(directions[0, y, x] * normal[0] + directions[1, y, x] * normal[1])
        counts = (along > ALIGNED) & (((owner < 0) & (owner >= lowest)) | (owner == c))
        best = max(best, np.int64(strength[y, x]) * counts)
    return best
