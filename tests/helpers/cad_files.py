"""Makers of small CAD files of known geometry for the tests of the CAD room."""

from __future__ import annotations

import json
import struct
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BOX_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
BOX_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX_FACES = np.array([t for a, b, c, d in BOX_QUADS for t in ((a, b, c), (a, c, d))], dtype=np.int64)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (8,3) and outward faces (12,3) of an axis-aligned box."""
    return np.asarray(low) + BOX_CORNERS * (np.asarray(high) - np.asarray(low)), BOX_FACES.copy()


# --- STEP ---------------------------------------------------------------------------------------------


@dataclass
class StepPart:
    """A box or a cylinder about +Z standing on z = 0, at the origin of its own frame."""

    name: str
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    radius: float | None = None
    color: tuple[float, float, float] | None = None


@dataclass
class StepBodies:
    """One product with several boxes as solids: (name, size, lowest corner, sRGB or None) each.

    With ``is_linked`` the solids are in a representation of their own, linked to that of the product, as many programs
    write them.
    """

    name: str
    bodies: list[tuple[str, tuple[float, float, float], tuple[float, float, float], tuple[float, float, float] | None]]
    is_linked: bool = False


@dataclass
class StepAssembly:
    """Children as (instance name, StepPart or StepAssembly, parent_from_child)."""

    name: str
    children: list[tuple[str, StepPart | StepBodies | StepAssembly, Array]] = field(default_factory=list)


class StepWriter:
    """Writes AP214 text for assemblies of boxes and cylinders; ``unit`` is mm, m or inch."""

    def __init__(self, unit: str = "mm") -> None:
        self.lines: list[str] = []
        self.product_of: dict[int, tuple[int, int, int]] = {}
        self.styled: list[int] = []
        self.app = self.add("APPLICATION_CONTEXT('core data for automotive mechanical design processes')")
        self.add(f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,#{self.app})")
        self.product_context = self.add(f"PRODUCT_CONTEXT('',#{self.app},'mechanical')")
        self.definition_context = self.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',#{self.app},'design')")
        prefix = "$" if unit == "m" else ".MILLI."
        length = self.add(f"( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT({prefix},.METRE.) )")
        if unit == "inch":
            measure = self.add(f"LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#{length})")
            dims = self.add("DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)")
            length = self.add(f"( CONVERSION_BASED_UNIT('INCH',#{measure}) LENGTH_UNIT() NAMED_UNIT(#{dims}) )")
        angle = self.add("( NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.) )")
        solid = self.add("( NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT() )")
        accuracy = self.add(
            f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-07),#{length},'distance_accuracy_value','')"
        )
        self.context = self.add(
            f"( GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#{accuracy}))"
            f" GLOBAL_UNIT_ASSIGNED_CONTEXT((#{length},#{angle},#{solid})) REPRESENTATION_CONTEXT('','') )"
        )

    def add(self, text: str) -> int:
        self.lines.append(f"#{len(self.lines) + 1}={text};")
        return len(self.lines)

    def refs(self, ids: list[int]) -> str:
        return "(" + ",".join(f"#{i}" for i in ids) + ")"

    def point(self, xyz: Array) -> int:
        return self.add(f"CARTESIAN_POINT('',({','.join(f'{v:.9E}' for v in xyz)}))")

    def direction(self, xyz: Array) -> int:
        return self.add(f"DIRECTION('',({','.join(f'{v:.9E}' for v in xyz)}))")

    def axis(self, origin: Array, z: Array, x: Array) -> int:
        o, d, r = self.point(origin), self.direction(z), self.direction(x)
        return self.add(f"AXIS2_PLACEMENT_3D('',#{o},#{d},#{r})")

    def vertex(self, xyz: Array) -> int:
        return self.add(f"VERTEX_POINT('',#{self.point(xyz)})")

    def line_edge(self, start: int, end: int, a: Array, b: Array) -> int:
        length = float(np.linalg.norm(b - a))
        origin, way = self.point(a), self.direction((b - a) / length)
        vector = self.add(f"VECTOR('',#{way},{length:.9E})")
        curve = self.add(f"LINE('',#{origin},#{vector})")
        return self.add(f"EDGE_CURVE('',#{start},#{end},#{curve},.T.)")

    def face(self, uses: list[tuple[int, bool]], surface: int, same_sense: bool = True) -> int:
        oriented = [self.add(f"ORIENTED_EDGE('',*,*,#{e},.{'T' if s else 'F'}.)") for e, s in uses]
        loop = self.add(f"EDGE_LOOP('',{self.refs(oriented)})")
        bound = self.add(f"FACE_OUTER_BOUND('',#{loop},.T.)")
        return self.add(f"ADVANCED_FACE('',(#{bound}),#{surface},.{'T' if same_sense else 'F'}.)")

    def box_faces(
        self, size: tuple[float, float, float], low: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> list[int]:
        corners = BOX_CORNERS * np.asarray(size) + np.asarray(low)
        ids = [self.vertex(c) for c in corners]
        edges: dict[tuple[int, int], int] = {}
        faces = []
        for quad in BOX_QUADS:
            uses = []
            for a, b in zip(quad, quad[1:] + quad[:1], strict=True):
                key = (min(a, b), max(a, b))
                if key not in edges:
                    edges[key] = self.line_edge(ids[key[0]], ids[key[1]], corners[key[0]], corners[key[1]])
                uses.append((edges[key], key == (a, b)))
            x = corners[quad[1]] - corners[quad[0]]
            normal = np.cross(x, corners[quad[3]] - corners[quad[0]])
            place = self.axis(corners[quad[0]], normal / np.linalg.norm(normal), x / np.linalg.norm(x))
            faces.append(self.face(uses, self.add(f"PLANE('',#{place})")))
        return faces

    def cylinder_faces(self, radius: float, height: float) -> list[int]:
        x, z, top = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, 0, height])
        a, b = self.vertex(radius * x), self.vertex(radius * x + top)
        low, high = self.axis(0 * x, z, x), self.axis(top, z, x)
        circles = []
        for vertex, place in ((a, low), (b, high)):
            curve = self.add(f"CIRCLE('',#{place},{radius:.9E})")
            circles.append(self.add(f"EDGE_CURVE('',#{vertex},#{vertex},#{curve},.T.)"))
        seam = self.line_edge(a, b, radius * x, radius * x + top)
        side = self.add(f"CYLINDRICAL_SURFACE('',#{low},{radius:.9E})")
        down, up = self.add(f"PLANE('',#{low})"), self.add(f"PLANE('',#{high})")
        return [
            self.face([(circles[0], True), (seam, True), (circles[1], False), (seam, False)], side),
            self.face([(circles[0], False)], down, same_sense=False),
            self.face([(circles[1], True)], up),
        ]

    def product(self, name: str, representation: int) -> int:
        product = self.add(f"PRODUCT('{name}','{name}','',(#{self.product_context}))")
        formation = self.add(f"PRODUCT_DEFINITION_FORMATION('','',#{product})")
        definition = self.add(f"PRODUCT_DEFINITION('design','',#{formation},#{self.definition_context})")
        shape = self.add(f"PRODUCT_DEFINITION_SHAPE('','',#{definition})")
        self.add(f"SHAPE_DEFINITION_REPRESENTATION(#{shape},#{representation})")
        return definition

    def part(self, part: StepPart) -> tuple[int, int, int]:
        faces = self.box_faces(part.size) if part.radius is None else self.cylinder_faces(part.radius, part.size[2])
        shell = self.add(f"CLOSED_SHELL('',{self.refs(faces)})")
        brep = self.add(f"MANIFOLD_SOLID_BREP('{part.name}',#{shell})")
        place = self.axis(np.zeros(3), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]))
        representation = self.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',(#{place},#{brep}),#{self.context})")
        if part.color is not None:
            self.paint(brep, part.color)
        return self.product(part.name, representation), representation, place

    def paint(self, brep: int, color: tuple[float, float, float]) -> None:
        """Give a solid a colour."""
        red, green, blue = color
        last = self.add(f"COLOUR_RGB('',{red},{green},{blue})")
        for template in (
            "FILL_AREA_STYLE_COLOUR('',#{})",
            "FILL_AREA_STYLE('',(#{}))",
            "SURFACE_STYLE_FILL_AREA(#{})",
            "SURFACE_SIDE_STYLE('',(#{}))",
            "SURFACE_STYLE_USAGE(.BOTH.,#{})",
            "PRESENTATION_STYLE_ASSIGNMENT((#{}))",
        ):
            last = self.add(template.format(last))
        self.styled.append(self.add(f"STYLED_ITEM('color',(#{last}),#{brep})"))

    def bodies(self, part: StepBodies) -> tuple[int, int, int]:
        place = self.axis(np.zeros(3), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]))
        breps = []
        for name, size, low, color in part.bodies:
            shell = self.add(f"CLOSED_SHELL('',{self.refs(self.box_faces(size, low))})")
            breps.append(self.add(f"MANIFOLD_SOLID_BREP('{name}',#{shell})"))
            if color is not None:
                self.paint(breps[-1], color)
        solids = self.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',{self.refs([place, *breps])},#{self.context})")
        if not part.is_linked:
            return self.product(part.name, solids), solids, place
        representation = self.add(f"SHAPE_REPRESENTATION('',(#{place}),#{self.context})")
        definition = self.product(part.name, representation)
        self.add(f"SHAPE_REPRESENTATION_RELATIONSHIP('','',#{representation},#{solids})")
        return definition, representation, place

    def item(self, item: StepPart | StepBodies | StepAssembly) -> tuple[int, int, int]:
        """Product definition, representation and origin axis of a part or assembly (written once)."""
        if id(item) not in self.product_of:
            if isinstance(item, StepBodies):
                self.product_of[id(item)] = self.bodies(item)
            else:
                self.product_of[id(item)] = self.part(item) if isinstance(item, StepPart) else self.assembly(item)
        return self.product_of[id(item)]

    def assembly(self, assembly: StepAssembly) -> tuple[int, int, int]:
        origin = self.axis(np.zeros(3), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]))
        children = [(name, self.item(child), matrix) for name, child, matrix in assembly.children]
        places = [self.axis(m[:3, 3], m[:3, 2], m[:3, 0]) for _, _, m in children]
        items = self.refs([origin, *places])
        representation = self.add(f"SHAPE_REPRESENTATION('',{items},#{self.context})")
        definition = self.product(assembly.name, representation)
        for number, ((name, (child, child_rep, child_axis), _), place) in enumerate(zip(children, places, strict=True)):
            usage = self.add(f"NEXT_ASSEMBLY_USAGE_OCCURRENCE('{number + 1}','{name}','',#{definition},#{child},$)")
            shape = self.add(f"PRODUCT_DEFINITION_SHAPE('Placement','',#{usage})")
            transform = self.add(f"ITEM_DEFINED_TRANSFORMATION('','',#{child_axis},#{place})")
            relation = self.add(
                f"( REPRESENTATION_RELATIONSHIP('','',#{child_rep},#{representation})"
                f" REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION(#{transform})"
                " SHAPE_REPRESENTATION_RELATIONSHIP() )"
            )
            self.add(f"CONTEXT_DEPENDENT_SHAPE_REPRESENTATION(#{relation},#{shape})")
        return definition, representation, origin

    def write(self, path: Path, item: StepPart | StepBodies | StepAssembly) -> Path:
        self.item(item)
        if self.styled:
            self.add(
                f"MECHANICAL_DESIGN_GEOMETRIC_PRESENTATION_REPRESENTATION('',{self.refs(self.styled)},#{self.context})"
            )
        header = (
            "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\n"
            "FILE_NAME('','2026-01-01T00:00:00',(''),(''),'','','');\n"
            "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
        )
        path.write_text(header + "\n".join(self.lines) + "\nENDSEC;\nEND-ISO-10303-21;\n")
        return path


# --- other formats ------------------------------------------------------------------------------------


def write_glb(path: Path, tree: dict[str, object], binary: bytes) -> Path:
    """A GLB of a glTF tree (without ``buffers``) and its binary chunk."""
    tree = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(binary)}], **tree}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


def glb_with_boxes(path: Path, nodes: list[dict[str, object]], roots: list[int], **tree: object) -> Path:
    """A GLB whose mesh 0 is a box of 0.01 × 0.02 × 0.03 (metres) that nodes may instance."""
    vertices, faces = box((0, 0, 0), (0.01, 0.02, 0.03))
    binary = vertices.astype("<f4").tobytes() + faces.astype("<u2").tobytes()
    content: dict[str, object] = {
        "nodes": nodes,
        "scenes": [{"nodes": roots}],
        "scene": 0,
        "meshes": [{"name": "box", "primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.21404114, 0.05087609, 1.0, 1.0]}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 72},
        ],
    }
    return write_glb(path, {**content, **tree}, binary)


def write_3mf(path: Path, resources: str, build: str, unit: str = "millimeter") -> Path:
    """A 3MF of the XML text of its resources and its build items."""
    xml = (
        f'<?xml version="1.0" encoding="UTF-8"?><model unit="{unit}" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        f"<resources>{resources}</resources><build>{build}</build></model>"
    )
    relation = (
        '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
        '<Relationship Id="r0" Target="/3D/3dmodel.model" '
        'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("_rels/.rels", relation)
        archive.writestr("3D/3dmodel.model", xml)
    return path


def mesh_xml(vertices: Array, faces: NDArray[np.int64]) -> str:
    """The ``mesh`` element of a 3MF object."""
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    return f"<mesh><vertices>{points}</vertices><triangles>{triangles}</triangles></mesh>"


def obj_text(name: str, vertices: Array, faces: NDArray[np.int64], offset: int = 0) -> str:
    """An ``o`` block of OBJ; ``offset`` is the number of vertices written before."""
    lines = [f"o {name}"] + [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a + 1 + offset} {b + 1 + offset} {c + 1 + offset}" for a, b, c in faces]
    return "\n".join(lines) + "\n"


def write_bench(folder: Path) -> Path:
    """``bench.obj``: a plate and a block on it, mm."""
    text, count = "", 0
    for name, (low, high) in {"plate": ((0, 0, 0), (90, 60, 5)), "block": ((20, 20, 5), (40, 35, 20))}.items():
        vertices, faces = box(low, high)
        text += obj_text(name, vertices, faces, count)
        count += len(vertices)
    path = folder / "bench.obj"
    path.write_text(text)
    return path


# --- the same nested box in several formats ------------------------------------------------------------

# parent_from_child: a quarter turn about Z, and shifts in mm; the box is 10 × 20 × 30 mm at its origin.
QUARTER_TURN = np.array([[0, -1, 0, 100], [1, 0, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1.0]])
SHIFT = np.array([[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
# The box moved by SHIFT, then turned: x in [-22, -2] + 100, y in [1, 11], z in [3, 33] + 5.
NESTED_BOUNDS = np.array([[78, 1, 8], [98, 11, 38]], dtype=np.float64)


def scaled(matrix: np.ndarray, factor: float) -> np.ndarray:
    result = matrix.copy()
    result[:3, 3] *= factor
    return result


def nested_glb(folder: Path) -> Path:
    nodes: list[dict[str, object]] = [
        {"name": "frame", "children": [1], "matrix": scaled(QUARTER_TURN, 0.001).T.ravel().tolist()},
        {"name": "lug", "mesh": 0, "translation": [0.001, 0.002, 0.003]},
    ]
    return glb_with_boxes(folder / "nested.glb", nodes, [0])


def nested_trs_glb(folder: Path) -> Path:
    half = float(np.sqrt(0.5))
    nodes: list[dict[str, object]] = [
        {"name": "frame", "children": [1], "rotation": [0, 0, half, half], "translation": [0.1, 0, 0.005]},
        {"name": "lug", "mesh": 0, "translation": [0.001, 0.002, 0.003], "scale": [1, 1, 1]},
    ]
    return glb_with_boxes(folder / "nested_trs.glb", nodes, [0])


def nested_scaled_glb(folder: Path) -> Path:
    nodes: list[dict[str, object]] = [
        {"name": "inches", "children": [1], "scale": [0.5, 0.5, 0.5]},
        {"name": "frame", "children": [2], "matrix": scaled(QUARTER_TURN, 0.002).T.ravel().tolist()},
        {"name": "lug", "mesh": 0, "translation": [0.002, 0.004, 0.006], "scale": [2, 2, 2]},
    ]
    return glb_with_boxes(folder / "nested_scaled.glb", nodes, [0])


def nested_trimesh_glb(folder: Path) -> Path:
    import trimesh

    scene = trimesh.Scene()
    scene.graph.update(frame_to="frame", frame_from="world", matrix=scaled(QUARTER_TURN, 0.001))
    mesh = trimesh.Trimesh(*box((0, 0, 0), (0.01, 0.02, 0.03)), process=False)
    scene.add_geometry(
        mesh, node_name="lug", geom_name="block", parent_node_name="frame", transform=scaled(SHIFT, 0.001)
    )
    (folder / "nested_trimesh.glb").write_bytes(scene.export(file_type="glb"))
    return folder / "nested_trimesh.glb"


def nested_step(folder: Path, unit: str) -> Path:
    per_mm = {"mm": 1.0, "m": 0.001, "inch": 1 / 25.4}[unit]
    part = StepPart("block", (10 * per_mm, 20 * per_mm, 30 * per_mm))
    frame = StepAssembly("frame_product", [("lug", part, scaled(SHIFT, per_mm))])
    root = StepAssembly("root", [("frame", frame, scaled(QUARTER_TURN, per_mm))])
    return StepWriter(unit).write(folder / f"nested_{unit}.step", root)


def nested_3mf(folder: Path, unit: str = "millimeter") -> Path:
    per_mm = {"millimeter": 1.0, "inch": 1 / 25.4}[unit]

    def transform(matrix: np.ndarray) -> str:
        return " ".join(f"{v:.12g}" for v in scaled(matrix, per_mm)[:3, :].T.ravel())

    mesh = mesh_xml(*box((0, 0, 0), (10 * per_mm, 20 * per_mm, 30 * per_mm)))
    resources = (
        f'<object id="1" name="lug">{mesh}</object><object id="2" name="frame"><components>'
        f'<component objectid="1" transform="{transform(SHIFT)}"/></components></object>'
    )
    item = f'<item objectid="2" transform="{transform(QUARTER_TURN)}"/>'
    return write_3mf(folder / f"nested_{unit}.3mf", resources, item, unit)
