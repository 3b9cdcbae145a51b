"""Remarks on components of a part: too small, thin or open ones. Equal remarks are gathered in one line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from arview.cad.fitness import MeshFitness

Severity = Literal["problem", "warning", "note"]

SMALL_PX = 12.0
"""Middle extent of a component in the picture below which its contour has too few lines."""

THIN_PX = 3.0
"""Thickness in the picture below which both edges of a component seen edge-on merge."""

SHEET_FRACTION = 1e-3
"""Ratio of the smallest to the largest extent below which a component counts as a sheet."""

NAMES_LISTED = 6
"""Number of names in a gathered remark, after which the rest is counted."""


@dataclass(frozen=True)
class Remark:
    """A remark on one component, and how equal remarks are put in one line.

    Attributes:
        severity: as of `PartFinding`.
        name: of the component.
        text: what is wrong with it, after its name.
        plural: what is wrong with several, after their number; ``{low}`` and ``{high}`` are the range of ``value``.
        value: a number of the remark, for ``plural``.
    """

    severity: Severity
    name: str
    text: str
    plural: str
    value: float = 0.0


def gathered(remarks: list[Remark]) -> list[tuple[Severity, str]]:
    """Severity and text of remarks, those of one kind in one line."""
    groups: dict[tuple[Severity, str], list[Remark]] = {}
    for remark in remarks:
        groups.setdefault((remark.severity, remark.plural), []).append(remark)
    lines = []
    for (severity, plural), group in groups.items():
        if len(group) == 1:
            lines.append((severity, f"{group[0].name} {group[0].text}"))
            continue
        low, high = min(r.value for r in group), max(r.value for r in group)
        text = plural.replace("{low}", f"{low:.3g}").replace("{high}", f"{high:.3g}")
        names = listed([remark.name for remark in group], NAMES_LISTED)
        lines.append((severity, f"{len(group)} components {text}: {names}"))
    return lines


def listed(items: list[str], limit: int, separator: str = ", ") -> str:
    """Items up to a limit, and the number of the others."""
    rest = f" and {len(items) - limit} more" if len(items) > limit else ""
    return separator.join(items[:limit]) + rest


def size_remarks(
    name: str,
    pixels_across: tuple[float, float],
    extents_mm: tuple[float, float, float],
    distance_mm: tuple[float, float],
    is_inspected: bool,
) -> list[Remark]:
    """Whether a component is too small, small or thin in the picture, at the nearest and the farthest distance.

    Args:
        name: of the component.
        pixels_across: its middle extent, px, at the farthest and the nearest distance.
        extents_mm: its extents, largest first.
        distance_mm: nearest and farthest distance.
        is_inspected: whether it is measured; too small is then a problem.
    """
    near_mm, far_mm = distance_mm
    far_px, near_px = pixels_across
    if near_px < SMALL_PX:
        return [
            Remark(
                "problem" if is_inspected else "warning",
                name,
                f"is too small to be seen: {near_px:.1f} px across even at {near_mm:.0f} mm",
                f"are too small to be seen, {{low}} to {{high}} px across even at {near_mm:.0f} mm",
                near_px,
            )
        ]
    if far_px < SMALL_PX:
        limit_mm = near_mm * near_px / SMALL_PX
        return [
            Remark(
                "warning",
                name,
                f"is small: {far_px:.1f} px across at {far_mm:.0f} mm; large enough up to {limit_mm:.0f} mm",
                f"are small, {{low}} to {{high}} px across at {far_mm:.0f} mm, where {SMALL_PX:.0f} are needed",
                far_px,
            )
        ]
    thin_px = far_px * extents_mm[2] / extents_mm[1]
    if thin_px < THIN_PX:
        return [
            Remark(
                "note",
                name,
                f"is thin: {thin_px:.1f} px at {far_mm:.0f} mm when seen edge-on",
                f"are thin, {{low}} to {{high}} px at {far_mm:.0f} mm when seen edge-on",
                thin_px,
            )
        ]
    return []


def mesh_remarks(name: str, fitness: MeshFitness) -> list[Remark]:
    """Whether the mesh of a component is a sheet, open, not a surface, or wound inconsistently."""
    remarks = []
    if fitness.thickness_mm < SHEET_FRACTION * fitness.extents_mm[0]:
        remarks.append(
            Remark(
                "warning",
                name,
                f"is a sheet without thickness ({fitness.thickness_mm:.3g} mm): give it one in the CAD",
                "are sheets without thickness, give them one in the CAD",
            )
        )
    elif fitness.open_edge_count:
        count = fitness.open_edge_count
        edges = "1 open edge, which" if count == 1 else f"{count} open edges, which"
        remarks.append(
            Remark(
                "warning",
                name,
                f"is not closed: {edges} will appear as {'a contour' if count == 1 else 'contours'}",
                "are not closed, {low} to {high} open edges each, which will appear as contours",
                float(fitness.open_edge_count),
            )
        )
    if fitness.non_manifold_edge_count:
        count = fitness.non_manifold_edge_count
        remarks.append(
            Remark(
                "warning",
                name,
                f"has {count} edge{'' if count == 1 else 's'} shared by more than two triangles (non-manifold)",
                "have edges shared by more than two triangles (non-manifold), {low} to {high} each",
                float(count),
            )
        )
    if not fitness.is_consistent:
        remarks.append(
            Remark("warning", name, "has triangles that face the wrong way", "have triangles that face the wrong way")
        )
    return remarks
