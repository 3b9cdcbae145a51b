"""The subject: the part that is shown, with its guide views and its inspection."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import cached_property

from arview.cad.part import Part
from arview.camera import Camera
from arview.camera.read import guess_camera, load_camera
from arview.fiducials.serial_code import SerialNumbers
from arview.geometry import Array
from arview.guideviews import GuideViewSet
from arview.inspection import Inspection
from arview.live.options import LiveOptions
from arview.live.stream.inspection_file import InspectionFile
from arview.live.stream.notices import Notice
from arview.overlay import OverlayOptions, OverlayRenderer
from arview.overlay.options import EdgeMode
from arview.tracking import TrackingSession
from arview.tracking.guide_pose import guide_pose
from arview.tracking.self_calibration.session import SelfCalibratingSession
from arview.video.intrinsics import load_square_camera

_SECONDS_PER_DAY = 86400.0
PHONE_FOV = "fov:66"
"""Camera assumed for phones: field of view along the longer side. Their main cameras have 65 to 72° (24 to 28 mm)."""


@dataclass(frozen=True)
class OverlayStyle:
    """What the server draws over the picture.

    Raises:
        InputError: the opacity is outside 0 to 1, or the edge mode is unknown.
    """

    ghost: bool = True
    edges: EdgeMode = "visible"
    labels: bool = True
    opacity: float = OverlayOptions.opacity
    only: str | None = None  # the only component that is drawn and labelled; None: all
    status: bool = True  # the status line at the lower edge; the page shows the same as text

    def __post_init__(self) -> None:
        self.overlay_options()

    def overlay_options(self) -> OverlayOptions:
        """The same style as options of the renderer."""
        return OverlayOptions(
            show_ghost=self.ghost,
            show_edges=self.edges,
            show_labels=self.labels,
            show_status=self.status,
            opacity=self.opacity,
        )


class Subject:
    """The part and its inspection; safe to use from several threads.

    Args:
        part: the part with its model.
        views: guide views of that model.
        options: options of the server.

    Attributes:
        serial: serial number of the part at the station, or None.
        revision: number of the part document, increased with each new inspection.

    Raises:
        InputError, MismatchError: the inspection cannot be read or belongs to another model, or the guide view does
            not exist.
    """

    def __init__(self, part: Part, views: GuideViewSet, options: LiveOptions) -> None:
        self.part, self.views, self.options = part, views, options
        self.serial = options.serial or part.serial
        self.revision = 1
        self._lock = threading.Lock()
        self._file: InspectionFile | None = None
        if options.inspection is not None:
            self._file = InspectionFile(options.inspection, part.model, self.serial, options.max_age_s)
        if options.guide is not None:
            guide_pose(options.guide, part, views.view_range, guess_camera(options.width, options.height))

    @cached_property
    def label_options(self) -> OverlayOptions:
        """Options of the texts on labels: the units, and from which age on an inspection is stale."""
        max_age_s = self.options.max_age_s
        return OverlayOptions(max_age_days=None if max_age_s is None else max_age_s / _SECONDS_PER_DAY)

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
        """The notices about camera and inspection."""
        notices = [] if self._file is None else self._file.notices()
        if self._file is None:
            notices.append(Notice("inspection_none", "info", "no inspection: nothing has been measured"))
        if self.options.camera is None:
            notices.append(
                Notice("camera_guessed", "warning", "camera not calibrated: distances to the part are only rough")
            )
        return notices

    def camera(
        self,
        width: int,
        height: int,
        quarter_turns_clockwise: int = 0,
        unsquared_size: tuple[int, int] | None = None,
    ) -> Camera:
        """Intrinsics for the frames of a feed, whose pixels may have been made square.

        Raises:
            InputError, MismatchError: the camera file cannot be read or is for frames of another aspect ratio.
        """
        spec, source = self.options.camera, self.options.source
        if spec is not None:
            size = (width, height)
            return load_square_camera(spec, size, unsquared_size, quarter_turns_clockwise, source)
        if self.options.is_phone:
            return load_camera(PHONE_FOV, width, height)
        return guess_camera(width, height)

    def session(self, camera: Camera) -> TrackingSession | SelfCalibratingSession:
        """A new tracking session for a feed with this camera, which is replaced while it runs if it is guessed."""
        guide = None
        if self.options.guide is not None:
            guide = guide_pose(self.options.guide, self.part, self.views.view_range, camera)

        def make_session(camera: Camera, start: Array | None) -> TrackingSession:
            return TrackingSession(
                self.views,
                camera,
                self.part.model,
                initial_cam_from_model=start,
                guide_cam_from_model=guide,
                serials=self.serial_numbers,
            )

        if self.options.camera is not None:
            return make_session(camera, None)
        return SelfCalibratingSession(make_session, self.views, camera)

    def overlay(self, camera: Camera, style: OverlayStyle) -> OverlayRenderer:
        """A renderer of the overlay for a feed with this camera."""
        inspection = self.inspection
        if inspection is not None and style.only is not None:
            wanted = tuple(one for one in inspection.components if one.name == style.only)
            inspection = replace(inspection, components=wanted)
        options = replace(style.overlay_options(), max_age_days=self.label_options.max_age_days)
        return OverlayRenderer(self.part.model, camera, inspection, options, serial=self.serial)
