"""Named conditions of a sequence: what is on the part, how it fills the picture, and which camera takes it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from arview.cad.model import Model
from arview.camera import Camera
from arview_lab.semisynthetic.camera_effects import CameraEffects
from arview_lab.semisynthetic.decoration import DecorationOptions
from arview_lab.semisynthetic.sequence import CAMERA
from arview_lab.semisynthetic.shading import Reflectance
from arview_lab.semisynthetic.shadows import ShadowOptions
from arview_lab.semisynthetic.trajectory import TrajectoryOptions

HAND_HELD = TrajectoryOptions(turn_deg=2.5, step_mm=6.0, distance_mm=(450.0, 900.0))
"""Motion of a part in the view of a phone that is held in the hand."""
CLOSE = TrajectoryOptions(turn_deg=3.0, step_mm=4.0)
"""Motion of a part that fills the picture."""


@dataclass(frozen=True)
class Conditions:
    """Conditions under which a part is seen.

    Attributes:
        name: of the conditions.
        size: width and height of the pictures, px.
        decoration: on the part's surface; the CAD has nothing of it.
        reflectance: of the surface.
        vivid: keep the CAD's colours instead of muting them.
        shadows: soft shadows; None: none.
        camera: its faults.
        motion: of the part.
        fill: smallest and largest diameter of the part in the picture, as a share of its height; None: the distances
            of the motion.
        in_view: smallest and largest share of the part inside the picture, cut by its border; None: as it comes.
    """

    name: str
    size: tuple[int, int] = (CAMERA.width, CAMERA.height)
    decoration: DecorationOptions = field(default_factory=DecorationOptions)
    reflectance: Reflectance = field(default_factory=Reflectance)
    vivid: bool = False
    shadows: ShadowOptions | None = None
    camera: CameraEffects = field(default_factory=CameraEffects)
    motion: TrajectoryOptions = field(default_factory=TrajectoryOptions)
    fill: tuple[float, float] | None = None
    in_view: tuple[float, float] | None = None

    @property
    def pinhole(self) -> Camera:
        """The camera, whose focal length grows with the picture's height: the part has the same share of it."""
        width, height = self.size
        focal = CAMERA.fx * height / CAMERA.height
        return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))

    def motion_of(self, model: Model) -> TrajectoryOptions:
        """Motion of a part, at the distances at which it fills the picture as wanted."""
        if self.fill is None:
            return self.motion
        low, high = self.fill
        at_height = model.diameter_mm * self.pinhole.fy / self.pinhole.height
        return replace(self.motion, distance_mm=(at_height / high, at_height / low))


GLOSSY = Reflectance(0.72, 0.9, 0.34, 70.0)
PAINTED = Reflectance(0.78, 0.7, 0.22, 40.0)
PHONE = CameraEffects(
    shutter=0.3, readout=0.6, lens_px=0.5, defocus_px=(0.0, 1.0), behind_px=0.8, light_ev=0.35, exposure_lag=6.0,
    white_balance=0.05, read_noise=1.5, shot_noise=4.0, sharpening=0.5, mbit_per_s=6.0,
)  # fmt: skip
USED = DecorationOptions(stickers=0.5, scratches=8.0, dirt=0.08)
WORN = DecorationOptions(stickers=0.4, tapes=0.6, scratches=25.0, rust=0.22, dirt=0.25)
CONDITIONS = {
    conditions.name: conditions
    for conditions in (
        Conditions("printed", decoration=DecorationOptions(photos=1.0, stickers=0.4)),
        Conditions("worn", decoration=WORN, reflectance=PAINTED, shadows=ShadowOptions()),
        Conditions("large", decoration=USED, motion=CLOSE, fill=(0.95, 1.25), camera=CameraEffects(lens_px=0.9)),
        Conditions(
            "border", decoration=USED, motion=CLOSE, fill=(1.05, 1.55), in_view=(0.4, 0.9),
            camera=CameraEffects(lens_px=0.9),
        ),
        Conditions(
            "hd", (1920, 1080), USED, PAINTED, shadows=ShadowOptions(), motion=HAND_HELD,
            camera=CameraEffects(shutter=0.2, lens_px=0.5, defocus_px=(0.0, 0.8), behind_px=0.8, shot_noise=3.0,
                                 mbit_per_s=12.0),
        ),
        Conditions("phone", (1280, 720), USED, PAINTED, shadows=ShadowOptions(), motion=HAND_HELD, camera=PHONE),
        Conditions(
            "phone-hard", (1280, 720), WORN, PAINTED, shadows=ShadowOptions(), motion=HAND_HELD,
            camera=replace(PHONE, shutter=0.6, readout=0.9, defocus_px=(0.0, 2.2), light_ev=0.7, white_balance=0.07,
                           shot_noise=8.0, mbit_per_s=1.5),
        ),
        Conditions(
            "curved", reflectance=GLOSSY, vivid=True, shadows=ShadowOptions(),
            camera=CameraEffects(shutter=0.2, lens_px=0.7, defocus_px=(0.0, 0.8)),
        ),
    )
}  # fmt: skip
"""All conditions by name."""
