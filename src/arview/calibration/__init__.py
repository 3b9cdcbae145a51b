"""Lens calibration from pictures of a board: finding the board, the camera, its uncertainty and a verdict."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.calibration.choose import ChoiceOptions as ChoiceOptions
    from arview.calibration.plot import draw as draw
    from arview.calibration.projection import CalibratedLens as CalibratedLens
    from arview.calibration.projection import intrinsics_of as intrinsics_of
    from arview.calibration.projection import lens_of as lens_of
    from arview.calibration.rig import CameraRig as CameraRig
    from arview.calibration.rig import rig_from_board as rig_from_board
    from arview.calibration.rig import rig_from_part as rig_from_part
    from arview.calibration.run import Calibration as Calibration
    from arview.calibration.run import calibrate as calibrate
    from arview.calibration.run import record_of as record_of

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "choose": ("ChoiceOptions",),
        "plot": ("draw",),
        "projection": (
            "CalibratedLens",
            "intrinsics_of",
            "lens_of",
        ),
        "rig": (
            "CameraRig",
            "rig_from_board",
            "rig_from_part",
        ),
        "run": (
            "Calibration",
            "calibrate",
            "record_of",
        ),
    },
)
