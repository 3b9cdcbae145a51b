"""Model and Component: a CAD assembly as named triangle meshes in one frame, in millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from arview.cad.shape.centroid import center_of_mass
from arview.errors import InputError
from arview.geometry import Array


@dataclass(frozen=True)
class Component:
    """A named mesh of an assembly at its nominal place.

    Attributes:
        name: unique within its model.
        vertices_in_model: (V,3) float64, mm.
        faces: (F,3) int32, counter-clockwise seen from outside.
        color: (3,) sRGB in 0–1.

    Raises:
        InputError: arrays of other shapes, NaN, or a face that refers to a missing vertex.
    """

    name: str
    vertices_in_model: Array
    faces: NDArray[np.int32]
    color: tuple[float, float, float] = (0.6, 0.6, 0.62)

    def __repr__(self) -> str:
        return f"<Component {self.name}: {len(self.faces):,} faces>"

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_in_model, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise InputError(f"component {self.name!r}: vertices have shape {vertices.shape}, expected (V, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(f"component {self.name!r}: faces have shape {faces.shape}, expected (F, 3), F > 0")
        if not np.all(np.isfinite(vertices)):
            bad = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
            raise InputError(f"component {self.name!r}: {bad} of {len(vertices)} vertices are NaN or infinite")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(f"component {self.name!r}: a face refers to vertex {faces.max()} of {len(vertices)}")
        object.__setattr__(self, "vertices_in_model", vertices)
        object.__setattr__(self, "faces", faces)

    @cached_property
    def bounds_in_model(self) -> Array:
        """(2,3) lowest and highest corner, mm."""
        used = self.vertices_in_model[np.unique(self.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @cached_property
    def _center_of_mass(self) -> tuple[Array, bool]:
        return center_of_mass(self.vertices_in_model, self.faces)

    @property
    def centroid_in_model(self) -> Array:
        """(3,) centre of mass, mm: centroid of the volume of a solid, of the area of a sheet body."""
        return self._center_of_mass[0]

    @property
    def is_solid(self) -> bool:
        """Whether its surface is closed and encloses a volume; otherwise it is a sheet body."""
        return self._center_of_mass[1]


@dataclass(frozen=True)
class Step:
    """A step of the assembly, in which components are mounted.

    Attributes:
        name: as it is shown and recorded.
        mount: names of the components.
        after: names of the steps that must be done before.
    """

    name: str
    mount: tuple[str, ...]
    after: tuple[str, ...] = ()


@dataclass(frozen=True)
class Model:
    """An assembly of named components.

    Attributes:
        name: of the assembly.
        components: with unique names.
        source_hash: SHA-256 of names, vertices rounded to a micrometre and faces, by which guide views and inspections
            are checked.
        steps: in which the components are mounted, in the order of the part file; empty: all are there from the start.

    Raises:
        InputError: no components, or a name that is not unique.
    """

    name: str
    components: tuple[Component, ...]
    source_hash: str
    steps: tuple[Step, ...] = ()

    def __post_init__(self) -> None:
        if not self.components:
            raise InputError(f"model {self.name!r} has no components")
        names = [component.name for component in self.components]
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise InputError(f"model {self.name!r}: component names are not unique: {', '.join(twice)}")

    def __repr__(self) -> str:
        faces = sum(len(component.faces) for component in self.components)
        count = len(self.components)
        return f"<Model {self.name}: {count} component{'s' * (count != 1)}, {faces:,} faces, {self.diameter_mm:.0f} mm>"

    @cached_property
    def mesh(self) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
        """The mesh of all components: vertices (V,3), mm, faces (F,3), and component index of each face (F,)."""
        vertices, faces, ids, offset = [], [], [], 0
        for index, component in enumerate(self.components):
            vertices.append(component.vertices_in_model)
            faces.append(component.faces + offset)
            ids.append(np.full(len(component.faces), index, dtype=np.int32))
            offset += len(component.vertices_in_model)
        return (
            np.ascontiguousarray(np.concatenate(vertices)),
            np.ascontiguousarray(np.concatenate(faces), dtype=np.int32),
            np.concatenate(ids),
        )

    @cached_property
    def bounds_in_model(self) -> Array:
        """(2,3) lowest and highest corner of all components, mm."""
        corners = np.stack([component.bounds_in_model for component in self.components])
        return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])

    @property
    def center_in_model(self) -> Array:
        """(3,) centre of the bounding box, mm."""
        return self.bounds_in_model.mean(axis=0)

    @property
    def diameter_mm(self) -> float:
        """Diagonal of the bounding box, mm."""
        return float(np.linalg.norm(self.bounds_in_model[1] - self.bounds_in_model[0]))

    def component(self, name: str) -> Component:
        """The component of that name; raises InputError naming those that exist."""
        for component in self.components:
            if component.name == name:
                return component
        known = ", ".join(component.name for component in self.components)
        raise InputError(f"model {self.name!r} has no component {name!r}; it has: {known}")

    def index(self, name: str) -> int:
        """Index of the component of that name."""
        return self.components.index(self.component(name))

    def only(self, names: list[str]) -> Model:
        """A model of the named components alone, with a hash of its own."""
        return make_model(f"{self.name}:{'+'.join(names)}", tuple(self.component(n) for n in names))


def make_model(name: str, components: tuple[Component, ...]) -> Model:
    """A model with the ``source_hash`` of its geometry."""
    import hashlib

    digest = hashlib.sha256()
    for component in components:
        digest.update(component.name.encode())
        digest.update(np.round(component.vertices_in_model * 1000.0).astype(np.int64).tobytes())
        digest.update(component.faces.tobytes())
    return Model(name=name, components=components, source_hash=digest.hexdigest())
