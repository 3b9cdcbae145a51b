"""Scale and frame from the CAD: the part is detected in a few photos, the detections vote, and all photos refine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model, Part, ViewRange
from arview.camera import Camera
from arview.core import subpixel_edges
from arview.core.parallel import pool
from arview.core.progress import Progress
from arview.detection import Detector
from arview.geometry import Array, invert, rigid
from arview.guideviews import GuideViewOptions, GuideViewSet, cached_guide_views
from arview.reconstruction.scale.refine import Fit, JointRefiner, ScaleView, Support
from arview.reconstruction.scale.similarity import Similarity
from arview.reconstruction.scale.vote import Sighting, Vote, vote
from arview.reconstruction.types import PosedPhoto

Pixels = NDArray[np.uint8]


FOUND_QUALITY = 0.5
"""Quality from which a detection is reliable by itself."""


DETECT_WIDTH_PX = 800
"""Longer side of the pictures in which the part is searched for."""
MAX_DETECTIONS = 12
"""Maximum number of photos searched."""
MORE_DETECTIONS = 30
"""Maximum number of photos searched where some show the part reliably, but too few: much of it is hidden."""
FIRST_DETECTIONS = 6
"""Maximum number of photos searched while none shows the part reliably."""
AGREEING = 3
"""Number of agreeing photos that ends the search."""
MIN_QUALITY = 0.1
"""Detections of at least this quality vote, even if they would not be reliable by themselves."""
SIGHTINGS = 5
"""Maximum number of detections per photo."""
SUBDIVISIONS = 3
"""Subdivisions of the guide views' directions; 3 is about 8° apart, enough for a start."""
SPANS = (0.2, 1.2)
"""Smallest and largest share of the photo's longer side that the part is expected to span."""
MIN_SUPPORT = 0.25
"""Minimum support of a similarity that is accepted, see `Support`."""
CLEAR_SUPPORT = 0.6
"""Support of a component that is seen as it should be …."""
MIN_CLEAR = 2
"""… and number of such components with which a part is accepted of which the rest is hidden."""
SAME_SUPPORT = 0.8
"""Share of the last part's support that the next one must have to lie where the last one lay."""
CLEAR_LEAD = 0.08
"""An alternative whose support is less than this below the best one's makes the frame ambiguous."""


@dataclass(frozen=True)
class CadOptions:
    """Options of finding the CAD in the photos.

    Attributes:
        max_side_px: photos are refined at no larger size, to limit memory.
        max_views: maximum number of photos refined, spread over all directions, to limit time.
        rival_views: number of photos in which alternatives to the best vote are scored.
    """

    max_side_px: int = 2000
    max_views: int = 30
    rival_views: int = 6


@dataclass(frozen=True)
class CadFind:
    """The CAD as found in the photos.

    Attributes:
        fit: the refined similarity.
        support: its support.
        refiner: with the views to which it was fitted.
        detail: description for the evidence.
        warnings: messages about doubts.
        turns: (N,3,3) rotations under which the part looks similar.
    """

    fit: Fit
    support: Support
    refiner: JointRefiner
    detail: str
    warnings: tuple[str, ...]
    turns: Array


@dataclass(frozen=True)
class NotFound:
    """Why the CAD was not found.

    Attributes:
        reason: as a message.
        is_contradiction: the part was seen, but not where the reconstruction has it.
    """

    reason: str
    is_contradiction: bool = False


def base_names(part: Part) -> tuple[str, ...]:
    """The components that define the frame: those with the role ``base``, else the largest."""
    present = {component.name for component in part.model.components}
    base = tuple(s.name for s in part.settings if s.role == "base" and s.name in present)
    if base:
        return base
    sizes = [float(np.linalg.norm(np.diff(c.bounds_in_model, axis=0))) for c in part.model.components]
    return (part.model.components[int(np.argmax(sizes))].name,)


def spread_order(photos: Sequence[PosedPhoto]) -> list[int]:
    """Indices of the photos, ordered such that the first ones look from places as different as possible."""
    centres = np.array([photo.centre_in_scan for photo in photos])
    axes = np.array([photo.cam_from_scan[2, :3] for photo in photos])
    size = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean() or 1.0
    places = np.concatenate([centres / size, axes], axis=1)
    order = [int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    distance = np.full(len(places), np.inf)
    while len(order) < len(places):
        distance = np.minimum(distance, np.linalg.norm(places - places[order[-1]], axis=1))
        distance[order] = -1.0
        order.append(int(np.argmax(distance)))
    return order


def make_view(photo: PosedPhoto, image: Pixels, max_side_px: int) -> ScaleView:
    """A photo in linear light, with no side longer than ``max_side_px``."""
    camera, gray = shrunk(photo.camera, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), max_side_px)
    return ScaleView(photo.name, camera, subpixel_edges.linear_light(gray), photo.cam_from_scan)


def shrunk(camera: Camera, image: Pixels, max_side_px: int) -> tuple[Camera, Pixels]:
    """Camera and picture, reduced to ``max_side_px`` if they are larger."""
    scale = max_side_px / max(camera.width, camera.height)
    if scale >= 1.0:
        return camera, image
    small = camera.scaled(round(camera.width * scale), round(camera.height * scale))
    return small, np.asarray(cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA))


def search_ranges(part: Part, cameras: Sequence[Camera], spans: tuple[float, float]) -> list[ViewRange]:
    """View ranges to search, the more likely one first: from above, from below, as far as the part file declares them.

    Photos are taken from all around, whatever azimuth is declared for tracking. Distances follow from the lenses, in
    steps of √2 so that cached guide views can be reused.
    """
    longer = np.array([camera.fx / max(camera.width, camera.height) for camera in cameras])
    diameter = part.model.diameter_mm
    # Guide views cannot be made from nearer than 0.75 diameters.
    low = max(0.75, 2.0 ** (np.floor(2.0 * np.log2(longer.min() / spans[1])) / 2.0)) * diameter
    high = max(1.5 * low, 2.0 ** (np.ceil(2.0 * np.log2(longer.max() / spans[0])) / 2.0) * diameter)
    distances = (float(low), float(high))
    above, below = ViewRange(distances, (0.0, 90.0)), ViewRange(distances, (-90.0, 0.0))
    if part.view_range is None:
        return [above, below]
    low_deg, high_deg = part.view_range.elevation_deg
    return [half for half, is_seen in ((above, high_deg > 5.0), (below, low_deg < -5.0)) if is_seen] or [above]


def find_cad(
    photos: Sequence[PosedPhoto],
    read: Callable[[PosedPhoto], Pixels],
    part: Part,
    options: CadOptions,
    progress: Progress | None = None,
    before: CadFind | None = None,
) -> CadFind | NotFound:
    """Find the similarity that fits the CAD to the photos.

    Args:
        photos: placed photos.
        read: returns the upright (H,W,3) uint8 RGB picture of a photo, of the size of its camera.
        part: the part to find.
        options: see `CadOptions`.
        progress: called with (what, done, total).
        before: where fixed cameras found the last part: if this one lies there as well, nothing is searched for.

    Returns:
        The CAD as found, or why it was not found.
    """
    if len(photos) < 2:
        return NotFound("fewer than two photos were placed")
    order = spread_order(photos)
    reasons: list[NotFound] = []
    if before is not None:
        last = [Vote(before.fit.similarity, (), 1.0)]
        found = _refined(
            photos, order, read, part=part, votes=last, turns=before.turns, options=options, progress=progress
        )
        if isinstance(found, CadFind) and found.support.score > SAME_SUPPORT * before.support.score:
            return found
    for view_range in search_ranges(part, [photo.camera for photo in photos], SPANS):
        views = cached_guide_views(
            part.model,
            view_range,
            GuideViewOptions(subdivisions=SUBDIVISIONS),
            progress=lambda done, total: progress("guide views", done, total) if progress else None,
        )
        votes, turns, reason = _search(photos, order, read, views, progress)
        if votes:
            return _refined(
                photos, order, read, part=part, votes=votes, turns=turns, options=options, progress=progress
            )
        reasons.append(reason)
        if reason.is_contradiction:
            break
    return reasons[-1] if reasons[-1].is_contradiction else reasons[0]


def _search(
    photos: Sequence[PosedPhoto],
    order: Sequence[int],
    read: Callable[[PosedPhoto], Pixels],
    views: GuideViewSet,
    progress: Progress | None,
) -> tuple[list[Vote], Array, NotFound]:
    """Votes of the detections, rotations (N,3,3) under which the part looks similar, and the reason without a vote."""
    from arview.detection import options_for
    from arview.tracking import diagnose_search

    detectors: dict[tuple[float, ...], Detector] = {}
    sightings: list[Sighting] = []
    votes: list[Vote] = []
    reasons: list[str] = []
    sure = 0
    enough = min(AGREEING, len(photos))
    for count, index in enumerate(order[:MORE_DETECTIONS]):
        if count >= (MAX_DETECTIONS if votes else FIRST_DETECTIONS) and not sure:
            break
        if progress:
            progress("finding the part", count, min(len(order), MAX_DETECTIONS))
        camera, image = shrunk(photos[index].camera, read(photos[index]), DETECT_WIDTH_PX)
        key = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist)
        detector = detectors.get(key)
        if detector is None:
            unsure = replace(options_for(views), min_quality=MIN_QUALITY)
            detector = detectors[key] = Detector(views, camera, unsure)
        found = detector.detect(image, SIGHTINGS)
        if found and found[0].quality >= FOUND_QUALITY:
            sure += 1
        elif not found:
            reasons.append(diagnose_search(image, camera, views, detector.best_rejected))
        for d in found:
            poses = (d.cam_from_model, *d.alternatives)
            sightings += [Sighting(index, photos[index].cam_from_scan, pose, d.quality) for pose in poses]
        votes = vote(sightings, views.center_in_model, views.diameter_mm)
        if votes and len(votes[0].sightings) >= enough:
            return votes, next(iter(detectors.values())).symmetries.near, NotFound("")
    if votes and min(one.quality for one in votes[0].sightings) >= FOUND_QUALITY:
        return votes, next(iter(detectors.values())).symmetries.near, NotFound("")
    if sure >= enough:
        apart = f"the part was found in {sure} photos, but at places that contradict each other"
        return [], np.zeros((0, 3, 3)), NotFound(apart, is_contradiction=True)
    reason = max(reasons, key=reasons.count) if reasons else "it looks similar from several sides"
    few = f"the part was found in only {sure} of the photos; in others: {reason}"
    return [], np.zeros((0, 3, 3)), NotFound(few if sure else reason)


def _refined(
    photos: Sequence[PosedPhoto],
    order: Sequence[int],
    read: Callable[[PosedPhoto], Pixels],
    part: Part,
    votes: Sequence[Vote],
    turns: Array,
    options: CadOptions,
    progress: Progress | None,
) -> CadFind | NotFound:
    """Refine the vote, or its rotated alternative, that the edges of several photos support best; or say why none."""
    chosen = list(order[: options.max_views])
    views: list[ScaleView] = []
    for view in pool().map(lambda i: make_view(photos[i], read(photos[i]), options.max_side_px), chosen):
        views.append(view)
        if progress:
            progress("reading photos", len(views), len(chosen))
    base, model = base_names(part), part.model
    scorer = JointRefiner(model, base, views[: options.rival_views])
    starts = [v.similarity for v in votes[:3] if v.score >= 0.4 * votes[0].score]
    starts += [_turned(votes[0].similarity, turn, model) for turn in turns]
    scored = []
    for start in starts:
        rough, support = scorer.rough(start)
        scored.append((support.score, rough))
    scored.sort(key=lambda pair: -pair[0])
    warnings = []
    rivals = [score for score, other in scored[1:] if _is_other(scored[0][1], other)]
    if rivals and scored[0][0] - max(rivals) < CLEAR_LEAD:
        warnings.append("the part looks similar after a rotation, so the frame may be wrong by that rotation")
    if progress:
        progress("fitting the CAD", 0, 1)
    refiner = JointRefiner(model, base, views)
    fit = refiner.refine(scored[0][1])
    support = refiner.support(fit.similarity, fit.samples)
    is_whole = max(support.score, support.base_score) >= MIN_SUPPORT
    clear = [
        one.name for one, share in zip(model.components, support.by_component, strict=True) if share >= CLEAR_SUPPORT
    ]
    if not is_whole and len(clear) >= MIN_CLEAR:
        warnings.append(
            f"only some of the part is in view: of the edges of {len(model.components)} components those of "
            f"{', '.join(clear)} were clearly found"
        )
    elif not is_whole:
        reason = (
            f"the part was found in {len(votes[0].sightings)} photos, but with the poses of these only "
            f"{100 * support.share:.0f} % of its edges are where they should be "
            f"({100 * support.chance:.0f} % would be by chance)"
        )
        return NotFound(reason, is_contradiction=True)
    detail = (
        f"CAD edges in {len(views)} photos, with {', '.join(base)} at nominal: "
        f"{100 * support.share:.0f} % found, {fit.sigma_px:.2f} px"
    )
    return CadFind(fit, support, refiner, detail, tuple(warnings), turns)


def _turned(similarity: Similarity, turn: Array, model: Model) -> Similarity:
    """The similarity with the part rotated (3,3) about its centre."""
    to_center = rigid(np.eye(3), model.center_in_model)
    back = to_center @ rigid(turn.T, np.zeros(3)) @ invert(to_center)
    return Similarity(similarity.scale, back @ similarity.model_from_scan)


def _is_other(a: Similarity, b: Similarity) -> bool:
    """Whether two refined similarities differ; an alternative that converged to the best one is none."""
    cosine = 0.5 * (float(np.sum(a.model_from_scan[:3, :3] * b.model_from_scan[:3, :3])) - 1.0)
    return bool(cosine < np.cos(np.deg2rad(2.0)) or abs(np.log(a.scale / b.scale)) > 0.02)
