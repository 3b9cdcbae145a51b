#!/usr/bin/env python
"""Evaluate arview on the recorded and semi-synthetic sequences, the sample clip and the photo sets, against targets."""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from arview.cad import load_part
from arview.camera.read import load_camera
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, rigid
from arview.pose import Pose, TrackingState
from arview.tracking import SpecimenTracking, Tracker
from arview_lab.evaluation import (
    FrameResult,
    PoseMeter,
    Scene,
    SceneResult,
    Spread,
    Summary,
    evaluate_scene,
    scene_guide_views,
    summarise,
)
from arview_lab.semisynthetic import BOX_SHAPES, CONDITIONS, CURVED_SHAPES, SHAPES
from options import positive
from recordings import (
    PHOTO_SEQUENCES,
    SAMPLE,
    SEQUENCES,
    VIDEOS,
    photo_sets,
    sample_command,
    scenes,
    skip,
    table,
)
from rows import ResultRow
from suites.capture import capture_rows, capture_sets
from suites.coverage import coverage_rows
from suites.detection import DetectionSuite
from suites.features import feature_rows
from suites.guided_init import guided_init_rows
from suites.identity import IdentitySuite
from suites.measurement import measurement_rows
from suites.occluders import OccluderSuite
from suites.presence import PresenceSuite
from suites.quality import quality_rows
from suites.real_conditions import REAL_FRAMES, REAL_SHAPES, RealConditionsSuite
from suites.reconstruction import reconstruction_rows
from suites.relocalization import relocalization_rows
from suites.rig import rig_rows
from suites.scale import SCALED, acceptance_rows, scale_rows
from suites.several import SeveralSuite
from suites.single_photos import evaluate_photos, photo_rows

TRUSTED = (TrackingState.TRACKED, TrackingState.CRITICAL)
START_COUNT = 50
SEED = 7
SECTIONS = (
    "track", "converge", "guided-init", "detect", "semisynthetic-track", "semisynthetic-detect", "false-alarms",
    "lookalike", "relocalize", "sample", "reconstruct", "measure", "real-track", "real-detect", "quality",
    "accepted", "scale", "presence", "several", "occluders", "coverage",
    "capture", "identity", "features", "rig",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--folder", type=Path, default=Path("out"), help="for evaluation.json and evaluation.md; default: out"
    )
    parser.add_argument("--only", choices=SECTIONS, help="only this section")
    parser.add_argument("--shapes", type=names_of(SHAPES), default=SHAPES, help=f"of {','.join(SHAPES)}; default: all")
    parser.add_argument("--frames", type=positive, help="largest number of frames of a scene, for a quick run")
    parser.add_argument(
        "--sequences", type=Path, default=Path("out/sequences"), help="where semi-synthetic sequences are kept"
    )
    parser.add_argument(
        "--backgrounds", type=Path, help="folder of photos; default: recordings and those of this machine"
    )
    parser.add_argument(
        "--photo-set", type=Path, action="append", default=[],
        help="another photo set: a folder made by samples/plate/generate.py --seed N -o FOLDER; may be given again",
    )  # fmt: skip
    parser.add_argument(
        "--conditions", type=names_of(tuple(CONDITIONS)), default=tuple(CONDITIONS),
        help=f"of real-track, real-detect and quality: of {','.join(CONDITIONS)}; default: all",
    )  # fmt: skip
    parser.add_argument(
        "--real-shapes", type=names_of((*SHAPES, *BOX_SHAPES, *CURVED_SHAPES)), default=REAL_SHAPES,
        help=f"of the same; under `curved` the curved ones of them, or all; default: {','.join(REAL_SHAPES)}",
    )  # fmt: skip
    parser.add_argument(
        "--real-frames", type=positive, default=REAL_FRAMES, help=f"of their sequences; default: {REAL_FRAMES}"
    )
    parser.add_argument("--sets", type=Path, help="folder of make_sets.py, for coverage; default: none")
    parser.add_argument("--use", choices=("develop", "judge", "all"), default="develop", help="of --sets")
    parser.add_argument("--assemblies", type=positive, help="of presence: how many assemblies; default: all six")
    parser.add_argument(
        "--two-parts", type=Path,
        help="of identity: folder with frames/, truth.json and camera.json of two castles; default: made by its script",
    )  # fmt: skip
    chosen = parser.parse_args()
    every = scenes(SEQUENCES)
    found = {name: scene for name, scene in every.items() if name in VIDEOS}
    details: dict[str, Any] = {}
    sets, reconstructions = photo_sets(chosen.photo_set), chosen.folder / "photo_sets"
    more = DetectionSuite(every, details, chosen.sequences, chosen.shapes, chosen.frames, chosen.backgrounds)
    real = RealConditionsSuite(
        details, chosen.sequences, chosen.conditions, chosen.real_shapes, chosen.real_frames, chosen.frames,
        chosen.backgrounds,
    )  # fmt: skip
    presence = PresenceSuite(found, details, chosen.sequences, chosen.frames, chosen.assemblies, chosen.backgrounds)
    makers: tuple[Callable[[], list[ResultRow]], ...] = (
        lambda: tracking_rows(every, details),
        lambda: convergence_rows(found),
        lambda: guided_init_rows(found, chosen.frames),
        more.detect,
        more.semisynthetic_track,
        more.semisynthetic_detect,
        more.false_alarms,
        more.look_alikes,
        lambda: relocalization_rows(found, details, chosen.frames),
        lambda: sample_rows(details),
        lambda: reconstruction_rows(sets, reconstructions, details),
        lambda: measurement_rows(sets, reconstructions, details),
        real.track,
        real.detect,
        lambda: quality_rows(every, real, details, chosen.frames),
        lambda: [row for name in PHOTO_SEQUENCES if name in every for row in acceptance_rows(every[name])],
        lambda: [row for name in SCALED if name in every for row in scale_rows(every[name], "truth", details)],
        presence.rows,
        lambda: SeveralSuite(found, details, chosen.frames).rows(),
        OccluderSuite(found, details).rows,
        lambda: coverage_rows(chosen.sets, chosen.use, chosen.folder / "coverage", details) if chosen.sets else [],
        lambda: capture_rows(capture_sets(chosen.photo_set), chosen.folder / "capture", details),
        IdentitySuite(found, details, chosen.two_parts, chosen.folder, chosen.frames, chosen.backgrounds).rows,
        lambda: feature_rows(details),
        lambda: rig_rows(details),
    )
    sections = dict(zip(SECTIONS, makers, strict=True))
    rows: list[ResultRow] = []
    for name, make in sections.items():
        if chosen.only in (None, name):
            try:
                rows += make()
            except InputError as error:  # no photos, no recordings
                skip(name, str(error))
    write(rows, details, chosen.folder)


def write(rows: list[ResultRow], details: dict[str, Any], folder: Path) -> None:
    """Print the table, and write it and all details into a folder."""
    cells = [(x.measure, x.on, x.found, x.target, "yes" if x.is_reached else "NO") for x in rows]
    text = table(("measure", "on", "found", "must reach", "reached"), cells)
    print(text)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "evaluation.md").write_text(text + "\n")
    content = {"rows": [asdict(row) for row in rows], "scenes": details}
    (folder / "evaluation.json").write_text(json.dumps(content, indent=1) + "\n")
    print(f"\nwrote {folder / 'evaluation.json'} and evaluation.md")


def names_of(known: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    """Type of an option that takes some of the known names, separated by commas."""

    def names(text: str) -> tuple[str, ...]:
        given = tuple(text.split(","))
        unknown = [name for name in given if name not in known]
        if unknown:
            raise argparse.ArgumentTypeError(f"{', '.join(unknown)}: not known; give some of {','.join(known)}")
        return given

    return names


# --- Tracking -------------------------------------------------------------------------------------------


def tracking_rows(found: dict[str, Scene], details: dict[str, Any]) -> list[ResultRow]:
    """Rows of the recorded sequences, tracked from truth or from detection."""
    rows = []
    for name, scene in found.items():
        if name in PHOTO_SEQUENCES:
            result = evaluate_photos(scene)
        else:
            result = evaluate_scene(scene, "detect" if name == "plate" else "truth")
        details[name] = result.to_dict()
        rows += TRACKING[name](result)
    if "dragon" in found:
        rows.append(wrong_start_row(found["dragon"]))
    return rows


def castle_rows(result: SceneResult) -> list[ResultRow]:
    shift, turn, tracked = *figures(result.summary), tracked_frames(result)
    is_reached = shift.median <= 0.8 and turn.median <= 0.2 and shift.max <= 3 and turn.max <= 0.7
    text = f"median {shift.median:.2f} mm / {turn.median:.2f}°, max {shift.max:.2f} / {turn.max:.2f}"
    text += f", {tracked}/{len(result.frames)}"
    target = "median ≤ 0.8 mm / 0.2°, max ≤ 3 mm / 0.7°, 40/40"
    return [ResultRow("track from truth", "castle", text, target, is_reached and tracked == 40)]


def rows_within(name: str, shift_mm: float, turn_deg: float) -> Any:
    """A function that makes the rows of a sequence whose every frame must be tracked and near the reference."""

    def rows(result: SceneResult) -> list[ResultRow]:
        total, tracked = len(result.frames), tracked_frames(result)
        near = sum(f.error is not None and f.error.within(shift_mm, turn_deg) for f in result.frames)
        shift, turn = figures(result.summary)
        text = f"{tracked}/{total} tracked, {near} near; max {shift.max:.2f} mm / {turn.max:.2f}°"
        target = f"{total}/{total}, all within {shift_mm:g} mm / {turn_deg:g}° of the peer"
        return [ResultRow("track from truth", name, text, target, tracked == near == total)]

    return rows


def dragon_rows(result: SceneResult) -> list[ResultRow]:
    near = [is_near_dragon(frame) for frame in result.frames]
    share = float(np.mean(near))
    target = "≥ 95 % within 4 mm across, 12 mm in depth, 4°"
    return [ResultRow("track from truth", "dragon", f"{100 * share:.1f} %", target, share >= 0.95)]


def is_near_dragon(frame: FrameResult) -> bool:
    error = frame.error
    return error is not None and error.across_mm <= 4 and abs(error.depth_mm) <= 12 and error.rotation_deg <= 4


def plate_rows(result: SceneResult) -> list[ResultRow]:
    summary = result.summary
    share = summary.within_2cm_2deg or 0.0
    shift, turn = figures(summary)
    text = f"{100 * share:.1f} % within 2 cm/2°, median {shift.median:.2f} mm / {turn.median:.2f}°"
    is_reached = share >= 0.95 and shift.median <= 2 and turn.median <= 0.2
    target = "≥ 95 % of frames with half in view, median ≤ 2 mm / 0.2°"
    return [
        ResultRow("track from detection", "plate", text, target, is_reached),
        loss_row("plate", list(result.frames)),
    ]


TRACKING = {
    "castle": castle_rows,
    "cube": rows_within("cube", 6.0, 3.0),
    "teabox": rows_within("teabox", 4.0, 1.0),
    "dragon": dragon_rows,
    "plate": plate_rows,
    "crate": lambda result: photo_rows("crate", result),
}


def figures(summary: Summary) -> tuple[Spread, Spread]:
    """Errors of position, mm, and of rotation, deg; infinite when nothing was tracked."""
    none = Spread(np.inf, np.inf, np.inf)
    return summary.errors.get("translation_mm", none), summary.errors.get("rotation_deg", none)


def tracked_frames(result: SceneResult) -> int:
    return sum(frame.pose.state is TrackingState.TRACKED for frame in result.frames)


def loss_row(name: str, frames: list[FrameResult]) -> ResultRow:
    """How soon the session notices that the part has left the view, and how soon it tracks it again."""
    late, back, false = [], [], 0
    for first, last in spans_out_of_view(frames):
        states = [frame.pose.state for frame in frames[first : last + 1]]
        gone = next((k for k, state in enumerate(states) if state not in TRUSTED), len(states))
        after = frames[last + 1 :]
        in_view = next((k for k, f in enumerate(after) if (f.visible or 0) >= 0.5), len(after))
        again = next((k for k, f in enumerate(after) if f.pose.state is TrackingState.TRACKED), len(after))
        late.append(gone)
        back.append(max(0, again - in_view))
        false += states.count(TrackingState.TRACKED)
    text = f"noticed after {late} frames, again after {back}, {false} false `tracked`"
    target = "lost within 5 frames, again within 10, no `tracked` while out"
    is_reached = bool(late) and max(late) <= 5 and max(back) <= 10 and false == 0
    return ResultRow("loss and return", name, text, target, is_reached)


def spans_out_of_view(frames: list[FrameResult]) -> list[tuple[int, int]]:
    """First and last index of each run of frames in which the part is out of view."""
    spans: list[tuple[int, int]] = []
    for k, frame in enumerate(frames):
        if frame.visible is not None and frame.visible <= 0.0:
            if spans and spans[-1][1] == k - 1:
                spans[-1] = (spans[-1][0], k)
            else:
                spans.append((k, k))
    return spans


# --- Convergence ----------------------------------------------------------------------------------------


def disturbed(truth: Array, center: Array, rng: np.random.Generator, turn_deg: float, depth: float) -> Array:
    """A pose rotated by an angle about a random axis through the centre, and shifted in depth by a share."""
    axis = rng.normal(size=3)
    turn = exp_so3(np.deg2rad(turn_deg) * axis / np.linalg.norm(axis))
    start = truth @ rigid(turn, center - turn @ center)
    return rigid(np.eye(3), depth * apply(start, center)) @ start


def wrong_start_row(scene: Scene) -> ResultRow:
    """A session started from a pose with an error of 10°."""
    views, center = scene_guide_views(scene), scene.part.model.center_in_model
    rng = np.random.default_rng(SEED)
    truth = scene.frames[0].cam_from_model
    assert truth is not None
    meter = PoseMeter(scene.part.model, scene.camera, views)
    converged = 0
    for _ in range(10):
        start = disturbed(truth, center, rng, 10.0, 0.0)
        session = SpecimenTracking(views, scene.camera, scene.part.model, initial_cam_from_model=start)
        for number, frame in enumerate(scene.frames[:3]):
            pose = session.process(scene.image(frame), frame.index, number / 30.0)
        if pose.cam_from_model is not None and frame.cam_from_model is not None:
            error = meter.measure(pose.cam_from_model, frame.cam_from_model)
            converged += error.across_mm <= 4 and abs(error.depth_mm) <= 12 and error.rotation_deg <= 4
    text = f"{converged} of 10 converged after 3 frames"
    return ResultRow("start 10° off", "dragon", text, "converged within 3 frames", converged == 10)


def convergence_rows(found: dict[str, Scene]) -> list[ResultRow]:
    """The tracker alone, from random wrong poses, given the same picture four times."""
    rows = []
    for name in ("dragon", "castle"):
        if name not in found:
            continue
        scene = found[name]
        views, center = scene_guide_views(scene), scene.part.model.center_in_model
        meter = PoseMeter(scene.part.model, scene.camera, views)
        tracker = Tracker(views, scene.camera)
        rng = np.random.default_rng(SEED)
        frames = [frame for frame in scene.frames if frame.cam_from_model is not None]
        converged = 0
        for k in range(START_COUNT):
            frame = frames[k * len(frames) // START_COUNT]
            truth, image = frame.cam_from_model, scene.image(frame)
            assert truth is not None
            tracker.start(image, disturbed(truth, center, rng, 15.0, float(rng.choice([-0.02, 0.02]))))
            for _ in range(4):
                estimate = tracker.track(image)
            error = meter.measure(estimate.cam_from_model, truth)
            converged += error.across_mm <= 3 and error.rotation_deg <= 3
        text = f"{100 * converged / START_COUNT:.0f} % of {START_COUNT} starts"
        target = "≥ 85 % within 3 mm across / 3° in 4 frames' work"
        rows.append(ResultRow("start 15° and 2 % off", name, text, target, converged >= 0.85 * START_COUNT))
    return rows


# --- The sample clip ------------------------------------------------------------------------------------


def sample_rows(details: dict[str, Any]) -> list[ResultRow]:
    """The sample clip, annotated by the command line from detection, against its truth."""
    clip = SAMPLE / "clip.mp4"
    if not clip.is_file():
        skip("sample", f"{clip} is not here")
        return []
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(sample_command(Path(folder)), check=True, stdout=subprocess.DEVNULL)
        text = (Path(folder) / "poses.jsonl").read_text()
    poses = [read_pose(line) for line in text.splitlines()]
    truths = {entry["index"]: entry for entry in json.loads((SAMPLE / "truth.json").read_text())["frames"]}
    part = load_part(SAMPLE / "part.toml")
    meter = PoseMeter(part.model, load_camera(SAMPLE / "camera.json"))
    frames = []
    for number, pose in enumerate(poses):
        entry = truths[pose.index]
        place = pose.cam_from_model
        error = None if place is None else meter.measure(place, np.array(entry["cam_from_model"]))
        had_pose = number > 0 and poses[number - 1].cam_from_model is not None
        visible = float(entry["visible_fraction"])
        frames.append(FrameResult(pose, error, True, True, visible, not had_pose, number == 0))
    summary = summarise(frames)
    details[SAMPLE.name] = {"summary": asdict(summary), "frames": [frame.to_dict() for frame in frames]}
    shift, turn = figures(summary)
    share = summary.within_2cm_2deg or 0.0
    found = f"{100 * share:.1f} % within 2 cm/2°, median {shift.median:.2f} mm / {turn.median:.2f}°"
    target = "≥ 95 % of frames with half in view"
    return [
        ResultRow("track from detection", SAMPLE.name, found, target, share >= 0.95),
        loss_row(SAMPLE.name, frames),
    ]


def read_pose(line: str) -> Pose:
    entry = json.loads(line)
    place = None if entry["cam_from_model"] is None else np.array(entry["cam_from_model"])
    state = TrackingState(entry["state"])
    return Pose(place, None, entry["quality"], state, entry["time_s"], entry["index"], entry["ms"])


if __name__ == "__main__":
    main()
