"""Subject: what is looked at. The part, its guide views and its inspection, and what is made of them for one feed."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

from arview.cad.part import Part
from arview.camera import Camera
from arview.camera.read import guess_camera, load_camera
from arview.guideviews import GuideViewSet
from arview.inspection import Inspection
from arview.live.options import LiveOptions
from arview.live.stream.inspection_file import InspectionFile
from arview.live.stream.notices import Notice
from arview.overlay import OverlayOptions, OverlayRenderer
from arview.overlay.options import EdgeMode
from arview.tracking import TrackingSession
from arview.tracking.guide_pose import guide_pose

PHONE_FOV = "fov:66"
"""Along the longer side: main cameras of phones have 24 to 28 mm equivalent, 65 to 72°."""


@dataclass(frozen=True)
class Look:
    """What the server draws.

    Raises:
        InputError: an opacity outside 0–1 or another edge mode.
    """

    ghost: bool = True
    edges: EdgeMode = "visible"
    labels: bool = True
    opacity: float = OverlayOptions.opacity
    only: str | None = None  # the component that alone is drawn and labelled; None: all
    status: bool = True  # the line at the lower edge; a page shows the same in its own letters

    def __post_init__(self) -> None:
        self.overlay_options()

    def overlay_options(self) -> OverlayOptions:
        """The same for the renderer."""
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
        part: with its model.
        views: guide views of that model.
        options: of the server.

    Raises:
        InputError, MismatchError: the inspection cannot be read or is another model's, or there is no such guide.
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

    @property
    def inspection(self) -> Inspection | None:
        """The inspection that is shown now."""
        with self._lock:
            return self._file.inspection if self._file else None

    def reload(self) -> bool:
        """Read the inspection again if its file has changed; True when another one is shown now."""
        if self._file is None or not self._file.reload():
            return False
        with self._lock:
            self.revision += 1
        return True

    def notices(self) -> list[Notice]:
        """What is to be said of camera and inspection."""
        said = [] if self._file is None else self._file.notices()
        if self._file is None:
            said.append(Notice("inspection_none", "info", "no inspection: nothing has been measured"))
        if self.options.camera is None:
            said.append(
                Notice("camera_guessed", "warning", "camera not calibrated: distances to the part are only rough")
            )
        return said

    def camera(self, width: int, height: int, quarter_turns_clockwise: int = 0) -> Camera:
        """Intrinsics of the pictures of a feed.

        Raises:
            InputError, MismatchError: the camera file cannot be read or is for pictures of another shape.
        """
        spec, source = self.options.camera, self.options.source
        if spec is not None:
            return load_camera(spec, width, height, source, quarter_turns_clockwise)
        if self.options.is_phone:
            return load_camera(PHONE_FOV, width, height)
        return guess_camera(width, height)

    def session(self, camera: Camera) -> TrackingSession:
        """A new session for a feed with this camera."""
        guide = None
        if self.options.guide is not None:
            guide = guide_pose(self.options.guide, self.part, self.views.view_range, camera)
        return TrackingSession(self.views, camera, self.part.model, guide_cam_from_model=guide)

    def overlay(self, camera: Camera, look: Look) -> OverlayRenderer:
        """What draws for a feed with this camera."""
        inspection = self.inspection
        if inspection is not None and look.only is not None:
            wanted = tuple(one for one in inspection.components if one.name == look.only)
            inspection = replace(inspection, components=wanted)
        return OverlayRenderer(self.part.model, camera, inspection, look.overlay_options())
