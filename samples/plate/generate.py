"""Makes the photo sample: the STEP file, the photos and their truth.

    generate.py step                    plate.step
    generate.py truth                   truth.json and camera.json
    generate.py photos [--first A --last B]   photos/img_000.jpg …; skips existing ones
    generate.py clip --work DIR [--first A --last B]   frames of the clip into DIR; skips existing ones
    generate.py encode --work DIR       clip.mp4 of them, and clip_truth.json
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
import time
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent / "common"))


def photo_name(index: int) -> str:
    return f"img_{index:03d}.jpg"


def make_step(out: Path) -> None:
    import assembly
    from solids import write_step

    write_step(out / "plate.step", "plate", assembly.components())


def make_truth(out: Path, seed: int) -> None:
    import scene
    import shots

    camera = shots.camera(seed)
    truth = {
        "part": "plate",
        "seed": seed,
        "convention": "cam_from_model_mm: 4x4 row-major, mm, OpenCV camera (x right, y down, z forward), pixel"
        " centres at integers. Per component, model axes: displacement_mm of its centroid_mm (of the nominal solid),"
        " tilt_deg rotation vector about that centroid; measured_from_nominal is both as 4x4. As built, not nominal:"
        " weld beads too.",
        "K": [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]],
        "dist_k1_k2": camera["dist"][:2],
        "cam_from_model_mm": {photo_name(i): pose.tolist() for i, pose in enumerate(shots.places(seed))},
        "truth": shots.as_built(seed, scene.nominal_meshes()),
    }
    # One matrix per line keeps the file readable.
    head = {key: truth.pop(key) for key in ("part", "seed", "convention", "K", "dist_k1_k2")}
    lines = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items()]
    for key, table in truth.items():
        rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in table.items())
        lines.append(f" {json.dumps(key)}: {{\n{rows}\n }}")
    (out / "truth.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")
    (out / "camera.json").write_text(json.dumps(camera) + "\n")


def exif(camera: dict, index: int, gain: float):
    """EXIF data as a phone writes them, with rounded focal lengths."""
    import shots
    from PIL import Image

    data = Image.Exif()
    # Tags of EXIF 2.3 by number: make, model, orientation, software; then those of the Exif directory.
    data.update({0x010F: "arview", 0x0110: "sample", 0x0112: 1, 0x0131: "samples/plate/generate.py"})
    focal_mm = round(camera["fx"] / shots.WIDTH * shots.SENSOR_WIDTH_MM, 1)
    full_frame_mm = round(43.27 * camera["fx"] / float(np.hypot(shots.WIDTH, shots.HEIGHT)))
    data.get_ifd(0x8769).update(
        {
            0x829A: round(gain / 60, 5),  # exposure time, s
            0x829D: 1.8,  # f-number
            0x8827: 320,  # ISO
            0x9003: f"2026:11:20 10:{4 + index // 8:02d}:{7 * (index % 8) + 2:02d}",  # taken
            0x920A: focal_mm,
            0xA002: shots.WIDTH,
            0xA003: shots.HEIGHT,
            0xA405: full_frame_mm,
        }
    )
    return data


def make_photos(out: Path, seed: int, first: int, last: int, quality: int) -> None:
    import scene
    from PIL import Image

    folder = out / "photos"
    folder.mkdir(parents=True, exist_ok=True)
    missing = [i for i in range(first, last) if not (folder / photo_name(i)).exists()]
    if not missing:
        return
    studio = scene.Studio(seed)
    for index in missing:
        begin = time.process_time()
        picture, gain = studio.photo(index)
        # Written under another name first, so that an interrupted run leaves no incomplete picture.
        part = folder / f".{photo_name(index)}.part"
        Image.fromarray(picture[..., ::-1]).save(part, "JPEG", quality=quality, exif=exif(studio.camera, index, gain))
        part.replace(folder / photo_name(index))
        print(f"{photo_name(index)}: {time.process_time() - begin:.1f} CPU-s", flush=True)


def make_clip(work: Path, seed: int, first: int, last: int) -> None:
    import clips
    import film

    clips.render(work, range(first, min(last, film.FRAMES)), lambda: film.Shoot(seed).frame)


def encode_clip(out: Path, work: Path, seed: int, crf: int) -> None:
    import clips
    import film

    clips.encode(work, out / "clip.mp4", film.FRAMES, film.FPS, (film.WIDTH, film.HEIGHT), crf)
    head = {
        "clip": "clip.mp4",
        "fps": film.FPS,
        "convention": "cam_from_model: 4x4 row-major, mm, OpenCV camera, at mid-exposure; a line for each frame",
        "camera": film.camera(seed),
    }
    poses = [json.dumps(np.round(film.cam_from_model(index, seed), 9).tolist()) for index in range(film.FRAMES)]
    text = json.dumps(head, indent=1)[:-2] + ',\n "cam_from_model": [\n  ' + ",\n  ".join(poses) + "\n ]\n}\n"
    (out / "clip_truth.json").write_text(text)


def make_as_built(out: Path, seed: int) -> None:
    import scene
    import textures as tx
    import trimesh

    vertices, faces = tx.join(*scene.as_built_meshes(seed).values())
    trimesh.Trimesh(vertices, faces, process=False).export(out / "as_built.ply")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("step", "truth", "photos", "clip", "encode", "as-built", "verify", "sfm"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, help="default: this folder for seed 0, else /tmp/plate_SEED")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--last", type=int, help="not itself; default: all")
    parser.add_argument("--work", type=Path, default=Path("/tmp/plate_clip"), help="folder for the clip's frames")
    parser.add_argument("--crf", type=int, default=20, help="of the clip")
    parser.add_argument("--quality", type=int, default=91, help="of the JPEGs")
    parser.add_argument("--draw", type=Path, help="folder for photos with the CAD's edges drawn in")
    arguments = parser.parse_args()
    seed = arguments.seed
    out = arguments.out or (Path(f"/tmp/plate_{seed}") if seed else FOLDER)
    out.mkdir(parents=True, exist_ok=True)
    if arguments.command == "step":
        make_step(out)
    elif arguments.command == "truth":
        make_truth(out, seed)
    elif arguments.command == "photos":
        make_photos(out, seed, arguments.first, arguments.last or 24, arguments.quality)
    elif arguments.command == "clip":
        make_clip(arguments.work, seed, arguments.first, arguments.last or 10**6)
    elif arguments.command == "encode":
        encode_clip(out, arguments.work, seed, arguments.crf)
    elif arguments.command == "as-built":
        make_as_built(out, seed)
    elif arguments.command == "verify":
        import verify

        verify.edges_on_photos(out, seed, arguments.draw)
    else:
        import sfm

        sfm.against_truth(out)


if __name__ == "__main__":
    main()
