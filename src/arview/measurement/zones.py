"""Tolerance zones (ISO 1101) of features whose place is measured: the smallest zone that holds them, with its U.

The displacements of some points of the features, each projected onto the directions in which the zone is bounded, must
lie within a circle, sphere or interval about zero. The datums hold the zone in place; along what they leave free it may
move, and an orientation or form leaves translations or all motions free. Twice the largest length, at the best such
motion, is the diameter or width of the smallest zone. Up to the exact lengths at its end this is a linear programme.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import linprog

from arview.core.fits import covariance_root
from arview.geometry import Array
from arview.measurement.uncertainty.budget import PROBABILITY

DRAWS, DRAWS_OF_FREE = 4000, 300
"""Monte Carlo draws, and those where each needs a linear programme."""
SIDES = 48
"""Sides of the polygon that stands for a circle while a free zone is moved."""
TOLERANCE = 0.05
"""Share of a motion by which a zone may change that is said not to depend on it."""
RECENTRINGS = 3
"""Further programmes whose polygons are turned towards the displacements that the one before left."""


@dataclass(frozen=True)
class Zone:
    """What must lie in a zone, as linear functions of a measured state (S,).

    Attributes:
        displacements: (P,D,S) derivative of the displacement of each point across the zone, D directions.
        motions: (P,D,K) derivative of the same by the free motions of the zone; K may be 0.
        reach_mm: (K,) how far it may move along each; infinity: freely. Two neighbours with the same finite reach are
            the axes of a disc.
    """

    displacements: Array
    motions: Array
    reach_mm: Array

    def size_mm(self, state: Array) -> float:
        """Diameter or width of the smallest zone that holds a state (S,)."""
        return float(self.sizes_mm(state[None])[0])

    def sizes_mm(self, states: Array) -> Array:
        """The same (N,) for each of some states (N,S)."""
        at = np.einsum("pds,ns->npd", self.displacements, states, optimize=True)
        if self.motions.shape[2]:
            at = np.stack([self._moved(one) for one in at])
        return np.asarray(2.0 * np.linalg.norm(at, axis=2).max(axis=1))

    def _moved(self, at: Array) -> Array:
        """Displacements (P,D) seen from the best place of the zone."""
        sides, discs, best = _sides(at.shape[1]), self._discs(), at
        for _ in range(1 + RECENTRINGS * (at.shape[1] > 1)):
            own = best / np.maximum(np.linalg.norm(best, axis=1, keepdims=True), 1e-12)
            rows = np.concatenate([np.tile(sides, (len(at), 1, 1)), own[:, None]], axis=1)  # (P,sides,D)
            by_motion = np.einsum("psd,pdk->psk", rows, self.motions).reshape(-1, self.motions.shape[2])
            values = np.einsum("psd,pd->ps", rows, at).ravel()
            unit = np.maximum(np.abs(by_motion).max(axis=0), 1e-12)
            cost = np.zeros(by_motion.shape[1] + 1)
            cost[-1] = 1.0
            found = linprog(
                cost,
                A_ub=np.concatenate(
                    [
                        np.concatenate([-by_motion / unit, -np.ones((len(values), 1))], axis=1),
                        np.concatenate([discs / unit, np.zeros((len(discs), 1))], axis=1),
                    ]
                ),
                b_ub=np.concatenate([-values, np.ones(len(discs))]),
                bounds=[*((-reach, reach) for reach in self.reach_mm * unit), (0.0, None)],
            )
            if found.x is None:
                break
            moved = at - self.motions @ (found.x[:-1] / unit)
            if np.linalg.norm(moved, axis=1).max() <= np.linalg.norm(best, axis=1).max():
                best = moved
        return best

    def _discs(self) -> Array:
        """(N,K) rows that are at most 1 where two motions stay within their disc."""
        rows = np.zeros((0, len(self.reach_mm)))
        first = 0
        while first + 1 < len(self.reach_mm):
            reach = self.reach_mm[first]
            if np.isfinite(reach) and reach == self.reach_mm[first + 1] > 0.0:
                more = np.zeros((SIDES, rows.shape[1]))
                more[:, first : first + 2] = _sides(2) / (reach * np.cos(np.pi / SIDES))
                rows, first = np.concatenate([rows, more]), first + 1
            first += 1
        return rows

    def depends_on(self, directions: Array) -> bool:
        """Whether states (N,S) of about a millimetre change the zone's size by more than a share of that."""
        return bool((self.sizes_mm(directions) > 2.0 * TOLERANCE).any()) if len(directions) else False


@cache
def _sides(dimensions: int) -> Array:
    """(N,D) unit normals of an interval, polygon or polyhedron about zero."""
    if dimensions == 1:
        return np.array([[1.0], [-1.0]])
    if dimensions == 2:
        angle = np.arange(SIDES) * 2.0 * np.pi / SIDES
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Points of a Fibonacci lattice cover a sphere evenly.
    index = np.arange(4 * SIDES) + 0.5
    height, angle = 1.0 - index / (2.0 * SIDES), np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def with_uncertainty(zone: Zone, state: Array, covariance: Array) -> tuple[float, float]:
    """Size of the zone that holds a state (S,) with covariance (S,S), and its expanded uncertainty U, both mm.

    U is what 95 % of draws of the error do not exceed. A size that pure noise stays below with the same probability is
    compatible with zero: there U is at least the size, as in `uncertainty.budget.length_of`.
    """
    rng = np.random.default_rng(0)
    draws = DRAWS_OF_FREE if zone.motions.shape[2] else DRAWS
    errors = rng.standard_normal((draws, len(state))) @ covariance_root(covariance).T
    value = zone.size_mm(state)
    uncertainty = float(np.quantile(np.abs(zone.sizes_mm(state + errors) - value), PROBABILITY))
    if value <= float(np.quantile(zone.sizes_mm(errors), PROBABILITY)):
        uncertainty = max(uncertainty, value)
    return value, uncertainty
