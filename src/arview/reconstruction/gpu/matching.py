"""Matching of features for GPUs: all pairs of descriptors at once, by kornia's matchers.

The rules are those of `arview.reconstruction.matching`: mutual nearest neighbours, and a limit for the angle between
two descriptors and for its ratio to the second angle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.reconstruction.gpu.device import device_memory

_ROWS = 2048
"""Descriptors compared with all others at a time: with 6,000 others, a matrix of 50 MB."""


class MatchLimits(NamedTuple):
    """Limits of a match, see `arview.reconstruction.matching`."""

    ratio: float
    angle_rad: float
    size_ratio: float


class Side(NamedTuple):
    """Features of one photo: (N,128) descriptors, (N,) sizes in px, (N,2) ideal rays at z = 1."""

    descriptors: NDArray[np.float32]
    sizes_px: NDArray[np.float32]
    rays: Array


def match_by_appearance(
    ones: NDArray[np.float32], others: NDArray[np.float32], limits: MatchLimits, device: str
) -> NDArray[np.uint32]:
    """(M,2) rows of descriptors (N,128) that are mutual nearest neighbours and pass the ratio test."""
    import torch
    from kornia.feature import match_mnn, match_snn

    with device_memory(device):
        one, other = torch.as_tensor(ones, device=device), torch.as_tensor(others, device=device)
        angles = torch.arccos((one @ other.T).clamp(-1, 1))
        distances, mutual = match_mnn(one, other, dm=angles)
        _, unlike = match_snn(one, other, th=limits.ratio, dm=angles)
        passes = torch.zeros(len(one), dtype=torch.bool, device=device)
        passes[unlike[:, 0]] = True
        kept = mutual[passes[mutual[:, 0]] & (distances[:, 0] < limits.angle_rad)]
        return _in_order(kept)


def match_on_lines(
    sides: tuple[Side, Side], focal_px: float, essential: Array, band_px: float, limits: MatchLimits, device: str
) -> NDArray[np.uint32]:
    """(M,2) rows of both sides that are mutual nearest neighbours among those near each other's epipolar line."""
    import torch

    with device_memory(device):
        there = _one_way(sides[0], sides[1], focal_px, essential, band_px, limits, device)
        back = _one_way(sides[1], sides[0], focal_px, essential.T, band_px, limits, device)
        rows = torch.nonzero(there >= 0)[:, 0]
        mutual = rows[back[there[rows]] == rows]
        return _in_order(torch.stack([mutual, there[mutual]], dim=1))


def _one_way(
    ones: Side, others: Side, focal_px: float, essential: Array, band_px: float, limits: MatchLimits, device: str
) -> Any:
    """(N,) partner of each of ``ones`` among ``others``, or −1."""
    import torch

    lines = np.column_stack([ones.rays, np.ones(len(ones.rays))]) @ essential.T
    norms = np.linalg.norm(lines[:, :2], axis=1)
    lines[:, 2] *= focal_px
    lines = np.where(norms[:, None] < 1e-12, 0.0, lines / np.maximum(norms, 1e-12)[:, None])
    lines[norms < 1e-12, 2] = np.inf
    places = torch.as_tensor(others.rays * focal_px, device=device, dtype=torch.float32)
    line = torch.as_tensor(lines, device=device, dtype=torch.float32)
    one, other = (torch.as_tensor(side.descriptors, device=device) for side in (ones, others))
    size, other_size = (torch.as_tensor(side.sizes_px, device=device) for side in (ones, others))
    found = []
    for start in range(0, len(one), _ROWS):
        rows = slice(start, start + _ROWS)
        value = one[rows] @ other.T
        far = (line[rows, :2] @ places.T + line[rows, 2:]).abs() > band_px
        ratio = size[rows, None] / other_size
        value[far | (ratio > limits.size_ratio) | (ratio < 1 / limits.size_ratio)] = -2.0
        best, partner = value.max(dim=1)
        # A key point may occur twice, with two orientations; it does not compete with itself.
        apart = (places - places[partner][:, None]).abs().sum(dim=2)
        second = torch.where(apart < band_px, torch.full_like(value, -2.0), value).amax(dim=1)
        angle, next_angle = torch.arccos(best.clamp(-1, 1)), torch.arccos(second.clamp(-1, 1))
        bad = (angle > limits.ratio * next_angle) | (angle > limits.angle_rad) | (best <= -2.0)
        found.append(torch.where(bad, torch.full_like(partner, -1), partner))
    return torch.cat(found)


def _in_order(matches: Any) -> NDArray[np.uint32]:
    """Matches by the rows of the first photo."""
    rows: NDArray[np.uint32] = matches.cpu().numpy().astype(np.uint32)
    return rows[np.argsort(rows[:, 0], kind="stable")]
