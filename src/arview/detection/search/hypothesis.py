"""Hypothesis: a refined pose with everything known for and against it."""

from __future__ import annotations

from dataclasses import dataclass

from arview.detection.confidence import appearance_score, confidence_weights, evidence_logit
from arview.geometry import Array
from arview.refinement import PoseEvidence


@dataclass(frozen=True)
class Hypothesis:
    """A refined pose about the part's centre, and its scores.

    Attributes:
        cam_from_body: (4,4).
        evidence: edge and colour evidence at the pose.
        profile_score: of the profile rankers for refined poses.
        view_lines: distinct lines that the view at the pose shows.
        radius_px: half the part's diameter in the image.
        verifier_score: of the pose verifier; None before verification.
        edge_response: mean edge response along the part's lines, 0–1; 0 before verification.
        contour_score: of the contour verifier; 0 before verification.
        outline_score: how clearly the image shows the outline, see `confidence.outline_score`; 0 before verification.
    """

    cam_from_body: Array
    evidence: PoseEvidence
    profile_score: float
    view_lines: float
    radius_px: float
    verifier_score: float | None = None
    edge_response: float = 0.0
    contour_score: float = 0.0
    outline_score: float = 0.0

    @property
    def evidence_logit(self) -> float:
        """Log odds by the evidence alone, see `confidence.evidence_logit`."""
        return evidence_logit(self.evidence, self.view_lines, self.radius_px)

    @property
    def appearance_score(self) -> float:
        """Verifier score and edge response as one term of the probability, see `confidence.appearance_score`."""
        return appearance_score(self.verifier_score or 0.0, self.edge_response)

    @property
    def logit(self) -> float:
        """Log odds that compare the hypotheses of one image, of which either all or none are verified."""
        weights = confidence_weights()
        if self.verifier_score is not None:
            return self.logit_without_contour + weights.verified.contour * self.contour_score
        return weights.unverified_evidence * self.evidence_logit + self.profile_score

    @property
    def logit_without_contour(self) -> float:
        """Log odds of a verified hypothesis among near-symmetric ones, whose outlines differ by chance only."""
        weights = confidence_weights().verified
        others = weights.evidence * self.evidence_logit + weights.profile * self.profile_score
        return (self.verifier_score or 0.0) + others + weights.edge_response * self.edge_response
