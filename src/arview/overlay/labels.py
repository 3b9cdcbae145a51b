"""Texts of labels: what was measured, and beside it whether the pictures confirm it; the two are never mixed.

Numbers are from the inspection. Only of a displaced component the distance is from the pictures, and then the label has
no number of the inspection.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

import numpy as np

from arview.core.messages import Message, sentence
from arview.geometry import Array, apply
from arview.inspection import ComponentDeviation, Finding, Inspection, Verdict, decimals_of
from arview.overlay.evidence import DISPLACED_RGB, MISSING_RGB, NEXT_RGB, DrawnEvidence, dimmed, evidence_of
from arview.overlay.options import DECIMALS, NEUTRAL_RGB, UNIT, VERDICT_RGB, VERDICT_WORD, OverlayOptions, Rgb
from arview.pose import ComponentPresence

_MM_PER_UNIT = {"mm": 1.0, "inch": 25.4}
_UNIT_SUFFIX = {"mm": " mm", "inch": " in"}
_RANK = {Verdict.FAIL: 0, Verdict.UNDECIDED: 1, Verdict.PASS: 2, Verdict.MEASURED: 3, Verdict.NOT_MEASURED: 4}
OCCLUDED = sentence("label.hidden")
MEASURING = sentence("walk.measuring")
"""What stands in place of a value that is not there yet."""
_SECONDS_PER_DAY = 86400.0
_REMARKS = {
    (DrawnEvidence.UNVERIFIED, True): "label.measured_unverified",
    (DrawnEvidence.UNVERIFIED, False): "label.not_verified",
    (DrawnEvidence.UNCERTAIN, True): "label.measured_uncertain",
    (DrawnEvidence.UNCERTAIN, False): "label.conflicts",
}
"""Keys of the remark on a component that the pictures leave open, by its evidence and whether it was measured."""
_MIN_TURN_DEG = 5.0
"""Rotation of a displaced component below which its label does not tell it."""
_SAME_PLACE_MM = 2.0
"""Distance within which a component that was measured as displaced is seen at the same place."""
_SAME_PLACE_SHARE = 0.3
"""The same as a share of its displacement."""
_ARROW_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ARROW_FRACTION = 0.14
"""Length of the longest arrow, at most, in diameters of the part."""


def _number(value_mm: float, signed: bool = False, uncertainty_mm: float | None = None) -> str:
    """A length in the unit of the labels, with a typographic minus sign and no more decimals than U allows."""
    decimals = DECIMALS
    if uncertainty_mm:
        decimals = min(decimals, decimals_of(uncertainty_mm / _MM_PER_UNIT[UNIT]))
    value = value_mm / _MM_PER_UNIT[UNIT]
    sign = "+" if signed else ""
    return f"{value:{sign}.{decimals}f}".replace("-", "−")


def by_urgency(inspection: Inspection) -> list[ComponentDeviation]:
    """Components by urgency of their labels: failures first, in order of their excess over the tolerance."""

    def key(deviation: ComponentDeviation) -> tuple[int, float, str]:
        if deviation.distance_mm is None or deviation.tolerance_mm is None:
            excess = math.inf if deviation.finding is Finding.MISSING else 0.0
        else:
            excess = deviation.distance_mm / deviation.tolerance_mm
        return _RANK[deviation.verdict], -excess, deviation.name

    return sorted(inspection.components, key=key)


def label_order(names: Iterable[str], inspection: Inspection | None, pending: Collection[str] = ()) -> list[str]:
    """Components with something to tell, by urgency; those that are measured now follow the failed ones.

    Args:
        names: of the components of the model.
        inspection: what was measured, if anything.
        pending: names of the components that are being measured.
    """
    measured = by_urgency(inspection) if inspection else []
    known = {one.name for one in measured}
    urgent = [one.name for one in measured if one.verdict in (Verdict.FAIL, Verdict.UNDECIDED)]
    open_names = [name for name in names if name in pending and name not in known]
    return [*urgent, *open_names, *(one.name for one in measured if one.name not in urgent)]


def value_text(deviation: ComponentDeviation) -> str:
    """The distance with its unit, ``missing``, ``undetermined``, or an empty text if nothing was measured."""
    if deviation.finding is Finding.MISSING:
        return sentence("label.was_missing")
    if deviation.distance_mm is None:
        return "" if deviation.verdict is Verdict.NOT_MEASURED else sentence("label.undetermined")
    return _number(deviation.distance_mm, uncertainty_mm=deviation.uncertainty_mm) + _UNIT_SUFFIX[UNIT]


def detail_parts(deviation: ComponentDeviation) -> tuple[str, ...]:
    """Displacement per axis, rotation and U, as texts that must not be broken; axes within U of zero are left out.

    Undetermined axes are shown with a question mark.
    """
    if deviation.distance_mm is None:
        return ()
    uncertainty_mm = deviation.uncertainty_mm or 0.0
    shown = []
    for axis, value in zip("xyz", deviation.displacement_mm, strict=True):
        if value is None:
            shown.append(f"d{axis} ?")
        elif abs(value) > uncertainty_mm:
            shown.append(f"d{axis} {_number(value, True, uncertainty_mm)}")
    parts = list(shown)
    if deviation.tilt_deg is not None and deviation.tilt_deg >= 0.1:
        parts.append(f"tilt {deviation.tilt_deg:.1f}°")
    if deviation.twist_deg is not None and abs(deviation.twist_deg) >= 0.1:
        parts.append(f"twist {deviation.twist_deg:+.1f}°".replace("-", "−"))
    parts.append(f"U {_number(uncertainty_mm, uncertainty_mm=uncertainty_mm)}")
    return tuple(parts)


def detail_text(deviation: ComponentDeviation) -> str:
    """The parts of `detail_parts` in one line, the axes closer together than the others."""
    parts = detail_parts(deviation)
    axes = "  ".join(part for part in parts if part.startswith("d"))
    return "   ".join([*([axes] if axes else []), *(part for part in parts if not part.startswith("d"))])


def arrow_scale(inspection: Inspection, diameter_mm: float, options: OverlayOptions) -> float:
    """Exaggeration of the arrows: from the options, or the largest round number that keeps the longest one short."""
    if options.arrow_scale is not None:
        return options.arrow_scale
    longest_mm = max((component.distance_mm or 0.0 for component in inspection.components), default=0.0)
    fitting = [s for s in _ARROW_SCALES if s * longest_mm <= _ARROW_FRACTION * diameter_mm]
    return float(fitting[-1] if fitting else _ARROW_SCALES[0])


def arrow_in_model(deviation: ComponentDeviation) -> tuple[float, float, float] | None:
    """Displacement (3,) mm that an arrow shows, with undetermined axes as 0; None if it is within U of zero."""
    if deviation.distance_mm is None or deviation.distance_mm <= (deviation.uncertainty_mm or 0.0):
        return None
    dx, dy, dz = (value or 0.0 for value in deviation.displacement_mm)
    return dx, dy, dz


@dataclass(frozen=True)
class LabelText:
    """The texts of a label.

    Attributes:
        name: of the component; the only text that may be shortened.
        value: distance with its unit, or empty.
        word: verdict, or what the pictures say instead of it.
        notes: doubts and remarks, in texts that are shown below.
        details: of the measurement, in texts that must not be broken; shown where there is room and no note.
        verdict: measured verdict; None if there is none, or it does not hold any longer.
        evidence: how label and component are drawn.
        is_dimmed: the verdict was measured, but is not supported by what is seen now.
    """

    name: str
    value: str
    word: str
    notes: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    verdict: Verdict | None = None
    evidence: DrawnEvidence = DrawnEvidence.SEEN
    is_dimmed: bool = False

    @cached_property
    def rgb(self) -> Rgb:
        """Colour of label and leader."""
        if self.evidence is DrawnEvidence.MISSING:
            return MISSING_RGB
        if self.evidence is DrawnEvidence.DISPLACED:
            return DISPLACED_RGB
        if self.evidence.is_awaited or self.evidence is DrawnEvidence.WRONG:
            return NEXT_RGB if self.evidence.is_awaited else MISSING_RGB
        color = NEUTRAL_RGB if self.verdict is None else VERDICT_RGB[self.verdict]
        return dimmed(color) if self.is_dimmed else color

    @cached_property
    def is_urgent(self) -> bool:
        """Whether the component must be shown by its label or an arrow: refuted, next, failed or undecided."""
        return (
            self.evidence.is_refuted
            or self.evidence is DrawnEvidence.NEXT
            or self.verdict in (Verdict.FAIL, Verdict.UNDECIDED)
        )


def age_text(age_s: float) -> Message:
    """Age in the largest unit in which it is at least two (minutes: one), e.g. ``3 h ago``."""
    for unit, length_s, least in (("days", 86400.0, 2), ("hours", 3600.0, 2), ("minutes", 60.0, 1)):
        if age_s >= least * length_s:
            return sentence(f"age.{unit}", count=round(age_s / length_s))
    return sentence("age.future" if age_s < 0 else "age.now")


def inspection_doubt(
    inspection: Inspection, serial: str | None, options: OverlayOptions, now: datetime | None = None
) -> str:
    """Why an inspection may not hold for the part in view, to be shown on each of its labels, or an empty text.

    Args:
        inspection: what was measured.
        serial: serial number of the part in view; None or empty: not known.
        options: with the age from which on an inspection is stale.
        now: time from which the age is computed; None: the current time.
    """
    if serial and inspection.serial != serial:
        return sentence("label.measured_on", serial=inspection.serial or "a part without serial")
    if options.max_age_days is not None:
        age_days = inspection.age_s(now) / _SECONDS_PER_DAY
        if age_days > options.max_age_days:
            return sentence("told.label_age", age=age_text(inspection.age_s(now)))
    return ""


def label_text(
    name: str,
    deviation: ComponentDeviation | None,
    presence: ComponentPresence | None,
    options: OverlayOptions,
    *,
    center_in_model: Array | None = None,
    is_withheld: bool = False,
    doubt: str = "",
    note: str = "",
    is_pending: bool = False,
) -> LabelText:
    """Texts of a component's label, for the picture and for the page.

    Args:
        name: of the component.
        deviation: what was measured; None if it was not.
        presence: what the pictures say of it; None if it is not checked.
        options: unit and decimals.
        center_in_model: (3,) mm of the component, needed to tell how far a displaced one is away.
        is_withheld: the labels of a serial number must not be shown with this pose.
        doubt: from `inspection_doubt`.
        note: a further remark, e.g. that the place depends on which pose is right.
        is_pending: the component is being measured: `MEASURING` stands in place of the value.
    """
    evidence = evidence_of(presence, is_withheld)
    if evidence is DrawnEvidence.WITHHELD:
        return LabelText(name, "", sentence("label.withheld"), evidence=evidence, is_dimmed=True)
    if evidence.is_awaited or evidence is DrawnEvidence.WRONG:
        word = "" if evidence is DrawnEvidence.LATER else sentence(f"label.{evidence}")
        return LabelText(name, "", word, _with((), note), evidence=evidence)
    changed = sentence("label.changed")
    was_missing = deviation is not None and deviation.finding is Finding.MISSING
    was_measured = deviation is not None and deviation.distance_mm is not None
    if evidence is DrawnEvidence.MISSING:
        notes = _with((), changed if was_measured else sentence("label.as_measured") if was_missing else "")
        value = MEASURING if is_pending else ""
        return LabelText(name, value, sentence("label.missing"), _with(notes, note), evidence=evidence)
    if evidence is DrawnEvidence.DISPLACED:
        assert presence is not None
        away, turned = displacement_texts(presence, center_in_model, options)
        is_new = was_missing or (was_measured and not _is_as_measured(deviation, presence, center_in_model))
        notes = _with(turned, changed if is_new else "", note)
        return LabelText(name, away, sentence("label.displaced"), notes, evidence=evidence)
    if deviation is None:
        word = sentence(f"label.{evidence}") if evidence.is_open or not is_pending else ""
        value = MEASURING if is_pending else ""
        return LabelText(name, value, word, _with((), note), evidence=evidence, is_dimmed=evidence.is_open)
    value, word, verdict = value_text(deviation), VERDICT_WORD[deviation.verdict], deviation.verdict
    remark = ""
    if evidence.is_open:
        remark = sentence(_REMARKS[evidence, verdict is not Verdict.NOT_MEASURED])
    elif was_missing and presence is not None:
        remark = sentence("label.seen_changed")
    notes = _with((), remark, doubt, note)
    is_dimmed = bool(remark or doubt)
    details = () if notes or verdict is Verdict.PASS else detail_parts(deviation)
    return LabelText(
        name, value, word, notes=notes, details=details, verdict=verdict, evidence=evidence, is_dimmed=is_dimmed
    )


def characteristic_labels(inspection: Inspection | None) -> list[tuple[LabelText, Array]]:
    """Labels of the characteristics that fail or are undecided, most urgent first, and where each is in the model."""
    shown = [one for one in inspection.characteristics if one.point_mm and _RANK[one.verdict] < 2] if inspection else []
    shown.sort(key=lambda one: (_RANK[one.verdict], -one.excess_mm))
    # The font of the labels has no diameter sign.
    signs = str.maketrans({"-": "−", "⌀": "Ø"})
    texts = [f"{one.value_text} ({one.allowed_text})".translate(signs) for one in shown]
    return [
        (LabelText(one.name, text, VERDICT_WORD[one.verdict], verdict=one.verdict), np.array(one.point_mm))
        for one, text in zip(shown, texts, strict=True)
    ]


def displacement_texts(
    presence: ComponentPresence, center_in_model: Array | None, options: OverlayOptions
) -> tuple[str, tuple[str, ...]]:
    """How far away a displaced component is seen, and by how much it is turned; rounded, because it is an estimate."""
    if presence.model_from_nominal is None or center_in_model is None:
        return "", ()
    moved = presence.model_from_nominal
    distance = float(np.linalg.norm(apply(moved, center_in_model[None])[0] - center_in_model))
    cosine = min(1.0, max(-1.0, 0.5 * (float(np.trace(moved[:3, :3])) - 1.0)))
    turn_deg = math.degrees(math.acos(cosine))
    digits = (2 if UNIT == "inch" else 1) if distance < 10.0 else (1 if UNIT == "inch" else 0)
    away = sentence("label.away", distance=f"{distance / _MM_PER_UNIT[UNIT]:.{digits}f}{_UNIT_SUFFIX[UNIT]}")
    return away, (sentence("label.turned", angle=f"{turn_deg:.0f}"),) if turn_deg >= _MIN_TURN_DEG else ()


def _is_as_measured(
    deviation: ComponentDeviation | None, presence: ComponentPresence, center_in_model: Array | None
) -> bool:
    """Whether a displaced component is seen where it was measured."""
    if deviation is None or presence.model_from_nominal is None or center_in_model is None:
        return False
    point = center_in_model if deviation.details is None else np.array(deviation.details.center_mm)
    seen = apply(presence.model_from_nominal, point[None])[0] - point
    measured = np.array([value or 0.0 for value in deviation.displacement_mm])
    slack = max(_SAME_PLACE_MM, _SAME_PLACE_SHARE * float(np.linalg.norm(seen)))
    return float(np.linalg.norm(seen - measured)) <= slack


def _with(notes: tuple[str, ...], *more: str) -> tuple[str, ...]:
    return (*notes, *(one for one in more if one))


def text_urgency(
    names: tuple[str, ...],
    inspection: Inspection | None,
    evidence: Mapping[str, DrawnEvidence],
    pending: Collection[str] = (),
) -> list[str]:
    """Components that deserve a label, the most urgent first: missing or displaced ones, those to be mounted
    now, then by `label_order`.
    """
    measured = label_order(names, inspection, pending)
    refuted = [name for name in names if evidence[name].is_refuted]
    rank = {name: index for index, name in enumerate(measured)}
    refuted.sort(key=lambda name: (evidence[name] is DrawnEvidence.DISPLACED, rank.get(name, len(rank)), name))
    shown = [*refuted, *(name for name in names if evidence[name] is DrawnEvidence.NEXT)]
    hidden = {*shown, *(name for name in names if evidence[name] is DrawnEvidence.LATER)}
    return [*shown, *(name for name in measured if name in evidence and name not in hidden)]


def text_size_px(image_height: int) -> int:
    """Size of the label text: legible at 480 rows, and in proportion to the height above."""
    return max(11, round(4.5 + image_height / 72))
