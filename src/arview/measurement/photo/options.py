"""Options of measuring in photos."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SweepOptions:
    """Options of the object-space sweep. Lengths in ``px`` are those of a pixel at the component's distance."""

    samples: int = 1000  # on a component's surface; more overlap, and cost without saying more
    patch_px: int = 13  # width of a patch: smaller is noise, larger bridges the edges of small parts
    patch_points: int = 9  # across a patch; at 1.5 px apart nothing is lost, and it is twice as quick
    edge_px: float = 4.0  # what is nearer a sharp edge is left out: blur mixes it with what lies beyond
    sample_spacing_px: float = 5.0  # about half a patch: each point of the surface is in four of them
    max_views: int = 7  # photos that a sample is compared in
    min_views: int = 3  # two agree by chance
    min_cosine: float = 0.35  # flattest view of a surface, 70° off its normal
    capture_mm: float = 5.0  # displacement that the coarse round finds
    fine_range_px: float = 3.0  # of the first fine round; narrows from round to round
    rounds: int = 5  # at most; patches are cut anew at the moved place
    settled_mm: float = 0.003  # a smaller step ends the rounds
    min_score: float = 0.55  # mean correlation of a sample's views below which it says nothing
    min_contrast: float = 1.5  # grey levels, standard deviation in a patch; less is noise
    max_sigma_mm: float = 0.3  # of one sample
    min_sigma_mm: float = 0.015  # samples are never taken to be better: form, lens, tessellation
    min_samples: int = 25  # fewer that agree are no measurement
    min_support: float = 0.15  # share of the visible samples that must agree
    min_direction: float = 0.2  # share of what is seen of a direction that must agree, or it is undetermined
    systematic_mm: float = 0.004  # of the whole component, any direction: what residuals do not show
    systematic_share: float = 0.25  # of the residuals that is alike all over: reflections, shadows, blur at edges


@dataclass(frozen=True)
class EdgeOptions:
    """Options of the measurement by edges; ``px`` are those of the photos."""

    capture_mm: float = 5.0  # displacement that the first round finds
    reaches_px: tuple[float, ...] = (6.0, 4.5, 3.5, 3.0, 3.0, 3.0)  # how far steps are looked for, by round
    spacing_px: float = 3.0  # between samples along an edge
    max_points: int = 3000  # edge points of one component in all photos; more say the same
    half_width_px: float = 2.0  # profiles are averaged so far along the edge
    threshold: float = 1.0  # weakest step, grey levels of 255 per px in linear light
    half_slope: float = 6.0  # a step of this slope counts half
    min_sigma_px: float = 0.05  # residuals are never taken to be better: lens, tessellation, pixel response
    max_dark_shift_px: float = 0.2  # how far all edges may be shifted towards the dark side: tone curve, glare
    min_points: int = 40  # fewer are no measurement
    min_direction: float = 0.2  # share of what is seen of a direction that must agree, or it is undetermined
    min_support: float = 0.25  # share of predicted points with a step where the fit says, above chance
    systematic_px: float = 0.03  # what all edges of a component may be off together: chamfers, light


@dataclass(frozen=True)
class PhotoOptions:
    """Options of both ways of measuring in photos."""

    sweep: SweepOptions = SweepOptions()
    edges: EdgeOptions = EdgeOptions()
    joint_mm: float = 4.0  # surfaces and edges so near another component are left out: welds, gaps, shadows
    undetermined_mm: float = 0.3  # a direction known worse than this (1 σ, turns at the component's rim) is free
    gone_share: float = 0.6  # share of what a component would hide that is seen, above which it is missing
