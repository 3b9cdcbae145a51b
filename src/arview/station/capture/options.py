"""Options of guided capture."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.errors import InputError


@dataclass(frozen=True)
class TriggerOptions:
    """When a frame is still, sharp and certain enough for a photo. Lengths are shares of the picture's longer side.

    Each pair (enter, leave) is a hysteresis: what became steady, certain or near enough stays so until the second
    limit is passed.
    """

    motion_per_s: tuple[float, float] = (0.05, 0.08)  # of the part in the picture: 1 px of blur at 1600 px and 1/80 s
    still_s: float = 0.15  # for which the camera must have been still
    min_focus: float = 0.6  # of the sharpness of recent frames
    min_interval_s: float = 1.0  # between two photos: a phone takes about that long for one


MAX_STEP_DEG = 40.0
"""From the nearest photo: features of photos farther apart are not matched."""


@dataclass(frozen=True)
class CaptureOptions:
    """How many photos are wanted, from where, and what they must show."""

    wanted_photos: int = 20  # fewer where the range of views has no more directions, more where components lack some
    max_photos: int = 40  # after which nothing more is asked for
    components: tuple[str, ...] = ()  # only these must be seen well, as for a part that is checked again; empty: all
    photo_px_per_px: float = 1.0  # pixels of a photo per pixel of the stream, along a side
    trigger: TriggerOptions = field(default_factory=TriggerOptions)

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
