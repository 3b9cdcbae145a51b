"""The check after rework: the plate with link_1 put right, in a few photos round that component. Lengths in mm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import photo_set
import shots
from kinds import SetOptions
from sample import KIND
from scipy.spatial.transform import Rotation

COMPONENT = "link_1"
PHOTOS = 6
FIRST_INDEX = 100  # of the noise and the exposure: other ones than those of the first photos
JPEG_QUALITY = 78


def places(centroid_mm: np.ndarray) -> list[np.ndarray]:
    """``cam_from_model`` (4,4) of each photo: all round, aimed between the component and the middle of the plate."""
    rng = np.random.default_rng((0, 12))
    poses = []
    for k in range(PHOTOS):
        azimuth = np.deg2rad(20.0 + 360.0 * k / PHOTOS + rng.uniform(-8, 8))
        elevation = np.deg2rad((42.0, 60.0)[k % 2] + rng.uniform(-4, 4))
        out = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        target = 0.4 * centroid_mm + rng.normal(0, 8.0, 3) * (1.0, 1.0, 0.3)
        position = target + rng.uniform(680.0, 760.0) * out
        right = np.cross(-out, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        roll = Rotation.from_euler("z", rng.normal(0, 5.0), degrees=True).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = roll @ np.stack([right, np.cross(-out, right), -out])
        pose[:3, 3] = -pose[:3, :3] @ position
        poses.append(pose)
    return poses


def make(out: Path, first: int, last: int | None) -> None:
    """Render the photos that are not there yet into ``out``/rework, with their truth."""
    import studio
    from PIL import Image

    folder = out / "rework"
    folder.mkdir(parents=True, exist_ok=True)
    kind, options = replace(KIND, put_right=(COMPONENT,)), SetOptions()
    truth = shots.as_built(kind, 0, studio.nominal_meshes(kind))
    poses = places(np.array(truth[COMPONENT]["centroid_mm"]))
    rows = {f"rework_{k}.jpg": np.round(pose, 9).tolist() for k, pose in enumerate(poses)}
    document = {"cam_from_model_mm": rows, "truth": {COMPONENT: truth[COMPONENT]}}
    (folder / "truth.json").write_text(json.dumps(document, indent=1) + "\n")
    missing = [k for k in range(first, min(last or PHOTOS, PHOTOS)) if not (folder / f"rework_{k}.jpg").exists()]
    if not missing:
        return
    camera = studio.Studio(kind, options)
    camera.places = dict(enumerate(poses, FIRST_INDEX))
    for k in missing:
        picture, gain = camera.photo(FIRST_INDEX + k)
        data = photo_set.exif(kind, options, camera.camera, FIRST_INDEX + k, gain)
        part = folder / f".rework_{k}.part"
        Image.fromarray(picture[..., ::-1]).save(part, "JPEG", quality=JPEG_QUALITY, exif=data)
        part.replace(folder / f"rework_{k}.jpg")
        print(f"rework_{k}.jpg", flush=True)
