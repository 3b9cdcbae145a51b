"""Pictures of a report: photos cropped to what was found, with the ghost of the design and an arrow; the whole part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.camera import Camera
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.geometry import Array, apply, look_at
from arview.inspection import ComponentDeviation, ForeignReport, Inspection, Verdict
from arview.overlay import OverlayOptions, OverlayRenderer, paint
from arview.overlay.labels import arrow_in_model
from arview.pose import Pose, TrackingState
from arview.reconstruction.intake.reading import read_photo
from arview.reconstruction.types import PosedPhoto, SparseModel
from arview.rendering.renderers import ZBufferRenderer

Picture = NDArray[np.uint8]
_ROUND_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_FOREIGN_RGB = (255, 214, 10)
_BACKGROUND = (52, 58, 68)


@dataclass(frozen=True)
class CropOptions:
    """What the crops show."""

    width_px: int = 720  # of a crop: sharp on a page that shows two beside each other
    height_px: int = 540
    share: float = 0.55  # of the crop's side that the component takes: its neighbours tell where it is
    least_px: int = 160  # of the photo that a crop shows at least; fewer would only be blur
    arrow_share: float = 0.3  # of the crop's width that the arrow is at most long
    apart_deg: float = 40.0  # between the lines of sight of two crops, so that the second one tells more
    longest_px: int = 400  # of the renderings that say what can be seen; a component of 1 % still has 16 px


@dataclass(frozen=True)
class Crop:
    """Part of a photo with what is drawn on it.

    Attributes:
        image: (H,W,3) uint8 RGB.
        photo: name of the photo.
        arrow_scale: how much longer than the displacement the arrow is; None without an arrow.
    """

    image: Picture
    photo: str
    arrow_scale: float | None


@dataclass(frozen=True)
class Gallery:
    """Crops by component, by number of the foreign object, and why photos could not be read."""

    components: dict[str, tuple[Crop, ...]]
    foreign: tuple[tuple[Crop, ...], ...]
    unread: tuple[str, ...]


def make_gallery(
    inspection: Inspection, model: Model, sparse: SparseModel, options: CropOptions | None = None,
    progress: StepProgress | None = None,
) -> Gallery:  # fmt: skip
    """Two crops of what did not pass and of foreign objects, one of the rest, from the photos that show it best.

    Args:
        inspection: what was measured, in the frame of ``sparse``.
        model: nominal.
        sparse: photos and poses, mm.
        options: see there.
        progress: called with (done, in all).
    """
    options = options or CropOptions()
    tell = progress or (lambda done, total: None)
    seen = _Seen(model, sparse.photos, options)
    wanted: list[tuple[str | int, list[int]]] = [
        (one.name, seen.best_of(one, 1 if one.verdict is Verdict.PASS else 2)) for one in inspection.components
    ]
    wanted += [(index, seen.best_of_box(one)) for index, one in enumerate(inspection.foreign_objects)]
    by_photo: dict[int, list[str | int]] = {}
    for key, photos in wanted:
        for index in photos:
            by_photo.setdefault(index, []).append(key)
    crops: dict[tuple[str | int, int], Crop] = {}
    unread: list[str] = []
    for done, (index, keys) in enumerate(by_photo.items()):
        tell(done, len(by_photo))
        photo = sparse.photos[index]
        try:
            image = read_photo(photo.path)
        except InputError as error:
            unread.append(str(error))
            continue
        if image.shape[:2] != (photo.camera.height, photo.camera.width):
            unread.append(f"{photo.path}: is {image.shape[1]}×{image.shape[0]}, not the photo that was measured in")
            continue
        for key in keys:
            if isinstance(key, str):
                deviation = inspection.find(key)
                assert deviation is not None
                crops[key, index] = _component_crop(deviation, inspection, model, photo, image, options)
            else:
                crops[key, index] = _foreign_crop(inspection.foreign_objects[key], photo, image, options)
    tell(len(by_photo), len(by_photo))
    found = {key: tuple(crops[key, photo] for photo in photos if (key, photo) in crops) for key, photos in wanted}
    return Gallery(
        {key: value for key, value in found.items() if isinstance(key, str)},
        tuple(found[index] for index in range(len(inspection.foreign_objects))),
        tuple(unread),
    )


def overview(inspection: Inspection, model: Model, sparse: SparseModel | None = None, width: int = 1440) -> Picture:
    """The whole part with ghosts in the colours of the verdicts, arrows and labels, (H,W,3) uint8 RGB.

    Over the photo that shows it best, if there is one that can be read; else the nominal part alone, from the right
    and above.
    """
    options = OverlayOptions(show_status=False, max_labels=10)
    for photo in _whole_views(model, sparse.photos if sparse is not None else ()):
        try:
            image = read_photo(photo.path)
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
    renderer = OverlayRenderer(model, camera, inspection, options)
    return renderer.draw(image, Pose(pose, None, 1.0, TrackingState.TRACKED, 0.0, 0))


def _whole_views(model: Model, photos: Sequence[PosedPhoto]) -> list[PosedPhoto]:
    """Photos that hold the whole part, those from the middle of the heights first, in which it is large."""
    corners = _corners(model.bounds_in_model)
    views = []
    for photo in photos:
        pixels = photo.camera.project(apply(photo.cam_from_scan, corners))
        size = np.array([photo.camera.width, photo.camera.height])
        if np.isfinite(pixels).all() and (pixels >= 0).all() and (pixels < size).all():
            share = float(np.max(np.ptp(pixels, axis=0) / size))
            views.append((min(share, 0.8), photo))  # beyond that there is no room for labels
    return [photo for _, photo in sorted(views, key=lambda view: -view[0])]


def _whole_pose(model: Model, camera: Camera) -> Array:
    """A view in which the model's box fills the picture but for the labels' margins."""
    direction = np.array([0.45, -0.75, 0.75]) / np.linalg.norm([0.45, -0.75, 0.75])
    corners, distance = _corners(model.bounds_in_model), 3.0 * model.diameter_mm
    for _ in range(4):
        pose = look_at(model.center_in_model + distance * direction, model.center_in_model, [0.0, 0.0, 1.0])
        spread = np.ptp(camera.project(apply(pose, corners)), axis=0) / [0.62 * camera.width, 0.86 * camera.height]
        distance *= float(spread.max())
    return pose


class _Seen:
    """How many pixels of what each photo shows."""

    def __init__(self, model: Model, photos: Sequence[PosedPhoto], options: CropOptions) -> None:
        self.model, self.photos, self.options = model, photos, options
        self.centres = np.array([photo.centre_in_scan for photo in photos]).reshape(-1, 3)
        self.pixels = np.zeros((len(photos), len(model.components)))
        self._depths: list[tuple[Camera, NDArray[np.float32]]] = []
        for row, photo in enumerate(photos):
            scale = min(1.0, options.longest_px / max(photo.camera.width, photo.camera.height))
            small = photo.camera.scaled(round(photo.camera.width * scale), round(photo.camera.height * scale))
            drawn = ZBufferRenderer(model, small).render(photo.cam_from_scan)
            ids = drawn.component_ids
            self.pixels[row] = np.bincount(ids[ids >= 0], minlength=len(model.components)) / scale**2
            self._depths.append((small.without_distortion(), drawn.depth_mm))

    def best_of(self, deviation: ComponentDeviation, count: int) -> list[int]:
        """Photos that show a component large and its displacement from the side, in different directions."""
        bounds = self.model.component(deviation.name).bounds_in_model
        score = self.pixels[:, self.model.index(deviation.name)] * self._inside(_corners(bounds))
        rays = self._rays(bounds.mean(axis=0))
        displacement = arrow_in_model(deviation)
        if displacement is not None:
            along = rays @ (np.array(displacement) / np.linalg.norm(displacement))
            score = score * np.sqrt(np.maximum(1.0 - along**2, 0.0))
        return self._apart(score, rays, count)

    def best_of_box(self, one: ForeignReport) -> list[int]:
        """Photos in which the middle of a foreign object is not behind the CAD, nearest first."""
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
        return self._apart(score, rays, 2)

    def _rays(self, point: Array) -> Array:
        rays = self.centres - point
        return np.asarray(rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9))

    def _inside(self, corners: Array) -> Array:
        """1 for photos that hold all corners (8,3), 0.05 for those that do not."""
        result = np.zeros(len(self.photos))
        for index, photo in enumerate(self.photos):
            pixels = photo.camera.project(apply(photo.cam_from_scan, corners))
            limit = [photo.camera.width - 1, photo.camera.height - 1]
            holds = bool(np.isfinite(pixels).all() and (pixels >= 0).all() and (pixels <= limit).all())
            result[index] = 1.0 if holds else 0.05
        return result

    def _apart(self, score: Array, rays: Array, count: int) -> list[int]:
        chosen: list[int] = []
        score = score.copy()
        while len(chosen) < count and score.max(initial=0.0) > 0.0:
            chosen.append(int(np.argmax(score)))
            score[rays @ rays[chosen[-1]] > np.cos(np.deg2rad(self.options.apart_deg))] = 0.0
        return chosen


_UNIT_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_BOX_EDGES = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]


def _corners(bounds: Array) -> Array:
    """The eight corners of a box (2,3)."""
    return np.asarray(bounds.mean(axis=0) + 0.5 * (bounds[1] - bounds[0]) * _UNIT_CORNERS)


def _component_crop(
    deviation: ComponentDeviation, inspection: Inspection, model: Model, photo: PosedPhoto, image: Picture,
    options: CropOptions,
) -> Crop:  # fmt: skip
    """The design place of a component as a ghost, and an arrow to where it is."""
    bounds = model.component(deviation.name).bounds_in_model
    crop, camera = _cut(image, photo, _corners(bounds), options)
    scale: float | None = None
    displacement = arrow_in_model(deviation)
    if displacement is not None and deviation.verdict is not Verdict.PASS:
        depth = float(apply(photo.cam_from_scan, bounds.mean(axis=0)[None])[0, 2])
        longest_mm = options.arrow_share * camera.width * depth / camera.fx
        length_mm = float(np.linalg.norm(displacement))
        scale = float(max((s for s in _ROUND_SCALES if s * length_mm <= longest_mm), default=1))
    alone = replace(inspection, components=(deviation,), foreign_objects=())
    drawn = OverlayOptions(opacity=0.3, show_labels=False, show_status=False, arrow_scale=scale or 1.0)
    pose = Pose(photo.cam_from_scan, None, 1.0, TrackingState.TRACKED, 0.0, 0)
    picture = OverlayRenderer(model, camera, alone, drawn).draw(crop, pose)
    return Crop(picture, photo.name, scale)


def _foreign_crop(one: ForeignReport, photo: PosedPhoto, image: Picture, options: CropOptions) -> Crop:
    """The box round something that does not belong there."""
    corners = np.array(one.center_mm) + 0.5 * np.array(one.size_mm) * _UNIT_CORNERS
    crop, camera = _cut(image, photo, corners, options)
    pixels = camera.project(apply(photo.cam_from_scan, corners))
    for a, b in _BOX_EDGES:
        if np.isfinite(pixels[[a, b]]).all():
            paint.line(crop, pixels[[a, b]], _FOREIGN_RGB, 2)
    return Crop(crop, photo.name, None)


def _cut(image: Picture, photo: PosedPhoto, corners: Array, options: CropOptions) -> tuple[Picture, Camera]:
    """The part of a photo round some points (N,3), at the size of a crop, and its camera."""
    pixels = photo.camera.project(apply(photo.cam_from_scan, corners))
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    camera = photo.camera
    middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
    aspect = options.width_px / options.height_px
    extent = np.ptp(pixels, axis=0) / options.share
    width = float(np.clip(max(extent[0], extent[1] * aspect, options.least_px), 1, camera.width))
    width = min(width, camera.height * aspect)
    size = np.array([round(width), round(width / aspect)])
    low = np.clip(np.round(middle - 0.5 * size), 0, np.array([camera.width, camera.height]) - size).astype(int)
    part = image[low[1] : low[1] + size[1], low[0] : low[0] + size[0]]
    shrinks = size[0] > options.width_px
    crop = cv2.resize(
        part, (options.width_px, options.height_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    )
    shifted = replace(
        camera, width=int(size[0]), height=int(size[1]), cx=camera.cx - float(low[0]), cy=camera.cy - float(low[1])
    )
    return np.ascontiguousarray(crop, dtype=np.uint8), shifted.scaled(options.width_px, options.height_px)
