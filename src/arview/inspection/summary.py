"""What an inspection says of the part as a whole."""

from __future__ import annotations

from collections import Counter

from arview.inspection.record import Finding, Inspection, Verdict

_WORDS = {
    Verdict.FAIL: "out of tolerance",
    Verdict.UNDECIDED: "undecided",
    Verdict.NOT_MEASURED: "not measured",
    Verdict.PASS: "in tolerance",
}


def overall_verdict(inspection: Inspection) -> Verdict:
    """Of the whole part.

    Fail when one component fails; not measured when none was measured; undecided when one is undecided or was not
    measured, or something foreign is there; else pass.
    """
    verdicts = {component.verdict for component in inspection.components}
    if Verdict.FAIL in verdicts:
        return Verdict.FAIL
    if not verdicts or verdicts == {Verdict.NOT_MEASURED}:
        return Verdict.NOT_MEASURED
    return Verdict.UNDECIDED if verdicts != {Verdict.PASS} or inspection.foreign_objects else Verdict.PASS


def verdict_sentence(inspection: Inspection) -> str:
    """The counts in words, what matters most first: ``2 of 16 components out of tolerance, 1 missing, …``."""
    total = len(inspection.components)
    counts = Counter(component.verdict for component in inspection.components)
    missing = sum(component.finding is Finding.MISSING for component in inspection.components)
    counts[Verdict.FAIL] -= missing
    parts = [f"{counts[verdict]} {word}" for verdict, word in _WORDS.items() if counts[verdict]]
    if missing:
        parts.insert(0, f"{missing} missing")
    if inspection.foreign_objects:
        parts.append(f"{len(inspection.foreign_objects)} foreign object{'s' * (len(inspection.foreign_objects) > 1)}")
    return f"{total} component{'s' * (total != 1)}: {', '.join(parts)}" if parts else "no components"
