"""Options of the measurement in photos."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SweepOptions:
    """Options of the object-space sweep.

    Lengths in ``px`` refer to the size of a pixel at the component's distance.
    """

    samples: int = 1000  # on a component's surface; more of them overlap and add cost without information
    patch_px: int = 13  # width of a patch: smaller ones are noisy, larger ones bridge the edges of small parts
    patch_points: int = 9  # across a patch; a spacing of 1.5 px loses nothing and halves the time
    edge_px: float = 4.0  # samples nearer to a sharp edge are dropped: blur mixes them with what lies beyond
    sample_spacing_px: float = 5.0  # about half a patch, so that each surface point lies in four patches
    max_views: int = 7  # photos in which a sample is compared
    min_views: int = 3  # with fewer, two may agree by chance
    min_cosine: float = 0.35  # smallest cosine between view and surface normal: 70°
    capture_mm: float = 5.0  # largest displacement that the coarse round finds
    fine_range_px: float = 3.0  # search range of the first fine round; it narrows from round to round
    rounds: int = 5  # maximum; patches are cut anew at the moved place
    converged_mm: float = 0.003  # a smaller step ends the rounds
    min_score: float = 0.55  # mean correlation of a sample's views below which it is ignored
    min_contrast: float = 1.5  # standard deviation of a patch in grey levels below which it is noise
    max_sigma_mm: float = 0.3  # largest standard deviation of one sample
    min_sigma_mm: float = 0.015  # lower bound of a sample's standard deviation: form, lens, tessellation
    min_samples: int = 25  # agreeing samples that a measurement needs
    min_support: float = 0.15  # share of the visible samples that must agree
    min_direction: float = 0.2  # share of a direction's information that must agree for it to be determined
    systematic_mm: float = 0.004  # standard deviation common to the whole component that residuals do not show
    systematic_share: float = 0.25  # share of the residuals that is common to all: reflections, shadows, blur at edges


@dataclass(frozen=True)
class EdgeOptions:
    """Options of the measurement by edges. Lengths in ``px`` refer to the photos."""

    capture_mm: float = 5.0  # largest displacement that the first round finds
    reaches_px: tuple[float, ...] = (6.0, 4.5, 3.5, 3.0, 3.0, 3.0)  # search range across the edges in each round
    spacing_px: float = 3.0  # distance between samples along an edge
    max_points: int = 3000  # edge points of one component in all photos; more are redundant
    half_width_px: float = 2.0  # profiles are averaged over this distance to either side along the edge
    threshold: float = 1.0  # weakest step, in grey levels (of 255) per px in linear light
    half_slope: float = 6.0  # slope at which a step has half its full weight
    min_sigma_px: float = 0.05  # lower bound of the residuals' standard deviation: lens, tessellation, pixel response
    max_dark_shift_px: float = 0.2  # largest common shift of all edges towards the dark side: tone curve, glare
    min_points: int = 40  # edge points that a measurement needs
    min_direction: float = 0.2  # share of a direction's information that must agree for it to be determined
    min_support: float = 0.25  # share of predicted points with a step at the fitted place, beyond chance
    first_rival_px: float = 3.0  # in the first rounds, points with another edge nearer beside them are left out
    rival_px: float = 2.0  # the same in the last rounds: blur merges nearer steps
    rival_reach_px: float = 6.0  # an edge farther than this is no rival: the last rounds search half as far
    fine_rounds: int = 3  # number of the last rounds
    blur_px: float = 1.0  # standard deviation of a step's blur: lens, sensor, smoothing, and the samples of a profile
    flanked_px: float = 0.5  # systematic standard deviation where all edges have others beside them: half their gap
    systematic_px: float = 0.03  # standard deviation of a common shift of all edges of a component: chamfers, light


@dataclass(frozen=True)
class PhotoOptions:
    """Options of both methods of measuring in photos."""

    sweep: SweepOptions = SweepOptions()
    edges: EdgeOptions = EdgeOptions()
    joint_mm: float = 4.0  # surfaces and edges this near to another component are dropped: welds, gaps, shadows
    undetermined_mm: float = 0.3  # largest standard deviation of a determined direction; rotations at the rim
    absent_support: float = 0.1  # share of a component's edges found below which nothing of it is there
    clear_support: float = 0.5  # share of other components' edges found for the photos to show what is there
    min_clear: int = 3  # components whose edges are found so well that one without any edges is missing
    gone_share: float = 0.6  # a component is missing when more than this share of what it would hide is visible
