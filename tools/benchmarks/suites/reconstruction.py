"""Reconstruction of photo sets with exact truth: cameras, scale, frame, cloud, time and memory."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from arview.camera import Camera
from arview.geometry import Array, apply, invert, rotation_angle_rad
from arview.reconstruction.dense import read_ply
from arview.reconstruction.scale.similarity import Similarity, fit_points
from arview_lab.evaluation.clouds import score_cloud
from recordings import PhotoSet
from rows import ResultRow


@dataclass(frozen=True)
class CameraErrors:
    """Errors of the placed cameras.

    Attributes:
        placed, photos: numbers of placed cameras and of photos.
        centres_mm: (M,) distance of each centre from the true one, after a similarity fit of all centres.
        focal: found / true focal length − 1.
        scale: found / true scale − 1, without any fit; None when no scale was found.
        frame_mm, frame_deg: translation and rotation between the found and the true frame at the part's centre.
        true_from_found: the fitted similarity.
    """

    placed: int
    photos: int
    centres_mm: Array
    focal: float
    scale: float | None
    frame_mm: float | None
    frame_deg: float | None
    true_from_found: Similarity


def reconstruction_rows(sets: Sequence[PhotoSet], folder: Path, details: dict[str, Any]) -> list[ResultRow]:
    """The rows of all photo sets, which are reconstructed anew into a folder."""
    rows = []
    for photos in sets:
        out = folder / photos.name
        seconds, memory_mb = timed_run(photos, out, "--force")
        rows += rows_of(photos, out, seconds, memory_mb, details)
    return rows


def timed_run(photos: PhotoSet, out: Path, *options: str) -> tuple[float, float]:
    """Seconds and peak MB of `arview reconstruct`; raises CalledProcessError when it fails."""
    program = [sys.executable, "-m", "arview.cli", "reconstruct", str(photos.folder), "--part", str(photos.part)]
    began = time.perf_counter()
    subprocess.run([*program, "-o", str(out), *options], check=True, stdout=subprocess.DEVNULL)
    seconds = time.perf_counter() - began
    return seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def rows_of(photos: PhotoSet, out: Path, seconds: float, memory_mb: float, details: dict[str, Any]) -> list[ResultRow]:
    """The rows of a finished reconstruction."""
    content = json.loads((out / "reconstruction.json").read_text())
    errors = camera_errors(content, photos)
    quality = content["quality"]
    name = photos.name
    median, worst = float(np.median(errors.centres_mm)), float(errors.centres_mm.max())
    focal = 100 * errors.focal
    rows = [
        ResultRow("cameras", name, f"{errors.placed}/{errors.photos}, centres {median:.3f} mm, max {worst:.3f}; focal "
             f"{focal:+.3f} %; {quality['points']} points", "all, ≤ 0.11 mm median, 0.02 %, ≥ 13,000",
             errors.placed == errors.photos and median <= 0.11 and abs(focal) <= 0.02 and quality["points"] >= 13000),
    ]  # fmt: skip
    if errors.scale is None or errors.frame_mm is None or errors.frame_deg is None:
        rows.append(ResultRow("scale", name, "not found", "within 0.05 %", False))
    else:
        text = f"{100 * errors.scale:+.4f} % (said ± {100 * content['scale']['std_relative']:.4f}), "
        text += f"frame {errors.frame_mm:.3f} mm / {errors.frame_deg:.4f}°"
        rows.append(ResultRow("scale from the CAD alone", name, text, "within 0.05 %", abs(errors.scale) <= 5e-4))
    rows += cloud_rows(photos, out, errors.true_from_found)
    times = ", ".join(f"{stage} {value:.0f}" for stage, value in content["seconds"].items())
    rows.append(
        ResultRow("all stages", name, f"{seconds:.0f} s ({times}), {memory_mb:.0f} MB", "≤ 90 s, ≤ 4 GB",
             seconds <= 90 and memory_mb <= 4096)
    )  # fmt: skip
    details.setdefault("reconstruct", {})[name] = {
        "centres_mm": errors.centres_mm.tolist(), "focal": errors.focal, "scale": errors.scale,
        "seconds": content["seconds"], "quality": quality, "memory_mb": memory_mb,
    }  # fmt: skip
    return rows


def cloud_rows(photos: PhotoSet, out: Path, true_from_found: Similarity) -> list[ResultRow]:
    """The cloud against the mesh of the part as photographed; nothing where that is not known."""
    if not photos.as_built.exists():
        return []
    mesh = trimesh.load(photos.as_built, process=False)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    points = true_from_found.points_in_model(read_ply(out / "cloud.ply").points)
    truth = json.loads(photos.truth.read_text())
    k = truth["K"]
    camera = Camera(1600, 1200, k[0][0], k[1][1], k[0][2], k[1][2], np.array(truth["dist_k1_k2"]))
    cameras = [(camera, np.array(pose)) for pose in truth["cam_from_model_mm"].values()]
    box = np.stack([vertices.min(0) - 2.0, vertices.max(0) + 2.0])
    box[0, 2] = -6.0  # above the table, the part's lower edge left out
    score = score_cloud(points, vertices, faces, cameras, box)
    text = (
        f"{score.points} points, median {score.median_mm:.3f} mm, 90 % {score.p90_mm:.3f} mm, {100 * score.far:.2f} % "
    )
    text += f"beyond 2 mm; {100 * score.complete:.1f} % of the visible surface"
    reached = score.median_mm <= 0.10 and score.p90_mm <= 0.35 and score.complete >= 0.85
    return [ResultRow("cloud", photos.name, text, "median ≤ 0.10, 90 % ≤ 0.35 mm, ≥ 85 % within 0.5 mm", reached)]


def camera_errors(content: dict[str, Any], photos: PhotoSet) -> CameraErrors:
    """Errors of the cameras in a reconstruction.json."""
    truth = json.loads(photos.truth.read_text())
    true_poses = {name: np.array(pose) for name, pose in truth["cam_from_model_mm"].items()}
    names = [name for name in content["photos"] if name in true_poses]
    found_poses = [np.array(content["photos"][name]["cam_from_scan"]) for name in names]
    found = np.array([invert(pose)[:3, 3] for pose in found_poses])
    true = np.array([invert(true_poses[name])[:3, 3] for name in names])
    fit = fit_points(found, true).similarity
    scale, true_from_found = fit.scale, fit.model_from_scan
    centres = np.linalg.norm(apply(true_from_found, scale * found) - true, axis=1)
    focal = content["photos"][names[0]]["camera"]["fx"] / truth["K"][0][0] - 1
    has_frame = content["scale"]["model_from_scan"] is not None
    # The similarity maps the found frame onto the true one: its motion is the error of the frame.
    middle = np.array([0.0, 0.0, 0.0])
    return CameraErrors(
        len(names), len(true_poses), centres, focal,
        1.0 / scale - 1.0 if content["unit"] == "mm" else None,
        float(np.linalg.norm(apply(true_from_found, scale * middle) - middle)) if has_frame else None,
        float(np.degrees(rotation_angle_rad(true_from_found, np.eye(4)))) if has_frame else None,
        fit,
    )  # fmt: skip
