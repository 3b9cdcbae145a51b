"""Evidence for the scale of a reconstruction, and the result of combining it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from arview.geometry import Array
from arview.reconstruction.scale.similarity import Similarity

Kind = Literal["tag_layout", "board", "tag", "scale_bar", "rig", "cad"]
"""Kinds of evidence."""
TRUST: tuple[Kind, ...] = ("tag_layout", "board", "tag", "scale_bar", "rig", "cad")
"""Kinds of evidence, the most trusted first."""


@dataclass(frozen=True)
class ScaleEvidence:
    """One source of the scale.

    Attributes:
        kind: of evidence.
        mm_per_unit: the scale.
        std: relative standard deviation.
        detail: description of what was used.
        is_used: False when it was rejected.
    """

    kind: Kind
    mm_per_unit: float
    std: float
    detail: str
    is_used: bool = True

    def as_dict(self) -> dict[str, Any]:
        """The evidence for JSON."""
        return {
            "kind": self.kind,
            "mm_per_unit": self.mm_per_unit,
            "std_relative": self.std,
            "detail": self.detail,
            "used": self.is_used,
        }


@dataclass(frozen=True)
class Consistency:
    """Whether the reconstruction has the shape of the CAD.

    Attributes:
        is_consistent: no evidence contradicts it; also True when nothing could be checked, see ``reason``.
        reason: what contradicts it, or what was checked.
        edges_found, edges_by_chance: shares of predicted CAD edges with a step of brightness at them, and beside them.
        residual_px: robust standard deviation of the edges' offsets.
        points_near, points_behind: shares of the sparse points on the part that are near the CAD's surface, and behind
            it.
        misfits: names of photos in which the edges are not where the other photos have them.
    """

    is_consistent: bool
    reason: str
    edges_found: float | None = None
    edges_by_chance: float | None = None
    residual_px: float | None = None
    points_near: float | None = None
    points_behind: float | None = None
    misfits: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScaleResult:
    """Scale and pose of a reconstruction.

    Attributes:
        scale: mm per unit; None without evidence.
        scale_std: relative standard deviation; None without a scale.
        model_from_scan: (4,4) rigid, applied after scaling (`SparseModel.transformed`); None if the CAD was not found,
            see ``why_no_frame``.
        covariance: (6,6) of ``model_from_scan``: twist (rad, mm) about the model's centre; None without it.
        evidence: every source, in order of trust; rejected ones have ``is_used`` False.
        warnings: messages about disagreement of the sources and other doubts.
        why_no_frame: why the part was not found; empty if it was.
        consistency: of the reconstruction's shape with the CAD's.
    """

    scale: float | None
    scale_std: float | None
    model_from_scan: Array | None
    covariance: Array | None
    evidence: tuple[ScaleEvidence, ...]
    warnings: tuple[str, ...]
    why_no_frame: str
    consistency: Consistency

    @property
    def similarity(self) -> Similarity | None:
        """Scale and frame together; None if one is missing."""
        if self.scale is None or self.model_from_scan is None:
            return None
        return Similarity(self.scale, self.model_from_scan)

    def provenance(self) -> dict[str, Any]:
        """The result for JSON."""
        c = self.consistency
        return {
            "mm_per_unit": self.scale,
            "std_relative": self.scale_std,
            "evidence": [evidence.as_dict() for evidence in self.evidence],
            "warnings": list(self.warnings),
            "model_from_scan": None if self.model_from_scan is None else self.model_from_scan.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "why_no_frame": self.why_no_frame,
            "consistency": {
                "is_consistent": c.is_consistent,
                "reason": c.reason,
                "edges_found": c.edges_found,
                "edges_by_chance": c.edges_by_chance,
                "residual_px": c.residual_px,
                "points_near": c.points_near,
                "points_behind": c.points_behind,
                "misfits": list(c.misfits),
            },
        }

    @classmethod
    def from_provenance(cls, content: dict[str, Any]) -> ScaleResult:
        """The inverse of `provenance`."""
        c = dict(content["consistency"])
        matrices = [None if content[name] is None else np.array(content[name]) for name in _MATRICES]
        return cls(
            scale=content["mm_per_unit"],
            scale_std=content["std_relative"],
            model_from_scan=matrices[0],
            covariance=matrices[1],
            evidence=tuple(
                ScaleEvidence(e["kind"], e["mm_per_unit"], e["std_relative"], e["detail"], e["used"])
                for e in content["evidence"]
            ),
            warnings=tuple(content["warnings"]),
            why_no_frame=content["why_no_frame"],
            consistency=Consistency(**{**c, "misfits": tuple(c["misfits"])}),
        )


_MATRICES = ("model_from_scan", "covariance")
