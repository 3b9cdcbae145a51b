"""Occluders: what lies before the part, as a hand or a tool, found by its colour against the appearance expected.

The colour of the surface is learned while the part is tracked, in cells of a grid that is fixed to the model. A pixel
whose colour differs from that of its cell, after the exposure of the frame is accounted for, or around which the ratio
of seen to expected brightness changes abruptly, belongs to an occluder if most of its neighbours do: light and shadows
change that ratio smoothly, the edges and highlights of a thing before the part do not. From there the occluder is
extended to its outline by a watershed of that ratio, as some of it may have the colour of the surface. The comparison
follows the background subtraction of Stauffer and Grimson ("Adaptive background mixture models for real-time tracking",
CVPR 1999), with one mode for each cell and the surface of the part as background. Occluders that were there before the
surface was seen, or of its colour throughout, are not found.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.camera import Camera
from arview.core.kernel import kernel
from arview.geometry import Array, invert
from arview.overlay.ghost import GhostView
from arview.overlay.paint import Image
from arview.pose import ComponentPresence, Visibility

_COLUMNS, _COUNT = 6, 5
"""Columns of the table of cells, and the one of the number of observations."""
_HIDDEN_FRAMES = 5
"""Frames after which a hidden component is called so, and after which it is not any longer."""
_HIDDEN_PX = 60
"""Visible pixels of a component's ghost from which on only something before the part can hide it."""
_HIDDEN_SHARE = 0.6
"""Share of these pixels that an occluder of a hidden component covers."""
_STEPS = (2, 3, 4, 6, 8, 12, 16)
"""Distances of the samples, px."""
_BORDER_LEVEL, _BORDER = np.uint8(250), 125
"""Level of an occluder between whose samples and others the border is interpolated, and the level of the border."""
_DARK = 12.0
"""Grey level of darker colours, which say nothing about the exposure."""
_MAX_CHANGE = 0.25
"""Logarithm of the largest change of exposure between two frames."""
_EXPOSURE_STRIDE = 5
"""Every so many samples are used for the exposure."""
_SQUARE = np.ones((3, 3), dtype=np.uint8)
_RATIO_OFFSET, _RATIO_LEVELS = np.float32(8.0), np.float32(120.0)
"""Grey levels added to both colours of a ratio, which damp noise in the dark, and levels of its logarithm."""
_SURFACE, _OCCLUDER, _BESIDE = 1, 2, 3
"""Markers of the watershed."""
_MIN_AGREEING = 0.1
"""Share of the samples that must agree on the exposure; with fewer it is taken to be as before."""


CELLS = 72
"""Cells of the grid along the longest side of the part."""
SAMPLES = 9000
"""Pixels that are compared in a frame, about."""
MIN_OBSERVATIONS = 6
"""Frames in which a cell was seen before it is compared."""
HUE_NOISE = 4.0
"""Standard deviation, in grey levels, of a colour of the same brightness, apart from what a cell shows."""
NOISE = 8.0
"""Standard deviation, in grey levels, of the brightness of the same colour, apart from what a cell shows."""
SHADE = 0.85
SHINE = 1.25
"""Factors of the brightness between which shading, shadows and reflections explain a difference."""
MAX_VARIANCE = 150.0
"""Largest variance of hue and brightness in a cell, squared grey levels; more would make it blind."""
MIN_SCORE = 1.0
"""Squared normalised difference of colours from which on a pixel looks like an occluder."""
SURE_SCORE = 6.0
"""Squared normalised difference of colours that some pixels of every occluder must reach."""
MIN_CONTRAST = 0.25
"""Standard deviation, among neighbours, of the logarithm of seen to expected brightness from which on there is an edge
that the surface does not have."""
MIN_SHARE = 0.6
"""Share of neighbours that must look like an occluder, too."""
MIN_SAMPLES = 10
"""Samples that an occluder has at least."""
MIN_SURE_SHARE = 0.15
"""Share of an occluder's samples that must be sure."""
REACH = 6
"""Distance, in samples, up to which an occluder is extended to its outline."""
MIN_MISMATCH = 2.5
"""Root mean square of the logarithm of seen to expected colour in a gap of an occluder, in standard deviations of the
surface, from which on the gap belongs to it: the surface between two fingers agrees."""
MIN_SURFACE_NOISE = 0.02
"""Smallest standard deviation of a surface's logarithmic colour in ``MIN_MISMATCH``."""
RATE = 0.04
"""Weight of a new colour in a cell that was seen often."""
OCCLUDED_RATE = 0.002
"""Weight of a new colour where an occluder was found: what stays is learned in the end."""


class OccluderFinder:
    """Finds occluders in the frames of one video; see the module."""

    def __init__(self, model: Model, camera: Camera) -> None:
        low, high = model.bounds_in_model
        self._cell_mm = float((high - low).max()) / CELLS
        self._origin = low - 0.5 * self._cell_mm
        shape = np.ceil((high - low) / self._cell_mm).astype(np.int64) + 2
        # Mean red, green and blue, variances of hue and brightness, and the number of observations.
        self._cells = np.zeros((*shape, _COLUMNS), dtype=np.float32)
        self._camera = camera
        self._components = len(model.components)
        self._gain = np.ones(3, dtype=np.float32)
        self._rays: dict[int, Array] = {}

    def find(
        self,
        image: Image,
        view: GhostView,
        cam_from_model: Array,
        learns: bool,
        skipped: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.bool_] | None:
        """Pixels (h,w) of the view's window that an occluder hides; None if there is none.

        Args:
            image: (H,W,3) uint8 RGB without overlay.
            view: the model at its pose.
            cam_from_model: (4,4) mm.
            learns: whether the pose is sure enough for the colours to be learned.
            skipped: (C,) components that are not there, so that nothing can lie before them.
        """
        finest = float(np.sqrt(view.face_ids.size / SAMPLES))
        step = next((one for one in _STEPS if one >= finest), _STEPS[-1])
        rays = self._ray_grid(step)
        skipped = np.zeros(self._components, dtype=np.bool_) if skipped is None else skipped
        cells, observed = _sample(
            image,
            view.u0,
            view.v0,
            face_ids=view.face_ids,
            components=view.components,
            skipped=skipped,
            inverse_depth=view.inverse_depth,
            rays=rays,
            step=step,
            model_from_cam=invert(cam_from_model),
            origin=self._origin,
            cell_mm=self._cell_mm,
            shape=np.array(self._cells.shape[:3]),
        )
        table = self._cells.reshape(-1, _COLUMNS)
        known = (cells >= 0) & (table[cells, _COUNT] >= MIN_OBSERVATIONS)
        rows, columns = cells.shape[0], cells.shape[1]
        mask = strange = np.zeros((rows, columns), dtype=np.uint8)
        gain = self._gain
        compared = np.flatnonzero(known)
        if len(compared) > 4 * MIN_SAMPLES:
            # A part of the samples is enough for the exposure.
            few = compared[::_EXPOSURE_STRIDE]
            gain = self._gain = _exposure(observed.reshape(-1, 3)[few], table[cells.ravel()[few], :3], self._gain)
            strange, mask = self._occluded(cells, observed, known, gain)
            if mask.any():
                mask = self._to_outline(cells, observed, known, gain, strange, mask)
        if learns:
            rates = np.array([RATE, OCCLUDED_RATE, MAX_VARIANCE], dtype=np.float32)
            _learn(table, cells, observed, gain, mask | strange, rates)
        if not mask.any():
            return None
        height, width = view.face_ids.shape
        # Samples lie at the multiples of the step in the image, not in the window.
        size = columns * step, rows * step
        # Edges on the outline of the part lie half beside it.
        mask |= cv2.dilate(mask, np.ones((3, 3), dtype=np.uint8)) & (cells < 0)
        large = cv2.resize(_BORDER_LEVEL * mask, size, interpolation=cv2.INTER_LINEAR)
        top, left = view.v0 % step, view.u0 % step
        return np.asarray(large[top : top + height, left : left + width] >= _BORDER)

    def _ray_grid(self, step: int) -> Array:
        """Rays (h,w,2), x and y at z = 1, through the middles of squares of ``step`` pixels of the image."""
        if step not in self._rays:
            u = np.arange(0, self._camera.width + step, step) + 0.5 * (step - 1)
            v = np.arange(0, self._camera.height + step, step) + 0.5 * (step - 1)
            with np.errstate(all="ignore"):
                rays = self._camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
            self._rays[step] = np.ascontiguousarray(rays[..., :2])
        return self._rays[step]

    def _occluded(
        self,
        cells: NDArray[np.int64],
        observed: NDArray[np.float32],
        known: NDArray[np.bool_],
        gain: NDArray[np.float32],
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Samples that look like an occluder by themselves, and those that belong to one."""
        table = self._cells.reshape(-1, _COLUMNS)
        noise = np.array([HUE_NOISE, NOISE, SHADE, SHINE], dtype=np.float32)
        hue, hue_variance, brightness_score, ratio = _differences(table, cells, observed, known, gain, noise)
        # What the frame as a whole differs by, as under another light, is not an occluder. Most of the part may be
        # hidden, so this is judged by the samples that agree best.
        seen = hue[known]
        common = 2.0 * float(np.partition(seen, len(seen) // 5)[len(seen) // 5])
        score = np.maximum(hue / (hue_variance + common), brightness_score)
        is_strange = known & (score > MIN_SCORE)
        # Near the surface's own edges and outline a small error of the pose shows the colour of what is beside.
        is_sure = _sure(table, cells, observed, known & (score > SURE_SCORE), known, gain, noise)
        if np.count_nonzero(is_sure) < max(1.0, MIN_SURE_SHARE * MIN_SAMPLES):
            return is_strange.astype(np.uint8), np.zeros(cells.shape, dtype=np.uint8)
        is_part, weight = cells >= 0, known.astype(np.float32)
        is_edge = known & (_local_deviation(ratio, weight) > MIN_CONTRAST)
        near = cv2.blur((is_strange | is_edge).astype(np.float32), (3, 3)) / np.maximum(cv2.blur(weight, (3, 3)), 1e-3)
        wide = cv2.morphologyEx(((near >= MIN_SHARE) & is_part).astype(np.uint8), cv2.MORPH_CLOSE, _SQUARE) > 0
        # A deviation reaches one sample beyond the edge that causes it.
        core = cv2.erode((wide | ~is_part).astype(np.uint8), _SQUARE) > 0
        candidate = (wide & is_part & (core | is_strange)).astype(np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(candidate, connectivity=8)
        sure = np.bincount(labels[is_sure], minlength=count)
        area = stats[:, cv2.CC_STAT_AREA]
        kept = (area >= MIN_SAMPLES) & (sure >= MIN_SURE_SHARE * area)
        kept[0] = False
        return is_strange.astype(np.uint8), kept[labels].astype(np.uint8)

    def _to_outline(
        self,
        cells: NDArray[np.int64],
        observed: NDArray[np.float32],
        known: NDArray[np.bool_],
        gain: NDArray[np.float32],
        strange: NDArray[np.uint8],
        mask: NDArray[np.uint8],
    ) -> NDArray[np.uint8]:
        """Samples of an occluder up to its outline, from those of its samples that look strange.

        Between them and the surface around, the outline is the strongest edge of the ratio of seen to expected colour:
        a watershed from markers (Meyer, "Color image segmentation", 1992). Gaps that agree with the surface are left
        out.
        """
        is_part = cells >= 0
        expected = gain * self._cells.reshape(-1, _COLUMNS)[cells, :3]
        ratio = np.log((observed + _RATIO_OFFSET) / (expected + _RATIO_OFFSET))
        ratio[~known] = 0.0
        levels = np.clip(128.0 + _RATIO_LEVELS * ratio, 0.0, 255.0).astype(np.uint8)
        side = 2 * REACH + 1
        near = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))) > 0
        is_strange = strange > 0
        markers = np.where(near, 0, _SURFACE).astype(np.int32)
        markers[(mask > 0) & is_strange] = _OCCLUDER
        markers[~is_part] = _BESIDE
        cv2.watershed(levels, markers)
        found = markers == _OCCLUDER
        # The watershed leaves a line of one sample between two regions.
        found |= (markers < 0) & is_strange & (cv2.dilate(found.astype(np.uint8), _SQUARE) > 0)
        mismatch = (ratio * ratio).max(axis=2)
        around = mismatch[known & ~near]
        noise = 1.48 * float(np.sqrt(np.median(around))) if len(around) else 0.0
        noise = max(noise, MIN_SURFACE_NOISE)
        gaps = (found & known & ~is_strange).astype(np.uint8)
        count, labels = cv2.connectedComponents(gaps, connectivity=4)
        size = np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
        agrees = np.bincount(labels.ravel(), mismatch.ravel(), count) / size < (MIN_MISMATCH * noise) ** 2
        agrees[0] = False
        return (found & is_part & ~agrees[labels]).astype(np.uint8)


class HiddenComponents:
    """Which components something before the part hides, steady over some frames.

    Attributes:
        flags: (C,) bool.
    """

    def __init__(self, count: int) -> None:
        self.flags = np.zeros(count, dtype=np.bool_)
        self._frames = np.zeros(count, dtype=np.int64)

    def update(
        self, view: GhostView, occluder: NDArray[np.bool_] | None, presences: Sequence[ComponentPresence | None]
    ) -> None:
        """Count a frame: its occluder, and what the pose says of components that the model by itself leaves visible."""
        hidden = [
            index
            for index, presence in enumerate(presences)
            if presence is not None and presence.observations > 0 and presence.visibility is Visibility.HIDDEN
        ]
        if not hidden and occluder is None and not self._frames.any():
            return
        count = len(presences)
        shown = np.bincount(view.components[view.face_ids[view.face_ids >= 0]], minlength=count)
        covered = np.zeros(count, dtype=np.int64)
        if occluder is not None:
            faces = view.face_ids[occluder & (view.face_ids >= 0)]
            covered = np.bincount(view.components[faces], minlength=count)
        is_hidden = covered >= _HIDDEN_SHARE * shown
        is_hidden[hidden] = True
        step = np.where(is_hidden & (shown >= _HIDDEN_PX), 1, -1)
        self._frames = np.clip(self._frames + step, 0, _HIDDEN_FRAMES)
        self.flags |= self._frames == _HIDDEN_FRAMES
        self.flags &= self._frames > 0


def _local_deviation(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Standard deviation (R,C) of the values of the 3×3 neighbours that have a weight."""
    total = np.maximum(cv2.blur(weight, (3, 3)), 1e-3)
    mean = cv2.blur(values, (3, 3)) / total
    variance = cv2.blur(values * values, (3, 3)) / total - mean * mean
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float32)


def _exposure(
    observed: NDArray[np.float32], expected: NDArray[np.float32], before: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Gain (3,) of the frame: median ratio of observed to expected colours, where it is about as before."""
    ratio = observed / np.maximum(expected, 1.0) / before
    agrees = (expected.min(axis=1) > _DARK) & (np.abs(np.log(np.maximum(ratio, 1e-3))).max(axis=1) < _MAX_CHANGE)
    if agrees.sum() < _MIN_AGREEING * len(observed):
        return before
    return np.asarray(before * np.median(ratio[agrees], axis=0), dtype=np.float32)


@kernel
def _sample(
    image: NDArray[np.uint8],
    u0: int,
    v0: int,
    face_ids: NDArray[np.int32],
    components: NDArray[np.int32],
    skipped: NDArray[np.bool_],
    inverse_depth: NDArray[np.float64],
    rays: NDArray[np.float64],
    step: int,
    model_from_cam: NDArray[np.float64],
    origin: NDArray[np.float64],
    cell_mm: float,
    shape: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Cell (R,C) of the model grid that each sample shows, -1 for none, and its mean colour (R,C,3)."""
    height, width = face_ids.shape
    first_row, first_column = v0 // step, u0 // step
    rows = (v0 + height - 1) // step - first_row + 1
    columns = (u0 + width - 1) // step - first_column + 1
    cells = np.full((rows, columns), -1, dtype=np.int64)
    colors = np.zeros((rows, columns, 3), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            v = (first_row + row) * step + step // 2
            u = (first_column + column) * step + step // 2
            i, j = v - v0, u - u0
            if i < 0 or j < 0 or i >= height or j >= width or face_ids[i, j] < 0:
                continue
            if skipped[components[face_ids[i, j]]]:
                continue
            depth = 1.0 / inverse_depth[i, j]
            x = rays[first_row + row, first_column + column, 0] * depth
            y = rays[first_row + row, first_column + column, 1] * depth
            index = 0
            is_inside = True
            for axis in range(3):
                place = model_from_cam[axis, 0] * x + model_from_cam[axis, 1] * y + model_from_cam[axis, 2] * depth
                number = int(np.floor((place + model_from_cam[axis, 3] - origin[axis]) / cell_mm))
                if not 0 <= number < shape[axis]:
                    is_inside = False
                index = index * shape[axis] + number
            if not is_inside:
                continue
            cells[row, column] = index
            total = 0
            for r in range(max(0, v - 1), min(image.shape[0], v + 2)):
                for c in range(max(0, u - 1), min(image.shape[1], u + 2)):
                    for k in range(3):
                        colors[row, column, k] += image[r, c, k]
                    total += 1
            for k in range(3):
                colors[row, column, k] /= total
    return cells, colors


@kernel
def _differences(
    table: NDArray[np.float32],
    cells: NDArray[np.int64],
    observed: NDArray[np.float32],
    known: NDArray[np.bool_],
    gain: NDArray[np.float32],
    noise: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Squared difference (R,C) of the hue of each sample from its cell, its variance, and the score of the brightness.

    The hue is what is left of the colour at the same brightness. ``noise``: of hue and brightness, and the factors
    between which a brightness is explained by the light. The last result is the logarithm of the ratio of seen to
    expected brightness, 0 where nothing is known and damped where noise is a large part of the expected brightness.
    """
    rows, columns = cells.shape
    hue = np.zeros((rows, columns), dtype=np.float32)
    variance = np.ones((rows, columns), dtype=np.float32)
    score = np.zeros((rows, columns), dtype=np.float32)
    ratio = np.zeros((rows, columns), dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            if not known[row, column]:
                continue
            cell = cells[row, column]
            along, length, mean = np.float32(0.0), np.float32(1.0), np.float32(0.0)
            for k in range(3):
                color = gain[k] * table[cell, k]
                along += observed[row, column, k] * color
                length += color * color
                mean += color / np.float32(3.0)
            light = along / length
            for k in range(3):
                left = observed[row, column, k] - light * gain[k] * table[cell, k]
                hue[row, column] += left * left / np.float32(3.0)
            variance[row, column] = noise[0] * noise[0] + np.float32(2.0) * table[cell, 3]
            excess = (light - min(max(light, noise[2]), noise[3])) * mean
            score[row, column] = excess * excess / (noise[1] * noise[1] + np.float32(2.0) * table[cell, 4])
            spread = np.float32(9.0) * (np.float32(0.25) * noise[1] * noise[1] + table[cell, 4])
            damping = mean / np.sqrt(mean * mean + spread)
            ratio[row, column] = damping * np.log(min(max(light, np.float32(0.05)), np.float32(20.0)))
    return hue, variance, score, ratio


@kernel
def _sure(
    table: NDArray[np.float32],
    cells: NDArray[np.int64],
    observed: NDArray[np.float32],
    strange: NDArray[np.bool_],
    known: NDArray[np.bool_],
    gain: NDArray[np.float32],
    noise: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Those strange samples (R,C) whose colour is not between the colours expected of their neighbours.

    Samples with a neighbour beside the part are none of them. ``noise`` is as in `_differences`.
    """
    rows, columns = cells.shape
    sure = np.zeros((rows, columns), dtype=np.bool_)
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            if not strange[row, column]:
                continue
            is_inner, is_between = True, True
            for k in range(3):
                low, high = np.float32(255.0), np.float32(0.0)
                for r in range(row - 1, row + 2):
                    for c in range(column - 1, column + 2):
                        if cells[r, c] < 0:
                            is_inner = False
                        elif known[r, c]:
                            color = gain[k] * table[cells[r, c], k]
                            low, high = min(low, color), max(high, color)
                color = observed[row, column, k]
                if color < low * noise[2] - noise[1] or color > high * noise[3] + noise[1]:
                    is_between = False
            sure[row, column] = is_inner and not is_between
    return sure


@kernel
def _learn(
    table: NDArray[np.float32],
    cells: NDArray[np.int64],
    observed: NDArray[np.float32],
    gain: NDArray[np.float32],
    occluded: NDArray[np.uint8],
    rates: NDArray[np.float32],
) -> None:
    """Update means, variances and counts of the cells, at the exposure that they have.

    ``rates``: weight of a new colour in a cell that was seen often, the same of an occluder, and the largest variance.
    """
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            cell = cells[row, column]
            if cell < 0:
                continue
            count = table[cell, 5]
            weight = rates[1]
            if not occluded[row, column]:
                weight = max(rates[0], np.float32(1.0) / (count + np.float32(1.0)))
                table[cell, 5] = count + np.float32(1.0)
            total, along, length = np.float32(0.0), np.float32(0.0), np.float32(1.0)
            for k in range(3):
                color = observed[row, column, k] / gain[k]
                difference = color - table[cell, k]
                total += difference * difference
                along += difference * table[cell, k]
                length += table[cell, k] * table[cell, k]
                table[cell, k] += weight * difference
            if count > 0:
                bright = along * along / length / np.float32(3.0)
                hue = max(total / np.float32(3.0) - bright, np.float32(0.0))
                table[cell, 3] += weight * (min(hue, rates[2]) - table[cell, 3])
                table[cell, 4] += weight * (min(bright, rates[2]) - table[cell, 4])
