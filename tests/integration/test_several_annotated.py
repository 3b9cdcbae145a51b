"""annotate with two specimens in one film: one line and one status for each, and exit codes by their components."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from arview.annotation import AnnotateSummary, SpecimenSummary, summary_lines
from arview.cli import main
from arview.cli.exit_codes import ExitCode, presence_exit_code
from arview.errors import InputError
from arview.pose import Completeness, Presence
from arview.tracking.several.specimens import specimen_names
from arview.video import open_source
from arview.workflow.specimens import load_specimens
from helpers import two_specimens
from helpers.live_sample import INSPECTION, PART


def summary_of(*found: Completeness | None) -> AnnotateSummary:
    presence = {"post": Presence.MISSING, "nut": Presence.PRESENT}
    specimens = {f"plate#{k}": SpecimenSummary({"tracked": 2}, one, presence, "") for k, one in enumerate(found, 1)}
    return AnnotateSummary(2, 0, 1.0, {"tracked": 4}, {}, (), (1.0, 2.0), "", False, {}, specimens)


@pytest.mark.parametrize(
    ("found", "code"),
    [
        ((Completeness.COMPLETE, Completeness.COMPLETE), ExitCode.DONE),
        ((Completeness.COMPLETE, Completeness.INCOMPLETE), ExitCode.FAIL),
        ((None, Completeness.INCOMPLETE), ExitCode.FAIL),
        ((Completeness.COMPLETE, Completeness.NOT_YET_CHECKED), ExitCode.UNDECIDED),
        ((Completeness.COMPLETE, None), ExitCode.UNDECIDED),
        ((None, None), ExitCode.CANNOT_MEASURE),
    ],
)
def test_exit_code_is_that_of_the_worst_specimen(found: tuple[Completeness | None, ...], code: ExitCode) -> None:
    assert presence_exit_code(summary_of(*found)) is code


def test_summary_names_what_is_missing_of_each_specimen() -> None:
    lines = "\n".join(summary_lines(summary_of(Completeness.INCOMPLETE, None)))
    assert "plate#1: 2 tracked" in lines and "plate#2: 2 tracked" in lines
    assert "plate#1: components incomplete: 1 missing (post), 1 present" in lines
    assert "plate#2: components" not in lines


def test_names_and_inspections_belong_to_specimens_in_their_order() -> None:
    assert specimen_names(["plate", "nut", "plate"]) == ["plate#1", "nut", "plate#2"]
    first, second = load_specimens([str(PART)], 2, [str(INSPECTION)], None)
    assert first.inspection is not None and second.inspection is None
    with pytest.raises(InputError, match="2 given for 1 specimen"):
        load_specimens([str(PART)], 1, [str(INSPECTION)] * 2, None)


@pytest.mark.slow
def test_film_and_poses_of_two_specimens(tmp_path: Path) -> None:
    lens = two_specimens.wide_camera()
    (tmp_path / "frames").mkdir()
    for number, (image, _) in enumerate(two_specimens.frames()[:6]):
        cv2.imwrite(str(tmp_path / "frames" / f"{number:03d}.png"), image[..., ::-1])
    values = {name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (tmp_path / "camera.json").write_text(json.dumps(values))
    arguments = [
        "annotate", tmp_path / "frames", "--part", PART, "--instances", 2, "--camera", tmp_path / "camera.json",
        "--poses", tmp_path / "poses.jsonl", "-o", tmp_path / "out.mp4", "--inspection", INSPECTION,
    ]  # fmt: skip
    result = CliRunner().invoke(main, [str(one) for one in arguments])
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text().splitlines()]
    names = sorted({line["instance"] for line in lines})
    assert len(lines) == 12 and len(names) == 2 and names[0].endswith("#1") and names[1].endswith("#2")
    last = [np.array(line["cam_from_model"]) for line in lines[-2:] if line["cam_from_model"]]
    assert len(last) == 2 and np.linalg.norm(last[0][:3, 3] - last[1][:3, 3]) > 50.0
    with open_source(tmp_path / "out.mp4") as film:
        assert sum(1 for _ in film) == 6


def test_options_of_one_part_are_refused_for_several() -> None:
    arguments = ["annotate", "film.mp4", "--part", str(PART), "--instances", "2", "--init", "guide:top"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == ExitCode.BAD_INPUT and "--init is for one part" in result.output
