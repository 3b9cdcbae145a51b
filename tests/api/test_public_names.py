"""The public interface: names, order of arguments, quick import, errors that name what was passed."""

from __future__ import annotations

import inspect
import json
import pkgutil
import subprocess
import sys
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

import arview

HEAVY = ("numpy", "numba", "cv2", "torch", "av", "scipy", "trimesh", "pycolmap", "onnxruntime", "matplotlib", "click")
ROOT = Path(__file__).parents[2]


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_is_quick_and_light() -> None:
    code = (
        "import json, sys, time\n"
        "began = time.process_time()\n"
        "import arview\n"
        "print(json.dumps([time.process_time() - began, sorted(sys.modules), dir(arview)]))\n"
    )
    seconds, modules, names = json.loads(run_python(code))
    assert not set(HEAVY) & set(modules)
    assert seconds < 0.2
    assert set(arview.__all__) <= set(names)


def test_every_public_name_exists() -> None:
    assert len(arview.__all__) == len(set(arview.__all__)) > 20
    for name in arview.__all__:
        assert getattr(arview, name) is not None
    source = set(arview._MODULE_OF)
    assert source | {"ArviewError", "__version__"} == set(arview.__all__)
    with pytest.raises(AttributeError, match="no attribute 'load_everything'"):
        arview.load_everything  # noqa: B018


@pytest.mark.slow
def test_no_name_is_a_submodule() -> None:
    modules = {module.name for module in pkgutil.iter_modules(arview.__path__)}
    assert not modules & set(arview.__all__) and "annotation" in modules
    run_python("import arview.annotation, arview; assert callable(arview.annotate)")
    run_python("import arview; arview.annotate; import arview.annotation; assert callable(arview.annotate)")


def test_type_checkers_see_the_names() -> None:
    source = (ROOT / "src" / "arview" / "__init__.py").read_text(encoding="utf-8")
    block = source[source.index("if TYPE_CHECKING:") : source.index("__all__ =")]
    for name, module in arview._MODULE_OF.items():
        lines = [line for line in block.splitlines() if line.strip().startswith(f"from {module} import ")]
        assert len(lines) == 1 and name in lines[0].replace(",", "").split(), name
    assert (ROOT / "src" / "arview" / "py.typed").is_file()


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("Detector", ["views", "camera", "options"]),
        ("Tracker", ["views", "camera", "model", "options"]),
        ("TrackingSession", ["parts", "camera", "options"]),
        ("TrackingSession.of", ["views", "camera", "model", "options"]),
        ("OverlayRenderer", ["model", "camera", "inspection", "options"]),
        ("make_guide_views", ["model", "view_range", "options"]),
        ("load_part", ["path", "unit"]),
        ("load_model", ["path", "unit"]),
        ("load_camera", ["spec", "width", "height"]),
        ("load_guide_views", ["path", "model"]),
        ("load_inspection", ["path", "model"]),
        ("check_part", ["part", "camera"]),
        ("open_source", ["spec"]),
        ("annotate", ["source", "session", "overlay", "sink", "poses_path"]),
        ("reconstruct", ["source", "folder", "part", "camera", "options"]),
        ("measure", ["reconstruction", "part", "options"]),
        ("make_report", ["inspection", "html", "pdf", "part"]),
        ("inspect_part", ["job", "folder"]),
    ],
)
def test_order_of_arguments(name: str, arguments: list[str]) -> None:
    parameters = inspect.signature(attrgetter(name)(arview)).parameters.values()
    assert [one.name for one in parameters if one.kind is one.POSITIONAL_OR_KEYWORD] == arguments


def test_errors_name_what_was_passed() -> None:
    from arview.camera import Camera

    camera = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
    calls: list[tuple[Any, str]] = [
        (lambda: arview.load_part(5), r"^load_part: path: expected str or Path, got int \(5\)$"),
        (lambda: arview.load_camera(None), r"^load_camera: spec: expected str or Path, got None$"),
        (lambda: arview.Detector(camera, camera), r"^Detector: views: expected GuideViewSet, got Camera$"),
        (lambda: arview.TrackingSession.of(camera, camera, None), r"^TrackingSession: views: expected GuideViewSet"),
        (lambda: arview.OverlayRenderer(camera, camera), r"^OverlayRenderer: model: expected Model, got Camera$"),
        (lambda: arview.make_guide_views("part.step", None), r"^make_guide_views: model: expected Model, got str"),
        (lambda: arview.measure(7, None), r"^measure: reconstruction: expected MetricReconstruction or str or Path"),
        (lambda: arview.annotate("clip.mp4", None), r"^annotate: source: expected FrameSource, got str"),
        (lambda: arview.open_source(0), r"^open_source: spec: expected str or Path, got int \(0\)$"),
        (lambda: arview.inspect_part("out", "out"), r"^inspect_part: job: expected InspectJob, got str \('out'\)$"),
    ]
    for call, message in calls:
        with pytest.raises(TypeError, match=message):
            call()


def test_short_reprs() -> None:
    part = arview.load_part(str(ROOT / "samples" / "bracket_plate" / "part.toml"))
    faces = sum(len(component.faces) for component in part.model.components)
    count = len(part.model.components)
    diameter = f"{part.model.diameter_mm:.0f} mm"
    assert repr(part.model) == f"<Model {part.model.name}: {count} components, {faces:,} faces, {diameter}>"
    first = part.model.components[0]
    assert repr(first) == f"<Component {first.name}: {len(first.faces):,} faces>"
    assert repr(part).startswith(f"<Part {part.name}") and f"{len(part.inspected)} inspected>" in repr(part)
    camera = arview.load_camera(ROOT / "samples" / "bracket_plate" / "camera.json")
    assert repr(camera).startswith(f"<Camera {camera.width}×{camera.height}: f {camera.fx:.1f}")
    assert all(len(repr(one)) < 120 for one in (part, part.model, first, camera))


def test_stage_keys_do_not_depend_on_short_reprs() -> None:
    from arview.camera import Camera
    from arview.core.stage_cache import key_of

    first = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
    other = Camera(640, 480, 600.001, 600.0, 320.0, 240.0)
    assert repr(first) == repr(other)
    assert key_of([first], {"a": (1, "x")}) != key_of([other], {"a": (1, "x")})
    assert key_of([first]) == key_of([Camera(640, 480, 600.0, 600.0, 320.0, 240.0)])


def test_the_program_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "arview", "--version"], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == f"arview, version {arview.__version__}"
