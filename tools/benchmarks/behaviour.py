#!/usr/bin/env python
"""Record the results of arview with all digits, and compare two such records: has a change altered any result?"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arview.detection import Detector
from arview.errors import ArviewError
from arview.geometry import Array
from arview.guideviews.cache import cached_guide_views
from arview.pose import Pose
from arview.tracking import TrackingSession
from arview_lab.evaluation import Scene, load_scene, scene_guide_views
from arview_lab.evaluation.protocols import full_sphere_range
from arview_lab.semisynthetic import SHAPES, SequenceOptions, Variant, make_sequence, shape_job
from photos import background_photos
from recordings import ROOT, VIDEOS, scenes, skip, table
from rows import watched

DESCRIPTION = """\
Record the results of arview with all digits, and compare two such records: has a change altered any result?

  behaviour.py record out/before                 poses, detections and an inspection, in about two minutes
  behaviour.py record out/again                  the same a second time: how much do two runs differ?
  behaviour.py compare out/before out/again
  git checkout changed; behaviour.py record out/after
  behaviour.py compare out/before out/after

The search runs in threads, so that two runs of the same code may differ a little, and in rare frames more: compare a
change with the differences between two runs of the code before it."""

RECORDED = f"""\
OUT holds a line of JSON for each frame in
  {", ".join(f"{name}.jsonl" for name in VIDEOS)}    recorded sequences, from detection, by TrackingSession
  clip_bracket.jsonl, clip_plate.jsonl    sample clips, by `arview annotate`
  detect.jsonl         detections in 60 frames of semi-synthetic sequences
and inspection.json, of the sample plate, by `arview inspect`.
The recorded sequences are read from $ARVIEW_DATA/sequences. What is missing is named on stderr and left out.

exit code: 0 recorded, 2 bad input, 70 a command of arview failed"""

COMPARED = """\
Of each record: the number of frames whose state, reason or components (mismatched or unverified) differ, that have a
pose or a detection in one record only, the largest distance between two poses, and the largest difference of quality.
Of inspection.json: numbers that differ, with the relative difference; times and paths are left out.

exit code: 0 within the tolerances, 1 not, 2 bad input"""

PARTS = (*VIDEOS, "detect", "clips")
DETECTED_VARIANTS: tuple[Variant, ...] = ("regular", "noise")
DETECTED_LENGTH, DETECTED_STRIDE, DETECTED_SEED = 10, 2, 1
"""Of the semi-synthetic sequences: frames, every which of them is searched, and the seed."""
MAX_DETECTIONS = 3
"""Recorded of each picture."""
FPS = 30.0
IGNORED = ("created", "cpu_s", "files", "seconds")
"""Keys of inspection.json that differ between two runs of the same code by their nature: times and paths."""
EXIT_DIFFERENT, EXIT_INPUT, EXIT_FAILED = 1, 2, 70

Record = dict[str, Any]


def main() -> int:
    chosen = parser().parse_args()
    try:
        return int(chosen.run(chosen))
    except ArviewError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_INPUT
    except subprocess.CalledProcessError as error:
        print(f"error: {' '.join(error.cmd)}: exit code {error.returncode}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    made = argparse.ArgumentParser(description=DESCRIPTION, formatter_class=raw)
    commands = made.add_subparsers(required=True, metavar="COMMAND")
    recording = commands.add_parser("record", help="write a record to a folder", epilog=RECORDED, formatter_class=raw)
    recording.add_argument("out", type=Path, metavar="OUT", help="folder to write to; made when missing")
    recording.add_argument("--only", type=names_of_parts, default=PARTS, help=f"of {','.join(PARTS)}; default: all")
    recording.add_argument(
        "--sequences", type=Path, default=Path("out/behaviour_sequences"), metavar="DIR",
        help="where the semi-synthetic sequences are kept; default: out/behaviour_sequences",
    )  # fmt: skip
    recording.set_defaults(run=record)
    comparing = commands.add_parser("compare", help="compare two records", epilog=COMPARED, formatter_class=raw)
    comparing.add_argument("a", type=Path, metavar="A", help="folder with a record")
    comparing.add_argument("b", type=Path, metavar="B", help="folder with the other record")
    comparing.add_argument("--max-mm", type=float, default=0.001, metavar="MM", help="between poses; default: 0.001")
    comparing.add_argument("--max-deg", type=float, default=0.001, metavar="DEG", help="the same; default: 0.001")
    comparing.add_argument("--all", action="store_true", help="list every number of inspection.json that differs")
    comparing.set_defaults(run=compare)
    return made


def names_of_parts(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise argparse.ArgumentTypeError(f"{', '.join(unknown)}: unknown; give some of {','.join(PARTS)}")
    return names


# --- Record ---------------------------------------------------------------------------------------------


def record(chosen: argparse.Namespace) -> int:
    out = chosen.out
    out.mkdir(parents=True, exist_ok=True)
    wanted = tuple(name for name in VIDEOS if name in chosen.only)
    for name, scene in scenes(wanted).items():
        write(out / f"{name}.jsonl", tracked_records(scene, name))
    if "detect" in chosen.only:
        photos = background_photos(None)
        if photos:
            write(out / "detect.jsonl", detection_records(photos, chosen.sequences))
        else:
            skip("detect", "no background photos are here")
    if "clips" in chosen.only:
        record_clips(out)
    return 0


def write(path: Path, records: Iterator[Record]) -> None:
    """Write records as lines of JSON, and say so."""
    count = 0
    with path.open("w", encoding="utf-8") as file:
        for one in records:
            file.write(json.dumps(one) + "\n")
            count += 1
    print(f"wrote {path} ({count} frames)", flush=True)


def tracked_records(scene: Scene, name: str) -> Iterator[Record]:
    """The pose of each frame of a recorded sequence, from detection."""
    session = TrackingSession.of(scene_guide_views(scene), scene.camera, scene.part.model)
    for frame in watched(scene.frames, name):
        (pose,) = session.process(scene.image(frame), frame.index, frame.index / FPS)
        yield pose_record(pose)


def pose_record(pose: Pose) -> Record:
    """What is compared of a pose: not how long it took."""
    return {
        "index": pose.index,
        "state": str(pose.state),
        "quality": pose.quality,
        "reason": pose.reason,
        "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.tolist(),
        "covariance": None if pose.covariance is None else pose.covariance.tolist(),
        "mismatches": list(pose.mismatches),
        "unverified": list(pose.unverified),
        "alternatives": [alternative.tolist() for alternative in pose.alternatives],
    }


def detection_records(photos: tuple[Path, ...], folder: Path) -> Iterator[Record]:
    """What the detector finds, without any hint, in frames of semi-synthetic sequences."""
    jobs = [(name, variant) for name in SHAPES for variant in DETECTED_VARIANTS]
    for name, variant in watched(jobs, "detect"):
        options = SequenceOptions(variant, DETECTED_LENGTH, DETECTED_SEED)
        made = make_sequence(shape_job(name, options, photos), folder)
        scene = load_scene(made / "test" / "000001")
        views = cached_guide_views(scene.part.model, full_sphere_range(*options.motion.distance_mm))
        detector = Detector(views=views, camera=scene.camera)
        for frame in scene.frames[::DETECTED_STRIDE]:
            found = detector.detect(scene.image(frame), max_results=MAX_DETECTIONS)
            yield {
                "shape": name,
                "variant": variant,
                "index": frame.index,
                "found": [
                    {
                        "quality": one.quality,
                        "pose": one.cam_from_model.tolist(),
                        "alternatives": [alternative.tolist() for alternative in one.alternatives],
                    }
                    for one in found
                ],
            }


def record_clips(out: Path) -> None:
    """The inspection of the sample plate, and the poses of both sample clips."""
    samples = ROOT / "samples"
    bracket, plate = samples / "bracket_plate", samples / "plate"
    annotate(bracket, bracket / "inspection.json", out / "clip_bracket.jsonl")
    arguments: list[str | Path] = [
        "--part",
        plate / "part.toml",
        "--photos",
        plate / "photos",
        "--video",
        plate / "clip.mp4",
    ]
    # Four components of the sample are out of tolerance: exit code 1, fail.
    run_arview("inspect", *arguments, "--no-pdf", "--force", "-o", out / "inspect", ends=(1,))
    content = (out / "inspect" / "inspection.json").read_text(encoding="utf-8")
    (out / "inspection.json").write_text(content, encoding="utf-8")
    print(f"wrote {out / 'inspection.json'}")
    annotate(plate, out / "inspection.json", out / "clip_plate.jsonl")


def annotate(sample: Path, inspection: Path, poses: Path) -> None:
    """Write the poses of a sample's clip."""
    arguments: list[str | Path] = [
        "--part",
        sample / "part.toml",
        "--camera",
        sample / "camera.json",
        "--inspection",
        inspection,
    ]
    run_arview("annotate", sample / "clip.mp4", *arguments, "--poses", poses)


def run_arview(*arguments: str | Path, ends: Sequence[int] = (0,)) -> None:
    """Run a command of arview.

    Raises:
        CalledProcessError: it ends with another exit code than those expected.
    """
    command = [sys.executable, "-m", "arview.cli", *map(str, arguments)]
    done = subprocess.run(command, check=False)
    if done.returncode not in ends:
        raise subprocess.CalledProcessError(done.returncode, command)


# --- Compare --------------------------------------------------------------------------------------------


@dataclass
class Difference:
    """Differences between two records of the same frames.

    Attributes:
        frames: compared.
        states, reasons, components: frames in which these differ.
        absent: poses or detections that are in one record only.
        max_mm, max_deg, max_quality: largest differences of poses and of their quality.
        where: the first frame whose result differs in kind.
    """

    frames: int = 0
    states: int = 0
    reasons: int = 0
    components: int = 0
    absent: int = 0
    max_mm: float = 0.0
    max_deg: float = 0.0
    max_quality: float = 0.0
    where: str = ""

    @property
    def is_same_in_kind(self) -> bool:
        """True when no frame differs but by its numbers."""
        return not (self.states or self.reasons or self.components or self.absent)

    def add_pose(self, a: Any, b: Any) -> None:
        """Compare two matrices ``cam_from_model``, or None."""
        if a is None and b is None:
            return
        if a is None or b is None:
            self.absent += 1
            return
        first, second = matrix(a), matrix(b)
        self.max_mm = max(self.max_mm, float(np.linalg.norm(first[:3, 3] - second[:3, 3])))
        chord = float(np.linalg.norm(first[:3, :3] - second[:3, :3]))
        angle_deg = np.degrees(2.0 * np.arcsin(min(1.0, chord / np.sqrt(8.0))))
        self.max_deg = max(self.max_deg, float(angle_deg))


def matrix(numbers: Any) -> Array:
    """A pose (4,4) from nested or flat numbers."""
    return np.asarray(numbers, dtype=np.float64).reshape(4, 4)


def compare(chosen: argparse.Namespace) -> int:
    for folder in (chosen.a, chosen.b):
        if not folder.is_dir():
            print(f"error: {folder}: no such folder; make it with: behaviour.py record {folder}", file=sys.stderr)
            return EXIT_INPUT
    names = sorted({path.name for folder in (chosen.a, chosen.b) for path in folder.glob("*.jsonl")})
    rows, is_same, compared = [], True, 0
    for name in names:
        paths = chosen.a / name, chosen.b / name
        missing = [path for path in paths if not path.is_file()]
        if missing:
            skip(name, f"{missing[0]} is not here")
            continue
        found = difference(lines_of(paths[0]), lines_of(paths[1]), compared_by(name))
        compared += 1
        is_near = found.max_mm <= chosen.max_mm and found.max_deg <= chosen.max_deg
        is_same &= found.is_same_in_kind and is_near
        rows.append((
            name, str(found.frames), str(found.states), str(found.reasons), str(found.components), str(found.absent),
            f"{found.max_mm:.6f}", f"{found.max_deg:.6f}", f"{found.max_quality:.6f}", found.where,
        ))  # fmt: skip
    head = (
        "record",
        "frames",
        "states",
        "reasons",
        "components",
        "absent",
        "max mm",
        "max deg",
        "max quality",
        "first",
    )
    if rows:
        print(table(head, rows))
    inspections = chosen.a / "inspection.json", chosen.b / "inspection.json"
    if all(path.is_file() for path in inspections):
        compared += 1
        first, second = (json.loads(path.read_text(encoding="utf-8")) for path in inspections)
        is_same &= print_inspection(first, second, lists_all=chosen.all)
    if not compared:
        print(f"error: {chosen.a} and {chosen.b} have no record in common", file=sys.stderr)
        return EXIT_INPUT
    print("\nthe same within the tolerances" if is_same else "\nDIFFERENT")
    return 0 if is_same else EXIT_DIFFERENT


def lines_of(path: Path) -> list[Record]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


Comparison = Callable[[Difference, Record, Record], None]


def compared_by(name: str) -> Comparison:
    return compare_detections if name == "detect.jsonl" else compare_poses


def difference(first: list[Record], second: list[Record], comparison: Comparison) -> Difference:
    """Differences of two records, frame by frame."""
    found = Difference(frames=min(len(first), len(second)), absent=abs(len(first) - len(second)))
    for a, b in zip(first, second, strict=False):
        was_same = found.is_same_in_kind
        comparison(found, a, b)
        if was_same and not found.is_same_in_kind:
            found.where = " ".join(str(a[key]) for key in ("shape", "variant", "index") if key in a)
    return found


def compare_poses(found: Difference, a: Record, b: Record) -> None:
    found.states += a["state"] != b["state"]
    found.reasons += a["reason"] != b["reason"]
    found.components += components_of(a) != components_of(b)
    found.max_quality = max(found.max_quality, abs(a["quality"] - b["quality"]))
    found.add_pose(a["cam_from_model"], b["cam_from_model"])


def components_of(one: Record) -> tuple[list[str], list[str]]:
    """Names of the components that a frame says are mismatched, and of those not verified yet."""
    return one["mismatches"], one["unverified"] if "unverified" in one else one["unseen"]


def compare_detections(found: Difference, a: Record, b: Record) -> None:
    found.absent += abs(len(a["found"]) - len(b["found"]))
    for one, other in zip(a["found"], b["found"], strict=False):
        found.max_quality = max(found.max_quality, abs(one["quality"] - other["quality"]))
        found.add_pose(one["pose"], other["pose"])


# --- inspection.json ------------------------------------------------------------------------------------


def print_inspection(a: Any, b: Any, lists_all: bool = False) -> bool:
    """Print how two inspections differ; True where they differ by numbers at most."""
    pairs = list(leaves(a, b, ""))
    numbers = [(path, x, y) for path, x, y in pairs if is_number(x) and is_number(y)]
    others = [(path, x, y) for path, x, y in pairs if not (is_number(x) and is_number(y)) and x != y]
    changed = sorted(((relative(x, y), path, x, y) for path, x, y in numbers if x != y), reverse=True)
    print(f"\ninspection.json: {len(changed)} of {len(numbers)} numbers differ, {len(others)} other values")
    for path, x, y in others:
        print(f"  {path}: {x!r} / {y!r}")
    if changed:
        parts = np.quantile([one[0] for one in changed], [0.5, 0.9, 1.0])
        print(
            "  relative differences: "
            + ", ".join(f"{q} {v:.1e}" for q, v in zip(("median", "90 %", "max"), parts, strict=True))
        )
    for share, path, x, y in changed if lists_all else changed[:8]:
        print(f"  {share:.1e}  {path}: {x} / {y}")
    return not others


def leaves(a: Any, b: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Pairs of values at the same place of two documents; None or the whole list where one has none there."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted({*a, *b} - set(IGNORED)):
            yield from leaves(a.get(key), b.get(key), f"{path}.{key}" if path else key)
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from leaves(x, y, f"{path}[{k}]")
    else:
        yield path, a, b


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def relative(x: float, y: float) -> float:
    """Difference of two numbers, of which one is not zero, as a share of the larger."""
    return abs(x - y) / max(abs(x), abs(y))


if __name__ == "__main__":
    sys.exit(main())
