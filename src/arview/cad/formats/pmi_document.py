"""Dimensions, tolerances and datums that OpenCASCADE finds in a STEP file (AP242), as JSON; for a limited process.

OpenCASCADE links dimensions and tolerances to faces, but few datums; those come as numbers of STEP statements.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from OCP.BRep import BRep_Tool
from OCP.BRepAdaptor import BRepAdaptor_Curve, BRepAdaptor_Surface
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps
from OCP.IFSelect import IFSelect_ReturnStatus
from OCP.OCP.collections import Sequence_TDF_Label
from OCP.STEPCAFControl import STEPCAFControl_Reader
from OCP.TCollection import TCollection_ExtendedString
from OCP.TDocStd import TDocStd_Document
from OCP.TopAbs import TopAbs_Orientation, TopAbs_ShapeEnum
from OCP.TopExp import TopExp_Explorer
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


def write_pmi(source: str, items: str, target: str) -> None:
    """Write what is in a STEP file as JSON and end the process, with `NOT_READ` where it cannot be read.

    Args:
        source: the STEP file.
        items: JSON file of the faces of datums, as numbers of STEP statements, by letter.
        target: JSON file to write.
    """
    reader = STEPCAFControl_Reader()
    reader.SetGDTMode(True)
    document = TDocStd_Document(TCollection_ExtendedString("pmi"))
    if reader.ReadFile(source) != IFSelect_ReturnStatus.IFSelect_RetDone or not reader.Transfer(document):
        os._exit(NOT_READ)
    faces_of_datum = json.loads(Path(items).read_text(encoding="utf-8"))
    Path(target).write_text(json.dumps(_Document(reader, document).content(faces_of_datum)), encoding="utf-8")
    os._exit(0)  # OpenCASCADE takes seconds to free a large document, and may crash in it


class _Document:
    """The tables of one file; ``places`` has each face and edge of the bodies as often as it is placed."""

    def __init__(self, reader: Any, document: Any) -> None:
        self.reader = reader
        self.tool = XCAFDoc_DocumentTool.DimTolTool_s(document.Main())
        self.places: dict[Any, list[Any]] = {}
        roots = Sequence_TDF_Label()
        XCAFDoc_DocumentTool.ShapeTool_s(document.Main()).GetFreeShapes(roots)
        shapes = [XCAFDoc_ShapeTool.GetShape_s(label) for label in _items(roots)]
        for kind in (TopAbs_ShapeEnum.TopAbs_FACE, TopAbs_ShapeEnum.TopAbs_EDGE):
            for shape in shapes:
                explorer = TopExp_Explorer(shape, kind)
                while explorer.More():
                    placed = self.places.setdefault(explorer.Current().TShape(), [])
                    if not any(explorer.Current().IsSame(other) for other in placed):
                        placed.append(explorer.Current())
                    explorer.Next()

    def content(self, faces_of_datum: dict[str, list[str]]) -> dict[str, Any]:
        dimensions, tolerances, datums = (Sequence_TDF_Label() for _ in range(3))
        self.tool.GetDimensionLabels(dimensions)
        self.tool.GetGeomToleranceLabels(tolerances)
        self.tool.GetDatumLabels(datums)
        objects = [XCAFDoc_Datum.Set_s(label).GetObject() for label in _items(datums)]
        return {
            "counts": [dimensions.Length(), tolerances.Length(), datums.Length()],
            "dimensions": [one for label in _items(dimensions) for one in self._dimensions(label)],
            "tolerances": [one for label in _items(tolerances) for one in self._tolerances(label)],
            "datums": self._datums(faces_of_datum),
            "targets": [_target(one) for one in objects if one.IsDatumTarget()],
        }

    def _dimensions(self, label: Any) -> Iterator[dict[str, Any]]:
        found = XCAFDoc_Dimension.Set_s(label).GetObject()
        values = found.GetValues()
        texts = [found.GetDescription(k).ToCString() for k in range(found.NbDescriptions())]
        own = {
            "name": _text(found.GetSemanticName()),
            "kind": _word(found.GetType()),
            "values": [] if values is None else [values.Value(k) for k in range(values.Lower(), values.Upper() + 1)],
            "is_plus_minus": found.IsDimWithPlusMinusTolerance(),
            "is_range": found.IsDimWithRange(),
            "is_class": found.IsDimWithClassOfTolerance(),
            "modifiers": [*map(_word, _items(found.GetModifiers())), *texts],
        }
        return self._at_places(label, own)

    def _tolerances(self, label: Any) -> Iterator[dict[str, Any]]:
        found = XCAFDoc_GeomTolerance.Set_s(label).GetObject()
        datums = Sequence_TDF_Label()
        XCAFDoc_DimTolTool.GetDatumWithObjectOfTolerLabels_s(label, datums)
        objects = [XCAFDoc_Datum.Set_s(datum).GetObject() for datum in _items(datums)]
        rest = [found.GetMaterialRequirementModifier(), found.GetZoneModifier(), *_items(found.GetModifiers())]
        own = {
            "name": _text(found.GetSemanticName()),
            "kind": _word(found.GetType()),
            "values": [found.GetValue()],
            "zone": _word(found.GetTypeOfValue()),
            "modifiers": [word for word in map(_word, rest) if word != "None"],
            "datums": [
                [_text(one.GetName()), one.GetPosition(), [_word(word) for word in _items(one.GetModifiers())]]
                for one in objects
            ],
        }
        return self._at_places(label, own)

    def _at_places(self, label: Any, own: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """A requirement once for each place of the part that carries it."""
        first, second = Sequence_TDF_Label(), Sequence_TDF_Label()
        XCAFDoc_DimTolTool.GetRefShapeLabel_s(label, first, second)
        sides = [[XCAFDoc_ShapeTool.GetShape_s(one) for one in _items(side)] for side in (first, second)]
        placed = [[self.places.get(shape.TShape(), [shape]) for shape in side] for side in sides]
        counts = {len(places) for side in placed for places in side}
        for place in range(counts.pop() if len(counts) == 1 else 1):
            shapes = [[_described(places[place]) for places in side] for side in placed]
            yield {**own, "place": place, "shapes": shapes[0], "others": shapes[1]}

    def _datums(self, faces_of_datum: dict[str, list[str]]) -> dict[str, list[list[dict[str, Any]]]]:
        """Shapes of the datum features by letter, for each place of the part that carries them."""
        if not any(faces_of_datum.values()):
            return {letter: [] for letter in faces_of_datum}
        model = self.reader.Reader().WS().Model()
        # An entity is found by its identity, because the model does not give back the number of its statement.
        entities = {
            model.Entity(model.NextNumberForLabel(f"#{number}", 0, True)): number
            for numbers in faces_of_datum.values()
            for number in numbers
        }
        results = self.reader.Reader().WS().TransferReader()
        of_number: dict[str, list[Any]] = {}
        for places in self.places.values():  # faces first; each search takes a millisecond
            if len(of_number) == len(entities):
                break
            entity = results.EntityFromShapeResult(places[0].Located(TopLoc_Location()), 1)
            if entity in entities:
                of_number[entities[entity]] = places
        found = {}
        for letter, numbers in faces_of_datum.items():
            placed = [of_number[number] for number in numbers if number in of_number]
            count = min(map(len, placed), default=0)
            found[letter] = [[_described(places[place]) for places in placed] for place in range(count)]
        return found


def _described(shape: Any) -> dict[str, Any]:
    """A face, edge or vertex at its place: kind, point, direction, diameter, length, area, side, a corner; mm."""
    explorer = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_VERTEX)
    corner = _numbers(BRep_Tool.Pnt_s(TopoDS.Vertex(explorer.Current()))) if explorer.More() else None
    if shape.ShapeType() == TopAbs_ShapeEnum.TopAbs_EDGE:
        curve = BRepAdaptor_Curve(TopoDS.Edge(shape))
        kind, first, last = _word(curve.GetType()), curve.FirstParameter(), curve.LastParameter()
        own = {
            "kind": "edge" if kind == "Line" else f"{kind} edge",
            "point": _numbers(curve.Value(0.5 * (first + last))),
        }
        if kind == "Line":
            own |= {"direction": _numbers(curve.Line().Direction()), "length": last - first}
        return {**own, "corner": corner}
    if shape.ShapeType() != TopAbs_ShapeEnum.TopAbs_FACE:
        return {"kind": _word(shape.ShapeType()).lower(), "point": corner or [0.0, 0.0, 0.0], "corner": corner}
    surface, properties = BRepAdaptor_Surface(TopoDS.Face(shape)), GProp_GProps()
    BRepGProp.SurfaceProperties_s(shape, properties)
    is_turned = shape.Orientation() == TopAbs_Orientation.TopAbs_REVERSED
    own = {"kind": _word(surface.GetType()).lower(), "point": _numbers(properties.CentreOfMass())}
    if own["kind"] == "plane":
        axes = surface.Plane().Position()
        sign = 1.0 if axes.Direct() != is_turned else -1.0
        own["direction"] = [sign * value for value in _numbers(axes.Direction())]
    elif own["kind"] == "cylinder":
        cylinder, low, high = surface.Cylinder(), surface.FirstVParameter(), surface.LastVParameter()
        axis, foot = _numbers(cylinder.Axis().Direction()), _numbers(cylinder.Location())
        own |= {
            "point": [a + low * b for a, b in zip(foot, axis, strict=True)],
            "direction": axis,
            "diameter": 2.0 * cylinder.Radius(),
            "length": high - low,
            "is_hole": cylinder.Position().Direct() == is_turned,
        }
    return {**own, "area": properties.Mass(), "corner": corner}


def _target(found: Any) -> dict[str, Any]:
    """A datum target: letter, number, kind, place and direction."""
    axes = found.GetDatumTargetAxis()
    return {
        "letter": _text(found.GetName()),
        "number": found.GetDatumTargetNumber(),
        "kind": _word(found.GetDatumTargetType()).lower(),
        "point": _numbers(axes.Location()),
        "direction": _numbers(axes.Direction()),
    }


def _items(sequence: Any) -> Iterator[Any]:
    return (sequence.Value(k) for k in range(1, sequence.Length() + 1))


def _word(value: Any) -> str:
    """The name of a constant without that of its kind."""
    return str(value.name).removeprefix(f"{type(value).__name__}_").removeprefix("GeomAbs_").removeprefix("TopAbs_")


def _text(value: Any) -> str:
    return "" if value is None else str(value.ToCString())


def _numbers(point: Any) -> list[float]:
    return [point.X(), point.Y(), point.Z()]
