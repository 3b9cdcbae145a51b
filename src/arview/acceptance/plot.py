"""Plot of the errors over the length, with U and the maximum permissible error."""

from __future__ import annotations

import io

import numpy as np

from arview.acceptance.conformity import UncertaintyCheck, Verification
from arview.core.figures import INK, MUTED, figure
from arview.errors import InputError
from arview.inspection import Verdict

FORMATS = ("png", "svg", "pdf")
_COLORS = {Verdict.PASS: "#2b5c8a", Verdict.UNDECIDED: "#b7791f", Verdict.FAIL: "#c22f2b"}


def draw(test: Verification, kind: str = "png") -> bytes:
    """Draw the test as a picture of one of FORMATS.

    Raises:
        InputError: another format.
    """
    if kind not in FORMATS:
        raise InputError(f"plot: {kind!r}: expected one of {', '.join(FORMATS)}")
    known = np.array([one.known.mm for one in test.lengths])
    errors = np.array([one.error_mm for one in test.lengths])
    with figure(4.4, 8.0) as (made, axes):
        axes.axhline(0.0, color=MUTED, linewidth=0.8)
        us = [one.uncertainty_mm for one in test.lengths]
        if all(u is not None for u in us):
            axes.errorbar(
                known,
                errors,
                yerr=np.array(us, dtype=float),
                fmt="none",
                ecolor="#d3dae2",
                elinewidth=1.2,
                zorder=1,
                label="U (k = 2)",
            )
        if test.limit is not None:
            steps = np.linspace(0.0, 1.04 * known.max(), 200)
            limit = np.array([test.limit.at(length) for length in steps])
            for sign in (1.0, -1.0):
                axes.plot(
                    steps,
                    sign * limit,
                    color=INK,
                    linewidth=1.1,
                    label=f"permissible: ± {test.limit}" if sign > 0 else None,
                )
        for verdict, color in _COLORS.items():
            mine = np.array([one.verdict is verdict for one in test.lengths])
            shown = verdict if test.limit is not None else "error"
            if mine.any():
                axes.plot(
                    known[mine],
                    errors[mine],
                    "o",
                    color=color if test.limit else _COLORS[Verdict.PASS],
                    markersize=4.0,
                    zorder=3,
                    label=f"{shown} ({mine.sum()})",
                )
        axes.set_xlim(0.0, 1.04 * known.max())
        axes.set_xlabel("known length, mm")
        axes.set_ylabel("measured minus known, mm")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=5)
        u = (
            ""
            if test.u_held is UncertaintyCheck.NOT_STATED
            else f"; U {test.u_held}: {test.within} of {len(errors)} within"
        )
        axes.set_title(f"{len(errors)} lengths: {test.verdict}{u}", loc="left", fontsize=11, color=INK)
        out = io.BytesIO()
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
        made.savefig(out, format=kind, dpi=120, metadata=metadata)
    return out.getvalue()
