"""Damaged copies of valid CAD files: each is read, or refused with one line, in bounded time, without a word."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from arview.cad.load import load_cad
from arview.errors import ArviewError
from helpers.cad_files import box, nested_3mf, nested_glb, obj_text

SNIPPETS = (b"-1", b"1e999", b"99999999999", b"0", b"null", b"[", b"{", b"nan", b"\xff\xfe", b"<a>", b"//")


def seed_files(folder: Path) -> list[Path]:
    import trimesh

    vertices, faces = box((0, 0, 0), (10, 20, 30))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    (folder / "b.obj").write_text(obj_text("b", vertices, faces))
    (folder / "a.ply").write_bytes(mesh.export(file_type="ply", encoding="ascii"))
    (folder / "b.ply").write_bytes(mesh.export(file_type="ply"))
    (folder / "a.stl").write_text(mesh.export(file_type="stl_ascii"))
    (folder / "b.stl").write_bytes(mesh.export(file_type="stl"))
    names = ("b.obj", "a.ply", "b.ply", "a.stl", "b.stl")
    return [nested_glb(folder), nested_3mf(folder), *(folder / name for name in names)]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """A copy with bytes changed, removed, repeated or inserted, or cut off."""
    copy = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        kind, at = rng.random(), rng.randrange(len(copy)) if copy else 0
        if kind < 0.4 and copy:
            copy[at] = rng.randrange(256)
        elif kind < 0.55:
            del copy[at : at + rng.randrange(1, 40)]
        elif kind < 0.7:
            copy[at:at] = copy[rng.randrange(len(copy) + 1) :][: rng.randrange(1, 60)]
        elif kind < 0.9:
            copy[at:at] = rng.choice(SNIPPETS)
        else:
            copy = copy[:at]
    return bytes(copy)


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(7), ids=["glb", "3mf", "obj", "ply-ascii", "ply", "stl-ascii", "stl"])
def test_damaged_files_are_read_or_refused(kind: int, tmp_path: Path, capfd) -> None:
    seed = seed_files(tmp_path)[kind]
    rng = random.Random(kind)
    unit = "m" if seed.suffix == ".glb" else "mm"
    assert len(load_cad(seed, unit).model.components) == 1
    refused = 0
    for _ in range(150):
        path = tmp_path / f"damaged{seed.suffix}"
        path.write_bytes(mutated(seed.read_bytes(), rng))
        start = time.process_time()
        try:
            load_cad(path, unit)
        except ArviewError as error:
            assert "\n" not in str(error)
            refused += 1
        assert time.process_time() - start < 10.0
    assert refused > 10
    said = capfd.readouterr()
    assert said.out == "" and said.err == ""
