"""Examples for the profile ranker and the pose verifier: poses that the detector tries on random solids, labelled."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.core.atomic import replacing
from arview.detection import Detector
from arview.detection.detector import DetectorOptions
from arview.detection.features.image_pyramid import ImagePyramid
from arview.detection.scoring.crops import pose_crop
from arview.detection.scoring.profile_ranker import RADII_PX, describe_poses
from arview.detection.search.global_search import WIDE, PoseCandidate, SearchBudget
from arview.detection.search.hypothesis import Hypothesis
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.guideviews.cache import cached_guide_views
from arview_lab.evaluation.protocols import full_sphere_range
from arview_lab.semisynthetic import (
    CAMERA,
    VARIANTS,
    SequenceFrame,
    SequenceOptions,
    TrajectoryOptions,
    Variant,
    frames_without_part,
    render_sequence,
    trajectory,
)
from arview_lab.semisynthetic.ambiguity import changed_share
from arview_lab.semisynthetic.backgrounds import read_photo
from arview_lab.semisynthetic.random_solids import random_solid
from edge_net_examples import cluttered_picture, coloured, recoloured
from seeded_files import missing_files

FRAMES_EACH = 4
"""Pictures of a solid in each variant, each at another pose."""
WITHOUT_EACH = 4
"""Photos without the solid, and as many pictures of another solid."""
ANYWHERE = TrajectoryOptions(turn_deg=90.0, step_mm=250.0, smooth_frames=1.0)
"""A trajectory whose frames have unrelated poses."""
CLUTTERED_EACH, CLUTTERED_WITHOUT_EACH = 6, 4
"""Pictures cluttered with other solids, with and without the solid."""
OTHERS_EACH = 8
"""Solids that the clutter is chosen from."""
RECOLOURED_SHARE, DARK_SHARE = 0.5, 0.4
"""Share of the variants in which a solid has other colours, and of these the share in which it is nearly black."""
DARK_GREY = (0.03, 0.15)
"""Range of the grey of nearly black solids."""
PRINTED_SHARE = 0.5
"""Share of the solids with a photo printed on."""
SHADOWED_SHARE = 0.4
"""Share of the solids that cast a soft shadow on the background, as a part does that lies on something."""
SHADOW_SHIFT, SHADOW_BLUR, SHADOW_DARKNESS = 0.2, (0.01, 0.1), (0.2, 0.8)
"""Largest shift and range of the blur, in square roots of the covered area, and range of the darkness."""
BLURRED_SHARE = 0.2
"""Share of the pictures with motion blur or defocus."""
MOTION_PX, DEFOCUS_PX, GRAIN = (3.0, 14.0), (0.8, 2.4), (1.0, 4.0)
"""Ranges of the two, and of the standard deviation of the noise there, grey levels."""
LIKELIEST, RANDOM_OTHERS, MAX_RIGHT = 60, 60, 40
"""Rough poses that become examples: the likeliest, random ones, and right ones."""
OTHER_SOLID, OCCLUDER = 3301, 7919
"""Offsets of the seeds of other solids."""
ROUGH_NEAR, REFINED_NEAR = (15.0, 0.12), (5.0, 0.06)
"""A pose is right within this angle (deg) and this share of diameter and distance of the true one."""
ROUGH_APART, REFINED_APART = (25.0, 0.2), (7.0, 0.12)
"""A pose is wrong beyond this from the true pose and its near-symmetric counterparts; those between are left out."""
SEARCHED_SHARE = 0.6
"""Limits of the rough stage, after the pattern search, as a share of those before."""
SAME_PIXELS, ALIKE_PIXELS = 0.01, 0.03
"""Largest shares of differing pixels at which a rotated pose is right, and at which it is not wrong."""
CROPS_WITH, CROPS_WITHOUT = 8, 12
"""Poses after the pattern search that become crops, of pictures with and without the solid."""
NEAR_TRUTH, OFF_TRUTH = 5, 9
"""Further crops: poses near the true one, and clearly off it."""


@dataclass(frozen=True)
class PoseGroup:
    """Competing poses of one picture.

    Attributes:
        solid: seed of the solid.
        stage: rough or refined.
        edges, scalars: inputs of each network by its name; the edges as 0–255.
        logits: (N,) evidence of refined poses, else 0.
        is_right: (N,) bool; all False where the solid is not in the picture.
    """

    solid: int
    stage: str
    edges: dict[str, NDArray[np.uint8]]
    scalars: dict[str, NDArray[np.float32]]
    logits: NDArray[np.float32]
    is_right: NDArray[np.bool_]


@dataclass(frozen=True)
class PoseCrops:
    """Crops of one picture around several poses, for the pose verifier.

    Attributes:
        solid: seed of the solid.
        pixels, drawn, edges: (N,S,S,4) uint8, (N,6,S,S) int8, 127 for 1, and (N,3,S,S) uint8, see `pose_crop`.
        radii_px: (N,) half the diameter in the picture.
        known: (N,3) the other inputs of the verifier, for refined poses.
        is_refined, is_right: (N,) bool.
    """

    solid: int
    pixels: NDArray[np.uint8]
    drawn: NDArray[np.int8]
    edges: NDArray[np.uint8]
    radii_px: Array
    known: Array
    is_refined: NDArray[np.bool_]
    is_right: NDArray[np.bool_]


def collect_pose_examples(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write the pose groups and the crops of each solid, unless its file exists."""
    for seed, path in missing_files(seeds, folder, "groups_{}.pkl", "solids"):
        examples = [e for picture in pictures_of(seed, photos, (WIDE,)) for e in _examples(seed, *picture)]
        for kind, name in ((PoseCrops, f"crops_{seed}.pkl"), (PoseGroup, path.name)):
            with replacing(folder / name) as file:
                pickle.dump([example for example in examples if isinstance(example, kind)], file)


def read_examples(folder: Path, pattern: str, every: int) -> tuple[list[Any], list[Any]]:
    """The examples in the files of a folder, split into those to train on and those held out.

    Args:
        folder: of the files.
        pattern: of their names.
        every: one solid in this many is held out.

    Raises:
        InputError: no examples.
    """
    examples = [example for path in sorted(folder.glob(pattern)) for example in pickle.loads(path.read_bytes())]
    if not examples:
        raise InputError(f"{folder}: no examples of {pattern}; make them by fit.py --help")
    solids = sorted({example.solid for example in examples})
    held_out = set(solids[::every]) if len(solids) > 1 else set()
    fitted, left = ([e for e in examples if (e.solid in held_out) == is_left] for is_left in (False, True))
    return fitted, left


def pictures_of(
    seed: int,
    photos: Sequence[Path],
    budgets: tuple[SearchBudget, ...],
    solid_of: Callable[[int], Model] = random_solid,
) -> Iterator[tuple[Detector, NDArray[np.uint8], Array | None]]:
    """Pictures with and without a solid, each with a detector of the solid and its true ``cam_from_body``, or None.

    Args:
        seed: of the solid and of all that is random.
        photos: for backgrounds.
        budgets: of the searches of the detector.
        solid_of: makes the solid of a seed; other solids in the pictures are random ones.
    """
    rng = np.random.default_rng([seed, 4])
    for detector, image, truth in _pictures_of(seed, photos, budgets, solid_of):
        yield detector, _blurred(image, rng) if rng.random() < BLURRED_SHARE else image, truth


def _pictures_of(
    seed: int, photos: Sequence[Path], budgets: tuple[SearchBudget, ...], solid_of: Callable[[int], Model]
) -> Iterator[tuple[Detector, NDArray[np.uint8], Array | None]]:
    """The pictures of `pictures_of` without motion blur and defocus."""
    try:
        solid, occluder, other = solid_of(seed), random_solid(seed + OCCLUDER), random_solid(seed + OTHER_SOLID)
    except ValueError:  # outlines that cross each other
        return
    rng = np.random.default_rng([seed, 2])
    views = cached_guide_views(solid, full_sphere_range(*ANYWHERE.distance_mm))
    detector = Detector(views, CAMERA, DetectorOptions(budgets=budgets))
    for variant in VARIANTS:
        shown = _recoloured(solid, rng) if rng.random() < RECOLOURED_SHARE else solid
        for frame in _rendered(shown, occluder, variant, FRAMES_EACH, photos, rng):
            if frame.visible >= 0.5:
                image = _printed_on(frame, photos, rng) if rng.random() < PRINTED_SHARE else frame.image
                truth = frame.cam_from_model @ detector.local.refiner.part.model_from_body
                yield detector, _shadowed(image, frame.mask, rng), truth
        for frame in _rendered(other, occluder, variant, WITHOUT_EACH // len(VARIANTS), photos, rng):
            yield detector, _shadowed(frame.image, frame.mask, rng), None
    others = some_solids(seed)
    for k in range(CLUTTERED_EACH + CLUTTERED_WITHOUT_EACH):
        options = SequenceOptions("regular", 1, int(rng.integers(1 << 30)), motion=ANYWHERE)
        pose = trajectory(solid, options)[0] if k < CLUTTERED_EACH else None
        clean, visible = cluttered_picture(others, None if pose is None else (solid, pose), photos, rng)
        if pose is None or visible >= 0.5:
            placed = None if pose is None else pose @ detector.local.refiner.part.model_from_body
            yield detector, noisy(clean, rng), placed
    for _, image in frames_without_part(photos, (), CAMERA.width, CAMERA.height, WITHOUT_EACH, seed):
        yield detector, image, None


def some_solids(seed: int) -> list[Model]:
    """Solids for clutter around the solid of a seed."""
    solids = []
    for k in range(OTHERS_EACH):
        try:
            solids.append(random_solid(OTHER_SOLID + OCCLUDER + OTHERS_EACH * seed + k))
        except ValueError:  # outlines that cross each other
            continue
    return solids


def noisy(picture: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A picture (H,W,3) with noise and, in the share of the noisy variant, blur."""
    noise, blur_px = 2.0, 0.0
    if rng.random() < 1.0 / len(VARIANTS):
        noise, blur_px = rng.uniform(3.0, 14.0), rng.uniform(0.4, 1.3)
    if blur_px:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur_px))
    return np.clip(np.round(picture + noise * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)


def _blurred(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A picture with motion blur or defocus, and noise."""
    picture = image.astype(np.float32)
    if rng.random() < 0.5:
        length_px, angle = rng.uniform(*MOTION_PX), rng.uniform(0.0, np.pi)
        half = int(np.ceil(0.5 * length_px))
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        for t in np.linspace(-0.5, 0.5, 8 * half) * length_px:
            x, y = half + t * np.cos(angle), half + t * np.sin(angle)
            kernel[round(y), round(x)] += 1.0
        picture = np.asarray(cv2.filter2D(picture, -1, cv2.GaussianBlur(kernel, (0, 0), 0.5) / kernel.sum()))
    else:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), rng.uniform(*DEFOCUS_PX)))
    picture = picture + rng.uniform(*GRAIN) * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def is_near(
    detector: Detector, poses: Array, truth: Array, turns: Array, angle_deg: float, share: float
) -> NDArray[np.bool_]:
    """Which poses (N,4,4) are near the true one, up to some rotations (K,3,3) of the part, (N,) bool."""
    turned = np.einsum("ij,kjl->kil", truth[:3, :3], turns)
    cosine = 0.5 * (np.einsum("nij,kij->nk", poses[:, :3, :3], turned).max(axis=1) - 1.0)
    return np.asarray((cosine > np.cos(np.deg2rad(angle_deg))) & _is_at(detector, poses, truth, share))


def is_alike(detector: Detector, poses: Array, truth: Array, share: float, differing: float) -> NDArray[np.bool_]:
    """Which poses (N,4,4) have the position of the true one and the same appearance, whatever their rotation.

    The rotation of a turned part cannot be seen where its only flat is hidden, so that appearance decides.

    Args:
        detector: of the part.
        poses: to be compared.
        truth: (4,4) the true pose.
        share: of the diameter and the distance, see `is_near`.
        differing: share of the part's pixels that may differ.
    """
    surface, diameter_mm = detector.local.refiner.part.surface, detector.views.diameter_mm
    at = _is_at(detector, poses, truth, share)
    for k in np.flatnonzero(at):
        at[k] = changed_share(surface, diameter_mm, rigid(poses[k, :3, :3], truth[:3, 3]), truth) < differing
    return at


def _is_at(detector: Detector, poses: Array, truth: Array, share: float) -> NDArray[np.bool_]:
    offset, distance_mm = poses[:, :3, 3] - truth[:3, 3], np.linalg.norm(truth[:3, 3])
    along = np.abs(offset @ truth[:3, 3]) / distance_mm
    aside = np.sqrt(np.maximum((offset**2).sum(axis=1) - along**2, 0.0)) / detector.views.diameter_mm
    return np.asarray((aside < share) & (along / distance_mm < share))


def _rendered(
    solid: Model, occluder: Model, variant: Variant, count: int, photos: Sequence[Path], rng: np.random.Generator
) -> list[SequenceFrame]:
    seed = int(rng.integers(1 << 30))
    options = SequenceOptions(
        variant, count, seed, noise=rng.uniform(3.0, 14.0), blur_px=rng.uniform(0.4, 1.3), motion=ANYWHERE
    )
    photo = read_photo(photos[int(rng.integers(len(photos)))])
    return list(render_sequence(solid, trajectory(solid, options), photo, options, CAMERA, occluder))


def _recoloured(solid: Model, rng: np.random.Generator) -> Model:
    if rng.random() < DARK_SHARE:
        grey = rng.uniform(*DARK_GREY)
        return coloured(solid, grey * rng.uniform(0.8, 1.2, (len(solid.components), 3)))
    return recoloured(solid, rng)


def _printed_on(frame: SequenceFrame, photos: Sequence[Path], rng: np.random.Generator) -> NDArray[np.uint8]:
    photo = cv2.resize(read_photo(photos[int(rng.integers(len(photos)))]), frame.image.shape[1::-1])
    share = rng.uniform(0.3, 1.0) * frame.mask[..., None]
    printed = frame.image * (1.0 - share + share * photo / 110.0)
    return np.asarray(np.clip(printed, 0, 255).astype(np.uint8))


def _shadowed(image: NDArray[np.uint8], mask: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """A picture, perhaps with a shadow that the solid, the mask (H,W), casts on the background."""
    size_px = float(np.sqrt(mask.sum()))
    if rng.random() >= SHADOWED_SHARE or size_px < 1.0:
        return image
    aside_px = size_px * rng.uniform(-SHADOW_SHIFT, SHADOW_SHIFT, 2)
    way = np.array([[1.0, 0.0, aside_px[0]], [0.0, 1.0, aside_px[1]]])
    shadow = cv2.warpAffine(mask, way, mask.shape[::-1])
    shadow = cv2.GaussianBlur(shadow, (0, 0), size_px * rng.uniform(*SHADOW_BLUR))
    light = 1.0 - rng.uniform(*SHADOW_DARKNESS) * (1.0 - mask) * shadow
    return np.asarray(np.round(image * light[..., None]).astype(np.uint8))


def _examples(
    seed: int, detector: Detector, image: NDArray[np.uint8], truth: Array | None
) -> Iterator[PoseGroup | PoseCrops]:
    picture = detector.local.pyramid(image)
    likely = detector.global_search.candidates(picture, WIDE)
    searched = detector.local.pattern_search(picture, detector.global_search.rank(picture, likely, WIDE), WIDE.kept)
    refined = detector.local.refine_and_verify(picture, searched)
    searched_poses = np.array([c.cam_from_body for c in searched]).reshape(-1, 4, 4)
    rng = np.random.default_rng(len(likely.poses))
    if truth is None:
        yield from _crops(seed, detector, picture, refined, searched_poses, truth, rng)
        if refined:
            yield _group(seed, "refined", detector, picture, refined, np.zeros(len(refined), bool))
        return
    for poses, share in ((likely.poses, 1.0), (searched_poses, SEARCHED_SHARE)):
        if not len(poses):
            continue
        right, known = label_poses(detector, poses, truth, ROUGH_NEAR, ROUGH_APART, share)
        chosen = {*range(min(LIKELIEST, len(poses))), *rng.permutation(len(poses))[:RANDOM_OTHERS].tolist()}
        index = np.array(sorted({*chosen, *np.flatnonzero(right)[:MAX_RIGHT].tolist()}))
        index = index[known[index]]
        if right[index].any():
            yield _group(seed, "rough", detector, picture, poses[index], right[index])
    refined += detector.local.refine_and_verify(picture, [PoseCandidate(0.0, truth)])
    yield from _crops(seed, detector, picture, refined, searched_poses, truth, rng)
    right, known = label_poses(
        detector,
        np.array([h.cam_from_body for h in refined]).reshape(-1, 4, 4),
        truth,
        REFINED_NEAR,
        REFINED_APART,
        1.0,
    )
    if right.any():
        kept = [h for h, is_known in zip(refined, known, strict=True) if is_known]
        yield _group(seed, "refined", detector, picture, kept, right[known])


def label_poses(
    detector: Detector,
    poses: Array,
    truth: Array | None,
    near: tuple[float, float],
    apart: tuple[float, float],
    share: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which poses are right, and for which that is known: none and all in a picture without the part."""
    if truth is None:
        return np.zeros(len(poses), dtype=bool), np.ones(len(poses), dtype=bool)
    angle_deg, place = (share * limit for limit in near)
    right = is_near(detector, poses, truth, detector.disambiguator.exact_rotations, angle_deg, place)
    right |= is_alike(detector, poses, truth, place, SAME_PIXELS)
    angle_deg, place = (share * limit for limit in apart)
    uncertain = is_near(detector, poses, truth, detector.disambiguator.all_rotations, angle_deg, place)
    return right, right | ~(uncertain | is_alike(detector, poses, truth, place, ALIKE_PIXELS))


def _crops(
    seed: int,
    detector: Detector,
    picture: ImagePyramid,
    refined: list[Hypothesis],
    searched: Array,
    truth: Array | None,
    rng: np.random.Generator,
) -> Iterator[PoseCrops]:
    """Crops at refined poses, at some before refinement, and at some around the true one."""
    some = searched[: CROPS_WITHOUT if truth is None else CROPS_WITH]
    around = np.empty((0, 4, 4)) if truth is None else _around_truth(truth, detector.views.diameter_mm, rng)
    poses = np.concatenate([np.array([h.cam_from_body for h in refined]).reshape(-1, 4, 4), some, around])
    known = np.zeros((len(poses), 3))
    known[: len(refined)] = [(h.evidence_logit, h.profile_score, h.evidence.scatter_px) for h in refined] or np.empty(
        (0, 3)
    )
    is_refined = np.arange(len(poses)) < len(refined)
    right, is_known = label_poses(detector, poses, truth, REFINED_NEAR, REFINED_APART, 1.0)
    index = np.flatnonzero(is_known & (poses[:, 2, 3] > 0))
    if not len(index):
        return
    part = detector.local.refiner.part
    poses = poses[index]
    radii_px = picture.radii_px(part.views.diameter_mm, poses)
    pixels, drawn, edges = zip(
        *(pose_crop(picture, part, *of) for of in zip(poses, radii_px.tolist(), strict=True)), strict=True
    )
    yield PoseCrops(
        seed, np.stack(pixels), np.round(127.0 * np.stack(drawn)).astype(np.int8), np.stack(edges),
        radii_px, known[index], is_refined[index], right[index],
    )  # fmt: skip


def _around_truth(truth: Array, diameter_mm: float, rng: np.random.Generator) -> Array:
    """Poses (N,4,4) near the true one, and clearly off it in rotation or in position."""
    poses = []
    for k in range(NEAR_TRUTH + OFF_TRUTH):
        if k < NEAR_TRUTH:
            angle_deg, aside, along = rng.uniform(0.0, 4.0), rng.uniform(0.0, 0.035), rng.uniform(-0.04, 0.04)
        elif k % 3:
            angle_deg, aside, along = rng.uniform(10.0, 45.0), rng.uniform(0.0, 0.1), rng.uniform(-0.15, 0.15)
        else:
            angle_deg, aside, along = rng.uniform(0.0, 10.0), rng.uniform(0.1, 0.5), rng.uniform(-0.5, 0.5)
        axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        place = (truth[:3, 3] + aside * diameter_mm * way) * (1.0 + along)
        poses.append(rigid(exp_so3(np.deg2rad(angle_deg) * axis) @ truth[:3, :3], place))
    return np.stack(poses)


def _group(
    seed: int,
    stage: str,
    detector: Detector,
    picture: ImagePyramid,
    found: Array | list[Hypothesis],
    is_right: NDArray[np.bool_],
) -> PoseGroup:
    hypotheses = found if isinstance(found, list) else []
    poses = np.array([h.cam_from_body for h in hypotheses]) if isinstance(found, list) else found
    lines_by_view = np.array([detector.local.view_lines(pose) for pose in poses])
    edges, scalars = {}, {}
    for name in ("fine", "close") if hypotheses else ("rough",):
        described, scalars[name] = describe_poses(
            picture, detector.local.refiner.part, poses, lines_by_view, RADII_PX[name]
        )
        edges[name] = np.round(255.0 * described).astype(np.uint8)
    logits = np.array([h.evidence_logit for h in hypotheses] or np.zeros(len(poses)), dtype=np.float32)
    return PoseGroup(seed, stage, edges, scalars, logits, is_right)
