"""PatchMatch for GPUs: hypotheses, costs and random numbers of `patchmatch`, for all pixels at once in torch.

What the numba kernels do pixel by pixel is done here for all pixels of one colour of the checkerboard together. Results
agree to float32 rounding, so both give the same depth maps except for ties. kornia samples the warped windows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.reconstruction.dense.kernels import (
    BEST,
    COLOR_SCALE,
    CX,
    CY,
    DX,
    DY,
    FALLOFF,
    FX,
    FY,
    GEOMETRIC,
    MAP_STEP,
    MAX_ERROR_PX,
    MIN_SQUARED_COSINE,
    NOISE,
    PARALLAX,
    RADIUS,
    Problem,
    make_scratch,
)
from arview.reconstruction.dense.patchmatch import NEIGHBOURS
from arview.reconstruction.dense.views import Planes
from arview.reconstruction.gpu.device import device_memory

_CHUNK = 1 << 17
"""Pixels processed at a time: a window of 40 float32 for each takes 20 MB, and there are about ten such arrays."""


def search_torch(
    problem: Problem,
    given: Planes,
    spread: float,
    randoms: int,
    low: float,
    high: float,
    steps: list[tuple[float, float]],
    is_dense: bool,
    seed: int,
    device: str,
) -> Planes:
    """PatchMatch of one view at one level.

    Args:
        problem: the view and its sources.
        given: (C,H,W,3) hypotheses, w = 0 where there is none.
        spread: range in w of random hypotheses around the first given one.
        randoms: number of random hypotheses.
        low, high: w of the farthest and the nearest surface.
        steps: perturbation of w and of the slope in each sweep.
        is_dense: windows of all pixels, see `make_scratch`.
        seed: of the random numbers.
        device: torch device.
    """
    with device_memory(device):
        search = _Search(problem, is_dense, device)
        search.try_hypotheses(given, spread, randoms, low, high, seed)
        for turn, (step_w, step_tilt) in enumerate(steps):
            for color in (0, 1):
                search.sweep(color, step_w, step_tilt, seed + 101 * (turn + 1))
        planes: Planes = search.planes.cpu().numpy()
    return planes


class _Search:
    """Planes (H,W,3) and costs (H,W) of one view on a device."""

    def __init__(self, problem: Problem, is_dense: bool, device: str) -> None:
        import torch
        from kornia.geometry.transform import remap

        self.torch, self.remap = torch, remap
        self.device = device
        self.grey, self.region = self._on_device(problem.grey), self._on_device(problem.region) > 0
        self.pixels, self.maps = self._on_device(problem.pixels), self._on_device(problem.maps)
        self.sizes = problem.sizes.astype(int).tolist()
        self.warps = problem.warps.tolist()
        self.numbers = problem.numbers.tolist()
        scratch, _ = make_scratch(is_dense=is_dense)
        self.dx, self.dy, self.falloff = (self._on_device(scratch[row]) for row in (DX, DY, FALLOFF))
        height, width = problem.grey.shape
        self.planes = torch.zeros((height, width, 3), dtype=torch.float32, device=device)
        self.costs = torch.full((height, width), 2.0, dtype=torch.float32, device=device)

    def _on_device(self, array: NDArray[Any]) -> Any:
        return self.torch.as_tensor(np.ascontiguousarray(array), device=self.device)

    def _chunks(self, mask: Any) -> list[tuple[Any, Any]]:
        """(y, x) of the pixels of a mask, in chunks."""
        y, x = self.torch.nonzero(mask, as_tuple=True)
        return list(zip(y.split(_CHUNK), x.split(_CHUNK), strict=True))

    def _draw(self, seed: int, x: Any, y: Any, turn: int) -> Any:
        """See `patchmatch.draw`: products of 32-bit numbers wrap in int64, whose low half equals that of uint32."""
        low = 0xFFFFFFFF
        h = seed ^ ((x * 0x9E3779B1) & low) ^ ((y * 0x85EBCA77) & low)
        h = h ^ ((turn * 0xC2B2AE3D) & low)
        h = ((h ^ (h >> 16)) * 0x85EBCA6B) & low
        h = ((h ^ (h >> 13)) * 0xC2B2AE35) & low
        h = h ^ (h >> 16)
        return (h.double() / 2147483648.0 - 1.0).float()

    def _window(self, y: Any, x: Any) -> tuple[Any, Any, Any]:
        """Weights (N,S) of sum 1, weighted centred grey levels (N,S) and variance (N,) of the view's windows."""
        height, width = self.grey.shape
        rows = (y[:, None] + self.dy.long()).clamp(0, height - 1)
        columns = (x[:, None] + self.dx.long()).clamp(0, width - 1)
        grey = self.grey[rows, columns]
        unlike = (grey - self.grey[y, x][:, None]) * COLOR_SCALE
        weight = self.falloff / (1.0 + unlike * unlike)
        weight = weight / weight.sum(dim=1, keepdim=True)
        away = grey - (weight * grey).sum(dim=1, keepdim=True)
        return weight, weight * away, (weight * away * away).sum(dim=1)

    def _cost(self, y: Any, x: Any, plane: Any, window: tuple[Any, Any, Any]) -> Any:
        """(N,) cost of planes (N,3), see `kernels.element_cost`."""
        torch, numbers = self.torch, self.numbers
        w, du, dv = plane.unbind(dim=1)
        u, v = x.float(), y.float()
        xn, yn = (u - numbers[CX]) / numbers[FX], (v - numbers[CY]) / numbers[FY]
        a, b = du * numbers[FX], dv * numbers[FY]
        c = w - a * xn - b * yn
        facing = (w > 0) & (w * w > MIN_SQUARED_COSINE * (a * a + b * b + c * c) * (xn * xn + yn * yn + 1.0))
        costs = torch.stack([self._source_cost(k, u, v, plane, window) for k in range(len(self.sizes))])
        best = min(int(numbers[BEST]), len(self.sizes))
        mean = costs.sort(dim=0).values[:best].mean(dim=0)
        return torch.where(facing, mean, torch.full_like(mean, 2.0))

    def _source_cost(self, k: int, x: Any, y: Any, plane: Any, window: tuple[Any, Any, Any]) -> Any:
        """(N,) cost of planes (N,3) in source k."""
        torch, (weight, centred, variance) = self.torch, window
        first, width, height, *map_size = self.sizes[k]
        m = self.warps[k]
        w, du, dv = plane.unbind(dim=1)
        forms = [  # of (dx, dy): value and slopes, see kernels.warp
            (
                m[r] * x + m[r + 1] * y + m[r + 2] + w * m[9 + r // 3],
                m[r] + du * m[9 + r // 3],
                m[r + 1] + dv * m[9 + r // 3],
            )
            for r in (0, 3, 6)
        ]
        inside = torch.ones_like(w, dtype=torch.bool)
        for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            p, q, z = (f[0] + (RADIUS + 1) * (corner[0] * f[1] + corner[1] * f[2]) for f in forms)
            inside &= (z > 0) & (p >= 0) & (q >= 0) & (p <= (width - 2) * z) & (q <= (height - 2) * z)
        p, q, z = (f[0][:, None] + f[1][:, None] * self.dx + f[2][:, None] * self.dy for f in forms)
        p, q = p / z, q / z
        picture = self.pixels[first : first + width * height].view(1, 1, height, width)
        grey = self.remap(picture, p[None], q[None], padding_mode="border", align_corners=True)[0, 0]
        mean = (weight * grey).sum(dim=1)
        contrast = ((weight * grey * grey).sum(dim=1) - mean * mean).clamp(min=0)
        noise = self.numbers[NOISE]
        zncc = (centred * grey).sum(dim=1) / torch.sqrt((variance + noise) * (contrast + noise))
        cost = (1.0 - zncc).clamp(max=2.0)
        if len(self.maps) > 0:
            cost = cost + self.numbers[GEOMETRIC] * self._disagreement(m[PARALLAX], map_size, forms, w)
        return torch.where(inside, cost, torch.full_like(cost, 2.0))

    def _disagreement(self, parallax: float, map_size: list[int], forms: Any, w: Any) -> Any:
        """(N,) see `kernels.disagreement_px`."""
        torch, step = self.torch, self.numbers[MAP_STEP]
        first, width, height = map_size
        (p, _, _), (q, _, _), (z, _, _) = forms
        u, v = ((p / z + 0.5) / step).nan_to_num(), ((q / z + 0.5) / step).nan_to_num()
        column, row = u.clamp(-1, width).trunc().long(), v.clamp(-1, height).trunc().long()
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        at = first + row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        plane = self.maps[at]
        there = plane[:, 0] + plane[:, 1] * (u - 0.5 - column) + plane[:, 2] * (v - 0.5 - row)
        error = ((there - w / z).abs() * parallax).clamp(max=MAX_ERROR_PX)
        return torch.where(inside & (plane[:, 0] > 0), error, torch.full_like(error, MAX_ERROR_PX))

    def try_hypotheses(self, given: Planes, spread: float, randoms: int, low: float, high: float, seed: int) -> None:
        """See ``patchmatch.try_hypotheses``."""
        torch, numbers = self.torch, self.numbers
        hypotheses = self._on_device(given)
        for y, x in self._chunks(self.region):
            window = self._window(y, x)
            best = torch.zeros((len(y), 3), device=self.device)
            costs = torch.full((len(y),), 2.0, device=self.device)
            base = torch.zeros((len(y), 3), device=self.device)
            for c in range(len(hypotheses) + randoms):
                if c < len(hypotheses):
                    plane = hypotheses[c, y, x]
                    base = torch.where((base[:, :1] == 0) & (plane[:, :1] > 0), plane, base)
                else:
                    one, two, three = (self._draw(seed, x, y, 4 * c + i) for i in range(3))
                    w = low + (high - low) * (0.5 + 0.5 * one)
                    plane = torch.stack([w, w / numbers[FX] * two, w / numbers[FY] * three], dim=1)
                    if c & 1:
                        near = torch.stack([base[:, 0] + spread * one, base[:, 1], base[:, 2]], dim=1)
                        plane = torch.where(base[:, :1] > 0, near, plane)
                best, costs = self._better(y, x, window, plane, best, costs)
            self.planes[y, x], self.costs[y, x] = best, costs

    def _better(self, y: Any, x: Any, window: Any, plane: Any, best: Any, costs: Any) -> tuple[Any, Any]:
        """The better of the current planes and one more hypothesis, with their costs."""
        cost = self._cost(y, x, plane, window)
        is_better = cost < costs
        return self.torch.where(is_better[:, None], plane, best), self.torch.where(is_better, cost, costs)

    def sweep(self, color: int, step_w: float, step_tilt: float, seed: int) -> None:
        """See `patchmatch.sweep`; all pixels of one colour at once, because a sweep reads only the other colour."""
        torch, numbers = self.torch, self.numbers
        height, width = self.costs.shape
        rows, columns = (torch.arange(n, device=self.device) for n in (height, width))
        mask = self.region & (((rows[:, None] + columns) & 1) == color)
        neighbours = self._on_device(NEIGHBOURS)
        for y, x in self._chunks(mask):
            window = self._window(y, x)
            best, costs = self.planes[y, x], self.costs[y, x]
            for offsets in neighbours:
                xx, yy = x[:, None] + offsets[:, 0], y[:, None] + offsets[:, 1]
                inside = (xx >= 0) & (yy >= 0) & (xx < width) & (yy < height)
                xx, yy = xx.clamp(0, width - 1), yy.clamp(0, height - 1)
                inside &= self.region[yy, xx]
                there = torch.where(inside, self.costs[yy, xx], torch.full_like(xx, 2, dtype=torch.float32))
                lowest, which = there.min(dim=1)
                which = which[:, None]
                bx, by = xx.gather(1, which)[:, 0], yy.gather(1, which)[:, 0]
                plane = self.planes[by, bx].clone()
                plane[:, 0] += plane[:, 1] * (x - bx) + plane[:, 2] * (y - by)
                moved, better = self._better(y, x, window, plane, best, costs)
                tilt = torch.maximum(
                    (plane[:, 1] - best[:, 1]).abs() * numbers[FX], (plane[:, 2] - best[:, 2]).abs() * numbers[FY]
                )
                is_same = ((plane[:, 0] - best[:, 0]).abs() < 0.1 * step_w) & (tilt < 0.1 * step_tilt * best[:, 0])
                is_new = (lowest < 2.0) & ~is_same
                best = torch.where(is_new[:, None], moved, best)
                costs = torch.where(is_new, better, costs)
            plane = best.clone()
            plane[:, 0] += step_w * self._draw(seed, x, y, 0)
            plane[:, 1] += best[:, 0] / numbers[FX] * step_tilt * self._draw(seed, x, y, 1)
            plane[:, 2] += best[:, 0] / numbers[FY] * step_tilt * self._draw(seed, x, y, 2)
            moved, better = self._better(y, x, window, plane, best, costs)
            known = best[:, 0] > 0
            best, costs = torch.where(known[:, None], moved, best), torch.where(known, better, costs)
            self.planes[y, x], self.costs[y, x] = best, costs
