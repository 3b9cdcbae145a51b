"""Training of the edge net on pictures of random solids."""

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
from edge_net_examples import FINE, EdgePicture, read_edge_pictures
from networks.layers import convolution_and_norm, residual_block, write_image_network
from networks.net2net import CONTINUED_RATE_SHARE, packaged_weights, torch_with_onnx, widen_from
from networks.unet import unet

WIDTHS = (16, 32, 56, 80, 96)
"""Channels of the levels, each of half the size of the one before."""
RESIDUAL_BLOCKS = (0, 0, 2, 2)
"""Residual blocks (He et al., CVPR 2016) on each level after the first: they cost little on the small ones."""
CROP_PX, CROPS = 256, 8
"""Side and number of the square crops of a batch."""
NEAR_EDGE_SHARE, NEAR_EDGE_PX = 0.75, 110
"""Share of the crops near an edge, and the largest distance of their centres from it."""
EDGE_PIXEL_WEIGHT, EDGES_WEIGHT, INSIDE_WEIGHT = 5.0, 4.0, 0.2
"""Weights of edge pixels against others, of the loss of edges, and of that of the inside, an auxiliary output."""
RESIZED_SHARE, SIZES = 0.5, (0.62, 1.3)
"""Share of the crops that are resized, and the range of factors."""
MOTTLED_SHARE, CLUTTERED_SHARE = 0.45, 0.3
"""Shares of the crops with a grain on the solids, and with flat shapes drawn on the background."""
MIN_FLAT_SHAPES, MAX_FLAT_SHAPES = 1, 6
"""Range of the number of flat shapes in a crop."""
RATE, DECAY, WARM_UP = 2.5e-3, 1e-2, 0.01
HELD_OUT, INITIAL_CROPS = 20, 24
"""One picture in this many is held out for the report; crops from which continued training is initialised."""
FALSE_POSITIVE_RATES = (0.05, 0.02, 0.01)
"""False positive rates for which the report states recall."""
CHANNEL_ORDERS = {
    "mirrored": [0, 7, 6, 5, 4, 3, 2, 1, 8],
    "transposed": [4, 3, 2, 1, 0, 7, 6, 5, 8],
}
"""Order of the channels, orientations and inside, after a flip of the crop."""


def fit_edge_net(folder: Path, epochs: int, from_scratch: bool = True) -> None:
    """Train the network on the pictures in a folder, write edge_net.onnx there, and report its recall.

    Args:
        folder: with pictures, see `collect_edge_pictures`.
        epochs: passes over the pictures.
        from_scratch: False continues from the network in the package.

    Raises:
        InputError: no pictures, no torch or onnx, or the network in the package is wider.
    """
    torch = torch_with_onnx()
    pictures = read_edge_pictures(folder)
    torch.manual_seed(0)
    network = _network(torch)
    fitted = [p for k, p in enumerate(pictures) if k % HELD_OUT]
    if not from_scratch:
        rng = np.random.default_rng(5)
        inputs = torch.from_numpy(
            np.stack([_example(fitted[k], rng)[0] for k in rng.integers(len(fitted), size=INITIAL_CROPS)])
        )
        widen_from(network, packaged_weights("edge_net.onnx"), lambda: network(inputs), torch)
    _fit(network, fitted, epochs, RATE if from_scratch else CONTINUED_RATE_SHARE * RATE, torch)
    network.eval()
    _report(network, pictures[::HELD_OUT], torch)
    write_image_network(torch.nn.Sequential(network, torch.nn.Sigmoid()), folder / "edge_net.onnx", "lines", torch)


def _fit(network: Any, pictures: list[EdgePicture], epochs: int, rate: float, torch: Any) -> None:
    rng = np.random.default_rng(0)
    network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=DECAY)
    steps = max(1, len(pictures) // CROPS)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * steps, pct_start=WARM_UP)
    for epoch in range(epochs):
        losses = []
        for _ in range(steps):
            crops = [_example(pictures[k], rng) for k in rng.integers(len(pictures), size=CROPS)]
            inputs, truth = (torch.from_numpy(np.stack(part)) for part in zip(*crops, strict=True))
            with torch.autocast("cpu", torch.bfloat16):
                outputs = network(inputs.contiguous(memory_format=torch.channels_last))
            loss = _loss(outputs.float(), truth, torch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"edge net, epoch {epoch + 1} of {epochs}: loss {np.mean(losses):.4f}", flush=True)


def _loss(outputs: Any, truth: Any, torch: Any) -> Any:
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    edges = slice(0, ORIENTATIONS)
    weights = 1.0 + (EDGE_PIXEL_WEIGHT - 1.0) * (truth[:, edges] > 0.1)
    inside = entropy(outputs[:, ORIENTATIONS], truth[:, ORIENTATIONS])
    return EDGES_WEIGHT * (entropy(outputs[:, edges], truth[:, edges], weight=weights)) + INSIDE_WEIGHT * inside


def _example(picture: EdgePicture, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A crop as network input (3,S,S), and the target, orientations of edges and inside (9,S/2,S/2)."""
    image = picture.image()
    inside = cv2.imdecode(np.frombuffer(picture.inside, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert inside is not None
    size = np.array(image.shape[:2])
    middle = rng.integers(size)
    if len(picture.edges) and rng.random() < NEAR_EDGE_SHARE:
        edge = picture.edges[rng.integers(len(picture.edges)), :2].astype(np.int64)
        middle = edge // FINE + rng.integers(-NEAR_EDGE_PX, NEAR_EDGE_PX, 2)
    scale = rng.uniform(*SIZES) if rng.random() < RESIZED_SHARE else 1.0
    taken_px = min(round(CROP_PX / scale), int(size.min())) // SHRINK * SHRINK
    top, left = (np.clip(middle - taken_px // 2, 0, size - taken_px) // SHRINK * SHRINK).tolist()
    square = np.s_[top : top + taken_px, left : left + taken_px]
    way = cv2.INTER_AREA if taken_px > CROP_PX else cv2.INTER_LINEAR
    image, inside = (cv2.resize(plane[square], (CROP_PX, CROP_PX), interpolation=way) for plane in (image, inside))
    side = CROP_PX // SHRINK
    truth = np.zeros((ORIENTATIONS + 1, side, side), np.float32)
    per_fine = CROP_PX / taken_px / (FINE * SHRINK)
    rows, columns = (
        np.floor((picture.edges[:, k].astype(float) - FINE * low) * per_fine).astype(np.int64)
        for k, low in enumerate((top, left))
    )
    is_in = (rows >= 0) & (rows < side) & (columns >= 0) & (columns < side)
    rows, columns, position = rows[is_in], columns[is_in], picture.edges[is_in, 2] / 256.0 * ORIENTATIONS
    low = np.floor(position).astype(np.int64)
    # A line between two orientations counts for both, as in `matching`.
    for bins, share in ((low, 1.0 - position + low), (low + 1, position - low)):
        np.maximum.at(truth, (bins % ORIENTATIONS, rows, columns), np.minimum(1.0, 2.0 * share).astype(np.float32))
    truth[ORIENTATIONS] = cv2.resize(inside, (side, side), interpolation=cv2.INTER_AREA) / 255.0
    covered = (inside / np.float32(255.0))[..., None]
    plain = np.asarray(image, dtype=np.float32)
    if rng.random() < CLUTTERED_SHARE:
        plain = covered * plain + (1.0 - covered) * with_flat_shapes(image, rng)
    if rng.random() < MOTTLED_SHARE:
        plain = plain * _mottles(rng) ** covered
    # Denoised, as the detector does.
    inputs = _denoiser().denoise(_degraded(plain, rng))
    if rng.random() < 0.5:
        inputs, truth = inputs[:, ::-1], truth[CHANNEL_ORDERS["mirrored"], :, ::-1]
    if rng.random() < 0.5:
        inputs, truth = inputs[::-1], truth[CHANNEL_ORDERS["mirrored"], ::-1]
    if rng.random() < 0.5:
        inputs, truth = inputs.swapaxes(0, 1), truth[CHANNEL_ORDERS["transposed"]].swapaxes(1, 2)
    normalised = (inputs.astype(np.float32) - np.float32(inputs.mean())) / np.float32(INPUT_SCALE)
    return np.ascontiguousarray(normalised.transpose(2, 0, 1)), np.ascontiguousarray(truth)


@cache
def _denoiser() -> Denoiser:
    return Denoiser()


def _mottles(rng: np.random.Generator) -> NDArray[np.float32]:
    """Brightness factors (S,S,1) of a cast, ground or painted surface, with a grain of one scale or of two."""
    grains = []
    for scale_px in (rng.uniform(0.6, 4.0), rng.uniform(3.0, 14.0)):
        grain = cv2.GaussianBlur(rng.standard_normal((CROP_PX, CROP_PX), dtype=np.float32), (0, 0), scale_px)
        grains.append(grain / grain.std())
    mixed = grains[0] if rng.random() < 0.5 else 0.7 * (grains[0] + grains[1])
    return np.clip(1.0 + rng.uniform(0.04, 0.35) * mixed, 0.1, 2.5)[..., None]


def with_flat_shapes(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A copy with lines, discs, cards and letters drawn on it: shapes with edges that are not solids."""
    drawn = image.copy()
    for _ in range(rng.integers(MIN_FLAT_SHAPES, MAX_FLAT_SHAPES + 1)):
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


def _motion_blurred(image: NDArray[Any], rng: np.random.Generator) -> NDArray[np.float32]:
    """The image blurred by a linear motion."""
    way, middle = rng.uniform(0.0, np.pi), 6
    half = 0.5 * rng.uniform(2.0, 9.0) * np.array([np.cos(way), np.sin(way)])
    kernel = np.zeros((2 * middle + 1, 2 * middle + 1), np.float32)
    ends = [tuple(np.round(middle + sign * half).astype(int).tolist()) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], (1.0,))
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()))


def _degraded(image: NDArray[Any], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Random changes of saturation, tint, brightness and illumination, blur, noise and compression."""
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
        image = _motion_blurred(image, rng)
    if rng.random() < 0.15:
        way = rng.uniform(0.0, 2.0 * np.pi)
        down, right = np.mgrid[:CROP_PX, :CROP_PX] / CROP_PX - 0.5
        slope = rng.uniform(0.2, 1.0) * (right * np.cos(way) + down * np.sin(way))
        image = image * np.clip(1.0 + slope, 0.2, 1.8)[..., None]
    noise = rng.uniform(1.0, 4.0) if rng.random() < 0.5 else rng.uniform(4.0, 22.0)
    image = image + noise * rng.standard_normal(image.shape)
    degraded = np.clip(np.round(image), 0, 255).astype(np.uint8)
    return compressed(degraded, int(rng.integers(50, 95))) if rng.random() < 0.3 else degraded


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """An image after JPEG compression."""
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded, dtype=np.uint8)


def _report(network: Any, pictures: list[EdgePicture], torch: Any) -> None:
    """Print the share of edge pixels found at some false positive rates."""
    rng = np.random.default_rng(1)
    on_edges, off_edges = [], []
    for picture in pictures:
        inputs, truth = _example(picture, rng)
        with torch.no_grad():
            outputs = network(torch.from_numpy(inputs[None]))[0, :ORIENTATIONS].amax(0).numpy()
        is_edge = truth[:ORIENTATIONS].max(axis=0) > 0.3
        is_near = cv2.dilate(is_edge.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        on_edges.append(cv2.dilate(outputs, np.ones((3, 3), np.uint8))[is_edge])
        off_edges.append(outputs[~is_near])
    edges, others = np.concatenate(on_edges), np.concatenate(off_edges)
    for share in FALSE_POSITIVE_RATES:
        found = np.mean(edges > np.quantile(others, 1.0 - share))
        print(f"  {100 * found:.0f} % of edge pixels found with {100 * share:.0f} % false positives")


def _network(torch: Any) -> Any:
    """The network of `arview.detection.features.edge_net`."""
    nn = torch.nn

    def convolution(before: int, after: int, size: int = 3, step: int = 1) -> Any:
        return nn.Sequential(*convolution_and_norm(before, after, size, step, torch), nn.ReLU())

    def down(before: int, after: int, blocks: int) -> Any:
        residuals = [residual_block(after, torch) for _ in range(blocks)]
        return nn.Sequential(convolution(before, after, 3, 2), convolution(after, after), *residuals)

    pairs = list(pairwise(WIDTHS))
    downward = [down(a, b, blocks) for (a, b), blocks in zip(pairs, RESIDUAL_BLOCKS, strict=True)]
    narrow = [convolution(b, a, 1) for a, b in pairs]
    up = [convolution(a, a) for a, _ in pairs]
    first, last = convolution(3, WIDTHS[0], 5, 2), nn.Conv2d(WIDTHS[0], ORIENTATIONS + 1, 1)
    return unet(torch, first, downward, narrow, up, last)
