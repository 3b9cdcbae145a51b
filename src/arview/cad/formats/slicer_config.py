"""Volumes of 3MF objects that are no bodies, by the configuration that slicers add: cutters, modifiers, supports.

PrusaSlicer keeps all volumes of an object in one mesh, and their triangles in ``Metadata/Slic3r_PE_model.config``;
Bambu Studio and OrcaSlicer name the components of an object in ``Metadata/model_settings.config``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

Attributes = dict[str, str]
FILES = ("metadata/slic3r_pe_model.config", "metadata/slic3r_model.config", "metadata/model_settings.config")
_BODIES = ("", "modelpart", "normalpart")
_CUTTERS = ("negativevolume", "negativepart")


class Volume(NamedTuple):
    """A volume of an object: its name, kind, and first and last triangle, or the identifier of its component."""

    name: str
    kind: str
    first: int
    last: int
    component: str

    @property
    def is_body(self) -> bool:
        """Whether it is part of the object, and not only of how that is printed."""
        return self.kind in _BODIES

    @property
    def is_cutter(self) -> bool:
        """Whether the slicer takes it away from the object."""
        return self.kind in _CUTTERS


@dataclass
class SlicerConfig:
    """Handler of the elements of a configuration: the volumes of objects by the identifiers of these, and names."""

    volumes: dict[str, list[Volume]] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    _object: str = ""
    _volume: Volume | None = None

    def start(self, tag: str, attributes: Attributes) -> None:
        """Take the beginning of an element."""
        if tag == "object":
            self._object = attributes.get("id", "")
        elif tag in ("volume", "part"):
            first, last = int(attributes.get("firstid", 0)), int(attributes.get("lastid", -1))
            kind = _plain(attributes.get("subtype", ""))
            self._volume = Volume("", kind, first, last, attributes.get("id", "") if tag == "part" else "")
        elif tag == "metadata":
            key, value = attributes.get("key", ""), attributes.get("value", "")
            if self._volume is None:
                if key == "name":
                    self.names[self._object] = value
            elif key == "name":
                self._volume = self._volume._replace(name=value)
            elif key == "volume_type":
                self._volume = self._volume._replace(kind=_plain(value))
            elif key == "modifier" and value == "1" and self._volume.is_body:  # of versions before volume_type
                self._volume = self._volume._replace(kind="modifier")

    def end(self, tag: str) -> None:
        """Take the end of an element."""
        if tag in ("volume", "part") and self._volume is not None:
            self.volumes.setdefault(self._object, []).append(self._volume)
            self._volume = None


def _plain(kind: str) -> str:
    return kind.replace("_", "").strip().lower()
