"""Cameras of Metashape: the XML of *Export Cameras*, and that of one calibration.

Metashape measures the principal point from the picture's centre, in pixels whose first has its corner at (0, 0), and
its ``p1`` and ``p2`` are Brown's exchanged (Metashape manual, appendix "Camera models", frame cameras).
"""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

from arview.camera.entry import CameraEntry
from arview.camera.model import COLMAP_HALF_PX
from arview.camera.tree import parse_xml
from arview.errors import InputError

_HEAD = 4000
_MAX_SKEW = 1e-5
"""Largest skew, as a share of the focal length, that moves no pixel of a picture by a hundredth."""
_HINT = "export the photos undistorted (File > Export > Undistort Photos) and give --camera of those"
_SIZE = ("width", "height")
_TERM = re.compile(r"f|c[xy]|[kpb]\d")
_UNSUPPORTED = ("k4", "p3", "p4")


def is_metashape(text: str) -> bool:
    """Whether a text begins as an XML file of Metashape does."""
    head = re.sub(r"\A<\?xml[^>]*\?>\s*", "", text[:_HEAD])
    if head.startswith("<document"):
        return "<chunk" in head or "<sensor" in head
    return head.startswith("<calibration") and "<projection>" in head and "<f>" in head


def entries_from_metashape(text: str, name: str = "") -> list[CameraEntry]:
    """The cameras of a file, a sensor each; where one has the wanted name, the others are not read.

    Raises:
        InputError: broken XML, or a sensor that is not a frame camera of Brown's terms.
    """
    root = parse_xml(text)
    if root.tag == "calibration":
        return [_entry(root, None, "")]
    sensors = [(one, one.get("label") or f"sensor{one.get('id', '')}") for one in root.iter("sensor")]
    labels = [label for _, label in sensors]
    sensors = [
        (one, label if labels.count(label) == 1 else f"{label}/{one.get('id', index)}")
        for index, (one, label) in enumerate(sensors)
    ]
    calibrated = [(one, label) for one, label in sensors if one.find("calibration") is not None]
    if not calibrated:
        raise InputError("no sensor in it has a calibration; align the photos in Metashape, export the cameras again")
    wanted = [(one, label) for one, label in calibrated if name and name == label]
    return [_entry(_calibration_of(one), one, label) for one, label in wanted or calibrated]


def _calibration_of(sensor: ElementTree.Element) -> ElementTree.Element:
    """The calibration of the alignment, else the first one."""
    found = sensor.findall("calibration")
    return next((one for one in found if one.get("class") == "adjusted"), found[0])


def _entry(calibration: ElementTree.Element, sensor: ElementTree.Element | None, label: str) -> CameraEntry:
    of_label = f"sensor {label}: " if label else ""
    kind = calibration.get("type") or calibration.findtext("projection")
    kind = kind or (None if sensor is None else sensor.get("type")) or "frame"
    if kind.strip() != "frame":
        raise InputError(f"{of_label}a {kind.strip()[:30]} camera of Metashape is not read; {_HINT}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None and sensor is not None else size
    texts = {one.tag: one.text for one in calibration if one.tag in _SIZE or _TERM.fullmatch(one.tag)}
    texts |= {} if size is None else {key: size.get(key) for key in _SIZE}
    numbers = {key: _number(key, text or "", of_label) for key, text in texts.items()}
    missing = [key for key in ("width", "height", "f") if not numbers.get(key, 0.0) > 0.0]
    if missing:
        raise InputError(f"{of_label}its calibration has no {', '.join(missing)}; export the cameras again")
    focal = numbers["f"]
    many = [key for key in _UNSUPPORTED if numbers.get(key, 0.0) != 0.0]
    many += ["b2 (skew)"] if abs(numbers.get("b2", 0.0)) > _MAX_SKEW * focal else []
    if many:
        raise InputError(
            f"{of_label}{', '.join(many)} of Metashape's lens model are not read; fix them at 0 in Optimize Cameras "
            f"and export again, or {_HINT}"
        )
    width, height = int(numbers["width"]), int(numbers["height"])
    terms = tuple(numbers.get(key, 0.0) for key in ("k1", "k2", "p2", "p1", "k3"))
    return CameraEntry(
        focal + numbers.get("b1", 0.0),
        focal,
        0.5 * width + numbers.get("cx", 0.0) - COLMAP_HALF_PX,
        cy=0.5 * height + numbers.get("cy", 0.0) - COLMAP_HALF_PX,
        dist=terms,
        lens=None,
        width=width,
        height=height,
        label=label,
    )


def _number(key: str, text: str, of_label: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (key in _SIZE and number != int(number)):
        kind = "whole number of px" if key in _SIZE else "number"
        raise InputError(f"{of_label}{key} is {text[:40]!r}; expected a {kind}; export again")
    return number
