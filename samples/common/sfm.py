"""Checks that a photo set can be reconstructed: pycolmap with its defaults against the truth."""

from __future__ import annotations

import json
import tempfile
import zlib  # noqa: F401  # pycolmap corrupts the heap unless Python's zlib is loaded first
from pathlib import Path

import numpy as np
import pycolmap


def against_truth(out: Path) -> None:
    """Print the registered photos, the focal length, and the errors of the camera centres after a similarity fit."""
    truth = json.loads((out / "truth.json").read_text())
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory() as work:
        database = Path(work) / "database.db"
        reader = pycolmap.ImageReaderOptions(camera_model="RADIAL")
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(database, out / "photos", camera_mode=mode, reader_options=reader)
        print("EXIF focal prior:", pycolmap.Database.open(database).read_all_cameras()[0])
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, out / "photos", work)
    model = max(models.values(), key=lambda m: m.num_reg_images())
    print(f"{len(models)} model(s); {model.summary()}")
    camera = next(iter(model.cameras.values()))
    print(f"focal {camera.params[0]:.2f} of {truth['K'][0][0]} px, k1 k2 {camera.params[3:]} of {truth['dist_k1_k2']}")
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    found = np.array([image.projection_center() for image in images])
    poses = [np.array(truth["cam_from_model_mm"][image.name]) for image in images]
    true = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    off = np.linalg.norm(true - similar(found, true), axis=1)
    print(f"camera centres: median {np.median(off):.3f} mm, largest {off.max():.3f} mm")


def similar(source, target):
    """``source`` (N,3) after the best similarity to ``target`` (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (s @ sign) / (a**2).sum() * a @ (u * sign @ vt).T + target.mean(axis=0)
