"""Check of truth and camera against the photos: CAD edges are projected, and the nearest picture edges found."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
from edges import common_shift, crease_points, gradient_offsets, projected
from kinds import Kind
from rendering import matte, mesh
from studio import as_built_meshes


def edges_on_photos(kind: Kind, out: Path, seed: int, draw: Path | None) -> None:
    """Print for each photo the common shift of its edges and the median offset of an edge point, px."""
    truth = json.loads((out / "truth.json").read_text())
    matrix, distortion = np.array(truth["K"]), np.array([*truth["dist_k1_k2"], 0.0, 0.0])
    meshes = as_built_meshes(kind, seed)
    part = {name: geometry for name, geometry in meshes.items() if not name.endswith("_weld")}
    # Weld beads hide the edges on the plate's top; where there are none, every crease is looked at.
    points = crease_points(part, next(iter(part)), 2.5 if kind.welds else -np.inf)
    plain = matte((0.5, 0.5, 0.5))
    rays = mi.load_dict({"type": "scene"} | {name: mesh(name, *geometry, plain) for name, geometry in meshes.items()})
    shifts = []
    for name, pose in truth["cam_from_model_mm"].items():
        path = out / "photos" / name
        picture = cv2.imread(str(path)) if path.exists() else None
        if picture is None:
            print(f"{name}: missing")
            continue
        pose = np.array(pose)
        # Depth test: the ray to the point must not hit anything before it.
        position = -pose[:3, :3].T @ pose[:3, 3]
        toward = points[:, 0] - position
        reach = np.linalg.norm(toward, axis=1)
        direction = (toward / reach[:, None]).T.astype(np.float32)
        ray = mi.Ray3f(mi.Point3f(*(float(x) for x in position)), mi.Vector3f(*direction))
        free = np.array(rays.ray_intersect_preliminary(ray).t) > reach - 0.5
        pixel, normal = projected(points[free], pose, matrix, distortion)
        inside = np.all((pixel > 12) & (pixel < (picture.shape[1] - 12, picture.shape[0] - 12)), axis=1)
        pixel, normal = pixel[inside], normal[inside]
        offset, strength = gradient_offsets(picture, pixel, normal)
        strong = strength > 12
        shift = common_shift(offset[strong], normal[strong])
        shifts.append(shift)
        off = np.abs(offset[strong])
        print(
            f"{name}: {strong.sum():4d} edge points, |offset| median {np.median(off):.2f} px, within 1 px"
            f" {100 * np.mean(off < 1):.0f} %, common shift ({shift[0]:+.2f}, {shift[1]:+.2f}) px"
        )
        if draw is not None:
            draw.mkdir(parents=True, exist_ok=True)
            for u, v in pixel:
                cv2.circle(picture, (round(u * 16), round(v * 16)), 8, (0, 255, 0), -1, cv2.LINE_AA, 4)
            cv2.imwrite(str(draw / Path(name).with_suffix(".png")), picture)
    shifts = np.array(shifts)
    mean, largest = shifts.mean(axis=0), np.linalg.norm(shifts, axis=1).max()
    print(f"common shift: mean ({mean[0]:+.3f}, {mean[1]:+.3f}) px, largest {largest:.3f} px, {len(shifts)} photos")
