"""The model-based tracker of ViSP: edges, and edges with KLT points."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from peers.cao import Polygons, polygons_of, write_cao, write_smooth
from peers.films import Film
from peers.programs import SINGLE, MissingPeerError, Track, done, is_newer, needed, read_track

SOURCE = Path(__file__).with_name("visp_track.cpp")
LIBRARIES = ("visp_mbt", "visp_me", "visp_klt", "visp_vision", "visp_io", "visp_core", "opencv_core")
GET = "get ViSP 3.5 or later: apt-get install g++ pkg-config libvisp-dev"
MAX_POLYGONS = 1000
"""ViSP's tracker is for parts of few flat faces: a model of more is simplified to this many triangles."""


def visp_ways(build: Path, has_scan_line: bool) -> dict[str, Callable[[Film], Track]]:
    """ViSP's ways by name, whose program is compiled into a folder; raises MissingPeerError.

    Args:
        build: folder for the program.
        has_scan_line: also the ways that find hidden edges by drawing, and not only by the normals of faces.
    """
    needed(("g++", "pkg-config"), GET)
    found = subprocess.run(["pkg-config", "--cflags", "visp"], capture_output=True, text=True, check=False)
    if found.returncode:
        raise MissingPeerError(f"no ViSP on this machine; {GET}")
    program = build / "visp_track"
    if not is_newer(program, SOURCE):
        build.mkdir(parents=True, exist_ok=True)
        links = [f"-l{name}" for name in LIBRARIES]
        done(
            ["g++", "-O3", "-march=native", *found.stdout.split(), "-std=c++17", SOURCE, "-o", program, *links],
            "compiling visp_track",
        )
    ways: dict[str, Callable[[Film], Track]] = {}
    for hidden, suffix in (("normals", ""), ("scan-line", ", scan line"))[: 1 + has_scan_line]:
        ways[f"ViSP edge{suffix}"] = partial(_track, program, "edge", hidden)
        ways[f"ViSP edge + KLT{suffix}"] = partial(_track, program, "edge+klt", hidden)
    return ways


def _track(program: Path, mode: str, hidden: str, film: Film) -> Track:
    output, model = film.folder / "visp.txt", film.folder / "model.cao"
    if not model.is_file():
        polygons = model_of(film)
        write_smooth(film.folder / "smooth.txt", polygons)
        write_cao(model, polygons)
    done([program, film.folder, mode, hidden, output], f"ViSP on {film.scene.name}", SINGLE)
    return read_track(output, film.center_mm)


def model_of(film: Film) -> Polygons:
    """The part's polygons, m; a part of many is first simplified, since ViSP compares every edge with every other."""
    vertices, faces = film.mesh_m
    polygons = polygons_of(vertices, faces)
    if len(polygons.loops) <= MAX_POLYGONS or find_spec("open3d") is None:
        return polygons
    import open3d

    vector, indices = open3d.utility.Vector3dVector, open3d.utility.Vector3iVector
    mesh = open3d.geometry.TriangleMesh(vector(vertices), indices(faces))
    mesh.merge_close_vertices(1e-6)
    small = mesh.simplify_quadric_decimation(MAX_POLYGONS)
    return polygons_of(np.asarray(small.vertices), np.asarray(small.triangles, dtype=np.int32))
