"""Check of truth and camera against the clip: CAD edges are projected, and the nearest picture edges found.

In each frame, points on the creases of the as-built components, except those covered by weld beads, are projected by
pose, intrinsics and distortion. Along the normal of each the strongest gradient of the picture is located to a fraction
of a pixel. The common shift is the error of the truth, the median offset the sharpness of the picture.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from edges import common_shift, crease_points, gradient_offsets, projected

FRAMES = (0, 40, 85, 125, 185, 200, 255, 265, 280, 299)


def verify(folder: Path, draw: Path | None, clip: Path | None = None) -> None:
    import av
    import mitsuba as mi
    import motion
    import scene

    camera = json.loads((folder / "camera.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())["frames"]
    matrix = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    points = crease_points(scene.as_built_meshes(), "base_plate")
    sight = scene.Sight(camera, rays=8)
    with av.open(str(clip or folder / "clip.mp4")) as container:
        pictures = {i: f.to_ndarray(format="bgr24") for i, f in enumerate(container.decode(video=0)) if i in FRAMES}
    everything = []
    for index, picture in pictures.items():
        pose = np.array(truth[index]["cam_from_model"])
        start = points[:, 0]
        # Depth test: the ray to a point slightly nearer to the camera must not hit anything.
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

        if free.sum() < 50:
            continue
        pixel, normal = projected(points[free], pose, matrix, np.array(camera["dist"]))
        inside = np.all((pixel > 12) & (pixel < (camera["width"] - 12, camera["height"] - 12)), axis=1)
        pixel, normal = pixel[inside], normal[inside]
        offset, strength = gradient_offsets(picture, pixel, normal)
        strong = strength > 12
        offset, normal = offset[strong], normal[strong]
        shift = common_shift(offset, normal)
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
