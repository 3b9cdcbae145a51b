"""Pictures of a report: crops of photos with the overlay of a component and its displacement, and an overview."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview import overlay, reconstruction
from arview.cad import Model
from arview.camera import Camera
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.geometry import Array, apply, look_at
from arview.inspection import CharacteristicResult, ComponentDeviation, ForeignReport, Inspection, Verdict
from arview.overlay import paint
from arview.pose import Pose, TrackingState
from arview.rendering import ZBufferRenderer

RgbImage = NDArray[np.uint8]
"""(H,W,3) RGB picture."""
_ROUND_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_FOREIGN_RGB = (255, 214, 10)
_BACKGROUND = (52, 58, 68)


WIDTH_PX = 720
"""Size of a crop, sharp on a page with two of them side by side."""
HEIGHT_PX = 540
SHARE = 0.55
"""Share of the crop that the component fills; the rest shows its surroundings."""
MIN_PX = 160
"""Smallest width of the region of the photo; smaller ones would be blurred."""
ARROW_SHARE = 0.3
"""Largest length of the arrow as a share of the width of the crop."""
APART_DEG = 40.0
"""Smallest angle between the lines of sight of two crops."""
SURROUNDINGS_MM, MARK_PX = 50.0, 60.0
"""Size of what is shown about the place of a characteristic, and radius of the ring that marks it."""
MAX_PX = 400
"""Longer side of the renderings that determine the visibility."""


@dataclass(frozen=True)
class Crop:
    """A region of a photo with the overlay.

    Attributes:
        image: (H,W,3) uint8 RGB.
        photo: name of the photo.
        arrow_scale: exaggeration of the displacement arrow; None without an arrow.
    """

    image: RgbImage
    photo: str
    arrow_scale: float | None


@dataclass(frozen=True)
class Gallery:
    """The crops of a report.

    Attributes:
        components: crops by the name of the component.
        foreign: crops of each foreign object.
        characteristics: crop of each characteristic that fails, by its name.
        unread: reasons why photos could not be read.
    """

    components: dict[str, tuple[Crop, ...]]
    foreign: tuple[tuple[Crop, ...], ...]
    unread: tuple[str, ...]
    characteristics: dict[str, Crop] = field(default_factory=dict)


Shown = str | int | CharacteristicResult
"""What a crop shows: the component of a name, the foreign object of an index, or a characteristic."""


def make_gallery(
    inspection: Inspection,
    model: Model,
    sparse: reconstruction.SparseModel,
    progress: StepProgress | None = None,
) -> Gallery:
    """Crops from the photos that show each object best: one for components that passed, else two.

    Args:
        inspection: the inspection, in the frame of ``sparse``.
        model: the CAD model.
        sparse: photos and their poses, mm.
        progress: called with (photos done, number of photos).
    """
    report_progress = progress or (lambda done, total: None)
    ranking = _PhotoRanking(model, sparse.photos)
    wanted: list[tuple[Shown, list[int]]] = [
        (one.name, ranking.best_of(one, 1 if one.verdict is Verdict.PASS else 2)) for one in inspection.components
    ]
    wanted += [(index, ranking.best_of_box(one)) for index, one in enumerate(inspection.foreign_objects)]
    failed = [one for one in inspection.characteristics if one.verdict is Verdict.FAIL and one.point_mm]
    wanted += [(one, ranking.best_of_box(_surroundings(one))[:1]) for one in failed]
    by_photo: dict[int, list[Shown]] = {}
    for key, photos in wanted:
        for index in photos:
            by_photo.setdefault(index, []).append(key)
    crops: dict[tuple[Shown, int], Crop] = {}
    unread: list[str] = []
    for done, (index, keys) in enumerate(by_photo.items()):
        report_progress(done, len(by_photo))
        photo = sparse.photos[index]
        try:
            image = reconstruction.read_photo(photo.path)
        except InputError as error:
            unread.append(str(error))
            continue
        if image.shape[:2] != (photo.camera.height, photo.camera.width):
            unread.append(f"{photo.path}: is {image.shape[1]}×{image.shape[0]}, not the size of the measured photo")
            continue
        for key in keys:
            if isinstance(key, str):
                deviation = inspection.find(key)
                assert deviation is not None
                crops[key, index] = _component_crop(deviation, inspection, model, photo, image)
            elif isinstance(key, CharacteristicResult):
                crops[key, index] = _point_crop(key, photo, image)
            else:
                crops[key, index] = _foreign_crop(inspection.foreign_objects[key], photo, image)
    report_progress(len(by_photo), len(by_photo))
    found = {key: tuple(crops[key, photo] for photo in photos if (key, photo) in crops) for key, photos in wanted}
    return Gallery(
        {key: value for key, value in found.items() if isinstance(key, str)},
        tuple(found[index] for index in range(len(inspection.foreign_objects))),
        tuple(unread),
        {one.name: found[one][0] for one in failed if found[one]},
    )


def overview(
    inspection: Inspection, model: Model, sparse: reconstruction.SparseModel | None = None, width: int = 1440
) -> RgbImage:
    """The whole part with the overlay in the colours of the verdicts, arrows and labels, (H,W,3) uint8 RGB.

    The overlay is drawn over the photo that shows the part best, or, without a readable photo, on a plain background
    from the upper right.
    """
    options = overlay.OverlayOptions(show_status=False, show_evidence=False, show_occlusion=False, max_labels=10)
    for photo in _whole_views(model, sparse.photos if sparse is not None else ()):
        try:
            image = reconstruction.read_photo(photo.path)
        except InputError:
            continue
        if image.shape[:2] == (photo.camera.height, photo.camera.width):
            height = round(width * photo.camera.height / photo.camera.width)
            image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
            camera, pose = photo.camera.scaled(width, height), photo.cam_from_scan
            break
    else:
        height, focal = round(0.62 * width), 1.5 * width
        camera = Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
        image = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
        pose = _whole_pose(model, camera)
    renderer = overlay.OverlayRenderer(model, camera, inspection, options)
    return renderer.draw(image, Pose(pose, None, 1.0, TrackingState.TRACKED, 0.0, 0))


def _whole_views(model: Model, photos: Sequence[reconstruction.PosedPhoto]) -> list[reconstruction.PosedPhoto]:
    """Photos that contain the whole part, those in which it is largest first."""
    corners = _corners(model.bounds_in_model)
    views = []
    for photo in photos:
        pixels = photo.camera.project(apply(photo.cam_from_scan, corners))
        size = np.array([photo.camera.width, photo.camera.height])
        if np.isfinite(pixels).all() and (pixels >= 0).all() and (pixels < size).all():
            share = float(np.max(np.ptp(pixels, axis=0) / size))
            views.append((min(share, 0.8), photo))  # larger parts leave no room for labels
    return [photo for _, photo in sorted(views, key=lambda view: -view[0])]


def _whole_pose(model: Model, camera: Camera) -> Array:
    """A pose in which the bounding box of the model fills the picture except for margins for labels."""
    direction = np.array([0.45, -0.75, 0.75]) / np.linalg.norm([0.45, -0.75, 0.75])
    corners, distance = _corners(model.bounds_in_model), 3.0 * model.diameter_mm
    for _ in range(4):
        pose = look_at(model.center_in_model + distance * direction, model.center_in_model, [0.0, 0.0, 1.0])
        spread = np.ptp(camera.project(apply(pose, corners)), axis=0) / [0.62 * camera.width, 0.86 * camera.height]
        distance *= float(spread.max())
    return pose


class _PhotoRanking:
    """How many pixels of what each photo shows."""

    def __init__(self, model: Model, photos: Sequence[reconstruction.PosedPhoto]) -> None:
        self.model, self.photos = model, photos
        self.centres = np.array([photo.centre_in_scan for photo in photos]).reshape(-1, 3)
        self.pixels = np.zeros((len(photos), len(model.components)))
        self._depths: list[tuple[Camera, NDArray[np.float32]]] = []
        for row, photo in enumerate(photos):
            scale = min(1.0, MAX_PX / max(photo.camera.width, photo.camera.height))
            small = photo.camera.scaled(round(photo.camera.width * scale), round(photo.camera.height * scale))
            drawn = ZBufferRenderer(model, small).render(photo.cam_from_scan)
            ids = drawn.component_ids
            self.pixels[row] = np.bincount(ids[ids >= 0], minlength=len(model.components)) / scale**2
            self._depths.append((small.without_distortion(), drawn.depth_mm))

    def best_of(self, deviation: ComponentDeviation, count: int) -> list[int]:
        """Photos, from different directions, that show a component large and its displacement from the side."""
        bounds = self.model.component(deviation.name).bounds_in_model
        score = self.pixels[:, self.model.index(deviation.name)] * self._inside(_corners(bounds))
        rays = self._rays(bounds.mean(axis=0))
        displacement = overlay.arrow_in_model(deviation)
        if displacement is not None:
            along = rays @ (np.array(displacement) / np.linalg.norm(displacement))
            score = score * np.sqrt(np.maximum(1.0 - along**2, 0.0))
        return self._select_apart(score, rays, count)

    def best_of_box(self, one: ForeignReport) -> list[int]:
        """Photos in which the centre of a foreign object is not occluded by the CAD model, the nearest first."""
        center, size = np.array(one.center_mm), np.array(one.size_mm)
        rays = self._rays(center)
        score = self._inside(center + 0.5 * size * _UNIT_CORNERS) / np.linalg.norm(self.centres - center, axis=1)
        for index, (camera, depth) in enumerate(self._depths):
            in_cam = apply(self.photos[index].cam_from_scan, center[None])[0]
            u, v = np.nan_to_num(camera.project(in_cam), nan=-1.0)
            if 0 <= u < camera.width and 0 <= v < camera.height:
                surface = depth[int(v), int(u)]
                if surface > 0 and surface < in_cam[2] - max(0.6 * float(np.linalg.norm(size)), 1.0):
                    score[index] = 0.0
        return self._select_apart(score, rays, 2)

    def _rays(self, point: Array) -> Array:
        rays = self.centres - point
        return np.asarray(rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9))

    def _inside(self, corners: Array) -> Array:
        """(M,) weights: 1 for photos that contain all corners (8,3), 0.05 for others."""
        result = np.zeros(len(self.photos))
        for index, photo in enumerate(self.photos):
            pixels = photo.camera.project(apply(photo.cam_from_scan, corners))
            limit = [photo.camera.width - 1, photo.camera.height - 1]
            holds = bool(np.isfinite(pixels).all() and (pixels >= 0).all() and (pixels <= limit).all())
            result[index] = 1.0 if holds else 0.05
        return result

    def _select_apart(self, score: Array, rays: Array, count: int) -> list[int]:
        chosen: list[int] = []
        score = score.copy()
        while len(chosen) < count and score.max(initial=0.0) > 0.0:
            chosen.append(int(np.argmax(score)))
            score[rays @ rays[chosen[-1]] > np.cos(np.deg2rad(APART_DEG))] = 0.0
        return chosen


_UNIT_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_BOX_EDGES = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]


def _corners(bounds: Array) -> Array:
    """The eight corners, (8,3), of a box given by its bounds, (2,3)."""
    return np.asarray(bounds.mean(axis=0) + 0.5 * (bounds[1] - bounds[0]) * _UNIT_CORNERS)


def _component_crop(
    deviation: ComponentDeviation,
    inspection: Inspection,
    model: Model,
    photo: reconstruction.PosedPhoto,
    image: RgbImage,
) -> Crop:
    """A crop with the overlay of a component at its design position and an arrow to its measured position."""
    bounds = model.component(deviation.name).bounds_in_model
    crop, camera = _cut(image, photo, _corners(bounds))
    scale: float | None = None
    displacement = overlay.arrow_in_model(deviation)
    if displacement is not None and deviation.verdict is not Verdict.PASS:
        depth = float(apply(photo.cam_from_scan, bounds.mean(axis=0)[None])[0, 2])
        longest_mm = ARROW_SHARE * camera.width * depth / camera.fx
        length_mm = float(np.linalg.norm(displacement))
        scale = float(max((s for s in _ROUND_SCALES if s * length_mm <= longest_mm), default=1))
    alone = replace(inspection, components=(deviation,), foreign_objects=())
    drawn = overlay.OverlayOptions(
        opacity=0.3,
        show_labels=False,
        show_status=False,
        show_evidence=False,
        show_occlusion=False,
        arrow_scale=scale or 1.0,
    )
    pose = Pose(photo.cam_from_scan, None, 1.0, TrackingState.TRACKED, 0.0, 0)
    picture = overlay.OverlayRenderer(model, camera, alone, drawn).draw(crop, pose)
    return Crop(picture, photo.name, scale)


def _surroundings(one: CharacteristicResult) -> ForeignReport:
    """A box about the place of a characteristic, large enough to see what it is on."""
    x, y, z = one.point_mm
    return ForeignReport((x, y, z), (SURROUNDINGS_MM,) * 3, 0.0, "", 0.0, "")


def _point_crop(one: CharacteristicResult, photo: reconstruction.PosedPhoto, image: RgbImage) -> Crop:
    """A crop about the place of a characteristic, which a ring marks."""
    crop, camera = _cut(image, photo, np.array(one.point_mm) + 0.5 * SURROUNDINGS_MM * _UNIT_CORNERS)
    middle = camera.project(apply(photo.cam_from_scan, np.array(one.point_mm)))
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    ring = middle + MARK_PX * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    paint.line(crop, ring, overlay.VERDICT_RGB[one.verdict], 2)
    return Crop(crop, photo.name, None)


def _foreign_crop(one: ForeignReport, photo: reconstruction.PosedPhoto, image: RgbImage) -> Crop:
    """A crop with the bounding box of a foreign object."""
    corners = np.array(one.center_mm) + 0.5 * np.array(one.size_mm) * _UNIT_CORNERS
    crop, camera = _cut(image, photo, corners)
    pixels = camera.project(apply(photo.cam_from_scan, corners))
    for a, b in _BOX_EDGES:
        if np.isfinite(pixels[[a, b]]).all():
            paint.line(crop, pixels[[a, b]], _FOREIGN_RGB, 2)
    return Crop(crop, photo.name, None)


def _cut(image: RgbImage, photo: reconstruction.PosedPhoto, corners: Array) -> tuple[RgbImage, Camera]:
    """The region of a photo around points (N,3), scaled to the size of a crop, and its camera."""
    pixels = photo.camera.project(apply(photo.cam_from_scan, corners))
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    camera = photo.camera
    middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
    aspect = WIDTH_PX / HEIGHT_PX
    extent = np.ptp(pixels, axis=0) / SHARE
    width = float(np.clip(max(extent[0], extent[1] * aspect, MIN_PX), 1, camera.width))
    width = min(width, camera.height * aspect)
    size = np.array([round(width), round(width / aspect)])
    low = np.clip(np.round(middle - 0.5 * size), 0, np.array([camera.width, camera.height]) - size).astype(int)
    part = image[low[1] : low[1] + size[1], low[0] : low[0] + size[0]]
    shrinks = size[0] > WIDTH_PX
    crop = cv2.resize(part, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    shifted = replace(
        camera, width=int(size[0]), height=int(size[1]), cx=camera.cx - float(low[0]), cy=camera.cy - float(low[1])
    )
    return np.ascontiguousarray(crop, dtype=np.uint8), shifted.scaled(WIDTH_PX, HEIGHT_PX)
