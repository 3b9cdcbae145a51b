#!/usr/bin/env python
"""Render CAD models along trajectories over real photos, with exact truth: test sequences in the manner of RBOT."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arview.cad import Part, load_part
from arview.core.progress import StepProgress
from arview.errors import ArviewError, InputError
from arview_lab.evaluation import Scene, find_scenes, load_scene
from arview_lab.semisynthetic import (
    BOX_SHAPES,
    CONDITIONS,
    CURVED_SHAPES,
    SHAPES,
    VARIANTS,
    Job,
    SequenceOptions,
    curved_shape,
    look_alike_job,
    look_alikes,
    make_sequence,
    shape,
    symmetries_of,
)
from options import positive, seed, share
from photos import background_photos
from recordings import SEQUENCES

DESCRIPTION = """\
Render CAD models along trajectories over real photos, with exact truth, as BOP scenes that `arview evaluate` reads.

  make_sequences.py --shape all --variant all -o out/sequences     six shapes × four variants, 100 frames each
  make_sequences.py --shape flange --variant light --frames 300 --seed 2 -o out/sequences
  make_sequences.py --cad samples/bracket_plate/part.toml --variant occlusion -o out/sequences
  make_sequences.py --cad my.glb --trajectory ../shared/data/sequences/plate -o out/sequences
  make_sequences.py --shape assembly --lookalike -o out/look_alikes
  make_sequences.py --shape curved --variant curved --frames 60 -o out/sequences
  make_sequences.py --shape block --variant real --frames 60 -o out/sequences     under all real conditions

Pictures are 640×512 px with f = 650 px; the part rotates by about 7° and moves by about 15 mm
from frame to frame, seen from all sides, 450 to 1000 mm away. The same seed and backgrounds give the same pictures;
existing sequences are kept."""

EPILOG = """\
variants:
  regular    fixed light
  light      a light that circles and changes its brightness
  noise      the same, with noise of 12 grey levels and a slight blur
  occlusion  the moving light, and another part circling in front; scene_gt_info.json has the visible share
real conditions, which the CAD knows nothing of (light as above; all by --variant real):
  printed    photographs, labels, logos and tags on the part
  worn       labels, tape, scratches, rust and dirt, stronger highlights, soft shadows
  large      the part fills the picture; scratched, soft
  border     the same, cut by the picture's border: 40 to 90 % of it in view
  hd         1920×1080 px, hand-held, H.264 at 12 Mbit/s; labels, dirt, shadows
  phone      1280×720 px, rolling shutter, automatic exposure, white balance, focus, H.264 at 6 Mbit/s; the same
  phone-hard the same with more of each and 1.5 Mbit/s; a worn part
  curved     glossy and vivid, shadows, slight blur; meant for --shape curved

Each OUT/NAME_VARIANT holds models/assembly.glb (the CAD to be detected), test/000001/ (rgb/, mask_visib/,
scene_camera.json, scene_gt.json, scene_gt_info.json) and sequence.json (how it was made). Look-alikes hold the
right CAD and pictures of a wrong assembly; sequence.json names what is wrong, different_fract how much of the
part's picture it changes. For larger steps between frames read every 2nd, 3rd or 4th.

Backgrounds are, without --backgrounds, frames of the recordings ($ARVIEW_DATA), photos in $ARVIEW_BACKGROUNDS,
those that scikit-image and scikit-learn bring along, and Debian's (apt-get install mate-backgrounds)."""


def main() -> int:
    chosen = parser().parse_args()
    try:
        for job in jobs(chosen):
            with progress_bar(job.name) as progress:
                target = make_sequence(job, chosen.output, progress)
            print(target)
    except ArviewError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        description=DESCRIPTION, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = made.add_mutually_exclusive_group(required=True)
    what.add_argument("--cad", type=Path, metavar="PATH", help="a CAD file or part file (mm for STL, PLY and OBJ)")
    what.add_argument(
        "--shape", choices=(*SHAPES, "all", *BOX_SHAPES, *CURVED_SHAPES, "curved"),
        help="one of the shapes made in code; all: the first six; curved: all curved ones",
    )  # fmt: skip
    made.add_argument(
        "--variant", choices=(*VARIANTS, "all", *CONDITIONS, "real"), default="regular",
        help="all: the first four; real: all others; default: regular",
    )  # fmt: skip
    made.add_argument("--frames", type=positive, default=100, metavar="N", help="of each sequence; default: 100")
    made.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="of trajectory, background, light and noise; default: 0"
    )
    made.add_argument("--backgrounds", type=Path, metavar="DIR", help="folder of photos to put behind the part")
    made.add_argument("--trajectory", type=Path, metavar="SCENE", help="take camera and motion of a BOP scene")
    made.add_argument("--shutter", type=share, default=0.0, metavar="SHARE", help="motion blur, 0 (none) to 1")
    made.add_argument(
        "--lookalike", action="store_true", help="render the assembly with something missing, moved, swapped"
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder for the data sets")
    return made


def jobs(chosen: argparse.Namespace) -> Iterator[Job]:
    """The sequences that the command line asks for."""
    follow = scene_to_follow(chosen.trajectory)
    variants = {"all": VARIANTS, "real": tuple(CONDITIONS)}.get(chosen.variant, (chosen.variant,))
    if set(variants) & set(CONDITIONS) and (chosen.lookalike or follow is not None or chosen.shutter):
        raise InputError(f"--variant {chosen.variant} takes no --lookalike, --trajectory or --shutter; leave them out")
    recorded = recorded_name(chosen.cad)
    photos = background_photos(chosen.backgrounds, recorded)
    if chosen.cad:
        part = load_cad(chosen.cad)
        models, symmetries = {recorded or part.name: part.model}, part.symmetries
    else:
        models, symmetries = {name: shape(name) for name in SHAPES if chosen.shape in (name, "all")}, ()
        if chosen.shape in BOX_SHAPES:
            models, symmetries = {chosen.shape: shape(chosen.shape)}, symmetries_of(chosen.shape)
        models |= {name: curved_shape(name) for name in CURVED_SHAPES if chosen.shape in (name, "curved")}
    for name, model in models.items():
        if chosen.lookalike and chosen.shape == "all" and len(model.components) < 2:
            continue
        for variant in variants:
            if variant in CONDITIONS:
                plain = SequenceOptions(frames=chosen.frames, seed=chosen.seed)
                yield Job(f"{name}_{variant}", model, plain, photos, None, None, symmetries, CONDITIONS[variant])
                continue
            options = SequenceOptions(variant, chosen.frames, chosen.seed, shutter=chosen.shutter)
            if not chosen.lookalike:
                yield Job(f"{name}_{variant}", model, options, photos, None, follow, symmetries)
                continue
            for look_alike in look_alikes(model):
                yield look_alike_job(name, model, look_alike, options, photos, follow)


def load_cad(path: Path) -> Part:
    needs_unit = path.suffix.lower() in (".stl", ".ply", ".obj")
    return load_part(path, "mm" if needs_unit else None)


def scene_to_follow(path: Path | None) -> Scene | None:
    return None if path is None else load_scene(find_scenes(path)[0])


def recorded_name(cad: Path | None) -> str:
    """Name of the recording that a CAD file belongs to, or an empty string."""
    found = [name for name in SEQUENCES if cad is not None and name in cad.resolve().parts]
    return found[0] if found else ""


@contextmanager
def progress_bar(label: str) -> Iterator[StepProgress]:
    """A progress bar on stderr, shown only on a terminal; yields a function of (frames done, frames in all)."""
    from tqdm import tqdm

    with tqdm(desc=label, disable=None, leave=False, unit="frame") as bar:

        def update(done: int, in_all: int) -> None:
            bar.total = in_all
            bar.update(done - bar.n)

        yield update


if __name__ == "__main__":
    sys.exit(main())
