"""Result of an evaluation as text."""

from __future__ import annotations

from arview_lab.evaluation.run import FrameResult, SceneResult, Spread, Summary

_FIGURES = (
    ("translation", "translation_mm", "mm"),
    ("  across", "across_mm", "mm"),
    ("  depth", "depth_mm", "mm"),
    ("rotation", "rotation_deg", "deg"),
    ("ADD", "add_mm", "mm"),
    ("contour", "contour_px", "px"),
)


def format_result(result: SceneResult, per_frame: bool = False) -> str:
    """Several lines of text for one scene, without a final newline."""
    summary = result.summary
    lines = [f"{result.scene}: from {result.init}; reference: {result.reference}"]
    if per_frame:
        lines += [_frame_line(frame) for frame in result.frames]
    states = ", ".join(f"{count} {state}" for state, count in sorted(summary.states.items()))
    lines.append(f"  {summary.frames} frames ({states}), {summary.evaluated} evaluated")
    lines.append(f"  lost {summary.lost}, false tracked {summary.false_tracked}{_shares(summary)}")
    if summary.errors:
        lines.append(f"  {'':<13}{'median':>9}{'p95':>9}{'max':>9}")
    for label, name, unit in _FIGURES:
        if name in summary.errors:
            lines.append(f"  {label:<13}{_row(summary.errors[name], 3)}  {unit}")
    for label, spread in (("tracking", summary.track_ms), ("detection", summary.detect_ms)):
        if spread is not None:
            lines.append(f"  {label:<13}{_row(spread, 2)}  ms a frame")
    return "\n".join(lines)


def _row(spread: Spread, digits: int) -> str:
    return "".join(f"{value:9.{digits}f}" for value in (spread.median, spread.p95, spread.max))


def _shares(summary: Summary) -> str:
    if summary.within_5cm_5deg is None or summary.within_2cm_2deg is None:
        return ""
    return f", within 5 cm/5° {100 * summary.within_5cm_5deg:.1f} %, 2 cm/2° {100 * summary.within_2cm_2deg:.1f} %"


def _frame_line(frame: FrameResult) -> str:
    pose, error = frame.pose, frame.error
    text = f"  {pose.index:6d} {pose.state:<9} q {pose.quality:4.2f} {pose.ms:8.2f} ms"
    if error is not None:
        text += (
            f"  {error.translation_mm:8.2f} mm (across {error.across_mm:.2f}, depth {error.depth_mm:+.2f})"
            f" {error.rotation_deg:7.2f} deg  ADD {error.add_mm:.2f} mm"
        )
        text += f"  {error.contour_px:.2f} px" if error.contour_px is not None else ""
    return text + ("  FALSE" if frame.is_false_tracked else "")
