"""What the pictures say of each component, and how ghost and edges show it: by colour and by pattern, never by colour
alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model
from arview.inspection import Inspection, Verdict
from arview.overlay.options import CONTEXT_RGB, NEUTRAL_RGB, VERDICT_RGB, OverlayOptions, Rgb
from arview.pose import ComponentPresence, Pose, Presence

MISSING_RGB: Rgb = (255, 72, 66)
"""Colour of the hatched ghost and the badge of a missing component."""
DISPLACED_RGB: Rgb = (214, 122, 255)
"""Colour of both places of a displaced component."""
NEXT_RGB: Rgb = (255, 236, 92)
"""Colour of a component that is to be mounted now."""
DIMMED_RGB: Rgb = (150, 158, 170)
"""Grey into which the colour of a verdict is mixed where the pictures do not support it."""
PLAIN, STRIPES, CROSSES = 0, 1, 2
"""Patterns of a ghost."""

_CONTEXT_WEIGHT = 0.25
"""Cost of covering a component that was not inspected with a label, relative to one that was."""
_CONTEXT_EDGE_ALPHA = 0.5
"""Opacity of the edges of components that were not inspected."""
_PASS_DIMMING = 0.65
"""Factor of the opacity of components that passed, so that the others stand out."""
_DIMMED_OPACITY = 0.45
"""Factor of the opacity of components that the pictures do not verify."""
_DIMMED_SHARE = 0.6
"""Share of grey in the colour of a dimmed verdict."""
_HATCH_OPACITY = 0.75
"""Opacity of the lines of a hatched ghost: higher than of a plain one, because they cover little."""


class DrawnEvidence(StrEnum):
    """How a component is drawn."""

    SEEN = "seen"
    """At its nominal place, or not to be checked: drawn as it was measured."""
    UNVERIFIED = "unverified"
    UNCERTAIN = "uncertain"
    MISSING = "missing"
    DISPLACED = "displaced"
    WITHHELD = "withheld"
    """The part in view may be another specimen: nothing measured is shown."""
    NEXT = "next"
    """To be mounted now."""
    LATER = "later"
    """To be mounted later: not drawn."""
    WRONG = "wrong"
    """To be mounted now, and something else stands at its place."""

    @property
    def is_open(self) -> bool:
        """Whether the pictures neither verify nor refute the measured state."""
        return self in (DrawnEvidence.UNVERIFIED, DrawnEvidence.UNCERTAIN)

    @property
    def is_refuted(self) -> bool:
        """Whether the component was seen not to be at its nominal place."""
        return self in (DrawnEvidence.MISSING, DrawnEvidence.DISPLACED, DrawnEvidence.WRONG)

    @property
    def is_awaited(self) -> bool:
        """Whether the component is still to be mounted, and nothing is wrong with that."""
        return self in (DrawnEvidence.NEXT, DrawnEvidence.LATER)


_AWAITED = {DrawnEvidence.NEXT: (0.6, 1.0, 1.0), DrawnEvidence.LATER: (0.0, 0.0, 0.0)}
"""Opacity of ghost and edges, and weight, of components to be mounted; behind the next one is its bare place."""
_EVIDENCE = {
    Presence.UNVERIFIED: DrawnEvidence.UNVERIFIED,
    Presence.UNCERTAIN: DrawnEvidence.UNCERTAIN,
    Presence.PRESENT: DrawnEvidence.SEEN,
    Presence.MISSING: DrawnEvidence.MISSING,
    Presence.DISPLACED: DrawnEvidence.DISPLACED,
    Presence.NEXT: DrawnEvidence.NEXT,
    Presence.LATER: DrawnEvidence.LATER,
    Presence.WRONG: DrawnEvidence.WRONG,
}


def evidence_of(presence: ComponentPresence | None, is_withheld: bool = False) -> DrawnEvidence:
    """DrawnEvidence on a component; a presence of None is not checked."""
    if is_withheld:
        return DrawnEvidence.WITHHELD
    return DrawnEvidence.SEEN if presence is None else _EVIDENCE[presence.presence]


def presence_of(pose: Pose, name: str, count: int) -> ComponentPresence | None:
    """Presence of a component in a pose; None if it is not checked because the part has a ``count`` of one."""
    if name in pose.components:
        return pose.components[name]
    return None if count == 1 and not pose.components else ComponentPresence()


def dimmed(color: Rgb) -> Rgb:
    """The colour of a verdict that the pictures do not support."""
    mixed = (1.0 - _DIMMED_SHARE) * np.array(color) + _DIMMED_SHARE * np.array(DIMMED_RGB)
    red, green, blue = (round(float(value)) for value in mixed)
    return red, green, blue


@dataclass(frozen=True)
class ComponentStyles:
    """Appearance of all C components.

    Attributes:
        ghost: (C,4) float32 r, g, b in 0–255 and alpha in 0–1.
        edges: (C,4) likewise.
        weight: (C,) float32 cost of covering the component with a label.
        patterns: (C,) int8 PLAIN, STRIPES or CROSSES of the ghost.
        dashed: (C,) bool: edges are dashed.
    """

    ghost: NDArray[np.float32]
    edges: NDArray[np.float32]
    weight: NDArray[np.float32]
    patterns: NDArray[np.int8]
    dashed: NDArray[np.bool_]


def component_styles(
    model: Model,
    inspection: Inspection | None,
    options: OverlayOptions,
    evidence: tuple[DrawnEvidence, ...],
    is_doubtful: bool,
) -> ComponentStyles:
    """Styles for the evidence on each component; ``is_doubtful`` dims all verdicts of a stale or other inspection."""
    ghost, edges, weight, patterns, is_dashed = [], [], [], [], []
    for component, seen in zip(model.components, evidence, strict=True):
        deviation = inspection.find(component.name) if inspection else None
        color, opacity, edge_alpha, cost = NEUTRAL_RGB, options.opacity, 1.0, 1.0
        if deviation is not None:
            color = VERDICT_RGB[deviation.verdict]
            opacity *= _PASS_DIMMING if deviation.verdict is Verdict.PASS else 1.0
        elif inspection is not None:
            color, opacity, edge_alpha, cost = CONTEXT_RGB, 0.0, _CONTEXT_EDGE_ALPHA, _CONTEXT_WEIGHT
        pattern = PLAIN
        if seen is DrawnEvidence.WITHHELD:
            color, opacity, edge_alpha = CONTEXT_RGB, 0.0, 1.0
        elif seen.is_awaited:
            color, (opacity, edge_alpha, cost) = NEXT_RGB, _AWAITED[seen]
        elif seen.is_refuted:
            color, opacity = DISPLACED_RGB if seen is DrawnEvidence.DISPLACED else MISSING_RGB, _HATCH_OPACITY
            pattern = CROSSES if seen is DrawnEvidence.MISSING else STRIPES
            edge_alpha, cost = 1.0, 1.0
        elif (seen.is_open or is_doubtful) and deviation is not None:
            color, opacity = dimmed(color), opacity * _DIMMED_OPACITY
        elif seen.is_open:
            opacity *= _DIMMED_OPACITY
        ghost.append([*color, opacity if options.show_ghost else 0.0])
        edges.append([*(0.75 * np.array(color) + 0.25 * 255), edge_alpha])
        weight.append(cost)
        patterns.append(pattern)
        is_dashed.append(seen.is_open or seen is DrawnEvidence.DISPLACED)
    return ComponentStyles(
        np.array(ghost, dtype=np.float32),
        np.array(edges, dtype=np.float32),
        np.array(weight, dtype=np.float32),
        np.array(patterns, dtype=np.int8),
        np.array(is_dashed, dtype=np.bool_),
    )
