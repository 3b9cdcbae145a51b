"""Options of the dense reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from arview.errors import InputError

SOURCES = 5
"""Photos with which each photo is compared. More cost time; fewer lose surfaces that are partly hidden."""
BEST_SOURCES = 3
"""The cost is the mean over this many best sources, since the others may not see the surface."""
MIN_VIEWS = 2
"""Photos that must agree on a point of the cloud, including its own. Each was matched with several."""


@dataclass(frozen=True)
class DenseOptions:
    """Options of the dense reconstruction.

    Attributes:
        max_region_px: photos are scaled so that the part's region has at most this many pixels, with which time and
            memory grow. 500,000 give pixels of 0.4 mm on a part of 300 mm.
        band_mm: largest displacement from the CAD that is found; the region is the CAD's silhouette widened by this.
        threads: photos worked on at a time; 0 for one per core.
        device: where PatchMatch runs: ``auto`` takes CUDA if torch and kornia find it; else ``cpu`` or a torch device.
        seed: of the random hypotheses; the same seed gives the same cloud.
    """

    max_region_px: int = 500_000
    band_mm: float = 5.0
    threads: int = 0
    device: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_region_px < 10_000:
            raise InputError(f"dense: max_region_px is {self.max_region_px}, expected at least 10000")
        if not self.band_mm > 0:
            raise InputError(f"dense: band_mm is {self.band_mm}, expected a positive number")
