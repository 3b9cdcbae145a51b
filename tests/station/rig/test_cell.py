"""A cell of fixed cameras: cycles against truth, a camera that was knocked, and station files with errors."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from arview.calibration import CameraRig
from arview.cli import main
from arview.errors import InputError
from arview.geometry import rigid
from arview.inspection import Verdict, load_inspection
from arview.quality.history import HistoryStore
from arview.station.rig import STATION_FILE_EXAMPLE, Cell, Cycle, RigCameras, read_station
from helpers.plant_bench import answers, broker, consuming, free_port, needs_broker, wait
from helpers.rig_cell import CAMERA, cell, names_of, true_mm, write_pictures, write_station

pytestmark = pytest.mark.slow  # each cycle detects, places and measures

SCENE = cell(16, 4, 7)
TURNED = {1: np.deg2rad([0.1, 0.0, 0.0])}


def true_rig() -> CameraRig:
    """The rig as it is, with the uncertainty that a board would give it."""
    names = tuple(names_of(SCENE))
    covariance = np.diag(np.tile(np.repeat([4e-5, 1.5e-2], 3), len(names))) ** 2
    return CameraRig(
        names, (CAMERA,) * len(names), SCENE.cams_from_rig, covariance, 1e-4, (0.05,) * 4, (8,) * 4, source="truth"
    )


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cell")
    path = write_station(folder, SCENE, "keep = 3")
    true_rig().save(folder / "rig.json")
    write_pictures(folder, SCENE, 0)
    write_pictures(folder, SCENE, 1, TURNED)
    # Another part that lies elsewhere: 6 mm away and turned.
    moved = SCENE.rig_from_model @ rigid(np.eye(3), [6.0, -3.0, 0.0])
    write_pictures(folder, replace(SCENE, rig_from_model=moved), 2)
    return path


def post(port: int, trigger: dict[str, str]) -> int:
    """Status of the answer to a trigger."""
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(f"http://127.0.0.1:{port}/triggers", json.dumps(trigger).encode(), headers)
    try:
        with urllib.request.urlopen(request, timeout=10.0) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


@pytest.fixture(scope="module")
def cycles(station: Path) -> list[Cycle]:
    setup = read_station(station)
    setup.table.finish()
    measuring = Cell(setup)
    with RigCameras(setup.cameras) as cameras:
        found = [measuring.cycle(cameras, serial) for serial in ("A-1", None, "A/3")]
        with pytest.raises(InputError, match="no camera gives a picture"):
            measuring.cycle(cameras)
    measuring.draw(found[1])
    return found


@pytest.mark.parametrize("number", [0, 1, 2])
def test_displacements_against_truth(cycles: list[Cycle], number: int) -> None:
    """A pixel is 0.23 mm; of the second cycle one of four cameras is left out."""
    errors = []
    for one in cycles[number].inspection.components:
        assert one.distance_mm is not None and one.uncertainty_mm is not None, one.name
        errors.append(abs(one.distance_mm - true_mm(SCENE, one.name)))
        assert errors[-1] <= one.uncertainty_mm < 0.08, one.name
        wrong = Verdict.FAIL if true_mm(SCENE, one.name) <= 0.6 else Verdict.PASS
        assert one.verdict is not wrong, one.name
    assert len(errors) == 16 and np.median(errors) < 0.012 and max(errors) < 0.04


def test_a_camera_turned_by_a_tenth_of_a_degree_is_named_and_left_out(cycles: list[Cycle]) -> None:
    assert [tuple(cycle.faults) for cycle in cycles] == [(), ("cam_2",), ()]
    text = "; ".join(cycles[1].inspection.warnings)
    assert "camera cam_2 has moved: it sees the part 3." in text and "cam_1" not in text
    assert set(cycles[1].cams_from_model) == {"cam_1", "cam_3", "cam_4"}
    assert cycles[1].inspection.provenance is not None and cycles[1].inspection.provenance.photos == 3


def test_each_cycle_leaves_its_files(cycles: list[Cycle], station: Path) -> None:
    assert cycles[0].inspection.serial == "A-1" and cycles[0].folder.name.endswith("Z-A-1")
    assert cycles[2].folder.name.endswith("Z-A_3"), "a serial number is no path"
    for cycle in cycles:
        again = load_inspection(cycle.folder / "inspection.json")
        assert [one.name for one in again.components] == [one.name for one in cycle.inspection.components]
    drawn = sorted(path.name for path in cycles[1].folder.glob("*.jpg"))
    assert drawn == ["cam_1.jpg", "cam_3.jpg", "cam_4.jpg"]
    assert sum(path.is_dir() for path in (station.parent / "cycles").iterdir()) == 3


def test_cameras_that_contradict_each_other_give_no_numbers(station: Path, tmp_path: Path) -> None:
    """Two of four are turned, each another way: nobody knows which are right."""
    path = write_station(tmp_path, SCENE)
    true_rig().save(tmp_path / "rig.json")
    write_pictures(tmp_path, SCENE, 0, {k: np.deg2rad([0.35 * (-1) ** k, 0.2 * k, 0.0]) for k in range(4)})
    setup = read_station(path)
    with RigCameras(setup.cameras) as cameras:
        cycle = Cell(setup).cycle(cameras)
    assert {one.verdict for one in cycle.inspection.components} == {Verdict.NOT_MEASURED}
    assert cycle.inspection.warnings


def test_the_program_measures_one_part_and_says_its_verdict(station: Path) -> None:
    result = CliRunner().invoke(main, ["station", "run", str(station), "--cycles", "1", "--serial", "B-7"])
    assert result.exit_code in (0, 1, 2), result.output
    assert "Z-B-7: 16 components" in result.output
    checked = CliRunner().invoke(main, ["station", "check", str(station)])
    assert checked.exit_code == 0 and "cell 4" in checked.output and "good: truth" in checked.output


@needs_broker
def test_the_line_triggers_and_is_told(station: Path, tmp_path: Path) -> None:
    """A trigger by HTTP and one by MQTT, a camera that is turned in the second cycle: results, an alarm, the store."""
    port, path = free_port(), station.with_name("line.toml")
    with broker(tmp_path) as broker_port, consuming(broker_port) as consumer:
        more = f'keep = 3\ncycles = "{tmp_path / "cycles"}"\nstore = "kept.sqlite"'
        text = station.read_text().replace("keep = 3", more)
        path.write_text(f'{text}\n[mqtt]\nhost = "127.0.0.1"\nport = {broker_port}\n[http]\nport = {port}\n')
        command = [sys.executable, "-m", "arview", "station", "run", str(path), "--cycles", "2"]
        program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            wait(lambda: answers(port), 300.0)
            wait(lambda: post(port, {"id": "t-1", "serial": "S-1"}) == 202, 120.0)
            assert post(port, {"id": "t-2", "seriel": "S-2"}) == 400
            wait(consumer.result_keys, 400.0)
            consumer.publish("arview/cell 4/triggers", {"id": "t-3", "serial": "S-3", "order": "O-7"})
            output, _ = program.communicate(timeout=400.0)
        finally:
            program.kill()
        wait(lambda: len(set(consumer.result_keys())) == 2 and consumer.of("alarms"))
        found, (alarm,) = consumer.of("results"), consumer.of("alarms")
    assert [(one["serial"], one["order"], one["trigger"]) for one in found] == [
        ("S-1", "", "t-1"),
        ("S-3", "O-7", "t-3"),
    ]
    assert all(len(one["components"]) == 16 for one in found)
    assert (alarm["kind"], alarm["component"], alarm["is_active"]) == ("camera_moved", "cam_2", True)
    assert "camera cam_2 has moved" in output and program.returncode in (0, 1, 2), output
    with HistoryStore(station.with_name("kept.sqlite")) as store:
        assert sorted(one.serial for one in store.listed()) == ["S-1", "S-3"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("kep = 3", "unknown key 'kep' (did you mean 'keep'?)"),
        ("keep = 0", "keep = 0: expected a positive number"),
        ('[[cameras]]\nname = "cam_1"\nsource = "cam_1"\ncamera = "lens.json"', "another one for each camera"),
        ('[[cameras]]\nname = "x"\nsource = "nowhere"\ncamera = "lens.json"', "nowhere: no such file or folder"),
        ('[[cameras]]\nname = "x"\nsource = "cam_1"\ncamera = "lens.json"\nburst = 1.5', "a whole number from 1 to 64"),
        ('[[cameras]]\nname = "x"\nsource = "cam_1"\ncamera = "lens.json"', "but the station has cam_1"),
    ],
)
def test_errors_of_a_station_file_are_one_line(station: Path, line: str, message: str) -> None:
    text = station.read_text()
    is_table = line.startswith("[[")
    wrong = station.with_name("wrong.toml")
    wrong.write_text(f"{text}\n{line}\n" if is_table else text.replace("keep = 3", line))
    result = CliRunner().invoke(main, ["station", "check", str(wrong)])
    assert result.exit_code == 64 and message in result.output, result.output
    assert result.output.count("\n") <= 2 and "Traceback" not in result.output


def test_the_example_is_a_station_file(tmp_path: Path, station: Path) -> None:
    """Its keys are those that are read; its cameras are not there."""
    path = tmp_path / "station.toml"
    path.write_text(STATION_FILE_EXAMPLE)
    with pytest.raises(InputError, match=r"north\.json"):
        read_station(path)
    result = CliRunner().invoke(main, ["station", "check", "--example"])
    assert result.output == STATION_FILE_EXAMPLE
