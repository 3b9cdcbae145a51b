"""Options of guided capture."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.capture.information import InformationOptions
from arview.errors import InputError
from arview.reconstruction.coverage import CoverageOptions


@dataclass(frozen=True)
class TriggerOptions:
    """When a frame is still, sharp and certain enough for a photo. Lengths are shares of the picture's longer side.

    Each pair (enter, leave) is a hysteresis: what became steady, certain or near enough stays so until the second
    limit is passed.
    """

    motion_per_s: tuple[float, float] = (0.05, 0.08)  # of the part in the picture: 1 px of blur at 1600 px and 1/80 s
    gyro_rad_s: tuple[float, float] = (0.12, 0.2)  # a hand that holds still trembles with about 0.05 rad/s
    quality: tuple[float, float] = (0.5, 0.4)  # of the tracked pose; wrong ones mostly do not reach 0.5
    window_s: float = 0.12  # over which motion is measured: a tracker's noise is small beside it
    still_s: float = 0.15  # for which the camera must have been still
    max_gap_s: float = 0.8  # between two frames; after a longer gap the motion is unknown
    focus_px: int = 320  # side of the part of the picture in which sharpness is measured
    focus_memory_s: float = 2.0  # sharpness is compared with frames of this time
    min_focus: float = 0.6  # of the sharpness of recent frames
    max_blur_px: float = 2.5  # edge spread of a frame that is out of focus …
    max_blur_ratio: float = 1.6  # … unless no frame of this stream was much sharper
    min_inside: float = 0.8  # share of the part's bounding box that must be in the picture
    min_interval_s: float = 1.0  # between two photos: a phone takes about that long for one
    pending_s: float = 8.0  # after which a photo that was asked for and not reported counts as failed


@dataclass(frozen=True)
class CaptureOptions:
    """How many photos are wanted, from where, and what they must show."""

    wanted_photos: int = 20  # fewer where the range of views has no more directions, more where components lack some
    max_photos: int = 40  # after which nothing more is asked for
    components: tuple[str, ...] = ()  # only these must be seen well, as for a part that is checked again; empty: all
    cells_per_photo: float = 1.8  # directions of the dome per wanted photo
    cell_deg: tuple[float, float] = (8.0, 24.0)  # smallest and largest distance of neighbouring directions
    elevation_deg: tuple[float, float] = (15.0, 75.0)  # asked for where the part's range of views goes further
    apart_share: float = 0.6  # of the distance of two directions by which two photos differ at least
    max_step_deg: float = 40.0  # from the nearest photo: features of photos farther apart are not matched
    fill: tuple[float, float] = (1.06, 0.55)  # part's diameter over the picture's shorter side: nearest, farthest
    distance_slack: float = 0.06  # hysteresis of the distance
    gain_share: float = 0.5  # of the best direction's gain from which a photo is taken from another one …
    min_gain_share: float = 0.1  # … and the share accepted at the end of ``patience_s`` after the last photo
    patience_s: float = 6.0  # a person who does not go where it is best still gets photos
    u_share: float = 0.25  # of the tolerance: a predicted U below it is enough
    reach_share: float = 2.0  # of the U that photos from all directions would give: below it is enough, too
    photo_px_per_px: float = 1.0  # pixels of a photo per pixel of the stream, along a side
    trigger: TriggerOptions = field(default_factory=TriggerOptions)
    information: InformationOptions = field(default_factory=InformationOptions)
    coverage: CoverageOptions = field(default_factory=CoverageOptions)

    def __post_init__(self) -> None:
        """Check the numbers of photos.

        Raises:
            InputError: they contradict each other.
        """
        if not 3 <= self.wanted_photos <= self.max_photos <= 500:
            raise InputError(
                f"photos: {self.wanted_photos} wanted, at most {self.max_photos}: expected 3 or more, and no more than "
                "the largest number, which is at most 500"
            )
        if not 0.05 <= self.photo_px_per_px <= 50.0:
            raise InputError(f"photo_px_per_px: {self.photo_px_per_px}, expected 0.05 to 50")
