"""Clouds of other programs: every format, separators, units, damaged files, very many points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from arview.errors import InputError
from arview.geometry import Array
from arview.measurement.cloud import placing
from arview.measurement.cloud.placing import cloud_in_mm
from arview.measurement.cloud.reading import RawPoints, possible_units, read_points, unit_of_option
from arview.measurement.folder import read_cloud
from helpers.plate_scene import nominal

POINTS = np.round(np.random.default_rng(4).uniform(-150.0, 250.0, (900, 3)), 3)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


def rows_of(values: Array, separator: str = " ", mark: str = ".") -> str:
    return "\n".join(separator.join(f"{v:.6f}".replace(".", mark) for v in row) for row in values) + "\n"


def ply(order: str = "<", kind: str = "binary_little_endian", count: int = 900, columns: Array = POINTS) -> bytes:
    names = ["x", "y", "z", "nx", "ny", "nz"][: columns.shape[1]]
    head = ["ply", f"format {kind} 1.0", "comment by a scanner", f"element vertex {count}"]
    head += [*(f"property float {name}" for name in names), "end_header", ""]
    body = rows_of(columns).encode() if kind == "ascii" else columns.astype(order + "f4").tobytes()
    return "\n".join(head).encode() + body


def pcd(count: int = 900) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\n"
    return (head + "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {0}\nDATA ascii\n").format(count).encode() + rows_of(
        POINTS
    ).encode()


def check(path: Path, content: bytes | str, has_normals: bool = False) -> RawPoints:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    raw = read_points(path)
    assert raw.points + raw.origin == pytest.approx(POINTS, abs=1e-3)
    assert (raw.normals is not None) == has_normals
    if raw.normals is not None:
        assert raw.normals == pytest.approx(NORMALS, abs=1e-4)
    return raw


def test_text_with_any_separator(tmp_path: Path) -> None:
    check(tmp_path / "a.xyz", rows_of(POINTS))
    check(tmp_path / "b.txt", "# made by hand\n\n" + rows_of(POINTS, "\t"))
    check(tmp_path / "c.csv", "\ufeffX,Y,Z\n" + rows_of(POINTS, ","))
    check(tmp_path / "d.csv", rows_of(POINTS, ";", ",").replace("\n", "\r\n"))
    check(tmp_path / "e.xyz", rows_of(POINTS, " ", ","))
    numbered = np.column_stack([np.arange(900), POINTS[:, ::-1]])
    raw = check(tmp_path / "f.csv", "Nr;Z [mm];Y [mm];X [mm]\n" + rows_of(numbered, ";", ","))
    assert raw.unit == "mm"
    many = np.column_stack([POINTS, np.full(900, -900), np.full((900, 3), 128)])
    check(tmp_path / "g.pts", "900\n" + rows_of(many))
    check(tmp_path / "h.xyz", rows_of(np.column_stack([POINTS, NORMALS])), True)
    check(tmp_path / "i.asc", "//X Y Z Nx Ny Nz\n" + rows_of(np.column_stack([POINTS, NORMALS])), True)


@pytest.mark.parametrize(
    "header",
    [
        "NomX,NomY,NomZ,ActX,ActY,ActZ",
        "Soll X;Soll Y;Soll Z;Ist X;Ist Y;Ist Z",
        "x_ref x_meas y_ref y_meas z_ref z_meas",
        "x_nominal\ty_nominal\tz_nominal\tx\ty\tz",
        "X,Y,Z,X measured,Y measured,Z measured",
        "X Nennwert [mm];Y Nennwert [mm];Z Nennwert [mm];X Messwert [mm];Y Messwert [mm];Z Messwert [mm]"
        "\nmm;mm;mm;mm;mm;mm",
    ],
)
def test_the_measured_columns_are_taken_by_name(header: str, tmp_path: Path) -> None:
    nominal = POINTS + np.random.default_rng(2).normal(0.0, 0.1, POINTS.shape)
    columns = np.column_stack([nominal, POINTS])
    columns = columns[:, [0, 3, 1, 4, 2, 5]] if "x_ref x_meas" in header else columns
    separator = next((mark for mark in ",;\t" if mark in header), " ")
    check(tmp_path / "a.csv", header + "\n" + rows_of(columns, separator))


@pytest.mark.parametrize(
    ("header", "says"),
    [
        ("", r"columns 1 to 3 and 4 to 6 both hold the places of points; name the measured columns ActX"),
        ("a,b,c,d,e,f\n", r"columns 1 to 3 and 4 to 6 both hold the places"),
        ("X1,Y1,Z1,X2,Y2,Z2\n", r"several places for each point \(x1, y1, z1, x2, y2, z2\); name the measured"),
        ("Xn,Yn,Zn,Xa,Ya,Za\n", r"several places for each point"),
        ("X,Y,Z,X,Y,Z\n", r"the column 'x' is there twice; name the measured"),
        ("NomX,NomY,NomZ,DevX,DevY,DevZ\n", r"only the nominal places nomx, nomy, nomz are named"),
        ("IstX,IstY,IstZ,ActX,ActY,ActZ\n", r"several places for each point"),
    ],
)
def test_which_columns_are_measured_is_asked(header: str, says: str, tmp_path: Path) -> None:
    nominal = POINTS + np.random.default_rng(2).normal(0.0, 0.1, POINTS.shape)
    (tmp_path / "a.csv").write_text(header + rows_of(np.column_stack([nominal, POINTS]), ","))
    with pytest.raises(InputError, match=says) as caught:
        read_points(tmp_path / "a.csv")
    assert str(caught.value).startswith(str(tmp_path / "a.csv")) and "\n" not in str(caught.value)


def test_a_block_may_end_inside_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.measurement.cloud.reading.text.BLOCK_BYTES", 1000)
    (tmp_path / "a.xyz").write_text(rows_of(POINTS))
    raw = read_points(tmp_path / "a.xyz")
    assert raw.points + raw.origin == pytest.approx(POINTS, abs=1e-3)


def test_damaged_lines_are_counted_or_refused(tmp_path: Path) -> None:
    lines = rows_of(POINTS).splitlines()
    lines[100], lines[200], lines[300] = "1.0 2.0", "12.0 scanner -4", "nan nan nan"
    (tmp_path / "a.xyz").write_text("\n".join(lines))
    raw = read_points(tmp_path / "a.xyz")
    assert len(raw) == 897
    assert raw.notes == ("2 unreadable lines were left out", "1 points without sensible coordinates were left out")
    lines[0] = "1e308 0 0"
    (tmp_path / "c.xyz").write_text("\n".join(lines))
    raw = read_points(tmp_path / "c.xyz")
    assert len(raw) == 896 and "2 points without sensible coordinates were left out" in raw.notes
    assert np.abs(raw.points + raw.origin).max() < 1e4
    lines[::7] = ["1.0 2.0"] * len(lines[::7])
    (tmp_path / "b.xyz").write_text("5 5 5\n" + "\n".join(lines))
    with pytest.raises(InputError, match=r"lines do not hold 3 numbers, as '1.0 2.0'"):
        read_points(tmp_path / "b.xyz")


def test_ply_and_pcd(tmp_path: Path) -> None:
    both = np.column_stack([POINTS, NORMALS])
    check(tmp_path / "a.ply", ply())
    check(tmp_path / "b.ply", ply(">", "binary_big_endian", columns=both), True)
    check(tmp_path / "c.ply", ply(kind="ascii", columns=both), True)
    check(tmp_path / "d.pcd", pcd())


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_faces_of_a_mesh_are_sampled(suffix: str, scale: float, tmp_path: Path) -> None:
    """A box of 80 × 60 × 10 mm has eight vertices; its faces are covered evenly, whatever its unit."""
    mesh = trimesh.creation.box((80.0 * scale, 60.0 * scale, 10.0 * scale))
    mesh.export(tmp_path / f"a{suffix}")
    raw = read_points(tmp_path / f"a{suffix}")
    points = (raw.points + raw.origin) / scale
    assert len(points) > 100_000
    beyond = np.abs(points) - [40.0, 30.0, 5.0]
    assert np.abs(beyond.max(axis=1)).max() < 1e-3  # every point is on a face
    top = np.count_nonzero(beyond[:, 2] > -1e-3) / len(points)
    assert top == pytest.approx(2 * 80 * 60 / (2 * (80 * 60 + 80 * 10 + 60 * 10)), abs=0.01)
    assert raw.normals is not None
    assert np.sum(raw.normals * points, axis=1).min() > 4.0  # outwards
    assert any("faces of the mesh were sampled" in note for note in raw.notes)


def test_damaged_meshes_are_refused(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(3, 20.0)
    for suffix in (".ply", ".stl"):
        mesh.export(tmp_path / f"a{suffix}")
        content = (tmp_path / f"a{suffix}").read_bytes()
        (tmp_path / f"b{suffix}").write_bytes(content[: len(content) // 2 + 7])
        with pytest.raises(InputError, match=r"truncated") as caught:
            read_points(tmp_path / f"b{suffix}")
        assert "\n" not in str(caught.value)


def ptx(stations: int = 2, per_scan: int = 600) -> str:
    """Half of the points each from its own station, in metres, with rays that did not return."""
    text = ""
    for index, seen in enumerate(np.array_split(POINTS / 1000.0, stations)):
        turn = trimesh.transformations.rotation_matrix(0.4 + index, (0.2, 0.3, 1.0))
        turn[:3, 3] = (1.0, -2.0, 0.5 * index)
        own = (seen - turn[:3, 3]) @ turn[:3, :3]
        own = np.vstack([own, np.zeros((per_scan - len(own), 3))])
        text += f"{per_scan // 10}\n10\n" + rows_of(turn[None, :3, 3]) + rows_of(turn[:3, :3].T) + rows_of(turn.T)
        text += rows_of(np.column_stack([own, np.full(per_scan, 0.5)]))
    return text


def test_stations_of_a_ptx_are_brought_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for lines in (1_000_000, 7):
        monkeypatch.setattr("arview.measurement.cloud.reading.ptx.CHUNK_LINES", lines)
        (tmp_path / "a.ptx").write_text(ptx())
        raw = read_points(tmp_path / "a.ptx")
        assert (raw.points + raw.origin) * 1000.0 == pytest.approx(POINTS, abs=5e-3)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda lines: lines[:-300], "scan 2 is truncated: its header names 600 points"),
        (lambda lines: ["99999", "99999", *lines[2:]], "holds 9999800001 points; at most"),
        (lambda lines: ["9999", "999", *lines[2:]], "scan 1 is truncated"),
        (lambda lines: ["sixty", *lines[1:]], "'sixty' is no number of columns or rows"),
        (lambda lines: [*lines[:6], "2 0 0 0", *lines[7:]], "its matrix is no rigid motion"),
        (lambda lines: [*lines[:6], *lines[7:]], "its matrix is no rigid motion"),
        (lambda lines: [*lines[:3], *lines[4:]], "its header is damaged"),
        (lambda lines: [*lines[:20], "1.0 scanner 2", *lines[21:]], "a line of points is damaged"),
        (lambda lines: [*lines[:20], "1.0", *lines[21:]], "a line of points is damaged"),
    ],
)
def test_damaged_ptx_is_refused(change: Callable[[list[str]], list[str]], says: str, tmp_path: Path) -> None:
    (tmp_path / "a.ptx").write_text("\n".join(change(ptx().splitlines())))
    with pytest.raises(InputError, match=says) as caught:
        read_points(tmp_path / "a.ptx")
    assert str(caught.value).startswith(str(tmp_path / "a.ptx")) and "\n" not in str(caught.value)


def test_las_laz_and_e57(tmp_path: Path) -> None:
    import laspy
    import pye57

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [1e-4] * 3, [4_500_000.0, 5_300_000.0, 0.0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = (POINTS + header.offsets).T
    for name in ("a.las", "b.laz"):
        las.write(tmp_path / name)
        raw = read_points(tmp_path / name)
        assert raw.points + (raw.origin - header.offsets) == pytest.approx(POINTS, abs=1e-3)
    file = pye57.E57(str(tmp_path / "c.e57"), mode="w")
    half = len(POINTS) // 2
    for part in (POINTS[:half], POINTS[half:]):
        file.write_scan_raw({f"cartesian{axis}": part[:, k].copy() for k, axis in enumerate("XYZ")})
    file.close()
    raw = read_points(tmp_path / "c.e57")
    assert raw.points + raw.origin == pytest.approx(POINTS, abs=1e-3)
    (tmp_path / "d.laz").write_bytes((tmp_path / "b.laz").read_bytes()[:2500])
    (tmp_path / "e.e57").write_bytes((tmp_path / "c.e57").read_bytes()[:3000])
    for name in ("d.laz", "e.e57"):
        with pytest.raises(InputError, match=r"damaged|truncated"):
            read_points(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", ply(count=901), "names 901 points"),
        ("b.ply", ply(kind="ascii")[:9000], "is truncated"),
        ("b2.ply", b"k".join(ply(kind="ascii").rsplit(b"1", 1)), "is truncated or damaged"),
        ("c.ply", ply(count=90_000_000_000), "at most 100000000 are read"),
        ("d.ply", b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n", "header is damaged"),
        ("e.pcd", pcd(5000), "is truncated"),
        (
            "p.pts",
            b"901\n" + rows_of(POINTS).encode(),
            "is truncated: its header names 901 points",
        ),
        ("f.pcd", b"DATA\n" * 20, "is not a PCD file"),
        ("g.las", b"LASF" + b"\0" * 400, "is not a LAS file"),
        ("h.xyz", b"", "is empty"),
        ("i.xyz", b"a" * 100_000, "no line with three numbers"),
        ("j.xyz", b"1 2 3\n" + b"7" * 90_000, "a line of more than"),
        ("k.csv", b"a,b\n" + b"1,2\n" * 40, "no line with three numbers"),
        ("l.step", b"solid", "is no known format"),
        ("m.xyz", b"\0\1\2\3" * 50, "is not a text file"),
    ],
)
def test_files_that_are_no_clouds(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / name)


# --- unit ------------------------------------------------------------------------------------------------


def raw_of(points: Array) -> RawPoints:
    return RawPoints(points.astype(np.float32), None, np.zeros(3))


def test_the_unit_is_found_by_size() -> None:
    cube = np.random.default_rng(0).uniform(0.0, 100.0, (5000, 3))
    for unit, factor in (("mm", 1.0), ("m", 1000.0), ("inch", 25.4)):
        assert possible_units(raw_of(cube / factor), 180.0, "a.ply") == [unit]
    for unit, factor in (("cm", 10.0), ("ft", 304.8), ("um", 1e-3)):  # tried before a usual unit that is possible
        assert possible_units(raw_of(cube / factor), 180.0, "a.ply")[0] == unit
    assert possible_units(raw_of(2.0 * cube / 25.4), 180.0, "a.ply") == ["inch", "cm"]
    assert set(possible_units(raw_of(4.0 * cube / 25.4), 180.0, "a.ply")) == {"inch", "cm", "mm"}
    # A fragment of a quarter in mm, or a part on a table in inch: the place decides.
    assert possible_units(raw_of(0.25 * cube), 180.0, "a.ply") == ["mm", "inch"]
    with pytest.raises(InputError, match=r"a\.ply: is 1\.\d+e\+04 units across, the CAD 180 mm: neither in mm, m nor"):
        possible_units(raw_of(100.0 * cube), 180.0, "a.ply")
    assert unit_of_option("Inches") == "inch"
    with pytest.raises(InputError, match="expected one of mm, cm, m, inch"):
        unit_of_option("mile")


def test_units_are_said_and_may_be_given(tmp_path: Path) -> None:
    size = nominal().diameter_mm
    cube = np.random.default_rng(0).uniform(0.0, 0.55 * size, (2000, 3))
    (tmp_path / "a.xyz").write_text(rows_of(cube / 1000.0))
    by_size = read_cloud(tmp_path / "a.xyz", nominal())
    assert by_size.cloud is not None and by_size.cloud.points == pytest.approx(cube, abs=2e-3)
    assert by_size.scale.warnings == ("the cloud is in m (by its size beside the CAD's)",)
    (tmp_path / "b.csv").write_text("x (m),y (m),z (m)\n" + rows_of(cube / 1000.0, ","))
    assert read_cloud(tmp_path / "b.csv", nominal()).scale.warnings == ("the cloud is in m (declared by the file)",)
    given = read_cloud(tmp_path / "b.csv", None, "cm")
    assert given.cloud is not None and given.cloud.points == pytest.approx(cube / 100.0, abs=1e-3)
    with pytest.raises(InputError, match=r"b\.csv: in cm it is .* mm across, .*: --cloud-unit m fits"):
        read_cloud(tmp_path / "b.csv", nominal(), "cm")


def test_large_clouds_are_averaged_without_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten points of a noisy plane in each cell: the average lies on the plane, and offsets are kept."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0.0, 20.0, (60_000, 2)), rng.normal(0.0, 0.05, 60_000)])
    normals = np.tile(np.float32([0, 0, 1]), (60_000, 1))
    raw = RawPoints(points.astype(np.float32), normals, np.array([1e6, 0.0, 3.0]))
    for name, value in {"MAX_POINTS": 10_000, "GRID_MM": 0.5, "CHUNK_POINTS": 16_000}.items():
        monkeypatch.setattr(placing, name, value)
    thin = cloud_in_mm(raw, "mm")
    assert 1600 <= len(thin.points) < 6000
    assert thin.points.mean(axis=0) == pytest.approx([1e6 + 10.0, 10.0, 3.0], abs=0.1)
    assert np.abs(thin.points[:, 2].mean() - 3.0) < 0.002
    assert thin.normals == pytest.approx(np.tile([0, 0, 1], (len(thin.points), 1)))
