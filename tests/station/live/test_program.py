"""`arview live` as a program: its output, its exit, and one line for each kind of invalid input."""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from arview.cli import main
from arview.errors import InputError
from arview.station.live.security.addresses import LOOPBACK, bind
from arview.video import open_source
from helpers.live_client import Http
from helpers.live_sample import CAMERA, CLIP, INSPECTION, PART
from helpers.paths import ROOT

pytestmark = pytest.mark.slow  # each test starts the program

LINK = re.compile(r"(https?)://127\.0\.0\.1:(\d+)/\?token=(\S+)")


@contextmanager
def program(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The program, started in a folder; killed at the end if it is still running."""
    process = subprocess.Popen(
        [sys.executable, "-m", "arview.cli", "live", *arguments],
        cwd=folder,
        env={**os.environ, "ARVIEW_DATA": str(folder / "data")},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def link(process: subprocess.Popen[str]) -> tuple[str, int, str]:
    """Scheme, port and token that it prints."""
    assert process.stdout is not None
    for line in process.stdout:
        if match := LINK.search(line):
            return match.group(1), int(match.group(2)), match.group(3)
    raise AssertionError(process.communicate()[1])


def free_port() -> int:
    """A port that is free now, and that nobody is given who asks for any free one, as tests beside this one do."""
    while True:
        port = random.randrange(20000, 30000)
        try:
            bind(LOOPBACK, port).close()
        except InputError:
            continue
        return port


def test_it_serves_until_ctrl_c_and_finishes_the_recording(tmp_path: Path) -> None:
    arguments = ["--part", str(PART), "--inspection", str(INSPECTION), "--camera", str(CAMERA), "--source", str(CLIP)]
    with program(tmp_path, *arguments, "--http", "--port", str(free_port()), "--record", "out.mp4") as process:
        scheme, port, token = link(process)
        assert scheme == "http"
        page = Http(port, token)
        ends_s = time.monotonic() + 120
        while page.json("GET", "/api/status")[1]["feed"]["width"] is None or not list(tmp_path.glob(".out.mp4*")):
            assert time.monotonic() < ends_s  # until the first frame is tracked and recorded
            time.sleep(0.1)
        time.sleep(0.5)
        asked_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
        assert time.monotonic() - asked_s < 6.0  # five, and one for a machine that does other work
    assert process.returncode == 130, err
    assert "█" not in out and "▀" not in out  # no QR code without a terminal
    assert err.splitlines()[-1] == "arview: ended; files are finished" and "Traceback" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "out.jsonl", "out.mp4"]
    shown = list(open_source(tmp_path / "out.mp4"))
    assert len(shown) >= 1 and shown[0].image.shape == (720, 1280, 3)


def test_https_is_the_default_and_sigterm_ends_it_too(tmp_path: Path) -> None:
    with program(tmp_path, "--part", str(PART), "--host", LOOPBACK, "--port", str(free_port())) as process:
        assert link(process)[0] == "https"
        assert process.stdout is not None
        assert process.stdout.readline().startswith("first time on a phone:  http://127.0.0.1:")
        assert re.match(r"fingerprint:  ([0-9A-F]{2} ){31}[0-9A-F]{2}$", process.stdout.readline())
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "camera not calibrated" in err and "no inspection" in err
    assert (tmp_path / "data" / "tls" / "authority.key").stat().st_mode & 0o777 == 0o600


def test_a_part_that_cannot_be_read_ends_it_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "part.toml").write_text("[part]\ncad = 'gone.step'\n")
    with program(tmp_path, "--part", "part.toml", "--http", "--port", str(free_port())) as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 64 and not out
    (line,) = err.splitlines()
    assert line.startswith("arview: error: ") and "gone.step" in line


def test_a_busy_port_says_so_in_one_line(tmp_path: Path) -> None:
    taken = bind(LOOPBACK, 0)
    port = str(taken.getsockname()[1])
    result = CliRunner().invoke(main, ["live", "--part", str(PART), "--http", "--port", port])
    taken.close()
    assert result.exit_code == 64
    assert result.stderr == (
        f"arview: error: port {port} at 127.0.0.1 cannot be used (Address already in use); choose another with --port\n"
    )


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--source", "no_such.mp4"], "no_such.mp4"),
        (["--init", "front"], "guide:NAME"),
        (["--cert", "x.pem"], "--key"),
        (["--record", "out.avi"], ".mp4"),
        (["--record", "no/such/out.mp4"], "no/such"),
        (["--record", str(INSPECTION), "--inspection", str(INSPECTION)], "overwrite"),
        (["--max-age", "soon"], "8h"),
        (["--max-age", "-3h"], "8h"),
        (["--size", "big"], "1280x720"),
        (["--size", "641x480"], "641"),
        (["--size", "20000x480"], "20000"),
        (["--clients", "0"], "clients"),
        (["--host", "192.0.2.7", "--http"], "--http"),
        (["--host", "no.such.host.invalid"], "no.such.host.invalid"),
    ],
)
def test_wrong_options_give_one_line(arguments: list[str], word: str) -> None:
    result = CliRunner().invoke(main, ["live", "--part", str(PART), "--port", "0", *arguments])
    assert result.exit_code == 64 and word in result.stderr and "Traceback" not in result.stderr


def test_wrong_inspection_camera_or_guide_end_it_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "inspection.json").write_text("{}")
    (tmp_path / "camera.json").write_text("{")
    for arguments, word in (
        (["--inspection", str(tmp_path / "inspection.json")], "schema_version"),
        (["--inspection", str(tmp_path / "none.json")], "none.json"),
        (["--camera", str(tmp_path / "camera.json")], "camera.json"),
        (["--init", "guide:nowhere"], "nowhere"),
        (["--guideviews", str(PART)], "part.toml"),
    ):
        result = CliRunner().invoke(main, ["live", "--part", str(PART), "--http", "--port", "0", *arguments])
        assert result.exit_code == 64 and word in result.stderr, result.stderr
        assert len(result.stderr.splitlines()) == 1


def test_a_part_that_is_not_there_is_said_before_anything_else() -> None:
    result = CliRunner().invoke(main, ["live", "--part", "nowhere.toml"])
    assert result.exit_code == 64 and "nowhere.toml: no such file" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_missing_extra_says_its_pip_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("aiortc", "segno"):
        monkeypatch.setitem(sys.modules, name, None)
    result = CliRunner().invoke(main, ["live", "--part", str(PART)])
    assert result.exit_code == 64
    assert "aiortc, segno" in result.stderr and re.search(r"pip install .*\[station\]", result.stderr)


def test_help_teaches() -> None:
    text = CliRunner().invoke(main, ["live", "--help"]).output
    assert text.count("arview live --part") >= 4
    notes = (ROOT / "docs" / "reference" / "command-notes.md").read_text(encoding="utf-8")
    assert "has to be told to trust the station" in " ".join(notes.split())
    assert "live" in CliRunner().invoke(main, ["--help"]).output
