"""Texture modality: the part's own texture, matched from keyframes of known pose, so that it does not drift.

A keyframe holds corners (Shi & Tomasi, CVPR 1994) with 3D points and surface normals from the CAD. In a new frame every
patch is warped into the predicted view by its tangent plane (PTAM: Klein & Murray, ISMAR 2007) and aligned coarse to
fine by inverse-compositional Lucas-Kanade (Baker & Matthews, IJCV 2004). Brightness gain and offset are projected out
of the steepest-descent images (Hager & Belhumeur, PAMI 1998), so that exposure may change abruptly. For large motion,
a shift common to all patches is first searched for at the coarsest level, as with the small image of PTAM.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array
from arview.refinement.modalities.keyframes import LEVELS, MIN_CORNERS, MIN_FACING, MIN_NCC, Keyframe, make_keyframe
from arview.refinement.modalities.patch_alignment import (
    Pyramid,
    build_pyramid,
)
from arview.refinement.modalities.texture_matching import (
    MIN_TRUST,
    MatchSettings,
    align_pose,
    learn_trust,
    match_texture,
    nearest_pose,
)
from arview.refinement.projection import intrinsics_of
from arview.rendering import RayCaster

SEARCH_PX = 4
"""Largest common shift, px of the coarsest level; 0 leaves this search out."""
CHECK_OCCLUSION = True
"""Test by a ray from each point to the camera whether the part hides it."""
NEIGHBOUR_PX = 3.0
"""Largest deviation from the median displacement of the nearest neighbours."""
MAX_KEYFRAMES = 12
"""Keyframes kept; the least recently used is dropped beyond."""
REPLACE_DISTANCE = 0.3
"""A keyframe nearer than this to a new one, in the steps above, is replaced by it."""


class TextureMatches(NamedTuple):
    """Corners of a keyframe found in a frame.

    Attributes:
        points_in_body: (N,3) mm.
        pixels: (N,2) where each was found, distorted px.
        weights: (N,) 0–1, by the correlation of the patch; multiplied by 1/σ² in `add_matches`.
        tried: number of corners expected in view.
    """

    points_in_body: Array
    pixels: Array
    weights: Array
    tried: int


class TextureModality:
    """Texture of one part, matched from a bank of keyframes.

    Args:
        vertices_in_body: (V,3) mm, vertices of the part about its centre.
        faces: (F,3) triangles of the part.
        camera: intrinsics of the frames.
    """

    def __init__(
        self,
        vertices_in_body: Array,
        faces: NDArray[np.int32],
        camera: Camera,
    ) -> None:
        self.camera = camera
        self.keyframes: list[Keyframe] = []
        self._caster = RayCaster(vertices_in_body, faces)
        used = np.asarray(vertices_in_body)[np.unique(faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        self._damping = np.full(6, 1.0 / 0.3**2)
        self._damping[3:] /= float((high - low) @ (high - low))
        pick = np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64)
        self._box_corners = low + pick * (high - low)
        self._intrinsics = intrinsics_of(camera)
        self._clock = 0
        self._last: tuple[Keyframe, NDArray[np.intp], Array] | None = None

    def pyramid(self, gray: NDArray[np.uint8]) -> Pyramid:
        """Image pyramid of a grey picture (H,W) uint8 for `measure` and `add_keyframe`.

        Raises:
            InputError: a picture of another size than the camera's.
        """
        if gray.shape != (self.camera.height, self.camera.width):
            raise InputError(
                f"texture modality: image is {gray.shape[1]}×{gray.shape[0]}, "
                f"the camera {self.camera.width}×{self.camera.height}"
            )
        return build_pyramid(gray, LEVELS)

    def clear(self) -> None:
        """Forget all keyframes."""
        self.keyframes.clear()
        self._last = None

    def _nearest(self, cam_from_body: Array) -> tuple[Keyframe | None, float]:
        """Keyframe nearest in direction of view, roll and distance, and its distance in the steps of the options."""
        if not self.keyframes:
            return None, np.inf
        best, steps = nearest_pose(np.stack([keyframe.cam_from_body for keyframe in self.keyframes]), cam_from_body)
        return self.keyframes[best], steps

    def wants_keyframe(self, cam_from_body: Array, tracked_count: int) -> bool:
        """Whether a keyframe at a pose (4,4) would help.

        It would where the view is new, or partly new and few corners were found.
        """
        keyframe, distance = self._nearest(cam_from_body)
        if keyframe is None or distance > 1.0:
            return True
        return tracked_count < MIN_CORNERS and distance > REPLACE_DISTANCE

    def add_keyframe(self, gray: NDArray[np.uint8] | Pyramid, cam_from_body: Array) -> int:
        """Make a keyframe of a frame whose pose is reliable.

        Args:
            gray: (H,W) uint8, or its pyramid.
            cam_from_body: (4,4) pose of the part.

        Returns:
            Number of corners; 0 when they are too few and no keyframe was made.
        """
        pyramid = gray if isinstance(gray, tuple) else self.pyramid(gray)
        keyframe = make_keyframe(pyramid, cam_from_body, self._outline(cam_from_body), self._caster, self._intrinsics)
        if keyframe is None:
            return 0
        self._clock += 1
        keyframe.last_used = self._clock
        nearest, distance = self._nearest(cam_from_body)
        if nearest is not None and distance < REPLACE_DISTANCE:
            self.keyframes.remove(nearest)
        elif len(self.keyframes) >= MAX_KEYFRAMES:
            self.keyframes.remove(min(self.keyframes, key=lambda old: old.last_used))
        self.keyframes.append(keyframe)
        return len(keyframe.anchors.points)

    def _outline(self, cam_from_body: Array) -> Array:
        """Convex polygon (K,2) px around the part's box; the whole picture when the box reaches behind the camera."""
        pixels = self.camera.project(self._box_corners @ cam_from_body[:3, :3].T + cam_from_body[:3, 3])
        if not np.all(np.isfinite(pixels)):
            w, h = float(self.camera.width), float(self.camera.height)
            return np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
        return np.asarray(cv2.convexHull(pixels.astype(np.float32))[:, 0], dtype=np.float64)

    def measure(self, pyramid: Pyramid, cam_from_body: Array) -> TextureMatches:
        """Find the corners of the nearest keyframe in a frame.

        Args:
            pyramid: image pyramid of the frame, see `pyramid`.
            cam_from_body: (4,4) predicted pose, off by at most about 30 px in a picture of 640×480.
        """
        keyframe, _ = self._nearest(cam_from_body)
        if keyframe is None:
            self._last = None
            return TextureMatches(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), 0)
        self._clock += 1
        keyframe.last_used = self._clock
        settings = MatchSettings(
            search_px=SEARCH_PX,
            check_occlusion=CHECK_OCCLUSION,
            min_facing=MIN_FACING,
            min_trust=MIN_TRUST,
            min_ncc=MIN_NCC,
            neighbour_px=NEIGHBOUR_PX,
        )
        matches = match_texture(
            keyframe.pyramid,
            pyramid,
            keyframe.anchors,
            self._caster.hierarchy,
            cam_from_body,
            self._intrinsics,
            self._damping,
            settings,
        )
        found = np.flatnonzero(matches.weights > 0.0)
        self._last = (keyframe, found, matches.pixels[found])
        tried = int(np.count_nonzero(matches.expected))
        points = keyframe.anchors.points[found]
        return TextureMatches(points, matches.pixels[found], matches.weights[found], tried)

    def align(self, matches: TextureMatches, cam_from_body: Array) -> Array:
        """Pose (4,4) from the matches only, started at a pose and damped towards it."""
        aligned = align_pose(
            matches.points_in_body, cam_from_body, self._intrinsics, matches.pixels, matches.weights, self._damping, 1.0
        )
        return np.asarray(aligned)

    def update_trust(self, cam_from_body: Array) -> None:
        """Learn from the accepted pose (4,4) of a frame which corners of the last `measure` are reliable.

        A corner found away from where the pose places it (a reflection, a shadow, a hand in the keyframe) loses trust
        and is no longer used when little is left. One that was not found may be hidden and keeps its trust. A keyframe
        with too few trusted corners is dropped.
        """
        if self._last is None:
            return
        keyframe, found, pixels = self._last
        anchors = keyframe.anchors
        trusted = learn_trust(anchors.trust, anchors.points, found, pixels, cam_from_body, self._intrinsics)
        if trusted < MIN_CORNERS and keyframe in self.keyframes:
            self.keyframes.remove(keyframe)
        self._last = None
