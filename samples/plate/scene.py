"""The Mitsuba scene: the as-built plate on a cluttered bench, and its photos. Lengths in mm."""

from __future__ import annotations

import assembly
import cv2
import mitsuba as mi
import numpy as np
import shots
import textures as tx
from rendering import denoise, develop, lamp, matte, mesh, page, sensor, steel, to_world, undistortion_maps
from solids import tessellated

FILM = (1680, 1260)  # undistorted picture that the distorted one is sampled from
APERTURE_MM = 1.2
PASSES, SAMPLES = 2, 4  # path samples per pixel: 8 in passes of 4, which keep memory low
EXPOSURE = 1.15
FLOOR = -8.0


def nominal_meshes():
    """Components at their nominal place, 3 µm from the true surface: name → vertices, faces."""
    return tessellated(assembly.components(), 0.003, 0.05)


def as_built_meshes(seed: int):
    """The plate as built: the displaced components, and the weld beads that the CAD does not have."""
    nominal = nominal_meshes()
    truth = shots.as_built(seed, nominal)
    rng = np.random.default_rng((seed, 4))
    meshes = {}
    for name, (vertices, faces) in nominal.items():
        pose = np.array(truth[name]["measured_from_nominal"])
        meshes[name] = vertices @ pose[:3, :3].T + pose[:3, 3], faces
        if name == "base_plate":
            continue
        # A bead lies on the plate: it follows the shift and twist of its component, not lift and tilt.
        centroid = np.array(truth[name]["centroid_mm"]) * (1, 1, 0)
        bead, bead_faces = tx.weld_bead(vertices, faces, rng)
        shift = np.array(truth[name]["displacement_mm"]) * (1, 1, 0)
        turned = (bead - centroid) @ tx.turn_z(truth[name]["tilt_deg"][2]).T + centroid + shift
        meshes[name + "_weld"] = turned, bead_faces
    return meshes


def _speckled(maps, size_px: float, rng):
    """Add pits and spatter of about a given size to a surface (color, roughness, bump)."""
    color, rough, bump = maps
    for scale, share, tint in ((1.0, 0.7, 0.3), (1.7, 0.6, 0.25), (1.3, 0.5, 2.2)):
        speck = tx.specks(*rough.shape, scale * size_px, rng) * share
        color = color * (1.0 + (tint - 1.0) * speck)[..., None]
    return np.minimum(color, 0.9), rough, bump


def _part(shapes, seed: int, rng):
    size = 1500
    plate = _speckled(tx.mill_scale(size, size, rng), 1.8, rng)
    chalk = np.zeros((size, size), np.uint8)
    for text, u, v, height in (
        (f"PL-{417 + seed:04d}", 0.30, 0.36, 2.0),
        ("7", 0.62, 0.60, 2.4),
        ("ok", 0.84, 0.74, 1.6),
    ):
        cv2.putText(chalk, text, (int(u * size), int(v * size)), cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, height, 255, 4)
    dust = (chalk / 255.0) * (0.35 + 0.6 * tx.fft_noise(size, size, 0.6, rng))
    plate[0][:] = plate[0] + (0.72 - plate[0]) * dust[..., None]
    bright = tx.machined(256, 256, rng)
    bead = steel((bright[0] * (0.62, 0.56, 0.46), bright[1], bright[2]), 0.8, 0.01)
    finishes = {"nut": (tx.zinc, 0.85, 0.012), "link": (tx.blued, 0.45, 0.02), "bracket": (tx.blued, 0.45, 0.02)}
    for name, geometry in as_built_meshes(seed).items():
        if name == "base_plate":
            shapes[name] = mesh(name, *geometry, steel(plate, 0.5, 0.03), (340.0, 340.0), (170.0, 170.0))
        elif name.endswith("_weld"):
            shapes[name] = mesh(name, *geometry, bead, (30.0, 30.0), rng.uniform(0, 30, 2), 60.0)
        else:
            # Every component has a texture of its own, so that no pattern repeats.
            finish, metallic, bump_mm = finishes.get(name.split("_")[0], (tx.machined, 0.85, 0.012))
            surface = steel(_speckled(finish(800, 800, rng), 1.8, rng), metallic, bump_mm)
            shapes[name] = mesh(name, *geometry, surface, (170.0, 170.0), rng.uniform(0, 170, 2))


def _clutter(shapes, rng):
    """Bench, walls and clutter around the part."""

    def add(name, geometry, surface, tile=(200.0, 200.0), crease=35.0):
        shapes[name] = mesh(name, *geometry, surface, tile, rng.uniform(0, 200, 2), crease)

    def paint(tint):
        return matte(tx.painted(256, 256, rng, tint), 0.45)

    # Centres and radii of the occupied places. Tall things stand farther away, so that they occlude the part in no
    # photo.
    taken = [((0.0, 0.0), 225.0)]

    def free(radius, height=0.0):
        for _ in range(10000):
            angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(250 + radius + 1.7 * height, 900)
            x, y = away * np.cos(angle), away * np.sin(angle)
            if all(np.hypot(x - at[0], y - at[1]) > radius + other + 8 for at, other in taken):
                taken.append(((x, y), radius))
                return x, y
        raise RuntimeError("no place left on the bench")

    bench = tx.bench_top(2000, 2000, 2.0, rng, f"fixture {rng.integers(1, 9)}", holes=False)
    bench = _speckled(bench, 1.0, rng)
    bench[0][:] *= rng.uniform(0.55, 0.9) * rng.uniform(0.85, 1.1, 3)
    slab = tx.box((2000, 2000, 30), (0, 0, FLOOR - 15))
    shapes["bench"] = mesh("bench", *slab, steel(bench, 0.2), (2000.0, 2000.0), (1000.0, 1000.0))
    wall = matte(tx.painted(1024, 1024, rng, (0.46, 0.48, 0.47), 0.12))
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        size = (20 + 5000 * abs(y), 20 + 5000 * abs(x), 3000)
        add(f"wall_{k}", tx.box(size, (1900 * x, 1900 * y, 300)), wall, (3000.0 + 70 * k, 2900.0))
    for k, (size, title) in enumerate([((320, 220, 190), "FRAGILE 24 pcs"), ((220, 160, 130), "RETURN 3/8")]):
        carton = matte(tx.printed_sheet(700, 900, rng, title, (0.42, 0.27, 0.14)), 0.7)
        center = (*free(150, size[2]), FLOOR + size[2] / 2)
        add(f"carton_{k}", tx.box(size, center, rng.uniform(0, 360)), carton, (330.0, 260.0))
    cup = [(0, 3), (36, 3), (38, 95), (41, 95), (39, 0), (0, 0)]
    add("cup", tx.revolve(cup, 64, (*free(42, 95), FLOOR)), paint(rng.uniform(0.03, 0.6, 3)))
    bottle = [(0, 0), (32, 0), (32, 120), (26, 140), (14, 152), (14, 175), (0, 175)]
    add("bottle", tx.revolve(bottle, 64, (*free(33, 175), FLOOR)), paint((0.75, 0.50, 0.03)), crease=50)
    roll = [(26, 0), (44, 0), (44, 24), (26, 24), (26, 0)]
    add("tape_roll", tx.revolve(roll, 64, (*free(45), FLOOR)), paint((0.60, 0.42, 0.20)))
    for k, title in enumerate((f"Work order {rng.integers(1000):04d}", "Weld plan", "Checklist")):
        sheet = matte(tx.printed_sheet(1100, 780, rng, title), 0.75)
        shapes[f"sheet_{k}"] = page(f"sheet_{k}", sheet, (148, 210), (*free(125), FLOOR + 0.4), rng.uniform(0, 360))
    for k in range(12):
        size = rng.uniform((20, 12, 10), (90, 50, 45))
        center = (*free(np.hypot(*size[:2]) / 2, size[2]), FLOOR + size[2] / 2)
        add(f"thing_{k}", tx.box(size, center, rng.uniform(0, 360)), paint(rng.uniform(0.03, 0.6, 3)))
    # Screws and parts like those on the plate lie around it, each with a surface of its own.
    loose = {name: geometry for name, geometry in nominal_meshes().items() if name in ("nut_1", "post_2", "link_2")}
    for name, (vertices, faces) in loose.items():
        vertices = vertices - vertices.mean(axis=0) * (1, 1, 0)
        for k in range(2):
            at = (*free(30), FLOOR)
            geometry = vertices @ tx.turn_z(rng.uniform(0, 360)).T + at, faces
            add(f"loose_{name}_{k}", geometry, steel(tx.machined(400, 400, rng), 0.85, 0.012), (90.0, 90.0))
    screw = tx.revolve([(0, 26), (3, 26), (3, 0), (5.2, 0), (5.2, -6), (0, -6)], 20)
    lying = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]])
    bright = steel(tx.machined(512, 512, rng), 0.85, 0.012)
    for k in range(10):
        turned = screw[0] @ lying.T @ tx.turn_z(rng.uniform(0, 360)).T + (*free(25), FLOOR + 5.2)
        add(f"screw_{k}", (turned, screw[1]), bright)
    s = np.linspace(0, 1, 120)
    side = rng.choice((-1, 1), 2)
    cable = np.column_stack(
        [side[0] * (330 + 90 * s**2 + 25 * np.sin(11 * s)), side[1] * (700 * s - 400), FLOOR + 4 + 0 * s]
    )
    add("cable", tx.sweep(cable, 4.0, 12), matte((0.03, 0.33, 0.09), 0.35), crease=60)


def build(seed: int, camera: dict, film: dict | None = None):
    """The scene as a Mitsuba object with the sensor of the photos, or another; the caller sets its pose."""
    rng = np.random.default_rng((seed, 5))
    shapes: dict[str, object] = {}
    _part(shapes, seed, rng)
    _clutter(shapes, rng)
    x, y = rng.uniform(-250, 250, 2)
    # Radiance of the lamps, each with a brightness and tint of its own.
    strip_1, strip_2, window = np.array([(9.5, 9.3, 8.9), (8.5, 8.4, 8.1), (3.0, 3.4, 4.0)]) * (
        rng.uniform(0.85, 1.15, (3, 1)) * rng.uniform(0.97, 1.03, (3, 3))
    )
    scene = {
        "type": "scene",
        "sensor": film or sensor(FILM, camera["fx"], APERTURE_MM, 750.0),
        "strip_1": lamp([-450 + x, 250, 1750], [-400 + x, 200, 0], (1500, 260), strip_1.tolist()),
        "strip_2": lamp([600, -250 + y, 1750], [550, -200 + y, 0], (1500, 260), strip_2.tolist()),
        "window": lamp([-1750, 300 + y, 900], [0, 0, 0], (1500, 1200), window.tolist()),
        "fill": {"type": "constant", "radiance": {"type": "rgb", "value": [0.30, 0.31, 0.33]}},
    }
    return mi.load_dict(scene | shapes)


class Studio:
    """Takes the photos of one seed."""

    def __init__(self, seed: int):
        self.seed, self.camera, self.places = seed, shots.camera(seed), shots.places(seed)
        self.scene = build(seed, self.camera)
        self.params = mi.traverse(self.scene)
        self.light = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 3})
        self.guides = mi.load_dict({"type": "aov", "aovs": "alb:albedo,nn:sh_normal"})
        self.maps = undistortion_maps(self.camera, FILM)

    def photo(self, index: int) -> tuple[np.ndarray, float]:
        """The finished BGR picture (H,W,3) uint8 and the exposure, 1 is the usual one."""
        rng = np.random.default_rng((self.seed, 6, index))
        gain, focus = np.exp(rng.normal(0, 0.13)), 1.0 + rng.normal(0, 0.03)
        pose = self.places[index]
        self.params["sensor.to_world"] = to_world(pose)
        self.params["sensor.focus_distance"] = float(pose[2, 3] * focus)
        self.params.update()
        noise, color = (self.seed * shots.PHOTOS + index) * (PASSES + 1), 0.0
        for k in range(PASSES):
            color = color + np.array(mi.render(self.scene, integrator=self.light, spp=SAMPLES, seed=noise + k)) / PASSES
        guide = np.array(mi.render(self.scene, integrator=self.guides, spp=SAMPLES, seed=noise + PASSES))
        linear = cv2.remap(denoise(color, guide), *self.maps, cv2.INTER_CUBIC)
        return develop(linear, gain * EXPOSURE, rng), gain
