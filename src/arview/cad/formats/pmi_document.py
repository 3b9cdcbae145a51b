"""Dimensions, tolerances and datums that OpenCASCADE finds in a STEP file (AP242), as JSON; for a limited process."""

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
from OCP.TopAbs import TopAbs_Orientation
from OCP.TopAbs import TopAbs_ShapeEnum as Kind
from OCP.TopExp import TopExp
from OCP.TopoDS import TopoDS
from OCP.XCAFDoc import (
    XCAFDoc_Datum,
    XCAFDoc_Dimension,
    XCAFDoc_DimTolTool,
    XCAFDoc_DocumentTool,
    XCAFDoc_GeomTolerance,
    XCAFDoc_ShapeTool,
)


def write_pmi(source: str, target: str) -> None:
    """Write what is in a STEP file as JSON and end the process.

    Args:
        source: the STEP file.
        target: JSON file to write; its keys are the fields of `arview.cad.formats.pmi.Pmi`.

    Raises:
        ValueError: OpenCASCADE cannot read the file.
    """
    reader = STEPCAFControl_Reader()
    reader.SetGDTMode(True)
    document = TDocStd_Document(TCollection_ExtendedString("pmi"))
    if reader.ReadFile(source) != IFSelect_ReturnStatus.IFSelect_RetDone or not reader.Transfer(document):
        raise ValueError("OpenCASCADE cannot read it")
    Path(target).write_text(json.dumps(_content(document.Main())), encoding="utf-8")
    os._exit(0)  # OpenCASCADE takes seconds to free a large document


def _content(main: Any) -> dict[str, Any]:
    tool = XCAFDoc_DocumentTool.DimTolTool_s(main)
    roots = [XCAFDoc_ShapeTool.GetShape_s(one) for one in _labels(XCAFDoc_DocumentTool.ShapeTool_s(main).GetFreeShapes)]
    dimensions, tolerances = _labels(tool.GetDimensionLabels), _labels(tool.GetGeomToleranceLabels)
    references = [(label, XCAFDoc_Datum.Set_s(label).GetObject()) for label in _labels(tool.GetDatumLabels)]
    places: dict[Any, list[Any]] = {}
    for shape in (*_parts(roots, Kind.TopAbs_FACE), *_parts(roots, Kind.TopAbs_EDGE)):
        places.setdefault(shape.TShape(), []).append(shape)
    datums: dict[str, list[dict[str, Any]]] = {}
    for label, reference in references:
        for placed in _at_places(label, places, {"datums": [[_text(reference.GetName())]]}):
            known = datums.setdefault(placed["datums"][0][0], [])
            known += [shape for shape in placed["shapes"] if shape not in known]
    meant = [
        (label, own)
        for label in dimensions
        if (own := _dimension(label))["kind"] not in ("CommonLabel", "DimensionPresentation")
    ]
    return {
        "counts": [len(dimensions), len(tolerances), len(references)],
        "drawn_dimensions": len(dimensions) - len(meant),
        "dimensions": [one for label, own in meant for one in _at_places(label, places, own)],
        "tolerances": [one for label in tolerances for one in _at_places(label, places, _tolerance(label))],
        "datums": datums,
        "targets": {
            f"{_text(one.GetName())}{one.GetDatumTargetNumber()}": {
                "kind": _word(one.GetDatumTargetType()).lower(),
                "point_in_model": _numbers(one.GetDatumTargetAxis().Location()),
                "direction_in_model": _numbers(one.GetDatumTargetAxis().Direction(), 9),
                "length_mm": one.GetDatumTargetLength(),
            }
            for _, one in references
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
            *map(_word, found.GetModifiers()),
            *(_text(found.GetDescription(k)) for k in range(found.NbDescriptions())),
            *(["class of tolerance"] if found.IsDimWithClassOfTolerance() else []),
        ],
    }


def _tolerance(label: Any) -> dict[str, Any]:
    found = XCAFDoc_GeomTolerance.Set_s(label).GetObject()
    rest = [found.GetMaterialRequirementModifier(), found.GetZoneModifier(), *found.GetModifiers()]
    labels = _labels(XCAFDoc_DimTolTool.GetDatumWithObjectOfTolerLabels_s, label)
    datums = sorted((XCAFDoc_Datum.Set_s(one).GetObject() for one in labels), key=lambda one: one.GetPosition())
    return {
        "name": _text(found.GetSemanticName()),
        "kind": _word(found.GetType()),
        "values": [found.GetValue()],
        "zone": _word(found.GetTypeOfValue()),
        "modifiers": [word for word in map(_word, rest) if word != "None"],
        "datums": [
            [_text(one.GetName()), one.GetPosition(), [_word(word) for word in one.GetModifiers()]] for one in datums
        ],
    }


def _at_places(label: Any, places: dict[Any, list[Any]], own: dict[str, Any]) -> list[dict[str, Any]]:
    """A requirement with its shapes, once for each place of its part, from the second on with datums A_2, A_3, …

    Args:
        label: of the requirement.
        places: each face and edge of the bodies, as often as it is placed.
        own: what is the same at all places.
    """
    sides = Sequence_TDF_Label(), Sequence_TDF_Label()
    XCAFDoc_DimTolTool.GetRefShapeLabel_s(label, *sides)
    placed = [
        [places.get(shape.TShape(), [shape]) for shape in map(XCAFDoc_ShapeTool.GetShape_s, side)] for side in sides
    ]
    counts = {len(found) for side in placed for found in side}
    return [
        own
        | {"shapes": [_described(one[k]) for one in placed[0]], "others": [_described(one[k]) for one in placed[1]]}
        | {"datums": [[f"{letter}_{k + 1}" if k else letter, *rest] for letter, *rest in own.get("datums", ())]}
        for k in range(max(counts) if len(counts) == 1 else 1)
    ]


def _described(shape: Any) -> dict[str, Any]:
    """A face or edge at its place, with the fields of `arview.cad.formats.pmi.PmiShape`."""
    corner = next((_numbers(BRep_Tool.Pnt_s(TopoDS.Vertex(one))) for one in _parts([shape], Kind.TopAbs_VERTEX)), None)
    own: dict[str, Any] = {"kind": "vertex", "point_in_model": corner, "corner_in_model": corner}
    if shape.ShapeType() == Kind.TopAbs_EDGE:
        curve = BRepAdaptor_Curve(TopoDS.Edge(shape))
        kind, middle = _word(curve.GetType()).lower(), 0.5 * (curve.FirstParameter() + curve.LastParameter())
        direction = {"direction_in_model": _numbers(curve.Line().Direction(), 9)} if kind == "line" else {}
        return own | {"kind": f"{kind} edge", "point_in_model": _numbers(curve.Value(middle)), **direction}
    if shape.ShapeType() != Kind.TopAbs_FACE:
        return own
    surface, properties = BRepAdaptor_Surface(TopoDS.Face(shape)), GProp_GProps()
    BRepGProp.SurfaceProperties_s(shape, properties)
    kind = _word(surface.GetType()).lower()
    own |= {"kind": kind, "point_in_model": _numbers(properties.CentreOfMass()), "area_mm2": properties.Mass()}
    if kind not in ("plane", "cylinder"):
        return own
    form = surface.Plane() if kind == "plane" else surface.Cylinder()
    axis, is_turned = form.Axis().Direction(), shape.Orientation() == TopAbs_Orientation.TopAbs_REVERSED
    if kind == "plane":
        return own | {
            "direction_in_model": _numbers(axis if form.Position().Direct() != is_turned else axis.Reversed(), 9)
        }
    to_middle = gp_Vec(axis).Multiplied(0.5 * (surface.FirstVParameter() + surface.LastVParameter()))
    return own | {
        "point_in_model": _numbers(form.Location().Translated(to_middle)),
        "direction_in_model": _numbers(axis, 9),
        "diameter_mm": round(2.0 * form.Radius(), 6),
        "length_mm": surface.LastVParameter() - surface.FirstVParameter(),
        "is_hole": form.Position().Direct() == is_turned,
    }


def _parts(shapes: Iterable[Any], kind: Any) -> list[Any]:
    """The faces, edges or vertices of some shapes, each once."""
    found = IndexedMap_TopoDS_Shape_TopTools_ShapeMapHasher()
    for shape in shapes:
        TopExp.MapShapes_s(shape, kind, found)
    return list(found)


def _labels(fill: Callable[..., object], *arguments: Any) -> list[Any]:
    """The labels that a method of OpenCASCADE writes into its last argument."""
    sequence = Sequence_TDF_Label()
    fill(*arguments, sequence)
    return list(sequence)


def _word(value: Any) -> str:
    """The name of a constant without that of its kind."""
    return str(value.name).removeprefix(f"{type(value).__name__}_").removeprefix("GeomAbs_")


def _text(value: Any) -> str:
    """A text of OpenCASCADE without control characters."""
    return "".join(letter if letter.isprintable() else " " for letter in ("" if value is None else value.ToCString()))


def _numbers(point: Any, digits: int = 6) -> list[float]:
    return [round(value, digits) + 0.0 for value in (point.X(), point.Y(), point.Z())]
