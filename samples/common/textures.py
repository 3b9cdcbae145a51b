"""Procedural textures and meshes, from random numbers of a seed.

Noise has a 1/f spectrum over the whole texture, so that nothing repeats on the bench or on the part:
repeated structure is what leads reconstructions astray.
"""

from __future__ import annotations

import cv2
import numpy as np


def fft_noise(height: int, width: int, slope: float, rng: np.random.Generator, stretch: float = 1.0):
    """Noise (H, W) in 0–1 with amplitude ~ f^-slope; ``stretch`` > 1 draws it out along x."""
    fy = np.fft.fftfreq(height)[:, None] * height
    fx = np.fft.rfftfreq(width)[None] * width * (height / width) * stretch
    frequency = np.sqrt(fx**2 + fy**2)
    frequency[0, 0] = 1.0
    phase = rng.uniform(0, 2 * np.pi, frequency.shape)
    noise = np.fft.irfft2(frequency**-slope * np.exp(1j * phase), s=(height, width))
    noise = (noise - noise.mean()) / noise.std()
    return np.clip(0.5 + noise / 5.0, 0.0, 1.0)


def smoothstep(x, low, high):
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def scratches(height: int, width: int, count: int, rng, length=(20, 220), turn=np.pi):
    """Thin bright lines (H, W) in 0–1."""
    layer = np.zeros((height, width), np.uint8)
    for _ in range(count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        angle, size = rng.uniform(0, turn), rng.uniform(*length)
        bend = rng.normal(0, 0.08)
        points = [(x, y)]
        for _ in range(5):
            x, y = x + size / 5 * np.cos(angle), y + size / 5 * np.sin(angle)
            angle += bend
            points.append((x, y))
        line = np.round(np.array(points) * 16).astype(np.int32)
        cv2.polylines(layer, [line], False, int(rng.uniform(60, 255)), 1, cv2.LINE_AA, 4)
    return layer.astype(np.float64) / 255.0


def specks(height: int, width: int, size_px: float, rng):
    """Scattered spots (H, W) in 0–1 of about a given size, on some 5 % of the area."""
    noise = rng.normal(size=(height, width)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), size_px)
    return smoothstep(noise / noise.std(), 1.5, 2.1)


def _mix(a, b, weight):
    return a + (np.asarray(b, dtype=np.float64) - a) * weight[..., None]


def mill_scale(height: int, width: int, rng):
    """Dark rolled steel: clouds, flaked scale, rust, scratches. Color (H,W,3), roughness, bump (H,W)."""
    cloud = fft_noise(height, width, 1.3, rng)
    grain = fft_noise(height, width, 0.5, rng)
    flake = smoothstep(fft_noise(height, width, 1.0, rng), 0.60, 0.68)
    rust = smoothstep(fft_noise(height, width, 1.25, rng), 0.76, 0.86) * smoothstep(grain, 0.3, 0.6)
    lines = scratches(height, width, height * width // 9000, rng)
    color = np.ones((height, width, 3)) * (0.075, 0.082, 0.096)
    color = color * (0.55 + 0.9 * cloud + 0.55 * (grain - 0.5))[..., None]
    color = _mix(color, (0.21, 0.215, 0.225), 0.55 * flake)
    color = _mix(color, (0.27, 0.095, 0.035), 0.8 * rust)
    color = _mix(color, (0.42, 0.42, 0.42), 0.6 * lines)
    rough = np.clip(0.42 + 0.25 * (cloud - 0.5) + 0.35 * rust - 0.08 * flake + 0.1 * grain, 0.2, 0.9)
    bump = 0.5 * grain + 0.4 * flake + 0.5 * rust - 0.6 * lines
    return color, rough, bump


def machined(height: int, width: int, rng):
    """Bright turned or ground steel with grinding lines, stains and handling marks."""
    lines = fft_noise(height, width, 0.55, rng, stretch=14.0)
    cloud = fft_noise(height, width, 1.3, rng)
    grain = fft_noise(height, width, 0.5, rng)
    stain = smoothstep(fft_noise(height, width, 1.2, rng), 0.58, 0.74)
    marks = scratches(height, width, height * width // 6000, rng)
    color = np.ones((height, width, 3)) * (0.43, 0.425, 0.41)
    color = color * (0.62 + 0.5 * cloud + 0.5 * (lines - 0.5) + 0.35 * (grain - 0.5))[..., None]
    color = _mix(color, (0.19, 0.165, 0.14), 0.55 * stain)
    color = _mix(color, (0.65, 0.65, 0.64), 0.5 * marks)
    rough = np.clip(0.3 + 0.3 * (lines - 0.5) + 0.25 * stain, 0.16, 0.8)
    return color, rough, 0.6 * lines + 0.3 * grain - 0.5 * marks


def blued(height: int, width: int, rng):
    """Blue-grey painted or blued sheet steel, worn."""
    color, rough, bump = mill_scale(height, width, rng)
    worn = smoothstep(fft_noise(height, width, 1.1, rng), 0.62, 0.72)
    cloud = fft_noise(height, width, 1.2, rng)
    color = color * 0.4 + np.array((0.085, 0.115, 0.165)) * (0.6 + 0.8 * cloud)[..., None]
    color = _mix(color, (0.36, 0.36, 0.35), 0.6 * worn)
    return color, rough, bump


def zinc(height: int, width: int, rng):
    """Yellow-passivated zinc, the colour of standard nuts."""
    color, rough, bump = machined(height, width, rng)
    tint = fft_noise(height, width, 1.1, rng)
    color = color * _mix(np.ones((height, width, 3)) * (1.05, 0.92, 0.62), (0.95, 0.8, 0.75), tint)
    return color, rough, bump


def cast(height: int, width: int, rng):
    """Sand-cast grey iron, blasted: one grey with the fine grain of the mould, and hardly anything else."""
    cloud = fft_noise(height, width, 1.4, rng)
    grain = fft_noise(height, width, 0.25, rng)
    color = np.ones((height, width, 3)) * (0.235, 0.237, 0.238)
    color = color * (0.95 + 0.1 * cloud + 0.12 * (grain - 0.5))[..., None]
    return color, np.clip(0.62 + 0.1 * (grain - 0.5), 0.3, 0.9), grain


def coat(height: int, width: int, rng, tint):
    """Fresh paint of one colour, with a little orange peel and dust: nearly without texture."""
    cloud = fft_noise(height, width, 1.5, rng)
    peel = fft_noise(height, width, 0.8, rng)
    dust = specks(height, width, 0.8, rng) * smoothstep(fft_noise(height, width, 0.9, rng), 0.62, 0.8)
    color = np.ones((height, width, 3)) * np.asarray(tint) * (0.985 + 0.03 * cloud)[..., None]
    color = _mix(color, (0.5, 0.49, 0.46), 0.12 * dust)
    return color, np.clip(0.3 + 0.12 * cloud + 0.1 * dust, 0.15, 0.8), 0.4 * peel


def chrome(height: int, width: int, rng):
    """Bright plating: a mirror with a few fine marks."""
    cloud = fft_noise(height, width, 1.3, rng)
    marks = scratches(height, width, height * width // 20000, rng)
    color = np.ones((height, width, 3)) * (0.62, 0.63, 0.64)
    color = _mix(color, (0.5, 0.5, 0.5), 0.3 * marks)
    return color, np.clip(0.1 + 0.08 * cloud + 0.1 * marks, 0.06, 0.4), -0.3 * marks


def rust(height: int, width: int, rng):
    """Steel that stood in the rain: brown and orange all over, with pits."""
    color, rough, bump = mill_scale(height, width, rng)
    red = smoothstep(fft_noise(height, width, 1.1, rng), 0.30, 0.52)
    grain = fft_noise(height, width, 0.5, rng)
    color = _mix(color, (0.17, 0.07, 0.03), red)
    color = _mix(color, (0.33, 0.13, 0.04), red * smoothstep(grain, 0.48, 0.62))
    return color, np.clip(rough + 0.4 * red, 0.3, 0.95), bump + 0.6 * grain * red


def _drilled(color, rough, px_per_mm: float, rng):
    """A breadboard's 25 mm grid of holes with bright rims."""
    height, width = rough.shape
    holes = np.zeros((height, width), np.uint8)
    rims = np.zeros((height, width), np.uint8)
    for j in range(int(height / px_per_mm // 25)):
        for i in range(int(width / px_per_mm // 25)):
            x = (12.5 + 25 * i + rng.normal(0, 0.05)) * px_per_mm
            y = (12.5 + 25 * j + rng.normal(0, 0.05)) * px_per_mm
            center = (round(x * 16), round(y * 16))
            cv2.circle(rims, center, round(4.1 * px_per_mm * 16), int(rng.uniform(90, 255)), -1, cv2.LINE_AA, 4)
            cv2.circle(holes, center, round(3.2 * px_per_mm * 16), 255, -1, cv2.LINE_AA, 4)
    color = _mix(color, (0.66, 0.66, 0.66), 0.45 * rims / 255.0)
    color = _mix(color, (0.012, 0.012, 0.013), holes / 255.0)
    return color, np.maximum(rough, holes / 255.0)


def bench_top(width_mm: float, depth_mm: float, px_per_mm: float, rng, stamp: str, holes: bool = True):
    """Worn aluminium bench, with ``holes`` a breadboard's 25 mm grid of them; color, roughness, bump."""
    height, width = int(depth_mm * px_per_mm), int(width_mm * px_per_mm)
    cloud = fft_noise(height, width, 1.35, rng)
    grain = fft_noise(height, width, 0.5, rng)
    stain = smoothstep(fft_noise(height, width, 1.25, rng), 0.60, 0.72)
    dirt = smoothstep(fft_noise(height, width, 1.1, rng), 0.68, 0.82)
    lines = scratches(height, width, 1800, rng, length=(30, 500))
    color = np.ones((height, width, 3)) * (0.50, 0.51, 0.52)
    color = color * (0.62 + 0.55 * cloud + 0.45 * (grain - 0.5))[..., None]
    color = _mix(color, (0.33, 0.30, 0.26), 0.4 * stain)
    color = _mix(color, (0.16, 0.15, 0.14), 0.6 * dirt)
    color = _mix(color, (0.68, 0.68, 0.68), 0.5 * lines)
    rough = np.clip(0.40 + 0.3 * (cloud - 0.5) + 0.15 * stain + 0.1 * grain, 0.2, 0.9)
    bump = 0.4 * grain - 0.5 * lines
    if holes:
        color, rough = _drilled(color, rough, px_per_mm, rng)
    # A felt-tip note and a strip of old tape, so that places of the bench can be distinguished.
    note = np.zeros((height, width), np.uint8)
    spots = [(0.36, 0.43), (0.62, 0.36), (0.70, 0.62), (0.27, 0.66)]
    for (u, v), text in zip(spots, (stamp, "do not move!", "M6x25", "CELL 3"), strict=True):
        at = (int(u * width), int(v * height))
        cv2.putText(note, text, at, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, 2.1, 255, 4, cv2.LINE_AA)
    color = _mix(color, (0.03, 0.05, 0.16), 0.85 * note / 255.0)
    tape = np.zeros((height, width), np.uint8)
    corner = np.array([[0.58, 0.70], [0.80, 0.64], [0.803, 0.668], [0.583, 0.729]]) * (width, height)
    cv2.fillPoly(tape, [corner.astype(np.int32)], 255)
    color = _mix(color, (0.55, 0.47, 0.16), (tape / 255.0) * (0.55 + 0.4 * smoothstep(cloud, 0.3, 0.6)))
    return color, rough, bump


def painted(height: int, width: int, rng, tint, wear: float = 0.25):
    """A painted or plastic surface of one colour, soiled."""
    cloud = fft_noise(height, width, 1.3, rng)
    grain = fft_noise(height, width, 0.6, rng)
    dirt = smoothstep(fft_noise(height, width, 1.1, rng), 0.66, 0.86)
    color = np.ones((height, width, 3)) * np.asarray(tint)
    color = color * (0.75 + 0.4 * cloud + 0.2 * (grain - 0.5))[..., None]
    return _mix(color, (0.06, 0.055, 0.05), wear * 2 * dirt)


def printed_sheet(height: int, width: int, rng, title: str, tint=(0.78, 0.77, 0.74)):
    """Paper or cardboard with a title, lines of text of random words, a table and a small drawing."""
    page = np.zeros((height, width), np.uint8)
    letters = np.array(list("abcdefghijklmnoprstuvwz0123456789"))
    margin = int(0.07 * width)
    cv2.putText(page, title, (margin, int(0.09 * height)), 0, width / 520, 255, 3, cv2.LINE_AA)
    y = int(0.15 * height)
    while y < 0.55 * height:
        text = " ".join("".join(rng.choice(letters, rng.integers(2, 9))) for _ in range(9))
        count = int(rng.uniform(0.5, 1.0) * 46)
        cv2.putText(page, text[:count], (margin, y), 0, width / 1250, 230, 1, cv2.LINE_AA)
        y += int(0.028 * height)
    for _ in range(9):
        y += int(0.034 * height)
        cv2.line(page, (margin, y), (width - margin, y), 150, 1)
        cv2.putText(page, f"{rng.uniform(0, 99):.2f}", (width // 2, y - 3), 0, width / 1250, 230, 1, cv2.LINE_AA)
    cv2.circle(page, (int(0.28 * width), int(0.80 * height)), int(0.09 * width), 200, 2, cv2.LINE_AA)
    paper = np.ones((height, width, 3)) * np.asarray(tint)
    paper = paper * (0.86 + 0.25 * fft_noise(height, width, 1.2, rng))[..., None]
    return _mix(paper, (0.04, 0.04, 0.05), page / 255.0)


# ---------------------------------------------------------------- meshes: (vertices (V,3), faces (F,3)), mm


def box(size, center=(0, 0, 0), turn_deg=0.0):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.asarray(size) / 2
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    return corners @ turn_z(turn_deg).T + np.asarray(center), faces


def turn_z(angle_deg: float):
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def revolve(profile, segments: int = 64, center=(0, 0, 0)):
    """Surface of revolution about Z of (N,2) points (radius, height)."""
    profile = np.asarray(profile, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([ring * r, np.full(segments, z)]) for r, z in profile])
    faces = []
    for k in range(len(profile) - 1):
        i = np.arange(segments)
        a, b = k * segments + i, k * segments + (i + 1) % segments
        faces += [np.column_stack([a, b, b + segments]), np.column_stack([a, b + segments, a + segments])]
    return vertices + np.asarray(center), np.concatenate(faces)


def sweep(path, radius, sides: int = 10):
    """Tube along a polyline (N,3); radius a number or (N,)."""
    path = np.asarray(path, dtype=np.float64)
    radius = np.broadcast_to(radius, len(path))
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, (0.03, 0.02, 1.0))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    vertices = (path[:, None] + ring * radius[:, None, None]).reshape(-1, 3)
    faces = []
    for k in range(len(path) - 1):
        i = np.arange(sides)
        a, b = k * sides + i, k * sides + (i + 1) % sides
        faces += [np.column_stack([a, b + sides, b]), np.column_stack([a, a + sides, b + sides])]
    return vertices, np.concatenate(faces)


def join(*meshes):
    vertices, faces, offset = [], [], 0
    for v, f in meshes:
        vertices.append(v)
        faces.append(f + offset)
        offset += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def hand(rng_seed: int = 5):
    """A right hand with forearm, palm down, fingers along +Y, wrist near the origin; mm.

    Rounded cones merged by a smooth minimum and turned into triangles by marching cubes.
    """
    from scipy.spatial.transform import Rotation
    from skimage.measure import marching_cubes

    bones = [((0, -260, 30), (0, -20, 2), 36, 27), ((-22, 0, 0), (-26, 70, 0), 17, 16)]
    bones += [((0, 0, 0), (0, 72, 2), 18, 16), ((22, 0, 0), (26, 66, 0), 17, 15)]
    for x, reach, spread, r in ((-29, 72, -10, 10), (-9, 84, -2, 10.5), (11, 78, 5, 10), (30, 58, 14, 8.8)):
        lean = np.tan(np.deg2rad(spread))
        root = np.array((x, 74.0, 2.0))
        knuckle = root + np.array((lean * reach * 0.5, reach * 0.5, 6.0))
        tip = knuckle + np.array((lean * reach * 0.5, reach * 0.46, -12.0))
        bones += [(root, knuckle, r, r * 0.92), (knuckle, tip, r * 0.92, r * 0.78)]
    bones += [((-26, 12, -3), (-56, 42, -10), 15, 12), ((-56, 42, -10), (-66, 74, -14), 12, 9.5)]
    low, high, step = np.array((-90, -300, -45)), np.array((75, 185, 80)), 2.5
    grid = np.stack(np.meshgrid(*[np.arange(a, b, step) for a, b in zip(low, high, strict=True)],
                                indexing="ij"), axis=-1)  # fmt: skip
    field = np.zeros(grid.shape[:3])
    for a, b, ra, rb in bones:
        a, b = np.asarray(a, float), np.asarray(b, float)
        t = np.clip(((grid - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
        distance = np.linalg.norm(grid - a - t[..., None] * (b - a), axis=-1) - (ra + (rb - ra) * t)
        field += np.exp(-np.clip(distance, -40, 60) / 3.5)
    vertices, faces, _, _ = marching_cubes(-np.log(np.maximum(field, 1e-12)) * 3.5, 0.0)
    vertices = vertices * step + low
    return vertices @ Rotation.from_euler("x", -8, degrees=True).as_matrix().T, faces


def weld_bead(vertices, faces, rng):
    """Weld beads around the footprint on z = 0 of an as-built component: (vertices, faces)."""
    vertices = np.asarray(vertices)
    merged, index = np.unique(np.round(vertices, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    bottom = faces[np.all(merged[faces][:, :, 2] < 0.35, axis=1)]
    count: dict[tuple[int, int], int] = {}
    for a, b, c in bottom:
        for edge in ((a, b), (b, c), (c, a)):
            key = (min(edge), max(edge))
            count[key] = count.get(key, 0) + 1
    follow: dict[int, list[int]] = {}
    for (a, b), times in count.items():
        if times == 1:
            follow.setdefault(a, []).append(b)
            follow.setdefault(b, []).append(a)
    loops = []
    while follow:
        start = next(iter(follow))
        loop, at = [start], start
        while follow.get(at):
            step = follow[at].pop()
            follow[step].remove(at)
            loop.append(step)
            at = step
        follow = {k: v for k, v in follow.items() if v}
        loops.append(merged[loop])
    outer = max(loops, key=lambda p: np.ptp(p[:, 0]) * np.ptp(p[:, 1]))[:, :2]
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(outer, axis=0), axis=1))])
    beads = []
    pieces = max(2, round(length[-1] / 45))
    for k in range(pieces):
        begin = (k + 0.08 + 0.1 * rng.random()) / pieces * length[-1]
        end = (k + 0.75 + 0.2 * rng.random()) / pieces * length[-1]
        s = np.arange(begin, end, 0.55)
        line = np.column_stack([np.interp(s, length, outer[:, i]) for i in (0, 1)])
        line = np.column_stack([line, np.full(len(s), 0.25)])
        swell = 1.45 + 0.22 * np.sin(2 * np.pi * s / 1.9) + rng.normal(0, 0.1, len(s))
        swell *= smoothstep(s - begin, 0, 2.0) * smoothstep(end - s, 0, 2.0) * 0.8 + 0.2
        line[:, :2] += rng.normal(0, 0.07, (len(s), 2))
        beads.append(sweep(line, swell, 8))
    return join(*beads)
