"""Makes the photo sample: the STEP file, the photos and their truth.

    generate.py step                    plate.step
    generate.py truth                   truth.json and camera.json
    generate.py photos [--first A --last B]   photos/img_000.jpg …; skips existing ones
    generate.py set                     the three above and part.toml: a folder that can be measured
    generate.py clip --work DIR [--first A --last B]   frames of the clip into DIR; skips existing ones
    generate.py encode --work DIR       clip.mp4 of them, and clip_truth.json
    generate.py rework                  rework/: the part with link_1 put right, in six photos round it
    generate.py as-built                as_built.ply: the mesh that is rendered, weld beads included (not shipped)
    generate.py verify [--draw DIR]     errors of the truth at the edges of the photos, px
    generate.py sfm                     pycolmap's defaults against the truth (in arview's environment)

--seed N makes another set, with other displacements, camera, poses, light, clutter and textures, in the folder -o.
See README.md for the packages that each step needs.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent / "common"))

import photo_set  # noqa: E402  # found by the line above
from sample import KIND  # noqa: E402


def make_clip(arguments: argparse.Namespace, _: Path) -> None:
    import clips
    import film

    span = range(arguments.first, min(arguments.last or film.FRAMES, film.FRAMES))
    clips.render(arguments.work, span, lambda: film.Shoot(arguments.seed).frame)


def encode_clip(arguments: argparse.Namespace, out: Path) -> None:
    import clips
    import film

    seed = arguments.seed
    size = film.WIDTH, film.HEIGHT
    clips.encode(arguments.work, out / "clip.mp4", film.FRAMES, film.FPS, size, arguments.crf)
    head = {
        "clip": "clip.mp4",
        "fps": film.FPS,
        "convention": "cam_from_model: 4x4 row-major, mm, OpenCV camera, at mid-exposure; a line for each frame",
        "camera": film.camera(seed),
    }
    poses = [json.dumps(np.round(film.cam_from_model(index, seed), 9).tolist()) for index in range(film.FRAMES)]
    text = json.dumps(head, indent=1)[:-2] + ',\n "cam_from_model": [\n  ' + ",\n  ".join(poses) + "\n ]\n}\n"
    (out / "clip_truth.json").write_text(text)


def make_rework(arguments: argparse.Namespace, out: Path) -> None:
    import rework

    rework.make(out, arguments.first, arguments.last)


def of_the_clip(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--work", type=Path, default=Path("/tmp/plate_clip"), help="folder for the clip's frames")
    parser.add_argument("--crf", type=int, default=20, help="of the clip")


if __name__ == "__main__":
    photo_set.main(
        KIND, FOLDER, __doc__, {"clip": make_clip, "encode": encode_clip, "rework": make_rework}, of_the_clip
    )
