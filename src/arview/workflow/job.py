"""Inspection jobs: the inputs of one part as plain values, which can be written to a file or sent to a process."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InspectJob:
    """One inspection. Paths are texts, so that a job can be written to a file; None where a field is not given.

    Attributes:
        part: part file or CAD file.
        photos: folder or glob of the photos; None: the sharp frames of ``video``.
        video: video that is annotated with the measured deviations; None: no film.
        serial: serial number of the part; None: that of the part file.
        camera: calibrated camera of the photos, or ``fov:DEG``; of the video when the photos are its frames.
        video_camera: camera of the video; None: that of the photos if the aspect ratio is the same, else a guess.
        scale_file: TOML or JSON file with the boards, tags, tag layouts, scale bars and camera rig.
        unit: length unit of the CAD file if it does not specify one.
    """

    part: str
    photos: str | None = None
    video: str | None = None
    serial: str | None = None
    camera: str | None = None
    video_camera: str | None = None
    scale_file: str | None = None
    unit: str | None = None
    masks: str | None = None  # folder of masks, black where a photo is not to be used; auto: the CAD's silhouettes
    sparse: str | None = None  # camera poses made elsewhere: COLMAP model, Metashape XML or transforms.json
    tolerance_mm: float | None = None  # tolerance of components without one in the part file
    guard: float = 1.0  # fraction of U by which the tolerance is reduced; 1: ISO 14253-1
    max_frames: int = 60  # frames of a video that are used as photos
    seed: int = 0  # the same seed gives the same result
    threads: int = 0  # threads of the reconstruction; 0: all cores
    device: str = "auto"  # device of features, matching and the dense cloud
    makes_pdf: bool = True
    makes_cloud: bool = True  # make a dense cloud and measure in it, too, after the verdict by the photos
    compares_halves: bool = True  # measure two halves of the photos apart and compare them
    pairs: str | None = None  # the sparse/pairs.json of another run, whose pairs of photos are matched

    @property
    def photo_source(self) -> str:
        """The source of the photos: their folder, or the video."""
        return self.photos or self.video or ""

    @property
    def is_from_video(self) -> bool:
        """Whether the photos are frames of the video."""
        return not self.photos
