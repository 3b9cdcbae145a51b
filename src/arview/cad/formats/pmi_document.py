"""Dimensions, tolerances and datums that OpenCASCADE finds in a STEP file (AP242), as JSON; for a limited process.

OpenCASCADE links dimensions and tolerances to faces, but few datums; those come as numbers of STEP statements.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Surface
from OCP.BRepGProp import BRepGProp
from OCP.gp import gp_Vec
from OCP.GProp import GProp_GProps
from OCP.IFSelect import IFSelect_ReturnStatus
from OCP.OCP.collections import IndexedMap_TopoDS_Shape_TopTools_ShapeMapHasher, Sequence_TDF_Label
from OCP.STEPCAFControl import STEPCAFControl_Reader
from OCP.TCollection import TCollection_ExtendedString
from OCP.TDocStd import TDocStd_Document
from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum
from OCP.TopExp import TopExp
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS
from OCP.XCAFDoc import (
    XCAFDoc_Datum,
    XCAFDoc_Dimension,
    XCAFDoc_DimTolTool,
    XCAFDoc_DocumentTool,
    XCAFDoc_GeomTolerance,
    XCAFDoc_ShapeTool,
)

NOT_READ = 3
"""Exit code of the process where OpenCASCADE cannot read the file."""
FACE, EDGE, VERTEX = TopAbs_ShapeEnum.TopAbs_FACE, TopAbs_ShapeEnum.TopAbs_EDGE, TopAbs_ShapeEnum.TopAbs_VERTEX
Places = dict[Any, list[Any]]
"""Each face and edge of the bodies, as often as it is placed."""


def write_pmi(source: str, items: str, target: str) -> None:
    """Write what is in a STEP file as JSON and end the process, with `NOT_READ` where it cannot be read.

    Args:
        source: the STEP file.
        items: JSON file of the faces of datums, as numbers of STEP statements, by letter.
        target: JSON file to write; its keys are the fields of `arview.cad.formats.pmi.Pmi`.
    """
    reader = STEPCAFControl_Reader()
    reader.SetGDTMode(True)
    document = TDocStd_Document(TCollection_ExtendedString("pmi"))
    if reader.ReadFile(source) != IFSelect_ReturnStatus.IFSelect_RetDone or not reader.Transfer(document):
        os._exit(NOT_READ)
    content = _content(reader, document.Main(), json.loads(Path(items).read_text(encoding="utf-8")))
    Path(target).write_text(json.dumps(content), encoding="utf-8")
    os._exit(0)  # OpenCASCADE takes seconds to free a large document


def _content(reader: Any, main: Any, faces_of_datum: dict[str, list[str]]) -> dict[str, Any]:
    tool = XCAFDoc_DocumentTool.DimTolTool_s(main)
    roots = _labels(XCAFDoc_DocumentTool.ShapeTool_s(main).GetFreeShapes)
    dimensions, tolerances = _labels(tool.GetDimensionLabels), _labels(tool.GetGeomToleranceLabels)
    datums = [XCAFDoc_Datum.Set_s(label).GetObject() for label in _labels(tool.GetDatumLabels)]
    places: Places = {}
    for kind in (FACE, EDGE):
        for shape in _parts(map(XCAFDoc_ShapeTool.GetShape_s, roots), kind):
            places.setdefault(shape.TShape(), []).append(shape)
    return {
        "counts": [len(dimensions), len(tolerances), len(datums)],
        "dimensions": [one for label in dimensions for one in _at_places(label, places, _dimension(label))],
        "tolerances": [one for label in tolerances for one in _at_places(label, places, _tolerance(label))],
        "datums": _datums(reader.Reader().WS(), places, faces_of_datum),
        "targets": {
            f"{one.GetName().ToCString()}{one.GetDatumTargetNumber()}": {
                "kind": _word(one.GetDatumTargetType()).lower(),
                "point_in_model": _numbers(one.GetDatumTargetAxis().Location()),
                "direction_in_model": _numbers(one.GetDatumTargetAxis().Direction(), 9),
                "length_mm": one.GetDatumTargetLength(),
            }
            for one in datums
            if one.IsDatumTarget()
        },
    }


def _dimension(label: Any) -> dict[str, Any]:
    found = XCAFDoc_Dimension.Set_s(label).GetObject()
    values = found.GetValues()
    return {
        "name": _text(found.GetSemanticName()),
        "kind": _word(found.GetType()),
        "values": [] if values is None else [values.Value(k) for k in range(values.Lower(), values.Upper() + 1)],
        "modifiers": [
            *map(_word, _items(found.GetModifiers())),
            *(found.GetDescription(k).ToCString() for k in range(found.NbDescriptions())),
            *(["class of tolerance"] if found.IsDimWithClassOfTolerance() else []),
        ],
    }


def _tolerance(label: Any) -> dict[str, Any]:
    found = XCAFDoc_GeomTolerance.Set_s(label).GetObject()
    rest = [found.GetMaterialRequirementModifier(), found.GetZoneModifier(), *_items(found.GetModifiers())]
    labels = _labels(XCAFDoc_DimTolTool.GetDatumWithObjectOfTolerLabels_s, label)
    datums = sorted((XCAFDoc_Datum.Set_s(one).GetObject() for one in labels), key=lambda one: one.GetPosition())
    return {
        "name": _text(found.GetSemanticName()),
        "kind": _word(found.GetType()),
        "values": [found.GetValue()],
        "zone": _word(found.GetTypeOfValue()),
        "modifiers": [word for word in map(_word, rest) if word != "None"],
        "datums": [
            [_text(one.GetName()), one.GetPosition(), [_word(word) for word in _items(one.GetModifiers())]]
            for one in datums
        ],
    }


def _at_places(label: Any, places: Places, own: dict[str, Any]) -> list[dict[str, Any]]:
    """A requirement with its shapes, once for each place of the part that carries it."""
    sides = Sequence_TDF_Label(), Sequence_TDF_Label()
    XCAFDoc_DimTolTool.GetRefShapeLabel_s(label, *sides)
    shapes = [[XCAFDoc_ShapeTool.GetShape_s(one) for one in _items(side)] for side in sides]
    placed = [[places.get(shape.TShape(), [shape]) for shape in side] for side in shapes]
    counts = {len(found) for side in placed for found in side}
    return [
        own
        | {"place": k, "shapes": [_described(one[k]) for one in placed[0]]}
        | {"others": [_described(one[k]) for one in placed[1]]}
        for k in range(max(counts) if len(counts) == 1 else 1)
    ]


def _datums(session: Any, places: Places, faces_of_datum: dict[str, list[str]]) -> dict[str, list[Any]]:
    """Shapes of the datum features by letter, for each place of the part that carries them."""
    model, results = session.Model(), session.TransferReader()
    # An entity is found by its identity, because the model does not give back the number of its statement.
    numbers = dict.fromkeys(number for faces in faces_of_datum.values() for number in faces)
    entities = {model.Entity(model.NextNumberForLabel(f"#{number}", 0, True)): number for number in numbers}
    found: dict[str, list[Any]] = {}
    for shapes in places.values():  # faces come first; each search takes a millisecond
        if len(found) == len(entities):
            break
        entity = results.EntityFromShapeResult(shapes[0].Located(TopLoc_Location()), 1)
        if entity in entities:
            found[entities[entity]] = shapes
    placed = {letter: [found[one] for one in faces if one in found] for letter, faces in faces_of_datum.items()}
    return {
        letter: [list(map(_described, shapes)) for shapes in zip(*faces, strict=False)]
        for letter, faces in placed.items()
    }


def _described(shape: Any) -> dict[str, Any]:
    """A face or edge at its place, with the fields of `arview.cad.formats.pmi.PmiShape`."""
    corner = next((_numbers(BRep_Tool.Pnt_s(TopoDS.Vertex(one))) for one in _parts([shape], VERTEX)), None)
    own: dict[str, Any] = {"kind": "vertex", "point_in_model": corner, "corner_in_model": corner}
    if shape.ShapeType() == EDGE:
        curve = BRepAdaptor_Curve(TopoDS.Edge(shape))
        first, last, kind = curve.FirstParameter(), curve.LastParameter(), _word(curve.GetType()).lower()
        own |= {"kind": f"{kind} edge", "point_in_model": _numbers(curve.Value(0.5 * (first + last)))}
        if kind == "line":
            own |= {"kind": "edge", "direction_in_model": _numbers(curve.Line().Direction(), 9)}
    elif shape.ShapeType() == FACE:
        surface, properties = BRepAdaptor_Surface(TopoDS.Face(shape)), GProp_GProps()
        BRepGProp.SurfaceProperties_s(shape, properties)
        is_turned = shape.Orientation() == TopAbs_Orientation.TopAbs_REVERSED
        own |= {"kind": _word(surface.GetType()).lower(), "point_in_model": _numbers(properties.CentreOfMass())}
        own["area_mm2"] = properties.Mass()
        if own["kind"] == "plane":
            axes = surface.Plane().Position()
            outward = axes.Direction() if axes.Direct() != is_turned else axes.Direction().Reversed()
            own["direction_in_model"] = _numbers(outward, 9)
        elif own["kind"] == "cylinder":
            cylinder, axis = surface.Cylinder(), surface.Cylinder().Axis()
            low, high = surface.FirstVParameter(), surface.LastVParameter()
            middle = cylinder.Location().Translated(gp_Vec(axis.Direction()).Multiplied(0.5 * (low + high)))
            own |= {
                "point_in_model": _numbers(middle),
                "direction_in_model": _numbers(axis.Direction(), 9),
                "diameter_mm": round(2.0 * cylinder.Radius(), 6),
                "length_mm": high - low,
                "is_hole": cylinder.Position().Direct() == is_turned,
            }
    return own


def _parts(shapes: Iterable[Any], kind: Any) -> list[Any]:
    """The faces, edges or vertices of some shapes, each once."""
    found = IndexedMap_TopoDS_Shape_TopTools_ShapeMapHasher()
    for shape in shapes:
        TopExp.MapShapes_s(shape, kind, found)
    return [found.FindKey(k) for k in range(1, found.Extent() + 1)]


def _labels(fill: Callable[..., object], *arguments: Any) -> list[Any]:
    """The labels that a method of OpenCASCADE writes into its last argument."""
    sequence = Sequence_TDF_Label()
    fill(*arguments, sequence)
    return _items(sequence)


def _items(sequence: Any) -> list[Any]:
    return [sequence.Value(k) for k in range(1, sequence.Length() + 1)]


def _word(value: Any) -> str:
    """The name of a constant without that of its kind."""
    return str(value.name).removeprefix(f"{type(value).__name__}_").removeprefix("GeomAbs_")


def _text(value: Any) -> str:
    return "" if value is None else str(value.ToCString())


def _numbers(point: Any, digits: int = 6) -> list[float]:
    return [round(value, digits) + 0.0 for value in (point.X(), point.Y(), point.Z())]
