"""Options of the dense reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from arview.errors import InputError


@dataclass(frozen=True)
class DenseOptions:
    """Options of the dense reconstruction.

    Attributes:
        max_region_px: photos are scaled so that the part's region has at most this many pixels, with which time and
            memory grow. 500,000 give pixels of 0.4 mm on a part of 300 mm.
        sources: photos with which each photo is compared. More cost time; fewer lose surfaces that are partly hidden.
        best_sources: the cost is the mean over this many best sources, since the others may not see the surface.
        good_angle_deg: angles between two views of a point that count fully. Smaller angles do not determine depth, and
            at larger ones the surface looks different.
        max_angle_deg: views at a larger angle are no sources.
        band_mm: largest displacement from the CAD that is found; the region is the CAD's silhouette widened by this.
        cad_hypotheses: also start from the surface of the CAD. It is only a hypothesis: photo-consistency decides.
        noise: standard deviation of the photos' noise in grey levels; less contrast does not count as texture.
        geometric_weight: cost of one pixel of disagreement with the depth map of a source.
        min_zncc: pixels with a lower mean correlation with the sources are not used.
        max_sigma_px: pixels with a larger standard deviation, in pixels of parallax, are not used: no texture.
        max_spread_px: largest standard deviation of a merged point along its normal, in pixels of the maps at the
            point.
        min_views: photos that must agree on a point of the cloud, including its own. Each was matched with several.
        agreement_px: two depth maps agree if the point moves by less than this in the photo, in pixels of the maps
            (half the working size) …
        normal_angle_deg: … and their normals differ by less than this.
        grazing_deg: surfaces seen at a larger angle from their normal are not used.
        threads: photos worked on at a time; 0 for one per core.
        device: where PatchMatch runs: ``auto`` takes CUDA if torch and kornia find it; else ``cpu`` or a torch device.
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
