"""Examples for the presence net: crops at the components of random assemblies that are right or wrong."""

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
from arview.geometry import Array, apply, exp_so3, rigid
from arview.guideviews.surface import reduced_surface, surface_about
from arview.refinement.projection import intrinsics_of
from arview_lab.semisynthetic import CAMERA, VARIANTS, SequenceOptions, render_sequence, trajectory
from arview_lab.semisynthetic.backgrounds import read_photo
from arview_lab.semisynthetic.look_alikes import look_alikes
from arview_lab.semisynthetic.random_solids import random_solid
from edge_net_examples import cluttered_picture, lone_picture, occluded_picture
from profile_ranker_examples import ANYWHERE, OCCLUDER, noisy, some_solids
from seeded_files import missing_files

MIN_COMPONENTS = 4
"""Smallest number of components of an assembly."""
PICTURES_EACH, RIGHT_SHARE = 36, 0.4
"""Pictures of an assembly, and the share of them that show it as designed; the others show a look-alike."""
LOOK_ALIKES, RESIZED, REDUCED = 12, 6, 10
"""Look-alikes of an assembly, those with one component of another size, and those without several components."""
MIN_ABSENT_SHARE = 0.15
"""Smallest share of the components besides the base that is left out of the last kind; the largest is all of them."""
EXPECTED_EACH = 4
"""Look-alikes whose changed components are cropped in each picture, as if they were the design."""
SIZES = (0.55, 0.8), (1.25, 1.7)
"""Ranges of the factors of smaller and of larger components."""
MOVED_MM = (10.0, 30.0)
"""Range of the displacement of moved components."""
ASSEMBLY_SHARE = 0.004
"""Standard deviation of the positions of all components, as a share of the diameter: real assemblies are not exact."""
ERROR_DEG, ERROR_SHARE, ERROR_MM = 0.35, 0.003, 0.6
"""Standard deviations of the poses, as of a tracker: rotation, share of the distance, and position."""
WORSE_SHARE = 0.3
"""Share of the pictures with twice these errors."""
CLUTTERED_SHARE = 0.3
"""Share of the pictures that are cluttered with other solids."""
OCCLUDED_SHARE, OCCLUDER_SIZE, OCCLUDER_SHIFT = 0.35, (0.5, 3.0), 0.6
"""Share of the pictures with a solid in front of a component, range of its radius relative to the size of the
component, and standard deviation of its shift, in radii. An occluded component looks neither right nor wrong."""


@dataclass(frozen=True)
class ComponentCrops:
    """Crops at the components in one picture.

    Attributes:
        solid: seed of the assembly.
        pixels, drawn, edges: (N,S,S,4) uint8, (N,6,S,S) int8, 127 for 1, and (N,3,S,S) uint8, see `ComponentCrop`.
        sizes_px: (N,) size of each component in the picture.
        is_wrong: (N,) bool.
    """

    solid: int
    pixels: NDArray[np.uint8]
    drawn: NDArray[np.int8]
    edges: NDArray[np.uint8]
    sizes_px: Array
    is_wrong: NDArray[np.bool_]


def collect_components(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the crops at the components of each assembly, unless its file exists."""
    for seed, path in missing_files(seeds, folder, "components_{}.pkl", "assemblies"):
        examples = list(_component_crops(seed, photos))
        if examples:
            with replacing(path) as file:
                pickle.dump(examples, file)


def _component_crops(seed: int, photos: Sequence[Path]) -> Iterator[ComponentCrops]:
    """Crops in all pictures of one assembly; none where the solid of the seed is not an assembly."""
    try:
        model, occluder = random_solid(seed), random_solid(seed + OCCLUDER)
    except ValueError:  # outlines that cross each other
        return
    if len(model.components) < MIN_COMPONENTS:
        return
    rng = np.random.default_rng([seed, 5])
    found = look_alikes(model, rng.uniform(*MOVED_MM))
    variants = [(found[k].model, found[k].components) for k in rng.permutation(len(found))[:LOOK_ALIKES]]
    variants += [_resized(model, rng) for _ in range(RESIZED)]
    variants += [_reduced(model, rng) for _ in range(REDUCED)]
    surfaces = [surface_about(*reduced_surface(one), model.center_in_model) for one, _ in variants]
    surface = surface_about(*reduced_surface(model), model.center_in_model)
    # Where components are only left out, the CAD expects nothing else.
    expectable = [k for k, (one, names) in enumerate(variants) if {c.name for c in one.components} & {*names}]
    others, network = some_solids(seed), EdgeNet()
    for _ in range(PICTURES_EACH):
        is_right = rng.random() < RIGHT_SHARE
        number = -1 if is_right else int(rng.integers(len(variants)))
        built, changed = (model, ()) if is_right else variants[number]
        variant = VARIANTS[int(rng.integers(len(VARIANTS)))]
        options = SequenceOptions(variant, 1, int(rng.integers(1 << 30)), noise=rng.uniform(2.0, 14.0), motion=ANYWHERE)
        pose = trajectory(model, options)[0]
        shown = slightly_displaced(built, model, rng)
        image = _picture(shown, model, pose, options, (occluder, *others), photos, rng)
        cam_from_body = perturbed_pose(pose, rng) @ rigid(np.eye(3), model.center_in_model)
        picture = PartImage(image, network.predict(image), intrinsics_of(CAMERA), cam_from_body)
        crops = component_crops(picture, surface, model.diameter_mm)
        is_wrong = [model.components[crop.index].name in changed for crop in crops]
        for k in rng.permutation(expectable)[:EXPECTED_EACH]:
            expected, names = variants[k]
            only = [i for i, component in enumerate(expected.components) if component.name in names]
            more = component_crops(picture, surfaces[k], model.diameter_mm, only)
            crops += more
            is_wrong += [k != number] * len(more)
        if crops:
            yield ComponentCrops(
                seed,
                np.stack([crop.pixels for crop in crops]),
                np.round(127.0 * np.stack([crop.drawn for crop in crops])).astype(np.int8),
                np.stack([crop.edge_responses for crop in crops]),
                np.array([crop.size_px for crop in crops]),
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
    """A picture of an assembly as built, perhaps cluttered, perhaps with a solid in front of a component.

    Args:
        shown: the assembly as built.
        model: the assembly as designed.
        pose: (4,4) ``cam_from_model``.
        options: of the sequence, where the picture is neither cluttered nor occluded.
        others: further solids; the first is the one that passes by in sequences with occlusion.
        photos: for the background.
        rng: random numbers.
    """
    is_cluttered, is_occluded = rng.random() < CLUTTERED_SHARE, rng.random() < OCCLUDED_SHARE
    if not (is_cluttered or is_occluded):
        photo = read_photo(photos[int(rng.integers(len(photos)))])
        return next(iter(render_sequence(shown, pose[None], photo, options, CAMERA, others[0]))).image
    picture = (
        cluttered_picture(others, (shown, pose), photos, rng)[0]
        if is_cluttered
        else lone_picture(shown, pose, photos, rng)
    )
    return noisy(_occluded(picture, model, pose, others, photos, rng) if is_occluded else picture, rng)


def _occluded(
    picture: NDArray[np.float32],
    model: Model,
    pose: Array,
    others: Sequence[Model],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """A picture of an assembly with another solid in front of one of its components."""
    base = _base(model)
    small = [component for component in model.components if component is not base]
    # A component on the near side, if there is any: the base hides the others.
    before = [one for one in small if _depth_mm(one, pose) < _depth_mm(base, pose)] or small
    chosen = before[int(rng.integers(len(before)))]
    corners_px = CAMERA.project(apply(pose, chosen.vertices_in_model))
    low_px, high_px = corners_px.min(axis=0), corners_px.max(axis=0)
    size_px = float(np.max(high_px - low_px))
    radius_px = size_px * rng.uniform(*OCCLUDER_SIZE)
    place_px = 0.5 * (low_px + high_px) + OCCLUDER_SHIFT * radius_px * rng.normal(size=2)
    return occluded_picture(picture, place_px, radius_px, others, photos, rng)


def _depth_mm(component: Component, pose: Array) -> float:
    return float(apply(pose, np.mean(component.bounds_in_model, axis=0))[2])


def perturbed_pose(pose: Array, rng: np.random.Generator) -> Array:
    """A pose with the error of a tracker."""
    much = 2.0 if rng.random() < WORSE_SHARE else 1.0
    turn = exp_so3(np.deg2rad(rng.normal(0.0, much * ERROR_DEG, 3)))
    place = pose[:3, 3] * (1.0 + rng.normal(0.0, much * ERROR_SHARE)) + rng.normal(0.0, much * ERROR_MM, 3)
    return rigid(turn @ pose[:3, :3], place)


def _base(model: Model) -> Component:
    """The component with the largest bounding box, which carries the others."""
    return max(model.components, key=lambda c: float(np.prod(np.ptp(c.bounds_in_model, axis=0) + 1e-3)))


def _resized(model: Model, rng: np.random.Generator) -> tuple[Model, tuple[str, ...]]:
    """An assembly with one component scaled about its foot on the base, and the name of that component."""
    base = _base(model)
    others = [component for component in model.components if component is not base]
    chosen = others[int(rng.integers(len(others)))]
    upright = int(np.argmin(np.ptp(base.bounds_in_model, axis=0)))
    low, high = chosen.bounds_in_model
    foot = 0.5 * (low + high)
    is_above = foot[upright] > np.mean(base.bounds_in_model[:, upright])
    foot[upright] = low[upright] if is_above else high[upright]
    scale = np.full(3, rng.uniform(*SIZES[rng.integers(2)]))
    if rng.random() < 0.5:
        scale[upright] = 1.0
    vertices = foot + scale * (chosen.vertices_in_model - foot)
    changed = [replace(c, vertices_in_model=vertices) if c is chosen else c for c in model.components]
    return make_model(model.name, tuple(changed)), (chosen.name,)


def _reduced(model: Model, rng: np.random.Generator) -> tuple[Model, tuple[str, ...]]:
    """An assembly without several of its components, up to all but the base, and the names of those left out."""
    base = _base(model)
    others = [component for component in model.components if component is not base]
    count = int(np.ceil(rng.uniform(MIN_ABSENT_SHARE, 1.0) * len(others)))
    absent = {others[k].name for k in rng.permutation(len(others))[:count]}
    left = tuple(component for component in model.components if component.name not in absent)
    return make_model(model.name, left), tuple(sorted(absent))


def slightly_displaced(built: Model, model: Model, rng: np.random.Generator) -> Model:
    """An assembly whose components, except for the base, are slightly displaced."""
    base = _base(model).name
    spread_mm = ASSEMBLY_SHARE * model.diameter_mm
    shifted = [
        c
        if c.name == base
        else replace(c, vertices_in_model=c.vertices_in_model + np.clip(rng.normal(0.0, 1.0, 3), -2.0, 2.0) * spread_mm)
        for c in built.components
    ]
    return make_model(built.name, tuple(shifted))
