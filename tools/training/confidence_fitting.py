"""Fitting of the confidence: the probability that the best hypothesis of a picture is right."""

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
from arview.detection.confidence import MIN_OUTLINE, ConfidenceTerms
from arview.errors import InputError
from arview.geometry import Array
from arview_lab.evaluation.protocols import spread_frames
from arview_lab.semisynthetic import frames_without_part
from photos import all_photos
from profile_ranker_examples import ALIKE_PIXELS, REFINED_NEAR, is_alike, is_near, pictures_of
from recordings import scenes
from suites.detection import DetectionSuite, recorded_views

RECORDED_EACH, PHOTOS_EACH, RECORDED_WEIGHT = 40, 60, 2.0
"""Frames of each recording, photos without its part, and the weight of each."""
OTHERS_EACH, OTHERS_WEIGHT = 91, 0.5
"""Further pictures without the part, for each shape and recorded part, and their weight."""
PHOTOS_SEED, OTHERS_SEED = 1001, 5000
"""Seeds that differ from those of the evaluation."""
RIDGE = 0.02
"""Ridge penalty on the weights of the standardised terms."""
FOLDS = 5
"""Of the cross-validation, over parts."""
FALSE_ALARMS = (15, 10, 5, 3)
"""Numbers of false alarms for which the report states detections."""

OUTLINE = ConfidenceTerms._fields.index("outline")
WITHOUT_OUTLINE = np.array([field != "outline" for field in ConfidenceTerms._fields], dtype=np.float64)
"""Terms of the regression that relies on the pose verifier."""
WITHOUT_VERIFIER = np.array(
    [field not in ("appearance", "evidence", "profile") for field in ConfidenceTerms._fields], dtype=np.float64
)
"""Terms of the regression that relies on the outline alone."""

LabelledPicture = tuple[Detector, NDArray[np.uint8], Array | None]


@dataclass(frozen=True)
class BestHypothesis:
    """The best hypothesis of a picture: its terms, whether it is right, its part, and the weight of the picture."""

    terms: tuple[float, ...]
    is_right: bool
    part: str
    weight: float


def fit_confidence(seeds: range, photos: Sequence[Path]) -> None:
    """Print the weights of the terms of a pose, and the detections at some numbers of false alarms.

    The bias in the package is lower than the fitted one, so that pictures like those of `_others` give hardly any
    false alarms. Pictures with the part whose best hypothesis is wrong are left out: most are near-symmetric poses.
    """
    budgets = DetectorOptions().budgets
    solids = ((str(seed), 1.0, pictures_of(seed, photos, budgets)) for seed in tqdm(seeds, desc="solids", disable=None))
    recorded = ((name, RECORDED_WEIGHT, _recorded(name)) for name in scenes())
    outcomes = [outcome for part in chain(solids, recorded, _others()) for outcome in _outcomes(*part)]
    if len({outcome.is_right for outcome in outcomes}) < 2:
        raise InputError("fit.py: too few pictures to fit the confidence to; ask for more solids")
    terms = np.array([outcome.terms for outcome in outcomes])
    known, terms = terms, terms * WITHOUT_OUTLINE
    is_right = np.array([outcome.is_right for outcome in outcomes])
    weights = np.array([outcome.weight for outcome in outcomes])
    parts = np.array([outcome.part for outcome in outcomes])
    fold_of = {part: k % FOLDS for k, part in enumerate(dict.fromkeys(parts.tolist()))}
    folds = np.array([fold_of[part] for part in parts])
    predicted = np.zeros(len(outcomes))
    for fold in range(FOLDS):
        fitted = _fitted(terms[folds != fold], is_right[folds != fold], weights[folds != fold])
        predicted[folds == fold] = terms[folds == fold] @ fitted[:-1] + fitted[-1]
    final = _fitted(terms, is_right, weights)
    print("probability", np.round(final[:-1], 2).tolist(), "bias", round(float(final[-1]), 2))
    shown = known[:, OUTLINE] >= MIN_OUTLINE
    if 0 < is_right[shown].sum() < shown.sum():
        by_outline = _fitted(known[shown] * WITHOUT_VERIFIER, is_right[shown], weights[shown])
        print("by_outline", np.round(by_outline[:-1], 2).tolist(), "bias", round(float(by_outline[-1]), 2))
    print(f"in {FOLDS} folds, of {is_right.sum()} right and {(~is_right).sum()} pictures without the part:")
    others = np.sort(predicted[~is_right])[::-1]
    for alarms in FALSE_ALARMS:
        if alarms < len(others):
            found = int(np.sum(predicted[is_right] > others[alarms]))
            print(f"  {found} found with {alarms} false alarms with the bias lowered by {others[alarms]:.2f}")


def _outcomes(part: str, weight: float, pictures: Iterator[LabelledPicture]) -> Iterator[BestHypothesis]:
    for detector, image, truth in pictures:
        found = detector.hypotheses(detector.local.pyramid(image))
        if not found:
            continue
        best = found[0]
        terms = detector.terms(best, found[1:])
        if truth is None:
            yield BestHypothesis(terms, False, part, weight)
            continue
        pose = best.cam_from_body[None]
        near = is_near(detector, pose, truth, detector.disambiguator.all_rotations, *REFINED_NEAR)
        if near[0] or is_alike(detector, pose, truth, REFINED_NEAR[1], ALIKE_PIXELS)[0]:
            yield BestHypothesis(terms, True, part, weight)


def _recorded(name: str) -> Iterator[LabelledPicture]:
    scene = scenes()[name]
    detector = Detector(recorded_views(scene), scene.camera)
    for frame in spread_frames(scene, RECORDED_EACH):
        if frame.cam_from_model is not None:
            yield detector, scene.image(frame), frame.cam_from_model @ detector.local.refiner.part.model_from_body
    camera = scene.camera
    others = all_photos(None, name)
    for _, image in frames_without_part(others, (), camera.width, camera.height, PHOTOS_EACH, PHOTOS_SEED):
        yield detector, image, None


def _others() -> Iterator[tuple[str, float, Iterator[LabelledPicture]]]:
    """Pictures without each shape and recorded part, like those of the evaluation."""
    sections = DetectionSuite(scenes(), {}, Path("out/sequences"))
    for number, name in enumerate([*sections.shapes, *sections.recorded]):
        without = sections.pictures_without(name, OTHERS_EACH, OTHERS_SEED + number)
        yield name, OTHERS_WEIGHT, ((detector, image, None) for detector, _, image in without)


def _fitted(terms: Array, is_right: NDArray[np.bool_], weights: Array) -> Array:
    """Weights of a logistic regression, none of them negative, and the bias last."""
    scale = terms.std(axis=0) + 1e-9
    columns = np.column_stack([terms / scale, np.ones(len(terms))])
    sign = np.where(is_right, 1.0, -1.0)

    def loss(w: Array) -> tuple[float, Array]:
        margin = sign * (columns @ w)
        value = np.sum(weights * np.logaddexp(0.0, -margin)) / weights.sum()
        slope = -columns.T @ (weights * sign / (1.0 + np.exp(margin))) / weights.sum()
        shrink = RIDGE / (len(w) - 1) * np.append(w[:-1], 0.0)
        return float(value + 0.5 * shrink @ w), slope + shrink

    bounds = [(0.0, None)] * terms.shape[1] + [(None, None)]
    found = minimize(loss, np.zeros(terms.shape[1] + 1), jac=True, method="L-BFGS-B", bounds=bounds).x
    return np.append(found[:-1] / scale, found[-1])
