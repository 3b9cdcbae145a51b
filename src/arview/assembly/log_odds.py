"""Log odds that a component is not at its nominal placement, by its edges and by the presence network.

Two logistic models, of the edges alone and of edges and network together. Their weights were fitted to pictures of
right and wrong assemblies and are stored in ``weights/component_log_odds.json``. Log odds are natural logarithms of the
likelihood ratio of "not there" to "there".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from arview.assembly.edge_support import EdgeSupport
from arview.geometry import Array
from arview.weights import load_weights


class EdgeWeights(NamedTuple):
    """Log odds by the edges of one picture: a constant, and weights of three measurements.

    Attributes:
        constant: log odds of a component with no support.
        supported_share: per share of points supported at the nominal placement.
        supported_lead: per share by which that exceeds the best displaced placement.
        colour_contrast: per standard deviation of colour change across the outline.
    """

    constant: float
    supported_share: float
    supported_lead: float
    colour_contrast: float


class FusionWeights(NamedTuple):
    """Log odds by edges and network together: a constant, and weights of the three.

    Attributes:
        constant: added where the network has predicted.
        edges: of the log odds by edges.
        network_against: of the network's log odds where they are positive.
        network_for: of the network's log odds where they are negative.
    """

    constant: float
    edges: float
    network_against: float
    network_for: float


@dataclass(frozen=True)
class LogOddsOptions:
    """Bounds of the evidence, and how occlusion discounts it.

    Attributes:
        half_reliable_points: number of determined points (see `EdgeSupport.determined`) at which edges count half.
        typical_contrast: contrast that stands for components without an outline of their own.
        max_contrast: contrast above which it counts no more.
        max_against: cap on what edges and network each count against a component.
        occlusion_discount: subtracted from what the network counts against a component when nothing around it is
            found: the network is not sure of components that a hand hides either.
        edges_alone: share that counts of log odds by edges against a component too small for the network; its
            surroundings and occluders leave its edges unsupported more often than where the weights were fitted.
    """

    half_reliable_points: float = 15.0
    typical_contrast: float = 5.0
    max_contrast: float = 6.0
    max_against: float = 4.0
    occlusion_discount: float = 2.4
    edges_alone: float = 0.35


@cache
def edge_weights() -> EdgeWeights:
    """The fitted weights of the edges."""
    return EdgeWeights(**load_weights("component_log_odds")["edges"])


@cache
def fusion_weights() -> FusionWeights:
    """The fitted weights of edges and network together."""
    return FusionWeights(**load_weights("component_log_odds")["fusion"])


def edge_log_odds(support: EdgeSupport, options: LogOddsOptions) -> Array:
    """Log odds (C,) by edges alone, in proportion to how well the edges determine a component's position."""
    w = edge_weights()
    contrast = np.where(
        support.contrast < 0.0, options.typical_contrast, np.minimum(support.contrast, options.max_contrast)
    )
    log_odds = w.constant + w.supported_share * support.supported
    log_odds += w.supported_lead * (support.supported - support.displaced)
    log_odds += w.colour_contrast * contrast
    determined = np.maximum(support.determined, 0.0)
    return np.asarray(log_odds * determined / (determined + options.half_reliable_points))


def fused_log_odds(
    by_edges: Array, by_network: Array, options: LogOddsOptions, unoccluded: Array | float = 1.0
) -> Array:
    """Log odds (C,) by edges and network together.

    Args:
        by_edges: (C,) log odds.
        by_network: (C,) log odds, NaN where the network has not predicted.
        options: see `LogOddsOptions`.
        unoccluded: (C,) 1 where the edges around a component, or of the whole part, are found, 0 where none are:
            something hides them, or the picture is blurred. Evidence for a component counts in full all the same.
    """
    o, w = options, fusion_weights()
    alone = np.where(by_edges > 0.0, o.edges_alone * by_edges * unoccluded, by_edges)
    edges = np.where(by_edges > 0.0, np.minimum(by_edges, o.max_against) * unoccluded, by_edges)
    against = np.minimum(by_network, o.max_against) - o.occlusion_discount * (1.0 - np.asarray(unoccluded))
    against = np.maximum(against, 0.0)
    both = w.constant + w.edges * edges + w.network_against * against + w.network_for * np.minimum(by_network, 0.0)
    return np.asarray(np.where(np.isnan(by_network), alone, both))
