"""Small valid files of every kind that arview reads, from which fuzzed ones are made."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from arview.cad import load_part
from arview.guideviews import GuideViewOptions, make_guide_views
from helpers.cad_files import StepBodies, StepWriter, box, nested_3mf, nested_glb, nested_step, obj_text
from helpers.video_files import numbered, write_clip

ROOT = Path(__file__).resolve().parents[3]
SAMPLE = ROOT / "samples" / "bracket_plate"
K = [[600.0, 0.0, 319.5], [0.0, 601.0, 239.5], [0.0, 0.0, 1.0]]

CAMERAS = {
    "arview.json": json.dumps(
        {
            "fx": 600,
            "fy": 601,
            "cx": 319.5,
            "cy": 239.5,
            "width": 640,
            "height": 480,
            "dist": [0.1, -0.05, 0.001, 0.0, 0.01],
        }
    ),
    "bop.json": json.dumps(
        {"depth_scale": 1, "fx": 600, "fy": 601, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
    ),
    "opencv.yml": "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
    "   cols: 3\n   dt: d\n   data: [ 600., 0., 319.5, 0., 601., 239.5, 0., 0., 1. ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
    "   data: [ 0.1, -0.05, 0.001, 0., 0.01 ]\n",
    "opencv.xml": '<?xml version="1.0"?>\n<opencv_storage>\n<image_width>640</image_width>\n'
    '<image_height>480</image_height>\n<camera_matrix type_id="opencv-matrix">\n<rows>3</rows>'
    "<cols>3</cols><dt>d</dt>\n<data>600. 0. 319.5 0. 601. 239.5 0. 0. 1.</data></camera_matrix>\n"
    '<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>'
    "<data>0.1 -0.05 0.001 0. 0.01</data></distortion_coefficients>\n</opencv_storage>\n",
    "ros.yaml": "image_width: 640\nimage_height: 480\ncamera_name: cam\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    "  data: [600, 0, 319.5, 0, 601, 239.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
    "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, -0.05, 0.001, 0, 0.01]\n"
    "roi: {x_offset: 0, y_offset: 0, width: 0, height: 0, do_rectify: false}\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n"
    "  distortion_coeffs: [0.1, -0.05, 0.001, 0.0]\n  intrinsics: [600, 601, 319.5, 239.5]\n"
    "  resolution: [640, 480]\n",
    "cameras.txt": "# Camera list\n1 OPENCV 640 480 600 601 320 240 0.1 -0.05 0.001 0.0\n",
    "realsense.json": json.dumps(
        {
            "width": 640,
            "height": 480,
            "fx": 600,
            "fy": 601,
            "ppx": 319.5,
            "ppy": 239.5,
            "model": "Brown Conrady",
            "coeffs": [0.1, -0.05, 0.001, 0.0, 0.01],
        }
    ),
    "transforms.json": json.dumps(
        {
            "fl_x": 600,
            "fl_y": 601,
            "cx": 320,
            "cy": 240,
            "w": 640,
            "h": 480,
            "k1": 0.1,
            "k2": 0,
            "p1": 0,
            "p2": 0,
            "camera_model": "OPENCV",
            "frames": [],
        }
    ),
}
TABLES = {
    "cmm.csv": "name;x [mm];y [mm];z [mm];U\npost_1;10,5;20,25;0,1;0,005\npost_2;30;40,5;0;0,005\n",
    "deviations.csv": "component,dx,dy,dz,Ux,Uy,Uz\npost_1,0.1,-0.2,0.05,0.01,0.01,0.02\npost_2,0,0,0,0.01,0.01,0.01\n",
}
PART = """[part]
name = "brick"
cad = "brick.stl"
unit = "mm"
serial = "S-1"
[components.brick]
role = "base"
position_tolerance_mm = 0.5
[view_range]
distance_mm = [300.0, 500.0]
elevation_deg = [30.0, 60.0]
azimuth_deg = [-20.0, 20.0]
"""
SCALE = (
    '[[board]]\nspec = "charuco:8x6:30:22:DICT_5X5_100"\n[[tag]]\n'
    'dictionary = "DICT_4X4_50"\nside_mm = 20.0\nids = [1, 2]\n'
    '[[scale_bar]]\nids = [1, 2]\nlength_mm = 250.0\ndictionary = "DICT_4X4_50"\nstd_mm = 0.01\n'
    "[[tag_layout]]\nstd_mm = 0.01\ncorners_mm = { 1 = [[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0]] }\n"
    "[rig]\ncentres_mm = { a = [0, 0, 0], b = [100, 0, 0] }\n"
)
RIG = json.dumps(
    {"centres_mm": {"a.jpg": [0, 0, 0], "b.jpg": [100, 0, 0]}, "distances_mm": [["a.jpg", "b.jpg", 100.0]]}
)
JOBS = (
    'out = "results"\n[defaults]\npart = "part.toml"\n[[job]]\nname = "one"\nphotos = "a"\n[[job]]\nname = "two"\n'
    'photos = "b"\n'
)
LENGTHS = 'name = "bar"\ncertificate = "C-1"\n[[length]]\nbetween = ["post_1", "post_2"]\nmm = 30.5\nU_mm = 0.004\n'
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.2.0"><chunk><sensors next_id="1"><sensor id="0" label="cam" type="frame">
<resolution width="640" height="480"/><calibration type="frame" class="adjusted">
<resolution width="640" height="480"/><f>600.5</f><cx>1.5</cx><cy>-2.5</cy><k1>0.1</k1><k2>-0.05</k2></calibration>
</sensor></sensors><cameras>
<camera id="0" sensor_id="0" label="a"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>
<camera id="1" sensor_id="0" label="b"><transform>1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>
</cameras></chunk></document>
"""
IMAGES = "# Image list\n1 1 0 0 0 0.5 0.25 2.5 1 a.jpg\n\n2 0.8 0.6 0 0 0.5 0.25 2.5 1 b.jpg\n\n"
MARKS = "name,x,y,z\npost_1,0,0,0\npost_2,30.5,0,0\n"


def _cad(folder: Path) -> list[Path]:
    import trimesh

    vertices, faces = box((0, 0, 0), (10, 20, 30))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    (folder / "box.obj").write_text(obj_text("b", vertices, faces))
    (folder / "box_ascii.ply").write_bytes(mesh.export(file_type="ply", encoding="ascii"))
    (folder / "box.ply").write_bytes(mesh.export(file_type="ply"))
    (folder / "box_ascii.stl").write_text(mesh.export(file_type="stl_ascii"))
    (folder / "box.stl").write_bytes(mesh.export(file_type="stl"))
    (folder / "brick.stl").write_bytes(mesh.export(file_type="stl"))
    moved = mesh.copy()
    moved.apply_translation([30, 0, 0])
    embedded = trimesh.Scene({"a": mesh, "b": moved}).export(file_type="gltf", embed_buffers=True)
    (folder / "box.gltf").write_bytes(embedded["model.gltf"])
    names = ("box.obj", "box_ascii.ply", "box.ply", "box_ascii.stl", "box.stl", "box.gltf")
    return [nested_glb(folder), nested_3mf(folder), *(folder / name for name in names)]


def _pictures(folder: Path) -> list[Path]:
    paths = []
    image = numbered(3, 96, 64)
    for name in ("a.jpg", "a.png", "a.tif", "a.bmp", "a.webp"):
        cv2.imwrite(str(folder / name), image)
        paths.append(folder / name)
    cv2.imwrite(str(folder / "deep.png"), image.astype(np.uint16) * 257)
    return [*paths, folder / "deep.png"]


def _videos(folder: Path) -> list[Path]:
    paths = [folder / "a.mp4", folder / "a.mkv", folder / "a.avi"]
    for path in paths:
        write_clip(path, [numbered(k, 96, 64) for k in range(6)])
    return paths


def _clouds(folder: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3)) * 20.0
    rows = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in points)
    (folder / "c.xyz").write_text(rows + "\n")
    (folder / "c.pts").write_text(f"{len(points)}\n{rows}\n")
    (folder / "c.csv").write_text("x,y,z\n" + rows.replace(" ", ",") + "\n")
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 60\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 60\nDATA "
    )
    (folder / "c.pcd").write_text(f"{head}ascii\n{rows}\n")
    (folder / "b.pcd").write_bytes(f"{head}binary\n".encode() + points.astype("<f4").tobytes())
    header = "ply\nformat {} 1.0\nelement vertex 60\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (folder / "c.ply").write_text(header.format("ascii") + rows + "\n")
    (folder / "b.ply").write_bytes(header.format("binary_little_endian").encode() + points.astype("<f4").tobytes())
    las = bytearray(227 + 60 * 20)  # LAS 1.2, point format 0
    las[:4], las[24], las[25] = b"LASF", 1, 2
    las[94:96], las[96:100], las[104:107] = (227).to_bytes(2, "little"), (227).to_bytes(4, "little"), b"\0\x14\0"
    las[107:111], las[131:155] = (60).to_bytes(4, "little"), np.full(3, 0.001).tobytes()
    for index, row in enumerate(np.round(points * 1000).astype("<i4")):
        las[227 + 20 * index : 239 + 20 * index] = row.tobytes()
    (folder / "c.las").write_bytes(bytes(las))
    names = ("c.xyz", "c.pts", "c.csv", "c.pcd", "b.pcd", "c.ply", "b.ply", "c.las")
    return [folder / name for name in names]


def _texts(folder: Path, files: dict[str, str]) -> list[Path]:
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in files]


def _part(folder: Path) -> list[Path]:
    _cad(folder)
    return [*_texts(folder, {"part.toml": PART}), SAMPLE / "part.toml"]


def _step(folder: Path) -> list[Path]:
    bodies = StepBodies(
        "two", [("a", (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), None), ("b", (1.0, 1.0, 1.0), (3.0, 0, 0), None)]
    )
    return [nested_step(folder, "mm"), nested_step(folder, "inch"), StepWriter().write(folder / "bodies.step", bodies)]


def _given(folder: Path) -> list[Path]:
    poses = folder / "poses.json"
    frames = [{"file_path": f"{name}.jpg", "transform_matrix": np.eye(4).tolist()} for name in "abc"]
    poses.write_text(json.dumps({**json.loads(CAMERAS["transforms.json"]), "frames": frames}))
    return [poses, *_texts(folder, {"metashape.xml": METASHAPE, "images.txt": IMAGES})]


def _guide_views(folder: Path) -> list[Path]:
    _part(folder)
    part = load_part(folder / "part.toml")
    options = GuideViewOptions(subdivisions=0, resolution_px=100, renderer="zbuffer")
    make_guide_views(part.model, part.effective_view_range, options).save(folder / "brick.guideviews.npz")
    return [folder / "brick.guideviews.npz"]


_MAKERS: dict[str, Callable[[Path], list[Path]]] = {
    "cad": _cad,
    "step": _step,
    "step_text": _step,
    "camera": lambda folder: _texts(folder, CAMERAS),
    "picture": _pictures,
    "video": _videos,
    "cloud": _clouds,
    "positions": lambda folder: _texts(folder, TABLES),
    "part": _part,
    "scale": lambda folder: _texts(folder, {"scale.toml": SCALE}),
    "rig": lambda folder: _texts(folder, {"rig.json": RIG}),
    "given": _given,
    "jobs": lambda folder: _texts(folder, {"jobs.toml": JOBS}),
    "lengths": lambda folder: _texts(folder, {"lengths.toml": LENGTHS, "marks.csv": MARKS}),
    "inspection": lambda folder: [SAMPLE / "inspection.json"],
    "exports": lambda folder: [SAMPLE / "inspection.json"],
    "guideviews": _guide_views,
}


def make_seeds(folder: Path, *kinds: str) -> dict[str, list[Path]]:
    """Write the files of some kinds; returns their paths by kind."""
    folder.mkdir(parents=True, exist_ok=True)
    return {kind: _MAKERS[kind](folder) for kind in kinds}
