"""Training of the denoiser on pictures of random solids in front of photos, with and without noise of many kinds."""

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
from edge_net_examples import read_edge_pictures
from edge_net_fitting import compressed, with_flat_shapes
from networks.layers import write_image_network
from networks.net2net import CONTINUED_RATE_SHARE, packaged_weights, torch_with_onnx, widen_from
from networks.prefetch import prefetched
from networks.unet import unet

WIDTHS = (24, 32, 48)
"""Channels of the levels, the first at half the size of the picture, each of half the size of the one before."""
EXTRA_CONVOLUTIONS = (1, 2)
"""Further convolutions on each level after the first."""
CROP_PX, CROPS = 192, 16
"""Side and number of the square crops of a batch."""
RATE, DECAY, WARM_UP, MAX_GRADIENT_NORM = 2e-3, 1e-3, 0.05, 1.0
HELD_OUT = 40
"""One picture in this many is held out for the report."""
NOISE, LOW_NOISE = (3.0, 22.0), (0.0, 4.0)
"""Ranges of the standard deviation of the noise, grey levels, in most crops and in the others."""
RESIDUAL_UNIT, ROUNDING = 16.0, 0.1
"""Scale of the errors in the loss, grey levels; below this share of it the loss is quadratic instead of linear."""
REPORTED_NOISE = 6.0, 12.0, 20.0
"""Standard deviations of noise for which the report states what is left."""

NoisyPair = tuple[NDArray[np.float32], NDArray[np.float32]]
"""A crop (3,S,S) with and without noise, grey levels."""


def fit_denoiser(folder: Path, epochs: int, from_scratch: bool = True) -> None:
    """Train the network on the pictures in a folder, write denoiser.onnx there, and report the noise that it leaves.

    Args:
        folder: with pictures, see `collect_edge_pictures`.
        epochs: passes over the pictures.
        from_scratch: False continues from the network in the package.

    Raises:
        InputError: no pictures, no torch or onnx, or the network in the package is wider.
    """
    torch = torch_with_onnx()
    pictures = [picture.image() for picture in read_edge_pictures(folder)]
    torch.manual_seed(0)
    network = _network(torch)
    if not from_scratch:
        noisy = torch.zeros(1, 3, CROP_PX, CROP_PX)
        widen_from(network, packaged_weights("denoiser.onnx"), lambda: network(noisy), torch)
    fitted = [p for k, p in enumerate(pictures) if k % HELD_OUT]
    _fit(network, fitted, epochs, RATE if from_scratch else CONTINUED_RATE_SHARE * RATE, torch)
    network.eval()
    _report(network, pictures[::HELD_OUT], torch)
    write_image_network(network, folder / "denoiser.onnx", "clean", torch)


def _fit(network: Any, pictures: Sequence[NDArray[np.uint8]], epochs: int, rate: float, torch: Any) -> None:
    network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=DECAY)
    steps = max(1, len(pictures) // CROPS)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * steps, pct_start=WARM_UP)

    def made(step: int) -> Any:
        rng = np.random.default_rng([step, 8])
        return _stacked([_pair(pictures[k], rng) for k in rng.integers(len(pictures), size=CROPS)], torch)

    total = epochs * steps
    for noisy, truth in tqdm(prefetched(made, total), total=total, desc="denoiser", disable=None):
        with torch.autocast("cpu", torch.bfloat16):
            predicted = network(_normalised(noisy).contiguous(memory_format=torch.channels_last))
        error = (_cleaned(noisy, predicted.float(), torch) - truth) / RESIDUAL_UNIT
        loss = torch.sqrt(error**2 + ROUNDING**2).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
        optimiser.step()
        schedule.step()


def _stacked(pairs: Sequence[NoisyPair], torch: Any) -> tuple[Any, Any]:
    noisy, truth = (torch.from_numpy(np.stack(part)) for part in zip(*pairs, strict=True))
    return noisy, truth


def _normalised(picture: Any) -> Any:
    return (picture - INPUT_MEAN) / INPUT_SCALE


def _cleaned(noisy: Any, predicted: Any, torch: Any) -> Any:
    return noisy + INPUT_SCALE * torch.nn.functional.pixel_shuffle(predicted, 2)


def _pair(image: NDArray[np.uint8], rng: np.random.Generator, noise: float | None = None) -> NoisyPair:
    """A random crop of a picture with noise, perhaps blurred and compressed, and without."""
    scale = rng.uniform(0.5, 1.1) if rng.random() < 0.4 else 1.0
    taken_px = min(round(CROP_PX / scale), *image.shape[:2])
    top, left = (int(rng.integers(side - taken_px + 1)) for side in image.shape[:2])
    square = image[top : top + taken_px, left : left + taken_px]
    if rng.random() < 0.15:
        square = with_flat_shapes(square, rng)
    pixels = square.astype(np.float32)
    way = cv2.INTER_AREA if taken_px > CROP_PX else cv2.INTER_LINEAR
    truth: NDArray[Any] = pixels
    if taken_px != CROP_PX:
        truth = np.asarray(cv2.resize(pixels, (CROP_PX, CROP_PX), interpolation=way))
    if rng.random() < 0.5:
        if rng.random() < 0.6:
            # A random change of saturation.
            truth = truth + rng.uniform(-1.2, 1.0) * (truth.mean(axis=2, keepdims=True) - truth)
        truth = 255.0 * (np.clip(truth, 0.0, 255.0) / 255.0) ** rng.uniform(0.6, 1.6)
        truth = truth * (rng.uniform(0.5, 1.15) * rng.uniform(0.8, 1.2, 3))
    truth = np.clip(truth, 0.0, 255.0)
    if rng.random() < 0.5:
        truth = truth[:, ::-1]
    if rng.random() < 0.5:
        truth = truth.swapaxes(0, 1)
    truth = np.ascontiguousarray(truth, np.float32)
    noisy = cv2.GaussianBlur(truth, (0, 0), rng.uniform(0.3, 1.2)) if rng.random() < 0.7 else truth
    drawn = rng.uniform(*NOISE) if rng.random() < 0.85 else rng.uniform(*LOW_NOISE)
    noisy = np.clip(np.round(noisy + _noise(noisy, noise or drawn, rng)), 0.0, 255.0)
    if rng.random() < 0.2:
        noisy = compressed(noisy.astype(np.uint8), int(rng.integers(70, 96)))
    return noisy.transpose(2, 0, 1).astype(np.float32), truth.transpose(2, 0, 1)


def _noise(picture: NDArray[np.float32], deviation: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(S,S,3) noise, perhaps correlated between the channels or between pixels, or stronger in bright places."""
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
    for noise in REPORTED_NOISE:
        rng = np.random.default_rng(1)
        noisy, truth = _stacked([_pair(picture, rng, noise) for picture in pictures], torch)
        with torch.no_grad():
            clean = _cleaned(noisy, network(_normalised(noisy)), torch)
        before, after = (float(((some - truth) ** 2).mean().sqrt()) for some in (noisy, clean))
        print(
            f"  noise of {noise:.0f}: {before:.1f} grey levels rms from the clean picture, {after:.1f} after denoising"
        )


def _network(torch: Any) -> Any:
    """The network of `arview.detection.features.denoiser`."""
    nn = torch.nn

    def convolution(before: int, after: int, size: int = 3, step: int = 1) -> Any:
        return nn.Sequential(nn.Conv2d(before, after, size, step, size // 2), nn.ReLU())

    pairs = list(pairwise(WIDTHS))
    down = [
        nn.Sequential(convolution(a, b, 3, 2), *(convolution(b, b) for _ in range(more)))
        for (a, b), more in zip(pairs, EXTRA_CONVOLUTIONS, strict=True)
    ]
    narrow = [nn.Conv2d(b, a, 1) for a, b in pairs]
    up = [convolution(a, a) for a, _ in pairs]
    first, last = convolution(3, WIDTHS[0], 5, 2), nn.Conv2d(WIDTHS[0], 12, 3, padding=1)
    return unet(torch, first, down, narrow, up, last)
