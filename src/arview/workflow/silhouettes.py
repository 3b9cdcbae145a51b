"""Masks of photos from the CAD: the part's silhouette, with a margin for everything that may be out of its place.

The margin covers what the measurement searches: a component that is displaced by less than the search range, or that
lies beside its place, is inside the mask. The measurement of components in the photos does not use masks at all.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from arview import guideviews, reconstruction
from arview.cad import Model, Part
from arview.camera import Camera
from arview.core.progress import Progress
from arview.core.stage_cache import key_of
from arview.detection import Detector
from arview.errors import OutputError
from arview.geometry import Array, apply
from arview.rendering import rasterise
from arview.version import __version__

MARGIN_MM = 10.0
"""Margin around the silhouette: twice the search range of the measurement and of the dense cloud."""
PLACING_MARGIN_MM = 0.0
"""Margin where photos are placed by the part alone: any background misleads them."""
MAX_SIDE_PX = 1000
"""Longer side of the masks; they are scaled to their photos."""
MAX_STRETCH = 3.0
"""Largest field of the undistorted view, relative to the photo."""
ROUGH = reconstruction.CadOptions(max_views=6, rival_views=4, max_side_px=800)
"""Rough placing is enough, because the margin covers its error."""


@dataclass(frozen=True)
class SilhouetteOptions:
    """How exact the masks are."""

    edge_px: float = 2.0  # added to ``MARGIN_MM`` for the reduced size of the masks


@dataclass(frozen=True)
class CadSilhouettes:
    """Masks of photos of one part, see `arview.reconstruction.part_masks.Silhouettes`."""

    part: Part
    options: SilhouetteOptions = field(default_factory=SilhouetteOptions)

    def key(self) -> str:
        """A hash of the part, the options and the version."""
        return key_of("auto", self.part.model.source_hash, self.part.effective_view_range, self.options, __version__)

    def at_poses(self, sparse: reconstruction.SparseModel, folder: Path, tell: Progress) -> reconstruction.PartMasks:
        """Masks of the placed photos in which the part is; none if it is not found, or contradicts the poses."""
        found = reconstruction.find_scale(sparse, self.part, options=ROUGH, progress=tell)
        if found.scale is None or found.model_from_scan is None:
            return reconstruction.PartMasks(f"the CAD was not found at the poses of the photos ({found.why_no_frame})")
        metric = sparse.transformed(found.scale, found.model_from_scan)
        poses = {photo.name: (photo.camera, photo.cam_from_scan) for photo in metric.photos}
        return self._written(poses, folder, MARGIN_MM)

    def in_photos(
        self, photos: Sequence[reconstruction.Photo], folder: Path, tell: Progress
    ) -> reconstruction.PartMasks:
        """Masks of the photos in which the part is found, each by itself."""
        poses: dict[str, tuple[Camera, Array]] = {}
        for view_range in reconstruction.search_ranges(
            self.part, [photo.camera for photo in photos], reconstruction.SPANS
        ):
            views = guideviews.cached_guide_views(
                self.part.model,
                view_range,
                guideviews.GuideViewOptions(subdivisions=reconstruction.SUBDIVISIONS),
                progress=lambda done, total: tell("guide views", done, total),
            )
            detectors: dict[str, Detector] = {}
            for done, photo in enumerate(photos):
                tell("finding the part", done, len(photos))
                if photo.name in poses:
                    continue
                camera, image = reconstruction.shrunk(
                    photo.camera, reconstruction.read_photo(photo.path), reconstruction.DETECT_WIDTH_PX
                )
                key = key_of(camera)
                if key not in detectors:
                    detectors[key] = Detector(views, camera)
                found = detectors[key].detect(image, max_results=1)
                if found:
                    poses[photo.name] = (photo.camera, found[0].cam_from_model)
            if 2 * len(poses) >= len(photos):
                break
        return self._written(poses, folder, PLACING_MARGIN_MM)

    def _written(
        self, poses: dict[str, tuple[Camera, Array]], folder: Path, margin_mm: float
    ) -> reconstruction.PartMasks:
        """The masks at poses ``cam_from_model``, as files; photos in which nothing of the part is seen have none."""
        options = self.options if margin_mm > 0.0 else replace(self.options, edge_px=0.0)
        masks: dict[str, Path] = {}
        shares: list[float] = []
        try:
            shutil.rmtree(folder, ignore_errors=True)
            for name, (camera, pose) in poses.items():
                mask = silhouette_mask(self.part.model, pose, camera, margin_mm, options)
                if not mask.any():
                    continue
                path = folder / f"{name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes())
                masks[name] = path
                shares.append(float(mask.mean()))
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written to ({error.strerror or error})") from error
        if not masks:
            return reconstruction.PartMasks("the part was found in none of the photos")
        area = f"{100 * float(np.median(shares)):.0f} % of their area"
        margin = f" or within {margin_mm:.0f} mm of it" if margin_mm > 0.0 else ""
        return reconstruction.PartMasks(f"{len(masks)} photos, where the part is{margin} ({area})", masks)


def silhouette_mask(
    model: Model, cam_from_model: Array, camera: Camera, margin_mm: float, options: SilhouetteOptions | None = None
) -> NDArray[np.bool_]:
    """(h,w) where the part is in a photo, and everything within a margin of it, in the photo's own distortion.

    Args:
        model: the CAD.
        cam_from_model: (4,4) pose, mm.
        camera: of the photo, with its distortion.
        margin_mm: at the depth of the nearest surface, so that it is at least as wide everywhere.
        options: see `SilhouetteOptions`.
    """
    options = options or SilhouetteOptions()
    scale = min(1.0, MAX_SIDE_PX / max(camera.width, camera.height))
    small = camera.scaled(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    columns, rows = np.meshgrid(np.arange(small.width), np.arange(small.height))
    rays = small.unproject(np.stack([columns, rows], axis=-1).astype(np.float64))[..., :2]
    reach = MAX_STRETCH * np.array([small.width, small.height]) / (2.0 * np.array([small.fx, small.fy]))
    in_field = np.asarray(np.isfinite(rays).all(axis=-1) & (np.abs(rays) <= reach).all(axis=-1))
    ideal = np.where(in_field[..., None], rays, 0.0) * (small.fx, small.fy)
    low, high = np.floor(ideal.min(axis=(0, 1))) - 1.0, np.ceil(ideal.max(axis=(0, 1))) + 1.0
    # What is outside of the photo by less than the margin has its margin inside.
    vertices = apply(cam_from_model, model.mesh[0])
    nearest_mm = float(np.clip(vertices[:, 2].min(), 0.05 * model.diameter_mm, None))
    reach_px = margin_mm * small.fx / nearest_mm + options.edge_px
    pad = int(np.ceil(min(reach_px, 0.5 * max(small.width, small.height))))
    low, (width, height) = low - pad, (high - low + 1 + 2 * pad).astype(int)
    inverse_depth, _ = rasterise(
        vertices, model.mesh[1], small.fx, fy=small.fy, cx=-low[0], cy=-low[1], width=int(width), height=int(height)
    )
    if not (inverse_depth > 0).any():
        return np.zeros(columns.shape, dtype=np.bool_)
    distance = cv2.distanceTransform((inverse_depth <= 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    column, row = np.rint(ideal - low).astype(int).transpose(2, 0, 1)
    return np.asarray((distance[row, column] <= reach_px) & in_field)
