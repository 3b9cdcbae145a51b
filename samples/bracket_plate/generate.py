"""Makes the sample: the STEP file, the clip with its truth, and the example inspection.

    generate.py step                                   bracket_plate.step
    generate.py clip --frames 0:300 --work DIR         PNG frames into DIR; skips existing ones
    generate.py encode --work DIR                      clip.mp4 from the frames
    generate.py truth                                  truth.json
    generate.py inspection                             inspection.json (needs arview installed)
    generate.py verify                                 errors of the truth at the edges of the clip, px

Everything is random by one seed. See README.md for the packages that each step needs.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent / "common"))


def make_step() -> None:
    import assembly
    from solids import write_step

    write_step(FOLDER / "bracket_plate.step", "bracket_plate", assembly.components())


def make_clip(first: int, last: int, work: Path) -> None:
    import clips
    import scene

    clips.render(work, range(first, last), lambda: scene.Shot(scene.load_camera(FOLDER)).frame)


def encode(work: Path, crf: int) -> None:
    import clips
    import motion

    clips.encode(work, FOLDER / "clip.mp4", motion.FRAMES, motion.FPS, (1280, 720), crf)


def make_truth() -> None:
    """Truth of the clip: poses from the motion, and visibility by rays against part, hand and card."""
    import motion
    import scene

    camera = scene.load_camera(FOLDER)
    sight = scene.Sight(camera)
    frames = []
    for index in range(motion.FRAMES):
        share = sight.visible(index)
        frames.append(
            {
                "index": index,
                "time_s": round(index / motion.FPS, 6),
                "cam_from_model": np.round(motion.cam_from_model(index), 9).tolist(),
                "visible_fraction": round(share["visible"], 4),
                "in_picture_fraction": round(share["in_picture"], 4),
            }
        )
    displacements = [
        {
            "component": name,
            "measured_from_nominal": np.round(scene.measured_from_nominal(name), 9).tolist(),
            "displacement_mm": moved["translation_mm"],
            "tilt_deg": moved["tilt_deg"],
        }
        for name, moved in scene.AS_BUILT.items()
    ]
    visible = np.array([frame["visible_fraction"] for frame in frames])
    inside = np.array([frame["in_picture_fraction"] for frame in frames])
    events = {
        "partly_covered": _spans((visible < 0.97 * inside) & (visible > 0)),
        "hidden_by_card": _spans((visible == 0) & (inside > 0)),
        "out_of_picture": _spans(inside == 0),
        "partly_out_of_picture": _spans((inside < 0.999) & (inside > 0)),
    }
    # One frame per line keeps the file short and differences between versions readable.
    head = {
        "part": "bracket_plate",
        "clip": "clip.mp4",
        "convention": "cam_from_model: 4x4 row-major, mm, OpenCV camera (x right, y down, z forward), at"
        " mid-exposure; frame spans are inclusive. in_picture_fraction: share of the part's silhouette that"
        " is in the picture; visible_fraction: share that is in it and not hidden by hand or card.",
        "made": "Path-traced with Mitsuba 3 (llvm_ad_rgb), thin lens, 2-8 sub-frames over a shutter of 0.4"
        " frames, Open Image Denoise, Brown distortion by resampling, shot noise, drifting exposure, H.264.",
        "as_built": displacements,
        "as_built_note": "Displacements are measured minus nominal in the model frame; components not listed"
        " stand at their nominal place. bracket_1 leans about the line of its wall on the plate. Weld beads"
        " are on the real part only.",
        "events": events,
    }
    text = json.dumps(head, indent=1)[:-2] + ',\n "frames": [\n'
    text += ",\n".join("  " + json.dumps(frame) for frame in frames) + "\n ]\n}\n"
    (FOLDER / "truth.json").write_text(text)
    print(json.dumps(events))


def _spans(flags: np.ndarray) -> list[list[int]]:
    """Inclusive spans of consecutive true frames."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [[int(a), int(b) - 1] for a, b in zip(edges[::2], edges[1::2], strict=True)]


def make_inspection() -> None:
    """An example inspection: the as-built truth with the noise of a measurement, by a fixed seed."""
    from datetime import UTC, datetime

    from arview.cad.part_file import load_part
    from arview.inspection.files import save_inspection
    from arview.inspection.record import ComponentDeviation, Inspection, Provenance, Verdict

    truth = json.loads((FOLDER / "truth.json").read_text())
    moved = {entry["component"]: entry for entry in truth["as_built"]}
    part = load_part(FOLDER / "part.toml")
    rng = np.random.default_rng(417)
    entries = []
    for name in part.inspected:
        nominal = part.model.component(name).bounds_in_model.mean(axis=0)
        pose = np.array(moved[name]["measured_from_nominal"]) if name in moved else np.eye(4)
        displacement = pose[:3, :3] @ nominal + pose[:3, 3] - nominal
        measured = np.round(displacement + rng.normal(0, 0.04, 3), 2)
        distance = round(float(np.linalg.norm(measured)), 3)
        uncertainty = round(float(rng.uniform(0.10, 0.16)), 2)
        tolerance = part.component_settings(name).position_tolerance_mm
        assert tolerance is not None
        # Pass up to tolerance - U, fail beyond tolerance + U, undecided between.
        verdict = Verdict.UNDECIDED
        if distance <= tolerance - uncertainty:
            verdict = Verdict.PASS
        elif distance > tolerance + uncertainty:
            verdict = Verdict.FAIL
        tilt = abs(moved.get(name, {"tilt_deg": 0.0})["tilt_deg"] + rng.normal(0, 0.05))
        entries.append(
            ComponentDeviation(
                name=name,
                displacement_mm=(float(measured[0]), float(measured[1]), float(measured[2])),
                distance_mm=distance,
                observable=(True, True, not name.startswith(("post", "boss")), True, True, True),
                uncertainty_mm=uncertainty,
                tolerance_mm=tolerance,
                verdict=verdict,
                tilt_deg=round(float(tilt), 2),
            )
        )
    note = "EXAMPLE, written by hand: not a measurement. Values near the sample's known truth, with noise."
    inspection = Inspection(
        part=part.name,
        serial="BP-0417",
        model_hash=part.model.source_hash,
        created=datetime(2026, 11, 20, 14, 5, tzinfo=UTC),
        components=tuple(entries),
        provenance=Provenance("samples/bracket_plate/generate.py", "1", "example values", note),
    )
    save_inspection(inspection, FOLDER / "inspection.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("step")
    clip = commands.add_parser("clip")
    clip.add_argument("--frames", default="0:300", help="A:B, B excluded")
    coder = commands.add_parser("encode")
    coder.add_argument("--crf", type=int, default=20)
    for command in (clip, coder):
        command.add_argument("--work", type=Path, default=Path("/tmp/sample_frames"))
    commands.add_parser("truth")
    commands.add_parser("inspection")
    verify = commands.add_parser("verify")
    verify.add_argument("--draw", type=Path, help="folder for pictures with the edges drawn in")
    arguments = parser.parse_args()
    if arguments.command == "step":
        make_step()
    elif arguments.command == "clip":
        first, last = (int(number) for number in arguments.frames.split(":"))
        make_clip(first, last, arguments.work)
    elif arguments.command == "encode":
        encode(arguments.work, arguments.crf)
    elif arguments.command == "truth":
        make_truth()
    elif arguments.command == "inspection":
        make_inspection()
    elif arguments.command == "verify":
        import verify as check

        check.verify(FOLDER, arguments.draw)


if __name__ == "__main__":
    main()
