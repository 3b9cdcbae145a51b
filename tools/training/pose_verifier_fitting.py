"""Fitting the network of the verifier to examples."""

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
from networks.score_nets import Design, Shown, fit, fit_score_network, scored, telling_loss, together
from pair_examples import Twins
from presence_net_examples import Looked
from profile_ranker_examples import Looks, read_examples

DESIGN = Design(
    "verifier",
    (CROP_CHANNELS + RESPONSE_CHANNELS, CROP_SIDE_PX, CROP_SIDE_PX),
    POSE_SCALARS,
    (24, 24, 48, 48, 96, 128),
    deepened=(3, 5),
    rate=2e-3,
)
PICTURES, POSES = 6, 20
"""A step looks at so many poses of so many pictures, a third of them right where there are any."""
REFINED_WEIGHT = 3.0
"""Refined poses are taken so much oftener than others."""
LISTWISE_WEIGHT = 0.3
"""Beside telling right from wrong in all pictures, the right pose of each is to be told from its others."""
DECAY = 2e-2
UNSURE = 0.3
"""Share of pictures in which the line network sees less, and as many in which it sees less of solids."""
HELD_OUT = 8
"""Every so manieth solid is not fitted to, but for telling how well others are verified."""
FALSE_SHARES = (0.0, 0.02, 0.05, 0.1)
"""Shares of false alarms to say the found ones for."""


def fit_verifier(folder: Path, epochs: int, is_anew: bool = True) -> None:
    """Fit the network to the looks in a folder, write verifier.onnx there, and say how well it does.

    Args:
        folder: with looks, see `collect_examples`.
        epochs: how often each picture is looked at.
        is_anew: not going on from the network in use.

    Raises:
        InputError: no examples, or no torch or onnx.
    """
    torch = torch_with_onnx()
    fitted, left = read_examples(folder, "looks_*.pkl", HELD_OUT)
    fit_score_network(
        DESIGN, folder, fitted, is_anew, _altered,
        lambda network, rate: _fit(network, fitted, epochs, rate, torch),
        lambda network: _report(network, left, torch),
        torch,
    )  # fmt: skip


def _fit(network: Any, looks: Sequence[Looks], epochs: int, rate: float, torch: Any) -> None:
    def shown(some: NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = [(looks[i], _chosen(looks[i], rng)) for i in some]
        truth = [torch.from_numpy(look.is_right[index]) for look, index in chosen]
        return *together(_inputs(look, index, rng) for look, index in chosen), truth

    def loss_of(some: Any) -> Any:
        seen, both, truth = some
        return telling_loss(scored(network, seen, both, torch), truth, LISTWISE_WEIGHT / PICTURES, torch)

    fit("verifier", network.parameters(), (len(looks), PICTURES, epochs), rate, DECAY, shown, loss_of, torch)


def _altered(look: Looks, rng: np.random.Generator) -> Shown:
    return _inputs(look, _chosen(look, rng), rng)


def _chosen(look: Looks, rng: np.random.Generator) -> list[int]:
    """Some poses of a picture."""
    weights = np.where(look.is_refined, REFINED_WEIGHT, 1.0)
    index: list[int] = []
    for group, most in ((look.is_right, POSES // 3), (~look.is_right, POSES)):
        some = np.flatnonzero(group)
        count = min(len(some), most - len(index))
        if count > 0:
            index += rng.choice(some, count, replace=False, p=weights[some] / weights[some].sum()).tolist()
    return index


def _inputs(look: Looks, index: Sequence[int], rng: np.random.Generator | None = None) -> Shown:
    """Poses of a picture as the network takes them; with random numbers altered, all of them alike."""
    shown, contrasts, explained = network_input(look, index, rng)
    both = []
    for k, contrast, share in zip(index, contrasts, explained, strict=True):
        # What is known of refined poses only is the mean for the others.
        known = look.known[k] if look.is_refined[k] else KNOWN_MEANS
        both.append(pose_scalars(float(look.radii_px[k]), contrast, known, share))
    return shown, np.stack(both)


def network_input(
    looked: Looks | Looked | Twins, index: Sequence[int], rng: np.random.Generator | None
) -> tuple[NDArray[np.float32], list[float], list[float]]:
    """Some looks of a picture as networks take them, with their contrasts and shares explained; perhaps altered."""
    plain, contrasts = zip(
        *(normalise_colours(looked.pixels[k], looked.drawn[k].astype(np.float32) / 127.0) for k in index), strict=True
    )
    lines = looked.lines[list(index)].astype(np.float32) / np.float32(255.0)
    seen = np.concatenate([np.stack(plain), lines], axis=1)
    if rng is not None:
        seen = augmented(seen, rng)
    shown, explained = zip(*map(append_gradients, np.ascontiguousarray(seen[:, :PLAIN_CHANNELS])), strict=True)
    return np.concatenate([np.stack(shown), seen[:, PLAIN_CHANNELS:]], axis=1), list(contrasts), list(explained)


def augmented(seen: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """The poses of one picture mirrored, turned, recoloured, shaded, blurred, noisier, or with something in front.

    What follows the plain channels is mirrored, turned and hidden too, or weaker: on materials that it
    does not know the line network is sure of little.
    """
    if rng.random() < 0.5:
        seen = mirrored(seen)
    if rng.random() < 0.5:
        seen = seen[..., ::-1, :].copy()
        seen[:, NORMAL_Y] *= -1.0
    if rng.random() < 0.5:
        seen = seen.swapaxes(2, 3).copy()
        seen[:, [NORMAL_X, NORMAL_Y]] = seen[:, [NORMAL_Y, NORMAL_X]]
    seen = np.concatenate([seen[:, rng.permutation(3)], seen[:, 3:]], axis=1)
    if rng.random() < 0.25:
        share = rng.uniform(0.5, 1.0)
        seen[:, :3] += share * (seen[:, :3].mean(axis=1, keepdims=True) - seen[:, :3])
    if rng.random() < 0.3:
        shade = 1.0 + rng.normal(0.0, rng.uniform(0.0, 0.3), (5, 5)).astype(np.float32)
        shift = rng.normal(size=(3, 1, 1)).astype(np.float32)
        seen[:, :3] = ((seen[:, :3] + shift) * cv2.resize(shade, seen.shape[2:]) - shift) * seen[:, 3:4]
    if rng.random() < 0.25:
        width_px = rng.uniform(0.4, 0.8)
        for one in seen:
            one[:3] = [cv2.GaussianBlur(np.ascontiguousarray(plane), (3, 3), width_px) for plane in one[:3]]
    if rng.random() < 0.4:
        seen[:, :3] += rng.uniform(0.0, 0.25) * rng.standard_normal(seen[:, :3].shape, dtype=np.float32)
    if rng.random() < 0.3:
        side = seen.shape[-1]
        width, height = rng.integers(side // 10, side // 3, 2)
        left, top = rng.integers(0, side - width), rng.integers(0, side - height)
        seen[:, :3, top : top + height, left : left + width] = rng.normal(size=(1, 3, 1, 1))
        seen[:, PLAIN_CHANNELS:, top : top + height, left : left + width] = 0.0
    for channels in (slice(PLAIN_CHANNELS, None), slice(PLAIN_CHANNELS + RESPONSE_CHANNELS - 1, None)):
        if rng.random() < UNSURE:
            seen[:, channels] *= rng.uniform(0.0, 1.0)
    return np.ascontiguousarray(seen)


def _report(network: Any, looks: Sequence[Looks], torch: Any) -> None:
    """Say how many pictures' right refined poses come before those of pictures without the solid, and before others."""
    with_it, without, first, first_of = [], [], 0, 0
    for look in looks:
        refined = np.flatnonzero(look.is_refined)
        if not len(refined):
            continue
        with torch.no_grad():
            scores = network(*map(torch.from_numpy, _inputs(look, refined.tolist()))).numpy()
        right = look.is_right[refined]
        if not look.is_right.any():
            without.append(scores.max())
        elif right.any():
            with_it.append(scores[right].max())
            first += bool(right[np.argmax(scores)])
            first_of += 1
    print(f"other solids: a right pose first in {first} of {first_of} pictures")
    highest = np.sort(without)[::-1]
    for share in FALSE_SHARES if len(highest) else ():
        found = np.mean(np.array(with_it) > highest[int(share * len(highest))])
        print(f"  {100 * found:.0f} % found with {100 * share:.0f} % false alarms, of {len(highest)} without it")
