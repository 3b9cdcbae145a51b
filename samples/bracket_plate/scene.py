"""The Mitsuba scene: the as-built part on a cluttered bench, and one rendered, developed frame of it.

Needs Mitsuba 3 (variant llvm_ad_rgb: apt libllvm19 libatomic1) and mitsuba-oidn. Lengths in mm.
"""

from __future__ import annotations

import json
from pathlib import Path

import assembly
import cv2
import mitsuba as mi
import motion
import numpy as np
import textures as tx
from rendering import denoise, develop, lamp, matte, mesh, page, sensor, steel, to_world, undistortion_maps
from solids import tessellated

SEED = 20261
SHUTTER = 0.4  # of the frame interval
MARGIN_FILM = (1336, 756)  # undistorted picture that the distorted one is sampled from
APERTURE_MM = 1.1
SAMPLES = 4  # path samples per pixel and frame, shared by the sub-frames (at least 1 each)
EXPOSURE = 1.3

# As-built displacement of the displaced components: translation (mm) and tilt about an axis of their own (deg).
AS_BUILT = {
    "post_1": {"translation_mm": [1.1, -0.7, 0.0], "tilt_deg": 0.0},
    "nut_1": {"translation_mm": [0.4, 0.3, 0.0], "tilt_deg": 0.0},
    "bracket_1": {"translation_mm": [0.0, 0.0, 0.0], "tilt_deg": 0.5},
}
# The bracket tilts about the line where its wall meets the plate: through this point, along this direction.
BRACKET_PIVOT = np.array([-46.0, 26.0, 0.0])
BRACKET_AXIS = np.array([np.cos(np.deg2rad(-20.0)), np.sin(np.deg2rad(-20.0)), 0.0])


def measured_from_nominal(name: str):
    """(4,4) as-built displacement of a component in the model frame."""
    moved = AS_BUILT.get(name)
    pose = np.eye(4)
    if moved is None:
        return pose
    if moved["tilt_deg"]:
        rotation, _ = cv2.Rodrigues(BRACKET_AXIS * np.deg2rad(moved["tilt_deg"]))
        pose[:3, :3] = rotation
        pose[:3, 3] = BRACKET_PIVOT - rotation @ BRACKET_PIVOT
    pose[:3, 3] += moved["translation_mm"]
    return pose


def component_meshes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Finely tessellated components at their nominal place: name → vertices, faces."""
    return tessellated(assembly.components())


def as_built_meshes():
    meshes = {}
    for name, (vertices, faces) in component_meshes().items():
        pose = measured_from_nominal(name)
        meshes[name] = vertices @ pose[:3, :3].T + pose[:3, 3], faces
    return meshes


def _part(shapes, rng):
    """The as-built part with its weld beads."""
    plate = tx.mill_scale(1000, 1350, rng)
    plate_color = plate[0]
    chalk = np.zeros(plate_color.shape[:2], np.uint8)
    # Texture rows run with v upwards flipped by Mitsuba: row 0 is the largest v.
    for text, u, v, size in (("BP-0417", 0.10, 0.80, 1.0), ("7", 0.53, 0.90, 1.5)):
        cv2.putText(chalk, text, (int(u * 1350), int(v * 1000)), cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, size, 255, 3)
    dust = (chalk / 255.0) * (0.35 + 0.6 * tx.fft_noise(*chalk.shape, 0.6, rng))
    plate_color[:] = plate_color + (0.72 - plate_color) * dust[..., None]
    tile = (240.0, 240.0)
    finishes = {
        "machined": steel(tx.machined(1024, 1024, rng), 0.85, 0.012),
        "blued": steel(tx.blued(1024, 1024, rng), 0.45, 0.02),
        "zinc": steel(tx.zinc(1024, 1024, rng), 0.85, 0.012),
    }
    kind = {"rib_1": "blued", "bracket_1": "blued", "lug_1": "blued", "nut_1": "zinc", "nut_2": "zinc"}
    bead = steel(tx.mill_scale(256, 256, rng), 0.7, 0.01)
    bright = tx.machined(256, 256, rng)
    bead = steel((bright[0] * (0.62, 0.56, 0.46), bright[1], bright[2]), 0.8, 0.01)
    for name, (vertices, faces) in as_built_meshes().items():
        if name == "base_plate":
            surface = steel(plate, 0.5, 0.03)
            shapes[name] = mesh(name, vertices, faces, surface, (240.0, 178.0), (120.0, 89.0))
            continue
        offset = rng.uniform(0, 240, 2)
        shapes[name] = mesh(name, vertices, faces, finishes[kind.get(name, "machined")], tile, offset)
        weld = tx.weld_bead(vertices, faces, rng)
        shapes[name + "_weld"] = mesh(name + "_weld", *weld, bead, (30.0, 30.0), offset, 60.0)


def _clutter(shapes, rng):
    """Bench, walls and clutter around the part."""
    floor = -10.0
    plain = component_meshes()

    def add(name, geometry, surface, tile=(200.0, 200.0), crease=35.0):
        shapes[name] = mesh(name, *geometry, surface, tile, rng.uniform(0, 200, 2), crease)

    def paint(tint, wear=0.25, rough=0.45):
        return matte(tx.painted(256, 256, rng, tint, wear), rough)

    bench = tx.bench_top(2000, 1500, 2.4, rng, "BP fixture 2")
    shapes["bench"] = mesh(
        "bench", *tx.box((2000, 1500, 30), (0, 0, floor - 15)), steel(bench, 0.35),
        (2000.0, 1500.0), (1000.0, 750.0),
    )  # fmt: skip
    wall = tx.painted(1024, 1024, rng, (0.46, 0.48, 0.47), 0.12)
    shapes["wall_x"] = mesh("wall_x", *tx.box((20, 5000, 3000), (1500, 0, 300)), matte(wall), (3000.0, 3000.0))
    shapes["wall_y"] = mesh("wall_y", *tx.box((5000, 20, 3000), (0, 1500, 300)), matte(wall), (3100.0, 2900.0))
    bright = steel(tx.machined(512, 512, rng), 0.85, 0.012)
    dark = steel(tx.mill_scale(512, 512, rng), 0.5, 0.03)
    nut = plain["nut_1"][0] * (1, 1, 1) - (-66, -38, 0)
    post = plain["post_2"][0] - (-12, -50, 0)
    for k, (x, y) in enumerate([(158, 62), (176, 88), (-135, -118), (305, -150), (-250, 60)]):
        turn = tx.turn_z(rng.uniform(0, 60))
        add(f"loose_nut_{k}", (nut @ turn.T + (x, y, floor), plain["nut_1"][1]), bright)
    for k, (x, y) in enumerate([(196, -30), (-190, 128), (62, 228)]):
        lying = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]) if k else np.eye(3)
        lifted = floor + (9.0 if k else 0.0)
        geometry = (post @ lying.T @ tx.turn_z(50 * k + 20).T + (x, y, lifted), plain["post_2"][1])
        add(f"loose_post_{k}", geometry, bright)
    for k in range(12):
        x, y = rng.uniform(-480, 620), rng.uniform(-420, 480)
        if abs(x) < 175 and abs(y) < 140:
            x += 330
        turn = tx.turn_z(rng.uniform(0, 360))
        screw = tx.revolve([(0, 26), (3, 26), (3, 0), (5.2, 0), (5.2, -6), (0, -6)], 20)
        screw = (screw[0] @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]]).T @ turn.T, screw[1])
        add(f"screw_{k}", (screw[0] + (x, y, floor + 4.5), screw[1]), bright if k % 3 else dark)
    cup = [(0, 3), (36, 3), (38, 95), (41, 95), (39, 0), (0, 0)]
    add("cup", tx.revolve(cup, 64, (-72, 262, floor)), paint((0.03, 0.13, 0.55)))
    bottle = [(0, 0), (32, 0), (32, 120), (26, 140), (14, 152), (14, 175), (0, 175)]
    add("bottle", tx.revolve(bottle, 64, (330, 205, floor)), paint((0.75, 0.50, 0.03)), crease=50)
    roll = [(26, 0), (44, 0), (44, 24), (26, 24), (26, 0)]
    add("tape_roll", tx.revolve(roll, 64, (170, 178, floor)), paint((0.60, 0.42, 0.20)))
    # Size, position, rotation and colour of boxes on the bench.
    things = [
        ((44, 22, 18), 212, 20, 35, (0.62, 0.04, 0.03)),
        ((52, 26, 22), -206, -40, 20, (0.04, 0.16, 0.55)),
        ((22, 22, 22), -190, -215, 10, (0.05, 0.42, 0.10)),
        ((60, 34, 26), 128, -196, -25, (0.60, 0.10, 0.04)),
        ((300, 150, 120), 560, 210, 18, (0.55, 0.04, 0.03)),
        ((160, 120, 90), 470, -30, -12, (0.08, 0.09, 0.10)),
        ((90, 60, 70), 640, -160, 30, (0.75, 0.48, 0.05)),
        ((120, 80, 60), -330, 330, -20, (0.10, 0.30, 0.16)),
        ((240, 12, 16), -10, 172, 8, (0.20, 0.20, 0.21)),
        ((70, 200, 40), 780, 20, 8, (0.05, 0.20, 0.50)),
        ((26, 14, 12), 60, -160, 60, (0.85, 0.75, 0.10)),
    ]
    for k, (size, x, y, turn, tint) in enumerate(things):
        add(f"thing_{k}", tx.box(size, (x, y, floor + size[2] / 2), turn), paint(tint))
    carton = matte(tx.printed_sheet(700, 900, rng, "FRAGILE 24 pcs", (0.42, 0.27, 0.14)), 0.7)
    add("carton", tx.box((320, 220, 190), (190, 470, floor + 95), -14), carton, (330.0, 260.0))
    add("carton_2", tx.box((220, 260, 150), (900, -260, floor + 75), 25), carton, (330.0, 260.0))
    shelf = paint((0.25, 0.26, 0.28))
    add("shelf", tx.box((200, 1800, 20), (1390, 0, 330)), shelf)
    for k in range(7):
        size = rng.uniform((80, 90, 80), (160, 210, 240))
        at = (1380, -720 + 235 * k, 340 + size[2] / 2)
        add(f"shelf_box_{k}", tx.box(size, at, rng.uniform(-10, 10)), paint(rng.uniform(0.03, 0.6, 3)))
    for k, (x, y, turn, title) in enumerate([
        (-292, 152, 24, "Work order 0417"), (215, -215, -18, "Weld plan BP"), (560, 40, 65, "Checklist")
    ]):  # fmt: skip
        sheet = matte(tx.printed_sheet(1100, 780, rng, title), 0.75)
        shapes[f"sheet_{k}"] = page(f"sheet_{k}", sheet, (148, 210), (x, y, floor + 0.4), turn)
    s = np.linspace(0, 1, 120)
    cable = np.column_stack([-420 + 330 * s, -330 + 190 * np.sin(2.2 * s) + 30 * np.sin(11 * s), floor + 4 + 0 * s])
    add("cable_green", tx.sweep(cable, 4.0, 12), matte((0.03, 0.33, 0.09), 0.35), crease=60)
    cable = np.column_stack([140 + 620 * s, 120 + 190 * s**2 + 40 * np.sin(7 * s), floor + 5 + 0 * s])
    add("cable_black", tx.sweep(cable, 5.0, 12), matte((0.02, 0.02, 0.022), 0.4), crease=60)
    add(
        "driver_shaft",
        tx.sweep([(-60, -188, -2), (-20, -176, -2), (20, -164, -2)], 3.0, 12),
        bright,
        crease=60,
    )
    handle = tx.sweep([(20, -164, 1), (24, -162.8, 1), (80, -146, 1), (118, -134.6, 1), (122, -133, 1)],
                      np.array([5, 10, 11, 11, 7.0]), 20)  # fmt: skip
    add("driver_handle", handle, paint((0.75, 0.25, 0.02)), crease=60)


def _occluders(shapes, rng):
    vertices, faces = tx.hand()
    skin = tx.painted(512, 512, rng, (0.56, 0.33, 0.235), 0.03)
    blush = tx.fft_noise(512, 512, 1.2, rng)[..., None]
    skin = skin * (1.0 + (np.array((1.06, 0.86, 0.82)) - 1.0) * blush)
    shapes["hand"] = mesh("hand", vertices, faces, matte(skin, 0.5, 0.45), (300.0, 300.0), (0, 0), 80.0)
    board = matte(tx.printed_sheet(760, 1000, rng, "CELL 3 - SETUP SHEET", (0.47, 0.33, 0.19)), 0.8)
    shapes["card"] = mesh("card", *tx.box((250, 190, 3)), board, (250.0, 190.0), (125.0, 95.0))


def build(width_height=MARGIN_FILM, focal_px=1130.0):
    """The scene as a Mitsuba object, with the resting vertices of hand and card."""
    rng = np.random.default_rng(SEED)
    shapes: dict[str, object] = {}
    _part(shapes, rng)
    _clutter(shapes, rng)
    _occluders(shapes, rng)

    scene = {
        "type": "scene",
        "sensor": sensor(width_height, focal_px, APERTURE_MM, 505.0),
        "strip_1": lamp([-350, 250, 1750], [-300, 200, 0], (1500, 260), [10.5, 10.3, 9.8]),
        "strip_2": lamp([600, -250, 1750], [550, -200, 0], (1500, 260), [9.0, 8.9, 8.6]),
        "window": lamp([-1700, 300, 900], [0, 0, 0], (1500, 1200), [3.2, 3.6, 4.3]),
        "fill": {"type": "constant", "radiance": {"type": "rgb", "value": [0.30, 0.31, 0.33]}},
    }  # fmt: skip
    scene.update(shapes)
    return mi.load_dict(scene)


class Shot:
    """Renders frames of the moving camera and occluders from the loaded scene."""

    def __init__(self, camera: dict):
        self.camera = camera
        self.scene = build(focal_px=camera["fx"])
        self.params = mi.traverse(self.scene)
        # Two passes take half the time of one in which the AOV integrator wraps the path tracer.
        self.light = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 3})
        self.guides = mi.load_dict({"type": "aov", "aovs": "alb:albedo,nn:sh_normal"})
        self.rest = {}
        for name in ("hand", "card"):
            vertices = np.array(self.params[f"{name}.vertex_positions"]).reshape(-1, 3)
            self.rest[name] = vertices, np.array(self.params[f"{name}.vertex_normals"]).reshape(-1, 3)
        self.maps = undistortion_maps(camera, MARGIN_FILM)

    def pose_all(self, t: float) -> None:
        """Set the poses of camera and occluders at time ``t`` (frames)."""
        cam_from_model = motion.cam_from_model(t)
        place_occluders(self.params, self.rest, t)
        self.params["sensor.to_world"] = to_world(cam_from_model)
        self.params.update()

    def linear(self, index: int) -> np.ndarray:
        """Linear RGB (H,W,3) of the distorted picture of frame ``index``, denoised, with motion blur."""
        steps = subframes(self.camera, index)
        samples = max(SAMPLES // steps, 1)
        color, guide = 0.0, 0.0
        for k in range(steps):
            self.pose_all(index + SHUTTER * ((k + 0.5) / steps - 0.5))
            seed = SEED + index * 64 + k
            color = color + np.array(mi.render(self.scene, integrator=self.light, spp=samples, seed=seed)) / steps
            seed += 1 << 20
            guide = guide + np.array(mi.render(self.scene, integrator=self.guides, spp=2, seed=seed)) / steps
        return cv2.remap(denoise(color, guide), *self.maps, cv2.INTER_CUBIC)

    def frame(self, index: int) -> np.ndarray:
        """The finished BGR picture (H,W,3) uint8 of frame ``index``."""
        gain = motion.exposure_gain(index) * EXPOSURE
        return develop(self.linear(index), gain, np.random.default_rng(SEED + 7919 * index))


def place_occluders(params, rest, t: float) -> None:
    """Move hand and card to their poses at time ``t``, or far below the floor when they are away."""
    card = motion.card_in_cam(t)
    model_from_cam = np.linalg.inv(motion.cam_from_model(t))
    poses = {"hand": motion.hand_in_model(t), "card": None if card is None else model_from_cam @ card}
    for name, pose in poses.items():
        if pose is None:
            pose = np.eye(4)
            pose[:3, 3] = (0, 0, -3000)
        vertices, normals = rest[name]
        moved = vertices @ pose[:3, :3].T + pose[:3, 3]
        params[f"{name}.vertex_positions"] = mi.Float(moved.reshape(-1).astype(np.float32))
        turned = normals @ pose[:3, :3].T
        params[f"{name}.vertex_normals"] = mi.Float(turned.reshape(-1).astype(np.float32))


class Sight:
    """Measures the visible share of the part's silhouette in a frame by rays."""

    def __init__(self, camera: dict, rays: int = 240):
        self.camera = camera
        plain = matte((0.5, 0.5, 0.5))
        part = {name: mesh(name, *geometry, plain) for name, geometry in as_built_meshes().items()}
        self.part = mi.load_dict({"type": "scene", **part})
        hiding = {"hand": tx.hand(), "card": tx.box((250, 190, 3))}
        hiding = {name: mesh(name, *geometry, plain) for name, geometry in hiding.items()}
        self.hiding = mi.load_dict({"type": "scene", **hiding})
        self.params = mi.traverse(self.hiding)
        self.rest = {}
        for name in hiding:
            vertices = np.array(self.params[f"{name}.vertex_positions"]).reshape(-1, 3)
            self.rest[name] = vertices, np.array(self.params[f"{name}.vertex_normals"]).reshape(-1, 3)
        self.slopes = (np.arange(rays) + 0.5) / rays * 0.8 - 0.4

    def visible(self, index: int) -> dict[str, float]:
        """Shares of the silhouette inside the picture (``in_picture``), and also not occluded (``visible``)."""
        place_occluders(self.params, self.rest, index)
        self.params.update()
        cam_from_model = motion.cam_from_model(index)
        position = np.linalg.inv(cam_from_model)[:3, 3]
        ahead = motion.CENTER - position
        ahead /= np.linalg.norm(ahead)
        side = np.cross(ahead, (0, 0, 1.0))
        side /= np.linalg.norm(side)
        a, b = np.meshgrid(self.slopes, self.slopes)
        direction = ahead + a.reshape(-1, 1) * side + b.reshape(-1, 1) * np.cross(side, ahead)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(*(float(x) for x in position)), mi.Vector3f(*direction.T.astype(np.float32)))
        to_part = np.array(self.part.ray_intersect_preliminary(ray).t)
        to_hiding = np.array(self.hiding.ray_intersect_preliminary(ray).t)
        on_part = np.isfinite(to_part)
        in_cam = direction @ cam_from_model[:3, :3].T
        camera = self.camera
        matrix = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
        pixel, _ = cv2.projectPoints(in_cam, np.zeros(3), np.zeros(3), matrix, np.array(camera["dist"]))
        edge = np.array((camera["width"] - 0.5, camera["height"] - 0.5))
        inside = (in_cam[:, 2] > 0) & np.all((pixel[:, 0] > -0.5) & (pixel[:, 0] < edge), axis=1)
        shown = on_part & inside
        seen = shown & (to_part < to_hiding)
        return {"in_picture": shown.sum() / on_part.sum(), "visible": seen.sum() / on_part.sum()}


def subframes(camera: dict, index: int) -> int:
    """Number of sub-frames, so that picture and card move by at most about 3 px between two of them.

    (The hand may move 7 px: it is soft enough for that.)
    """
    times = (index - SHUTTER / 2, index + SHUTTER / 2)
    before, after = (motion.cam_from_model(t)[:3, :3] for t in times)
    flow_px = np.arccos(np.clip((np.trace(after @ before.T) - 1) / 2, -1, 1)) * camera["fx"]
    cards = [card[:3, 3] for card in map(motion.card_in_cam, times) if card is not None]
    if len(cards) == 2:
        flow_px = max(flow_px, np.linalg.norm(cards[1] - cards[0]) / cards[0][2] * camera["fx"])
    return next((n for n in (2, 4) if n >= flow_px / 3), 8)


def load_camera(folder: Path) -> dict:
    return json.loads((folder / "camera.json").read_text())
