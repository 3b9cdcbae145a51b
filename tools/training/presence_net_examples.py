"""Examples for the component network: looks at components of random assemblies, right and wrong."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.assembly.presence_net import PartImage, component_crops
from arview.cad.model import Component, Model, make_model
from arview.core.atomic import replacing
from arview.detection.features.edge_net import EdgeNet
from arview.evaluation.semisynthetic import CAMERA, VARIANTS, SequenceOptions, render_sequence, trajectory
from arview.evaluation.semisynthetic.backgrounds import read_photo
from arview.evaluation.semisynthetic.look_alikes import look_alikes
from arview.evaluation.semisynthetic.random_solids import random_solid
from arview.geometry import Array, apply, exp_so3, rigid
from arview.guideviews.surface import reduced_surface, surface_about
from arview.refinement.projection import intrinsics_of
from edge_net_examples import covered_picture, crowded_picture, lone_picture
from profile_ranker_examples import ANYWHERE, OCCLUDER, noisy, some_solids
from seeded_files import still_to_make

LEAST_COMPONENTS = 4
"""Solids of fewer are no assemblies."""
PICTURES_EACH, RIGHT_SHARE = 36, 0.4
"""Pictures of an assembly; such a share shows it as it is, the others a look-alike."""
LOOK_ALIKES, RESIZED = 12, 6
"""So many look-alikes, and so many more with a component of another size."""
EXPECTED = 4
"""In each picture so many look-alikes are expected, too, of which only what is changed is looked at."""
SIZES = (0.55, 0.8), (1.25, 1.7)
"""Smaller or larger by such factors."""
MOVED_MM = (10.0, 30.0)
BUILT_SHARE = 0.004
"""Components of any are displaced by so much of the diameter, as in real ones."""
TURNED_DEG, OFF_SHARE, OFF_MM = 0.35, 0.003, 0.6
"""How far off the poses are: what tracking leaves; twice as far in WORSE of them."""
WORSE = 0.3
IN_CROWD = 0.3
"""Share of pictures that show a crowd of other solids too."""
COVERED, COVER_SIZE, COVER_OFF = 0.35, (0.5, 3.0), 0.6
"""Share of pictures in which something is before some component, its half diameter in the component's larger sides, and
how far its middle is off: what is hidden is neither right nor wrong."""


@dataclass(frozen=True)
class Looked:
    """Looks at the components in one picture.

    Attributes:
        solid: its seed.
        pixels, drawn, lines: (N,S,S,4) uint8, (N,6,S,S) int8, 127 for 1, and (N,3,S,S) uint8, see `ComponentCrop`.
        sizes_px: (N,).
        is_wrong: (N,) bool.
    """

    solid: int
    pixels: NDArray[np.uint8]
    drawn: NDArray[np.int8]
    lines: NDArray[np.uint8]
    sizes_px: Array
    is_wrong: NDArray[np.bool_]


def collect_components(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the looks at the components of each assembly to a file of its own, unless it is there."""
    for seed, path in still_to_make(seeds, folder, "components_{}.pkl", "assemblies"):
        looked = list(_looked(seed, photos))
        if looked:
            with replacing(path) as file:
                pickle.dump(looked, file)


def _looked(seed: int, photos: Sequence[Path]) -> Iterator[Looked]:
    try:
        model, occluder = random_solid(seed), random_solid(seed + OCCLUDER)
    except ValueError:  # outlines that cross each other
        return
    if len(model.components) < LEAST_COMPONENTS:
        return
    rng = np.random.default_rng([seed, 5])
    found = look_alikes(model, rng.uniform(*MOVED_MM))
    variants = [(found[k].model, found[k].components) for k in rng.permutation(len(found))[:LOOK_ALIKES]]
    variants += [_resized(model, rng) for _ in range(RESIZED)]
    surfaces = [surface_about(*reduced_surface(one), model.center_in_model) for one, _ in variants]
    surface = surface_about(*reduced_surface(model), model.center_in_model)
    others, network = some_solids(seed), EdgeNet()
    for _ in range(PICTURES_EACH):
        is_right = rng.random() < RIGHT_SHARE
        number = -1 if is_right else int(rng.integers(len(variants)))
        built, changed = (model, ()) if is_right else variants[number]
        variant = VARIANTS[rng.integers(len(VARIANTS))]
        options = SequenceOptions(variant, 1, int(rng.integers(1 << 30)), noise=rng.uniform(2.0, 14.0), motion=ANYWHERE)
        pose = trajectory(model, options)[0]
        shown = _displaced(built, model, rng)
        image = _picture(shown, model, pose, options, (occluder, *others), photos, rng)
        cam_from_body = _off(pose, rng) @ rigid(np.eye(3), model.center_in_model)
        picture = PartImage(image, network.predict(image), intrinsics_of(CAMERA), cam_from_body)
        looks = component_crops(picture, surface, model.diameter_mm)
        is_wrong = [model.components[look.index].name in changed for look in looks]
        for k in rng.permutation(len(variants))[:EXPECTED]:
            expected, names = variants[k]
            only = [i for i, component in enumerate(expected.components) if component.name in names]
            more = component_crops(picture, surfaces[k], model.diameter_mm, only)
            looks += more
            is_wrong += [k != number] * len(more)
        if looks:
            yield Looked(
                seed,
                np.stack([look.pixels for look in looks]),
                np.round(127.0 * np.stack([look.drawn for look in looks])).astype(np.int8),
                np.stack([look.edge_responses for look in looks]),
                np.array([look.size_px for look in looks]),
                np.array(is_wrong),
            )


def _picture(
    shown: Model,
    model: Model,
    pose: Array,
    options: SequenceOptions,
    others: Sequence[Model],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """A picture of what is built for an assembly, perhaps in a crowd, perhaps with something before a component.

    The first of the others is what passes by in sequences with occlusion.
    """
    is_crowded, is_covered = rng.random() < IN_CROWD, rng.random() < COVERED
    if not (is_crowded or is_covered):
        photo = read_photo(photos[rng.integers(len(photos))])
        return next(iter(render_sequence(shown, pose[None], photo, options, CAMERA, others[0]))).image
    picture = (
        crowded_picture(others, (shown, pose), photos, rng)[0] if is_crowded else lone_picture(shown, pose, photos, rng)
    )
    return noisy(_covered(picture, model, pose, others, photos, rng) if is_covered else picture, rng)


def _covered(
    picture: NDArray[np.float32],
    model: Model,
    pose: Array,
    others: Sequence[Model],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """A picture of an assembly with something before one of its components."""
    base = _base(model)
    small = [component for component in model.components if component is not base]
    # Of those on the near side, if there are any: the base hides the others.
    before = [one for one in small if _depth_mm(one, pose) < _depth_mm(base, pose)] or small
    chosen = before[rng.integers(len(before))]
    seen_px = CAMERA.project(apply(pose, chosen.vertices_in_model))
    low_px, high_px = seen_px.min(axis=0), seen_px.max(axis=0)
    size_px = float(np.max(high_px - low_px))
    radius_px = size_px * rng.uniform(*COVER_SIZE)
    place_px = 0.5 * (low_px + high_px) + COVER_OFF * radius_px * rng.normal(size=2)
    return covered_picture(picture, place_px, radius_px, others, photos, rng)


def _depth_mm(component: Component, pose: Array) -> float:
    return float(apply(pose, np.mean(np.stack(component.bounds_in_model), axis=0))[2])


def _off(pose: Array, rng: np.random.Generator) -> Array:
    much = 2.0 if rng.random() < WORSE else 1.0
    turn = exp_so3(np.deg2rad(rng.normal(0.0, much * TURNED_DEG, 3)))
    place = pose[:3, 3] * (1.0 + rng.normal(0.0, much * OFF_SHARE)) + rng.normal(0.0, much * OFF_MM, 3)
    return rigid(turn @ pose[:3, :3], place)


def _base(model: Model) -> Component:
    return max(model.components, key=lambda c: float(np.prod(np.ptp(c.bounds_in_model, axis=0) + 1e-3)))


def _resized(model: Model, rng: np.random.Generator) -> tuple[Model, tuple[str, ...]]:
    """An assembly with one component of another size about its foot on the base, and that one's name."""
    base = _base(model)
    others = [component for component in model.components if component is not base]
    chosen = others[rng.integers(len(others))]
    upright = int(np.argmin(np.ptp(base.bounds_in_model, axis=0)))
    low, high = chosen.bounds_in_model
    foot = 0.5 * (low + high)
    is_above = foot[upright] > np.mean(np.stack(base.bounds_in_model)[:, upright])
    foot[upright] = low[upright] if is_above else high[upright]
    scale = np.full(3, rng.uniform(*SIZES[rng.integers(2)]))
    if rng.random() < 0.5:
        scale[upright] = 1.0
    vertices = foot + scale * (chosen.vertices_in_model - foot)
    changed = [replace(c, vertices_in_model=vertices) if c is chosen else c for c in model.components]
    return make_model(model.name, tuple(changed)), (chosen.name,)


def _displaced(built: Model, model: Model, rng: np.random.Generator) -> Model:
    """An assembly with all components but the base a little displaced."""
    base = _base(model).name
    spread_mm = BUILT_SHARE * model.diameter_mm
    shifted = [
        c
        if c.name == base
        else replace(c, vertices_in_model=c.vertices_in_model + np.clip(rng.normal(0.0, 1.0, 3), -2.0, 2.0) * spread_mm)
        for c in built.components
    ]
    return make_model(built.name, tuple(shifted))
