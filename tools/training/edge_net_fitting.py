"""Fitting the line network to pictures of random solids."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.detection.features.denoiser import Denoiser
from arview.detection.features.edge_net import INPUT_SCALE, SHRINK
from arview.detection.features.response_maps import ORIENTATIONS
from edge_net_examples import FINE, LinedPicture, read_lined_pictures
from networks.layers import normalised, residual, write_picture_network
from networks.net2net import GONE_ON, begin_as, in_use, torch_with_onnx
from networks.unet import pyramid

WIDTHS = (16, 32, 56, 80, 96)
"""Of the levels, each half as large as that before."""
DEEPER = (0, 0, 2, 2)
"""So many residual blocks (He et al., CVPR 2016) on the levels after the first: they cost little on the small ones."""
CROP_PX, CROPS = 256, 8
"""A step looks at so many squares of pictures."""
AROUND_LINES, AROUND_PX = 0.75, 110
"""So many of them about a line, so far off it at most."""
LINE_WEIGHT, LINES_WEIGHT, INSIDE_WEIGHT = 5.0, 4.0, 0.2
"""Of places with a line against those without; of lines; of the solids' inside, which is told for their sake only."""
RESIZED, SIZES = 0.5, (0.62, 1.3)
"""So many squares are shown at another size."""
MOTTLED, CLUTTERED = 0.45, 0.3
"""So many solids have a grain; before so many squares flat things are drawn where no solid is."""
FEWEST_THINGS, MOST_THINGS = 1, 6
"""Drawn there."""
RATE, DECAY, WARM_UP = 2.5e-3, 1e-2, 0.01
HELD_OUT, BEGUN = 20, 24
"""Every so manieth picture is not fitted to; in so many squares one that goes on sees how it is to begin."""
FALSE_SHARES = (0.05, 0.02, 0.01)
"""Shares of places without a line to say the lines seen for."""
TURNED = {
    "mirrored": [0, 7, 6, 5, 4, 3, 2, 1, 8],
    "transposed": [4, 3, 2, 1, 0, 7, 6, 5, 8],
}
"""What becomes of orientations and inside."""


def fit_lines(folder: Path, epochs: int, is_anew: bool = True) -> None:
    """Fit the network to the pictures in a folder, write lines.onnx there, and say how many lines it sees.

    ``is_anew``: not going on from the network in use.

    Raises:
        InputError: no pictures, no torch or onnx, or the network in use is wider.
    """
    torch = torch_with_onnx()
    pictures = read_lined_pictures(folder)
    torch.manual_seed(0)
    network = _network(torch)
    fitted = [p for k, p in enumerate(pictures) if k % HELD_OUT]
    if not is_anew:
        rng = np.random.default_rng(5)
        shown = torch.from_numpy(np.stack([_example(fitted[k], rng)[0] for k in rng.integers(len(fitted), size=BEGUN)]))
        begin_as(network, in_use("lines.onnx"), lambda: network(shown), torch)
    _fit(network, fitted, epochs, RATE if is_anew else GONE_ON * RATE, torch)
    network.eval()
    _report(network, pictures[::HELD_OUT], torch)
    write_picture_network(torch.nn.Sequential(network, torch.nn.Sigmoid()), folder / "lines.onnx", "lines", torch)


def _fit(network: Any, pictures: list[LinedPicture], epochs: int, rate: float, torch: Any) -> None:
    rng = np.random.default_rng(0)
    network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=DECAY)
    steps = max(1, len(pictures) // CROPS)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * steps, pct_start=WARM_UP)
    for epoch in range(epochs):
        losses = []
        for _ in range(steps):
            crops = [_example(pictures[k], rng) for k in rng.integers(len(pictures), size=CROPS)]
            shown, truth = (torch.from_numpy(np.stack(part)) for part in zip(*crops, strict=True))
            with torch.autocast("cpu", torch.bfloat16):
                seen = network(shown.contiguous(memory_format=torch.channels_last))
            loss = _loss(seen.float(), truth, torch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"lines, epoch {epoch + 1} of {epochs}: loss {np.mean(losses):.4f}", flush=True)


def _loss(seen: Any, truth: Any, torch: Any) -> Any:
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    lines = slice(0, ORIENTATIONS)
    weights = 1.0 + (LINE_WEIGHT - 1.0) * (truth[:, lines] > 0.1)
    inside = entropy(seen[:, ORIENTATIONS], truth[:, ORIENTATIONS])
    return LINES_WEIGHT * (entropy(seen[:, lines], truth[:, lines], weight=weights)) + INSIDE_WEIGHT * inside


def _example(picture: LinedPicture, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A square of a picture as the network takes it (3,S,S), and what it should see, lines and inside (9,S/2,S/2)."""
    image = picture.image()
    inside = cv2.imdecode(np.frombuffer(picture.inside, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert inside is not None
    size = np.array(image.shape[:2])
    middle = rng.integers(size)
    if len(picture.lines) and rng.random() < AROUND_LINES:
        line = picture.lines[rng.integers(len(picture.lines)), :2].astype(np.int64)
        middle = line // FINE + rng.integers(-AROUND_PX, AROUND_PX, 2)
    scale = rng.uniform(*SIZES) if rng.random() < RESIZED else 1.0
    taken_px = min(round(CROP_PX / scale), int(size.min())) // SHRINK * SHRINK
    top, left = (np.clip(middle - taken_px // 2, 0, size - taken_px) // SHRINK * SHRINK).tolist()
    square = np.s_[top : top + taken_px, left : left + taken_px]
    way = cv2.INTER_AREA if taken_px > CROP_PX else cv2.INTER_LINEAR
    image, inside = (cv2.resize(plane[square], (CROP_PX, CROP_PX), interpolation=way) for plane in (image, inside))
    side = CROP_PX // SHRINK
    truth = np.zeros((ORIENTATIONS + 1, side, side), np.float32)
    per_fine = CROP_PX / taken_px / (FINE * SHRINK)
    rows, columns = (
        np.floor((picture.lines[:, k].astype(float) - FINE * low) * per_fine).astype(np.int64)
        for k, low in enumerate((top, left))
    )
    is_in = (rows >= 0) & (rows < side) & (columns >= 0) & (columns < side)
    rows, columns, position = rows[is_in], columns[is_in], picture.lines[is_in, 2] / 256.0 * ORIENTATIONS
    low = np.floor(position).astype(np.int64)
    # A line between two orientations counts for both, as in `matching`.
    for bins, share in ((low, 1.0 - position + low), (low + 1, position - low)):
        np.maximum.at(truth, (bins % ORIENTATIONS, rows, columns), np.minimum(1.0, 2.0 * share).astype(np.float32))
    truth[ORIENTATIONS] = cv2.resize(inside, (side, side), interpolation=cv2.INTER_AREA) / 255.0
    covered = (inside / np.float32(255.0))[..., None]
    plain = np.asarray(image, dtype=np.float32)
    if rng.random() < CLUTTERED:
        plain = covered * plain + (1.0 - covered) * with_flat_things(image, rng)
    if rng.random() < MOTTLED:
        plain = plain * _mottles(rng) ** covered
    # As the searches are shown it.
    shown = _denoiser().denoise(_spoilt(plain, rng))
    if rng.random() < 0.5:
        shown, truth = shown[:, ::-1], truth[TURNED["mirrored"], :, ::-1]
    if rng.random() < 0.5:
        shown, truth = shown[::-1], truth[TURNED["mirrored"], ::-1]
    if rng.random() < 0.5:
        shown, truth = shown.swapaxes(0, 1), truth[TURNED["transposed"]].swapaxes(1, 2)
    as_shown = (shown.astype(np.float32) - np.float32(shown.mean())) / np.float32(INPUT_SCALE)
    return np.ascontiguousarray(as_shown.transpose(2, 0, 1)), np.ascontiguousarray(truth)


@cache
def _denoiser() -> Denoiser:
    return Denoiser()


def _mottles(rng: np.random.Generator) -> NDArray[np.float32]:
    """Factors (S,S,1) as of a cast, ground or painted surface, of one grain or of two."""
    grains = []
    for scale_px in (rng.uniform(0.6, 4.0), rng.uniform(3.0, 14.0)):
        grain = cv2.GaussianBlur(rng.standard_normal((CROP_PX, CROP_PX), dtype=np.float32), (0, 0), scale_px)
        grains.append(grain / grain.std())
    mixed = grains[0] if rng.random() < 0.5 else 0.7 * (grains[0] + grains[1])
    return np.clip(1.0 + rng.uniform(0.04, 0.35) * mixed, 0.1, 2.5)[..., None]


def with_flat_things(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A copy with lines, discs, cards and letters drawn on it: things that have edges and are no solids."""
    drawn = image.copy()
    for _ in range(rng.integers(FEWEST_THINGS, MOST_THINGS + 1)):
        colour = tuple(rng.integers(0, 256, 3).tolist())
        kind, width = rng.choice(4, p=(0.3, 0.2, 0.25, 0.25)), int(rng.integers(1, 6))
        at, to = (tuple(rng.integers(-20, CROP_PX + 20, 2).tolist()) for _ in range(2))
        if kind == 0:
            cv2.line(drawn, at, to, colour, width, cv2.LINE_AA)
        elif kind == 1:
            cv2.circle(drawn, at, int(rng.integers(4, 70)), colour, width if rng.random() < 0.6 else -1, cv2.LINE_AA)
        elif kind == 2:
            card = (tuple(map(float, at)), tuple(rng.uniform(10, 140, 2).tolist()), float(rng.uniform(0, 90)))
            corners = cv2.boxPoints(card).astype(np.int32)
            if rng.random() < 0.5:
                cv2.polylines(drawn, [corners], True, colour, width, cv2.LINE_AA)
            else:
                cv2.fillPoly(drawn, [corners], colour, cv2.LINE_AA)
        else:
            text = "".join(map(chr, rng.integers(48, 123, rng.integers(1, 9))))
            cv2.putText(
                drawn, text, at, int(rng.integers(0, 8)), rng.uniform(0.4, 2.5), colour, 1 + width // 2, cv2.LINE_AA
            )
    return drawn


def _moved(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """As blurred by motion."""
    way, middle = rng.uniform(0.0, np.pi), 6
    half = 0.5 * rng.uniform(2.0, 9.0) * np.array([np.cos(way), np.sin(way)])
    kernel = np.zeros((2 * middle + 1, 2 * middle + 1), np.float32)
    ends = [tuple(np.round(middle + sign * half).astype(int).tolist()) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], (1.0,))
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()))


def _spoilt(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Paler, more saturated, tinted, darker, lit from a side, blurred, noisy, compressed: each now and then."""
    if rng.random() < 0.6:
        grey = rng.uniform(-1.5, 1.0) if rng.random() < 0.5 else rng.uniform()
        image = grey * image.mean(axis=2, keepdims=True) + (1.0 - grey) * image
    if rng.random() < 0.25:
        image = image * rng.uniform(0.55, 1.35, 3)
    image = np.clip(image, 0.0, 255.0).astype(np.float32)
    if rng.random() < 0.5:
        image = 255.0 * (image / 255.0) ** rng.uniform(0.6, 1.6)
    if rng.random() < 0.4:
        image = image * rng.uniform(0.5, 1.1)
    if rng.random() < 0.45:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.5)))
    elif rng.random() < 0.25:
        image = _moved(image, rng)
    if rng.random() < 0.15:
        way = rng.uniform(0.0, 2.0 * np.pi)
        down, right = np.mgrid[:CROP_PX, :CROP_PX] / CROP_PX - 0.5
        slope = rng.uniform(0.2, 1.0) * (right * np.cos(way) + down * np.sin(way))
        image = image * np.clip(1.0 + slope, 0.2, 1.8)[..., None]
    noise = rng.uniform(1.0, 4.0) if rng.random() < 0.5 else rng.uniform(4.0, 22.0)
    image = image + noise * rng.standard_normal(image.shape)
    spoilt = np.clip(np.round(image), 0, 255).astype(np.uint8)
    return compressed(spoilt, int(rng.integers(50, 95))) if rng.random() < 0.3 else spoilt


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """A picture as JPEG leaves it."""
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded, dtype=np.uint8)


def _report(network: Any, pictures: list[LinedPicture], torch: Any) -> None:
    """Say how many places on lines are answered to more than most of those without one nearby."""
    rng = np.random.default_rng(1)
    on_lines, elsewhere = [], []
    for picture in pictures:
        shown, truth = _example(picture, rng)
        with torch.no_grad():
            seen = network(torch.from_numpy(shown[None]))[0, :ORIENTATIONS].amax(0).numpy()
        is_line = truth[:ORIENTATIONS].max(axis=0) > 0.3
        is_near = cv2.dilate(is_line.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        on_lines.append(cv2.dilate(seen, np.ones((3, 3), np.uint8))[is_line])
        elsewhere.append(seen[~is_near])
    lines, others = np.concatenate(on_lines), np.concatenate(elsewhere)
    for share in FALSE_SHARES:
        found = np.mean(lines > np.quantile(others, 1.0 - share))
        print(f"  {100 * found:.0f} % of the lines seen with {100 * share:.0f} % of other places")


def _network(torch: Any) -> Any:
    """The network of `arview.detection.features.edge_net`."""
    nn = torch.nn

    def convolution(before: int, after: int, size: int = 3, step: int = 1) -> Any:
        return nn.Sequential(*normalised(before, after, size, step, torch), nn.ReLU())

    def down(before: int, after: int, blocks: int) -> Any:
        residuals = [residual(after, torch) for _ in range(blocks)]
        return nn.Sequential(convolution(before, after, 3, 2), convolution(after, after), *residuals)

    pairs = list(pairwise(WIDTHS))
    downward = [down(a, b, blocks) for (a, b), blocks in zip(pairs, DEEPER, strict=True)]
    narrow = [convolution(b, a, 1) for a, b in pairs]
    up = [convolution(a, a) for a, _ in pairs]
    first, last = convolution(3, WIDTHS[0], 5, 2), nn.Conv2d(WIDTHS[0], ORIENTATIONS + 1, 1)
    return pyramid(torch, first, downward, narrow, up, last)
