"""Log odds that a component is not at its nominal placement, by all that one picture shows of it.

The picture shows the component, its place without it, or something before both, which says nothing. A multinomial
logistic model (Böhning, 1992) gives the odds of the first two to the third; where something may be before the place
they are limited by the mixture: log((1 + absent) / (1 + present)). A second model of the edges alone says for which
components no more than these need to be measured. The weights were fitted to pictures of random assemblies and are
stored in ``weights/component_log_odds.json``. Log odds are natural logarithms of the likelihood ratio of "not there"
to "there".
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from arview.assembly.bare_place import BarePlaces
from arview.assembly.edge_support import EdgeSupport, MeasuredSupport
from arview.geometry import Array
from arview.weights import load_weights

FEATURES = (
    "constant",
    "supported",
    "lead",
    "contrast",
    "determined",
    "determined_supported",
    "determined_lead",
    "network_against",
    "network_for",
    "is_predicted",
    "bare",
    "is_bare_known",
    "bare_unsupported",
    "ring",
    "is_ring_known",
    "around",
    "is_around_known",
    "base",
    "behind",
    "is_behind_known",
    "bare_around",
    "against_around",
    "against_unsupported",
)
"""Inputs of the model of places, in order; see `evidence_features`."""


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


class PlaceWeights(NamedTuple):
    """Weights (F,) of `FEATURES` in the log odds of "absent" and of "present" to "something is before the place"."""

    absent: Array
    present: Array


HALF_RELIABLE_POINTS = 15.0
"""Number of determined points (see `EdgeSupport.determined`) at which edges count half."""
TYPICAL_CONTRAST = 5.0
"""Contrast that stands for components without an outline of their own."""
MAX_CONTRAST = 6.0
"""Contrast above which it counts no more."""
MAX_NETWORK = 5.0
"""Bound on the network's log odds, in both directions."""


class Evidence(NamedTuple):
    """Measurements of each component in one picture; of those that are not visible they mean nothing.

    Attributes:
        support: of the edges.
        unshared: the same by points apart from other components' edges.
        network: (C,) log odds against the nominal placement by the presence network, NaN where it has not predicted.
        places: what is seen at the place; -1 where that was not measured.
        base: share of the edge points of trusted components that lie on image edges.
    """

    support: EdgeSupport
    unshared: EdgeSupport
    network: Array
    places: BarePlaces
    base: float


class PlaceOdds(NamedTuple):
    """Log odds (C,) that a picture shows a place without its component, or with it, to something before the place."""

    absent: Array
    present: Array

    @property
    def log_odds(self) -> Array:
        """(C,) of "not there" to "there"."""
        return np.asarray(np.logaddexp(0.0, self.absent) - np.logaddexp(0.0, self.present))

    @property
    def occluded(self) -> Array:
        """(C,) probability that something is before the place."""
        return np.asarray(1.0 / (1.0 + np.exp(self.absent) + np.exp(self.present)))


@cache
def edge_weights() -> EdgeWeights:
    """The fitted weights of the edges."""
    return EdgeWeights(**load_weights("component_log_odds")["edges"])


@cache
def place_weights() -> PlaceWeights:
    """The fitted weights of all measurements together."""
    groups = load_weights("component_log_odds")
    absent, present = (np.array([groups[name][f] for f in FEATURES]) for name in ("place_absent", "place_present"))
    return PlaceWeights(absent, present)


def edge_log_odds(measured: MeasuredSupport) -> Array:
    """Log odds (C,) by edges alone, 0 for components that are not visible."""
    support, unshared = measured
    by_edges = np.where(support.supported >= 0.0, _edge_log_odds(support), 0.0)
    return _without_neighbours(by_edges, _edge_log_odds(unshared), unshared)


def place_log_odds(evidence: Evidence) -> Array:
    """Log odds (C,) by all measurements, 0 for components that are not visible."""
    by_place = np.where(evidence.support.supported >= 0.0, place_odds(evidence).log_odds, 0.0)
    by_unshared = place_odds(evidence._replace(support=evidence.unshared)).log_odds
    return _without_neighbours(by_place, by_unshared, evidence.unshared)


def _without_neighbours(log_odds: Array, by_unshared: Array, unshared: EdgeSupport) -> Array:
    """Log odds (C,) of which those for a component are no stronger than by its unshared points: edges near the others
    may be a neighbour's.
    """
    known = np.where(unshared.supported >= 0.0, np.minimum(by_unshared, 0.0), 0.0)
    return np.where(log_odds < 0.0, np.maximum(log_odds, known), log_odds)


def _edge_log_odds(support: EdgeSupport) -> Array:
    """Log odds (C,) by one support, in proportion to how well the edges determine a component's position."""
    w = edge_weights()
    contrast = np.where(support.contrast < 0.0, TYPICAL_CONTRAST, np.minimum(support.contrast, MAX_CONTRAST))
    log_odds = w.constant + w.supported_share * support.supported
    log_odds += w.supported_lead * (support.supported - support.displaced)
    log_odds += w.colour_contrast * contrast
    determined = np.maximum(support.determined, 0.0)
    return np.asarray(log_odds * determined / (determined + HALF_RELIABLE_POINTS))


def place_odds(evidence: Evidence) -> PlaceOdds:
    """What the picture shows at each place, by all measurements."""
    features, weights = evidence_features(evidence), place_weights()
    return PlaceOdds(features @ weights.absent, features @ weights.present)


def evidence_features(evidence: Evidence) -> Array:
    """Inputs (C,F) of the model of places, see `FEATURES`; measurements that are not known are 0."""
    (support, _, network, places, base) = evidence
    contrast = np.where(support.contrast < 0.0, TYPICAL_CONTRAST, np.minimum(support.contrast, MAX_CONTRAST))
    determined = np.maximum(support.determined, 0.0)
    reliable = determined / (determined + HALF_RELIABLE_POINTS)
    lead = support.supported - support.displaced
    is_predicted = ~np.isnan(network)
    predicted = np.clip(np.where(is_predicted, network, 0.0), -MAX_NETWORK, MAX_NETWORK)
    is_bare, is_ring, is_around = places.bare >= 0.0, places.ring >= 0.0, places.around >= 0.0
    is_behind, around = places.behind >= 0.0, np.where(is_around, places.around, 0.0)
    bare = np.where(is_bare, places.bare * places.coverage, 0.0)
    columns = [
        np.ones(len(network)),
        support.supported,
        lead,
        contrast / MAX_CONTRAST,
        reliable,
        reliable * support.supported,
        reliable * lead,
        np.maximum(predicted, 0.0),
        np.minimum(predicted, 0.0),
        is_predicted,
        bare,
        np.where(is_bare, places.coverage, 0.0),
        bare * (1.0 - support.supported),
        np.where(is_ring, places.ring, 0.0),
        is_ring,
        around,
        is_around,
        np.full(len(network), base),
        np.where(is_behind, places.behind, 0.0),
        is_behind,
        bare * around,
        np.maximum(predicted, 0.0) * around,
        np.maximum(predicted, 0.0) * (1.0 - support.supported),
    ]
    return np.stack([np.asarray(column, dtype=np.float64) for column in columns], axis=1)
