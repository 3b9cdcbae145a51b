"""Fitting the denoiser: pictures of random solids before photos, made noisy in many ways, and as they were."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from arview.detection.features.denoiser import INPUT_MEAN, INPUT_SCALE
from edge_net_examples import read_lined_pictures
from edge_net_fitting import compressed, with_flat_things
from networks.layers import write_picture_network
from networks.net2net import GONE_ON, begin_as, in_use, torch_with_onnx
from networks.prefetch import made_ahead
from networks.unet import pyramid

WIDTHS = (24, 32, 48)
"""Of the levels, at half the picture's size and each half as large as that before."""
DEEPER = (1, 2)
"""So many more convolutions on those after the first."""
CROP_PX, CROPS = 192, 16
"""A step looks at so many squares of pictures."""
RATE, DECAY, WARM_UP, LARGEST_GRADIENT = 2e-3, 1e-3, 0.05, 1.0
HELD_OUT = 40
"""Every so manieth picture is not fitted to."""
NOISE, HARDLY_ANY = (3.0, 22.0), (0.0, 4.0)
"""Deviations in grey levels, of most squares and of the others."""
RESIDUAL_UNIT, ROUND = 16.0, 0.1
"""Errors count as they are, in such grey levels; below this share as their square."""
TOLD_NOISE = 6.0, 12.0, 20.0
"""Of which it is said how much is left."""

Pair = tuple[NDArray[np.float32], NDArray[np.float32]]
"""A square as it is shown and as it was (3,S,S), grey levels."""


def fit_denoiser(folder: Path, epochs: int, is_anew: bool = True) -> None:
    """Fit the network to the pictures in a folder, write denoiser.onnx there, and say how much noise it leaves.

    ``is_anew``: not going on from the network in use.

    Raises:
        InputError: no pictures, no torch or onnx, or the network in use is wider.
    """
    torch = torch_with_onnx()
    pictures = [picture.image() for picture in read_lined_pictures(folder)]
    torch.manual_seed(0)
    network = _network(torch)
    if not is_anew:
        shown = torch.zeros(1, 3, CROP_PX, CROP_PX)
        begin_as(network, in_use("denoiser.onnx"), lambda: network(shown), torch)
    fitted = [p for k, p in enumerate(pictures) if k % HELD_OUT]
    _fit(network, fitted, epochs, RATE if is_anew else GONE_ON * RATE, torch)
    network.eval()
    _report(network, pictures[::HELD_OUT], torch)
    write_picture_network(network, folder / "denoiser.onnx", "clean", torch)


def _fit(network: Any, pictures: Sequence[NDArray[np.uint8]], epochs: int, rate: float, torch: Any) -> None:
    network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=DECAY)
    steps = max(1, len(pictures) // CROPS)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * steps, pct_start=WARM_UP)

    def made(step: int) -> Any:
        rng = np.random.default_rng([step, 8])
        return _stacked([_pair(pictures[k], rng) for k in rng.integers(len(pictures), size=CROPS)], torch)

    total = epochs * steps
    for shown, truth in tqdm(made_ahead(made, total), total=total, desc="denoiser", disable=None):
        with torch.autocast("cpu", torch.bfloat16):
            said = network(_as_shown(shown).contiguous(memory_format=torch.channels_last))
        error = (_cleaned(shown, said.float(), torch) - truth) / RESIDUAL_UNIT
        loss = torch.sqrt(error**2 + ROUND**2).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
        optimiser.step()
        schedule.step()


def _stacked(pairs: Sequence[Pair], torch: Any) -> tuple[Any, Any]:
    shown, truth = (torch.from_numpy(np.stack(part)) for part in zip(*pairs, strict=True))
    return shown, truth


def _as_shown(picture: Any) -> Any:
    return (picture - INPUT_MEAN) / INPUT_SCALE


def _cleaned(shown: Any, said: Any, torch: Any) -> Any:
    return shown + INPUT_SCALE * torch.nn.functional.pixel_shuffle(said, 2)


def _pair(image: NDArray[np.uint8], rng: np.random.Generator, noise: float | None = None) -> Pair:
    """A square of a picture, blurred and noisy and compressed now and then, and as it was."""
    scale = rng.uniform(0.5, 1.1) if rng.random() < 0.4 else 1.0
    taken_px = min(round(CROP_PX / scale), *image.shape[:2])
    top, left = (int(rng.integers(side - taken_px + 1)) for side in image.shape[:2])
    square = image[top : top + taken_px, left : left + taken_px]
    if rng.random() < 0.15:
        square = with_flat_things(square, rng)
    square = square.astype(np.float32)
    way = cv2.INTER_AREA if taken_px > CROP_PX else cv2.INTER_LINEAR
    truth = cv2.resize(square, (CROP_PX, CROP_PX), interpolation=way) if taken_px != CROP_PX else square
    if rng.random() < 0.5:
        if rng.random() < 0.6:
            # More saturated, or less.
            truth = truth + rng.uniform(-1.2, 1.0) * (truth.mean(axis=2, keepdims=True) - truth)
        truth = 255.0 * (np.clip(truth, 0.0, 255.0) / 255.0) ** rng.uniform(0.6, 1.6)
        truth = truth * (rng.uniform(0.5, 1.15) * rng.uniform(0.8, 1.2, 3))
    truth = np.clip(truth, 0.0, 255.0)
    if rng.random() < 0.5:
        truth = truth[:, ::-1]
    if rng.random() < 0.5:
        truth = truth.swapaxes(0, 1)
    truth = np.ascontiguousarray(truth, np.float32)
    shown = cv2.GaussianBlur(truth, (0, 0), rng.uniform(0.3, 1.2)) if rng.random() < 0.7 else truth
    drawn = rng.uniform(*NOISE) if rng.random() < 0.85 else rng.uniform(*HARDLY_ANY)
    shown = np.clip(np.round(shown + _noise(shown, noise or drawn, rng)), 0.0, 255.0)
    if rng.random() < 0.2:
        shown = compressed(shown.astype(np.uint8), int(rng.integers(70, 96)))
    return shown.transpose(2, 0, 1).astype(np.float32), truth.transpose(2, 0, 1)


def _noise(picture: NDArray[np.float32], deviation: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(S,S,3) noise: now and then the same in all colours, of some width, or more of it in bright places."""
    noise = rng.standard_normal(picture.shape, dtype=np.float32)
    if rng.random() < 0.3:
        common = rng.uniform(0.2, 1.0)
        grey = rng.standard_normal((*picture.shape[:2], 1), dtype=np.float32)
        noise = np.sqrt(1.0 - common**2) * noise + common * grey
    if rng.random() < 0.3:
        noise = cv2.GaussianBlur(noise, (0, 0), rng.uniform(0.3, 0.8))
        noise /= noise.std()
    if rng.random() < 0.3:
        return np.asarray(deviation * np.sqrt(0.3 + 1.4 * picture / 255.0) * noise, dtype=np.float32)
    return np.asarray(deviation * noise, dtype=np.float32)


def _report(network: Any, pictures: Sequence[NDArray[np.uint8]], torch: Any) -> None:
    for noise in TOLD_NOISE:
        rng = np.random.default_rng(1)
        shown, truth = _stacked([_pair(picture, rng, noise) for picture in pictures], torch)
        with torch.no_grad():
            clean = _cleaned(shown, network(_as_shown(shown)), torch)
        before, after = (float(((some - truth) ** 2).mean().sqrt()) for some in (shown, clean))
        print(f"  noise of {noise:.0f}: {before:.1f} grey levels off the picture as it was, cleaned {after:.1f}")


def _network(torch: Any) -> Any:
    """The network of `arview.detection.features.denoiser`."""
    nn = torch.nn

    def convolution(before: int, after: int, size: int = 3, step: int = 1) -> Any:
        return nn.Sequential(nn.Conv2d(before, after, size, step, size // 2), nn.ReLU())

    pairs = list(pairwise(WIDTHS))
    down = [
        nn.Sequential(convolution(a, b, 3, 2), *(convolution(b, b) for _ in range(more)))
        for (a, b), more in zip(pairs, DEEPER, strict=True)
    ]
    narrow = [nn.Conv2d(b, a, 1) for a, b in pairs]
    up = [convolution(a, a) for a, _ in pairs]
    first, last = convolution(3, WIDTHS[0], 5, 2), nn.Conv2d(WIDTHS[0], 12, 3, padding=1)
    return pyramid(torch, first, down, narrow, up, last)
