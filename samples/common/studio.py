"""The Mitsuba scene: the as-built part on a cluttered bench, its lamps, and its photos. Lengths in mm."""

from __future__ import annotations

from functools import cache

import cv2
import mitsuba as mi
import numpy as np
import shots
import textures as tx
from kinds import Kind, SetOptions
from rendering import denoise, develop, lamp, matte, mesh, metered, page, sensor, steel, to_world, undistortion_maps
from solids import tessellated

APERTURE_MM = 1.2
METALLIC = {"rust": 0.2, "paint": 0.0, "chrome": 1.0, "cast": 0.15}
BUMP_MM = {"rust": 0.03, "paint": 0.004, "chrome": 0.004, "cast": 0.02}
NOISE_GAIN = {"dim": 8.0, "mixed": 2.0}
"""Variance of the sensor's noise against that in a well-lit workshop."""


@cache
def nominal_meshes(kind: Kind):
    """Components at their nominal place, 3 µm from the true surface: name → vertices, faces."""
    return tessellated(kind.components(), 0.003, 0.05)


def as_built_meshes(kind: Kind, seed: int):
    """The part as built: the displaced components, and what the CAD does not have, weld beads and foreign objects."""
    nominal = nominal_meshes(kind)
    truth = shots.as_built(kind, seed, nominal)
    base = next(iter(nominal))
    rng = np.random.default_rng((seed, 4))
    meshes = {}
    for name, (vertices, faces) in nominal.items():
        if not truth[name].get("present", True):
            continue
        pose = np.array(truth[name]["measured_from_nominal"])
        meshes[name] = vertices @ pose[:3, :3].T + pose[:3, 3], faces
        if name == base or not kind.welds:
            continue
        # A bead lies on the plate: it follows the shift and twist of its component, not lift and tilt.
        centroid = np.array(truth[name]["centroid_mm"]) * (1, 1, 0)
        bead, bead_faces = tx.weld_bead(vertices, faces, rng)
        shift = np.array(truth[name]["displacement_mm"]) * (1, 1, 0)
        turned = (bead - centroid) @ tx.turn_z(truth[name]["tilt_deg"][2]).T + centroid + shift
        meshes[name + "_weld"] = turned, bead_faces
    return meshes | shots.foreign_meshes(kind, seed, nominal, truth)


def _speckled(maps, size_px: float, rng):
    """Add pits and spatter of about a given size to a surface (color, roughness, bump)."""
    color, rough, bump = maps
    for scale, share, tint in ((1.0, 0.7, 0.3), (1.7, 0.6, 0.25), (1.3, 0.5, 2.2)):
        speck = tx.specks(*rough.shape, scale * size_px, rng) * share
        color = color * (1.0 + (tint - 1.0) * speck)[..., None]
    return np.minimum(color, 0.9), rough, bump


def _steel_base(kind: Kind, seed: int, rng):
    """Rolled plate with pits and a serial number in chalk."""
    size = 1500
    plate = _speckled(tx.mill_scale(size, size, rng), 1.8, rng)
    chalk = np.zeros((size, size), np.uint8)
    for text, u, v, height in (
        (f"{kind.stamp}-{417 + seed:04d}", 0.30, 0.36, 2.0),
        ("7", 0.62, 0.60, 2.4),
        ("ok", 0.84, 0.74, 1.6),
    ):
        cv2.putText(chalk, text, (int(u * size), int(v * size)), cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, height, 255, 4)
    dust = (chalk / 255.0) * (0.35 + 0.6 * tx.fft_noise(size, size, 0.6, rng))
    plate[0][:] = plate[0] + (0.72 - plate[0]) * dust[..., None]
    return steel(plate, 0.5, 0.03)


def _finished(finish: str, size: int, rng, tint):
    """The surface of an unworn finish: rust, paint, chrome or cast."""
    maps = tx.coat(size, size, rng, tint) if finish == "paint" else getattr(tx, finish)(size, size, rng)
    return steel(maps, METALLIC[finish], BUMP_MM[finish])


def _surface(kind: Kind, finish: str, name: str, rng):
    """The surface of a component. Every one has a texture of its own, so that no pattern repeats."""
    metals = {"zinc": (tx.zinc, 0.85, 0.012), "blued": (tx.blued, 0.45, 0.02), "machined": (tx.machined, 0.85, 0.012)}
    own = kind.metals.get(name.split("_")[0], "machined")
    is_own = finish == kind.finish and name.split("_")[0] in kind.metals
    if finish in ("steel", "cast") or is_own:
        # Parts fixed to a casting are cast themselves, plated or turned.
        if own in ("cast", "chrome"):
            return _finished(own, 800, rng, kind.tint)
        look, metallic, bump_mm = metals[own]
        return steel(_speckled(look(800, 800, rng), 1.8, rng), metallic, bump_mm)
    return _finished(finish, 400, rng, np.array(kind.tint) * rng.uniform(0.88, 1.0))


def _part(shapes, kind: Kind, options: SetOptions, rng):
    meshes = as_built_meshes(kind, options.seed)
    base, finish = next(iter(meshes)), options.finish
    extent = np.ptp(meshes[base][0], axis=0).max()
    plain = kind.finish if finish == "chrome" else finish
    is_steel = plain == "steel"
    base_surface = _steel_base(kind, options.seed, rng) if is_steel else _finished(plain, 1500, rng, kind.tint)
    bright = tx.machined(256, 256, rng)
    bead = steel((bright[0] * (0.62, 0.56, 0.46), bright[1], bright[2]), 0.8, 0.01)
    bead = base_surface if finish in ("paint", "rust") else bead
    for name, geometry in meshes.items():
        if name == base:
            tile = extent + 40.0
            shapes[name] = mesh(name, *geometry, base_surface, (tile, tile), (tile / 2, tile / 2))
        elif name.endswith("_weld"):
            shapes[name] = mesh(name, *geometry, bead, (30.0, 30.0), rng.uniform(0, 30, 2), 60.0)
        else:
            own = "steel" if name.startswith("foreign") else finish
            surface = _surface(kind, own, name.removeprefix("fallen_"), rng)
            shapes[name] = mesh(name, *geometry, surface, (170.0, 170.0), rng.uniform(0, 170, 2))


def _clutter(shapes, kind: Kind, options: SetOptions, rng):
    """Bench, walls and clutter around the part."""
    floor, bench_mm = kind.floor, max(2000.0, 2 * kind.radius + 1550.0)

    def add(name, geometry, surface, tile=(200.0, 200.0), crease=35.0):
        shapes[name] = mesh(name, *geometry, surface, tile, rng.uniform(0, 200, 2), crease)

    def paint(tint):
        return matte(tx.painted(256, 256, rng, tint), 0.45)

    # Centres and radii of the occupied places. Tall things stand farther away, so that they occlude the part in no
    # photo.
    taken = [((0.0, 0.0), kind.radius)]

    def free(radius, height=0.0):
        for _ in range(10000):
            near, far = kind.radius + 25 + radius + 1.7 * height, max(kind.radius + 675, 900)
            angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(near, far)
            x, y = away * np.cos(angle), away * np.sin(angle)
            if all(np.hypot(x - at[0], y - at[1]) > radius + other + 8 for at, other in taken):
                taken.append(((x, y), radius))
                return x, y
        raise RuntimeError("no place left on the bench")

    resolution = options.bench_px_per_mm
    bench = tx.bench_top(bench_mm, bench_mm, resolution, rng, f"fixture {rng.integers(1, 9)}", holes=False)
    bench = _speckled(bench, 1.0, rng)
    bench[0][:] *= rng.uniform(0.55, 0.9) * rng.uniform(0.85, 1.1, 3)
    slab = tx.box((bench_mm, bench_mm, 30), (0, 0, floor - 15))
    tile = (bench_mm, bench_mm)
    shapes["bench"] = mesh("bench", *slab, steel(bench, 0.2), tile, (bench_mm / 2, bench_mm / 2))
    for k, (size, center) in enumerate(kind.supports):
        add(f"support_{k}", tx.box(size, center), paint((0.42, 0.29, 0.16)))
    wall = matte(tx.painted(1024, 1024, rng, (0.46, 0.48, 0.47), 0.12))
    wall_mm = max(1900.0, bench_mm / 2 + 900.0)
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        size = (20 + 5000 * abs(y), 20 + 5000 * abs(x), 3000)
        add(f"wall_{k}", tx.box(size, (wall_mm * x, wall_mm * y, 300)), wall, (3000.0 + 70 * k, 2900.0))
    for k, (size, title) in enumerate([((320, 220, 190), "FRAGILE 24 pcs"), ((220, 160, 130), "RETURN 3/8")]):
        carton = matte(tx.printed_sheet(700, 900, rng, title, (0.42, 0.27, 0.14)), 0.7)
        center = (*free(150, size[2]), floor + size[2] / 2)
        add(f"carton_{k}", tx.box(size, center, rng.uniform(0, 360)), carton, (330.0, 260.0))
    cup = [(0, 3), (36, 3), (38, 95), (41, 95), (39, 0), (0, 0)]
    add("cup", tx.revolve(cup, 64, (*free(42, 95), floor)), paint(rng.uniform(0.03, 0.6, 3)))
    bottle = [(0, 0), (32, 0), (32, 120), (26, 140), (14, 152), (14, 175), (0, 175)]
    add("bottle", tx.revolve(bottle, 64, (*free(33, 175), floor)), paint((0.75, 0.50, 0.03)), crease=50)
    roll = [(26, 0), (44, 0), (44, 24), (26, 24), (26, 0)]
    add("tape_roll", tx.revolve(roll, 64, (*free(45), floor)), paint((0.60, 0.42, 0.20)))
    for k, title in enumerate((f"Work order {rng.integers(1000):04d}", "Weld plan", "Checklist")):
        sheet = matte(tx.printed_sheet(1100, 780, rng, title), 0.75)
        shapes[f"sheet_{k}"] = page(f"sheet_{k}", sheet, (148, 210), (*free(125), floor + 0.4), rng.uniform(0, 360))
    for k in range(12):
        size = rng.uniform((20, 12, 10), (90, 50, 45))
        center = (*free(np.hypot(*size[:2]) / 2, size[2]), floor + size[2] / 2)
        add(f"thing_{k}", tx.box(size, center, rng.uniform(0, 360)), paint(rng.uniform(0.03, 0.6, 3)))
    # Screws and parts like those on the plate lie around it, each with a surface of its own.
    loose = {name: geometry for name, geometry in nominal_meshes(kind).items() if name in kind.loose}
    for name, (vertices, faces) in loose.items():
        seat = kind.seat(name)
        vertices = (vertices - seat[:3, 3]) @ seat[:3, :3]
        vertices = vertices - vertices.mean(axis=0) * (1, 1, 0)
        for k in range(2):
            at = (*free(30), floor)
            geometry = vertices @ tx.turn_z(rng.uniform(0, 360)).T + at, faces
            add(f"loose_{name}_{k}", geometry, steel(tx.machined(400, 400, rng), 0.85, 0.012), (90.0, 90.0))
    screw = tx.revolve([(0, 26), (3, 26), (3, 0), (5.2, 0), (5.2, -6), (0, -6)], 20)
    lying = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]])
    bright = steel(tx.machined(512, 512, rng), 0.85, 0.012)
    for k in range(10):
        turned = screw[0] @ lying.T @ tx.turn_z(rng.uniform(0, 360)).T + (*free(25), floor + 5.2)
        add(f"screw_{k}", (turned, screw[1]), bright)
    s = np.linspace(0, 1, 120)
    side = rng.choice((-1, 1), 2)
    cable = np.column_stack(
        [side[0] * (kind.radius + 105 + 90 * s**2 + 25 * np.sin(11 * s)), side[1] * (700 * s - 400), floor + 4 + 0 * s]
    )
    add("cable", tx.sweep(cable, 4.0, 12), matte((0.03, 0.33, 0.09), 0.35), crease=60)


def lamps(light: str, radius: float, rng) -> dict:
    """The lamps of a scene, each with a brightness and tint of its own."""
    x, y = rng.uniform(-250, 250, 2)
    high = 1750.0 + max(0.0, radius - 225.0) / 2
    spread = rng.uniform(0.85, 1.15, (3, 1)) * rng.uniform(0.97, 1.03, (3, 3))
    strip_1, strip_2, window = np.array([(9.5, 9.3, 8.9), (8.5, 8.4, 8.1), (3.0, 3.4, 4.0)]) * spread
    window_lamp = lamp([-1750, 300 + y, 900], [0, 0, 0], (1500, 1200), window.tolist())
    if light == "hard-sun":
        # A lamp of half a degree as the sun has it, and the sky through open doors.
        angle, rise = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(38, 58))
        toward = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        sun = {"type": "directional", "direction": (-toward).tolist(), "irradiance": _rgb((9.0, 8.5, 7.6))}
        return {"sun": sun, "fill": {"type": "constant", "radiance": _rgb((0.42, 0.50, 0.64))}}
    if light == "mixed":
        # A cold window from one side and a warm bulb from the other.
        bulb = lamp([900 + x, -700 + y, 1200], [0, 0, 0], (130, 130), [210.0, 140.0, 70.0])
        return {
            "window": lamp([-1750, 300 + y, 900], [0, 0, 0], (1500, 1200), (2.2 * window).tolist()),
            "bulb": bulb,
            "fill": {"type": "constant", "radiance": _rgb((0.14, 0.15, 0.17))},
        }
    strips = {
        "strip_1": lamp([-450 + x, 250, high], [-400 + x, 200, 0], (1500, 260), strip_1.tolist()),
        "strip_2": lamp([600, -250 + y, high], [550, -200 + y, 0], (1500, 260), strip_2.tolist()),
        "window": window_lamp,
        "fill": {"type": "constant", "radiance": _rgb((0.30, 0.31, 0.33))},
    }
    if light == "dim":
        del strips["strip_1"], strips["window"]
        strips["fill"] = {"type": "constant", "radiance": _rgb((0.12, 0.12, 0.125))}
    return strips


def _rgb(value) -> dict:
    return {"type": "rgb", "value": list(value)}


def build(kind: Kind, options: SetOptions, film: dict):
    """The scene as a Mitsuba object with a sensor; the caller sets its pose."""
    rng = np.random.default_rng((options.seed, 5))
    shapes: dict[str, object] = {}
    _part(shapes, kind, options, rng)
    _clutter(shapes, kind, options, rng)
    return mi.load_dict({"type": "scene", "sensor": film} | lamps(options.light, kind.radius, rng) | shapes)


class Studio:
    """Takes the photos of one set."""

    def __init__(self, kind: Kind, options: SetOptions):
        self.kind, self.options = kind, options
        self.camera, self.places = shots.camera(options), shots.places(kind, options)
        film = shots.film_size(self.camera, undistortion_maps)
        if options.lens_changes:
            film = tuple(size + 2 * round(0.02 * options.width) for size in film)
        focus_mm = float(np.mean([distance for _, distance in kind.rings]))
        self.scene = build(kind, options, sensor(film, self.camera["fx"], APERTURE_MM, focus_mm))
        self.params = mi.traverse(self.scene)
        self.light = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 3})
        self.guides = mi.load_dict({"type": "aov", "aovs": "alb:albedo,nn:sh_normal"})
        self.film = film

    def photo(self, index: int) -> tuple[np.ndarray, float]:
        """The finished BGR picture (H,W,3) uint8 and the exposure, 1 is the usual one."""
        options = self.options
        rng = np.random.default_rng((options.seed, 6, index))
        gain, focus = np.exp(rng.normal(0, 0.13)), 1.0 + rng.normal(0, 0.03)
        pose = self.places[index]
        self.params["sensor.to_world"] = to_world(pose)
        self.params["sensor.focus_distance"] = float(pose[2, 3] * focus)
        self.params.update()
        noise, color = (options.seed * options.photos + index) * (options.passes + 1), 0.0
        for k in range(options.passes):
            part = np.array(mi.render(self.scene, integrator=self.light, spp=options.samples, seed=noise + k))
            color = color + part / options.passes
        guide = np.array(
            mi.render(self.scene, integrator=self.guides, spp=options.samples, seed=noise + options.passes)
        )
        maps = undistortion_maps(shots.camera_of_photo(options, index), self.film, self.camera["fx"])
        linear = cv2.remap(denoise(color, guide), *maps, cv2.INTER_CUBIC)
        fixed = self.kind.exposure if options.light == "workshop" else None
        exposure = fixed or metered(linear)
        return develop(linear, gain * exposure, rng, NOISE_GAIN.get(options.light, 1.0)), gain
