"""Disambiguation: which of several near-symmetric poses the frames of a video support, and which others may be right.

A nearly round part, such as a mug, looks the same from many sides as long as what is not round is hidden behind it.
While it is followed it is compared now and then with itself, turned about its axis.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad import Model, find_round_axis
from arview.camera import Camera
from arview.geometry import Array, apply, rigid
from arview.refinement import BINS, ColorModel, PartView
from arview.rendering import rasterise

DECISION_MARGIN = 0.25
"""Sum over the frames of the differences in score that decides between two poses."""
EVERY_FRAMES = 4
"""Every so many frames a nearly round part is compared with itself, turned about its axis."""
FIRST_FRAMES = 2
"""Frames after the part was found in each of which it is compared."""
RADIUS_PX = 40.0
"""Half diameter of the part in the picture in which its outlines are compared."""
MIN_CHANGE = 0.012
"""Share of the part's picture that a turn must change for colours to tell which is right."""
WORSE, BETTER = -0.2, 0.3
"""Mean evidence of the pixels that a turn changes, -1 to 1, below which it does not fit, and from which it is right."""
MAX_SIGMA_DEG = 4.0
"""Standard deviation of the turn about the axis up to which design edges tell it. On a smooth part what seems to tell
it may be gloss and shadows, which stay where they are when the part turns."""
MAX_ALTERNATIVES = 4
"""Turned poses that are named."""


class HypothesisSet:
    """Near-symmetric alternatives of a tracked pose, compared with it frame by frame.

    Args:
        model_from_other: (4,4) transforms on the model's side that lead from the tracked pose to each alternative.
    """

    def __init__(self, model_from_other: list[Array]) -> None:
        self.model_from_other = model_from_other
        self._margins = [0.0] * len(model_from_other)

    def __len__(self) -> int:
        return len(self.model_from_other)

    def poses(self, cam_from_model: Array) -> list[Array]:
        """The alternatives (4,4) of a tracked pose."""
        return [cam_from_model @ turn for turn in self.model_from_other]

    def update(self, score: float, other_scores: list[float]) -> Array | None:
        """Count a frame.

        Alternatives whose scores sum up to clearly less than those of the tracked pose are dropped.

        Args:
            score: score of the tracked pose in this frame.
            other_scores: scores of the alternatives.

        Returns:
            Transform (4,4) to the alternative that is clearly better than the tracked pose; None if there is none.
        """
        pairs = zip(self._margins, other_scores, strict=True)
        self._margins = [margin + score - other for margin, other in pairs]
        worst = int(np.argmin(self._margins))
        if self._margins[worst] <= -DECISION_MARGIN:
            return self.model_from_other[worst]
        kept = [k for k, margin in enumerate(self._margins) if margin < DECISION_MARGIN]
        self.model_from_other = [self.model_from_other[k] for k in kept]
        self._margins = [self._margins[k] for k in kept]
        return None


class RoundTurns:
    """Turns of a nearly round part about its axis, which are compared with its pose while it is followed.

    What is not round, such as a handle, decides by its colours: where it stands out of the outline at one pose and not
    at another, the picture shows either the part or the background. Where it is hidden behind the part at both, nothing
    decides.

    Args:
        model: of the part; one that is not nearly round has no turns.
        part: its guide views in the form of the kernels.
        camera: of the pictures.

    Attributes:
        fitting: (4,4) turns of the model that fit as well as the pose; none where it is known.
    """

    def __init__(self, model: Model, part: PartView, camera: Camera) -> None:
        vertices, faces, _ = model.mesh
        self._axis = find_round_axis(vertices, faces)
        self._surface, self._camera, self._diameter_mm = part.surface, camera, model.diameter_mm
        self._is_smooth = part.is_smooth
        self._center_in_model = model.center_in_model
        self._frames = self._votes = 0
        self.fitting: list[Array] = []

    def is_due(self) -> bool:
        """Whether this frame is compared; asked once in each frame."""
        self._frames += 1
        is_turn = self._frames <= FIRST_FRAMES or self._frames % EVERY_FRAMES == 0
        return self._axis is not None and is_turn

    def better(
        self, image: NDArray[np.uint8], cam_from_model: Array, covariance: Array, colors: ColorModel
    ) -> Array | None:
        """The turn (4,4) of the model at which the picture shows it, if that is not its pose; else None.

        A turn must be better at two comparisons.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) pose.
            covariance: (6,6) of its twist.
            colors: of part and background.
        """
        assert self._axis is not None
        changes, evidence = self._compared(image, cam_from_model, colors)
        is_told = changes >= MIN_CHANGE
        best = int(np.argmax(np.where(is_told, changes * evidence, -np.inf)))
        is_better = bool(is_told[best] and evidence[best] >= BETTER)
        self._votes = self._votes + 1 if is_better else 0
        sigma_rad = float(np.sqrt(self._axis.direction @ covariance[:3, :3] @ self._axis.direction))
        is_seen = not self._is_smooth and np.rad2deg(sigma_rad) <= MAX_SIGMA_DEG
        if not self.fitting and not is_better and is_seen:
            return None
        fitting = np.flatnonzero(~is_told | (evidence > WORSE))
        chosen = fitting[np.linspace(0, len(fitting) - 1, min(len(fitting), MAX_ALTERNATIVES)).astype(int)]
        self.fitting = [self._axis.turns[index] for index in chosen]
        if self._votes < 2:
            return None
        self._votes, self.fitting = 0, []
        return np.asarray(self._axis.turns[best])

    @property
    def unknown_twist(self) -> Array | None:
        """The turn (6,) about the axis by 1 rad, as `Tracker.hold_turn` takes it, while it is not known."""
        if self._axis is None or not self.fitting:
            return None
        arm = self._axis.point_in_model - self._center_in_model
        return np.concatenate([self._axis.direction, np.cross(arm, self._axis.direction)])

    def reset(self) -> None:
        """Forget what was compared: the part was found anew."""
        self._frames = self._votes = 0
        self.fitting = []

    def _compared(self, image: NDArray[np.uint8], cam_from_model: Array, colors: ColorModel) -> tuple[Array, Array]:
        """Of each turn (T,): the share of the part's picture that it changes, and the evidence of what changes for it.

        The evidence is the mean lean of the pixels that only the turned part covers towards the part's colours, and of
        those that only the pose covers towards the background's.
        """
        assert self._axis is not None
        center = apply(cam_from_model, self._center_in_model)
        radius_px = 0.5 * self._diameter_mm * self._camera.fx / center[2]
        size = np.array([self._camera.width, self._camera.height])
        middle = self._camera.project(center)
        first = np.clip(np.floor(middle - 1.1 * radius_px), 0, size - 2).astype(int)
        last = np.clip(np.ceil(middle + 1.1 * radius_px), first + 2, size).astype(int)
        small = np.maximum(np.round((last - first) * min(1.0, RADIUS_PX / radius_px)), 2).astype(int)
        camera = self._camera.cropped(*first.tolist(), *(last - first).tolist()).scaled(*small.tolist())
        picture = cv2.resize(
            image[first[1] : last[1], first[0] : last[0]], small.tolist(), interpolation=cv2.INTER_AREA
        )
        bins = colors.bin_of[picture].astype(np.int64)
        odds = colors.odds[(bins[..., 0] * BINS + bins[..., 1]) * BINS + bins[..., 2]]
        lean = odds / np.sqrt(1.0 + odds * odds)
        about_center = rigid(np.eye(3), self._center_in_model)
        masks = [
            rasterise(
                apply(cam_from_model @ turn @ about_center, self._surface.points.astype(np.float64)),
                self._surface.faces,
                camera.fx,
                camera.fy,
                camera.cx,
                camera.cy,
                camera.width,
                camera.height,
            )[1]
            >= 0
            for turn in (np.eye(4), *self._axis.turns)
        ]
        own, turned = masks[0], np.stack(masks[1:])
        gained = turned.astype(np.int8) - own
        counts = np.abs(gained).sum(axis=(1, 2))
        evidence = (gained * lean).sum(axis=(1, 2)) / np.maximum(counts, 1)
        return counts / max(int(own.sum()), 1), evidence
