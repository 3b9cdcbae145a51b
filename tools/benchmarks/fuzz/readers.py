"""The readers of files under test, and plain readers whose answers theirs must equal."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from guard import Fault
from lxml import etree

from arview.acceptance.lengths import read_known, read_measured
from arview.acceptance.position_list import read_position_list
from arview.cad import load_part
from arview.cad.formats.step_text import prepare_step, step_unit_mm
from arview.cad.load import load_cad
from arview.camera.read import load_camera
from arview.errors import InputError
from arview.guideviews import load_guide_views
from arview.inspection import load_inspection
from arview.inspection.export import to_csv, to_dfq, to_qif
from arview.measurement.cloud.reading.files import read_points
from arview.quality.batch.jobs_file import load_jobs
from arview.reconstruction.given_poses import read_poses
from arview.reconstruction.intake.reading import glance, read_photo
from arview.reconstruction.scale.specs import load_rig, load_scale_file
from arview.video import open_source
from helpers.paths import SHARED, TESTS

MAX_FRAMES = 40


def differs(kind: str, text: str) -> Fault:
    """The fault of an answer that is not the plain reader's."""
    return Fault(f"{kind} another answer than the plain reader's", text)


def read_cad(path: Path, seeds: Path) -> None:
    """A CAD file; STL, PLY and OBJ against trimesh: the box around all triangles."""
    model = load_cad(path, "m" if path.suffix in (".glb", ".gltf") else "mm").model
    if path.suffix not in (".stl", ".ply"):
        return
    import trimesh

    try:
        plain = trimesh.load(io.BytesIO(path.read_bytes()), file_type=path.suffix[1:], process=False)
        corners = np.asarray(plain.triangles, dtype=np.float64)
    except BaseException:  # trimesh raises anything on damaged files
        return
    edges = corners[:, 1:] - corners[:, :1]
    corners = corners[np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 1e-6]
    if len(corners) == 0 or not np.isfinite(corners).all():
        return
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    bounds = np.asarray(model.bounds_in_model)
    if not np.allclose(bounds, [low, high], atol=1e-3 * float((high - low).max())):
        raise differs(path.suffix, f"{bounds.tolist()} instead of {[low.tolist(), high.tolist()]}")


def read_camera(path: Path, seeds: Path) -> None:
    """A camera file; arview and BOP JSON against the JSON itself."""
    camera = load_camera(path)
    camera.project(np.array([[0.01, 0.02, 1.0]]))
    if path.name.startswith(("arview", "bop")):
        try:
            plain = dict(json.loads(path.read_bytes()))
        except (TypeError, ValueError):  # read by another, more lenient format
            return
        for name in {"fx", "fy", "cx", "cy", "width", "height"} & set(plain):
            if float(getattr(camera, name)) != float(plain[name]):
                raise differs("camera", f"{name} {getattr(camera, name)} instead of {plain[name]}")


def read_picture(path: Path, seeds: Path) -> None:
    """A photo; lossless ones against OpenCV."""
    import cv2

    pixels = read_photo(path)
    glance(path.read_bytes())
    plain = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.suffix in (".png", ".bmp") else None
    if plain is not None and path.name != "deep.png":
        if plain.shape != pixels.shape:
            raise differs("picture", f"{pixels.shape} instead of {plain.shape}")
        if path.suffix == ".png" and not np.array_equal(plain[:, :, ::-1], pixels):
            raise differs("picture", "other pixels")


def read_video(path: Path, seeds: Path) -> None:
    """Frames of a video: times rise, sizes stay."""
    with open_source(path) as source:
        last_s, shape = -np.inf, None
        for count, frame in enumerate(source):
            if not np.isfinite(frame.time_s) or frame.time_s < last_s:
                raise Fault("video time runs back", f"{last_s} {frame.time_s}")
            if shape is not None and frame.image.shape != shape:
                raise Fault("video size changes", f"{shape} {frame.image.shape}")
            last_s, shape = frame.time_s, frame.image.shape
            if count >= MAX_FRAMES:
                break


def read_cloud(path: Path, seeds: Path) -> None:
    """A cloud; XYZ against NumPy."""
    raw = read_points(path)
    if not (np.isfinite(raw.points).all() and np.isfinite(raw.origin).all()):
        raise Fault("cloud not finite", str(raw.origin))
    if path.suffix == ".xyz":
        try:
            plain = np.loadtxt(path, ndmin=2)
        except Exception:  # damaged
            return
        if plain.shape[1] == 3 and (np.abs(plain) < 1e12).all():
            own = raw.points + raw.origin
            if own.shape != plain.shape or not np.allclose(
                own, plain, rtol=1e-5, atol=1e-4 + 1e-6 * np.abs(plain).max()
            ):
                raise differs("cloud", f"{own.shape} {plain.shape}")


def read_inspection(path: Path, seeds: Path) -> None:
    """An inspection against its JSON: names, verdicts, displacements."""
    inspection = load_inspection(path)
    plain = json.loads(path.read_bytes())["components"]
    if [one.name for one in inspection.components] != [one["name"] for one in plain]:
        raise differs("inspection", "names")
    for own, one in zip(inspection.components, plain, strict=True):
        if own.verdict.value != one["verdict"] or list(own.displacement_mm) != list(one["displacement_mm"]):
            raise differs("inspection", f"{own} instead of {one}")


def read_positions(path: Path, seeds: Path) -> None:
    """A list of a measuring machine; one with commas against Python's csv."""
    listed = read_position_list(path)
    if path.name == "deviations.csv":
        try:
            rows = list(csv.DictReader(io.StringIO(path.read_bytes().decode("utf-8"), newline="")))
        except (UnicodeDecodeError, csv.Error):
            return
        if all(set(row) == {"component", "dx", "dy", "dz", "Ux", "Uy", "Uz"} for row in rows):
            for own, row in zip(listed, [row for row in rows if any(row.values())], strict=True):
                plain = [float(row[f"d{axis}"] or "nan") for axis in "xyz"]
                if not np.array_equal(own.displacement, plain, equal_nan=True):
                    raise differs("positions", f"{own} instead of {row}")


def read_part(path: Path, seeds: Path) -> None:
    """A part file, beside its CAD file."""
    part = load_part(path)
    _ = part.effective_view_range, part.model.components


def read_lengths(path: Path, seeds: Path) -> None:
    """Measured marks and known lengths."""
    if path.suffix == ".csv":
        read_measured(path)
    else:
        read_known(path, read_measured(seeds / "marks.csv"))


def read_step_text(path: Path, seeds: Path) -> None:
    """What is read of a STEP file without OpenCASCADE: encoding, instances, solids, unit, products without shape."""
    data = path.read_bytes()
    prepared, _ = prepare_step(data, path)
    with suppress(InputError):
        step_unit_mm(prepared, path)


def read_given(path: Path, seeds: Path) -> None:
    """Poses of photos by nerfstudio, Metashape and COLMAP; they must be rigid."""
    if path.suffix == ".txt":
        folder = path.parent / "colmap"
        folder.mkdir(exist_ok=True)
        (folder / "cameras.txt").write_text("1 OPENCV 640 480 600 601 320 240 0.1 -0.05 0.001 0.0\n")
        (folder / "points3D.txt").write_text("")
        (folder / "images.txt").write_bytes(path.read_bytes())
        path = folder
    for one in read_poses(path):
        pose = one.cam_from_scan
        if not np.isfinite(pose).all() or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6):
            raise Fault("given pose is not rigid", f"{one}")


def read_and_export(path: Path, seeds: Path) -> None:
    """QIF, DFQ and CSV of an inspection that was accepted: QIF by its schema, CSV against the inspection."""
    inspection = load_inspection(path)
    document = etree.fromstring(to_qif(inspection))
    if not _qif_schema().validate(document):
        raise Fault("QIF is not valid", str(_qif_schema().error_log)[:300])
    to_dfq(inspection)
    rows = list(csv.DictReader(io.StringIO(to_csv(inspection), newline="")))
    if len(rows) != len(inspection.components):
        raise differs("csv", f"{len(rows)} rows of {len(inspection.components)} components")


@cache
def _qif_schema() -> Any:
    published = SHARED / "qif3" / "QIFApplications" / "QIFDocument.xsd"
    return etree.XMLSchema(etree.parse(published if published.is_file() else TESTS / "inspection" / "qif3_subset.xsd"))


def read_guide_views(path: Path, seeds: Path) -> None:
    """Guide views, each of which is decoded."""
    for view in load_guide_views(path):
        _ = view


READERS: dict[str, Callable[[Path, Path], Any]] = {
    "cad": read_cad,
    "step": lambda path, _: load_cad(path),
    "step_text": read_step_text,
    "camera": read_camera,
    "picture": read_picture,
    "video": read_video,
    "cloud": read_cloud,
    "inspection": read_inspection,
    "exports": read_and_export,
    "positions": read_positions,
    "part": read_part,
    "lengths": read_lengths,
    "guideviews": read_guide_views,
    "scale": lambda path, _: load_scale_file(path),
    "rig": lambda path, _: load_rig(path),
    "given": read_given,
    "jobs": lambda path, _: load_jobs(path),
}
