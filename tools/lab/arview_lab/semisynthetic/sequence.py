"""A semi-synthetic sequence frame by frame: a rendered part in front of a real photo, with exact true poses.

Modelled on the RBOT dataset (Tjaden et al., "A Region-based Gauss-Newton Approach to Real-Time Monocular
Multiple Object Tracking", TPAMI 2018): 640×512 px, f = 650 px, four variants of one trajectory.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.geometry import Array, apply, exp_se3, exp_so3, invert, log_se3, rigid
from arview.video import Image
from arview_lab.semisynthetic.backgrounds import moving_crops, surroundings
from arview_lab.semisynthetic.shading import Layer, Light, ShadedModel
from arview_lab.semisynthetic.trajectory import TrajectoryOptions, random_trajectory, smooth_noise

Variant = Literal["regular", "light", "noise", "occlusion"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
CAMERA = Camera(640, 512, 650.0, 650.0, 319.5, 255.5)

KEY_LIGHT = np.array([-0.45, -0.72, -0.53])
FILL_LIGHT = np.array([0.75, -0.10, -0.65])
"""Directions towards the lights, in the camera frame."""
LIGHT_PERIODS = np.array([70.0, 45.0, 31.0])
"""Periods, in frames, in which the moving light rotates, tilts, and varies in strength."""
ORBIT_FRAMES = 60.0
"""Frames in which the occluder circles the part once."""
OCCLUDER_SHARE = 0.6
"""Size of the occluder, as a share of the part's."""
JOIN_BLUR_PX = 0.6
"""Standard deviation of the blur at the part's edges, like that of a lens."""
EXPOSURES = 5
"""Moments over which motion blur is averaged."""


@dataclass(frozen=True)
class SequenceOptions:
    """Parameters of a sequence.

    Attributes:
        variant: ``regular``: fixed light; ``light``: moving light; ``noise``: moving light, noise and blur;
            ``occlusion``: moving light and an occluder.
        frames: number of frames.
        seed: of all random numbers; the trajectory depends only on the seed and the part's name.
        sensor_noise: standard deviation in grey levels in all variants; ``noise`` adds its own.
        noise, blur_px: standard deviations of the variant ``noise``, in grey levels and px.
        shutter: share of the time between frames in which the shutter is open; 0: no motion blur.
        motion: of the part.
    """

    variant: Variant = "regular"
    frames: int = 100
    seed: int = 0
    sensor_noise: float = 2.0
    noise: float = 12.0
    blur_px: float = 0.9
    shutter: float = 0.0
    motion: TrajectoryOptions = field(default_factory=TrajectoryOptions)


@dataclass(frozen=True)
class SequenceFrame:
    """A picture with its true pose and mask.

    Attributes:
        image: (H,W,3) uint8 RGB.
        cam_from_model: (4,4).
        pixels: area that the part covers, also outside the picture, px.
        pixels_in_picture: area inside the picture, px.
        mask: (H,W) float32, share of each pixel that shows the part.
    """

    image: Image
    cam_from_model: Array
    pixels: float
    pixels_in_picture: float
    mask: NDArray[np.float32]

    @property
    def visible(self) -> float:
        """Share of the part that is visible: neither occluded nor outside the picture."""
        return float(self.mask.sum()) / self.pixels if self.pixels > 0 else 0.0


def generator(seed: int, *words: str) -> np.random.Generator:
    """Random number generator of a seed, for one purpose."""
    return np.random.default_rng([seed, *(zlib.crc32(word.encode()) for word in words)])


def trajectory(model: Model, options: SequenceOptions, camera: Camera = CAMERA, name: str = "") -> Array:
    """``cam_from_model`` (frames,4,4) of a part in a sequence: the same in all variants, different for each name."""
    rng = generator(options.seed, model.name, "trajectory", name)
    return random_trajectory(camera, model.center_in_model, model.diameter_mm, options.frames, rng, options.motion)


def render_sequence(
    model: Model,
    poses: Array,
    photo: Image,
    options: SequenceOptions,
    camera: Camera = CAMERA,
    occluder: Model | None = None,
    name: str | None = None,
) -> Iterator[SequenceFrame]:
    """The frames of a sequence.

    Args:
        model: rendered.
        poses: (N,4,4) ``cam_from_model``, for instance from `trajectory`.
        photo: (H,W,3) background.
        options: variant, seed, noise; ``frames`` is not used.
        camera: ideal, of the pictures.
        occluder: of the variant ``occlusion``.
        name: of the sequence, for its random numbers; None: the model's.
    """
    rng = generator(options.seed, name or model.name, options.variant)
    crops = moving_crops(photo, camera.width, camera.height, len(poses), rng)
    lights = scene_lights(options.variant, len(poses), surroundings(photo), rng)
    part = ShadedModel(model)
    blocker = None
    if occluder is not None and options.variant == "occlusion":
        blocker = ShadedModel(scaled(occluder, OCCLUDER_SHARE * model.diameter_mm / occluder.diameter_mm))
    blocker_poses = occluder_poses(model, poses, blocker.model, rng) if blocker else poses
    is_noisy = options.variant == "noise"
    noise = float(np.hypot(options.sensor_noise, options.noise if is_noisy else 0.0))
    for number, (crop, light) in enumerate(zip(crops, lights, strict=True)):
        drawn = _drawn(part, _exposure(poses, number, options.shutter), camera, light)
        picture = crop * (1.0 - drawn.blurred_coverage[..., None]) + 255.0 * drawn.blurred_color
        mask = drawn.coverage
        if blocker:
            front = _drawn(blocker, _exposure(blocker_poses, number, options.shutter), camera, light)
            picture = picture * (1.0 - front.blurred_coverage[..., None]) + 255.0 * front.blurred_color
            mask = mask * (1.0 - front.coverage)
        if is_noisy:
            picture = cv2.GaussianBlur(picture, (0, 0), options.blur_px)
        picture = picture + noise * rng.standard_normal(picture.shape, dtype=np.float32)
        image = np.clip(np.round(picture), 0, 255).astype(np.uint8)
        yield SequenceFrame(image, poses[number], drawn.pixels, float(drawn.coverage.sum()), mask)


@dataclass(frozen=True)
class _Drawn:
    """A rendered part in the picture.

    Attributes:
        blurred_color, blurred_coverage: (H,W,3) colour times coverage and (H,W) coverage, blurred by the lens.
        coverage: (H,W) without blur.
        pixels: sum of the coverage of the whole part, also outside the picture.
    """

    blurred_color: NDArray[np.float32]
    blurred_coverage: NDArray[np.float32]
    coverage: NDArray[np.float32]
    pixels: float


def _drawn(part: ShadedModel, poses: list[Array], camera: Camera, light: Light) -> _Drawn:
    """Mean of the renderings of a part at the poses of one exposure."""
    shape = (camera.height, camera.width)
    both = np.zeros((*shape, 4), np.float32)
    coverage = np.zeros(shape, np.float32)
    pixels = 0.0
    for pose in poses:
        layer = part.draw(pose, camera, light)
        if layer is None:
            continue
        pixels += float(layer.coverage.sum()) / len(poses)
        stacked = np.dstack([layer.color, layer.coverage])
        paste(cv2.GaussianBlur(stacked, (0, 0), JOIN_BLUR_PX, borderType=cv2.BORDER_CONSTANT), layer, both)
        paste(layer.coverage, layer, coverage)
    both /= len(poses)
    coverage /= len(poses)
    return _Drawn(both[..., :3], both[..., 3], coverage, pixels)


def paste(window: NDArray[np.float32], layer: Layer, picture: NDArray[np.float32]) -> None:
    """Add the part of a layer's window that lies inside the picture."""
    height, width = picture.shape[:2]
    left, top = max(layer.left, 0), max(layer.top, 0)
    right, bottom = min(layer.left + window.shape[1], width), min(layer.top + window.shape[0], height)
    if right > left and bottom > top:
        rows = slice(top - layer.top, bottom - layer.top)
        picture[top:bottom, left:right] += window[rows, left - layer.left : right - layer.left]


def _exposure(poses: Array, number: int, shutter: float) -> list[Array]:
    """Poses (4,4) evenly spread over the exposure of a frame."""
    if shutter <= 0.0 or len(poses) < 2:
        return [poses[number]]
    before, after = poses[max(number - 1, 0)], poses[min(number + 1, len(poses) - 1)]
    frames = min(number + 1, len(poses) - 1) - max(number - 1, 0)
    twist = log_se3(invert(before) @ after) / frames
    return [poses[number] @ exp_se3(shutter * t * twist) for t in np.linspace(-0.5, 0.5, EXPOSURES)]


def scene_lights(
    variant: Variant, count: int, around: NDArray[np.float32], rng: np.random.Generator
) -> Iterator[Light]:
    """Light of each frame: fixed, or a key light that circles and varies in strength."""
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    key = KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
    fill = FILL_LIGHT / np.linalg.norm(FILL_LIGHT)
    for number in range(count):
        toward, strength, ambient = key, 0.85, 0.36
        if variant != "regular":
            turn, tilt, wave = 2.0 * np.pi * number / LIGHT_PERIODS + phases
            toward = exp_so3([0.0, 0.0, turn]) @ exp_so3([0.5 * np.sin(tilt), 0.0, 0.0]) @ key
            strength, ambient = 0.85 + 0.55 * np.sin(wave), 0.30 + 0.14 * np.sin(wave)
        yield Light(np.stack([toward, fill]), np.array([strength, 0.25]), ambient, around)


def scaled(model: Model, factor: float) -> Model:
    """The model scaled about its origin."""
    components = [replace(c, vertices_in_model=factor * c.vertices_in_model) for c in model.components]
    return make_model(model.name, tuple(components))


def occluder_poses(model: Model, poses: Array, occluder: Model, rng: np.random.Generator) -> Array:
    """``cam_from_occluder`` (N,4,4) of a second part that circles the line of sight in front of the first."""
    count = len(poses)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    spin = smooth_noise(count, 3, 20.0, rng)
    swing = smooth_noise(count, 1, 15.0, rng)[:, 0]
    reach = 0.5 * (model.diameter_mm + occluder.diameter_mm)
    placed = []
    for number, pose in enumerate(poses):
        center = apply(pose, model.center_in_model)
        distance = float(np.linalg.norm(center))
        # Nearer by both radii, so that the parts never touch.
        near = max(distance - reach, 0.4 * distance)
        angle = 2.0 * np.pi * number / ORBIT_FRAMES + phase
        radius = (0.75 + 0.2 * np.tanh(swing[number])) * 0.5 * model.diameter_mm * near / distance
        offset = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
        rotation = exp_so3(1.5 * spin[number])
        target = center * (near / distance) + offset
        placed.append(rigid(rotation, target - rotation @ occluder.center_in_model))
    return np.stack(placed)
