"""BackgroundMotion: how the scene around the part has moved in the picture since the part was last tracked.

Corners of the background are followed from frame to frame (Lucas and Kanade 1981; Bouguet 2000) and give a chain of
homographies. Where the chain breaks, as in a blurred frame, the last picture of the tracked part is matched by features
(ORB, Rublee et al. 2011).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.geometry import Array
from arview.tracking.identity.part_outline import PartOutline, transfer

MAX_SIDE_PX = 480
"""Longer side of the reduced pictures in which the background is followed."""
MAX_CORNERS = 160
"""Corners followed from one frame to the next."""
MIN_CORNER_QUALITY = 0.01
"""Quality of a corner relative to the best one."""
CORNER_SPACING_PX = 8
"""Least distance between two corners of a reduced picture."""
WINDOW_PX = 15
"""Side of the window around a corner that is followed."""
MAX_RETURN_PX = 0.7
"""Distance within which a corner must return when it is followed back."""
MAX_RESIDUAL_PX = 2.0
"""Distance from the homography within which a corner or match counts as an inlier."""
MIN_INLIERS = 15
MIN_INLIER_SHARE = 0.5
"""Of the corners that were followed, for a link from frame to frame."""
MAX_FEATURES = 600
"""Features matched between two pictures where no chain of frames links them."""
MIN_MATCH_INLIERS = 25
MIN_MATCH_INLIER_SHARE = 0.4
"""Of these matches."""
MAX_MATCH_RATIO = 0.8
"""Distance of the best match of a feature relative to that of the second best."""
MAX_SCALE = 3.0
"""Change of scale, in either direction, beyond which a homography is not believed."""


@dataclass(frozen=True)
class ReducedPicture:
    """A reduced grey picture.

    Attributes:
        gray: (rows,columns) uint8.
        scale: its size over that of the frame.
    """

    gray: NDArray[np.uint8]
    scale: float

    @property
    def matrix(self) -> Array:
        """Homography (3,3) from the frame; integers are centres of pixels in both."""
        shift = 0.5 * self.scale - 0.5
        return np.array([[self.scale, 0.0, shift], [0.0, self.scale, shift], [0.0, 0.0, 1.0]])


def reduced(image: NDArray[np.uint8], max_side_px: int) -> ReducedPicture:
    """A frame (H,W,3) uint8 RGB as a grey picture whose longer side is at most ``max_side_px``."""
    scale = min(1.0, max_side_px / max(image.shape[:2]))
    size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else image
    return ReducedPicture(np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)), scale)


class BackgroundMotion:
    """Motion of the background since a picture.

    Args:
        outline: of the part, which is no background.

    Attributes:
        homography: (3,3) from the first picture to the last, px of the frame; None where it is not known.
        is_chained: whether an unbroken chain of frames gave it. One matched over a gap says where the part is, but not
            where it is not, because the view may have changed so much that the scene is no plane any more.
    """

    def __init__(self, outline: PartOutline) -> None:
        self.homography: Array | None = None
        self.is_chained = False
        self._outline = outline
        self._first: ReducedPicture | None = None
        self._first_pose: Array | None = None
        self._last: ReducedPicture | None = None
        self._features: tuple[NDArray[np.float32], NDArray[np.uint8]] | None = None

    def start(self, picture: ReducedPicture, cam_from_model: Array) -> None:
        """Begin at a picture with the part at a pose (4,4)."""
        self._first = self._last = picture
        self._first_pose = cam_from_model
        self._features = None
        self.homography = np.eye(3)
        self.is_chained = True

    def follow(self, image: NDArray[np.uint8], cam_from_model: Array | None) -> None:
        """Follow the background into the next frame (H,W,3) uint8 RGB with the part at a pose (4,4), if it is known."""
        if self._last is None:
            return
        before, self._last = self._last, reduced(image, MAX_SIDE_PX)
        if self.homography is not None:
            link = self._link(before, self._last, cam_from_model)
            self.homography = None if link is None else self._checked(link @ self.homography)
            self.is_chained = self.is_chained and self.homography is not None

    def match(self, cam_from_model: Array | None) -> None:
        """Match the last frame, with the part at a pose (4,4), with the first picture, where no chain links them."""
        if self.homography is None and self._first is not None and self._last is not None:
            matched = self._matched(self._first, self._last, cam_from_model)
            self.homography = None if matched is None else self._checked(matched)

    def _link(self, before: ReducedPicture, after: ReducedPicture, cam_from_model: Array | None) -> Array | None:
        """Homography (3,3) of the frame from one picture to the next one; None where it is not sure."""
        poses = [] if self._first_pose is None else [self._outline.moved(self._first_pose, self._known())]
        poses += [] if cam_from_model is None else [cam_from_model]
        mask = self._outline.mask(poses, before.scale, before.gray.shape[:2], 0.05)
        corners = cv2.goodFeaturesToTrack(before.gray, MAX_CORNERS, MIN_CORNER_QUALITY, CORNER_SPACING_PX, mask=mask)
        if corners is None or len(corners) < MIN_INLIERS:
            return None
        window = (WINDOW_PX, WINDOW_PX)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(before.gray, after.gray, corners, None, winSize=window, maxLevel=3)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(after.gray, before.gray, moved, None, winSize=window, maxLevel=3)
        is_good = (found[:, 0] > 0) & (found_back[:, 0] > 0)
        is_good &= np.linalg.norm(back - corners, axis=2)[:, 0] < MAX_RETURN_PX
        return self._fitted(corners[is_good, 0], moved[is_good, 0], before, after, MIN_INLIERS, MIN_INLIER_SHARE)

    def _known(self) -> Array:
        return np.eye(3) if self.homography is None else self.homography

    def _matched(self, first: ReducedPicture, last: ReducedPicture, cam_from_model: Array | None) -> Array | None:
        if self._features is None:
            self._features = self._described(first, self._first_pose)
        pixels, descriptors = self._features
        pixels_now, descriptors_now = self._described(last, cam_from_model)
        if min(len(pixels), len(pixels_now)) < MIN_MATCH_INLIERS:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors, descriptors_now, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < MAX_MATCH_RATIO * p[1].distance]
        if len(good) < MIN_MATCH_INLIERS:
            return None
        before, after = pixels[[m.queryIdx for m in good]], pixels_now[[m.trainIdx for m in good]]
        return self._fitted(before, after, first, last, MIN_MATCH_INLIERS, MIN_MATCH_INLIER_SHARE)

    def _described(
        self, picture: ReducedPicture, cam_from_model: Array | None
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Pixels (N,2) and descriptors (N,32) of the features around the part at a pose (4,4)."""
        poses = [] if cam_from_model is None else [cam_from_model]
        mask = self._outline.mask(poses, picture.scale, picture.gray.shape[:2], 0.05)
        points, descriptors = cv2.ORB.create(MAX_FEATURES).detectAndCompute(picture.gray, mask)
        if descriptors is None:
            return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
        return np.array([point.pt for point in points], dtype=np.float32), descriptors

    def _fitted(
        self,
        before_px: NDArray[np.float32],
        after_px: NDArray[np.float32],
        before: ReducedPicture,
        after: ReducedPicture,
        min_inliers: int,
        min_share: float,
    ) -> Array | None:
        """Homography (3,3) of the frame by matches (N,2) of reduced pictures; None with too few inliers."""
        if len(before_px) < min_inliers:
            return None
        homography, inliers = cv2.findHomography(before_px, after_px, cv2.RANSAC, MAX_RESIDUAL_PX)
        if homography is None or inliers.sum() < max(min_inliers, min_share * len(before_px)):
            return None
        return np.asarray(np.linalg.inv(after.matrix) @ homography @ before.matrix)

    def _checked(self, homography: Array) -> Array | None:
        """A homography (3,3), normalised; None where it cannot be that of a scene before the camera."""
        if self._first_pose is None:
            return None
        homography = homography / homography[2, 2]
        center = self._outline.place(self._first_pose).center_px
        is_before = homography[2] @ np.array([*center, 1.0]) > 0
        scale = transfer(homography, center)[1]
        is_possible = is_before and math.isfinite(scale) and 1 / MAX_SCALE < scale < MAX_SCALE
        return homography if is_possible else None
