"""M3T with a colour camera and the region modality, with its defaults and with its authors' settings for RBOT."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from peers.films import Film
from peers.programs import SINGLE, MissingPeerError, Track, done, needed, read_track

HERE = Path(__file__).resolve().parent
GET = "git clone https://github.com/DLR-RM/3DObjectTracking and give the folder with --m3t"
PACKAGES = "apt-get install cmake g++ libopencv-dev libeigen3-dev libglew-dev libglfw3-dev xvfb"


def m3t_ways(checkout: Path | None, build: Path) -> dict[str, Callable[[Film], Track]]:
    """M3T's ways by name, built with cmake from a checkout into a folder outside it; raises MissingPeerError."""
    if checkout is None:
        raise MissingPeerError(GET)
    source = next((path for path in (checkout / "M3T", checkout) if (path / "include/m3t/tracker.h").is_file()), None)
    if source is None:
        raise MissingPeerError(f"{checkout} has no M3T/include/m3t/tracker.h; {GET}")
    needed(("cmake", "g++"), PACKAGES)
    if "DISPLAY" not in os.environ:
        needed(("xvfb-run",), f"M3T draws its views with OpenGL; {PACKAGES}")
    program = build / "m3t_track"
    try:
        done(["cmake", "-S", HERE, "-B", build, f"-DM3T={source.resolve()}"], "cmake")
        if not program.is_file():
            print("M3T: building it, once; this takes some minutes", file=sys.stderr, flush=True)
        done(["cmake", "--build", build, f"-j{os.cpu_count() or 1}"], "building M3T")
    except RuntimeError as error:
        raise MissingPeerError(f"{error}\n{PACKAGES}") from error
    return {"M3T": partial(_track, program, "default"), "M3T, RBOT settings": partial(_track, program, "rbot")}


def _track(program: Path, settings: str, film: Film) -> Track:
    mesh = film.folder / "body.obj"
    kept = program.parent / f"{film.scene.name}_{hashlib.sha256(mesh.read_bytes()).hexdigest()[:16]}.obj"
    if not kept.is_file():  # its views are tied to the path of the mesh
        shutil.copyfile(mesh, kept)
    output = film.folder / "m3t.txt"
    views = kept.with_suffix(".views")
    if not views.is_file():
        print(
            f"M3T: making its views of {film.scene.name}, once; this takes a minute or two", file=sys.stderr, flush=True
        )
    virtual: list[str | Path] = [] if "DISPLAY" in os.environ else ["xvfb-run", "-a"]
    done([*virtual, program, film.folder, settings, kept, views, output], f"M3T on {film.scene.name}", SINGLE)
    return read_track(output, film.center_mm)
