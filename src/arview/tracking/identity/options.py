"""Options of the monitoring of the identity."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.fiducials.serial_code import SerialCodeOptions


@dataclass(frozen=True)
class BackgroundMotionOptions:
    """Options of the motion of the background.

    Attributes:
        max_side_px: longer side of the reduced pictures in which the background is followed.
        max_corners: corners followed from one frame to the next.
        min_corner_quality: quality of a corner relative to the best one.
        corner_spacing_px: least distance between two corners of a reduced picture.
        window_px: side of the window around a corner that is followed.
        max_return_px: distance within which a corner must return when it is followed back.
        max_residual_px: distance from the homography within which a corner or match counts as an inlier.
        min_inliers, min_inlier_share: of the corners that were followed, for a link from frame to frame.
        max_features: features matched between two pictures where no chain of frames links them.
        min_match_inliers, min_match_inlier_share: of these matches.
        max_match_ratio: distance of the best match of a feature relative to that of the second best.
        max_scale: change of scale, in either direction, beyond which a homography is not believed.
    """

    max_side_px: int = 480
    max_corners: int = 160
    min_corner_quality: float = 0.01
    corner_spacing_px: int = 8
    window_px: int = 15
    max_return_px: float = 0.7
    max_residual_px: float = 2.0
    min_inliers: int = 15
    min_inlier_share: float = 0.5
    max_features: int = 600
    min_match_inliers: int = 25
    min_match_inlier_share: float = 0.4
    max_match_ratio: float = 0.8
    max_scale: float = 3.0


@dataclass(frozen=True)
class OwnMotionOptions:
    """When a part has gone on its own way while it was not seen.

    Attributes:
        frames: frames before the gap over which the motion is taken.
        max_break: frames from one sure pose to the next up to which the motion between them is taken.
        wrong_frames: the last of them whose poses may have been wrong.
        max_gap: frames without a sure pose up to which it is continued.
        near: shift in diameters from the expected place, across the line of sight, up to which the part is there.
        near_depth: the same along the line of sight.
        reach: shift in diameters from the last place beyond which another specimen may stand.
        max_turn_deg: rotation since the last pose up to which it is the same part.
    """

    frames: int = 7
    max_break: int = 3
    wrong_frames: int = 2
    max_gap: int = 15
    near: float = 0.2
    near_depth: float = 0.6
    reach: float = 0.6
    max_turn_deg: float = 45.0


@dataclass(frozen=True)
class IdentityOptions:
    """Options of the monitoring of the identity.

    Attributes:
        is_used: look after the identity at all; without it every pose is ``followed``.
        quality_rate: share by which the usual quality of the followed specimen follows each frame, from 0.
        sure_quality: usual quality from which its pose is certainly right; below, the detector is asked.
        found_quality: quality of a pose found near a given one from which a specimen is there.
        turn_deg: angle by which a given pose is turned, where the camera may have gone round the part.
        min_quality: quality from which a pose counts as tracked.
        max_jump: shift between two frames, in diameters of the part in the picture, from which a pose is compared with
            the place at which the background says that the part was.
        same_place: shift from that place, in diameters of the part in the picture, up to which a pose is the same part,
            because two specimens do not stand in one place.
        same_depth, same_depth_share: the same along the line of sight, in diameters, and as a share of the distance;
            the larger limit counts.
        max_unknown_frames: frames without a sure pose up to which a pose near the last one is the same part although
            the motion of the background is not known.
        apart: shift in diameters from which a second detection is another specimen.
        max_specimens: specimens looked for in one picture.
        pixel_turns_deg, pixel_distances: rotations about the vertical axis of the picture, and distances relative to
            that of the tracked part, that are tried first for a part at a named pixel.
        pixel_margin: distance from the outline, in diameters, at which a named pixel still lies on a part.
        watch_s: time for which the old place is watched before a part that was found elsewhere has its labels back.
        watch_every_s: time between two checks of the old place.
        min_room: share of the part's box that must lie in the picture for its place to count as seen.
        return_every_s: time between two checks whether the followed part is seen at its old place again.
        return_s: time after the doubt arose for which the old place is followed.
        background: of the motion of the background.
        own_motion: of the part's own motion.
        code: of the reading of serial codes.
    """

    is_used: bool = True
    quality_rate: float = 0.1
    sure_quality: float = 0.6
    found_quality: float = 0.7
    turn_deg: float = 25.0
    min_quality: float = 0.5
    max_jump: float = 0.35
    same_place: float = 0.35
    same_depth: float = 0.6
    same_depth_share: float = 0.12
    max_unknown_frames: int = 5
    apart: float = 0.5
    max_specimens: int = 3
    pixel_turns_deg: tuple[float, ...] = (0.0, 25.0, -25.0, 50.0, -50.0)
    pixel_distances: tuple[float, ...] = (1.0, 0.8, 1.25, 0.64, 1.56)
    pixel_margin: float = 0.03
    watch_s: float = 0.75
    watch_every_s: float = 0.25
    min_room: float = 0.7
    return_every_s: float = 0.35
    return_s: float = 10.0
    background: BackgroundMotionOptions = field(default_factory=BackgroundMotionOptions)
    own_motion: OwnMotionOptions = field(default_factory=OwnMotionOptions)
    code: SerialCodeOptions = field(default_factory=SerialCodeOptions)
