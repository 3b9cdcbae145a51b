"""The parts and specimens that are tracked in one stream: which they are, their sessions and their drawing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from arview import overlay as overlays
from arview import tracking
from arview.errors import InputError

if TYPE_CHECKING:
    from arview.cad import Part
    from arview.camera import Camera
    from arview.fiducials import SerialNumbers
    from arview.inspection import Inspection


class Specimen(NamedTuple):
    """One specimen to be tracked, with its inspection if there is one."""

    name: str
    part: Part
    inspection: Inspection | None

    @property
    def serials(self) -> SerialNumbers | None:
        """Serial number that a code on the specimen must hold; None where neither part nor inspection says one."""
        from arview.fiducials import SerialNumbers

        inspected = None if self.inspection is None else self.inspection.serial
        return SerialNumbers.expected(inspected, self.part.serial, self.part.serial_pattern)


def load_specimens(
    part_paths: Sequence[str], instances: int, inspection_paths: Sequence[str], unit: str | None
) -> list[Specimen]:
    """The specimens of a command line, in the order of the parts.

    Args:
        part_paths: part files or CAD files, one for each part.
        instances: specimens of each part.
        inspection_paths: inspections of the first specimens, in their order.
        unit: of CAD files without one.

    Raises:
        InputError: more inspections than specimens, or a file that cannot be read.
    """
    from arview.cad import load_part
    from arview.inspection import load_inspection

    parts = [part for path in part_paths for part in [load_part(path, unit)] * instances]
    if len(inspection_paths) > len(parts):
        raise InputError(
            f"--inspection: {len(inspection_paths)} given for {len(parts)} specimen{'s' if len(parts) > 1 else ''}; "
            f"give one for each --part, or with --instances one for each specimen"
        )
    found = [load_inspection(path, part.model) for path, part in zip(inspection_paths, parts, strict=False)]
    inspections = [*found, *[None] * (len(parts) - len(found))]
    names = tracking.specimen_names([part.name for part in parts])
    return [Specimen(*of) for of in zip(names, parts, inspections, strict=True)]


def make_overlay(
    specimens: Sequence[Specimen], options: overlays.OverlayOptions, camera: Camera
) -> overlays.OverlayRenderer:
    """The drawing of all specimens in one picture."""
    (name, part, inspection), *others = specimens
    overlay = overlays.OverlayRenderer(part.model, camera, inspection, options, name=name, serial=part.serial)
    for name, part, inspection in others:
        overlay.add(part.model, inspection, name=name, serial=part.serial)
    return overlay
