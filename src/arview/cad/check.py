"""Check of a part: its content, and what will make it hard to detect, track and inspect."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import NoneType

import numpy as np

from arview.cad.assembly_tree import tree_lines
from arview.cad.component_remarks import Remark, Severity, gathered, listed, mesh_remarks, size_remarks
from arview.cad.datum_check import datum_problems
from arview.cad.fitness import MeshFitness, inspect_mesh
from arview.cad.model import Component
from arview.cad.part import ComponentSettings, Part
from arview.cad.shape.equal_shapes import ShapeSymmetries
from arview.cad.shape.hidden_components import hidden_components
from arview.cad.shape.symmetry import FoundSymmetry, Symmetry, find_symmetries
from arview.cad.tolerance_check import tolerance_remarks, untold_tolerances
from arview.cad.view_range import ViewRange
from arview.camera import Camera
from arview.core.checks import check_type
from arview.geometry import Array, exp_so3

GUESSED_CAMERA = Camera(width=1280, height=720, fx=1536.0, fy=1536.0, cx=639.5, cy=359.5)
"""Camera when none is given: a focal length of 1.2 times the longer side of a 720p picture."""

USUAL_DIAMETERS = 6.0
"""Distance, in diameters of the part, up to which its components are checked where no range is declared."""

MOVING_SHARE = 0.02
"""Unmatched share of a component's surface above which it breaks a near-symmetry."""

MANY_TRIANGLES = 200_000
"""Number of triangles above which guide views are rendered slowly, without any gain."""


MIN_TRACKED_MM = 3.0
"""Distance from the camera below which detection and tracking were not made to work: steps there are absolute."""

GATHERED_ROWS = 40
"""Number of components from which equal rows of the table become one."""


@dataclass(frozen=True)
class PartFinding:
    """A remark on a part: a ``problem`` causes failure, a ``warning`` makes it hard to use, a ``note`` informs."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class ComponentCheck:
    """The check of one component.

    Attributes:
        component: that was checked.
        settings: of the part file.
        fitness: properties of its mesh.
        pixels_across: its middle extent, px, at the farthest and the nearest declared distance.
        symmetries: of the component alone.
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
        camera: the given one, or GUESSED_CAMERA.
        is_camera_guessed: True when none was given.
        view_range: declared or default range.
        components: of the model.
        symmetries: exact and near ones of the whole part.
        findings: problems first, then warnings, then notes.
    """

    part: Part
    camera: Camera
    is_camera_guessed: bool
    view_range: ViewRange
    components: tuple[ComponentCheck, ...]
    symmetries: tuple[FoundSymmetry, ...]
    findings: tuple[PartFinding, ...]

    def with_findings(self, findings: list[PartFinding]) -> PartCheck:
        """The report with further findings, such as those of guide views, sorted in."""
        return replace(self, findings=_sorted([*self.findings, *findings]))

    def format(self) -> str:
        """The report as text of several lines, without a newline at its end."""
        model = self.part.model
        size = model.bounds_in_model[1] - model.bounds_in_model[0]
        triangles = sum(check.fitness.triangle_count for check in self.components)
        serial = f"  serial {self.part.serial}" if self.part.serial else ""
        lines = [
            f"{self.part.name}{serial}  ({self.part.cad_path})",
            f"  {_extent(size)} mm, {len(self.components)} components, {triangles:,} triangles",
            f"  model_hash {model.source_hash}",
            f"  view range{'' if self.part.view_range else ' (default)'}: {_range_text(self.view_range)}",
            *([] if self.part.up == "z" else [f"  up: {self.part.up}"]),
            f"  camera{' (guessed)' if self.is_camera_guessed else ''}: "
            f"{self.camera.width}×{self.camera.height}, focal length {self.camera.fx:.0f} px",
        ]
        lines += [f"  datum {datum.label}: {datum.feature} of {datum.component}" for datum in self.part.datums]
        lines += [f"  feature {one.label}: {one.feature} of {one.component}" for one in self.part.features]
        lines += [f"  characteristic {one.name}: {one.kind}" for one in self.part.characteristics]
        tree = tree_lines(self.part.paths)
        lines += ["", *tree] if tree else []
        if tree:
            lines.append('  settings for all of an assembly: [components."NAME/*"] in the part file')
        lines += ["", *self._table(), ""]
        lines += [f"{finding.severity}: {finding.text}" for finding in self.findings]
        if not self.findings:
            lines.append("no difficulties expected")
        return "\n".join(lines)

    def _table(self) -> list[str]:
        head = (
            "component",
            "role",
            "size mm",
            "faces",
            "colour",
            "tolerance",
            "px far-near",
            "own symmetry",
        )
        rows: list[tuple[str, ...]] = [head]
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
                    listed([found.symmetry.describe() for found in check.symmetries], 2, "; ") or "-",
                )
            )
        rows = [head, *_gathered_rows(rows[1:])] if len(rows) > GATHERED_ROWS else rows
        ignored = [settings.name for settings in self.part.settings if settings.role == "ignore"]
        widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
        table = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        return [*table, *([f"ignored: {', '.join(ignored)}"] if ignored else [])]


def _gathered_rows(rows: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Rows of the table, those that differ in the numbers of their names only as one."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        groups.setdefault((re.sub(r"\d+", "#", row[0]), *row[1:]), []).append(row[0])
    return [
        (names[0] if len(names) == 1 else f"{names[0]} … {names[-1]} ({len(names)})", *key[1:])
        for key, names in groups.items()
    ]


def check_part(part: Part, camera: Camera | None = None) -> PartCheck:
    """Check a part: its components, symmetries, sizes in the picture and meshes.

    Args:
        part: to be checked; one with problems can still be used.
        camera: None for GUESSED_CAMERA.
    """
    check_type(part, Part, "check_part: part")
    check_type(camera, (Camera, NoneType), "check_part: camera")
    is_guessed = camera is None
    camera = GUESSED_CAMERA if camera is None else camera
    view_range = part.effective_view_range.for_camera(camera, part.model.diameter_mm)
    sized_range = view_range
    if part.view_range is None:
        # Nobody means to inspect a part as far away as it can be found.
        sized_range = ViewRange((view_range.distance_mm[0], USUAL_DIAMETERS * part.model.diameter_mm))
    shapes = ShapeSymmetries()
    components = tuple(
        _check_component(part, component, camera, sized_range, shapes) for component in part.model.components
    )
    vertices, faces, owners = part.model.mesh
    symmetries = find_symmetries(vertices, faces.astype(np.int64), owners.astype(np.int64))
    findings = [
        *[PartFinding("note", note) for note in part.notes],
        *_view_findings(part, camera, view_range),
        *_symmetry_findings(part, view_range, symmetries),
    ]
    findings += _role_findings(part)
    findings += [PartFinding("warning", text) for text in datum_problems(part)]
    mm_per_px = sized_range.distance_mm[0] / camera.fx
    remarks = [remark for check in components for remark in _remarks(check, sized_range, mm_per_px)]
    findings += [PartFinding(severity, text) for severity, text in gathered(remarks)]
    findings += _own_symmetry_findings(components, shapes.skipped)
    if shapes.skipped:
        text = f"own symmetries were not searched, to save time, of {len(shapes.skipped)} components: "
        findings.append(PartFinding("note", text + listed(shapes.skipped, 4)))
    findings += [PartFinding("note", text) for text in untold_tolerances(part)]
    findings += [*_number_findings(part), *_hidden_findings(part)]
    return PartCheck(
        part=part,
        camera=camera,
        is_camera_guessed=is_guessed,
        view_range=view_range,
        components=components,
        symmetries=symmetries,
        findings=_sorted(findings),
    )


def _sorted(findings: list[PartFinding]) -> tuple[PartFinding, ...]:
    order: tuple[Severity, ...] = ("problem", "warning", "note")
    return tuple(sorted(findings, key=lambda finding: order.index(finding.severity)))


def _check_component(
    part: Part, component: Component, camera: Camera, view_range: ViewRange, shapes: ShapeSymmetries
) -> ComponentCheck:
    fitness = inspect_mesh(component)
    near_mm, far_mm = view_range.distance_mm
    middle_mm = fitness.extents_mm[1]
    return ComponentCheck(
        component=component,
        settings=part.component_settings(component.name),
        fitness=fitness,
        pixels_across=(camera.fx * middle_mm / far_mm, camera.fx * middle_mm / near_mm),
        symmetries=shapes.of(component),
    )


def _view_findings(part: Part, camera: Camera, view_range: ViewRange) -> list[PartFinding]:
    findings, diameter_mm = [], part.model.diameter_mm
    near_mm, far_mm = view_range.distance_mm
    if near_mm <= 0.5 * diameter_mm:
        findings.append(
            PartFinding(
                "problem",
                f"the nearest distance {near_mm:.0f} mm lies inside the part (half its diameter is "
                f"{0.5 * diameter_mm:.0f} mm); distance_mm is from the camera to the part's middle"
                + (", in mm: is it given in metres?" if far_mm < 0.5 * diameter_mm else ""),
            )
        )
    elif camera.fx * diameter_mm / near_mm > 2.0 * max(camera.width, camera.height):
        share = camera.fx * diameter_mm / near_mm / max(camera.width, camera.height)
        findings.append(
            PartFinding(
                "warning",
                f"at {near_mm:.0f} mm the part is {share:.1f} pictures wide: little of its contour is visible",
            )
        )
    if near_mm < MIN_TRACKED_MM:
        findings.append(
            PartFinding(
                "problem",
                f"the nearest distance is {near_mm:.2g} mm: detection and tracking need {MIN_TRACKED_MM:g} mm and more",
            )
        )
    across_px = camera.fx * diameter_mm / far_mm
    if part.view_range and across_px < 60.0:  # the default range ends there
        findings.append(
            PartFinding("problem", f"at {far_mm:.0f} mm the whole part is {across_px:.0f} px across; come nearer")
        )
    triangles = len(part.model.mesh[1])
    if triangles > MANY_TRIANGLES:
        findings.append(
            PartFinding(
                "warning",
                f"{triangles:,} triangles make guide views slow; decimate, or for STEP raise tol_linear_mm",
            )
        )
    return findings


def _symmetry_findings(part: Part, view_range: ViewRange, symmetries: tuple[FoundSymmetry, ...]) -> list[PartFinding]:
    """Exact and near symmetries of the whole part, weighed by the declared view range."""
    findings = []
    for declared in part.symmetries:
        if not any(found.is_exact and _covers(found.symmetry, declared) for found in symmetries):
            findings.append(
                PartFinding(
                    "warning", f"the declared symmetry of the part, {declared.describe()}, is not in its geometry"
                )
            )
    ambiguous, excluded = [], []
    near: dict[str, list[str]] = {}
    declared_ones = []
    for found in symmetries:
        what = found.symmetry.describe()
        if not can_confuse(found.symmetry, view_range):
            excluded.append(what)
        elif any(_covers(declared, found.symmetry) for declared in part.symmetries):
            declared_ones.append(what)
        elif found.is_exact:
            ambiguous.append(what)
        else:
            same = 100.0 * (1.0 - found.unmatched_share)
            near.setdefault(_breaking_text(part, found), []).append(f"{what} ({same:.0f} % of its surface)")
    for told, rotations in near.items():
        findings.append(
            PartFinding("warning", f"the part is nearly the same when rotated by {listed(rotations, 4)}{told}")
        )
    if declared_ones:
        findings.append(PartFinding("note", f"the part is symmetric as declared: {listed(declared_ones, 4)}"))
    if ambiguous:
        findings.append(
            PartFinding(
                "problem",
                f"the part looks the same when rotated by {listed(ambiguous, 4)}: its pose is ambiguous; "
                "restrict [view_range], declare it as [[symmetry]] if it does not matter, or rely on its texture",
            )
        )
    if excluded:
        findings.append(
            PartFinding("note", f"symmetries and near-symmetries that the view range excludes: {listed(excluded, 4)}")
        )
    return findings


def _breaking_text(part: Part, found: FoundSymmetry) -> str:
    """The components that distinguish the places of a near-symmetry."""
    names = [component.name for component in part.model.components]
    shares = zip(names, found.unmatched_of_group, strict=True)
    breaking = [name for name, share in shares if share > MOVING_SHARE]
    return f"; distinguished by {listed(breaking, 6)}" if len(names) > 1 and breaking else ""


def can_confuse(symmetry: Symmetry, view_range: ViewRange) -> bool:
    """Whether two viewpoints of the range look the same because of a symmetry.

    The view from direction d with image-up u equals that from S d with image-up S u, for every rotation S of the
    symmetry; both must be in the range, roll included.
    """
    if symmetry.order is None:
        return True
    count = 2000
    z = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    # Half the spacing of the directions as margin, so that a narrow range is not missed.
    directions = directions[view_range.contains_direction(directions, margin_deg=2.5)]
    up, width_deg = view_range.up_in_model, view_range.roll_deg[1] - view_range.roll_deg[0]
    for turn in range(1, symmetry.order):
        rotation = exp_so3(np.array(symmetry.axis_in_model) * (2.0 * np.pi * turn / symmetry.order))
        turned = directions @ rotation.T
        roll_deg = _angle_about_deg(turned, _image_up(turned, up), _image_up(directions, up) @ rotation.T)
        same_roll = np.abs(roll_deg) <= width_deg
        if np.any(view_range.contains_direction(turned, margin_deg=2.5) & same_roll):
            return True
    return False


def _image_up(directions: Array, up_in_model: Array) -> Array:
    """(N,3) unit vectors perpendicular to directions (N,3), closest to the up axis: up in a picture of roll 0."""
    up = up_in_model - directions * (directions @ up_in_model)[:, None]
    return up / np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-12)


def _angle_about_deg(axes: Array, start: Array, end: Array) -> Array:
    """(N,) signed angles, deg, about unit axes (N,3) from start to end (N,3), both perpendicular to the axis."""
    sine = np.einsum("ij,ij->i", axes, np.cross(start, end))
    return np.asarray(np.rad2deg(np.arctan2(sine, np.einsum("ij,ij->i", start, end))))


def _own_symmetry_findings(checks: tuple[ComponentCheck, ...], skipped: Sequence[str]) -> list[PartFinding]:
    """Inspected bodies of revolution without a declared symmetry, and declared symmetries missing in the geometry."""
    findings, spinning = [], []
    for check in checks:
        declared = check.settings.symmetry
        exact = [found.symmetry for found in check.symmetries]
        is_searched = check.component.name not in skipped
        if declared is not None and is_searched and not any(_covers(symmetry, declared) for symmetry in exact):
            name, what = check.component.name, declared.describe()
            findings.append(PartFinding("warning", f"{name}: the declared symmetry, {what}, is not in its geometry"))
        spins = [symmetry for symmetry in exact if symmetry.order is None]
        if check.settings.role == "inspect" and declared is None and spins:
            spinning.append(f"{check.component.name} ({spins[0].describe().removeprefix('any angle about ')})")
    if spinning:
        findings.append(
            PartFinding(
                "note",
                f"bodies of revolution, whose rotation about their axis cannot be measured: {listed(spinning, 8)}",
            )
        )
    return findings


def _remarks(check: ComponentCheck, view_range: ViewRange, mm_per_px: float) -> list[Remark]:
    name, is_inspected = check.component.name, check.settings.role == "inspect"
    sizes = size_remarks(name, check.pixels_across, check.fitness.extents_mm, view_range.distance_mm, is_inspected)
    tolerances = tolerance_remarks(check.settings, check.fitness.extents_mm, mm_per_px)
    return [*sizes, *mesh_remarks(name, check.fitness), *tolerances]


def _role_findings(part: Part) -> list[PartFinding]:
    """No base or several, datums on components that are inspected, and nothing to inspect."""
    components = part.model.components
    bases = [c.name for c in components if part.component_settings(c.name).role == "base"]
    findings = []
    if not bases and len(components) > 1:
        sizes = [float(np.linalg.norm(np.diff(c.bounds_in_model, axis=0))) for c in components]
        largest = components[int(np.argmax(sizes))].name
        text = f"no component has the role base: deviations are stated in the frame of the largest, {largest}"
        is_bare = part.path == part.cad_path
        hint = "a part file says which is the base" if is_bare else 'give the base role = "base" in the part file'
        findings.append(PartFinding("note" if is_bare else "warning", f"{text}; {hint}"))
    if len(bases) > 1:
        text = f"{len(bases)} components have the role base: {listed(bases, 6)}; deviations are stated in the frame "
        findings.append(PartFinding("warning", text + "of all of them together, and none of them is judged"))
    for datum in part.datums:
        if bases and datum.component not in bases:
            findings.append(
                PartFinding(
                    "warning",
                    f"datum {datum.label} is on {datum.component}, which is not the base: its deviation moves the "
                    "frame",
                )
            )
    if not part.inspected:
        findings.append(PartFinding("warning", "no component has the role inspect: nothing is measured"))
    return findings


def _number_findings(part: Part) -> list[PartFinding]:
    """Components that the CAD gives one name, and the part file settings of their own by their numbers."""
    groups: dict[str, list[ComponentSettings]] = {}
    for settings, path in zip(part.settings, part.paths, strict=False):
        if path and re.fullmatch(re.escape(path[-1]) + r"(_\d+)?", settings.name):
            groups.setdefault(path[-1], []).append(settings)
    told = [s.name for group in groups.values() if len({replace(s, name="") for s in group}) > 1 for s in group]
    text = (
        "the CAD gives these one name, so that they are numbered by their places (along x, then y, then z), and their "
    )
    text += "settings go to others when one is added, removed or moved past another; give them names of their own there"
    return [PartFinding("warning", f"{text}: {listed(told, 6)}")] if told else []


def _hidden_findings(part: Part) -> list[PartFinding]:
    """Components that are there twice, or inside others, whose presence no picture shows."""
    twice, inside, unsearched = hidden_components(part.model.components)
    hint = 'so that no view shows them; leave out of the CAD, or give the role "ignore"'
    told: tuple[tuple[list[str], Severity, str], ...] = (
        (twice, "warning", f"there twice, at the place of an equal one, {hint}"),
        (inside, "warning", f"wholly inside another, {hint}"),
        (unsearched, "note", "to save time, it was not searched whether these are inside others"),
    )
    return [PartFinding(severity, f"{text}: {listed(names, 6)}") for names, severity, text in told if names]


def _covers(wide: Symmetry, narrow: Symmetry) -> bool:
    """True when every rotation of ``narrow`` is one of ``wide``, about the same direction."""
    if not wide.is_same_axis(narrow):
        return False
    return wide.order is None or (narrow.order is not None and wide.order % narrow.order == 0)


def _extent(size_mm: Array) -> str:
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
