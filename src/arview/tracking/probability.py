"""Quality of a tracked pose: the probability that it is right, from the evidence of its frame.

A pose is right within 5 cm, 5° and a tenth of the part's diameter. The probability is a logistic regression with
weights of known sign, fitted by ``tools/training/fit.py tracked-pose`` to poses tracked from right and wrong starts.
Wrong poses differ from right ones less by the edges that they find, which there are anywhere, than by the colours
beside the outline and by how well the frame determines the pose.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from arview.core.kernel import kernel
from arview.geometry import Array
from arview.tracking.estimate import Estimate
from arview.weights import load_weights

SURE_SIGMA_DEG, SURE_SIGMA_SHARE = 3.0, 0.03
"""Standard deviations of the least certain rotation, and of the least certain translation in diameters, up to which
they say nothing about the pose."""


class PoseFeatures(NamedTuple):
    """Features of the evidence for a tracked pose, or the weights of these features.

    Attributes:
        outline: support and sharpness of the outline, as in `PoseEvidence.score`.
        inner: support of design edges beyond a half, by their share, at most a half.
        informed_colours: region support by its information and by the share of the outline.
        colours: region support.
        log_in_picture: logarithm of the share of the outline inside the picture.
        log_sigma_deg: logarithm of the largest standard deviation of the rotation relative to `SURE_SIGMA_DEG`, at
            least 0.
        log_sigma_mm: the same of the translation, relative to `SURE_SIGMA_SHARE` of the diameter.
        restless: 1 for a pose that jumped in several of the last frames.
        texture: share of the expected texture that was found.
        negative_scatter_px: negative mean distance of the supporting steps from the outline.
    """

    outline: float
    inner: float
    informed_colours: float
    colours: float
    log_in_picture: float
    log_sigma_deg: float
    log_sigma_mm: float
    restless: float
    texture: float
    negative_scatter_px: float


def pose_features(estimate: Estimate, covariance: Array, diameter_mm: float) -> PoseFeatures:
    """Features of an estimate with its covariance (6,6), of a part of some diameter."""
    evidence = estimate.evidence
    share = min(0.5, evidence.inner_share)
    colours = max(evidence.region_support, 0.0)
    sigma_rad, sigma_mm = _max_sigmas(covariance)
    sigma_deg, sigma_share = math.degrees(sigma_rad), sigma_mm / diameter_mm
    return PoseFeatures(
        outline=0.6 * evidence.contour_support + 0.4 * evidence.sharpness,
        inner=share * (evidence.inner_support - 0.5),
        informed_colours=(1.0 - share) * colours * min(evidence.region_information / 0.2, 1.0),
        colours=colours,
        log_in_picture=math.log(max(evidence.points_in_picture, 0.05)),
        log_sigma_deg=math.log(max(sigma_deg / SURE_SIGMA_DEG, 1.0)),
        log_sigma_mm=math.log(max(sigma_share / SURE_SIGMA_SHARE, 1.0)),
        restless=float(estimate.is_restless),
        texture=estimate.texture_share,
        negative_scatter_px=-evidence.scatter_px,
    )


def pose_probability(features: PoseFeatures) -> float:
    """Probability, 0–1, that a pose with these features is right."""
    weights, bias = _weights()
    logit = bias + sum(weight * value for weight, value in zip(weights, features, strict=True))
    return 1.0 / (1.0 + math.exp(-max(min(logit, 50.0), -50.0)))


@kernel
def _max_sigmas(covariance: Array) -> tuple[float, float]:
    """Largest standard deviations of rotation, rad, and translation, mm, of a covariance (6,6)."""
    turn, shift = np.linalg.eigvalsh(covariance[:3, :3].copy())[2], np.linalg.eigvalsh(covariance[3:, 3:].copy())[2]
    return np.sqrt(max(turn, 0.0)), np.sqrt(max(shift, 0.0))


@cache
def _weights() -> tuple[PoseFeatures, float]:
    group = dict(load_weights("tracked_pose")["probability"])
    bias = group.pop("bias")
    return PoseFeatures(**group), bias
