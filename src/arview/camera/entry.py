"""One camera of a camera file, as the file gives it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from arview.camera.lens import LensDistortion
from arview.errors import InputError


@dataclass(frozen=True)
class CameraEntry:
    """One camera of a file; the size is None where the file does not give it.

    Attributes:
        fx, fy, cx, cy: px.
        dist: k1 k2 p1 p2 k3.
        lens: another lens model, or None.
        width, height: of the calibrated picture, px.
        roi: left, top, width, height px of the window of that picture that the frames show, before binning.
        binning: pixels of that picture in a pixel of the frames, across and down.
        whole_size: width and height before roi and binning were applied, see `as_recorded`.
        label: name in the file.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    dist: tuple[float, ...] = ()
    lens: LensDistortion | None = None
    width: int | None = None
    height: int | None = None
    roi: tuple[int, int, int, int] | None = None
    binning: tuple[int, int] = (1, 1)
    whole_size: tuple[int, int] | None = None
    label: str = field(default="", compare=False)

    def as_recorded(self) -> CameraEntry:
        """The camera of the frames as they leave the device: the window of the roi, binned.

        Raises:
            InputError: roi or binning without the size of the picture, or a roi outside it.
        """
        if self.roi is None and self.binning == (1, 1):
            return self
        if self.width is None or self.height is None:
            raise InputError("roi or binning, but no image size in the camera file; add width and height in px")
        left, top, width, height = self.roi or (0, 0, self.width, self.height)
        if left + width > self.width or top + height > self.height:
            raise InputError(
                f"roi {width}×{height} at ({left}, {top}) reaches beyond the {self.width}×{self.height} picture"
            )
        across, down = self.binning
        if width < across or height < down:
            raise InputError(f"binning {across}×{down} leaves nothing of a picture of {width}×{height} px")
        return replace(
            self,
            fx=self.fx / across,
            fy=self.fy / down,
            cx=(self.cx - left + 0.5) / across - 0.5,
            cy=(self.cy - top + 0.5) / down - 0.5,
            width=width // across,
            height=height // down,
            roi=None,
            binning=(1, 1),
            whole_size=(self.width, self.height),
        )
