"""Part: a CAD model with the settings that its CAD file does not hold: roles, tolerances, datums, symmetries, views."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from arview.cad.model import Model
from arview.cad.shape.symmetry import Symmetry
from arview.cad.view_range import Up, ViewRange
from arview.errors import InputError

Role = Literal["base", "inspect", "ignore"]
Vector = tuple[float, float, float]

NamedPoint = Literal["mass", "seat", "axis", "hole"]
"""Points of a component by which its place is stated: centre of mass, middle of the surface on which it stands, foot of
its axis, centre of its hole."""

DatumFeature = Literal["plane", "hole", "pin", "slot", "cylinder", "edge", "point", "surface", "fit"]
ReworkVerb = Literal["towards", "away from"]
DOF_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Degrees of freedom: rotations about and translations along the axes of the model."""


@dataclass(frozen=True)
class ReworkAxis:
    """A direction on the part by whose name a fitter is told to move a component.

    Attributes:
        verb: towards, or away from, the target.
        target: name of a component, or of a datum feature as in ``hole_B``; empty for a direction of its own.
        direction_in_model: (3,) unit vector; None where there is a target.
        name: text for the fitter; empty: verb and target.
    """

    verb: ReworkVerb = "towards"
    target: str = ""
    direction_in_model: Vector | None = None
    name: str = ""


@dataclass(frozen=True)
class ReworkKind:
    """How components of one kind are reworked.

    Attributes:
        name: unbolt, reweld, …, see `arview.cad.rework_table.KINDS`, or one of the part file.
        text: of the part file, for the fitter.
        steps: instead of the usual ones; ``{move}`` stands for the moves, ``{component}`` for the name.
        pictures: paths relative to the part file.
    """

    name: str = "adjust"
    text: str = ""
    steps: tuple[str, ...] = ()
    pictures: tuple[str, ...] = ()


@dataclass(frozen=True)
class ReworkSettings(ReworkKind):
    """How one component is reworked: its kind, with what the component has of its own.

    Attributes:
        axes: directions by which its moves are stated, before those that are found.
    """

    axes: tuple[ReworkAxis, ...] = ()


@dataclass(frozen=True)
class ComponentSettings:
    """Settings of one component in the part file.

    Attributes:
        name: of the component.
        role: base, inspect or ignore.
        position_tolerance_mm: largest allowed distance from the nominal place; None: not judged.
        angle_tolerance_deg: largest allowed rotation from nominal; None: not judged.
        symmetry: rotation that cannot be observed, in the model frame.
        point: the point whose displacement is stated: a named one, or coordinates in the model, mm.
        rework: how it is put right when it is out of tolerance.
    """

    name: str
    role: Role = "inspect"
    position_tolerance_mm: float | None = None
    angle_tolerance_deg: float | None = None
    symmetry: Symmetry | None = None
    point: NamedPoint | Vector = "mass"
    rework: ReworkSettings = ReworkSettings()


@dataclass(frozen=True)
class Datum:
    """A feature that defines the datum frame.

    Attributes:
        label: A, B, C, ….
        feature: its kind.
        component: name of the component that carries it.
        point_in_model: a point on it, mm; for ``fit``, the best fit of a whole component, its centre. A surface is all
            that is joined with that point without a sharp edge.
        direction_in_model: unit normal of a plane or point, unit axis of a hole, pin, slot, cylinder or edge; for
            ``fit`` +Z.
        diameter_mm: of round features, and width of a slot.
        locks: degrees of freedom that it may lock.
        targets_in_model: datum targets (ISO 5459): points of a plane, measured only around them; none: all of it.
    """

    label: str
    feature: DatumFeature
    component: str
    point_in_model: Vector
    direction_in_model: Vector
    diameter_mm: float | None = None
    locks: tuple[str, ...] = DOF_NAMES
    targets_in_model: tuple[Vector, ...] = ()

    @property
    def feature_name(self) -> str:
        """Name on the part, as in ``hole_B``."""
        return f"{self.feature}_{self.label}"


CharacteristicKind = Literal[
    "position", "profile", "flatness", "perpendicularity", "parallelism", "angularity",
    "size", "distance", "gap", "flush",
]  # fmt: skip
"""Characteristics of a drawing: those with a tolerance zone (ISO 1101), and those between limits."""

MaterialCondition = Literal["", "maximum", "least"]
"""The limit of size at which a zone is smallest."""
ZoneShape = Literal["diameter", "sphere", "width"]
"""A tolerance zone: a cylinder about an axis, a sphere, or the space between two planes."""


@dataclass(frozen=True)
class Characteristic:
    """A requirement of the drawing on features or components.

    Attributes:
        name: as the reports call it.
        kind: what is limited.
        of: names of features or components. Several of a kind with a zone are a pattern, which must comply at once; a
            distance, gap or flush is between two.
        tolerance_mm: diameter of the zone, or its width; None for a kind with limits.
        limits_mm: smallest and largest value of a kind with limits; None: not limited.
        zone: shape of the zone.
        direction_in_model: (3,) unit, across a zone between planes or along a distance; None: the feature's own.
        datums: labels of the datums of its frame, in order of precedence; what they leave free is free.
        offset_mm: how far the middle of a zone between planes lies off nominal, along its direction (ISO 1101, UZ).
        material: the zone grows with the distance of the measured size from this limit (ISO 2692); empty: it does not.
        datums_at_maximum: labels of the round datums from which the features may shift by that distance.
        source: where it comes from, such as a balloon of the drawing or the PMI of the CAD file.
    """

    name: str
    kind: CharacteristicKind
    of: tuple[str, ...]
    tolerance_mm: float | None = None
    limits_mm: tuple[float | None, float | None] = (None, None)
    zone: ZoneShape = "width"
    direction_in_model: Vector | None = None
    datums: tuple[str, ...] = ()
    offset_mm: float = 0.0
    material: MaterialCondition = ""
    datums_at_maximum: tuple[str, ...] = ()
    source: str = ""


@dataclass(frozen=True)
class Guide:
    """A named view that the part can be brought into; None leaves a value to the declared range."""

    name: str
    azimuth_deg: float
    elevation_deg: float
    roll_deg: float | None = None
    distance_mm: float | None = None


@dataclass(frozen=True)
class Part:
    """A model and the settings of a part file, or the defaults for a bare CAD file.

    Attributes:
        name: of the part.
        path: the part file, or the bare CAD file.
        cad_path: the CAD file.
        model: without the components whose role is ``ignore``, in the colours of the part file.
        settings: one per component of the CAD, ignored ones included, in the order of the CAD.
        view_range: the declared one, or None; see `default_view_range`.
        symmetries: declared rotations of the whole part.
        datums: in order of precedence.
        guides: views of the part file.
        serial: serial number of the specimen, or None.
        serial_pattern: regular expression that a code on the part must match to be a serial number; empty: the form of
            the serial number, see `arview.fiducials.serial_code.SerialNumbers`.
        up: axis of the model that is up; the part file's, else the format's.
        notes: remarks of the loader on renamed or empty components.
        paths: of each component of ``settings``, its names in the assembly from the root on; empty if not known.
        drawing: number and revision of the drawing, or empty.
        features: that characteristics are about; a feature is described like a datum, its label is its name.
        characteristics: requirements of the drawing beside the tolerances of the components.
    """

    name: str
    path: Path
    cad_path: Path
    model: Model
    settings: tuple[ComponentSettings, ...]
    view_range: ViewRange | None = None
    symmetries: tuple[Symmetry, ...] = ()
    datums: tuple[Datum, ...] = ()
    guides: tuple[Guide, ...] = ()
    serial: str | None = None
    serial_pattern: str = ""
    up: Up = "z"
    notes: tuple[str, ...] = ()
    paths: tuple[tuple[str, ...], ...] = ()
    drawing: str = ""
    features: tuple[Datum, ...] = ()
    characteristics: tuple[Characteristic, ...] = ()

    def __repr__(self) -> str:
        serial = f" {self.serial}" if self.serial else ""
        return f"<Part {self.name}{serial}: {len(self.model.components)} components, {len(self.inspected)} inspected>"

    def component_settings(self, name: str) -> ComponentSettings:
        """Settings of a component by name.

        Raises:
            InputError: there is no such component; the message has the closest name.
        """
        for settings in self.settings:
            if settings.name == name:
                return settings
        raise InputError(f"part {self.name!r}: {unknown_component(name, [s.name for s in self.settings])}")

    @property
    def inspected(self) -> tuple[str, ...]:
        """Names of the components that are measured and judged."""
        return tuple(settings.name for settings in self.settings if settings.role == "inspect")

    @property
    def effective_view_range(self) -> ViewRange:
        """The declared range of viewpoints, or the default one."""
        return self.view_range or replace(default_view_range(self.model), up=self.up)


def default_view_range(model: Model) -> ViewRange:
    """The range of a part that declares none: every direction and roll, from where it fills the picture to 60 px.

    The distances depend on the camera, see `ViewRange.for_camera`. Here they suit all cameras: at 40 diameters the part
    spans 60 px with a focal length of 2400 px. Nearer than 0.9 diameters the camera could touch the part.
    """
    return ViewRange(distance_mm=(0.9 * model.diameter_mm, 40.0 * model.diameter_mm), min_span_px=60.0)


def unknown_component(name: str, names: list[str]) -> str:
    """The message for a component that the CAD does not have, with the closest name that it has."""
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"no component {name!r} in the CAD; {hint}It has: {', '.join(names)}"
