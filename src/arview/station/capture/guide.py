"""CaptureGuide: leads a person round a part, and says at which frames photos are to be taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad import Part
from arview.camera import Camera
from arview.core.checks import check_type
from arview.core.messages import Message, sentence
from arview.geometry import Array, apply, check_rigid, direction_from
from arview.pose import Pose, TrackingState
from arview.station.capture import words
from arview.station.capture.advice import CaptureAdvice, CellState, RingDistance
from arview.station.capture.dome import CaptureDome, component_points
from arview.station.capture.needs import CaptureNeeds
from arview.station.capture.options import CaptureOptions
from arview.station.capture.trigger import FocusMonitor, Hysteresis, MotionMonitor, middle_of_part

QUALITY = (0.5, 0.4)
"""Quality of the tracked pose needed to begin, and to go on; wrong poses mostly do not reach 0.5."""
FOCUS_PX = 320
"""Side of the part of the picture in which sharpness is measured."""
MIN_INSIDE = 0.8
"""Share of the part's bounding box that must be in the picture."""
PENDING_S = 8.0
"""Time after which a photo that was asked for and not reported counts as failed."""
DISTANCE_SLACK = 0.06
"""Share by which the limits of the distance are wider once it was good."""
GAIN_SHARE = 0.5
"""Share of the best direction's gain from which a photo is taken from another one …."""
MIN_GAIN_SHARE = 0.1
"""… and the share accepted at the end of ``PATIENCE_S`` after the last photo."""
PATIENCE_S = 6.0
"""Time after the last photo in which ``GAIN_SHARE`` falls to ``MIN_GAIN_SHARE``: a person who does not go where it is
best still gets photos."""


class CaptureGuide:
    """Guided capture of one part for one job. It has no threads and is used by one at a time.

    Args:
        part: CAD, roles, tolerances, range of views.
        camera: of the stream.
        options: see `CaptureOptions`.
        taken: (4,4) ``cam_from_model`` of photos taken before.
        dome: of a guide of the same part, camera and options, so that nothing is rendered again.

    Attributes:
        dome: the directions, and what is visible from each.
        needs: what the photos show and what they lack.

    Raises:
        InputError: a pose that is not a rigid transform.
    """

    def __init__(
        self,
        part: Part,
        camera: Camera,
        options: CaptureOptions | None = None,
        taken: Sequence[Array] = (),
        dome: CaptureDome | None = None,
    ) -> None:
        check_type(part, Part, "CaptureGuide: part")
        check_type(camera, Camera, "CaptureGuide: camera")
        self.options = o = options or CaptureOptions()
        self._camera = camera.without_distortion()
        self._center = part.model.center_in_model
        low, high = part.model.bounds_in_model
        self._corners = low + np.array(list(np.ndindex(2, 2, 2))) * (high - low)
        self._points = component_points(part)
        self.dome = dome or CaptureDome.of(part, camera, o)
        self.needs = CaptureNeeds(part, self._camera, self.dome, o)
        for pose in taken:
            self.needs.add(check_rigid(pose, "CaptureGuide: taken"))
        self._motion = MotionMonitor(self._corners, self._camera, o.trigger)
        self._focus = FocusMonitor(o.trigger)
        self._quality = Hysteresis(*QUALITY)
        self._distance: RingDistance = "far"
        self._take_id = 0
        self._asked: tuple[float, Array] | None = None  # time and pose of the photo that was asked for
        self._last_s: float | None = None  # of the last photo
        self._cells: tuple[int, tuple[CellState, ...]] | None = None

    def layout(self) -> dict[str, Any]:
        """Cells, distances and the number of photos wanted, for a page that draws the dome."""
        return self.dome.layout(self.options.wanted_photos)

    def update(
        self, pose: Pose, image_rgb: NDArray[np.uint8] | None, time_s: float, gyro_rad_s: float | None = None
    ) -> CaptureAdvice:
        """What to do at a frame.

        Args:
            pose: of the part in it.
            image_rgb: (H,W,3) uint8 frame, for its sharpness; None: sharpness is not checked.
            time_s: time stamp of the frame.
            gyro_rad_s: rate of turn by the device's gyroscope, None without one.
        """
        if self._asked is not None and not 0.0 <= time_s - self._asked[0] <= PENDING_S:
            self.photo_failed()
        obstacle = self._obstacle(pose, image_rgb, time_s, gyro_rad_s)
        if not obstacle and pose.cam_from_model is not None:
            self._take_id += 1
            self._asked = time_s, pose.cam_from_model
        takes = self._asked is not None
        here = pose.cam_from_model if pose.state is TrackingState.TRACKED else None
        return CaptureAdvice(
            takes=takes,
            take_id=self._take_id,
            text=self._way(here),
            reason=obstacle,
            progress=self.needs.progress,
            is_enough=self.needs.is_enough,
            photos=self.needs.photos,
            cells=self._cell_states(),
            distance=self._distance,
            components=self.needs.components(None if here is None else self._cell(here)),
            revision=self.needs.revision,
        )

    def photo_taken(self, cam_from_model: Array) -> None:
        """Count a photo.

        Args:
            cam_from_model: (4,4) its pose: that of the frame at which it was taken.

        Raises:
            InputError: it is no rigid transform.
        """
        self.needs.add(check_rigid(cam_from_model, "photo_taken"))
        if self._asked is not None:
            self._last_s, self._asked = self._asked[0], None

    def photo_failed(self) -> None:
        """The photo that was asked for could not be taken: it is asked for again."""
        if self._asked is not None:
            self._last_s, self._asked = self._asked[0], None

    # --- whether to take one now -----------------------------------------------------------------------------

    def _obstacle(
        self, pose: Pose, image_rgb: NDArray[np.uint8] | None, time_s: float, gyro_rad_s: float | None
    ) -> str:
        """Why no photo is to be taken at this frame; empty if nothing stands against it."""
        trigger = self.options.trigger
        here = pose.cam_from_model
        is_certain = self._quality.update(pose.quality if here is not None else 0.0)
        if here is None:
            self._motion.forget()
            return sentence("capture.not_tracked")
        is_still = self._motion.update(here, time_s, gyro_rad_s)
        self._distance = self._ring_distance(here)
        pixels = self._camera.project(apply(here, self._corners))
        gray = None if image_rgb is None else middle_of_part(image_rgb, pixels, FOCUS_PX)
        is_sharp = gray is None or self._focus.update(gray, time_s)
        if self._asked is not None:
            return sentence("capture.taking")
        if self.needs.is_enough:
            return sentence("capture.enough")
        if pose.state is not TrackingState.TRACKED or not is_certain:
            return (
                sentence("capture.not_tracked")
                if pose.state is not TrackingState.CRITICAL
                else sentence("capture.uncertain")
            )
        if pose.is_label_withheld:
            return sentence("capture.other_specimen")
        if pose.alternatives:
            return sentence("capture.ambiguous")
        if self._distance != "good":
            return sentence("capture.closer") if self._distance == "far" else sentence("capture.farther")
        if self._inside_share(pixels) < MIN_INSIDE:
            return sentence("capture.not_inside")
        if self.needs.nearest_deg(self._direction(here)) < self.needs.apart_deg:
            return sentence("capture.already_taken")
        if not self._gains_enough(here, time_s):
            return sentence("capture.little_gain")
        if not is_still:
            return sentence("capture.hold_still")
        if not is_sharp:
            return sentence("capture.not_sharp")
        if self._last_s is not None and 0.0 <= time_s - self._last_s < trigger.min_interval_s:
            return sentence("capture.too_soon")
        return "" if gray is None or self._focus.is_in_focus(gray) else sentence("capture.out_of_focus")

    def _gains_enough(self, cam_from_model: Array, time_s: float) -> bool:
        """Whether a photo from here lowers U nearly as much as one from the best direction.

        The share that is asked for falls with the time since the last photo.
        """
        waited_s = PATIENCE_S if self._last_s is None else max(0.0, time_s - self._last_s)
        share = GAIN_SHARE + (MIN_GAIN_SHARE - GAIN_SHARE) * min(1.0, waited_s / PATIENCE_S)
        return self.needs.gain_of(cam_from_model, self._cell(cam_from_model)) >= share * self.needs.best_gain

    def _ring_distance(self, cam_from_model: Array) -> RingDistance:
        """Where the camera is beside the ring of good distances, with hysteresis."""
        distance_mm = float(np.linalg.norm(apply(cam_from_model, self._center)))
        near, far = self.dome.distance_mm
        slack = 1.0 + DISTANCE_SLACK if self._distance == "good" else 1.0
        if distance_mm < near / slack:
            return "near"
        return "far" if distance_mm > far * slack else "good"

    def _inside_share(self, pixels: Array) -> float:
        """Share of the bounding box (8,2) of the part, as drawn in the picture, that is in it."""
        if not np.isfinite(pixels).all():
            return 0.0
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        size = np.array([self._camera.width, self._camera.height])
        inside = np.maximum(np.minimum(high, size - 0.5) - np.maximum(low, -0.5), 0.0)
        return float(np.prod(inside / np.maximum(high - low, 1e-9)))

    # --- what is said ----------------------------------------------------------------------------------------

    def _direction(self, cam_from_model: Array) -> Array:
        """(3,) unit vector from the part's centre to the camera."""
        return direction_from(cam_from_model, self._center)

    def _cell(self, cam_from_model: Array) -> int:
        """The cell of the dome nearest to the camera."""
        return self.dome.nearest(self._direction(cam_from_model))

    def _way(self, here: Array | None) -> Message:
        """Where to go next."""
        if self.needs.is_enough:
            return sentence("capture.enough")
        plan = self.needs.plan
        if here is None:
            return words.more_message(len(plan), ())
        distance_mm = float(np.linalg.norm(apply(here, self._center)))
        eyes = self._center + distance_mm * self.dome.directions[plan]
        sides = [words.side_of(here, eye, self._center) for eye in eyes]
        more = words.more_message(len(plan), sides)
        hidden = words.hidden_message(self.needs.hidden_from(self._cell(here)))
        return more if hidden is None else sentence("capture.both", first=more, second=hidden)

    def _cell_states(self) -> tuple[CellState, ...]:
        """The cells of the dome, made anew when something has changed."""
        if self._cells is None or self._cells[0] != self.needs.revision:
            wanted, filled = set(self.needs.plan), self.needs.filled
            states = tuple(
                CellState(float(azimuth), float(elevation), index in filled, index in wanted and index not in filled)
                for index, (azimuth, elevation) in enumerate(self.dome.angles_deg)
            )
            self._cells = self.needs.revision, states
        return self._cells[1]
