"""A plate with holes of many sizes, studs, blocks and gaps, as designed and as built with known errors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from arview.cad.model import Component, Model, make_model
from arview.cad.part import Characteristic, ComponentSettings, Datum, Part
from arview.camera import Camera
from arview.geometry import Array, apply, exp_so3, rigid
from helpers.cad_files import box
from helpers.synthetic import post

CELL_MM, THICK_MM, SIDES = 50.0, 8.0, 192
CAMERA = Camera(1600, 1200, 1800.0, 1800.0, 799.5, 599.5, np.array([-0.06, 0.01, 0.0, 0.0, 0.0]))
UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class FeatureScene:
    """A nominal part and what was built of it.

    Attributes:
        part: with datums A (top), B and C (holes), and the features and characteristics of all that is measured.
        built: the model as built.
        true_mm: true value of each characteristic that has a size, distance, gap or flush; or the diameter or width of
            the zone.
    """

    part: Part
    built: Model
    true_mm: dict[str, float] = field(default_factory=dict)


def cell(middle: Array, offset: Array, radius_mm: float, half_mm: Array) -> tuple[Array, list[tuple[int, int, int]]]:
    """A square of plate about ``middle`` with a hole, or a slot of some half length (2,): vertices and triangles."""
    half = 0.5 * CELL_MM
    corners = np.arctan2([half, half, -half, -half], [half, -half, -half, half])
    angle = np.sort(np.concatenate([np.arange(SIDES) * 2 * np.pi / SIDES - np.pi + 0.01, corners]))
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    reach = half / np.abs(direction).max(axis=1)
    n = len(angle)
    inner, outer = middle + offset + radius_mm * direction, middle + reach[:, None] * direction
    if half_mm.any():
        inner = inner + np.sign(direction @ half_mm)[:, None] * half_mm
    vertices = np.concatenate([
        np.column_stack([ring, np.full(n, z)]) for z in (0.0, -THICK_MM) for ring in (inner, outer)
    ])  # fmt: skip
    faces: list[tuple[int, int, int]] = []
    for i in range(n):
        j = (i + 1) % n
        for a, b, c, d in (
            (i, n + i, n + j, j),
            (2 * n + i, 2 * n + j, 3 * n + j, 3 * n + i),
            (j, 2 * n + j, 2 * n + i, i),
        ):
            faces += [(a, b, c), (a, c, d)]
    return vertices, faces


def plate(columns: int, rows: int, radii_mm: Array, offsets: Array, halves_mm: Array | None = None) -> Component:
    """A plate of cells, each with a hole, or a slot where its half length (2,) is given."""
    halves_mm = np.zeros((columns * rows, 2)) if halves_mm is None else halves_mm
    size = np.array([columns, rows]) * CELL_MM
    parts: list[Array] = []
    faces: list[tuple[int, int, int]] = []
    for index in range(columns * rows):
        middle = (np.array([index % columns, index // columns]) + 0.5) * CELL_MM - 0.5 * size
        vertices, own = cell(middle, offsets[index], radii_mm[index], halves_mm[index])
        before = sum(len(part) for part in parts)
        faces += [(a + before, b + before, c + before) for a, b, c in own]
        parts.append(vertices)
    x, y = 0.5 * size
    start = sum(len(part) for part in parts)
    rim = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    parts.append(np.concatenate([np.column_stack([rim, np.full(4, z)]) for z in (0.0, -THICK_MM)]))
    for i in range(4):
        j = (i + 1) % 4
        faces += [(start + i, start + 4 + i, start + 4 + j), (start + i, start + 4 + j, start + j)]
    vertices, owner = np.unique(np.concatenate(parts).round(9), axis=0, return_inverse=True)
    return Component("plate", vertices, owner.ravel()[np.array(faces)].astype(np.int32))


def moved(component: Component, shift_mm: Array, turn_deg: Array) -> Component:
    """A component shifted, and turned about the middle of its foot."""
    foot = component.bounds_in_model.mean(axis=0)
    foot[2] = component.bounds_in_model[0, 2]
    rotation = exp_so3(np.deg2rad(turn_deg))
    place = rigid(rotation, foot - rotation @ foot + shift_mm)
    return replace(component, vertices_in_model=apply(place, component.vertices_in_model))


def feature_scene(seed: int = 0, columns: int = 5, rows: int = 4) -> FeatureScene:
    """Holes of ⌀4 to ⌀20, studs, pairs of blocks with gaps of 0.3 to 3 mm and tilted faces, all with errors."""
    rng = np.random.default_rng(seed)
    count = columns * rows
    middles = np.array([
        ((index % columns + 0.5 - 0.5 * columns) * CELL_MM, (index // columns + 0.5 - 0.5 * rows) * CELL_MM)
        for index in range(count)
    ])  # fmt: skip
    radii = 0.5 * rng.uniform(4.0, 20.0, count)
    corners = {"B": 0, "C": columns - 1}
    radii[list(corners.values())] = 6.0
    stands = {index for index in range(count) if index % 2 == 1 and index not in corners.values()}
    radii[sorted(stands)] = 2.5
    errors, growths = rng.uniform(-0.4, 0.4, (count, 2)), rng.uniform(-0.15, 0.15, count)
    for index in corners.values():
        errors[index], growths[index] = 0.0, 0.0
    nominal = [plate(columns, rows, radii, np.zeros((count, 2)))]
    built = [plate(columns, rows, radii + growths, errors)]
    datums = [Datum("A", "plane", "plate", (float(middles[0, 0] + 20.0), float(middles[0, 1]), 0.0), UP)]
    datums += [
        Datum(label, "hole", "plate", (*middles[index].tolist(), 0.0), UP, 12.0) for label, index in corners.items()
    ]
    features: list[Datum] = []
    characteristics: list[Characteristic] = []
    true_mm: dict[str, float] = {}

    def require(one: Characteristic, value_mm: float) -> None:
        characteristics.append(one)
        true_mm[one.name] = value_mm

    everything = ("A", "B", "C")
    for index in range(count):
        if index in corners.values() or index in stands:
            continue
        name = f"hole_{index}"
        features.append(Datum(name, "hole", "plate", (*middles[index].tolist(), 0.0), UP, 2.0 * float(radii[index])))
        at = Characteristic(f"{name} position", "position", (name,), 0.5, zone="diameter", datums=everything)
        require(at, 2.0 * float(np.linalg.norm(errors[index])))
        nominal_mm = 2.0 * float(radii[index])
        limits = (nominal_mm - 0.2, nominal_mm + 0.2)
        require(
            Characteristic(f"{name} size", "size", (name,), limits_mm=limits), nominal_mm + 2.0 * float(growths[index])
        )
    for number, index in enumerate(sorted(stands)):
        x, y = middles[index]
        if number % 2 == 0:
            radius, height = float(rng.uniform(3.0, 9.0)), float(rng.uniform(12.0, 25.0))
            name, growth = f"stud_{index}", float(rng.uniform(-0.1, 0.1))
            shift = np.array([*rng.uniform(-0.4, 0.4, 2), 0.0])
            vertices, faces = post((float(x), float(y)), radius, 0.0, height, SIDES)
            nominal.append(Component(name, vertices, faces.astype(np.int32)))
            vertices, faces = post((float(x), float(y)), radius + growth, 0.0, height, SIDES)
            built.append(moved(Component(name, vertices, faces.astype(np.int32)), shift, np.zeros(3)))
            pin = Datum(f"{name}_pin", "pin", name, (float(x), float(y), height), UP, 2.0 * radius)
            features.append(pin)
            at = Characteristic(f"{name} position", "position", (pin.label,), 0.5, zone="diameter", datums=everything)
            require(at, 2.0 * float(np.linalg.norm(shift)))
            limits = (2.0 * radius - 0.2, 2.0 * radius + 0.2)
            require(Characteristic(f"{name} size", "size", (pin.label,), limits_mm=limits), 2.0 * (radius + growth))
            continue
        gap, half, height = float(rng.uniform(0.3, 3.0)), 10.0, float(rng.uniform(10.0, 18.0))
        step, opening = float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.2, 0.3))
        tilt_deg = float(rng.uniform(-0.6, 0.6))
        pair = {}
        for side, sign in (("left", -1.0), ("right", 1.0)):
            low = (x - 0.5 * gap - 2 * half, y - half, 0.0) if sign < 0 else (x + 0.5 * gap, y - half, 0.0)
            vertices, faces = box(low, (low[0] + 2 * half, y + half, height))
            pair[side] = Component(f"{side}_{index}", vertices, faces.astype(np.int32))
            nominal.append(pair[side])
        built.append(pair["left"])
        right = pair["right"]
        built.append(moved(right, np.array([opening, 0.0, step]), np.array([tilt_deg, 0.0, 0.0])))
        names = [f"top_{side}_{index}" for side in pair]
        for side, name in zip(pair, names, strict=True):
            middle = pair[side].bounds_in_model.mean(axis=0)
            features.append(Datum(name, "plane", f"{side}_{index}", (float(middle[0]), float(y), height), UP))
        require(
            Characteristic(f"flush_{index}", "flush", tuple(names), limits_mm=(-0.3, 0.3)),
            flush_of(step, tilt_deg, height),
        )
        sides = [f"face_{side}_{index}" for side in pair]
        for side, name, sign in zip(pair, sides, (1.0, -1.0), strict=True):
            at_x = x - 0.5 * gap if sign > 0 else x + 0.5 * gap
            features.append(Datum(name, "plane", f"{side}_{index}", (float(at_x), float(y), 5.0), (sign, 0.0, 0.0)))
        across = Characteristic(f"gap_{index}", "gap", tuple(sides), limits_mm=(gap - 0.3, gap + 0.3))
        require(across, gap + opening)
        outer = Datum(
            f"outer_{index}",
            "edge",
            f"right_{index}",
            (float(x + 0.5 * gap + 2 * half), float(y), height),
            (0.0, 1.0, 0.0),
        )
        features.append(outer)
        aside = Characteristic(
            f"edge_{index}", "position", (outer.label,), 0.5, direction_in_model=(1.0, 0.0, 0.0), datums=everything
        )
        require(aside, 2.0 * abs(opening))
        tilted = Characteristic(f"top_{index} parallelism", "parallelism", (names[1],), 0.2, datums=("A",))
        require(tilted, 2.0 * half * abs(float(np.sin(np.deg2rad(tilt_deg)))))
    model = make_model("features", tuple(nominal))
    settings = [ComponentSettings("plate", "base")]
    settings += [ComponentSettings(component.name, "inspect", 1.0) for component in nominal[1:]]
    part = Part(
        "features", Path("part.toml"), Path("features.step"), model, tuple(settings), datums=tuple(datums),
        features=tuple(features), characteristics=tuple(characteristics),
    )  # fmt: skip
    return FeatureScene(part, make_model("built", tuple(built)), true_mm)


def slot_scene() -> FeatureScene:
    """A plate with three holes and two slots, of which one is off by 0.25 mm, turned by 0.5° and too wide by 0.1 mm.

    Its datum A is of three targets; further characteristics are of unequal zones and of least material.
    """
    middles = np.array([(x, y) for y in (-25.0, 25.0) for x in (-75.0, -25.0, 25.0, 75.0)])
    radii, halves = np.full(8, 6.0), np.zeros((8, 2))
    radii[[1, 6]], halves[1], halves[6] = (4.0, 5.0), (9.0, 0.0), (0.0, 7.0)
    errors, built_radii, built_halves = np.zeros((8, 2)), radii.copy(), halves.copy()
    errors[1], errors[5] = (0.2, -0.15), (0.1, 0.05)
    built_radii[1] += 0.05
    built_radii[5] -= 0.04
    built_halves[1] = 9.0 * np.array([np.cos(np.deg2rad(0.5)), np.sin(np.deg2rad(0.5))])
    nominal, built = plate(4, 2, radii, np.zeros((8, 2)), halves), plate(4, 2, built_radii, errors, built_halves)
    targets = ((-90.0, 40.0, 0.0), (90.0, 40.0, 0.0), (0.0, -40.0, 0.0))
    datums = (
        Datum("A", "plane", "plate", (-55.0, -25.0, 0.0), UP, targets_in_model=targets),
        Datum("B", "hole", "plate", (*middles[0].tolist(), 0.0), UP, 12.0),
        Datum("C", "hole", "plate", (*middles[3].tolist(), 0.0), UP, 12.0),
    )
    features = (
        Datum("slot", "slot", "plate", (*middles[1].tolist(), 0.0), UP, 8.0),
        Datum("upright", "slot", "plate", (*middles[6].tolist(), 0.0), UP, 10.0),
        Datum("hole", "hole", "plate", (*middles[5].tolist(), 0.0), UP, 12.0),
        Datum("top", "plane", "plate", (0.0, 0.0, 0.0), UP),
    )
    x, y, everything = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("A", "B", "C")
    characteristics = (
        Characteristic("width", "size", ("slot",), limits_mm=(7.9, 8.15)),
        Characteristic("across", "position", ("slot",), 0.3, direction_in_model=y, datums=everything),
        Characteristic("along", "position", ("slot",), 0.5, direction_in_model=x, datums=everything),
        Characteristic("upright width", "size", ("upright",), limits_mm=(9.9, 10.1)),
        Characteristic("upright place", "position", ("upright",), 0.2, direction_in_model=x, datums=everything),
        Characteristic("hole size", "size", ("hole",), limits_mm=(11.8, 12.1)),
        Characteristic("least", "position", ("hole",), 0.3, zone="diameter", datums=everything, material="least"),
        Characteristic("unequal", "position", ("slot",), 0.5, direction_in_model=x, datums=everything, offset_mm=0.2),
        Characteristic("raised", "profile", ("top",), 0.2, datums=everything, offset_mm=0.15),
    )  # fmt: skip
    turn = float(built_halves[1][1])
    true_mm = {
        "width": 8.1, "across": 2.0 * (0.15 + turn), "along": 2.0 * (0.2 + 9.0 - float(built_halves[1][0])),
        "upright width": 10.0, "upright place": 0.0, "hole size": 11.92, "least": 2.0 * float(np.hypot(0.1, 0.05)),
        "unequal": 0.0, "raised": 0.3,
    }  # fmt: skip
    part = Part(
        "slots", Path("part.toml"), Path("slots.step"), make_model("slots", (nominal,)),
        (ComponentSettings("plate", "base"),), datums=datums, features=features, characteristics=characteristics,
    )  # fmt: skip
    return FeatureScene(part, make_model("built", (built,)), true_mm)


def flush_of(step_mm: float, tilt_deg: float, height_mm: float) -> float:
    """Height of the middle of a block's top that is lifted, and tilted about its foot."""
    return step_mm + height_mm * (float(np.cos(np.deg2rad(tilt_deg))) - 1.0)
