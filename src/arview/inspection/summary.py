"""Overall verdict and summary of an inspection."""

from __future__ import annotations

from collections import Counter

from arview.inspection.record import Finding, Inspection, Verdict

_WORDS = {
    Verdict.FAIL: "out of tolerance",
    Verdict.UNDECIDED: "undecided",
    Verdict.MEASURED: "measured without a tolerance",
    Verdict.NOT_MEASURED: "not measured",
    Verdict.PASS: "in tolerance",
}


def overall_verdict(inspection: Inspection) -> Verdict:
    """Verdict of the whole part.

    Fail if a component or characteristic fails; not measured if nothing was measured; undecided if one of them is
    undecided or was not measured, or if there are foreign objects; measured if none has a tolerance; otherwise pass.
    """
    verdicts = {component.verdict for component in inspection.components}
    verdicts |= {one.verdict for one in inspection.characteristics}
    if Verdict.FAIL in verdicts:
        return Verdict.FAIL
    if not verdicts or verdicts == {Verdict.NOT_MEASURED}:
        return Verdict.NOT_MEASURED
    if not verdicts <= {Verdict.PASS, Verdict.MEASURED} or inspection.foreign_objects:
        return Verdict.UNDECIDED
    return Verdict.PASS if Verdict.PASS in verdicts else Verdict.MEASURED


def verdict_sentence(inspection: Inspection) -> str:
    """Number of components by verdict, the most severe first: ``16 components: 1 missing, 2 out of tolerance, …``."""
    total = len(inspection.components)
    counts = Counter(component.verdict for component in inspection.components)
    missing = sum(component.finding is Finding.MISSING for component in inspection.components)
    counts[Verdict.FAIL] -= missing
    parts = [f"{counts[verdict]} {word}" for verdict, word in _WORDS.items() if counts[verdict]]
    if missing:
        parts.insert(0, f"{missing} missing")
    if inspection.foreign_objects:
        parts.append(f"{len(inspection.foreign_objects)} foreign object{'s' * (len(inspection.foreign_objects) > 1)}")
    sentence = f"{total} component{'s' * (total != 1)}: {', '.join(parts)}" if parts else "no components"
    verdicts = Counter(one.verdict for one in inspection.characteristics)
    if not verdicts:
        return sentence
    count, words = (
        verdicts.total(),
        ", ".join(f"{verdicts[key]} {word}" for key, word in _WORDS.items() if verdicts[key]),
    )
    return f"{sentence}; {count} characteristic{'s' * (count != 1)}: {words}"
