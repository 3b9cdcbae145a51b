"""Options of the dense reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from arview.errors import InputError


@dataclass(frozen=True)
class DenseOptions:
    """Options of the dense reconstruction.

    Attributes:
        max_region_px: photos are scaled so that the part's region has no more pixels than this. Work and memory
            grow with it; 500,000 are 0.4 mm pixels on a part of 300 mm, 4 CPU-s a photo.
        sources: photos that each photo is compared with. More cost time, fewer lose surfaces that are hidden.
        best_sources: of these, the mean of the best is the cost: the others may not see the surface.
        good_angle_deg: range of angles between two views at a point that count fully. Smaller ones do not
            measure depth, larger ones do not look alike.
        max_angle_deg: a view farther round than this is no source.
        band_mm: displacements looked for around a CAD model; the region is its silhouette widened by this.
        cad_hypotheses: start from the CAD's surface too. It never decides: only photo-consistency does.
        noise: standard deviation of the photos' noise in grey values; contrast below it is no texture.
        geometric_weight: cost of one pixel of disagreement with the depth map of a source.
        min_zncc: mean correlation with the sources below which a pixel is not used.
        max_sigma_px: standard deviation in pixels of parallax above which a pixel is not used: no texture.
        max_spread_px: standard deviation of a merged point along its normal, in pixels of the maps as wide as
            they are there, above which it is dropped.
        min_views: photos that must agree on a point of the cloud, its own included. Each was matched with several.
        agreement_px: depth maps agree when the point moves by less than this in the photo, in pixels of the maps
            (half the working size).
        normal_angle_deg: and when their normals differ by less than this.
        grazing_deg: surfaces seen at a larger angle from their normal are not used.
        threads: photos worked on at a time; 0 for one per core.
        device: where the search is done: ``auto`` takes CUDA where torch sees it, ``cpu``, or a torch device.
        seed: of the random hypotheses; the same seed gives the same cloud.
    """

    max_region_px: int = 500_000
    sources: int = 5
    best_sources: int = 3
    good_angle_deg: tuple[float, float] = (8.0, 25.0)
    max_angle_deg: float = 50.0
    band_mm: float = 5.0
    cad_hypotheses: bool = True
    noise: float = 1.5
    geometric_weight: float = 0.1
    min_zncc: float = 0.5
    max_sigma_px: float = 0.25
    max_spread_px: float = 0.2
    min_views: int = 2
    agreement_px: float = 1.5
    normal_angle_deg: float = 20.0
    grazing_deg: float = 75.0
    threads: int = 0
    device: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_region_px < 10_000:
            raise InputError(f"dense: max_region_px is {self.max_region_px}, expected at least 10000")
        if not 1 <= self.best_sources <= self.sources <= 16:
            raise InputError(
                f"dense: best_sources {self.best_sources} of sources {self.sources}, expected 1 to 16 in this order"
            )
        if not self.min_views >= 2:
            raise InputError(f"dense: min_views is {self.min_views}, expected at least 2")
        for name in ("band_mm", "noise", "agreement_px", "max_sigma_px", "max_spread_px"):
            if not getattr(self, name) > 0:
                raise InputError(f"dense: {name} is {getattr(self, name)}, expected a positive number")
        for name in ("normal_angle_deg", "grazing_deg"):
            if not 0.0 < getattr(self, name) < 90.0:
                raise InputError(f"dense: {name} is {getattr(self, name)}, expected between 0 and 90")
