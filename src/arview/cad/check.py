"""check_part: what is in a part, and what will be hard about finding, tracking and inspecting it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from arview.cad.fitness import MeshFitness, inspect_mesh
from arview.cad.model import Component
from arview.cad.part import ComponentSettings, Part
from arview.cad.symmetry import FoundSymmetry, Symmetry, find_symmetries
from arview.cad.view_range import ViewRange
from arview.camera import Camera

Severity = Literal["problem", "warning", "note"]

GUESSED_CAMERA = Camera(width=1280, height=720, fx=1536.0, fy=1536.0, cx=639.5, cy=359.5)
"""Stands in where no camera is given: a focal length of 1.2 times the longer side of a 720p picture."""

SMALL_PX = 12.0
"""A component less than this across (its middle extent) gives the contour too few lines to be seen by."""

THIN_PX = 3.0
"""A component thinner than this shows both its edges as one line when seen edge-on."""

SHEET_FRACTION = 1e-3
"""A component whose smallest extent is below this share of its largest has no thickness worth the name."""

MOVING_SHARE = 0.02
"""A component breaks a near-symmetry when this share of its own surface has no counterpart."""

MANY_TRIANGLES = 200_000
"""Rendering guide views gets slow beyond, with nothing gained."""


@dataclass(frozen=True)
class Finding:
    """One remark: ``problem`` will fail unless something is done, ``warning`` is hard, ``note`` is good to know."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class ComponentCheck:
    """One component: its settings, its mesh, its apparent size, its own symmetries.

    ``pixels_across`` is its middle extent in px at the farthest and the nearest declared distance.
    """

    component: Component
    settings: ComponentSettings
    fitness: MeshFitness
    pixels_across: tuple[float, float]
    symmetries: tuple[FoundSymmetry, ...]


@dataclass(frozen=True)
class PartCheck:
    """The report of `arview check`.

    Attributes:
        part: that was checked.
        camera: given, or GUESSED_CAMERA.
        is_camera_guessed: none was given.
        view_range: declared, or the default.
        components: those of the model.
        symmetries: exact and near ones of the whole part.
        findings: problems first, then warnings, then notes.
    """

    part: Part
    camera: Camera
    is_camera_guessed: bool
    view_range: ViewRange
    components: tuple[ComponentCheck, ...]
    symmetries: tuple[FoundSymmetry, ...]
    findings: tuple[Finding, ...]

    @property
    def has_problems(self) -> bool:
        """True when something will fail unless it is changed."""
        return any(finding.severity == "problem" for finding in self.findings)

    def format(self) -> str:
        """The report as text of several lines, without a newline at its end."""
        model = self.part.model
        size = model.bounds_in_model[1] - model.bounds_in_model[0]
        triangles = sum(check.fitness.triangle_count for check in self.components)
        serial = f"  serial {self.part.serial}" if self.part.serial else ""
        lines = [
            f"{self.part.name}{serial}  ({self.part.cad_path})",
            f"  {_extent(size)} mm, {len(self.components)} components, {triangles:,} triangles, "
            f"hash {model.source_hash[:12]}",
            f"  view range{'' if self.part.view_range else ' (default)'}: {_range_text(self.view_range)}",
            f"  camera{' (guessed)' if self.is_camera_guessed else ''}: {self.camera.width}×{self.camera.height}, "
            f"focal length {self.camera.fx:.0f} px",
        ]
        lines += [
            f"  datum {datum.label}: {datum.feature} of {datum.component}" for datum in self.part.datums
        ]
        lines += ["", *self._table(), ""]
        lines += [f"{finding.severity}: {finding.text}" for finding in self.findings]
        if not self.findings:
            lines.append("nothing that should be hard")
        return "\n".join(lines)

    def _table(self) -> list[str]:
        head = (
            "component",
            "role",
            "size mm",
            "triangles",
            "colour",
            "tolerance",
            "px far-near",
            "own symmetry",
        )
        rows = [head]
        for check in self.components:
            component = check.component
            far, near = check.pixels_across
            rows.append(
                (
                    component.name,
                    check.settings.role,
                    _extent(np.array(check.fitness.extents_mm)),
                    f"{check.fitness.triangle_count}",
                    "#" + "".join(f"{round(255 * value):02x}" for value in component.color),
                    _tolerance_text(check.settings),
                    f"{far:.0f}-{near:.0f}",
                    "; ".join(found.symmetry.describe() for found in check.symmetries if found.is_exact)
                    or "-",
                )
            )
        ignored = [settings.name for settings in self.part.settings if settings.role == "ignore"]
        widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
        table = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return [*table, *([f"ignored: {', '.join(ignored)}"] if ignored else [])]


def check_part(part: Part, camera: Camera | None = None) -> PartCheck:
    """Describe a part and judge what will be hard, for a camera (None: GUESSED_CAMERA).

    Nothing here is an error; a part with problems can be used where they do not matter.
    """
    is_guessed = camera is None
    camera = GUESSED_CAMERA if camera is None else camera
    view_range = part.effective_view_range
    components = tuple(
        _check_component(part, component, camera, view_range) for component in part.model.components
    )
    vertices, faces, owners = part.model.mesh
    symmetries = (
        components[0].symmetries
        if len(components) == 1
        else find_symmetries(vertices, faces.astype(np.int64), owners.astype(np.int64))
    )
    findings = [
        *[Finding("note", note) for note in part.notes],
        *_view_findings(part, camera, view_range),
        *_symmetry_findings(part, symmetries),
    ]
    for check in components:
        findings += _size_findings(check, view_range)
        findings += _mesh_findings(check)
        findings += _own_symmetry_findings(check)
    findings += _tolerance_findings(part)
    order: tuple[Severity, ...] = ("problem", "warning", "note")
    return PartCheck(
        part=part,
        camera=camera,
        is_camera_guessed=is_guessed,
        view_range=view_range,
        components=components,
        symmetries=symmetries,
        findings=tuple(sorted(findings, key=lambda finding: order.index(finding.severity))),
    )


def _check_component(
    part: Part, component: Component, camera: Camera, view_range: ViewRange
) -> ComponentCheck:
    fitness = inspect_mesh(component)
    near_mm, far_mm = view_range.distance_mm
    middle_mm = fitness.extents_mm[1]
    return ComponentCheck(
        component=component,
        settings=part.component_settings(component.name),
        fitness=fitness,
        pixels_across=(camera.fx * middle_mm / far_mm, camera.fx * middle_mm / near_mm),
        symmetries=find_symmetries(component.vertices_in_model, component.faces.astype(np.int64)),
    )


def _view_findings(part: Part, camera: Camera, view_range: ViewRange) -> list[Finding]:
    findings = []
    diameter_mm = part.model.diameter_mm
    near_mm, far_mm = view_range.distance_mm
    if near_mm <= 0.5 * diameter_mm:
        findings.append(
            Finding(
                "problem",
                f"the nearest distance {near_mm:g} mm lies inside the part (half its diameter is "
                f"{0.5 * diameter_mm:.0f} mm); distance_mm is from the camera to the part's middle",
            )
        )
    elif camera.fx * diameter_mm / near_mm > 2.0 * max(camera.width, camera.height):
        share = camera.fx * diameter_mm / near_mm / max(camera.width, camera.height)
        findings.append(
            Finding(
                "warning", f"at {near_mm:g} mm the part is {share:.1f} pictures wide: little contour is seen"
            )
        )
    across_px = camera.fx * diameter_mm / far_mm
    if across_px < 60.0:
        findings.append(
            Finding("problem", f"at {far_mm:g} mm the whole part is {across_px:.0f} px across; come nearer")
        )
    triangles = len(part.model.mesh[1])
    if triangles > MANY_TRIANGLES:
        findings.append(
            Finding(
                "warning",
                f"{triangles:,} triangles make guide views slow; decimate, or load STEP with a larger tol_linear_mm",
            )
        )
    return findings


def _symmetry_findings(part: Part, symmetries: tuple[FoundSymmetry, ...]) -> list[Finding]:
    findings = []
    for declared in part.symmetries:
        if not any(found.is_exact and _covers(found.symmetry, declared) for found in symmetries):
            text = (
                f"the part file declares the symmetry {declared.describe()}, which the geometry does not have"
            )
            findings.append(Finding("warning", text))
    names = [component.name for component in part.model.components]
    for found in symmetries:
        what = found.symmetry.describe()
        if found.is_exact:
            if any(_covers(declared, found.symmetry) for declared in part.symmetries):
                findings.append(Finding("note", f"the part is symmetric as declared: {what}"))
                continue
            text = (
                f"the part looks the same when turned by {what}: its pose is ambiguous; restrict [view_range], "
                "declare it as [[symmetry]] if it does not matter, or rely on texture"
            )
            findings.append(Finding("problem", text))
            continue
        breaking = [
            name for name, share in zip(names, found.unmatched_of_group, strict=True) if share > MOVING_SHARE
        ]
        told = (
            f"only {', '.join(breaking)} tell" if len(breaking) <= 8 else f"{len(breaking)} components tell"
        )
        by = f"; {told} the two apart" if len(names) > 1 and breaking else ""
        text = f"the part is nearly the same ({100 * (1 - found.unmatched_share):.0f} % of its surface) turned by {what}{by}"
        findings.append(Finding("warning", text))
    return findings


def _size_findings(check: ComponentCheck, view_range: ViewRange) -> list[Finding]:
    near_mm, far_mm = view_range.distance_mm
    far_px, near_px = check.pixels_across
    name = check.component.name
    is_judged = check.settings.role == "inspect"
    if near_px < SMALL_PX:
        text = f"{name} is too small to see: {near_px:.1f} px across even at {near_mm:g} mm"
        return [Finding("problem" if is_judged else "warning", text)]
    if far_px < SMALL_PX:
        limit_mm = near_mm * near_px / SMALL_PX
        text = f"{name} is small: {far_px:.1f} px across at {far_mm:g} mm; well seen up to {limit_mm:.0f} mm"
        return [Finding("warning", text)]
    thin_px = far_px * check.fitness.extents_mm[2] / check.fitness.extents_mm[1]
    if thin_px < THIN_PX:
        text = f"{name} is thin: {thin_px:.1f} px at {far_mm:g} mm when seen edge-on"
        return [Finding("note", text)]
    return []


def _mesh_findings(check: ComponentCheck) -> list[Finding]:
    fitness, name = check.fitness, check.component.name
    findings = []
    if fitness.thickness_mm < SHEET_FRACTION * fitness.extents_mm[0]:
        text = f"{name} is a sheet without thickness ({fitness.thickness_mm:.3g} mm): give it its thickness in the CAD"
        findings.append(Finding("warning", text))
    elif fitness.open_edge_count:
        text = f"{name} is not closed: {fitness.open_edge_count} open edges; they will show as contours"
        findings.append(Finding("warning", text))
    if fitness.non_manifold_edge_count:
        text = f"{name} has {fitness.non_manifold_edge_count} edges shared by more than two triangles (non-manifold)"
        findings.append(Finding("warning", text))
    if not fitness.is_consistent:
        findings.append(Finding("warning", f"{name} has triangles that face the wrong way"))
    return findings


def _own_symmetry_findings(check: ComponentCheck) -> list[Finding]:
    """A judged component that can be turned about itself unseen, where the part file does not say so."""
    if check.settings.role != "inspect":
        return []
    declared = check.settings.symmetry
    exact = [found.symmetry for found in check.symmetries if found.is_exact]
    name = check.component.name
    if declared is not None and not any(_covers(symmetry, declared) for symmetry in exact):
        text = f"{name}: the declared symmetry {declared.describe()} is not in its geometry"
        return [Finding("warning", text)]
    spins = [symmetry for symmetry in exact if symmetry.order is None]
    if declared is None and spins:
        axis = spins[0].describe().removeprefix("any angle about ")
        return [
            Finding("note", f"{name} is a body of revolution: its rotation about {axis} cannot be measured")
        ]
    return []


def _tolerance_findings(part: Part) -> list[Finding]:
    open_ended = [
        name for name in part.inspected if part.component_settings(name).position_tolerance_mm is None
    ]
    if not open_ended:
        return []
    names = ", ".join(open_ended[:6]) + (f" and {len(open_ended) - 6} more" if len(open_ended) > 6 else "")
    return [Finding("note", f"no position_tolerance_mm, so measured but not judged: {names}")]


def _covers(wide: Symmetry, narrow: Symmetry) -> bool:
    """True when every turn of ``narrow`` is one of ``wide`` (about the same direction)."""
    if not wide.is_same_axis(narrow):
        return False
    return wide.order is None or (narrow.order is not None and wide.order % narrow.order == 0)


def _extent(size_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return " × ".join(f"{value:.4g}" for value in size_mm)


def _tolerance_text(settings: ComponentSettings) -> str:
    parts = []
    if settings.position_tolerance_mm is not None:
        parts.append(f"{settings.position_tolerance_mm:g} mm")
    if settings.angle_tolerance_deg is not None:
        parts.append(f"{settings.angle_tolerance_deg:g}°")
    return " ".join(parts) or "-"


def _range_text(view_range: ViewRange) -> str:
    low, high = view_range.distance_mm
    text = f"{low:.0f} to {high:.0f} mm"
    text += (
        ", every direction"
        if view_range.is_full_sphere
        else (
            f", elevation {view_range.elevation_deg[0]:g} to {view_range.elevation_deg[1]:g}°"
            f", azimuth {view_range.azimuth_deg[0]:g} to {view_range.azimuth_deg[1]:g}°"
        )
    )
    rolls = view_range.roll_deg
    return text + (", any roll" if rolls[1] - rolls[0] >= 360 else f", roll {rolls[0]:g} to {rolls[1]:g}°")
