"""The command line of the photo samples: STEP file, photos, truth and checks of one kind of part."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from kinds import FINISHES, LAYOUTS, LIGHTS, Kind, SetOptions

CONVENTION = (
    "cam_from_model_mm: 4x4 row-major, mm, OpenCV camera (x right, y down, z forward), pixel centres at integers. Per"
    " component, model axes: displacement_mm of its centroid_mm (of the nominal solid), tilt_deg rotation vector about"
    " that centroid; measured_from_nominal is both as 4x4. As built, not nominal: weld beads too."
)
PRESENT = (
    " present: false for a missing component, whose displacement says nothing. foreign: objects on the part that are"
    " not in the CAD, with the box around them; fallen_NAME is the missing component NAME lying elsewhere."
)


def photo_name(index: int) -> str:
    return f"img_{index:03d}.jpg"


def make_step(kind: Kind, out: Path) -> None:
    from solids import write_step

    write_step(out / f"{kind.name}.step", kind.name, kind.components())


def make_truth(kind: Kind, out: Path, options: SetOptions) -> None:
    import shots
    import studio

    camera = shots.camera(options)
    nominal = studio.nominal_meshes(kind)
    truth = shots.as_built(kind, options.seed, nominal)
    head = {
        "part": kind.name,
        "seed": options.seed,
        "convention": CONVENTION + PRESENT * bool(kind.missing or kind.foreign),
        "K": [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]],
        "dist_k1_k2": camera["dist"][:2],
        "made": {name: getattr(options, name) for name in ("photos", "layout", "light", "finish")},
    }
    if options.lens_changes:
        head["made"]["lens_changes"] = True
    tables = {
        "cam_from_model_mm": {photo_name(i): p.tolist() for i, p in enumerate(shots.places(kind, options))},
        "truth": truth,
    }
    if options.lens_changes:
        tables["lenses"] = {photo_name(i): shots.camera_of_photo(options, i) for i in range(options.photos)}
    if kind.missing or kind.foreign:
        tables["foreign"] = {
            name: {"low_mm": vertices.min(axis=0).round(3).tolist(), "high_mm": vertices.max(axis=0).round(3).tolist()}
            for name, (vertices, _) in shots.foreign_meshes(kind, options.seed, nominal, truth).items()
        }
    # One matrix per line keeps the file readable.
    lines = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items()]
    for key, table in tables.items():
        rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in table.items())
        lines.append(f" {json.dumps(key)}: {{\n{rows}\n }}")
    (out / "truth.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")
    (out / "camera.json").write_text(json.dumps(camera) + "\n")


def exif(kind: Kind, options: SetOptions, camera: dict, index: int, gain: float):
    """EXIF data as a phone writes them, with rounded focal lengths."""
    import shots
    from PIL import Image

    data = Image.Exif()
    # Tags of EXIF 2.3 by number: make, model, orientation, software; then those of the Exif directory.
    data.update({0x010F: "arview", 0x0110: "sample", 0x0112: 1, 0x0131: f"samples/{kind.name}/generate.py"})
    focal_mm = round(camera["fx"] / options.width * shots.SENSOR_WIDTH_MM, 1)
    full_frame_mm = round(43.27 * camera["fx"] / float(np.hypot(options.width, options.height)))
    data.get_ifd(0x8769).update(
        {
            0x829A: round(gain / (15 if options.light == "dim" else 60), 5),  # exposure time, s
            0x829D: 1.8,  # f-number
            0x8827: 2500 if options.light == "dim" else 320,  # ISO
            0x9003: f"2026:11:20 10:{4 + index // 8:02d}:{7 * (index % 8) + 2:02d}",  # taken
            0x920A: focal_mm,
            0xA002: options.width,
            0xA003: options.height,
            0xA405: full_frame_mm,
        }
    )
    return data


def make_photos(kind: Kind, out: Path, options: SetOptions, span: tuple[int, int], quality: int) -> None:
    import studio
    from PIL import Image

    folder = out / "photos"
    folder.mkdir(parents=True, exist_ok=True)
    missing = [i for i in range(*span) if not (folder / photo_name(i)).exists()]
    if not missing:
        return
    begin = time.process_time()
    camera = studio.Studio(kind, options)
    print(f"scene: {time.process_time() - begin:.1f} CPU-s", flush=True)
    for index in missing:
        begin = time.process_time()
        picture, gain = camera.photo(index)
        # Written under another name first, so that an interrupted run leaves no incomplete picture.
        part = folder / f".{photo_name(index)}.part"
        data = exif(kind, options, camera.camera, index, gain)
        Image.fromarray(picture[..., ::-1]).save(part, "JPEG", quality=quality, exif=data)
        part.replace(folder / photo_name(index))
        print(f"{photo_name(index)}: {time.process_time() - begin:.1f} CPU-s", flush=True)


def make_as_built(kind: Kind, out: Path, seed: int) -> None:
    import studio
    import textures as tx
    import trimesh

    vertices, faces = tx.join(*studio.as_built_meshes(kind, seed).values())
    trimesh.Trimesh(vertices, faces, process=False).export(out / "as_built.ply")


def _parser(kind: Kind, text: str, commands: tuple[str, ...]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=commands)
    parser.add_argument("--seed", type=int, default=0, help="other displacements, camera, places, clutter, textures")
    parser.add_argument("-o", "--out", type=Path, help=f"default: this folder for seed 0, else /tmp/{kind.name}_SEED")
    parser.add_argument("--photos", type=int, default=24, help="number of photos (default: %(default)s)")
    parser.add_argument("--layout", choices=LAYOUTS, default="ring", help="where they are taken from")
    parser.add_argument("--light", choices=LIGHTS, default="workshop")
    parser.add_argument("--finish", choices=FINISHES, default=kind.finish, help="default: %(default)s")
    parser.add_argument("--focal", type=float, help="px, of a picture 1600 px wide; default: by the seed")
    parser.add_argument("--distortion", type=float, nargs=2, metavar=("K1", "K2"), help="default: by the seed")
    parser.add_argument("--lens-changes", action="store_true", help="autofocus and stabiliser: a lens for each photo")
    parser.add_argument("--jpeg-quality", type=int, default=91, help="of the photos (default: %(default)s)")
    parser.add_argument("--width", type=int, help="of the photos, px; 4:3 (default: 1600, with --fast 1280)")
    parser.add_argument("--passes", type=int, help="of 4 samples per pixel each (default: 2, with --fast 1)")
    parser.add_argument("--fast", action="store_true", help="smaller photos, fewer samples: about a third of the time")
    parser.add_argument("--first", type=int, default=0, help="first photo or frame to render")
    parser.add_argument("--last", type=int, help="not itself; default: all")
    parser.add_argument("--draw", type=Path, help="folder for photos with the CAD's edges drawn in, for verify")
    return parser


def _options(arguments: argparse.Namespace) -> SetOptions:
    quick = {"bench_px_per_mm": 1.0} if arguments.fast else {}
    return SetOptions(
        arguments.seed,
        arguments.photos,
        arguments.layout,
        arguments.light,
        arguments.finish,
        arguments.focal,
        tuple(arguments.distortion) if arguments.distortion else None,
        arguments.lens_changes,
        arguments.width or (1280 if arguments.fast else 1600),
        arguments.passes or (1 if arguments.fast else 2),
        **quick,
    )


def main(kind: Kind, folder: Path, text: str, more: dict[str, Callable] | None = None, extend=None) -> None:
    """Run the command line of a kind. ``more`` are commands of its own, given the arguments and the output folder."""
    more = more or {}
    parser = _parser(kind, text, ("step", "truth", "photos", "set", "as-built", "verify", "sfm", *more))
    if extend is not None:
        extend(parser)
    arguments = parser.parse_args()
    options, command = _options(arguments), arguments.command
    out = arguments.out or (Path(f"/tmp/{kind.name}_{options.seed}") if options.seed else folder)
    out.mkdir(parents=True, exist_ok=True)
    if command in more:
        more[command](arguments, out)
    if command in ("step", "set"):
        make_step(kind, out)
    if command in ("truth", "set"):
        make_truth(kind, out, options)
    if command == "set" and out.resolve() != folder.resolve():
        (out / "part.toml").write_text((folder / "part.toml").read_text())
    if command in ("photos", "set"):
        span = arguments.first, min(arguments.last or options.photos, options.photos)
        make_photos(kind, out, options, span, arguments.jpeg_quality)
    if command == "as-built":
        make_as_built(kind, out, options.seed)
    if command == "verify":
        import edge_check

        edge_check.edges_on_photos(kind, out, options.seed, arguments.draw)
    if command == "sfm":
        import sfm

        sfm.against_truth(out)
