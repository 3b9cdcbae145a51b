"""The section of a report that compares two halves of the photos."""

from __future__ import annotations

from typing import Any

import numpy as np

from arview.inspection import Inspection, Repeatability, decimals_of
from arview.report.formatting import NONE, number


def repeatability_context(inspection: Inspection) -> dict[str, Any]:
    """The rows and sentences of the section; empty without a comparison."""
    found = inspection.repeatability
    if found is None:
        return {"halves": []}
    if found.reason:
        return {"halves": [], "halves_absent": f"Two halves of the photos were not compared: {found.reason}."}
    rows = []
    for one in found.components:
        rows.append(
            {
                "name": one.name,
                "difference": number(one.difference_mm),
                "first": number(one.uncertainties_mm[0], decimals_of(one.uncertainties_mm[0])),
                "second": number(one.uncertainties_mm[1], decimals_of(one.uncertainties_mm[1])),
                "joint": number(one.joint_mm),
                "e_n": NONE if one.e_n is None else number(one.e_n, 2),
                "is_beyond": one.e_n is not None and one.e_n > 1.0,
                "remark": one.reason or ("differ by more than their U allow" if one in found.contradictions else ""),
            }
        )
    return {"halves": rows, "halves_lead": _lead(found)}


def _lead(found: Repeatability) -> str:
    """What was compared, and what follows."""
    first, second = (*found.photos, 0, 0)[:2]
    text = (
        f"Every other photo ({first}) and the rest ({second}) were adjusted apart, each with its own lens and poses,"
        " and measured apart, each in its own datum frame. They share features, matches, the CAD and what is known of"
        " the scale from elsewhere, so an error of these is not seen here."
    )
    ratios = [one.e_n for one in found.components if one.e_n is not None]
    if not ratios or found.rms_mm is None:
        return f"{text} No component could be compared."
    beyond = len(found.contradictions)
    text += (
        f" The components differ by {number(found.rms_mm)} mm rms; all photos together repeat to about half of that."
        f" {beyond} of {len(ratios)} differ by more than the U of both halves allow (1 in 20 would by chance), E_n is"
        f" {float(np.sqrt(np.mean(np.square(ratios)))):.2f} rms."
    )
    if beyond:
        text += " Where they do, the excess is part of U."
    return text if found.cpu_s is None else f"{text} The comparison took {found.cpu_s:.0f} s of processor time."
