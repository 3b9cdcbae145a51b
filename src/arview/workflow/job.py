"""What is to be inspected: the inputs of one part, as plain values that a file and another process can hold."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InspectJob:
    """One inspection. Paths are texts, so that it can be written to a file; None where a field is not given.

    Attributes:
        part: part file or CAD file.
        photos: folder or glob; None takes the sharp frames of ``video``.
        video: is annotated with what was measured; None makes no film.
        serial: of the specimen; None leaves that of the part file.
        camera: calibrated camera of the photos, or ``fov:DEG``; of the video where that has its photos.
        video_camera: camera of the video; None: that of the photos where the shape of the picture is the same, else
            a guess.
        scale_file: boards, tags, scale bars and rig in view (TOML).
        unit: of the CAD, where the file does not say.
    """

    part: str
    photos: str | None = None
    video: str | None = None
    serial: str | None = None
    camera: str | None = None
    video_camera: str | None = None
    scale_file: str | None = None
    unit: str | None = None
    tolerance_mm: float | None = None  # of components for which the part file has none
    guard: float = 1.0  # share of U kept from the tolerance; 1: ISO 14253-1
    max_frames: int = 60  # of a video, taken as photos
    seed: int = 0  # the same seed gives the same result
    threads: int = 0  # 0: all cores
    device: str = "auto"  # of dense matching
    makes_pdf: bool = True

    @property
    def photo_source(self) -> str:
        """Where the photos come from: the folder, or the video."""
        return self.photos or self.video or ""

    @property
    def is_from_video(self) -> bool:
        """True when the photos are frames of the video."""
        return not self.photos
