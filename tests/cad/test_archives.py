"""STEP files that are packed by gzip or zip, and archives that hold something else."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path

import numpy as np
import pytest

from arview.cad import load_part
from arview.cad.formats import archive
from arview.cad.load import load_cad
from arview.errors import InputError
from helpers.cad_files import StepPart, StepWriter

STEP = StepPart("plate", (50.0, 40.0, 5.0))


def write_zip(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return path


def write_archive(folder: Path, name: str) -> Path:
    """A STEP file packed as the name says: by gzip, or by zip beside a picture and what macOS adds."""
    content = StepWriter().write(folder / "source.step", STEP).read_bytes()
    path = folder / name.removeprefix("zip:")
    if "zip" not in name:
        path.write_bytes(gzip.compress(content))
        return path
    return write_zip(path, {"a/": b"", "a/Plate.STP": content, "__MACOSX/a/._Plate.STP": b"x", "a/view.png": b"x"})


@pytest.mark.parametrize("name", ["fix.stpz", "zip:fix.stpz", "fix.stp.gz", "fix.step.zip", "fix.ZIP", "fix.STEP"])
def test_packed_step_is_read(name: str, tmp_path: Path) -> None:
    part = load_part(write_archive(tmp_path, name.replace(".ZIP", ".zip")))
    assert part.name == part.model.name == "fix"
    assert [component.name for component in part.model.components] == ["plate"]
    np.testing.assert_allclose(part.model.bounds_in_model, [[0, 0, 0], [50, 40, 5]], atol=1e-9)


def test_the_unit_of_packed_step_can_be_overridden(tmp_path: Path) -> None:
    model = load_cad(write_archive(tmp_path, "fix.stpz"), "cm").model
    np.testing.assert_allclose(np.ptp(model.bounds_in_model, axis=0), [500, 400, 50], rtol=1e-6)


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({"a.stp": b"1", "b.stp": b"2"}, r"holds a\.stp, b\.stp; only an archive of one STEP file is read: unpack it"),
        ({"a.obj": b"1", "a.mtl": b"2"}, r"holds a\.obj, a\.mtl; only an archive"),
        ({"a.stl": b"solid a"}, r"holds a\.stl; only an archive of one STEP file is read: unpack it"),
        ({}, r"holds no file"),
    ],
)
def test_archives_of_other_files_are_refused_in_one_line(files: dict[str, bytes], reason: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=reason) as caught:
        load_cad(write_zip(tmp_path / "a.zip", files))
    assert "\n" not in str(caught.value)


def test_packed_files_of_other_kinds_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.obj.gz").write_bytes(gzip.compress(b"v 0 0 0\n"))
    with pytest.raises(InputError, match=r"holds a\.obj; only an archive of one STEP file is read"):
        load_cad(tmp_path / "a.obj.gz")


@pytest.mark.parametrize("name", ["fix.stpz", "zip:fix.stpz"])
def test_damaged_archives_are_refused(name: str, tmp_path: Path) -> None:
    path = write_archive(tmp_path, name)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:200] + bytes(40) + whole[240:]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="this archive cannot be unpacked"):
            load_cad(path)


@pytest.mark.parametrize("kind", ["gzip", "zip"])
def test_what_unpacks_to_gigabytes_is_refused_early(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "_RATIO_FROM_BYTES", 1_000_000)
    content = b"ISO-10303-21;" + bytes(3_000_000)
    path = tmp_path / "bomb.stpz"
    if kind == "gzip":
        path.write_bytes(gzip.compress(content))
    else:
        write_zip(path, {"a.stp": content})
    with pytest.raises(InputError, match="unpack to more than 1 MB are no model"):
        load_cad(path)
