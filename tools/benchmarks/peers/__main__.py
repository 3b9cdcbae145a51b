"""Named peers beside arview: CPU time by CPU time, on the very same frames, photos and clouds."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(ROOT / "tools" / "lab"), str(HERE.parent)]

from options import positive
from peers.clouds import CloudRow, cloud_rows
from peers.colmap import PhotoRow, photo_rows
from peers.films import Film, TrackRow, make_film, row_of, track_with_arview, warm_up
from peers.m3t.ways import m3t_ways
from peers.programs import MissingPeerError, Track
from peers.visp import visp_ways
from recordings import scenes, skip, table

BUILD = ROOT / "out" / "peers"
PEERS = ("visp", "m3t", "colmap", "clouds")
SEQUENCES = ("castle", "cube", "teabox", "dragon", "desk_dragon")
DESCRIPTION = """\
Named peers beside arview, CPU time by CPU time, on the very same frames, photos and clouds.

  python tools/benchmarks/peers                                   all peers that are here
  python tools/benchmarks/peers visp --sequences castle,teabox    one peer, two sequences
  python tools/benchmarks/peers m3t --m3t ../3DObjectTracking     with a checkout of M3T
  python tools/benchmarks/peers colmap --photos FOLDER --part PART

A peer that is missing is left out, with a line that says how to get it."""

EPILOG = """\
peers:
  visp     the model-based tracker of ViSP, edges and edges with KLT points (Debian: libvisp-dev), from the first
           reference pose of each sequence. A part of more than 1,000 flat faces is simplified to as many triangles,
           and the edges of its smooth surfaces count where they are a silhouette: ViSP is not made for such parts
  m3t      the region tracker M3T (github.com/DLR-RM/3DObjectTracking) with a colour camera, likewise, with its
           defaults and with its authors' settings for RBOT; views of a new part take a minute, once, and do not count
  colmap   structure from motion by pycolmap's defaults, exhaustive matching, incremental and global mapping, beside
           `arview.reconstruct` to the scale; neither knows the camera, and arview has the CAD part for the scale
  clouds   point-to-plane ICP of open3d and GICP of small_gicp (both from PyPI) beside the registration to the surface

CPU time is user and system time of all threads. arview and the peers run in turn, A B A B, as often as --rounds says; a
column gives medians over the rounds, and in brackets the lowest and the highest round. In films only the tracker is in
the time, not the reading of pictures (for ViSP, not their conversion to grey either); the first frame does not count.
Trackers and ICP run with one OpenMP thread. Errors are those of the first round where there is a reference; "right" is
within 5 cm and 5°. The references of cube and teabox are tracks by ViSP itself: they say how far apart the two are,
not who is right.

$ARVIEW_DATA is the folder that holds sequences/. What is compiled goes to out/peers.
exit code: 0, or 1 when a peer that is here failed"""


def main() -> int:
    options = parser().parse_args()
    peers = tuple(options.peers or PEERS)
    failures: list[str] = []
    found: dict[str, Any] = {"machine": machine()}
    print(found["machine"], flush=True)
    if any(peer in peers for peer in ("visp", "m3t")):
        ways = tracking_ways(peers, options, failures)
        if ways:
            rows = track_rows(ways, options, failures)
            found["tracking"] = [asdict(row) for row in rows]
            print(f"\n{tracking_table(rows)}", flush=True)
    if "colmap" in peers:
        photos = attempt("colmap", lambda: photo_rows(options.photos, options.part, options.count, options.rounds),
                         failures) or []  # fmt: skip
        found["photos"] = [asdict(row) for row in photos]
        if photos:
            print(f"\n{photo_table(photos)}", flush=True)
    if "clouds" in peers:
        clouds = attempt("clouds", lambda: cloud_rows(options.rounds), failures) or []
        found["clouds"] = [asdict(row) for row in clouds]
        if clouds:
            print(f"\n{cloud_table(clouds)}", flush=True)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 1 if failures else 0


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="tools/benchmarks/peers", description=DESCRIPTION, epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    made.add_argument("peers", nargs="*", metavar="PEER", type=_peer, help=f"of {', '.join(PEERS)}; default: all")
    made.add_argument("--rounds", type=positive, default=3, metavar="N", help="default: 3")
    made.add_argument("--sequences", default=",".join(SEQUENCES), metavar="NAMES", help="default: %(default)s")
    made.add_argument("--frames", type=positive, metavar="N", help="of each sequence at most; default: all")
    scan_line = "ViSP also with its scan-line test of hidden edges, which takes several times as long"
    made.add_argument("--visp-scan-line", action="store_true", help=scan_line)
    made.add_argument("--m3t", type=Path, metavar="FOLDER", help="checkout of DLR-RM/3DObjectTracking")
    made.add_argument("--photos", type=Path, metavar="FOLDER", help="for colmap; default: made of the sample plate's")
    made.add_argument("--part", type=Path, metavar="PART", help="what is in the photos of --photos")
    made.add_argument("--count", type=positive, default=24, metavar="N", help="of photos that are made; default: 24")
    made.add_argument("--json", type=Path, metavar="FILE", help="write all figures to this file")
    return made


def _peer(text: str) -> str:
    if text not in PEERS:
        raise argparse.ArgumentTypeError(f"{text}: unknown; give some of {', '.join(PEERS)}")
    return text


def machine() -> str:
    """Processor, cores and load, in a line."""
    return f"{os.cpu_count()} cores, {platform.machine()}, load {os.getloadavg()[0]:.1f}"


def attempt(name: str, work: Callable[[], Any], failures: list[str]) -> Any:
    """What a peer gives; None, with a line on stderr, when it is missing or fails."""
    try:
        return work()
    except MissingPeerError as error:
        skip(name, str(error))
    except RuntimeError as error:
        failures.append(name)
        print(f"error: {name}: {error}", file=sys.stderr)
    return None


def tracking_ways(
    peers: tuple[str, ...], options: argparse.Namespace, failures: list[str]
) -> dict[str, Callable[[Film], Track]]:
    """The trackers that are here, by name."""
    ways: dict[str, Callable[[Film], Track]] = {}
    if "visp" in peers:
        ways |= attempt("visp", lambda: visp_ways(BUILD / "visp", options.visp_scan_line), failures) or {}
    if "m3t" in peers:
        ways |= attempt("m3t", lambda: m3t_ways(options.m3t, BUILD / "m3t"), failures) or {}
    return ways


def track_rows(
    ways: dict[str, Callable[[Film], Track]], options: argparse.Namespace, failures: list[str]
) -> list[TrackRow]:
    """All trackers on each sequence, arview first, in turn; one that fails is left out from there on."""
    rows = []
    for name, scene in scenes(tuple(options.sequences.split(","))).items():
        with tempfile.TemporaryDirectory() as folder:
            film = make_film(scene, Path(folder) / "film", options.frames)
            warm_up(film)
            tracks: dict[str, list[Track]] = {"arview": [], **{way: [] for way in ways}}
            for _ in range(options.rounds):
                for way in list(tracks):
                    work = partial(ways.get(way, track_with_arview), film)
                    track = attempt(f"{way} on {name}", work, failures)
                    if track is None:
                        del tracks[way]
                    else:
                        tracks[way].append(track)
            rows += [row_of(film, way, of_way) for way, of_way in tracks.items()]
            print(f"{name}: done", file=sys.stderr, flush=True)
    return rows


def tracking_table(rows: list[TrackRow]) -> str:
    """Times and errors of trackers."""
    own = {row.sequence: row.median_ms for row in rows if row.way == "arview"}
    head = ("sequence", "way", "CPU ms a frame", "95 %", "arview's / its", "followed", "right", "mm, max", "°, max")
    lines = []
    for row in rows:
        ratio = own[row.sequence]
        lines.append((
            row.sequence, row.way, with_range(row.rounds_ms, 2),
            "–" if row.p95_ms is None else f"{row.p95_ms:.2f}",
            "–" if row.median_ms is None or ratio is None else f"{ratio / row.median_ms:.2f}",
            f"{row.followed} of {row.evaluated}", f"{row.right} of {row.evaluated}",
            pair(row.translation_mm), pair(row.rotation_deg),
        ))  # fmt: skip
    return table(head, lines)


def photo_table(rows: list[PhotoRow]) -> str:
    """Times of structure from motion."""
    return table(
        ("way", "step", "CPU s", "photos placed"),
        [
            (row.way, row.step, with_range(row.rounds_s, 2),
             "" if row.placed is None else f"{row.placed} of {row.photos}")
            for row in rows
        ],
    )  # fmt: skip


def cloud_table(rows: list[CloudRow]) -> str:
    """Times and errors of registrations."""
    return table(
        ("surface", "way", "CPU s", "µm, max", "°, max"),
        [
            (row.on, row.way, with_range(row.rounds_s, 3),
             f"{1e3 * sum(row.translation_mm) / len(row.translation_mm):.2f}, {1e3 * max(row.translation_mm):.2f}",
             "–" if row.rotation_deg is None else
             f"{sum(row.rotation_deg) / len(row.rotation_deg):.5f}, {max(row.rotation_deg):.5f}")
            for row in rows
        ],
    )  # fmt: skip


def with_range(values: list[float], digits: int) -> str:
    """Median, and the lowest and highest in brackets."""
    if not values:
        return "–"
    ordered = sorted(values)
    middle = 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
    if len(ordered) == 1:
        return f"{middle:.{digits}f}"
    return f"{middle:.{digits}f} ({ordered[0]:.{digits}f}–{ordered[-1]:.{digits}f})"


def pair(values: tuple[float, float] | None) -> str:
    """Median and maximum."""
    return "–" if values is None else f"{values[0]:.2f}, {values[1]:.2f}"


if __name__ == "__main__":
    sys.exit(main())
