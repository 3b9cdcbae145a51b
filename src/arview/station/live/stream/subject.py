"""A subject: a part that is shown, with its guide views and its inspection."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from arview import guideviews, tracking
from arview import overlay as overlays
from arview.cad import Part
from arview.camera import Camera, guess_camera
from arview.core.messages import sentence
from arview.fiducials import SerialNumbers
from arview.inspection import Inspection
from arview.station.live.options import LiveOptions
from arview.station.live.stream.inspection_file import InspectionFile
from arview.station.live.stream.notices import Notice
from arview.tracking.guide_pose import guide_pose

_SECONDS_PER_DAY = 86400.0


@dataclass(frozen=True)
class OverlayStyle:
    """What the server draws over the picture.

    Raises:
        InputError: the opacity is outside 0 to 1, or the edge mode is unknown.
    """

    ghost: bool = True
    edges: overlays.EdgeMode = "visible"
    labels: bool = True
    opacity: float = overlays.OverlayOptions.opacity
    only: str | None = None  # the only component that is drawn and labelled; None: all
    only_part: int = 0  # number of the part to which that component belongs
    status: bool = True  # the status line at the lower edge; the page shows the same as text
    text_px: int | None = None  # size of the text on labels; None: in proportion to the height of the picture

    def __post_init__(self) -> None:
        self.overlay_options()

    def overlay_options(self) -> overlays.OverlayOptions:
        """The same style as options of the renderer."""
        return overlays.OverlayOptions(
            show_ghost=self.ghost,
            show_edges=self.edges,
            show_labels=self.labels,
            show_status=self.status,
            opacity=self.opacity,
            text_px=self.text_px,
        )


class Subject:
    """A part and its inspection; safe to use from several threads.

    Args:
        part: the part with its model.
        views: guide views of that model.
        options: options of the server.
        name: that tells it from the others, see `Pose.instance`; empty for the only one.
        inspection_path: of its inspection, or None.
        path: of the part file or CAD file, or None.

    Attributes:
        serial: serial number of the part at the station, or None.
        revision: number of the part document, increased with each new inspection.
        pending: names of the components that are being measured: those without a value say so.

    Raises:
        InputError, MismatchError: the inspection cannot be read or belongs to another model, or the guide view does
            not exist.
    """

    def __init__(
        self,
        part: Part,
        views: guideviews.GuideViewSet,
        options: LiveOptions,
        name: str = "",
        inspection_path: Path | None = None,
        path: str | None = None,
    ) -> None:
        self.part, self.views, self.options, self.name, self.path = part, views, options, name, path
        self.serial = options.serial or part.serial
        self.revision = 1
        self._lock = threading.Lock()
        self._file: InspectionFile | None = None
        if inspection_path is not None:
            self._file = InspectionFile(inspection_path, part.model, self.serial, options.max_age_s)
        if options.guide is not None:
            guide_pose(options.guide, part, views.view_range, guess_camera(options.width, options.height))

    pending: frozenset[str] = frozenset()

    @cached_property
    def label_options(self) -> overlays.OverlayOptions:
        """Options of the texts on labels: the units, and from which age on an inspection is stale."""
        max_age_s = self.options.max_age_s
        return overlays.OverlayOptions(max_age_days=None if max_age_s is None else max_age_s / _SECONDS_PER_DAY)

    @property
    def inspection(self) -> Inspection | None:
        """The inspection that is currently shown."""
        with self._lock:
            return self._file.inspection if self._file else None

    @property
    def serial_numbers(self) -> SerialNumbers | None:
        """Serial number to which the labels belong, and which codes name one; None where there is neither."""
        inspection = self.inspection
        inspected = None if inspection is None else inspection.serial
        return SerialNumbers.expected(inspected, self.serial, self.part.serial_pattern)

    def reload(self) -> bool:
        """Read the inspection again if its file has changed; returns whether another one is shown now."""
        if self._file is None or not self._file.reload():
            return False
        with self._lock:
            self.revision += 1
        return True

    def notices(self) -> list[Notice]:
        """The notices about the inspection."""
        if self._file is None:
            return [Notice("inspection_none", "info", sentence("told.inspection_none"))]
        return self._file.notices()

    def tracked_part(self, camera: Camera) -> tracking.TrackedPart:
        """The part for a tracking session; the only part of a feed with this camera may wait at its guide view."""
        guide = None
        if self.options.guide is not None and not self.name:
            guide = guide_pose(self.options.guide, self.part, self.views.view_range, camera)
        return tracking.TrackedPart(
            self.views, self.part.model, self.name, self.serial_numbers, guide_cam_from_model=guide
        )

    def overlay(
        self, camera: Camera, style: OverlayStyle, number: int = 0, beside: overlays.OverlayRenderer | None = None
    ) -> overlays.OverlayRenderer:
        """A renderer of the overlay for a feed with this camera; ``number`` is that of this part.

        Args:
            camera, style: of the drawing.
            number: of this part.
            beside: renderer of the parts before, to which this one is added; None: a new one.
        """
        with self._lock:
            pending = self.pending
        inspection = self.inspection
        measured = {one.name for one in inspection.components} if inspection else set()
        pending -= measured
        if style.only is not None:
            is_of_it = number == style.only_part
            pending &= {style.only} if is_of_it else set()
            if inspection is not None:
                wanted = tuple(one for one in inspection.components if is_of_it and one.name == style.only)
                inspection = replace(inspection, components=wanted)
        model, name, serial = self.part.model, self.name, self.serial
        if beside is None:
            options = replace(style.overlay_options(), max_age_days=self.label_options.max_age_days)
            return overlays.OverlayRenderer(
                model, camera, inspection, options, name=name, serial=serial, pending=pending
            )
        beside.add(model, inspection, name=name, serial=serial, pending=pending)
        return beside
