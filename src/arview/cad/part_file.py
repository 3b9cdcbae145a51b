"""Part files: TOML that names a CAD file and the settings of its components, read into a `Part`."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, cast

from arview.cad.characteristics_table import read_characteristics
from arview.cad.formats.raw import UNIT_MM
from arview.cad.load import SUFFIXES, LoadedCad, check_step_tolerances, load_cad
from arview.cad.model import Model, make_model
from arview.cad.part import (
    DOF_NAMES,
    ComponentSettings,
    Datum,
    DatumFeature,
    Guide,
    NamedPoint,
    Part,
    ReworkKind,
    Role,
    Vector,
    unknown_component,
)
from arview.cad.rework_table import read_rework, read_rework_kinds
from arview.cad.shape.symmetry import Symmetry
from arview.cad.steps_table import read_steps
from arview.cad.toml_table import TomlTable, vectors
from arview.cad.view_range import UP_AXES, Up, ViewRange
from arview.core.checks import PATH, check_type
from arview.errors import InputError

ROLES = ("base", "inspect", "ignore")
POINTS = ("mass", "seat", "axis", "hole")
TABLES = (
    "part", "view_range", "guides", "defaults", "components", "symmetry", "datums", "features", "characteristics",
    "rework", "steps",
)  # fmt: skip
DATUM_FEATURES = ("plane", "hole", "pin", "slot", "cylinder", "edge", "point", "fit")

PART_FILE_EXAMPLE = """\
# A part file. Lengths in mm, angles in degrees, positions in the frame of the CAD file.
# Only [part] with its cad is required; everything else has a default.

[part]
name = "bracket plate"         # default: the name of this file, or of its folder for part.toml
cad = "bracket_plate.step"     # relative to this file
# unit = "mm"                  # mm, cm, m, inch: needed for OBJ, STL and PLY; overrides the unit of others
# up = "z"                     # axis of the CAD file that is up: x, y, z, -x, -y, -z; default: y for glTF (not that of
                               # trimesh, which writes the axes as they are), z for all others
tol_linear_mm = 0.1            # STEP: largest distance of the triangles from the true surface
tol_angular_deg = 10.0         # STEP: largest angle between neighbouring triangles of a curved surface
drawing = "4711-02 rev. C"     # number and revision of the drawing, for the report
serial = "BP-0042"             # of the specimen at hand, shown in the overlay
# DataMatrix and QR codes on the part whose text matches this regular expression are serial numbers; all others are
# ignored. Default: texts of the form of the serial number, here BP- and four digits. An AprilTag's text is its family
# and number, as in tag36h11-42.
# serial_pattern = "BP-[0-9]{4}"

# From where the camera may look at the middle of the part's bounding box. Azimuth runs from +X to +Y,
# elevation from the XY plane to +Z, roll 0 has +Z up in the picture. All but distance_mm may be left out. With up = "y"
# azimuth runs from +X to -Z, elevation to +Y, which is up at roll 0: the frame in which the up axis is called +Z.
# Without this table: every direction and roll, from where the part fills the picture to where it spans 60 px.
[view_range]
distance_mm = [400.0, 900.0]
elevation_deg = [20.0, 85.0]
azimuth_deg = [-180.0, 180.0]
roll_deg = [-30.0, 30.0]

# Views of your own for --init guide:NAME, next to front, back, left, right, top, bottom, iso and middle.
[guides.start]
azimuth_deg = -60.0
elevation_deg = 40.0
roll_deg = 0.0                 # default: 0, or the middle of the declared rolls
distance_mm = 650.0            # default: the part spans 60 % of the picture's smaller side

# For components that do not say otherwise.
[defaults]
role = "inspect"
position_tolerance_mm = 1.0

# One table for each component that needs one. Names as `arview check` prints them; quote odd ones:
# [components."sub_1/post"]
# A table may hold for several: [components."post_*"], or [components."sub_1/*"] for all of an assembly; a table of the
# component's own name comes after those.
[components.base_plate]
role = "base"                  # base: carries the datums and is not judged; inspect: is measured and judged;
                               # ignore: is left out of the model (a fixture that the camera never sees)
color = "#8a8f98"              # sRGB, default: the colour in the CAD

[components.post_1]
role = "inspect"
position_tolerance_mm = 0.5    # largest allowed distance from the nominal place (half of GD&T's zone)
angle_tolerance_deg = 0.5      # largest allowed rotation from nominal
# The point whose distance from its nominal place is measured: "mass" (default: centre of the volume of a solid, of the
# area of a sheet body), "seat" (middle of the surface on which it stands), "axis" (foot of its axis), "hole" (centre of
# its only hole), or coordinates.
# point = "seat"               # or [60.0, 40.0, 0.0]
# A rotation that changes nothing about the component: it cannot be measured and is not judged.
symmetry = { axis = [0.0, 0.0, 1.0], through_mm = [60.0, 40.0, 0.0], order = "continuous" }

# How it is put right when it is out of tolerance; `arview rework` and the report tell which way and how far. All may be
# left out, and stand in [defaults.rework] for all components.
[components.post_1.rework]
how = "unbolt"                 # adjust (default), unbolt, reweld, reglue, shim, bend, replace, or one of [rework.KIND]
text = "2 × M6 from below, 9 N m"
# pictures = ["post_bolts.jpg"]   # relative to this file
# Directions that the fitter has, before those that are found (neighbours, datum features, up and down):
axes = [{ toward = "hole_B" }, { away_from = "post_2" }, { direction = [0.0, 1.0, 0.0], name = "towards the hinge" }]

# Text, pictures and steps of all components of a kind; a kind of your own needs steps. {move} stands for the moves,
# {component} for the name.
[rework.reweld]
text = "MAG, seam 3 mm"
# steps = ["Grind the seam of {component} open.", "{move}", "Tack, measure, weld."]

# Rotations that change nothing about the whole part: order 2 is half a turn, 6 a hexagon's; or "continuous".
# through_mm may be left out here: the middle of the bounding box.
# [[symmetry]]
# axis = [0.0, 0.0, 1.0]
# order = 2

# The features of the base that define the frame in which deviations are stated, in order of precedence: each
# locks what it determines and those before it have left free (ISO 5459). What all leave free, here the
# rotation about B, the best fit of the base decides; so it does without any datums.
[datums.A]
feature = "plane"              # plane, hole, pin (their rim), slot (its rim, two half circles and two lines), cylinder
                               # (the axis of a round face), edge (straight, of two flat faces), point (where its
                               # normal meets the surface), or fit (of a component)
component = "base_plate"
point_mm = [0.0, 0.0, 0.0]
normal = [0.0, 0.0, 1.0]
# targets_mm = [[-90.0, 60.0, 0.0], [90.0, 60.0, 0.0], [0.0, -60.0, 0.0]]   # datum targets: only around these points

[datums.B]
feature = "hole"               # or "pin"
component = "base_plate"
point_mm = [-97.0, -67.0, 0.0] # on the axis, at the end that the camera sees
axis = [0.0, 0.0, 1.0]
diameter_mm = 12.0             # of a slot: width_mm
locks = ["tx", "ty"]           # default: all that it determines; of rx ry rz tx ty tz, axes of the model

# Features that the drawing limits, each named as it is called in the reports and described as a datum is; or a
# "surface": all that is joined with point_mm without a sharp edge, for its profile.
[features.bore_1]
feature = "hole"
component = "base_plate"
point_mm = [97.0, 67.0, 0.0]
axis = [0.0, 0.0, 1.0]
diameter_mm = 12.0

# What the drawing requires of features and components (ISO 1101), beside the tolerances above; `arview check --pmi`
# proposes it from STEP AP242. position, profile, flatness, perpendicularity, parallelism, angularity have a
# tolerance_mm; size, distance, gap and flush min_mm, max_mm or both.
[[characteristics]]
name = "place of bore 1"
kind = "position"
of = "bore_1"                  # a feature or component; a list of them is a pattern, which must comply at once
tolerance_mm = 0.4             # diameter or width of the zone
# zone = "diameter"            # default for round features; "sphere" for components and points, "width" for others
# direction = [1.0, 0.0, 0.0]  # across a zone of some width; default: the feature's normal
datums = ["A", "B"]            # default: all; ["A", "B(M)"] lets it shift by what B is off maximum material
at_maximum_material = true     # the zone grows by what the bore is wider than its smallest size, see its size; or
                               # at_least_material
# offset_mm = 0.1              # of a profile or a position between planes: the zone's middle off nominal (UZ)

[[characteristics]]
name = "width of bore 1"
kind = "size"                  # diameter
of = "bore_1"
min_mm = 11.9
max_mm = 12.1

[[characteristics]]
name = "pitch"
kind = "distance"              # of two features; gap: along the first one's normal; flush: step between two faces
of = ["bore_1", "post_1"]
min_mm = 35.0
# source = "drawing 4711, balloon 12"

# The order of work: what each step mounts, one table for each. Components that no step mounts are there from the start.
# `arview annotate` and the live page ghost the next component and name a wrong or missing one, see
# docs/concepts/presence.md.
# [[steps]]
# mount = ["post_1"]           # components that are mounted together
# name = "first post"          # default: the components
# [[steps]]
# mount = ["post_2", "nut_2"]
# after = ["first post"]       # steps that must be done before; default: the one above; []: none
"""
"""A complete part file with comments; what `arview check --help` shows."""


def find_part_file(path: str | Path) -> Path:
    """The part file or CAD file at a path; for a folder its part.toml.

    Raises:
        InputError: there is no such file.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "part.toml"
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a part file (.toml) or a CAD file ({' '.join(SUFFIXES)})")
    return path


def load_part(path: str | Path, unit: str | None = None) -> Part:
    """The part of a part file (TOML, see PART_FILE_EXAMPLE), of a folder with a part.toml, or of a bare CAD file.

    Args:
        path: of the file or folder.
        unit: mm, cm, m or inch; overrides the unit in the part file and in the CAD file.

    Raises:
        InputError: a missing or broken file, an unknown key, a wrong type or value, or a component that the CAD
            does not have; and all errors of `load_cad`.
    """
    check_type(path, PATH, "load_part: path")
    path = find_part_file(path)
    if path.suffix.lower() != ".toml":
        cad = load_cad(path, unit)
        settings = tuple(ComponentSettings(component.name) for component in cad.model.components)
        return Part(cad.model.name, path, path, cad.model, settings, up=cad.up, notes=cad.notes, paths=cad.paths)
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    return part_from_text(text, path, unit)


def part_from_text(
    text: str, path: str | Path, unit: str | None = None, load: Callable[..., LoadedCad] = load_cad
) -> Part:
    """The part that the text of a part file describes.

    Args:
        text: TOML, see PART_FILE_EXAMPLE.
        path: where the file is, or will be; the CAD file is relative to it.
        unit: as in `load_part`.
        load: reads the CAD file; who edits a text again and again keeps what it has read.

    Raises:
        InputError: as `load_part`.
    """
    path = Path(path)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    return _read_part(TomlTable(path, "", content), path, unit, load)


def _read_part(root: TomlTable, path: Path, unit: str | None, load: Callable[..., LoadedCad]) -> Part:
    for key in TABLES:
        root.known(key)
    root.finish()
    head = root.table("part", required=True)
    default_name = path.resolve().parent.name if path.stem == "part" else path.stem
    name, cad_path = head.line("name", default_name), path.parent / head.text("cad")
    own_unit = head.choice("unit", tuple(UNIT_MM), None)
    own_up = head.choice("up", UP_AXES, None)
    tol_linear_mm = head.positive("tol_linear_mm", 0.1)
    tol_angular_deg = head.positive("tol_angular_deg", 10.0)
    try:
        check_step_tolerances(cast(float, tol_linear_mm), cast(float, tol_angular_deg))
    except InputError as error:
        raise InputError(f"{path}: [part] {error}") from error
    serial = head.line("serial", "") or None
    drawing = head.line("drawing", "")
    serial_pattern = _read_pattern(head)
    head.finish()
    if not cad_path.is_file():
        raise InputError(f"{path}: [part] cad = {str(head.content['cad'])!r}: there is no file {cad_path}")
    view_range = _read_view_range(root.table("view_range")) if "view_range" in root.content else None
    guides = _read_guides(root.table("guides"))
    cad = load(cad_path, unit or own_unit, cast(float, tol_linear_mm), cast(float, tol_angular_deg))
    up = cast(Up, own_up or cad.up)
    view_range = replace(view_range, up=up) if view_range else None
    names = [component.name for component in cad.model.components]
    datums = _read_datums(root.table("datums"), cad.model)
    features = _read_datums(root.table("features"), cad.model, taken=[*names, *(datum.label for datum in datums)])
    characteristics = read_characteristics(root.tables("characteristics"), names, datums, features)
    rework = _ReworkTables(read_rework_kinds(root.table("rework")), [*names, *(d.feature_name for d in datums)])
    defaults = _read_settings(root.table("defaults"), "", cad.model, ComponentSettings(""), rework)
    tables = root.table("components")
    selectors = _selectors(tables, names, cad.paths)
    settings, components = [], []
    for component in cad.model.components:
        setting, color = replace(defaults, name=component.name), None
        for key in selectors[component.name]:
            table = tables.table(key)
            color = table.color("color") or color
            setting = _read_settings(table, component.name, cad.model, setting, rework)
        settings.append(setting)
        if setting.role != "ignore":
            components.append(replace(component, color=color) if color else component)
    tables.finish()
    if not components:
        raise InputError(f"{path}: every component has the role 'ignore'; nothing is left to track")
    model = make_model(cad.model.name, tuple(components))
    model = replace(model, steps=read_steps(root.tables("steps"), [component.name for component in components]))
    symmetries = tuple(
        _read_symmetry(table, tuple(model.center_in_model.tolist())) for table in root.tables("symmetry")
    )
    return Part(
        name=name,
        path=path,
        cad_path=cad_path,
        model=model,
        settings=tuple(settings),
        view_range=view_range,
        symmetries=symmetries,
        datums=datums,
        drawing=drawing,
        features=features,
        characteristics=characteristics,
        guides=guides,
        serial=serial,
        serial_pattern=serial_pattern,
        up=up,
        notes=cad.notes,
        paths=cad.paths,
    )


def _selectors(tables: TomlTable, names: list[str], paths: tuple[tuple[str, ...], ...]) -> dict[str, list[str]]:
    """Keys of the tables that hold for each component: those with wildcards in the order of the file, then its own.

    A selector with ``*`` or ``?`` is compared with the name and with the names of the assemblies above it, so that
    ``sub/*`` holds for all that is in ``sub``.

    Raises:
        InputError: a key that is no component and matches none.
    """
    selectors: dict[str, list[str]] = {name: [] for name in names}
    for key in [key for key in tables.content if key not in names]:
        ways = [
            (name, [name, *("/".join(path[k:]) for k in range(len(path)))])
            for name, path in zip(names, paths, strict=True)
        ]
        chosen = [name for name, ends in ways if any(fnmatchcase(end, key) for end in ends)]
        if not chosen or not set(key) & set("*?["):
            raise InputError(f"{tables.path}: [components] {unknown_component(key, names)}")
        for name in chosen:
            selectors[name].append(key)
    for name in names:
        if name in tables.content:
            selectors[name].append(name)
    return selectors


def _read_pattern(table: TomlTable) -> str:
    pattern = table.text("serial_pattern", "")
    try:
        re.compile(pattern)
    except re.error as error:
        table.fail("serial_pattern", pattern, f"a regular expression: {error}")
    return pattern


def _read_view_range(table: TomlTable) -> ViewRange:
    intervals: dict[str, Any] = {"distance_mm": table.interval("distance_mm")}
    for key in ("elevation_deg", "azimuth_deg", "roll_deg"):
        if table.known(key):
            intervals[key] = table.interval(key)
    table.finish()
    try:
        return ViewRange(**intervals)
    except InputError as error:
        raise InputError(f"{table.path}: [view_range] {error}") from error


def _read_guides(tables: TomlTable) -> tuple[Guide, ...]:
    guides = []
    for name in tables.content:
        table = tables.table(name)
        guides.append(
            Guide(
                name,
                azimuth_deg=table.angle("azimuth_deg"),
                elevation_deg=table.angle("elevation_deg", 90.0),
                roll_deg=table.angle("roll_deg") if table.known("roll_deg") else None,
                distance_mm=table.positive("distance_mm"),
            )
        )
        table.finish()
    tables.finish()
    return tuple(guides)


@dataclass(frozen=True)
class _ReworkTables:
    """Kinds of rework of a part file, and names by which directions can be given."""

    kinds: dict[str, ReworkKind]
    targets: list[str]


def _read_settings(
    table: TomlTable, name: str, model: Model, defaults: ComponentSettings, rework: _ReworkTables
) -> ComponentSettings:
    """Settings of one component, or of [defaults] when ``name`` is empty."""
    symmetry = defaults.symmetry
    if name and "symmetry" in table.content:
        center = model.component(name).bounds_in_model.mean(axis=0)
        symmetry = _read_symmetry(table.table("symmetry"), tuple(center.tolist()))
    elif name:
        table.known("symmetry")
    settings = ComponentSettings(
        name=name,
        role=cast(Role, table.choice("role", ROLES, defaults.role)),
        position_tolerance_mm=table.positive("position_tolerance_mm", defaults.position_tolerance_mm),
        angle_tolerance_deg=table.positive("angle_tolerance_deg", defaults.angle_tolerance_deg),
        symmetry=symmetry,
        point=_read_point(table, defaults.point),
        rework=read_rework(table.table("rework"), rework.kinds, rework.targets, defaults.rework),
    )
    table.finish()
    return settings


def _read_point(table: TomlTable, default: NamedPoint | Vector) -> NamedPoint | Vector:
    """The point whose displacement is stated: a name, or coordinates."""
    if not table.known("point"):
        return default
    if isinstance(table.content["point"], list):
        return table.vector("point")
    if table.content["point"] not in POINTS:
        table.fail("point", table.content["point"], '"mass", "seat", "axis", "hole", or three numbers [x, y, z]')
    return cast(NamedPoint, table.content["point"])


def _read_symmetry(table: TomlTable, default_through: Vector) -> Symmetry:
    axis = table.direction("axis")
    through = table.vector("through_mm", default_through)
    order = table.take("order")
    table.finish()
    if order == "continuous":
        return Symmetry(axis, through, None)
    if isinstance(order, bool) or not isinstance(order, int) or order < 2:
        table.fail("order", order, 'a whole number of at least 2, or "continuous"')
    return Symmetry(axis, through, order)


def _read_datums(tables: TomlTable, model: Model, taken: Sequence[str] | None = None) -> tuple[Datum, ...]:
    """Datums; or features, which lock nothing, with names that no component or datum has (``taken``)."""
    datums, names = [], [component.name for component in model.components]
    for label in tables.content:
        table = tables.table(label)
        kinds = DATUM_FEATURES if taken is None else (*DATUM_FEATURES, "surface")
        feature = cast(DatumFeature, table.choice("feature", kinds, required=True))
        component = table.text("component")
        if component not in names:
            raise InputError(f"{table.path}: [{table.name}] {unknown_component(component, names)}")
        x, y, z = model.component(component).bounds_in_model.mean(axis=0).tolist()
        point, direction, diameter_mm = (x, y, z), (0.0, 0.0, 1.0), None
        if feature != "fit":
            point = table.vector("point_mm")
        if feature not in ("fit", "surface"):
            direction = table.direction("normal" if feature in ("plane", "point") else "axis")
        if feature in ("hole", "pin", "cylinder"):
            diameter_mm = table.positive("diameter_mm", required=True)
        if feature == "slot":
            diameter_mm = table.positive("width_mm", required=True)
        targets: tuple[Vector, ...] = ()
        if feature == "plane" and taken is None:
            targets = vectors(table, "targets_mm")
        locks = table.choices("locks", DOF_NAMES) if taken is None else DOF_NAMES
        if label in (taken or ()):
            raise InputError(f"{table.path}: [{table.name}] {label!r} is the name of a component or datum")
        table.finish()
        datums.append(Datum(label, feature, component, point, direction, diameter_mm, locks, targets))
    tables.finish()
    return tuple(datums)
