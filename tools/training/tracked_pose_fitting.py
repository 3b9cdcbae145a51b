"""Fitting of the quality of tracked poses: a logistic regression with weights of known sign.

Each scene is tracked for some frames from its true poses and from wrong ones. What the tracker makes of them is right
or wrong by the truth; parts that look the same when they are turned cannot be told and should not be among the scenes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import chi2

from arview.core.atomic import replacing
from arview.errors import InputError
from arview.geometry import Array, exp_so3, invert, log_se3, rigid
from arview.tracking import TrackingSession, specimen
from arview.tracking.probability import PoseFeatures, pose_features
from arview.weights import weights_file
from arview_lab.evaluation import PoseMeter, load_scene
from arview_lab.evaluation.run import scene_guide_views

STARTS = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75)
"""Shares of the sequence at which tracking starts."""
FRAMES_RIGHT, FRAMES_WRONG = 30, 8
"""Frames tracked from a true pose and from a wrong one."""
OFFSETS = ((8.0, 0.05), (20.0, 0.1), (45.0, 0.1), (100.0, 0.05), (180.0, 0.3))
"""Rotation in deg and shift in diameters of the wrong starts."""
RIGHT_MM, RIGHT_DEG, RIGHT_SHARE = 50.0, 5.0, 0.1
"""Errors up to which a pose is right: translation, rotation, translation as a share of the diameter."""
WRONG_WEIGHT = 0.7
"""Weight of wrong poses, of which there are more than in use."""
RIDGE = 0.003
"""Penalty on the weights, relative to the mean log likelihood."""
SIGNS = PoseFeatures(1, 1, 1, 1, 1, -1, -1, -1, 1, 1)
"""Signs of the weights."""
BINS = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Bounds of the classes of quality in the table."""


@dataclass(frozen=True)
class TrackedPoses:
    """Poses tracked in one scene.

    Attributes:
        name: of the scene.
        features: (N,F) see `PoseFeatures`.
        is_right: (N,) by the truth.
        is_from_truth: (N,) tracked from a true pose.
        distances: (N,) squared Mahalanobis distance of the truth; only of right poses does it say something.
    """

    name: str
    features: Array
    is_right: NDArray[np.bool_]
    is_from_truth: NDArray[np.bool_]
    distances: Array


def fit_tracked_pose(scenes: Sequence[Path], turned: Sequence[Path], folder: Path) -> None:
    """Track the scenes, fit the weights, print how they do on scenes left out, and write them.

    Args:
        scenes: folders with exact truth.
        turned: folders of which only the true rotations are exact.
        folder: of the tracked poses, which are kept.

    Raises:
        InputError: fewer than three scenes.
    """
    if len(scenes) < 3:
        raise InputError(f"fit.py: {len(scenes)} scenes, at least three are needed")
    found = [*(_kept(scene, folder, True) for scene in scenes), *(_kept(scene, folder, False) for scene in turned)]
    for line in _report(found):
        print(line)
    weights = _fitted(found)
    path = Path(str(weights_file("tracked_pose.json")))
    names = (*PoseFeatures._fields, "bias")
    content = {"probability": dict(zip(names, np.round(weights, 3).tolist(), strict=True))}
    with replacing(path) as file:
        file.write((json.dumps(content, indent=2) + "\n").encode())
    print(f"wrote {path}")


def _kept(scene: Path, folder: Path, has_translations: bool) -> TrackedPoses:
    """The tracked poses of a scene, from the file in which an earlier run has left them if there is one."""
    name = "_".join(scene.resolve().parts[-3:])
    path = folder / f"tracked_{name}.npz"
    if not path.exists():
        rows = list(_tracked(scene, has_translations))
        features, is_right, is_from_truth, distances = (np.array(column) for column in zip(*rows, strict=True))
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            np.savez(file, features=features, is_right=is_right, is_from_truth=is_from_truth, distances=distances)
        print(f"{name}: {len(rows)} poses, {np.count_nonzero(~is_right)} wrong", flush=True)
    with np.load(path) as stored:
        return TrackedPoses(name, **{key: stored[key] for key in stored.files})


def _tracked(folder: Path, has_translations: bool) -> Iterator[tuple[PoseFeatures, bool, bool, float]]:
    """Features of the poses tracked from right and wrong starts, whether they are right, and their distances."""
    scene = load_scene(folder)
    model, views = scene.part.model, scene_guide_views(scene)
    meter = PoseMeter(model, scene.camera, views)
    frames = [(frame, frame.cam_from_model) for frame in scene.frames if frame.cam_from_model is not None]
    rng = np.random.default_rng(1)
    center = rigid(np.eye(3), model.center_in_model)
    seen: list[PoseFeatures] = []

    def noted(*of: Any) -> PoseFeatures:
        seen.append(pose_features(*of))
        return seen[-1]

    with patch.object(specimen, "pose_features", noted):
        for share in STARTS:
            first = int(share * len(frames))
            for angle_deg, shift in ((0.0, 0.0), *OFFSETS):
                axis, way = rng.normal(size=(2, 3))
                turn = exp_so3(np.deg2rad(rng.uniform(0.7, 1.2) * angle_deg) * axis / np.linalg.norm(axis))
                move = center @ rigid(turn, shift * model.diameter_mm * way) @ invert(center)
                start = frames[first][1] @ move
                session = TrackingSession.of(views, scene.camera, model, initial_cam_from_model=start)
                count = FRAMES_RIGHT if angle_deg == 0.0 else FRAMES_WRONG
                for k, (frame, truth) in enumerate(frames[first : first + count]):
                    (pose,) = session.process(scene.image(frame), k, k / 30.0)
                    if pose.cam_from_model is None or pose.covariance is None:
                        break
                    error = meter.measure(pose.cam_from_model, truth)
                    limit_mm = min(RIGHT_MM, RIGHT_SHARE * model.diameter_mm) if has_translations else np.inf
                    is_right = error.rotation_deg <= RIGHT_DEG and error.translation_mm <= limit_mm
                    twist = log_se3(invert(center) @ invert(pose.cam_from_model) @ truth @ center)
                    distance = float(twist @ np.linalg.solve(pose.covariance, twist))
                    if k and not pose.alternatives:
                        yield seen[-1], is_right, angle_deg == 0.0, distance


def _fitted(found: Sequence[TrackedPoses]) -> Array:
    """Weights (F+1,) of the features and the bias; every scene counts as much."""
    features = np.concatenate([one.features for one in found])
    right = np.concatenate([one.is_right for one in found]).astype(float)
    weight = np.concatenate([np.where(one.is_right, 1.0, WRONG_WEIGHT) / len(one.is_right) for one in found])
    weight /= weight.sum()
    rows = np.column_stack([features, np.ones(len(features))])
    penalty = RIDGE * np.append(np.std(features, axis=0) ** 2, 0.0)

    def loss(weights: Array) -> tuple[float, Array]:
        logits = rows @ weights
        value = float(weight @ (np.logaddexp(0.0, logits) - right * logits) + penalty @ weights**2)
        return value, rows.T @ (weight * (expit(logits) - right)) + 2.0 * penalty * weights

    bounds = [(0.0, None) if sign > 0 else (None, 0.0) for sign in SIGNS]
    start = np.zeros(rows.shape[1])
    return np.asarray(minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[*bounds, (None, None)]).x)


def _report(found: Sequence[TrackedPoses]) -> list[str]:
    """Scenes that were left out of the fit: how often poses of a quality are right, and how many lie."""
    quality = []
    for one in found:
        weights = _fitted([other for other in found if other is not one])
        quality.append(expit(one.features @ weights[:-1] + weights[-1]))
    joined, right = np.concatenate(quality), np.concatenate([one.is_right for one in found])
    lines = ["quality      poses  mean   right"]
    for low, high in pairwise(BINS):
        of = (joined >= low) & (joined < high + (high == 1.0))
        if of.any():
            lines.append(f"{low:.2f}-{high:.2f} {of.sum():8d}  {joined[of].mean():.3f}  {right[of].mean():.3f}")
    lines.append(f"{'scene':32s} right  quality  from truth (right, quality)  wrong at 0.9  inside the 95 % ellipsoid")
    bound = chi2.ppf(0.95, 6)
    for one, values in zip(found, quality, strict=True):
        true = one.is_from_truth
        inside = np.mean(one.distances[one.is_right & true] < bound)
        wrong = np.count_nonzero((values >= 0.9) & ~one.is_right)
        lines.append(
            f"{one.name:32s} {one.is_right.mean():.3f}  {values.mean():.3f}    {one.is_right[true].mean():.3f} "
            f"{values[true].mean():.3f}                  {wrong:4d}          {inside:.3f}"
        )
    return lines
