#!/usr/bin/env python3
"""Render the photo sets on which the coverage of U is judged: four kinds of part, lights, photos, layouts, finishes.

    make_sets.py -o sets/ --python /tmp/samples-venv/bin/python     all of them; resumes where it was stopped
    make_sets.py --list                                             what would be made
    make_sets.py -o sets/ --kind panel --light dim                  only these

Each set is a folder KIND_LIGHT_SEED_PHOTOS[_LAYOUT][_FINISH] with photos/, part.toml, the STEP file, truth.json and
camera.json, as `samples/*/generate.py set` writes it; sets.json beside them lists the finished ones and their classes.
Half of the sets of every kind are marked `judge`: nothing may be tuned on them. --python names the environment of the
samples (see samples/plate/README.md), which has Mitsuba.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

SAMPLES = Path(__file__).resolve().parents[2] / "samples"
KINDS = ("plate", "manifold", "panel", "cabinet")
LIGHTS = ("workshop", "hard-sun", "mixed", "dim")
OWN_FINISH = {"plate": "steel", "manifold": "cast", "panel": "paint", "cabinet": "paint"}
WORN_FINISH = {"plate": "paint", "manifold": "rust", "panel": "chrome", "cabinet": "rust"}
DESIGNS = (
    ("workshop", 24, "ring", False),
    ("hard-sun", 16, "ring", False),
    ("workshop", 12, "one-sided", False),
    ("dim", 16, "ring", False),
    ("workshop", 8, "ring", False),
    ("mixed", 24, "ring", False),
    ("workshop", 30, "film", False),
    ("mixed", 48, "ring", True),
)
"""Light, number of photos, layout, and whether the finish is another than the kind's own."""


@dataclass(frozen=True)
class PhotoSet:
    """One set: its class and its seed.

    Attributes:
        kind, light, photos, layout, finish: class of the set; the options of `generate.py`.
        seed: chooses displacements, camera, places and textures.
        use: ``develop``, or ``judge`` for those that nothing may be tuned on.
    """

    kind: str
    light: str
    photos: int
    layout: str
    finish: str
    seed: int
    use: str

    @property
    def name(self) -> str:
        """The folder's name."""
        words = [self.kind, self.light, str(self.seed), str(self.photos)]
        words += [self.layout] * (self.layout != "ring") + [self.finish] * (self.finish != OWN_FINISH[self.kind])
        return "_".join(words)


def all_sets() -> list[PhotoSet]:
    """Every set, in the order in which they are made: each design for all kinds before the next one."""
    found = []
    for number, (light, photos, layout, worn) in enumerate(DESIGNS):
        for index, kind in enumerate(KINDS):
            finish = WORN_FINISH[kind] if worn else OWN_FINISH[kind]
            use = ("develop", "judge")[(number + index) % 2]
            found.append(PhotoSet(kind, light, photos, layout, finish, 101 + 10 * number + index, use))
    return found


def command(one: PhotoSet, folder: Path, python: str) -> list[str]:
    """The command line that makes a set."""
    options = {"seed": one.seed, "photos": one.photos, "layout": one.layout, "light": one.light, "finish": one.finish}
    line = [python, str(SAMPLES / one.kind / "generate.py"), "set", "--fast", "-o", str(folder)]
    return line + [word for name, value in options.items() for word in (f"--{name}", str(value))]


def is_finished(one: PhotoSet, out: Path) -> bool:
    return len(list((out / one.name / "photos").glob("img_*.jpg"))) >= one.photos


def make(sets: list[PhotoSet], out: Path, python: str) -> int:
    """Make the sets that are not finished; returns the number that could not be made."""
    failed = 0
    for one in sets:
        begin = time.monotonic()
        if not is_finished(one, out):
            folder = out / one.name
            folder.mkdir(parents=True, exist_ok=True)
            with (folder / "generate.log").open("a") as log:
                done = subprocess.run(command(one, folder, python), stdout=log, stderr=subprocess.STDOUT, check=False)
            if done.returncode:
                failed += 1
                print(f"{one.name}: failed, see {folder / 'generate.log'}", file=sys.stderr, flush=True)
                continue
            print(f"{one.name}: {time.monotonic() - begin:.0f} s", flush=True)
        finished = [{"folder": other.name, **asdict(other)} for other in all_sets() if is_finished(other, out)]
        (out / "sets.json").write_text(json.dumps(finished, indent=1) + "\n")
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/sets"), help="default: %(default)s")
    parser.add_argument("--python", default=sys.executable, help="interpreter of the samples' environment")
    parser.add_argument("--kind", choices=KINDS, action="append", help="only this kind; may be given again")
    parser.add_argument("--light", choices=LIGHTS, action="append", help="only this light; may be given again")
    parser.add_argument("--list", action="store_true", help="print the sets and make none")
    arguments = parser.parse_args()
    sets = [
        one for one in all_sets() if one.kind in (arguments.kind or KINDS) and one.light in (arguments.light or LIGHTS)
    ]
    if arguments.list:
        for one in sets:
            print(f"{one.name:<36}{one.use}")
        return 0
    arguments.out.mkdir(parents=True, exist_ok=True)
    return 1 if make(sets, arguments.out, arguments.python) else 0


if __name__ == "__main__":
    raise SystemExit(main())
