"""Where fixed cameras stand: from a board that several of them see at a time, or from the part itself.

Each shot is one picture of every camera at the same moment. With a board, all poses of cameras and boards are
adjusted together (Triggs et al., "Bundle adjustment — a modern synthesis", 2000); corners of one picture share errors
of the lens and of blur, so that many of them say little more than some. With the part, each camera is moved until it
sees the part's edges where the others do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview import reconstruction
from arview.cad import Part
from arview.calibration.board_view import BoardView
from arview.calibration.plain_boards import PlainBoardFinder
from arview.calibration.solve import K
from arview.calibration.verdict import Grade
from arview.calibration.views import BoardFinder
from arview.camera import Camera, require_brown
from arview.core.atomic import write_file
from arview.core.fits import robust_sigma, tukey_weights
from arview.errors import InputError
from arview.fiducials import Board
from arview.geometry import Array, apply, exp_se3, invert, orthonormalise, rigid

ROUNDS = 12
"""Rounds of the adjustment; it settles after three to five."""
COMMON_PX = 0.03
"""Standard deviation of an error that all corners of one picture share: lens, blur, a board that is not quite flat."""
MIN_SIGMA_PX = 0.03
"""Corners of a board are not found better than this."""
GOOD_SHOTS, GOOD_PX, USABLE_PX = 5, 0.4, 1.0
"""Shots of each camera, and residual, of a good rig; and the residual up to which one is usable."""
FORMAT = "arview rig 1"
_INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class CameraRig:
    """Fixed cameras that know each other's place.

    Attributes:
        names: of the cameras.
        cameras: their intrinsics.
        cams_from_rig: (M,4,4) their poses, mm.
        covariance: (6M,6M) of the poses: a twist (rad, mm) of each, on the left of ``cam_from_rig``, in the frame in
            which the cameras together vary least.
        scale_std: relative standard uncertainty of all lengths.
        residuals_px: of each camera: robust standard deviation of corners, or shift of the part's edges.
        shots: in which each camera took part.
        source: what the poses come from.
        created: UTC.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cams_from_rig: Array
    covariance: Array
    scale_std: float
    residuals_px: tuple[float, ...]
    shots: tuple[int, ...]
    source: str
    created: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def uncertainties(self) -> Array:
        """(M,2) U (k = 2) of each camera's direction, deg, and place, mm: root mean square over the axes."""
        variances = np.diag(self.covariance).reshape(-1, 2, 3).mean(axis=2)
        return K * np.sqrt(variances) * (np.rad2deg(1.0), 1.0)

    @property
    def grade(self) -> tuple[Grade, tuple[str, ...]]:
        """Verdict on the rig, and why it is not better."""
        few = [name for name, count in zip(self.names, self.shots, strict=True) if count < GOOD_SHOTS]
        reasons = [f"{', '.join(few)}: fewer than {GOOD_SHOTS} shots; take more from other places"] if few else []
        grade = Grade.USABLE if few else Grade.GOOD
        for name, left_px in zip(self.names, self.residuals_px, strict=True):
            if left_px > GOOD_PX:
                grade = Grade.NOT_ENOUGH if left_px > USABLE_PX else max(grade, Grade.USABLE, key=list(Grade).index)
                reasons.append(f"{name}: {left_px:.2f} px off; calibrate its lens anew, and hold the board still")
        return grade, tuple(reasons)

    def save(self, path: str | Path) -> None:
        """Write the rig as JSON."""
        content = {
            "format": FORMAT,
            "source": self.source,
            "created": self.created.isoformat(),
            "scale_std": self.scale_std,
            "covariance": self.covariance.tolist(),
            "cameras": [
                {
                    "name": name,
                    "camera": {key: getattr(camera, key) for key in _INTRINSICS} | {"dist": camera.dist.tolist()},
                    "cam_from_rig": pose.tolist(),
                    "residual_px": residual,
                    "shots": shots,
                }
                for name, camera, pose, residual, shots in zip(
                    self.names, self.cameras, self.cams_from_rig, self.residuals_px, self.shots, strict=True
                )
            ],
        }
        write_file(Path(path), f"{json.dumps(content, indent=1)}\n".encode())

    @classmethod
    def load(cls, path: str | Path) -> CameraRig:
        """The inverse of `save`.

        Raises:
            InputError: there is no such file, or it is damaged.
        """
        try:
            content: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
            if content.get("format") != FORMAT:
                raise ValueError(f"its format is {content.get('format')!r}, expected {FORMAT!r}")
            entries = content["cameras"]
            rig = cls(
                tuple(str(one["name"]) for one in entries),
                tuple(
                    Camera(**{key: one["camera"][key] for key in _INTRINSICS}, dist=np.array(one["camera"]["dist"]))
                    for one in entries
                ),
                np.array([orthonormalise(np.array(one["cam_from_rig"], dtype=np.float64)) for one in entries]),
                np.array(content["covariance"], dtype=np.float64),
                float(content["scale_std"]),
                residuals_px=tuple(float(one["residual_px"]) for one in entries),
                shots=tuple(int(one["shots"]) for one in entries),
                source=str(content["source"]),
                created=datetime.fromisoformat(content["created"]),
            )
            if rig.covariance.shape != (6 * len(entries), 6 * len(entries)):
                raise ValueError("its covariance does not have six rows for each camera")
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read ({error.strerror}); `arview station calibrate` writes it"
            ) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: is no rig of cameras, or is damaged ({error}); calibrate again") from error
        return rig

    def posed(self, paths: Mapping[str, Path]) -> reconstruction.SparseModel:
        """One picture of each camera, as a reconstruction without points in mm; cameras without one are left out."""
        chosen = [index for index, name in enumerate(self.names) if name in paths]
        photos = tuple(
            reconstruction.PosedPhoto(self.names[i], paths[self.names[i]], self.cameras[i], self.cams_from_rig[i])
            for i in chosen
        )
        rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in chosen]) if chosen else np.zeros(0, dtype=int)
        return reconstruction.SparseModel.without_points(photos, self.covariance[np.ix_(rows, rows)])


Shot = Mapping[str, Path]
"""Picture of each camera at one moment, by the camera's name."""


def rig_from_board(shots: Sequence[Shot], cameras: Mapping[str, Camera], board: Board) -> CameraRig:
    """The rig from a board that was held where two or more cameras see it at a time.

    Args:
        shots: at least three, with the board at different places.
        cameras: intrinsics of each camera.
        board: the board.

    Raises:
        InputError: a camera sees no board together with the others; the message names it.
    """
    names = tuple(cameras)
    finder = BoardFinder(board) if board.is_coded else PlainBoardFinder(board)
    seen: dict[tuple[int, int], BoardView] = {}
    for s, shot in enumerate(shots):
        for m, name in enumerate(names):
            if name in shot:
                found = finder.find(f"{name} {s + 1}", _gray(shot[name], cameras[name], name))
                if isinstance(found, BoardView):
                    seen[m, s] = found
    lenses = tuple(require_brown(cameras[name], name) for name in names)
    starts = {key: _pose_of_board(view, lenses[key[0]]) for key, view in seen.items()}
    rig_poses, boards = _linked(starts, names, len(shots))
    system = _BoardSystem(lenses, {key: view for key, view in seen.items() if key[1] in boards}, rig_poses, boards)
    for _ in range(ROUNDS):
        if system.step() < 1e-7:
            break
    residuals, counts = system.residuals()
    return CameraRig(
        names,
        lenses,
        np.array(system.cams_from_rig),
        system.covariance(),
        reconstruction.PRINT_STD,
        residuals_px=residuals,
        shots=counts,
        source=f"{board} in {len(boards)} shots",
    )


def rig_from_part(shots: Sequence[Shot], cameras: Mapping[str, Camera], part: Part) -> CameraRig:
    """The rig from the part itself: each camera sees it in every shot, best at several places.

    Raises:
        InputError: the part is not found in the picture of a camera, or Brown's terms do not describe its lens; the
            message names it.
    """
    lenses = {name: require_brown(camera, name) for name, camera in cameras.items()}
    found = reconstruction.cameras_from_part(shots, lenses, part)
    return CameraRig(
        tuple(lenses),
        tuple(lenses.values()),
        found.cams_from_rig,
        found.covariance,
        found.scale_std,
        residuals_px=found.residuals_px,
        shots=(len(shots),) * len(cameras),
        source=f"part {part.name} in {len(shots)} shots",
    )


def _gray(path: Path, camera: Camera, name: str) -> NDArray[np.uint8]:
    """The picture of a camera in grey."""
    picture = reconstruction.read_photo(path)
    if picture.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{path}: is {picture.shape[1]}×{picture.shape[0]} px, but the camera {name} has"
            f" {camera.width}×{camera.height}; calibrate the lens at the size that is used"
        )
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))


def _pose_of_board(view: BoardView, camera: Camera) -> Array:
    """``cam_from_board`` (4,4) of one picture: of the two poses of a plane the one that fits better."""
    rays = np.ascontiguousarray(camera.unproject(view.pixels)[:, :2])
    _, turns, shifts, _ = cv2.solvePnPGeneric(view.points_in_board, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return rigid(cv2.Rodrigues(turns[0])[0], np.asarray(shifts[0]).ravel())


def _linked(
    starts: Mapping[tuple[int, int], Array], names: Sequence[str], count: int
) -> tuple[list[Array], dict[int, Array]]:
    """Approximate ``cam_from_rig`` of all cameras, in the frame of the first, and ``rig_from_board`` of shots."""
    cams: dict[int, Array] = {0: np.eye(4)}
    boards: dict[int, Array] = {}
    for _ in range(len(names) + count):
        for (m, s), cam_from_board in starts.items():
            if m in cams and s not in boards:
                boards[s] = invert(cams[m]) @ cam_from_board
            elif s in boards and m not in cams:
                cams[m] = cam_from_board @ invert(boards[s])
    missing = [name for m, name in enumerate(names) if m not in cams]
    if missing or len(names) < 2 or not boards:
        who = ", ".join(missing) or ", ".join(names) or "no camera"
        raise InputError(f"{who}: sees the board in no shot together with the other cameras; hold it where both see it")
    return [cams[m] for m in range(len(names))], boards


class _BoardSystem:
    """Poses of cameras and boards that are adjusted together."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        seen: Mapping[tuple[int, int], BoardView],
        cams_from_rig: Sequence[Array],
        rig_from_boards: Mapping[int, Array],
    ) -> None:
        self.cameras, self.seen = cameras, seen
        self.cams_from_rig, self.boards = list(cams_from_rig), dict(rig_from_boards)
        self.order = {s: len(cameras) + k for k, s in enumerate(self.boards)}
        self.sigma_px = 1.0

    def _rows(self, m: int, s: int) -> tuple[Array, Array, Array]:
        """Residuals (2N,), and derivatives (2N,6) by the twists of camera and board."""
        view, camera, pose = self.seen[m, s], self.cameras[m], self.cams_from_rig[m]
        in_rig = apply(self.boards[s], view.points_in_board)
        in_cam = apply(pose, in_rig)
        left = (view.pixels - camera.project(in_cam)).ravel()
        by_cam = camera.slopes(in_cam)
        by_rig = by_cam @ pose[:3, :3]

        def by_twist(points: Array, by_point: Array) -> Array:
            rows = np.concatenate([np.cross(points[:, None], by_point), by_point], axis=2)
            return np.asarray(rows.reshape(-1, 6))

        return left, by_twist(in_cam, by_cam), by_twist(in_rig, by_rig)

    def _normal(self) -> tuple[Array, Array]:
        """Normal matrix and right side of all twists, rotations first by cameras and then by boards."""
        size = 6 * (len(self.cameras) + len(self.boards))
        hessian, right = np.zeros((size, size)), np.zeros(size)
        every = []
        for m, s in self.seen:
            left, by_cam, by_board = self._rows(m, s)
            every.append(left)
            weights = tukey_weights(left / (2.0 * self.sigma_px))
            weights /= self.sigma_px**2 + 0.5 * len(left) * COMMON_PX**2
            at = np.r_[6 * m : 6 * m + 6, 6 * self.order[s] : 6 * self.order[s] + 6]
            rows = np.concatenate([by_cam, by_board], axis=1)
            hessian[np.ix_(at, at)] += (rows * weights[:, None]).T @ rows
            right[at] += rows.T @ (weights * left)
        self.sigma_px = max(MIN_SIGMA_PX, robust_sigma(np.concatenate(every)))
        return hessian, right

    def step(self) -> float:
        """One round of Gauss-Newton; the largest element of its step, rad or m."""
        hessian, right = self._normal()
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
        twists = scale * (np.linalg.pinv(hessian * np.outer(scale, scale), 1e-9, hermitian=True) @ (scale * right))
        for m in range(len(self.cameras)):
            self.cams_from_rig[m] = orthonormalise(exp_se3(twists[6 * m : 6 * m + 6]) @ self.cams_from_rig[m])
        for s, k in self.order.items():
            self.boards[s] = orthonormalise(exp_se3(twists[6 * k : 6 * k + 6]) @ self.boards[s])
        return float(np.abs(twists.reshape(-1, 2, 3) * [[[1.0], [1e-3]]]).max())

    def covariance(self) -> Array:
        """(6M,6M) of the cameras' twists, in the frame in which they vary least together."""
        hessian, _ = self._normal()
        n = 6 * len(self.cameras)
        inner = np.linalg.inv(hessian[n:, n:])
        reduced = hessian[:n, :n] - hessian[:n, n:] @ inner @ hessian[n:, :n]
        distance = float(np.mean([np.linalg.norm(pose[:3, 3]) for pose in self.cams_from_rig])) or 1.0
        scale = np.tile(np.repeat([1.0 / distance, 1.0], 3), len(self.cameras))
        scaled = reduced * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
        # The six smallest belong to motions of the whole rig, which nothing determines.
        inverse = (vectors[:, 6:] / values[6:]) @ vectors[:, 6:].T
        return np.asarray(inverse * np.outer(scale, scale))

    def residuals(self) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Robust standard deviation of the corners, and number of shots, of each camera."""
        left: list[list[Array]] = [[] for _ in self.cameras]
        for m, s in self.seen:
            left[m].append(self._rows(m, s)[0])
        return tuple(robust_sigma(np.concatenate(one)) for one in left), tuple(len(one) for one in left)
