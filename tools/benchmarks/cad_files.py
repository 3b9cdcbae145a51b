"""CAD files of a folder as arview reads them, beside what OpenCASCADE (STEP) and trimesh (meshes) find in them.

A row for each file: components, size in mm and seconds of arview; then what differs: number and names of components,
size. Needs ``cadquery-ocp-novtk<8`` for STEP. The files are not part of the project: give a folder of your own.

    python tools/benchmarks/cad_files.py FOLDER [--only PATTERN]
"""

from __future__ import annotations

import argparse
import re
import time
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arview.cad.load import SUFFIXES, load_cad
from arview.errors import ArviewError

TIMEOUT_S = 300.0
SIZE_DIFFERENCE = 0.01
STEP = (".step", ".stp")
WITHOUT_UNIT = (".obj", ".stl", ".ply")


class Found(NamedTuple):
    """What a reader finds in a file; ``fault`` is why it finds nothing."""

    names: tuple[str, ...] = ()
    size_mm: tuple[float, ...] = ()
    fault: str = ""
    notes: str = ""
    seconds: float = 0.0


def of_arview(path: Path) -> Found:
    began = time.perf_counter()
    unit = "mm" if path.suffix.lower() in WITHOUT_UNIT else None
    try:
        cad = load_cad(path, unit)
    except ArviewError as error:
        return Found(fault=str(error).removeprefix(f"{path}: "), seconds=time.perf_counter() - began)
    except Exception as error:
        return Found(fault=f"TRACEBACK {type(error).__name__}: {error}")
    size = np.ptp(cad.model.bounds_in_model, axis=0).tolist()
    names = tuple(component.name for component in cad.model.components)
    return Found(names, tuple(size), "", "; ".join(cad.notes), time.perf_counter() - began)


def of_opencascade(path: Path) -> Found:
    """Products at their places, by OpenCASCADE's own document, and the bounding box of their triangles."""
    occ: Any = lambda module, name: getattr(import_module(f"OCP.{module}"), name)  # noqa: E731
    document = occ("TDocStd", "TDocStd_Document")(occ("TCollection", "TCollection_ExtendedString")("doc"))
    reader = occ("STEPCAFControl", "STEPCAFControl_Reader")()
    reader.SetNameMode(True)
    if int(reader.ReadFile(str(path))) != 1 or not reader.Transfer(document):
        return Found(fault="not read")
    tool = occ("XCAFDoc", "XCAFDoc_DocumentTool").ShapeTool_s(document.Main())
    sequence, label_type = occ("TDF", "TDF_LabelSequence"), occ("TDF", "TDF_Label")
    name_type, shape_tool = occ("TDataStd", "TDataStd_Name"), occ("XCAFDoc", "XCAFDoc_ShapeTool")
    bounds, faces = occ("Bnd", "Bnd_Box")(), occ("TopExp", "TopExp_Explorer")
    face_kind = occ("TopAbs", "TopAbs_ShapeEnum").TopAbs_FACE

    def name_of(label: Any) -> str:
        attribute = name_type()
        return attribute.Get().ToExtString() if label.FindAttribute(name_type.GetID_s(), attribute) else ""

    def leaves(label: Any, name: str) -> Iterator[str]:
        target = label_type()
        if shape_tool.IsReference_s(label):
            shape_tool.GetReferredShape_s(label, target)
        else:
            target = label
        if not shape_tool.IsAssembly_s(target):
            if faces(shape_tool.GetShape_s(target), face_kind).More():
                yield name or name_of(target)
            return
        parts = sequence()
        shape_tool.GetComponents_s(target, parts)
        for index in range(1, parts.Length() + 1):
            part = parts.Value(index)
            yield from leaves(part, name_of(part))

    free = sequence()
    tool.GetFreeShapes(free)
    names: list[str] = []
    for index in range(1, free.Length() + 1):
        names += leaves(free.Value(index), "")
        shape = shape_tool.GetShape_s(free.Value(index))
        # Of triangles, because the box of surfaces without them reaches beyond trimmed ones; and without loose curves.
        occ("BRepMesh", "BRepMesh_IncrementalMesh")(shape, 0.1, False, 0.17, True)
        explorer = faces(shape, face_kind)
        while explorer.More():
            occ("BRepBndLib", "BRepBndLib").AddOptimal_s(explorer.Current(), bounds, True, False)
            explorer.Next()
    if bounds.IsVoid():
        return Found(tuple(names), fault="no shape")
    low, high = bounds.CornerMin(), bounds.CornerMax()
    size = [high.X() - low.X(), high.Y() - low.Y(), high.Z() - low.Z()]
    return Found(tuple(names), tuple(size))


def of_trimesh(path: Path) -> Found:
    import trimesh

    scene: Any = trimesh.load_scene(path, process=False)
    meshes = {name for name, mesh in scene.geometry.items() if len(getattr(mesh, "faces", ()))}
    nodes = [name for name in scene.graph.nodes_geometry if scene.graph[name][1] in meshes]
    if not nodes:
        return Found(fault="no triangles")
    factor = 1000.0 if path.suffix.lower() in (".glb", ".gltf") else 1.0
    if path.suffix.lower() == ".3mf":
        factor = trimesh.units.unit_conversion(scene.units or "mm", "mm")
    size = np.ptp(scene.bounds, axis=0) * factor
    return Found(tuple(name for name in nodes), tuple(size.tolist()))


def reference(path: Path) -> Found:
    try:
        return of_opencascade(path) if path.suffix.lower() in STEP else of_trimesh(path)
    except Exception as error:  # whatever another reader stumbles over
        return Found(fault=f"{type(error).__name__}: {error}"[:80])


def base_name(name: str) -> str:
    """A name without the number, the assembly and the file type that readers add to make it unique."""
    return re.sub(r"(_\d+)?$", "", name.rpartition("/")[2].strip())


def differences(own: Found, other: Found) -> list[str]:
    told = []
    if own.fault or other.fault:
        return [] if own.fault and other.fault else [f"arview: {own.fault or 'read'}; other: {other.fault or 'read'}"]
    if len(own.names) != len(other.names):
        told.append(f"{len(other.names)} components by the other")
    else:
        # Names of files and numbers are what a reader gives to what has none.
        lost = Counter(map(base_name, other.names)) - Counter(map(base_name, own.names))
        lost = Counter(
            {
                name: n
                for name, n in lost.items()
                if name and not re.search(r"^\d+$|\.(stl|ply|obj)$|^=>\[|^NAUO\d|^Open CASCADE", name, re.I)
            }
        )
        if lost:
            told.append(f"names of the other: {', '.join(list(lost)[:3])}; here {', '.join(own.names[:3])}")
    apart = max(abs(a - b) for a, b in zip(own.size_mm, other.size_mm, strict=True))
    if apart > SIZE_DIFFERENCE * max(own.size_mm):
        told.append(f"size by the other {' × '.join(f'{value:.4g}' for value in other.size_mm)}")
    return told


def system_of(path: Path) -> str:
    """Name of the program that wrote a STEP file, by its header."""
    if path.suffix.lower() not in STEP:
        return path.suffix[1:].lower()
    head = path.read_bytes()[:6000].decode("latin-1")
    entry = re.search(r"FILE_NAME\s*\((.*?)\)\s*;", head, re.DOTALL)
    return " | ".join(re.findall(r"'([^']*)'", entry[1])[-3:-1])[:60] if entry else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="*", help="pattern of the names of files")
    arguments = parser.parse_args()
    paths = [path for path in sorted(arguments.folder.rglob(arguments.only)) if path.suffix.lower() in SUFFIXES]
    counts: Counter[str] = Counter()
    with get_context("spawn").Pool(1, maxtasksperchild=10) as other:
        for path in paths:
            waiting = other.apply_async(reference, (path,))
            own = of_arview(path)
            try:
                told = differences(own, waiting.get(TIMEOUT_S))
            except Exception as error:
                told = [f"the other gave up ({type(error).__name__})"]
            counts[path.suffix.lower()] += 1
            counts["different"] += bool(told)
            size = " × ".join(f"{value:.4g}" for value in own.size_mm) or own.fault
            row = (path.relative_to(arguments.folder).as_posix(), system_of(path), f"{len(own.names)} components", size)
            print(" ; ".join(row), f"{own.seconds:.1f} s", sep=" ; ", flush=True)
            for line in (*told, *([own.notes] if own.notes else [])):
                print("    ", line, flush=True)
    print(", ".join(f"{name} {count}" for name, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
