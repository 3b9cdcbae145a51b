"""What a kind of sample part is made of, and the options of one photo set. Lengths in mm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

LIGHTS = ("workshop", "hard-sun", "mixed", "dim")
LAYOUTS = ("ring", "one-sided", "film")
FINISHES = ("steel", "rust", "paint", "chrome", "cast")


@dataclass(frozen=True)
class SetOptions:
    """How one photo set is made.

    Attributes:
        seed: chooses displacements, camera, places, clutter and textures.
        photos: number of photos.
        layout: rings round the part, a third of that seen from one side, or the frames of a walk past it.
        light: lamps of the scene.
        finish: surface of the components, and of the base but for chrome.
        focal_px: focal length at a picture width of 1600 px; None lets the seed choose.
        distortion: radial distortion k1, k2; None lets the seed choose.
        lens_changes: autofocus and stabiliser change the lens in every photo, as a phone's do.
        width: picture width in px; pictures are 4:3.
        passes: passes of rendering, which keep memory low.
        samples: path samples per pixel and pass.
        bench_px_per_mm: resolution of the bench's texture.
    """

    seed: int = 0
    photos: int = 24
    layout: str = "ring"
    light: str = "workshop"
    finish: str = "steel"
    focal_px: float | None = None
    distortion: tuple[float, float] | None = None
    lens_changes: bool = False
    width: int = 1600
    passes: int = 2
    samples: int = 4
    bench_px_per_mm: float = 2.0

    @property
    def height(self) -> int:
        """Picture height, px."""
        return self.width * 3 // 4


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of part, and how people photograph it.

    Attributes:
        name: name of the part, its STEP file and its folder.
        components: returns name, solid at its nominal place and colour of every component; the base comes first.
        seats: returns model_from_seat (4,4) of components that do not stand upright on z = 0.
        moves: shift in the seat's plane (mm), lift off it (mm), tilt about an axis in the plane (deg) and twist about
            its normal (deg) of the displaced components. The seed determines which component gets which.
        missing: number of components that are absent; the first has fallen and lies on the part.
        spots: places (3,) on the base's surface where fallen and foreign objects may lie.
        foreign: number of foreign objects on the part.
        litter: whether washers, keys and chips, which are flat and small, are among the foreign objects.
        rings: elevation (deg) and distance (mm) of the rings of photos.
        aim: point that the photos look at.
        aim_spread: 1 sigma of the hand-held aim.
        radius: radius round the part that is free of clutter.
        floor: height of the bench's top.
        finish: finish of the part unless an option asks for another.
        tint: colour of the base where it is painted.
        metals: finish of components by the first word of their name; others are machined.
        loose: components of which copies lie on the bench.
        stamp: first letters of the serial number in chalk.
        supports: boxes (size, centre) that the part lies on.
        welds: whether there are weld beads round the components.
        exposure: factor of a fixed exposure; None meters every photo.
        put_right: components that a fitter has put back to their nominal place; all others stay as built.
    """

    name: str
    components: Callable[[], list]
    moves: tuple[tuple[float, float, float, float], ...]
    rings: tuple[tuple[float, float], ...]
    radius: float
    floor: float
    aim: tuple[float, float, float]
    aim_spread: float
    seats: Callable[[], dict[str, np.ndarray]] = dict
    missing: int = 0
    spots: tuple[tuple[float, float, float], ...] = ()
    foreign: int = 0
    litter: bool = False
    finish: str = "steel"
    tint: tuple[float, float, float] = (0.3, 0.34, 0.36)
    metals: dict[str, str] = field(default_factory=dict)
    loose: tuple[str, ...] = ()
    stamp: str = ""
    supports: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    welds: bool = False
    exposure: float | None = None
    put_right: tuple[str, ...] = ()

    def seat(self, component: str) -> np.ndarray:
        """``model_from_seat`` (4,4): +Z points out of the surface that the component stands on."""
        return self.seats().get(component, np.eye(4))
