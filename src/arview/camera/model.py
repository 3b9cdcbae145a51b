"""The pinhole camera with Brown distortion (k1 k2 p1 p2 k3) or another lens model, in OpenCV's conventions.

Pixel (u, v): integer coordinates are pixel centres. Camera frame: +X right, +Y down, +Z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from arview.camera.lens import LensDistortion, undistort_by_newton
from arview.camera.terms import lens_from_terms
from arview.errors import InputError
from arview.geometry import Array

COLMAP_HALF_PX = 0.5
"""COLMAP puts (0, 0) on the corner of the first pixel, arview on its centre: added to arview's coordinates."""
MAX_OFF_CENTRE = 0.15
"""Distance of the principal point from the middle, by the picture's size, beyond which a camera is doubted …."""
MAX_UNEVEN = 0.05
"""… and relative difference of its focal lengths."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera at one image size.

    Attributes:
        width, height: of the image, px.
        fx, fy: focal lengths, px.
        cx, cy: principal point, px.
        dist: (5,) distortion k1 k2 p1 p2 k3, as in OpenCV; zeros where ``lens`` is given.
        lens: another lens model, or None. Pictures of such a camera are undistorted before the engine uses them, see
            `arview.camera.undistort`.

    Raises:
        InputError: a value that no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    dist: Array = field(default_factory=lambda: np.zeros(5))
    lens: LensDistortion | None = None

    def __post_init__(self) -> None:
        dist = np.zeros(5)
        given = np.asarray(self.dist, dtype=np.float64).ravel()
        if given.size > 5 and np.any(given[5:] != 0):
            raise InputError(f"camera: {given.size} distortion terms; only k1 k2 p1 p2 k3 are supported")
        dist[: min(5, given.size)] = given[:5]
        object.__setattr__(self, "dist", dist)
        if self.lens is not None and np.any(dist != 0.0):
            raise InputError(f"camera: distortion terms beside the lens model {self.lens.model}; give one of them")
        values = np.array([self.fx, self.fy, self.cx, self.cy, *dist], dtype=np.float64)
        if not np.all(np.isfinite(values)):
            raise InputError("camera: a value is NaN or infinite; calibrate again or correct the file")
        if self.width <= 0 or self.height <= 0:
            raise InputError(f"camera: image size {self.width}×{self.height} is not positive")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"camera: focal length fx={self.fx} fy={self.fy} px is not positive")

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, size: tuple[int, int], dist: ArrayLike = ()) -> Camera:
        """The camera of a calibration matrix and distortion terms as OpenCV gives them.

        Args:
            matrix: (3,3) K, px.
            size: width and height of the image, px.
            dist: 4, 5, 8, 12 or 14 terms in OpenCV's order, or none; those of a tilted sensor must be zero.

        Raises:
            InputError: another shape or number, a skew, or terms that are not supported.
        """
        k, terms = np.asarray(matrix, dtype=np.float64), np.asarray(dist, dtype=np.float64).ravel()
        if k.shape != (3, 3) or abs(k[0, 1]) > 1e-3 * abs(k[0, 0]) or k[1, 0] or not np.allclose(k[2], [0, 0, 1]):
            raise InputError(f"camera: the matrix {k.tolist()} is not fx 0 cx / 0 fy cy / 0 0 1")
        brown, lens = lens_from_terms([], terms.tolist(), {})
        fx, fy, cx, cy = (float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return cls(size[0], size[1], fx, fy, cx, cy, np.array(brown), lens)

    def __repr__(self) -> str:
        distortion = "distorted" if self.is_distorted else "no distortion"
        if self.lens is not None:
            distortion = f"{self.lens.model} lens"
        focal, center = f"f {self.fx:.1f}, {self.fy:.1f} px", f"centre {self.cx:.1f}, {self.cy:.1f} px"
        return f"<Camera {self.width}×{self.height}: {focal}, {center}, {distortion}>"

    @property
    def matrix(self) -> Array:
        """(3,3) calibration matrix K, px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """True when any distortion term is not zero, or the lens has another model."""
        return self.lens is not None or bool(self.dist.any())

    @property
    def doubt(self) -> str:
        """Why the values are unlikely for pictures of this size; empty if they are not."""
        off = max(abs((self.cx + 0.5) / self.width - 0.5), abs((self.cy + 0.5) / self.height - 0.5))
        uneven = abs(np.log(self.fx / self.fy))
        found = [f"the principal point ({self.cx:g}, {self.cy:g}) is {100 * off:.0f} % of the picture off its middle"]
        found = found if off > MAX_OFF_CENTRE else []
        found += [f"fx and fy differ by {100 * np.expm1(uneven):.0f} %"] if uneven > MAX_UNEVEN else []
        if not found:
            return ""
        return (
            f"{' and '.join(found)}: is the camera for another resolution than {self.width}×{self.height}, or a crop?"
        )

    def project(self, points_in_cam: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera frame; NaN for points not in front of the camera."""
        points = np.asarray(points_in_cam, dtype=np.float64)
        if points.ndim == 1 and self.lens is None:
            return self._project_one(*points.tolist())
        z = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.where(z > 0, points[..., 0] / z, np.nan)
            y = np.where(z > 0, points[..., 1] / z, np.nan)
        x, y = self.distort(x, y)
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)

    def _project_one(self, x: float, y: float, z: float) -> Array:
        """As `project`, of one point: without numpy's overhead, because it is done several times in a frame."""
        if not z > 0.0:
            return np.array([np.nan, np.nan])
        x, y = self.distort(x / z, y / z)  # type: ignore[arg-type, assignment]
        return np.array([self.fx * x + self.cx, self.fy * y + self.cy])

    def slopes(self, points_in_cam: Array) -> Array:
        """(N,2,3) derivatives of the pixels of points (N,3) in the camera frame, px by the points' unit.

        Through a lens of another model by differences with steps of one millionth of the depth.
        """
        z = np.where(points_in_cam[:, 2] > 0, points_in_cam[:, 2], np.nan)
        if self.lens is not None:
            delta = 1e-6 * z[:, None]
            pixels = self.project(points_in_cam)
            moved = [(self.project(points_in_cam + delta * axis) - pixels) / delta for axis in np.eye(3)]
            return np.stack(moved, axis=2)
        k1, k2, p1, p2, k3 = self.dist.tolist()
        x, y = points_in_cam[:, 0] / z, points_in_cam[:, 1] / z
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bend = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        xx = radial + x * x * bend + 2.0 * p1 * y + 6.0 * p2 * x
        xy = x * y * bend + 2.0 * p1 * x + 2.0 * p2 * y
        yy = radial + y * y * bend + 6.0 * p1 * y + 2.0 * p2 * x
        result = np.empty((len(z), 2, 3))
        result[:, 0, 0], result[:, 0, 1], result[:, 0, 2] = xx, xy, -(xx * x + xy * y)
        result[:, 1, 0], result[:, 1, 1], result[:, 1, 2] = xy, yy, -(xy * x + yy * y)
        result *= np.array([[self.fx], [self.fy]]) / z[:, None, None]
        return result

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted normalised coordinates of ideal ones (Brown 1966, OpenCV's formula; or the lens model)."""
        if self.lens is not None:
            return self.lens.distort(x, y)
        k1, k2, p1, p2, k3 = self.dist.tolist()
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return xd, yd

    def unproject(self, pixels: ArrayLike) -> Array:
        """Ideal normalised rays (..., 3) with z = 1 of pixels (..., 2); distortion is removed by Newton's method.

        NaN for pixels where a lens of another model sees nothing less than 90° off the axis.
        """
        uv = np.asarray(pixels, dtype=np.float64)
        xd = (uv[..., 0] - self.cx) / self.fx
        yd = (uv[..., 1] - self.cy) / self.fy
        x, y = xd.copy(), yd.copy()
        if self.lens is not None:
            x, y = self.lens.undistort(xd, yd)
        elif self.is_distorted:
            x, y = undistort_by_newton(self.distort, xd, yd, is_nearest=True)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def scaled(self, width: int, height: int) -> Camera:
        """The camera for an image resized to width × height with the whole field of view."""
        sx, sy = width / self.width, height / self.height
        return self._resized(width, height, sx, sy)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera for a window of its image: width × height px, with (left, top) as the first pixel."""
        return self._changed(width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def magnified(self, scale: float) -> Camera:
        """The camera whose pixels are smaller than its own by exactly a scale; its size is rounded."""
        return self._resized(round(self.width * scale), round(self.height * scale), scale, scale)

    def _resized(self, width: int, height: int, sx: float, sy: float) -> Camera:
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return self._changed(width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=cx, cy=cy)

    def _changed(self, *, width: int, height: int, **values: float) -> Camera:
        """The camera with other values, which are only checked in so far as they can be wrong: once per picture."""
        if width <= 0 or height <= 0:
            raise InputError(f"camera: image size {width}×{height} is not positive")
        other = object.__new__(Camera)
        other.__dict__.update(self.__dict__, width=width, height=height, **values)
        return other

    def rotated(self, quarter_turns_clockwise: int) -> Camera:
        """The camera for an image turned clockwise by quarter turns, distortion included."""
        camera = self
        for _ in range(quarter_turns_clockwise % 4):
            k1, k2, p1, p2, k3 = camera.dist
            camera = Camera(
                width=camera.height,
                height=camera.width,
                fx=camera.fy,
                fy=camera.fx,
                cx=camera.height - 1 - camera.cy,
                cy=camera.cx,
                dist=np.array([k1, k2, p2, -p1, k3]),
                lens=None if camera.lens is None else camera.lens.turned_clockwise(),
            )
        return camera

    def without_distortion(self) -> Camera:
        """The ideal camera with the same calibration matrix."""
        return replace(self, dist=np.zeros(5), lens=None)
