"""Training of the pose verifier."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.detection.scoring.crops import (
    CROP_CHANNELS,
    CROP_SIDE_PX,
    NORMAL_X,
    NORMAL_Y,
    PLAIN_CHANNELS,
    RESPONSE_CHANNELS,
    append_gradients,
    normalise_colours,
)
from arview.detection.scoring.pose_verifier import KNOWN_MEANS, POSE_SCALARS, pose_scalars
from arview.detection.scoring.score_net import mirrored
from networks.net2net import torch_with_onnx
from networks.score_nets import (
    NetworkInputs,
    ScoreNetDesign,
    concatenated,
    half_precision_scores,
    ranking_loss,
    train,
    train_score_net,
)
from pair_examples import NearSymmetricPoses
from presence_net_examples import ComponentCrops
from profile_ranker_examples import PoseCrops, read_examples

DESIGN = ScoreNetDesign(
    "pose_verifier",
    (CROP_CHANNELS + RESPONSE_CHANNELS, CROP_SIDE_PX, CROP_SIDE_PX),
    POSE_SCALARS,
    (24, 24, 48, 48, 96, 128),
    deepened=(3, 5),
    rate=2e-3,
)
PICTURES, POSES = 6, 20
"""Pictures of a batch and poses of each, of which up to a third are right."""
REFINED_WEIGHT = 3.0
"""How much more often refined poses are chosen than others."""
LISTWISE_WEIGHT = 0.3
"""Weight of the ranking inside each picture, beside the classification over all pictures."""
DECAY = 2e-2
WEAKENED_SHARE = 0.3
"""Share of the pictures with weakened edge-response maps, and with a weakened map of the solids alone."""
HELD_OUT = 8
"""One solid in this many is held out for the report."""
FALSE_ALARM_RATES = (0.0, 0.02, 0.05, 0.1)
"""Rates of false alarms for which the report states detections."""


def fit_pose_verifier(folder: Path, epochs: int, from_scratch: bool = True) -> None:
    """Train the network on the crops in a folder, write pose_verifier.onnx there, and report its quality.

    Args:
        folder: with crops, see `collect_pose_examples`.
        epochs: passes over the pictures.
        from_scratch: False continues from the network in the package.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    fitted, held_out = read_examples(folder, "crops_*.pkl", HELD_OUT)
    train_score_net(
        DESIGN, folder, fitted, from_scratch, _augmented_inputs,
        lambda network, rate: _fit(network, fitted, epochs, rate, torch),
        lambda network: _report(network, held_out, torch),
        torch,
    )  # fmt: skip


def _fit(network: Any, examples: Sequence[PoseCrops], epochs: int, rate: float, torch: Any) -> None:
    def batch_of(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = [(examples[i], _chosen(examples[i], rng)) for i in some]
        truth = [torch.from_numpy(example.is_right[index]) for example, index in chosen]
        return *concatenated(_inputs(example, index, rng) for example, index in chosen), truth

    def loss_of(some: Any) -> Any:
        maps, scalars, truth = some
        return ranking_loss(
            half_precision_scores(network, maps, scalars, torch), truth, LISTWISE_WEIGHT / PICTURES, torch
        )

    train(
        "pose verifier", network.parameters(), (len(examples), PICTURES, epochs), rate, DECAY, batch_of, loss_of, torch
    )


def _augmented_inputs(example: PoseCrops, rng: np.random.Generator) -> NetworkInputs:
    return _inputs(example, _chosen(example, rng), rng)


def _chosen(example: PoseCrops, rng: np.random.Generator) -> list[int]:
    """Indices of some poses of a picture."""
    weights = np.where(example.is_refined, REFINED_WEIGHT, 1.0)
    index: list[int] = []
    for group, limit in ((example.is_right, POSES // 3), (~example.is_right, POSES)):
        some = np.flatnonzero(group)
        count = min(len(some), limit - len(index))
        if count > 0:
            index += rng.choice(some, count, replace=False, p=weights[some] / weights[some].sum()).tolist()
    return index


def _inputs(example: PoseCrops, index: Sequence[int], rng: np.random.Generator | None = None) -> NetworkInputs:
    """Network inputs of some poses of a picture; with random numbers augmented, all in the same way."""
    with_gradient_maps, contrasts, explained = network_input(example, index, rng)
    scalars = []
    for k, contrast, share in zip(index, contrasts, explained, strict=True):
        # Inputs that only refined poses have are set to their means for the others.
        known = example.known[k] if example.is_refined[k] else KNOWN_MEANS
        scalars.append(pose_scalars(float(example.radii_px[k]), contrast, known, share))
    return with_gradient_maps, np.stack(scalars)


def network_input(
    crops: PoseCrops | ComponentCrops | NearSymmetricPoses, index: Sequence[int], rng: np.random.Generator | None
) -> tuple[NDArray[np.float32], list[float], list[float]]:
    """Maps of some crops, augmented if ``rng`` is given, with the contrast and the explained share of each."""
    plain, contrasts = zip(
        *(normalise_colours(crops.pixels[k], crops.drawn[k].astype(np.float32) / 127.0) for k in index), strict=True
    )
    edges = crops.edges[list(index)].astype(np.float32) / np.float32(255.0)
    maps = np.concatenate([np.stack(plain), edges], axis=1)
    if rng is not None:
        maps = augmented(maps, rng)
    with_gradient_maps, explained = zip(
        *map(append_gradients, np.ascontiguousarray(maps[:, :PLAIN_CHANNELS])), strict=True
    )
    return (
        np.concatenate([np.stack(with_gradient_maps), maps[:, PLAIN_CHANNELS:]], axis=1),
        list(contrasts),
        list(explained),
    )


def augmented(maps: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Maps (N,C,S,S) of one picture after random flips, changes of colour and shading, blur, noise and occlusion.

    The edge-response maps after the plain channels are flipped and occluded alike, and weakened at
    random: the edge net responds less on materials that it was not trained on.
    """
    if rng.random() < 0.5:
        maps = mirrored(maps)
    if rng.random() < 0.5:
        maps = maps[..., ::-1, :].copy()
        maps[:, NORMAL_Y] *= -1.0
    if rng.random() < 0.5:
        maps = maps.swapaxes(2, 3).copy()
        maps[:, [NORMAL_X, NORMAL_Y]] = maps[:, [NORMAL_Y, NORMAL_X]]
    maps = np.concatenate([maps[:, rng.permutation(3)], maps[:, 3:]], axis=1)
    if rng.random() < 0.25:
        share = rng.uniform(0.5, 1.0)
        maps[:, :3] += share * (maps[:, :3].mean(axis=1, keepdims=True) - maps[:, :3])
    if rng.random() < 0.3:
        shade = 1.0 + rng.normal(0.0, rng.uniform(0.0, 0.3), (5, 5)).astype(np.float32)
        shift = rng.normal(size=(3, 1, 1)).astype(np.float32)
        maps[:, :3] = ((maps[:, :3] + shift) * cv2.resize(shade, maps.shape[2:]) - shift) * maps[:, 3:4]
    if rng.random() < 0.25:
        width_px = rng.uniform(0.4, 0.8)
        for one in maps:
            one[:3] = [cv2.GaussianBlur(np.ascontiguousarray(plane), (3, 3), width_px) for plane in one[:3]]
    if rng.random() < 0.4:
        maps[:, :3] += rng.uniform(0.0, 0.25) * rng.standard_normal(maps[:, :3].shape, dtype=np.float32)
    if rng.random() < 0.3:
        side = maps.shape[-1]
        width, height = rng.integers(side // 10, side // 3, 2)
        held_out, top = rng.integers(0, side - width), rng.integers(0, side - height)
        maps[:, :3, top : top + height, held_out : held_out + width] = rng.normal(size=(1, 3, 1, 1))
        maps[:, PLAIN_CHANNELS:, top : top + height, held_out : held_out + width] = 0.0
    for channels in (slice(PLAIN_CHANNELS, None), slice(PLAIN_CHANNELS + RESPONSE_CHANNELS - 1, None)):
        if rng.random() < WEAKENED_SHARE:
            maps[:, channels] *= rng.uniform(0.0, 1.0)
    return np.ascontiguousarray(maps)


def _report(network: Any, examples: Sequence[PoseCrops], torch: Any) -> None:
    """Print how often a right refined pose is first in its picture, and detections at some rates of false alarms."""
    scores_with, scores_without, ranked_first, ranked = [], [], 0, 0
    for example in examples:
        refined = np.flatnonzero(example.is_refined)
        if not len(refined):
            continue
        with torch.no_grad():
            scores = network(*map(torch.from_numpy, _inputs(example, refined.tolist()))).numpy()
        right = example.is_right[refined]
        if not example.is_right.any():
            scores_without.append(scores.max())
        elif right.any():
            scores_with.append(scores[right].max())
            ranked_first += bool(right[np.argmax(scores)])
            ranked += 1
    print(f"other solids: a right pose first in {ranked_first} of {ranked} pictures")
    highest = np.sort(scores_without)[::-1]
    for share in FALSE_ALARM_RATES if len(highest) else ():
        found = np.mean(np.array(scores_with) > highest[int(share * len(highest))])
        print(f"  {100 * found:.0f} % found with {100 * share:.0f} % false alarms, of {len(highest)} without it")
