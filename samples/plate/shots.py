"""Values that a seed determines: as-built displacements, camera and poses of the photos."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

PHOTOS = 24
WIDTH, HEIGHT = 1600, 1200
SENSOR_WIDTH_MM = 6.4  # of the simulated phone, for the focal length in the EXIF data

# Shift in the plate's plane (mm), lift (mm), tilt about an axis in the plate's plane (deg) and twist about its
# normal (deg) of the displaced components. The seed determines which component gets which, and the directions.
MOVES = (
    (0.3, 0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0, 0.0),
    (3.0, 0.0, 0.0, 0.0),
    (0.8, 0.6, 0.0, 0.0),  # 1 mm in space
    (0.0, 0.3, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.3, 0.0, 0.5, 0.0),
    (0.0, 0.0, 0.0, 1.2),
    (0.6, 0.0, 0.7, 0.8),
    (0.1, 0.0, 0.0, 0.0),
)


def as_built(seed: int, meshes) -> dict[str, dict]:
    """Displacement of every component of the nominal ``meshes`` (name → vertices, faces; the base comes first).

    ``displacement_mm`` (3,) of its centroid, ``tilt_deg`` (3,) the rotation vector about that centroid, both in
    model axes, and the same as ``measured_from_nominal`` (4,4). A tilted component rests on the plate: it is
    lifted until its lowest point touches.
    """
    rng = np.random.default_rng((seed, 1))
    base, *names = meshes
    moves = dict(zip(rng.permutation(names), MOVES, strict=False))
    truth = {}
    for name in (base, *names):
        vertices, faces = meshes[name]
        centroid = volume_centroid(vertices, faces)
        shift, lift, tilt, twist = moves.get(name, (0.0, 0.0, 0.0, 0.0))
        toward, about = rng.uniform(0, 2 * np.pi, 2)
        rotation_deg = np.round([tilt * np.cos(about), tilt * np.sin(about), rng.choice((-1, 1)) * twist], 6)
        rotation = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
        if tilt:
            lift -= ((vertices - centroid) @ rotation.T + centroid)[:, 2].min()
        displacement = np.round([shift * np.cos(toward), shift * np.sin(toward), lift], 6)
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = centroid - rotation @ centroid + displacement
        truth[name] = {
            "displacement_mm": (displacement + 0.0).tolist(),
            "tilt_deg": (rotation_deg + 0.0).tolist(),
            "centroid_mm": np.round(centroid, 6).tolist(),
            "measured_from_nominal": pose.tolist(),
        }
    return truth


def volume_centroid(vertices, faces):
    """(3,) centroid of the solid inside a closed mesh."""
    corner = vertices[faces]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
    return (corner.sum(axis=1) * volume[:, None]).sum(axis=0) / (4.0 * volume.sum())


def camera(seed: int) -> dict:
    """Intrinsics as camera.json holds them. Seed 0 has a centred principal point, other seeds do not."""
    rng = np.random.default_rng((seed, 2))
    focal, cx, cy, k1, k2 = 1920.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, -0.06, 0.01
    if seed:
        focal = round(rng.uniform(1750, 2050), 1)
        cx, cy = np.round(np.array((cx, cy)) + rng.normal(0, 4.0, 2), 1).tolist()
        k1, k2 = round(rng.uniform(-0.08, 0.06), 4), round(rng.uniform(-0.02, 0.02), 4)
    return {"width": WIDTH, "height": HEIGHT, "fx": focal, "fy": focal, "cx": cx, "cy": cy, "dist": [k1, k2, 0, 0, 0]}


def places(seed: int) -> list[np.ndarray]:
    """``cam_from_model`` (4,4) of each photo: three uneven rings, as of someone walking around the part."""
    rng = np.random.default_rng((seed, 3))
    start, poses = rng.uniform(0, 360), []
    for k in range(PHOTOS):
        ring = k % 3
        azimuth = np.deg2rad(start + 360.0 * k / PHOTOS + rng.uniform(-6, 6))
        elevation = np.deg2rad((35.0, 49.0, 66.0)[ring] + rng.uniform(-4, 4))
        distance = (810.0, 750.0, 720.0)[ring] + rng.uniform(-45, 45)
        out = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        target = rng.normal(0, 14.0, 3) * (1.0, 1.0, 0.3) + (0.0, 0.0, 10.0)
        roll = Rotation.from_euler("z", rng.normal(0, 5.0), degrees=True).as_matrix()
        right = np.cross(-out, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = roll @ np.stack([right, np.cross(-out, right), -out])
        pose[:3, 3] = -pose[:3, :3] @ (target + distance * out)
        poses.append(pose)
    return poses
