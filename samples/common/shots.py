"""Values that a seed determines: as-built displacements, foreign objects, camera and poses of the photos."""

from __future__ import annotations

import numpy as np
import textures as tx
from kinds import Kind, SetOptions
from scipy.spatial.transform import Rotation

SENSOR_WIDTH_MM = 6.4  # of the simulated phone, for the focal length in the EXIF data


def as_built(kind: Kind, seed: int, meshes) -> dict[str, dict]:
    """Displacement of every component of the nominal ``meshes`` (name → vertices, faces; the base comes first).

    ``displacement_mm`` (3,) of its centroid, ``tilt_deg`` (3,) the rotation vector about that centroid, both in
    model axes, and the same as ``measured_from_nominal`` (4,4). A tilted component rests on its seat: it is lifted
    until its lowest point touches. ``present`` is false for those that are missing.
    """
    rng = np.random.default_rng((seed, 1))
    base, *names = meshes
    order = list(rng.permutation(names))
    moves = dict(zip(order, kind.moves, strict=False))
    absent = order[len(order) - kind.missing :]
    truth = {}
    for name in (base, *names):
        vertices, faces = meshes[name]
        centroid = volume_centroid(vertices, faces)
        shift, lift, tilt, twist = (0.0,) * 4 if name in kind.put_right else moves.get(name, (0.0,) * 4)
        toward, about = rng.uniform(0, 2 * np.pi, 2)
        turn = kind.seat(name)[:3, :3]
        rotation_deg = np.round(turn @ [tilt * np.cos(about), tilt * np.sin(about), rng.choice((-1, 1)) * twist], 6)
        rotation = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
        if tilt:
            up = turn[:, 2]
            lift += (vertices @ up).min() - (((vertices - centroid) @ rotation.T + centroid) @ up).min()
        displacement = np.round(turn @ [shift * np.cos(toward), shift * np.sin(toward), lift], 6)
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = centroid - rotation @ centroid + displacement
        truth[name] = {
            "displacement_mm": (displacement + 0.0).tolist(),
            "tilt_deg": (rotation_deg + 0.0).tolist(),
            "centroid_mm": np.round(centroid, 6).tolist(),
            "measured_from_nominal": pose.tolist(),
        }
        if kind.missing:
            truth[name]["present"] = name not in absent
    return truth


def foreign_meshes(kind: Kind, seed: int, meshes, truth) -> dict:
    """Objects on the part that are not in the CAD: name → vertices, faces. A fallen component lies on its side."""
    rng = np.random.default_rng((seed, 11))
    spots = iter(rng.permutation(np.array(kind.spots)).tolist())
    lying = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]])
    found = {}
    for name in [name for name, moved in truth.items() if not moved.get("present", True)][:1]:
        vertices, faces = meshes[name]
        seat = kind.seat(name)
        upright = (vertices - seat[:3, 3]) @ seat[:3, :3]
        found[f"fallen_{name}"] = _resting(upright @ lying.T @ tx.turn_z(rng.uniform(0, 360)).T, next(spots)), faces
    shapes = [
        tx.revolve([(0, 0), (6.5, 0), (6.5, 9), (4, 9), (4, 34), (0, 34)], 32),  # a cap screw
        tx.box((34, 19, 12)),  # an offcut
        tx.revolve([(5, 0), (12, 0), (12, 4), (5, 4), (5, 0)], 40),  # a spacer ring
    ]
    if kind.litter:
        ring = [(5.3, 0), (10, 0), (10, 2), (5.3, 2), (5.3, 0)]
        chip = np.column_stack([9 * np.cos(t := np.linspace(0, 5, 40)), 6 * np.sin(t), 1.5 + 0.6 * t])
        key = tx.join(tx.box((18, 14, 2.4), (-15, 0, 1.2)), tx.box((32, 6, 2.4), (10, 0, 1.2)))
        shapes = [tx.revolve(ring, 40), key, tx.sweep(chip, 1.4, 10), *shapes]
    for k in range(kind.foreign):
        vertices, faces = shapes[int(rng.integers(len(shapes)))]
        found[f"foreign_{k + 1}"] = _resting(vertices @ tx.turn_z(rng.uniform(0, 360)).T, next(spots)), faces
    return found


def _resting(vertices, spot):
    """Vertices shifted so that their middle is above the spot and the lowest lies on it."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return vertices - (*((low + high) / 2)[:2], low[2]) + np.asarray(spot)


def volume_centroid(vertices, faces):
    """(3,) centroid of the solid inside a closed mesh."""
    corner = vertices[faces]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
    return (corner.sum(axis=1) * volume[:, None]).sum(axis=0) / (4.0 * volume.sum())


def camera(options: SetOptions) -> dict:
    """Intrinsics as camera.json holds them. Seed 0 has a centred principal point, other seeds do not."""
    seed, width, height = options.seed, options.width, options.height
    rng = np.random.default_rng((seed, 2))
    focal, k1, k2 = 1920.0, -0.06, 0.01
    cx, cy = (width - 1) / 2, (height - 1) / 2
    if seed:
        focal = round(rng.uniform(1750, 2050), 1)
        cx, cy = np.round(np.array((cx, cy)) + rng.normal(0, 4.0, 2), 1).tolist()
        k1, k2 = round(rng.uniform(-0.08, 0.06), 4), round(rng.uniform(-0.02, 0.02), 4)
    focal = (options.focal_px or focal) * width / 1600
    k1, k2 = options.distortion or (k1, k2)
    return {"width": width, "height": height, "fx": focal, "fy": focal, "cx": cx, "cy": cy, "dist": [k1, k2, 0, 0, 0]}


def camera_of_photo(options: SetOptions, index: int) -> dict:
    """Intrinsics of one photo: those of camera.json, or changed by 0.3 % and 0.4 % of the width (1 sigma)."""
    usual = camera(options)
    if not options.lens_changes:
        return usual
    rng = np.random.default_rng((options.seed, 7, index))
    factor, shift = 1.0 + rng.normal(0, 0.003), rng.normal(0, 0.004 * options.width, 2)
    focal = round(usual["fx"] * factor, 3)
    cx, cy = np.round(shift + np.array([usual["cx"], usual["cy"]]), 3).tolist()
    return usual | {"fx": focal, "fy": focal, "cx": cx, "cy": cy}


def film_size(camera: dict, maps_of) -> tuple[int, int]:
    """(width, height) px of the undistorted picture that the distorted one is sampled from: 5 % more, or what it takes.

    ``maps_of(camera, film)`` are the maps of the resampling.
    """
    width, height = camera["width"], camera["height"]
    film = round(width * 1.05), round(height * 1.05)
    reach = [np.abs(axis - (size - 1) / 2).max() for axis, size in zip(maps_of(camera, film), film, strict=True)]
    return tuple(max(size, 2 * int(np.ceil(far + 3))) for size, far in zip(film, reach, strict=True))


def places(kind: Kind, options: SetOptions) -> list[np.ndarray]:
    """``cam_from_model`` (4,4) of each photo.

    ``ring``: uneven rings, as of someone walking around the part; ``one-sided``: within 110° of azimuth; ``film``: an
    arc of 80° at one height, as the frames of a clip.
    """
    rng = np.random.default_rng((options.seed, 3))
    start, poses, rings = rng.uniform(0, 360), [], kind.rings
    # Farther with a longer lens, so that the part fills the picture as with the usual one.
    farther = (options.focal_px or 1920.0) / 1920.0
    for k in range(options.photos):
        elevation, distance = rings[k % len(rings)]
        share = k / options.photos
        if options.layout == "film":
            elevation, distance = np.mean(rings, axis=0)
            elevation += 5.0 * np.sin(2 * np.pi * (0.8 * share + 0.1)) - 4.0
            azimuth, wander = start + 80.0 * share, 0.15
        else:
            azimuth, wander = start + (360.0 if options.layout == "ring" else 110.0) * share, 1.0
        azimuth = np.deg2rad(azimuth + rng.uniform(-6, 6) * wander)
        elevation = np.deg2rad(elevation + rng.uniform(-4, 4) * wander)
        distance = (distance + rng.uniform(-0.06, 0.06) * 750.0 * wander) * farther
        out = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        target = rng.normal(0, kind.aim_spread, 3) * (1.0, 1.0, 0.3) * wander + kind.aim
        roll = Rotation.from_euler("z", rng.normal(0, 5.0) * wander, degrees=True).as_matrix()
        right = np.cross(-out, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = roll @ np.stack([right, np.cross(-out, right), -out])
        pose[:3, 3] = -pose[:3, :3] @ (target + distance * out)
        poses.append(pose)
    return poses
