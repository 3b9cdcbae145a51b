"""SIFT for GPUs: the key points and descriptors of OpenCV's SIFT, for all key points at once in torch and kornia.

Scale space, extrema, fit and edge test as in Lowe 2004, with the constants and roundings of OpenCV, so that nearly all
key points and descriptors are those of the processor's path.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.reconstruction.gpu.device import device_memory

LAYERS = 3
"""Layers of an octave in which extrema are sought."""
SIGMA = 1.6
"""Blur of an octave's first layer, in its pixels."""
CAMERA_SIGMA = 0.5
"""Blur that a photo is taken to have already, in its pixels."""
BORDER = 5
"""Pixels at the border of an octave without key points."""
FIT_STEPS = 5
"""Most steps of a fit from pixel to pixel."""
EDGE_RATIO = 10.0
"""Largest ratio of a key point's principal curvatures; larger ones lie on edges."""
ANGLES = 36
"""Bins of the histogram of gradient directions."""
PEAK_SHARE = 0.8
"""Of the highest bin; lower peaks give no further orientation."""
CELLS, DIRECTIONS = 4, 8
"""A descriptor has 4×4 cells with 8 directions each."""
CELL_SIGMAS = 3.0
"""Width of a cell in units of the key point's scale."""
CLIP = 0.2
"""Largest entry of a unit descriptor before it is normalised again."""
_CHUNK = 1 << 22
"""Samples of gradients taken at a time: 40 float32 for each take 670 MB."""


class KeyPoints(NamedTuple):
    """Key points of a picture with their descriptors, in the order of falling strength.

    Attributes:
        points_px: (N,2) float32, integers are pixel centres.
        sizes_px: (N,) float32 diameters.
        strengths: (N,) float64 contrast.
        sums: (N,128) float32 histograms of gradients, whole numbers up to 255 as OpenCV gives them.
    """

    points_px: NDArray[np.float32]
    sizes_px: NDArray[np.float32]
    strengths: NDArray[np.float64]
    sums: NDArray[np.float32]


class _Found(NamedTuple):
    """Extrema of one octave: layer, row and column (N,), offsets (N,3) in x, y and layer, contrast (N,)."""

    layer: Any
    row: Any
    column: Any
    offset: Any
    contrast: Any


def sift(
    grey: NDArray[np.uint8], max_features: int, contrast_threshold: float, mask: NDArray[np.uint8] | None, device: str
) -> KeyPoints:
    """Key points of an (H,W) picture, the ``max_features`` strongest, and of these the ones where ``mask`` is set."""
    import torch

    with device_memory(device):
        octave = _first_layer(torch.as_tensor(grey, device=device).float())
        parts = []
        for number in range(_octaves(octave.shape)):
            if min(octave.shape) <= _radius(_blurs()[-1]):
                break  # smaller than the widest blur: such key points would cover the whole picture
            layers = _layers(octave)
            found = _extrema(layers, contrast_threshold)
            if len(found.layer) > 0:
                parts.append(_oriented(layers, found, number))
            octave = layers[LAYERS, ::2, ::2][: octave.shape[0] // 2, : octave.shape[1] // 2].contiguous()
            parts = _strongest(parts, max_features)
        return _gathered(parts, mask)


def _octaves(shape: tuple[int, ...]) -> int:
    """Number of octaves of a picture of twice the size."""
    return round(float(np.log2(min(shape)) - 2)) + 1


def _blurs() -> list[float]:
    """Blur that makes each layer of an octave from the one before."""
    scales = SIGMA * 2.0 ** (np.arange(LAYERS + 3) / LAYERS)
    return [float(blur) for blur in np.sqrt(scales[1:] ** 2 - scales[:-1] ** 2)]


def _radius(sigma: float) -> int:
    return (round(sigma * 8 + 1) | 1) // 2


def _blurred(picture: Any, sigma: float) -> Any:
    """An (H,W) picture blurred; the kernel reaches to four sigmas as in OpenCV."""
    from kornia.filters import gaussian_blur2d

    size = 2 * _radius(sigma) + 1
    return gaussian_blur2d(picture[None, None], (size, size), (sigma, sigma), border_type="reflect")[0, 0]


def _first_layer(grey: Any) -> Any:
    """The picture at twice the size, pixel (x, y) at (2x, 2y), with the blur of the first layer."""
    import torch

    padded = torch.nn.functional.pad(grey[None, None], (0, 1, 0, 1), mode="replicate")[0, 0]
    twice = torch.empty((2 * grey.shape[0], 2 * grey.shape[1]), device=grey.device)
    twice[::2, ::2] = grey
    twice[::2, 1::2] = 0.5 * (grey + padded[:-1, 1:])
    twice[1::2, ::2] = 0.5 * (grey + padded[1:, :-1])
    twice[1::2, 1::2] = 0.25 * (grey + padded[:-1, 1:] + padded[1:, :-1] + padded[1:, 1:])
    return _blurred(twice, float(np.sqrt(SIGMA**2 - (2 * CAMERA_SIGMA) ** 2)))


def _layers(first: Any) -> Any:
    """(LAYERS + 3,H,W) an octave's layers."""
    import torch

    layers = [first]
    for blur in _blurs():
        layers.append(_blurred(layers[-1], blur))
    return torch.stack(layers)


# --- extrema ---------------------------------------------------------------------------------------------


def _extrema(layers: Any, contrast_threshold: float) -> _Found:
    """Extrema of the differences of neighbouring layers, fitted to a fraction of a pixel."""
    import torch

    differences = layers[1:] - layers[:-1]
    inner = differences[1:-1, BORDER:-BORDER, BORDER:-BORDER]
    around = differences[None, None, :, BORDER - 1 : 1 - BORDER, BORDER - 1 : 1 - BORDER]
    least = float(np.floor(0.5 * contrast_threshold / LAYERS * 255))
    pool = torch.nn.functional.max_pool3d
    is_high = (inner > least) & (inner == pool(around, 3, 1)[0, 0])
    is_low = (inner < -least) & (inner == -pool(-around, 3, 1)[0, 0])
    layer, row, column = torch.nonzero(is_high | is_low, as_tuple=True)
    found = _fitted(differences, layer + 1, row + BORDER, column + BORDER)
    value = differences[found.layer, found.row, found.column] / 255.0
    slope, curvature = _derivatives(differences, found.layer, found.row, found.column)
    contrast = value + 0.5 * (slope * found.offset).sum(dim=1)
    trace = curvature[:, 0, 0] + curvature[:, 1, 1]
    det = curvature[:, 0, 0] * curvature[:, 1, 1] - curvature[:, 0, 1] ** 2
    is_kept = (contrast.abs() * LAYERS >= contrast_threshold) & (det > 0)
    is_kept &= trace * trace * EDGE_RATIO < (EDGE_RATIO + 1) ** 2 * det
    found = _Found._make(part[is_kept] for part in (*found[:4], contrast.abs()))
    return _without_repeats(found, differences.shape)


def _without_repeats(found: _Found, shape: tuple[int, ...]) -> _Found:
    """Each pixel once: fits that began at neighbouring pixels may end at the same one."""
    places = (found.layer * shape[1] + found.row) * shape[2] + found.column
    _, first = np.unique(places.cpu().numpy(), return_index=True)
    return _Found._make(part[first] for part in found)


def _fitted(differences: Any, layer: Any, row: Any, column: Any) -> _Found:
    """Extrema of the parabolas through each place; those that leave the octave or do not settle are dropped."""
    import torch

    layers, height, width = differences.shape
    done = []
    for _ in range(FIT_STEPS):
        slope, curvature = _derivatives(differences, layer, row, column)
        offset, is_regular = _solved(curvature, -slope)
        is_settled = (offset.abs() < 0.5).all(dim=1) & is_regular
        done.append(_Found._make(part[is_settled] for part in (layer, row, column, offset, offset[:, 0])))
        moves = is_regular & ~is_settled & (offset.abs() < 1e6).all(dim=1)
        step = offset[moves].round().long()
        column, row, layer = column[moves] + step[:, 0], row[moves] + step[:, 1], layer[moves] + step[:, 2]
        inside = (layer >= 1) & (layer <= layers - 2) & (row >= BORDER) & (row < height - BORDER)
        inside &= (column >= BORDER) & (column < width - BORDER)
        layer, row, column = layer[inside], row[inside], column[inside]
    return _Found._make(torch.cat(parts) for parts in zip(*done, strict=True))


def _derivatives(differences: Any, layer: Any, row: Any, column: Any) -> tuple[Any, Any]:
    """(N,3) slopes and (N,3,3) curvatures in x, y and layer, of grey values up to 1."""
    import torch

    def at(dx: int, dy: int, ds: int) -> Any:
        return differences[layer + ds, row + dy, column + dx]

    steps = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    middle = at(0, 0, 0)
    after, behind = [at(*step) for step in steps], [at(*(-d for d in step)) for step in steps]
    slope = torch.stack([0.5 * (one - other) for one, other in zip(after, behind, strict=True)], dim=1)
    curvature = torch.empty((len(layer), 3, 3), device=differences.device)
    for i in range(3):
        curvature[:, i, i] = after[i] + behind[i] - 2 * middle
        for j in range(i):
            plus = [p + q for p, q in zip(steps[i], steps[j], strict=True)]
            minus = [p - q for p, q in zip(steps[i], steps[j], strict=True)]
            mixed = at(*plus) + at(*(-d for d in plus)) - at(*minus) - at(*(-d for d in minus))
            curvature[:, i, j] = curvature[:, j, i] = 0.25 * mixed
    return slope / 255.0, curvature / 255.0


def _solved(matrices: Any, vectors: Any) -> tuple[Any, Any]:
    """(N,3) solutions of systems (N,3,3), by Cramer's rule in float64, and (N,) whether there is one."""
    import torch

    a, b, c = matrices.double().unbind(dim=2)
    v = vectors.double()
    det = (a * torch.linalg.cross(b, c)).sum(dim=1)
    is_regular = det != 0
    parts = [
        (v * torch.linalg.cross(b, c)).sum(dim=1),
        (a * torch.linalg.cross(v, c)).sum(dim=1),
        (a * torch.linalg.cross(b, v)).sum(dim=1),
    ]
    solution = torch.stack(parts, dim=1) / torch.where(is_regular, det, torch.ones_like(det))[:, None]
    return solution.float(), is_regular


# --- orientation and descriptor --------------------------------------------------------------------------


class _Part(NamedTuple):
    """Oriented key points of one octave, and what describes them."""

    gradients: list[tuple[Any, Any]]
    number: int
    layer: Any
    x: Any
    y: Any
    scale: Any
    angle: Any
    strength: Any


def _gradients(layer: Any) -> tuple[Any, Any]:
    """(H,W) length and direction (rad, y upwards) of the gradients of one layer; length 0 at the border."""
    import torch

    dx, dy = torch.zeros_like(layer), torch.zeros_like(layer)
    dx[1:-1, 1:-1] = layer[1:-1, 2:] - layer[1:-1, :-2]
    dy[1:-1, 1:-1] = layer[:-2, 1:-1] - layer[2:, 1:-1]
    return torch.hypot(dx, dy), torch.atan2(dy, dx)


def _window(shape: tuple[int, ...], x: Any, y: Any, radius: int) -> tuple[Any, Any, Any, Any]:
    """Offsets (1,S) in x and y of square windows; flat indices (N,S), and whether they are in the picture."""
    import torch

    side = torch.arange(-radius, radius + 1, device=x.device)
    dy, dx = (part.reshape(1, -1) for part in torch.meshgrid(side, side, indexing="ij"))
    column, row = x[:, None] + dx, y[:, None] + dy
    inside = (column > 0) & (row > 0) & (column < shape[1] - 1) & (row < shape[0] - 1)
    return dx, dy, row.clamp(0, shape[0] - 1) * shape[1] + column.clamp(0, shape[1] - 1), inside


def _oriented(layers: Any, found: _Found, number: int) -> _Part:
    """Each key point once for every dominant gradient direction around it."""
    import torch

    gradients = [_gradients(layers[1 + i]) for i in range(LAYERS)]
    scale = SIGMA * 2.0 ** ((found.layer + found.offset[:, 2]) / LAYERS)
    histograms = torch.zeros((len(scale), ANGLES), dtype=torch.float64, device=scale.device)
    for rows, radius, (length, direction) in _batches(gradients, found.layer, torch.round(4.5 * scale)):
        dx, dy, at, inside = _window(length.shape, found.column[rows], found.row[rows], radius)
        sigma = 1.5 * scale[rows, None]
        reach = torch.round(4.5 * scale[rows, None])
        inside &= (dx.abs() <= reach) & (dy.abs() <= reach)
        weight = torch.exp(-(dx * dx + dy * dy) / (2 * sigma * sigma)) * inside * length.view(-1)[at]
        bins = torch.round(direction.view(-1)[at] * (ANGLES / (2 * np.pi))).long() % ANGLES
        # Whole numbers add up to the same sum in any order, so that results do not change from run to run.
        sums = torch.zeros((len(rows), ANGLES), dtype=torch.int64, device=scale.device)
        sums.scatter_add_(1, bins, (weight * (1 << 20)).round().long())
        histograms[rows] = sums.double()
    smooth = sum(
        factor * histograms.roll(shift, dims=1)
        for shift, factor in ((-2, 1 / 16), (-1, 4 / 16), (0, 6 / 16), (1, 4 / 16), (2, 1 / 16))
    )
    before, after = smooth.roll(1, dims=1), smooth.roll(-1, dims=1)
    is_peak = (smooth > before) & (smooth > after) & (smooth >= PEAK_SHARE * smooth.amax(dim=1, keepdim=True))
    which, peak = torch.nonzero(is_peak, as_tuple=True)
    left, top, right = before[which, peak], smooth[which, peak], after[which, peak]
    angle = (peak + 0.5 * (left - right) / (left - 2 * top + right)) % ANGLES * (2 * np.pi / ANGLES)
    x, y = (found.column + found.offset[:, 0])[which], (found.row + found.offset[:, 1])[which]
    return _Part(
        gradients,
        number,
        found.layer[which],
        x=x,
        y=y,
        scale=scale[which],
        angle=angle.float(),
        strength=found.contrast[which],
    )


def _batches(gradients: list[tuple[Any, Any]], layer: Any, radii: Any) -> Any:
    """Rows of key points of one layer with similar windows, the largest radius, and the layer's gradients."""
    import torch

    for index in range(LAYERS):
        rows = torch.nonzero(layer == index + 1)[:, 0]
        rows = rows[torch.argsort(radii[rows], stable=True)]
        while len(rows) > 0:
            count = max(1, _CHUNK // int(2 * radii[rows[min(len(rows), 4096) - 1]] + 1) ** 2)
            batch, rows = rows[: min(count, 4096)], rows[min(count, 4096) :]
            yield batch, int(radii[batch[-1]]), gradients[index]


def _described(part: _Part) -> Any:
    """(N,128) descriptors of one octave's key points, as whole numbers up to 255."""
    import torch

    width = CELL_SIGMAS * part.scale
    radii = torch.round(width * (2.0**0.5 * (CELLS + 1) * 0.5))
    radii = radii.clamp(max=float(np.hypot(*part.gradients[0][0].shape)))
    sums = torch.zeros((len(radii), CELLS * CELLS * DIRECTIONS), device=radii.device)
    cells = torch.arange(CELLS, device=radii.device)
    directions = torch.arange(DIRECTIONS, device=radii.device)
    for rows, radius, (length, direction) in _batches(part.gradients, part.layer, radii):
        x, y = part.x[rows].round().long(), part.y[rows].round().long()
        dx, dy, at, inside = _window(length.shape, x, y, radius)
        angle = part.angle[rows, None]
        cos, sin = torch.cos(angle) / width[rows, None], torch.sin(angle) / width[rows, None]
        # The picture's y points down and the angle is measured with y up.
        across, down = dx * cos - dy * sin, dx * sin + dy * cos
        inside &= (dx.abs() <= radii[rows, None]) & (dy.abs() <= radii[rows, None])
        weight = torch.exp((across * across + down * down) * (-2.0 / CELLS**2)) * inside * length.view(-1)[at]
        turn = ((direction.view(-1)[at] - angle) * (DIRECTIONS / (2 * np.pi))) % DIRECTIONS
        by_row = _hats(down + (0.5 * CELLS - 0.5), cells) * weight[..., None]
        by_column = _hats(across + (0.5 * CELLS - 0.5), cells)
        apart = (turn[..., None] - directions).abs()
        by_turn = (1 - torch.minimum(apart, DIRECTIONS - apart)).clamp(min=0)
        by_cell = (by_row[..., :, None] * by_column[..., None, :]).flatten(2)
        sums[rows] = torch.bmm(by_cell.transpose(1, 2), by_turn).flatten(1)
    norm = torch.linalg.norm(sums, dim=1, keepdim=True)
    sums = torch.minimum(sums, CLIP * norm)
    norm = torch.linalg.norm(sums, dim=1, keepdim=True).clamp(min=1e-7)
    return (sums * (512.0 / norm)).round().clamp(max=255)


def _hats(place: Any, cells: Any) -> Any:
    """Weights of linear interpolation: of each place (…) in each cell (…,C)."""
    return (1 - (place[..., None] - cells).abs()).clamp(min=0)


def _strongest(parts: list[_Part], count: int) -> list[_Part]:
    """The parts with no more than the ``count`` strongest key points in all, and those as strong as the last."""
    import torch

    strengths = torch.cat([part.strength for part in parts]) if parts else []
    if len(strengths) <= count:
        return parts
    least = torch.topk(strengths, count).values[-1]
    kept = []
    for part in parts:
        is_kept = part.strength >= least
        kept.append(_Part(part.gradients, part.number, *(value[is_kept] for value in part[2:])))
    return kept


def _gathered(parts: list[_Part], mask: NDArray[np.uint8] | None) -> KeyPoints:
    """Key points of all octaves where the mask is set, in pixels of the picture, the strongest first."""
    columns: list[list[NDArray[np.float32]]] = [[], [], [], [], []]
    for part in parts:
        factor = 0.5 * 2.0**part.number
        for column, value in zip(
            columns, (part.x * factor, part.y * factor, part.scale * 2 * factor, part.strength, None), strict=True
        ):
            if value is not None:
                column.append(value.cpu().numpy())
        columns[4].append(_described(part).cpu().numpy())
    if not parts:
        return KeyPoints(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0), np.zeros((0, 128), "f4"))
    x, y, size, strength, sums = (np.concatenate(column) for column in columns)
    order = np.argsort(-strength, kind="stable")
    if mask is not None:
        rows, places = np.rint(y[order]).astype(int), np.rint(x[order]).astype(int)
        order = order[mask[rows.clip(0, mask.shape[0] - 1), places.clip(0, mask.shape[1] - 1)] > 0]
    points = np.stack([x, y], axis=1)
    return KeyPoints(points[order], size[order], strength[order].astype(np.float64), sums[order])
