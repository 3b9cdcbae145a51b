"""Fitting the probability that the best hypothesis of a picture is right."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from tqdm import tqdm

from arview.detection import Detector, DetectorOptions
from arview.errors import InputError
from arview.evaluation.protocols import spread_frames
from arview.evaluation.semisynthetic import frames_without_part
from arview.geometry import Array
from photos import all_photos
from profile_ranker_examples import ALIKE, REFINED_NEAR, is_alike, is_near, pictures_of
from recordings import scenes
from suites.detection import Sections, recorded_views

RECORDED_EACH, PHOTOS_EACH, RECORDED_WEIGHT = 40, 60, 2.0
"""Frames of each recording, and photos without its part; each counts for so many."""
OTHERS_EACH, OTHERS_WEIGHT = 91, 0.5
"""Pictures without it of each shape and recorded part, and what each counts."""
PHOTOS_SEED, OTHERS_SEED = 1001, 5000
"""Others than those of the evaluation."""
SHRINK = 0.02
"""Penalty on squared weights, in deviations of what they are of."""
FOLDS = 5
FALSE = (15, 10, 5, 3)
"""Numbers of false alarms to say the found ones for."""

Seen = tuple[Detector, NDArray[np.uint8], Array | None]


@dataclass(frozen=True)
class Outcome:
    """The best hypothesis of a picture: what speaks for it, whether it is right, its part, how much it counts."""

    terms: tuple[float, ...]
    is_right: bool
    part: str
    weight: float


def fit_probability(seeds: range, photos: Sequence[Path]) -> None:
    """Print the weights of what speaks for a pose, in the order of `confidence_terms`, and how many are told then.

    The bias in use is lowered from that of the fit until pictures like those of `_others` give hardly a false alarm.

    Pictures with the part in which the best hypothesis is wrong are left out: most are twins of the right pose.
    """
    budgets = DetectorOptions().budgets
    solids = ((str(seed), 1.0, pictures_of(seed, photos, budgets)) for seed in tqdm(seeds, desc="solids", disable=None))
    recorded = ((name, RECORDED_WEIGHT, _recorded(name)) for name in scenes())
    outcomes = [outcome for part in chain(solids, recorded, _others()) for outcome in _outcomes(*part)]
    if len({outcome.is_right for outcome in outcomes}) < 2:
        raise InputError("fit_judge: too few pictures to fit a probability to; ask for more solids")
    terms = np.array([outcome.terms for outcome in outcomes])
    is_right = np.array([outcome.is_right for outcome in outcomes])
    weights = np.array([outcome.weight for outcome in outcomes])
    parts = np.array([outcome.part for outcome in outcomes])
    fold_of = {part: k % FOLDS for k, part in enumerate(dict.fromkeys(parts.tolist()))}
    folds = np.array([fold_of[part] for part in parts])
    told = np.zeros(len(outcomes))
    for fold in range(FOLDS):
        fitted = _fitted(terms[folds != fold], is_right[folds != fold], weights[folds != fold])
        told[folds == fold] = terms[folds == fold] @ fitted[:-1] + fitted[-1]
    final = _fitted(terms, is_right, weights)
    print("weights", np.round(final[:-1], 2).tolist(), "bias", round(float(final[-1]), 2))
    print(f"in {FOLDS} folds, of {is_right.sum()} right and {(~is_right).sum()} pictures without the part:")
    others = np.sort(told[~is_right])[::-1]
    for most in FALSE:
        if most < len(others):
            found = int(np.sum(told[is_right] > others[most]))
            print(f"  {found} found with {most} false alarms with the bias lowered by {others[most]:.2f}")


def _outcomes(part: str, weight: float, pictures: Iterator[Seen]) -> Iterator[Outcome]:
    for detector, image, truth in pictures:
        found = detector.hypotheses(detector.local.pyramid(image))
        if not found:
            continue
        best = found[0]
        terms = detector.terms(best, found[1:])
        if truth is None:
            yield Outcome(terms, False, part, weight)
            continue
        pose = best.cam_from_body[None]
        near = is_near(detector, pose, truth, detector.turns, *REFINED_NEAR)
        if near[0] or is_alike(detector, pose, truth, REFINED_NEAR[1], ALIKE)[0]:
            yield Outcome(terms, True, part, weight)


def _recorded(name: str) -> Iterator[Seen]:
    scene = scenes()[name]
    detector = Detector(recorded_views(scene), scene.camera)
    for frame in spread_frames(scene, RECORDED_EACH):
        if frame.cam_from_model is not None:
            yield detector, scene.image(frame), frame.cam_from_model @ detector.local.refiner.part.model_from_body
    camera = scene.camera
    others = all_photos(None, name)
    for _, image in frames_without_part(others, (), camera.width, camera.height, PHOTOS_EACH, PHOTOS_SEED):
        yield detector, image, None


def _others() -> Iterator[tuple[str, float, Iterator[Seen]]]:
    """Every shape and recorded part, with pictures without it such as those of the evaluation."""
    sections = Sections(scenes(), {}, Path("out/sequences"))
    for number, name in enumerate([*sections.shapes, *sections.recorded]):
        without = sections.pictures_without(name, OTHERS_EACH, OTHERS_SEED + number)
        yield name, OTHERS_WEIGHT, ((detector, image, None) for detector, _, image in without)


def _fitted(terms: Array, is_right: NDArray[np.bool_], weights: Array) -> Array:
    """Logistic regression: weights, none negative, and the bias last."""
    scale = terms.std(axis=0) + 1e-9
    columns = np.column_stack([terms / scale, np.ones(len(terms))])
    sign = np.where(is_right, 1.0, -1.0)

    def loss(w: Array) -> tuple[float, Array]:
        margin = sign * (columns @ w)
        value = np.sum(weights * np.logaddexp(0.0, -margin)) / weights.sum()
        slope = -columns.T @ (weights * sign / (1.0 + np.exp(margin))) / weights.sum()
        shrink = SHRINK / (len(w) - 1) * np.append(w[:-1], 0.0)
        return float(value + 0.5 * shrink @ w), slope + shrink

    bounds = [(0.0, None)] * terms.shape[1] + [(None, None)]
    found = minimize(loss, np.zeros(terms.shape[1] + 1), jac=True, method="L-BFGS-B", bounds=bounds).x
    return np.append(found[:-1] / scale, found[-1])
