"""The one place that knows pycolmap: loaded after zlib, no handlers left behind, cameras to the half pixel."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import arview
from arview.camera import Camera
from arview.geometry import apply, exp_se3
from arview.reconstruction.colmap import camera_of, colmap_camera, import_pycolmap, sparse_model_of, write_model
from arview.reconstruction.types import Photo

BROWN = Camera(640, 480, 700.0, 702.0, 321.0, 238.0, np.array([-0.1, 0.02, 1e-3, -5e-4, 3e-3]))
RADIAL = Camera(640, 480, 700.0, 700.0, 321.0, 238.0, np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))


IMPORTING = re.compile(r'import pycolmap\b|load\([^)]*"pycolmap"\)')


def test_nothing_else_imports_pycolmap() -> None:
    source = Path(arview.__file__).parent
    importing = [path.name for path in source.rglob("*.py") if IMPORTING.search(path.read_text(encoding="utf-8"))]
    assert importing == ["colmap.py"]


def test_zlib_is_there_first_and_a_terminated_run_is_silent() -> None:
    code = (
        "import sys, time\n"
        "from arview.reconstruction.colmap import import_pycolmap\n"
        "assert 'pycolmap' not in sys.modules\n"
        "import_pycolmap()\n"
        "names = list(sys.modules)\n"
        "assert names.index('zlib') < names.index('pycolmap')\n"
        "print('ready', flush=True)\n"
        "time.sleep(60)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    run.send_signal(signal.SIGTERM)
    _, errors = run.communicate(timeout=30)
    assert errors == "" and run.returncode == -signal.SIGTERM


@pytest.mark.parametrize(("camera", "is_calibrated"), [(BROWN, True), (RADIAL, False)])
def test_cameras_project_alike_but_for_the_half_pixel(camera: Camera, is_calibrated: bool) -> None:
    theirs = colmap_camera(camera, is_calibrated)
    points = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.35, 0.25, 1.0]])
    assert np.allclose(theirs.img_from_cam(points), camera.project(points) + 0.5, atol=1e-9)
    again = camera_of(theirs)
    assert np.allclose(again.matrix, camera.matrix) and np.allclose(again.dist, camera.dist)


def test_written_model_is_moved_like_the_sparse_model(tmp_path: Path) -> None:
    pycolmap = import_pycolmap()
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=4, num_points3D=30, camera_model_id=pycolmap.CameraModelId.RADIAL,
        camera_params=[1280.0, 512.0, 384.0, 0.05, -0.01],
    )  # fmt: skip
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "a").mkdir()
    model.write(str(tmp_path / "a"))
    camera = Camera(1024, 768, 1280.0, 1280.0, 511.5, 383.5)
    names = sorted(image.name for image in model.images.values())
    photos = [Photo(name, Path(name), 1024, 768, "lens", camera) for name in names]
    motion = exp_se3(np.array([0.3, -0.5, 0.2, 40.0, -20.0, 7.0]))
    moved = sparse_model_of(model, photos).transformed(12.5, motion)
    write_model(tmp_path / "a", tmp_path / "b", 12.5, motion)
    read = sparse_model_of(pycolmap.Reconstruction(str(tmp_path / "b")), photos)
    assert np.allclose(read.points_in_scan, moved.points_in_scan)
    for one, other in zip(read.photos, moved.photos, strict=True):
        assert np.allclose(one.cam_from_scan, other.cam_from_scan)
    seen = read.observed_photo == 0
    in_cam = apply(read.photos[0].cam_from_scan, read.points_in_scan[read.observed_point[seen]])
    assert np.abs(read.photos[0].camera.project(in_cam) - read.observed_px[seen]).max() < 1e-6
