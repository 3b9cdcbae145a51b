"""Scale and approximate frame of a reconstruction from all evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Part
from arview.core.fits import nearest_covariance
from arview.core.progress import Progress
from arview.reconstruction.scale.cad import CadFind, CadOptions, NotFound, Pixels, find_cad
from arview.reconstruction.scale.consistency import check_consistency
from arview.reconstruction.scale.specs import ScaleSources
from arview.reconstruction.scale.targets import scale_from_rig, scale_from_targets
from arview.reconstruction.scale.types import TRUST, Consistency, ScaleEvidence, ScaleResult
from arview.reconstruction.types import PosedPhoto, SparseModel

MAX_SIGMAS = 4.0
"""Sources that differ by more standard deviations than this contradict each other."""
NO_CHECK = Consistency(True, "not checked against the CAD")


@dataclass(frozen=True)
class CombinedScale:
    """The scale on which the evidence agrees.

    Attributes:
        scale: mm per unit.
        std: relative standard deviation.
        evidence: all of it, in order of trust, marked as used or rejected.
        warnings: messages about rejected evidence.
    """

    scale: float
    std: float
    evidence: tuple[ScaleEvidence, ...]
    warnings: tuple[str, ...]


def find_scale(
    sparse: SparseModel,
    part: Part | None,
    sources: ScaleSources | None = None,
    options: CadOptions | None = None,
    read: Callable[[PosedPhoto], Pixels] | None = None,
    progress: Progress | None = None,
) -> ScaleResult:
    """Find the scale (mm per unit) and the approximate CAD frame of a sparse model.

    Args:
        sparse: poses in an arbitrary frame and unit.
        part: to be found in the photos; None uses ``sources`` only and gives no frame.
        sources: known boards, tags, scale bars and rig.
        options: of finding the CAD.
        read: returns the upright (H,W,3) uint8 RGB picture of a photo, of the size of its camera; default: from its
            file.
        progress: called with (what, done, total).

    Raises:
        InputError: a photo cannot be read.
    """
    sources = sources or ScaleSources()
    read = read or read_file
    evidence, missing = scale_from_targets(
        sparse.photos, lambda photo: np.asarray(cv2.cvtColor(read(photo), cv2.COLOR_RGB2GRAY)), sources
    )
    if sources.rig is not None:
        of_rig, not_in_rig = scale_from_rig(sparse.photos, sources.rig)
        evidence, missing = evidence + of_rig, missing + not_in_rig
    found: CadFind | NotFound = NotFound("no part was given")
    if part is not None:
        found = find_cad(sparse.photos, read, part, options or CadOptions(), progress)
    return scale_of_cad(sparse, part, found, evidence, missing)


def scale_of_cad(
    sparse: SparseModel,
    part: Part | None,
    found: CadFind | NotFound,
    evidence: Sequence[ScaleEvidence],
    remarks: Sequence[str],
) -> ScaleResult:
    """Scale and frame by the CAD as it was found, and by other evidence; ``remarks`` come before other warnings."""
    if isinstance(found, CadFind):
        std = float(np.sqrt(found.fit.covariance[6, 6]))
        evidence = [*evidence, ScaleEvidence("cad", found.fit.similarity.scale, std, found.detail)]
    combined = combine(evidence)
    warnings = [*remarks, *(combined.warnings if combined else ())]
    if isinstance(found, NotFound) or combined is None or part is None:
        no_fit = NotFound("") if isinstance(found, CadFind) else found
        consistency = Consistency(False, no_fit.reason) if no_fit.is_contradiction else NO_CHECK
        warnings += [no_fit.reason] if no_fit.is_contradiction else []
        return ScaleResult(
            combined.scale if combined else None,
            combined.std if combined else None,
            None,
            covariance=None,
            evidence=combined.evidence if combined else (),
            warnings=tuple(warnings),
            why_no_frame=no_fit.reason,
            consistency=consistency,
        )
    # The change of scale by the other sources moves the frame by as much as the two are correlated.
    fit = found.fit
    change = float(np.log(combined.scale / fit.similarity.scale))
    by_scale = fit.covariance[:, 6] / fit.covariance[6, 6]
    similarity = fit.similarity.moved(by_scale * change, part.model.center_in_model)
    covariance = fit.covariance[:6, :6] + np.outer(by_scale[:6], by_scale[:6]) * (
        combined.std**2 - fit.covariance[6, 6]
    )
    consistency = check_consistency(sparse, part.model, found, similarity)
    against = [e for e in combined.evidence if e.kind == "cad" and not e.is_used]
    if against:
        reason = f"the size of the CAD contradicts {combined.evidence[0].detail}"
        consistency = replace(consistency, is_consistent=False, reason=f"{reason}; {consistency.reason}")
    warnings += found.warnings
    if not consistency.is_consistent:
        warnings.append(consistency.reason)
    return ScaleResult(
        combined.scale,
        combined.std,
        similarity.model_from_scan,
        covariance=nearest_covariance(covariance),
        evidence=combined.evidence,
        warnings=tuple(warnings),
        why_no_frame="",
        consistency=consistency,
    )


def combine(evidence: Sequence[ScaleEvidence]) -> CombinedScale | None:
    """Weighted mean of the evidence by inverse variance; None without any.

    Evidence that differs from more trusted evidence by more than MAX_SIGMAS standard deviations is rejected, with a
    warning that names both. If the rest scatters by more than its standard deviations allow, that of the mean is
    increased.
    """
    ordered = sorted(evidence, key=lambda e: TRUST.index(e.kind))
    checked: list[ScaleEvidence] = []
    warnings = []
    for e in ordered:
        trusted = [other for other in checked if other.is_used]
        apart = [abs(np.log(e.mm_per_unit / t.mm_per_unit)) / np.hypot(e.std, t.std) for t in trusted]
        is_used = not apart or bool(max(apart) <= MAX_SIGMAS)
        checked.append(replace(e, is_used=is_used))
        if not is_used:
            rival = trusted[int(np.argmax(apart))]
            percent = 100.0 * (e.mm_per_unit / rival.mm_per_unit - 1.0)
            warnings.append(
                f"the scale of [{e.detail}] differs by {percent:+.3f} % ({max(apart):.0f} σ) from that of "
                f"[{rival.detail}], which is more trusted and was used"
            )
    used = [e for e in checked if e.is_used]
    if not used:
        return None
    weights = np.array([1.0 / e.std**2 for e in used])
    logs = np.log([e.mm_per_unit for e in used])
    mean = float(weights @ logs / weights.sum())
    excess = float(weights @ (logs - mean) ** 2) / max(1, len(used) - 1)
    std = float(np.sqrt(max(1.0, excess) / weights.sum()))
    return CombinedScale(float(np.exp(mean)), std, tuple(checked), tuple(warnings))


def read_file(photo: PosedPhoto) -> NDArray[np.uint8]:
    """The picture of a photo, from its file."""
    from arview.reconstruction.intake.reading import read_photo

    return read_photo(photo.path)
