"""How well truth and camera lie on the clip: CAD edges projected, and the picture's edge sought beside them.

Per frame, points on the creases of the as-built components (those that no weld bead covers) are projected
through pose, intrinsics and distortion; along each normal in the picture the position of the strongest
gradient is found to a fraction of a pixel. The common shift says how far off the truth is, the median offset
how crisp the picture is.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

FRAMES = (0, 40, 85, 125, 185, 200, 255, 265, 280, 299)
REACH_PX = 6.0


def _edges():
    """Sample points (N,3) on sharp edges and triangles for the depth test, as built."""
    import scene

    points, owners, triangles = [], [], []
    for name, (vertices, faces) in scene.as_built_meshes().items():
        _, index = np.unique(np.round(vertices, 4), axis=0, return_inverse=True)
        corner = vertices[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        triangles.append(corner)
        sides: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        for face, triple in enumerate(faces):
            for k in range(3):
                a, b = int(triple[k]), int(triple[(k + 1) % 3])
                key = tuple(sorted((int(index.ravel()[a]), int(index.ravel()[b]))))
                sides.setdefault(key, []).append((a, b, face))
        for users in sides.values():
            if len(users) != 2 or normal[users[0][2]] @ normal[users[1][2]] > 0.8:
                continue
            start, end = vertices[users[0][0]], vertices[users[0][1]]
            # Edges on the plate's top are hidden by weld beads, except the plate's own.
            if name != "base_plate" and max(start[2], end[2]) < 2.5:
                continue
            length = np.linalg.norm(end - start)
            along = (np.arange(max(1, int(length / 2))) + 0.5) / max(1, int(length / 2))
            for t in along:
                points.append((start + t * (end - start), (end - start) / length))
                owners.append(name)
    return np.array(points), np.array(owners), np.concatenate(triangles)


def verify(folder: Path, draw: Path | None, clip: Path | None = None) -> None:
    import av
    import mitsuba as mi
    import motion
    import scene

    camera = json.loads((folder / "camera.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())["frames"]
    matrix = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    points, _, _ = _edges()
    sight = scene.Sight(camera, rays=8)
    with av.open(str(clip or folder / "clip.mp4")) as container:
        pictures = {i: f.to_ndarray(format="bgr24") for i, f in enumerate(container.decode(video=0)) if i in FRAMES}
    everything = []
    for index, picture in pictures.items():
        pose = np.array(truth[index]["cam_from_model"])
        start = points[:, 0]
        # The depth test: a ray to a point pulled a little towards the camera must meet nothing.
        position = np.linalg.inv(pose)[:3, 3]
        toward = start - position
        reach = np.linalg.norm(toward, axis=1)
        toward /= reach[:, None]
        ray = mi.Ray3f(mi.Point3f(*(float(x) for x in position)), mi.Vector3f(*toward.T.astype(np.float32)))
        scene.place_occluders(sight.params, sight.rest, index)
        sight.params.update()
        free = np.array(sight.part.ray_intersect_preliminary(ray).t) > reach - 0.5
        free &= np.array(sight.hiding.ray_intersect_preliminary(ray).t) > reach
        free &= (start @ pose[:3, :3].T + pose[:3, 3])[:, 2] > 50

        def project(at, pose=pose):
            pixel, _ = cv2.projectPoints(
                at, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], matrix, np.array(camera["dist"])
            )
            return pixel[:, 0]

        if free.sum() < 50:
            continue
        pixel = project(start[free])
        along = project(start[free] + 0.5 * points[free, 1]) - pixel
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        inside = np.all((pixel > 12) & (pixel < (camera["width"] - 12, camera["height"] - 12)), axis=1)
        pixel, normal = pixel[inside], normal[inside]
        offset, strength = _gradient_offsets(picture, pixel, normal)
        strong = strength > 12
        offset, normal = offset[strong], normal[strong]
        # The common shift of the picture against the projection, by robust least squares over all normals.
        shift = np.zeros(2)
        for _ in range(10):
            weight = 1.0 / (1.0 + ((offset - normal @ shift) / 0.5) ** 2)
            shift = np.linalg.solve((normal * weight[:, None]).T @ normal, (normal * weight[:, None]).T @ offset)
        everything.append(shift)
        off = np.abs(offset)
        print(
            f"frame {index:3d}: {strong.sum():4d} edge points, |offset| median {np.median(off):.2f} px,"
            f" within 1 px {100 * np.mean(off < 1):.0f} %, common shift ({shift[0]:+.2f}, {shift[1]:+.2f}) px"
        )
        if draw is not None:
            draw.mkdir(parents=True, exist_ok=True)
            picture = picture.copy()
            for u, v in pixel:
                at = (round(u * 16), round(v * 16))
                cv2.circle(picture, at, 8, (0, 255, 0), -1, cv2.LINE_AA, 4)
            cv2.imwrite(str(draw / f"verify_{index:03d}.png"), picture)
    shifts = np.array(everything)
    mean = shifts.mean(axis=0)
    print(f"mean common shift ({mean[0]:+.3f}, {mean[1]:+.3f}) px over {len(shifts)} frames")
    assert len(truth) == motion.FRAMES


def _gradient_offsets(picture, pixel, normal):
    """Signed distance (px) along each normal to the nearest strong gradient peak, and its strength."""
    gray = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 0.8)
    step = np.arange(-REACH_PX, REACH_PX + 0.01, 0.25)
    at = pixel[:, None] + step[None, :, None] * normal[:, None]
    profile = cv2.remap(gray, at[..., 0].astype(np.float32), at[..., 1].astype(np.float32), cv2.INTER_CUBIC)
    slope = np.abs(np.gradient(profile, 0.25, axis=1))
    # A peak far away counts less, or a neighbouring edge would win.
    score = slope * np.exp(-((step / 3.0) ** 2))
    best = np.clip(score.argmax(axis=1), 1, len(step) - 2)
    rows = np.arange(len(pixel))
    left, middle, right = (slope[rows, best + k] for k in (-1, 0, 1))
    curve = left - 2 * middle + right
    fine = np.where(np.abs(curve) > 1e-6, 0.5 * (left - right) / np.where(curve == 0, 1, curve), 0)
    return step[best] + np.clip(fine, -1, 1) * 0.25, middle
