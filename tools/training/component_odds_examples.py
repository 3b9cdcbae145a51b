"""Examples for the log odds of components: measurements at places that are empty, filled, or behind something."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.assembly.log_odds import evidence_features
from arview.assembly.observation import ComponentObserver, Known, base_of
from arview.cad.model import Model, make_model
from arview.core.atomic import replacing
from arview.geometry import Array, apply, exp_so3, rigid
from arview.guideviews import GuideViewOptions, GuideViewSet, make_guide_views
from arview.rendering.renderers import ZBufferRenderer
from arview_lab.evaluation.protocols import full_sphere_range
from arview_lab.semisynthetic import CAMERA
from arview_lab.semisynthetic.random_solids import random_solid
from edge_net_examples import cluttered_picture, lone_picture, occluded_picture
from presence_net_examples import perturbed_pose, slightly_displaced
from profile_ranker_examples import OCCLUDER, noisy, some_solids
from seeded_files import missing_files

PRESENT, ABSENT, OCCLUDED, DROPPED = 0, 1, 2, -1
"""Classes of a place; those that are partly occluded are dropped."""
MIN_COMPONENTS, MAX_COMPONENTS = 3, 20
"""Range of the number of components of an assembly."""
PICTURES_EACH = 24
"""Pictures of an assembly."""
CLUTTERED_SHARE, OCCLUDED_SHARE = 0.3, 0.5
"""Shares of the pictures that are cluttered with other solids, and that have a solid in front of the part."""
OCCLUDER_RADIUS = (0.05, 0.35)
"""Range of the occluder's radius relative to the size of the part in the picture."""
VIEW_ERROR_DEG = 2.0
"""Angle between a picture's direction and the nearest guide view's."""
DISTANCES_MM = (420.0, 950.0)
"""Range of the distance of the camera."""
CHANGED_GREY = 6.0
"""Grey levels by which a pixel behind the occluder differs."""
CLEAR_SHARE, HIDDEN_SHARE = 0.1, 0.65
"""A place of which less is behind the occluder is clear, one of which more is occluded."""


@dataclass(frozen=True)
class ComponentOdds:
    """Measurements in the pictures of one assembly.

    Attributes:
        solid: seed of the assembly.
        features: (N,F) see `arview.assembly.log_odds.FEATURES`.
        classes: (N,) PRESENT, ABSENT or OCCLUDED.
        pictures: (N,) number of the picture.
    """

    solid: int
    features: Array
    classes: NDArray[np.int64]
    pictures: NDArray[np.int64]


def collect_component_odds(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the measurements of each assembly, unless its file exists."""
    for seed, path in missing_files(seeds, folder, "odds_{}.npz", "assemblies"):
        found = _component_odds(seed, photos)
        if found is not None:
            with replacing(path) as file:
                np.savez(file, solid=seed, features=found.features, classes=found.classes, pictures=found.pictures)


def read_component_odds(folder: Path) -> list[ComponentOdds]:
    """All measurements in a folder."""
    found = []
    for path in sorted(folder.glob("odds_*.npz")):
        with np.load(path) as content:
            arrays = {name: content[name] for name in content.files}
        found.append(ComponentOdds(int(arrays["solid"]), arrays["features"], arrays["classes"], arrays["pictures"]))
    return found


def _component_odds(seed: int, photos: Sequence[Path]) -> ComponentOdds | None:
    """Measurements in all pictures of one assembly; None where the solid of the seed is not a fit one."""
    try:
        model = random_solid(seed)
    except ValueError:  # outlines that cross each other
        return None
    if not MIN_COMPONENTS <= len(model.components) <= MAX_COMPONENTS:
        return None
    rng = np.random.default_rng([seed, 11])
    views = make_guide_views(model, full_sphere_range(*DISTANCES_MM), GuideViewOptions(subdivisions=2))
    observer, others = ComponentObserver(views, CAMERA, model), some_solids(seed + OCCLUDER)
    features, classes, pictures = [], [], []
    for number in range(PICTURES_EACH):
        for row, kind in _picture_odds(model, views, observer, others, photos, rng):
            features.append(row)
            classes.append(kind)
            pictures.append(number)
    if not features:
        return None
    return ComponentOdds(seed, np.array(features), np.array(classes), np.array(pictures))


def _picture_odds(
    model: Model,
    views: GuideViewSet,
    observer: ComponentObserver,
    others: Sequence[Model],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> Iterator[tuple[Array, int]]:
    """Features (F,) and class of each component in one picture of an assembly, of which some are absent."""
    count, base = len(model.components), base_of(model)
    is_absent = _absent(count, base, rng)
    kept = tuple(one for one, absent in zip(model.components, is_absent, strict=True) if not absent)
    shown = slightly_displaced(make_model(model.name, kept), model, rng)
    pose = _pose(views, rng)
    picture = (
        cluttered_picture(others, (shown, pose), photos, rng)[0]
        if rng.random() < CLUTTERED_SHARE
        else lone_picture(shown, pose, photos, rng)
    )
    ids = ZBufferRenderer(model, CAMERA).render(pose).component_ids
    is_hidden = np.zeros(ids.shape, dtype=bool)
    if rng.random() < OCCLUDED_SHARE and (ids >= 0).any():
        before = _occluded(picture, ids, base, others, photos, rng)
        is_hidden = np.abs(before - picture).max(axis=2) > CHANGED_GREY
        picture = before
    image = noisy(picture, rng)
    known = Known(
        (~is_absent) & (rng.random(count) < 0.5 * rng.random()),
        is_absent & (rng.random(count) < 0.7 * rng.random()),
        np.zeros(count, dtype=bool),
    )
    evidence, _ = observer.measure(image, perturbed_pose(pose, rng), known)
    features = evidence_features(evidence)
    for c in np.flatnonzero(evidence.support.supported >= 0.0):
        place = ids == c
        if c == base or not place.any():
            continue
        hidden = float(np.mean(is_hidden[place]))
        if hidden > HIDDEN_SHARE:
            yield features[c], OCCLUDED
        elif hidden < CLEAR_SHARE:
            yield features[c], ABSENT if is_absent[c] else PRESENT


def _absent(count: int, base: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(C,) components to leave out: none, one, two, half or all but the base."""
    others = rng.permutation(np.delete(np.arange(count), base))
    number = (0, 1, 2, len(others) // 2, len(others))[int(rng.integers(5))]
    is_absent = np.zeros(count, dtype=bool)
    is_absent[others[:number]] = True
    return is_absent


def _pose(views: GuideViewSet, rng: np.random.Generator) -> Array:
    """A random pose, ``cam_from_model``, near the direction of a guide view, with the part mostly in the picture."""
    view = views.poses[int(rng.integers(len(views)))]
    spin = exp_so3([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    tilt = exp_so3(np.deg2rad(VIEW_ERROR_DEG) * rng.normal(size=3))
    rotation = spin @ tilt @ view[:3, :3]
    distance_mm = float(np.exp(rng.uniform(*np.log(DISTANCES_MM))))
    place_px = np.array([CAMERA.width, CAMERA.height]) * rng.uniform(0.3, 0.7, 2)
    center = distance_mm * np.append((place_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], 1.0)
    pose = rigid(rotation, np.zeros(3))
    return rigid(rotation, center - apply(pose, views.center_in_model))


def _occluded(
    picture: NDArray[np.float32],
    ids: NDArray[np.int16],
    base: int,
    others: Sequence[Model],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """A picture with another solid in front of some of the part, mostly before a component."""
    v, u = np.nonzero((ids >= 0) & (ids != base)) if (ids[ids >= 0] != base).any() else np.nonzero(ids >= 0)
    chosen = int(rng.integers(len(u)))
    part_px = float(np.max(np.ptp(np.argwhere(ids >= 0), axis=0)) + 1)
    radius_px = part_px * float(np.exp(rng.uniform(*np.log(OCCLUDER_RADIUS))))
    place_px = np.array([u[chosen], v[chosen]]) + 0.4 * radius_px * rng.normal(size=2)
    return occluded_picture(picture, place_px, radius_px, others, photos, rng)
