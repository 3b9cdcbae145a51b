"""Joint adjustment: one focal length and the poses of many frames, from the edges of the part.

Bundle adjustment over point-to-line residuals. The unknowns of a frame are eliminated (Schur complement; Triggs et al.,
"Bundle adjustment: a modern synthesis", 2000), so that a system of the camera alone is left. The standard uncertainty
is that of a delete-one-group jackknife: residuals within one frame are correlated, and so are those on one edge of the
part in all frames (Bell and McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
samples", 2002; groups in two ways: Cameron, Gelbach and Miller 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array
from arview.refinement import (
    STRENGTH_HALF,
    EdgeProfiles,
    PartView,
    ProjectedLines,
    apply_twist,
    measure_edges,
    nearest_view,
    project_lines,
)
from arview.tracking.self_calibration.edge_lines import (
    POSE_COLUMNS,
    EdgeEquations,
    edge_equations,
    line_labels,
)
from arview.tracking.self_calibration.frame_set import CalibrationFrame

LOG_FOCAL = 0
"""Place of the logarithm of the focal length among the unknowns of the camera."""


SPREADS_PX: tuple[float, ...] = (6.0, 3.0, 1.5, 1.0, 0.7, 0.5)
"""Expected distance of predicted from true edges in each round; all edges are measured anew in each."""
REACH = 12
"""Samples to either side of an edge."""
STEP_PX = 1.0
"""Distance of the samples across an edge."""
THRESHOLD = 3.0
"""Weakest step used, grey levels over two pixels."""
UPDATES = 4
"""Gauss-Newton steps of a round."""
MAX_FOCAL_STEP = 0.15
"""Largest change of the logarithm of the focal length in one step."""
SMOOTH_WEIGHT = 0.3
"""Weight of points on no sharp edge."""
SIGMA_PX = 0.7
"""Standard deviation of a single edge point."""
CORRELATED_POINTS = 8.0
"""Neighbouring points that share one error; only sets the weight against what is known before."""
FOCAL_SIGMA = 0.5
"""Standard deviation of the logarithm of the focal length before the estimation."""
CENTER_SIGMA = 0.01
"""Standard deviation of the principal point before the estimation, as a share of the picture's longer side."""
K1_SIGMA = 0.05
"""Standard deviation of the radial distortion before the estimation."""
LINE_POINTS = 4
"""Edge points of a line that counts."""
MIN_POINTS = 40
"""Measured edge points that a frame must have."""
SIGNIFICANCE = 5.0
"""Standard uncertainties by which the distortion must differ from none to be kept."""
CELL_SHARE = 0.05
"""Rounding of the place of edges that are taken for one line, in diameters."""
FLOOR = 0.003
"""Smallest relative standard uncertainty, for what the model of the edges leaves out."""


class Adjusted(NamedTuple):
    """Result of an adjustment.

    Attributes:
        camera: with the estimated focal length, the nominal principal point, and distortion where it is determined.
        log_focal_std: standard uncertainty of the logarithm of the focal length.
        used: indices of the frames used.
        rms_px: weighted root mean square of the residuals.
    """

    camera: Camera
    log_focal_std: float
    used: list[int]
    rms_px: float


@dataclass
class _Measured:
    """Edges of one frame, measured at some pose."""

    points: NDArray[np.float32]
    tangents: NDArray[np.float32]
    kinds: NDArray[np.uint8]
    lines: ProjectedLines
    profiles: EdgeProfiles


class FocalAdjustment:
    """Joint adjustment of the frames of one part.

    Args:
        part: the part in the form of the kernels.
        guess: camera before the estimation, with equal focal lengths.
    """

    def __init__(self, part: PartView, guess: Camera) -> None:
        self.guess = guess
        self._part = part
        self._diameter_mm = part.views.diameter_mm
        longer_px = max(guess.width, guess.height)
        sigmas = np.array([FOCAL_SIGMA, CENTER_SIGMA * longer_px, CENTER_SIGMA * longer_px, K1_SIGMA])
        self._prior = np.diag(1.0 / sigmas**2)
        # Weight of a residual of one pixel against what is known before.
        self._weight = 1.0 / (SIGMA_PX**2 * CORRELATED_POINTS)

    def information(self, frame: CalibrationFrame, camera: Camera) -> float:
        """Information of one frame alone on the logarithm of the focal length, all else of the camera being known."""
        pose = frame.pose_at(camera.fx)
        spread_px = SPREADS_PX[1]
        equations = self._equations(frame, self._measure(frame, pose, camera, spread_px), pose, camera, spread_px)
        if np.count_nonzero(equations.weights) < MIN_POINTS:
            return 0.0
        reduced, _, _, _ = self._reduced(equations)
        return float(reduced[LOG_FOCAL, LOG_FOCAL])

    def lines(self, frame: CalibrationFrame, camera: Camera) -> int:
        """Number of straight lines of the part that a frame shows with `LINE_POINTS` edge points or more."""
        found = self._measure(frame, frame.pose_at(camera.fx), camera, SPREADS_PX[-1])
        tangents = found.tangents.astype(np.float64)
        labels = line_labels(found.points.astype(np.float64), tangents, self._diameter_mm, CELL_SHARE)
        return int(np.count_nonzero(np.unique(labels, return_counts=True)[1] >= LINE_POINTS))

    def solve(self, frames: Sequence[CalibrationFrame], start: Camera) -> Adjusted | None:
        """Adjust the focal length and the poses of some frames, from the camera ``start``; None without an edge.

        Principal point and distortion are adjusted as well, so that the uncertainty of the focal length holds whatever
        they are. The principal point is not kept, because edges tell it badly and it only shifts the poses.
        """
        found = self._adjust(frames, start)
        if found is None:
            return None
        camera, poses, used, rms_px = found
        std = np.sqrt(np.diag(self._covariance(frames, used, poses, camera, SPREADS_PX[-1])))
        is_distorted = abs(camera.dist[0]) > SIGNIFICANCE * std[3]
        camera = replace(
            camera,
            cx=self.guess.cx,
            cy=self.guess.cy,
            dist=np.array([camera.dist[0] if is_distorted else 0.0, 0.0, 0.0, 0.0, 0.0]),
        )
        return Adjusted(camera, float(max(std[LOG_FOCAL], FLOOR)), used, rms_px)

    def _adjust(
        self, frames: Sequence[CalibrationFrame], camera: Camera
    ) -> tuple[Camera, list[Array], list[int], float] | None:
        """Camera, poses, indices of the frames used, and residuals after several rounds; None without an edge."""
        poses = [frame.pose_at(camera.fx) for frame in frames]
        used = list(range(len(frames)))
        rms_px = float("nan")
        for spread_px in SPREADS_PX:
            measured = {i: self._measure(frames[i], poses[i], camera, spread_px) for i in used}
            for _ in range(UPDATES):
                system = {}
                for i in used:
                    equations = self._equations(frames[i], measured[i], poses[i], camera, spread_px)
                    if np.count_nonzero(equations.weights) >= MIN_POINTS:
                        system[i] = equations
                used = list(system)
                if not used:
                    return None
                camera, stepped = self._step(camera, [poses[i] for i in used], list(system.values()))
                for i, pose in zip(used, stepped, strict=True):
                    poses[i] = pose
                weights = np.concatenate([e.weights for e in system.values()])
                residuals = np.concatenate([e.residuals for e in system.values()])
                rms_px = float(np.sqrt((weights * residuals**2).sum() / weights.sum()))
        return camera, [poses[i] for i in used], used, rms_px

    def _measure(self, frame: CalibrationFrame, pose: Array, camera: Camera, spread_px: float) -> _Measured:
        """Edges of the nearest guide view, measured in a frame at a pose (4,4)."""
        arrays = self._part.resolvable
        view = nearest_view(arrays.directions, pose)
        chosen = slice(arrays.edge_starts[view], arrays.edge_starts[view + 1])
        points, tangents, kinds = arrays.edge_points[chosen], arrays.edge_tangents[chosen], arrays.edge_kinds[chosen]
        lines = project_lines(points, tangents, True, pose, frame.intrinsics(camera), 0.01 * self._diameter_mm)
        reach = max(5, round(min(REACH, 2.5 * spread_px + 2.0)))
        profiles = measure_edges(frame.gray, lines, reach, STEP_PX, THRESHOLD, 1.0)
        return _Measured(points, tangents, kinds, lines, profiles)

    def _equations(
        self, frame: CalibrationFrame, measured: _Measured, pose: Array, camera: Camera, spread_px: float
    ) -> EdgeEquations:
        """Equations of a frame; the columns of the principal point are in pixels of the whole frame."""
        equations = edge_equations(
            measured.points,
            measured.kinds,
            pose,
            frame.intrinsics(camera),
            measured.lines,
            measured.profiles,
            spread_px,
            STRENGTH_HALF,
            SMOOTH_WEIGHT,
        )
        equations.jacobian[:, POSE_COLUMNS + 1 : POSE_COLUMNS + 3] *= frame.scale
        return equations

    def _reduced(self, equations: EdgeEquations) -> tuple[Array, Array, Array, Array]:
        """System of the camera alone (4,4), (4,), after the pose is eliminated.

        Also returns the inverse (6,6) of the pose's part, and the coupling (6,4).
        """
        weighted = equations.jacobian * (self._weight * equations.weights)[:, None]
        normal, right = weighted.T @ equations.jacobian, weighted.T @ equations.residuals
        own = normal[:POSE_COLUMNS, :POSE_COLUMNS]
        scale = np.sqrt(np.maximum(np.diag(own), 1e-12))
        # Views that leave a degree of freedom open, such as a round part, must not stop the others.
        inverse = np.linalg.inv(own / np.outer(scale, scale) + 1e-9 * np.eye(POSE_COLUMNS)) / np.outer(scale, scale)
        coupling = normal[:POSE_COLUMNS, POSE_COLUMNS:]
        reduced = normal[POSE_COLUMNS:, POSE_COLUMNS:] - coupling.T @ inverse @ coupling
        return reduced, right[POSE_COLUMNS:] - coupling.T @ inverse @ right[:POSE_COLUMNS], inverse, coupling

    def _step(self, camera: Camera, poses: list[Array], system: list[EdgeEquations]) -> tuple[Camera, list[Array]]:
        """Camera and poses after one Gauss-Newton step."""
        parts = [self._reduced(equations) for equations in system]
        offset = np.array(
            [np.log(camera.fx / self.guess.fx), camera.cx - self.guess.cx, camera.cy - self.guess.cy, camera.dist[0]]
        )
        matrix = self._prior + np.sum([part[0] for part in parts], axis=0)
        right = self._prior @ offset + np.sum([part[1] for part in parts], axis=0)
        shared = -np.linalg.solve(matrix, right)
        if abs(shared[LOG_FOCAL]) > MAX_FOCAL_STEP:
            shared *= MAX_FOCAL_STEP / abs(shared[LOG_FOCAL])
        factor = float(np.exp(shared[LOG_FOCAL]))
        moved = []
        for pose, equations, (_, _, inverse, coupling) in zip(poses, system, parts, strict=True):
            weighted = equations.jacobian[:, :POSE_COLUMNS] * (self._weight * equations.weights)[:, None]
            twist = -inverse @ (weighted.T @ equations.residuals + coupling @ shared)
            pose = pose.copy()
            pose[2, 3] *= factor
            moved.append(apply_twist(pose, twist))
        return self._moved_camera(camera, shared), moved

    def _moved_camera(self, camera: Camera, shared: Array) -> Camera:
        """The camera after a step (4,) of its unknowns."""
        factor = float(np.exp(shared[LOG_FOCAL]))
        k1 = camera.dist[0] + shared[3]
        return replace(
            camera,
            fx=camera.fx * factor,
            fy=camera.fy * factor,
            cx=camera.cx + float(shared[1]),
            cy=camera.cy + float(shared[2]),
            dist=np.array([k1, 0.0, 0.0, 0.0, 0.0]),
        )

    def _covariance(
        self, frames: Sequence[CalibrationFrame], used: list[int], poses: list[Array], camera: Camera, spread_px: float
    ) -> Array:
        """Covariance (4,4) of the unknowns of the camera."""
        rows, scores, labels, owners = [], [], [], []
        for i, pose in zip(used, poses, strict=True):
            measured = self._measure(frames[i], pose, camera, spread_px)
            equations = self._equations(frames[i], measured, pose, camera, spread_px)
            is_used = equations.weights > 0.0
            if not is_used.any():
                continue
            _, _, inverse, coupling = self._reduced(equations)
            jacobian = equations.jacobian[is_used]
            # Columns of the camera after elimination of the pose.
            own = jacobian[:, POSE_COLUMNS:] - jacobian[:, :POSE_COLUMNS] @ (inverse @ coupling)
            weight = self._weight * equations.weights[is_used]
            rows.append(own * np.sqrt(weight)[:, None])
            scores.append(own * (weight * equations.residuals[is_used])[:, None])
            tangents = measured.tangents[is_used].astype(np.float64)
            labels.append(
                line_labels(measured.points[is_used].astype(np.float64), tangents, self._diameter_mm, CELL_SHARE)
            )
            owners.append(np.full(len(weight), i))
        row, score = np.concatenate(rows), np.concatenate(scores)
        information = row.T @ row + self._prior
        # What is known before counts as one more measurement.
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        parts: list[Array] = [covariance @ self._prior @ covariance]
        for group in (np.concatenate(owners), np.concatenate(labels)):
            parts.append(_jackknife(row, score, information, group))
        return np.asarray(np.sum(parts, axis=0))


def _jackknife(row: Array, score: Array, information: Array, group: NDArray[np.int64]) -> Array:
    """Covariance (4,4) of a delete-one-group jackknife, to first order.

    Args:
        row: (N,4) weighted rows of the equations.
        score: (N,4) gradient of each of them.
        information: (4,4) of all together.
        group: (N,) labels; errors are correlated within one and independent between two.
    """
    _, index = np.unique(group, return_inverse=True)
    count = int(index.max()) + 1
    sums = np.stack([np.bincount(index, score[:, k], count) for k in range(score.shape[1])], axis=1)
    products = row[:, :, None] * row[:, None, :]
    own = np.zeros((count, row.shape[1], row.shape[1]))
    np.add.at(own, index, products)
    moved = np.linalg.solve(information - own, sums[:, :, None])[:, :, 0]
    return np.asarray((count - 1) / count * moved.T @ moved)
