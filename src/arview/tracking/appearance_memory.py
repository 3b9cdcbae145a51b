"""Learned views: how the part looked where it was tracked well, kept so that it is found again sooner after a loss.

A view is a small picture of the part with its silhouette, of a fixed size, and the pose it was seen at. Kept views are
looked for by masked normalised cross-correlation: with all places of a very small picture at once as a product of two
matrices, at several rolls and distances; then the best places by a pattern search at twice that resolution.
What is found is a rough pose and no more: whether the part is there is for the detector to say.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.atomic import replacing
from arview.core.kernel import kernel
from arview.errors import InputError, MismatchError, OutputError
from arview.geometry import Array, are_near, exp_so3, rigid, rolls_between, turns_to_rays
from arview.guideviews import GuideViewSet
from arview.tracking.estimate import Estimate

FORMAT_VERSION = 1
SIDE, SIDE_DIAMETER = 24, 21.0
"""Side of a kept picture, and the part's diameter in it, px."""
FINE_DIAMETER, FINE_PAD = 20.0, 6
"""The part's diameter in the pictures of the second search, and their margins, px."""
WINDOW, WINDOW_DIAMETER = 8, 8.0
"""Side of the windows of the first search, and the part's diameter in them, px."""
NOISE = 4.0
"""Deviation in grey levels below which a picture shows nothing."""
CHANNELS = 3
VIEWS_A_PLACE = 4
"""So many of the first search are looked at closer."""
SEARCHED, STARTS_A_PLACE = 24, 3
"""So many of these are improved, and in one place."""
HOPPED, HOPS, HOP_DEG = 3, 6, 40.0
"""For the best of those so many other views, from directions no farther off, are tried in the same place."""


@dataclass(frozen=True)
class AppearanceMemoryOptions:
    """Options of the learned views.

    Attributes:
        max_views: kept at most; 4 kB each in a file, 80 kB in memory.
        view_step_deg: a direction differing by more from all kept is a new view.
        learn_every: frames between two looks whether the direction is new.
        look_every: at least so many frames are between two looks whether the part looks otherwise than kept.
        same_look: correlation with the nearest kept view below which it does.
        least_quality, least_in_picture: of a tracked pose to be learned from.
        least_support: share of the usual support of its outline.
        steady_frames: it must have been so for so many frames in a row.
        roll_steps: rolls looked for, in a full turn.
        stretch: ratio of neighbouring distances that are looked for.
        near_views, near_deg: when only what is near is asked for, so many kept views are looked for, no farther from
            the last known direction than this, at rolls no farther from the last known roll.
        near_stretch: and at distances within this ratio.
        least_score, least_share: correlation of a proposal, and its share of the best one's.
        windows: the best windows of the first search that are looked at, for each distance.
        proposals: at most so many.
    """

    max_views: int = 48
    view_step_deg: float = 8.0
    learn_every: int = 4
    look_every: int = 16
    same_look: float = 0.75
    least_quality: float = 0.8
    least_in_picture: float = 0.75
    least_support: float = 0.85
    steady_frames: int = 5
    roll_steps: int = 20
    stretch: float = 1.2
    near_views: int = 12
    near_deg: float = 45.0
    near_stretch: float = 1.5
    least_score: float = 0.55
    least_share: float = 0.8
    windows: int = 18
    proposals: int = 2

    def __post_init__(self) -> None:
        if self.max_views < 1 or self.roll_steps < 4 or self.proposals < 1:
            raise InputError("learned views: expected max_views ≥ 1, roll_steps ≥ 4 and proposals ≥ 1")
        if not self.stretch > 1.0:
            raise InputError(f"learned views: stretch = {self.stretch}, expected more than 1")


@dataclass(frozen=True)
class Proposal:
    """A rough pose: correlation with a kept view, ``cam_from_model`` (4,4) mm, and which view."""

    score: float
    cam_from_model: Array
    view: int


class AppearanceMemory:
    """A bounded number of views of one part, learned while it was tracked.

    Args:
        views: guide views of the part; they say where its silhouette is.
        camera: intrinsics of the frames; kept views serve with any camera.
        options: see AppearanceMemoryOptions.
    """

    def __init__(self, views: GuideViewSet, camera: Camera, options: AppearanceMemoryOptions | None = None) -> None:
        self.options = o = options or AppearanceMemoryOptions()
        self.views = views
        self.camera = camera
        self._focal = 0.5 * (camera.fx + camera.fy)
        self._contour_start = np.array(views.arrays["contour_start"])
        self._contour_points = views.arrays["contour_points"]
        most = o.max_views
        self._count = 0
        self._rotations = np.zeros((most, 3, 3))
        self._pictures = np.zeros((most, SIDE, SIDE, CHANNELS), dtype=np.uint8)
        self._masks = np.zeros((most, SIDE, SIDE), dtype=np.uint8)
        self._born = np.zeros(most, dtype=np.int64)
        self._templates = np.zeros((most, o.roll_steps, WINDOW * WINDOW), dtype=np.float32)
        self._weights = np.zeros((most, o.roll_steps, WINDOW * WINDOW), dtype=np.float32)
        self._frame = self._steady = self._looked = self._added = 0
        self._usual_support = 0.0

    def __len__(self) -> int:
        return self._count

    @property
    def rotations(self) -> Array:
        """(N,3,3) rotations of the kept views from the model, as if seen along the optical axis."""
        return self._rotations[: self._count]

    # --- Learning ---------------------------------------------------------------------------------------

    def learn(self, image: NDArray[np.uint8], estimate: Estimate, is_sure: bool) -> bool:
        """Keep the part as it looks in a frame, if it is tracked well and shows something new; True when kept.

        Args:
            image: (H,W,3) uint8 RGB.
            estimate: of the tracker in this frame.
            is_sure: the part is tracked and nothing speaks against it.
        """
        o = self.options
        evidence = estimate.evidence
        self._frame += 1
        # A hand over the part hides outline that was seen before.
        self._usual_support = max(0.99 * self._usual_support, evidence.contour_support)
        is_clear = evidence.contour_support >= o.least_support * self._usual_support
        is_good = estimate.quality >= o.least_quality and evidence.points_in_picture >= o.least_in_picture
        self._steady = self._steady + 1 if is_sure and is_clear and is_good else 0
        if self._steady < o.steady_frames or self._frame % o.learn_every:
            return False
        cam_from_model = estimate.cam_from_model
        cosines = self.rotations[:, 2] @ self._along_axis(cam_from_model)[0][2]
        is_new = self._count == 0 or cosines.max() < np.cos(np.deg2rad(o.view_step_deg))
        if not is_new and self._frame - self._looked < o.look_every:
            return False
        self._looked = self._frame
        return self._keep(image, cam_from_model, is_new)

    def _keep(self, image: NDArray[np.uint8], cam_from_model: Array, is_new: bool) -> bool:
        """Cut the part out; keep it unless one kept from about that direction looks the same."""
        cut = self._cut(image, cam_from_model)
        if cut is None:
            return False
        picture, mask = cut
        rotation, _, _ = self._along_axis(cam_from_model)
        if not is_new:
            cosines = self.rotations[:, 2] @ rotation[2]
            near = np.flatnonzero(cosines > np.cos(np.deg2rad(self.options.view_step_deg)))
            middle = 0.5 * (SIDE - 1)
            seen = picture.astype(np.float32)
            for k in near:
                start = np.array([middle, middle, rolls_between(self._rotations[k], rotation), 1.0])
                score = search(seen, self._pictures[k], self._masks[k], start, np.array([1.0, 1.0, 0.1, 0.05]), 1)[0]
                if score >= self.options.same_look:
                    return False
        self._add(rotation, picture, mask)
        return True

    def _along_axis(self, cam_from_model: Array) -> tuple[Array, Array, float]:
        """A pose's rotation (3,3) as if seen along the optical axis, unit ray (3,) to the centre, its distance mm."""
        center = cam_from_model[:3, :3] @ self.views.center_in_model + cam_from_model[:3, 3]
        distance_mm = float(np.sqrt(center @ center))
        ray = center / distance_mm
        return turns_to_rays(ray).T @ cam_from_model[:3, :3], ray, distance_mm

    def _cut(
        self, image: NDArray[np.uint8], cam_from_model: Array
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
        """The part (SIDE,SIDE,3) of a frame and its mask (SIDE,SIDE), 255 on the part; None where it is too small."""
        _, ray, distance_mm = self._along_axis(cam_from_model)
        u, v = self.camera.project(ray)
        half = 0.5 * SIDE / SIDE_DIAMETER * self._focal * self.views.diameter_mm / distance_mm
        if not np.isfinite(half + u + v) or 2.0 * half < SIDE / 2:
            return None
        left, top = round(u + 0.5 - half), round(v + 0.5 - half)
        side = round(2.0 * half)
        inside = np.s_[max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)]
        window = image[inside]
        if window.size == 0:
            return None
        above, before = max(-top, 0), max(-left, 0)
        below, behind = side - above - window.shape[0], side - before - window.shape[1]
        if above + before + below + behind > 0:
            window = cv2.copyMakeBorder(window, above, below, before, behind, cv2.BORDER_REPLICATE)
        picture = cv2.resize(window, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        mask = self._silhouette(cam_from_model)
        # What lies outside the frame was not seen.
        seen = np.zeros((side, side), dtype=np.uint8)
        seen[above : side - below, before : side - behind] = 255
        mask &= cv2.resize(seen, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
        if np.count_nonzero(mask) < SIDE:
            return None
        return np.asarray(picture), mask

    def _silhouette(self, cam_from_model: Array) -> NDArray[np.uint8]:
        """(SIDE,SIDE) 255 inside the outline of the nearest guide view at a pose.

        The outline's points are so dense at this size that, made thicker, they close; what the outside cannot reach
        is the part.
        """
        index = self.views.nearest_index(cam_from_model)
        first, last = self._contour_start[index : index + 2]
        points = self._contour_points[first:last] @ cam_from_model[:3, :3].T + cam_from_model[:3, 3]
        center = cam_from_model[:3, :3] @ self.views.center_in_model + cam_from_model[:3, 3]
        scale = SIDE_DIAMETER / self.views.diameter_mm * np.sqrt(center @ center)
        places = scale * (points[:, :2] / points[:, 2:] - center[:2] / center[2]) + 0.5 * (SIDE - 1)
        lines = np.zeros((SIDE + 2, SIDE + 2), dtype=np.uint8)
        u, v = np.clip(np.round(places) + 1, 0, SIDE + 1).astype(np.int64).T
        lines[v, u] = 1
        lines = cv2.dilate(lines, np.ones((3, 3), dtype=np.uint8))
        lines[[0, -1]] = 0
        lines[:, [0, -1]] = 0
        outside = np.zeros((SIDE + 4, SIDE + 4), dtype=np.uint8)
        outside[1:-1, 1:-1] = lines
        cv2.floodFill(lines, outside, (0, 0), 2)
        part = np.where(lines == 2, 0, 255).astype(np.uint8)
        return np.ascontiguousarray(cv2.erode(part, np.ones((3, 3), dtype=np.uint8))[1:-1, 1:-1])

    def _add(self, rotation: Array, picture: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
        """Keep a view; when there are too many, the older of the two that are nearest in direction goes."""
        place = self._count
        if place == self.options.max_views:
            directions = self.rotations[:, 2]
            nearness = directions @ directions.T
            np.fill_diagonal(nearness, -1.0)
            nearest = np.maximum(nearness.max(axis=1), directions @ rotation[2])
            crowded = np.flatnonzero(nearest >= nearest.max() - 1e-6)
            place = int(crowded[np.argmin(self._born[crowded])])
        self._count = max(self._count, place + 1)
        self._rotations[place] = rotation
        self._pictures[place] = picture
        self._masks[place] = mask
        self._born[place] = self._added = self._added + 1
        self._templates[place], self._weights[place] = _rolled(picture, mask, self.options.roll_steps)

    # --- Looking ----------------------------------------------------------------------------------------

    def propose(self, image: NDArray[np.uint8], near: Array | None = None) -> list[Proposal]:
        """Rough poses of the part in a frame, best first, none sure.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            near: (4,4) ``cam_from_model`` last known: only views, rolls and distances near it are looked for, in
                all places. None: all of the declared range.
        """
        o = self.options
        chosen, distances_mm = self._chosen(near)
        if not len(chosen) or not len(distances_mm):
            return []
        kept, rolls = chosen.T
        windows = _Windows(self._templates[kept, rolls], self._weights[kept, rolls], kept)
        pictures = self._pictures_at(image, distances_mm)
        starts, views, levels = [], [], []
        for level, picture in enumerate(pictures):
            for place, template in windows.best(picture, o.windows):
                view, step = chosen[template]
                roll = 2.0 * np.pi * step / o.roll_steps
                starts.append([*place, roll, FINE_DIAMETER / SIDE_DIAMETER])
                views.append(view)
                levels.append(level)
        return self._improved(pictures, np.array(starts), np.array(views), np.array(levels))

    def _chosen(self, near: Array | None) -> tuple[NDArray[np.intp], Array]:
        """Which views and rolls (T,2) are looked for, and at which distances (D,) mm."""
        o = self.options
        low, high = self.views.view_range.distance_mm
        low, high = 0.9 * low, 1.1 * high
        rolls = 2.0 * np.pi * np.arange(o.roll_steps) / o.roll_steps
        if near is None:
            is_chosen = np.ones((self._count, o.roll_steps), dtype=bool)
        else:
            rotation, _, distance_mm = self._along_axis(near)
            cosine = np.cos(np.deg2rad(o.near_deg))
            cosines = self.rotations[:, 2] @ rotation[2]
            is_near = (cosines > cosine) & (cosines >= np.sort(cosines)[-o.near_views :][:1].min(initial=1.0))
            last = rolls_between(self.rotations, rotation)
            is_chosen = is_near[:, None] & (np.cos(rolls - last[:, None]) > cosine)
            low, high = max(low, distance_mm / o.near_stretch), min(high, distance_mm * o.near_stretch)
        count = int(np.ceil(np.log(max(high / low, 1.0)) / np.log(o.stretch))) + 1
        return np.argwhere(is_chosen), np.geomspace(low, max(high, low), count)

    def _pictures_at(self, image: NDArray[np.uint8], distances_mm: Array) -> list[NDArray[np.float32]]:
        """Frames (H,W,3) in which the part at these distances is FINE_DIAMETER across, with a margin."""
        pictures = []
        width, height = self.camera.width, self.camera.height
        # Halves are quickly made, and nearly as good to go on from.
        source = image
        for distance_mm in distances_mm[::-1]:
            scale = min(1.0, FINE_DIAMETER * distance_mm / (self._focal * self.views.diameter_mm))
            while scale * width < 0.35 * source.shape[1]:
                source = cv2.resize(source, (source.shape[1] // 2, source.shape[0] // 2), interpolation=cv2.INTER_AREA)
            small = cv2.resize(source, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
            padded = cv2.copyMakeBorder(small, FINE_PAD, FINE_PAD, FINE_PAD, FINE_PAD, cv2.BORDER_REPLICATE)
            pictures.append(padded.astype(np.float32))
        return pictures[::-1]

    def _improved(
        self,
        pictures: list[NDArray[np.float32]],
        starts: Array,
        views: NDArray[np.intp],
        levels: NDArray[np.intp],
    ) -> list[Proposal]:
        """The best of the first search improved, best first, apart from each other."""
        o = self.options
        none = np.zeros(4)
        first = np.array(
            [
                search(pictures[level], self._pictures[view], self._masks[view], start, none, 0)[0]
                for start, view, level in zip(starts, views, levels, strict=True)
            ]
        )
        # In diameters of the part at its distance.
        widths = np.array([picture.shape[1] - 2 * FINE_PAD for picture in pictures])[levels]
        spots = (starts[:, :2] - FINE_PAD) / widths[:, None]
        reach = (0.3 * FINE_DIAMETER / widths) ** 2
        chosen: list[int] = []
        for k in np.argsort(-first):
            if len(chosen) == SEARCHED:
                break
            apart = ((spots[chosen] - spots[k]) ** 2).sum(axis=1)
            if np.count_nonzero(apart < reach[k]) < STARTS_A_PLACE:
                chosen.append(int(k))
        steps = np.array([1.0, 1.0, np.pi / o.roll_steps, 0.5 * (o.stretch - 1.0)])
        found = []
        for k in chosen:
            level, view = int(levels[k]), int(views[k])
            score, place = search(pictures[level], self._pictures[view], self._masks[view], starts[k], steps, 2)
            found.append((float(score), place, level, view))
        found.sort(key=lambda item: -item[0])
        found[:HOPPED] = [self._hopped(pictures[item[2]], *item) for item in found[:HOPPED]]
        found.sort(key=lambda item: -item[0])
        least = max(o.least_score, o.least_share * found[0][0]) if found else 0.0
        result: list[Proposal] = []
        for score, place, level, view in found:
            if score < least or len(result) == o.proposals:
                break
            proposal = Proposal(score, self._pose(pictures[level], view, place), view)
            if not any(self._same(proposal, other) for other in result):
                result.append(proposal)
        return result

    def _hopped(
        self, picture: NDArray[np.float32], score: float, place: Array, level: int, view: int
    ) -> tuple[float, Array, int, int]:
        """A find, or that of a kept view from a direction nearby if it fits better there."""
        best = (score, place, level, view)
        rotation = exp_so3(np.array([0.0, 0.0, place[2]])) @ self._rotations[view]
        cosines = self.rotations[:, 2] @ rotation[2]
        for k in np.argsort(-cosines)[: HOPS + 1]:
            if k == view or cosines[k] < np.cos(np.deg2rad(HOP_DEG)):
                continue
            start = place.copy()
            start[2] = rolls_between(self._rotations[k], rotation)
            score, there = search(picture, self._pictures[k], self._masks[k], start, np.array([1.0, 1.0, 0.1, 0.05]), 1)
            if score > best[0]:
                best = (float(score), there, level, int(k))
        return best

    def _pose(self, picture: NDArray[np.float32], view: int, found: Array) -> Array:
        """(4,4) of a view found at (u, v, roll, ratio of sizes) in a picture."""
        height, width = picture.shape[0] - 2 * FINE_PAD, picture.shape[1] - 2 * FINE_PAD
        scale = width / self.camera.width, height / self.camera.height
        u, v = ((found[k] - FINE_PAD + 0.5) / scale[k] - 0.5 for k in range(2))
        ray = self.camera.unproject(np.array([u, v]))
        ray /= np.linalg.norm(ray)
        real = self._focal * self.views.diameter_mm * np.sqrt(scale[0] * scale[1]) / (SIDE_DIAMETER * found[3])
        rotation = turns_to_rays(ray) @ exp_so3(np.array([0.0, 0.0, found[2]])) @ self._rotations[view]
        return rigid(rotation, ray * real - rotation @ self.views.center_in_model)

    def _same(self, a: Proposal, b: Proposal) -> bool:
        """Whether the detector would come from one to the other."""
        model_from_body = rigid(np.eye(3), self.views.center_in_model)
        poses = a.cam_from_model @ model_from_body, b.cam_from_model @ model_from_body
        return are_near(*poses, 0.15 * self.views.diameter_mm, 25.0)

    # --- Files ------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write the views to one file, oldest first, atomically. Raises OutputError."""
        order = np.argsort(self._born[: self._count])
        meta = {
            "format_version": FORMAT_VERSION,
            "model_name": self.views.model_name,
            "model_hash": self.views.model_hash,
        }
        try:
            with replacing(path) as file:
                np.savez_compressed(
                    file,
                    meta=np.array(json.dumps(meta)),
                    rotations=self._rotations[order],
                    pictures=self._pictures[order],
                    masks=self._masks[order],
                )
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error

    def load(self, path: Path) -> None:
        """Take over the views of a file instead of those kept.

        Raises:
            InputError: no such file, not learned views, damaged, or of another format version.
            MismatchError: they are of another model.
        """
        meta, arrays = _read(path)
        if meta.get("format_version") != FORMAT_VERSION:
            raise InputError(
                f"{path}: learned views of format {meta.get('format_version')}, this arview reads {FORMAT_VERSION}; "
                "delete the file to learn anew"
            )
        if meta.get("model_hash") != self.views.model_hash:
            raise MismatchError(
                f"{path}: learned views of model {meta.get('model_name')!r} ({str(meta.get('model_hash'))[:12]}), but "
                f"the part is {self.views.model_name!r} ({self.views.model_hash[:12]}); give another file"
            )
        self._count = 0
        for rotation, picture, mask in zip(arrays["rotations"], arrays["pictures"], arrays["masks"], strict=True):
            self._add(rotation, picture, mask)


class _Windows:
    """The first search: grey templates in all places.

    Args:
        templates: (T,W²) of mean 0 and unit norm under their weights.
        weights: (T,W²).
        views: (T,) that the templates are of, ascending.
    """

    def __init__(self, templates: NDArray[np.float32], weights: NDArray[np.float32], views: NDArray[np.intp]) -> None:
        self._firsts = np.flatnonzero(np.diff(views, prepend=-1))
        self._templates = np.ascontiguousarray(templates.T)
        self._weights = np.ascontiguousarray(weights.T)
        self._sums = self._weights.sum(axis=0)

    def best(self, picture: NDArray[np.float32], most: int) -> list[tuple[Array, int]]:
        """The best of a picture for the second search: (centre there (2,) px, template), one of each of a few views."""
        shrink = WINDOW_DIAMETER / FINE_DIAMETER
        width, height = round(picture.shape[1] * shrink), round(picture.shape[0] * shrink)
        if min(height, width) < WINDOW:
            return []
        small = cv2.resize(picture.mean(axis=2), (width, height), interpolation=cv2.INTER_AREA) - 128.0
        cut = np.lib.stride_tricks.sliding_window_view(small, (WINDOW, WINDOW))
        rows, columns = cut.shape[:2]
        windows = cut.reshape(rows * columns, -1)
        # Weighted sum of squares about the weighted mean, of each window under each template's mask.
        totals = windows @ self._weights
        squares = (windows * windows) @ self._weights
        totals *= totals
        totals /= self._sums
        squares -= totals
        np.maximum(squares, NOISE * NOISE * self._sums, out=squares)
        scores = windows @ self._templates
        scores /= np.sqrt(squares, out=squares)
        values = scores.max(axis=1).reshape(rows, columns)
        peaks = values >= cv2.dilate(values, np.ones((3, 3), dtype=np.uint8))
        order = np.argsort(-np.where(peaks, values, -1.0), axis=None)[:most]
        centers = np.stack([order % columns, order // columns], axis=1) + 0.5 * WINDOW
        places = centers * (np.array(picture.shape[1::-1]) / (width, height)) - 0.5
        found = []
        for place, row in zip(places, scores[order], strict=True):
            of_views = np.maximum.reduceat(row, self._firsts)
            for view in np.argsort(-of_views)[:VIEWS_A_PLACE]:
                first = self._firsts[view]
                found.append((place, int(first + np.argmax(row[first:] == of_views[view]))))
        return found


@kernel(fastmath=True)
def _correlation(image, picture, mask, u, v, roll, ratio):  # type: ignore[no-untyped-def]
    """Masked normalised correlation of a view with an image at a place, roll and ratio of sizes; all channels as one.

    What falls outside the image counts as not fitting.
    """
    height, width, channels = image.shape
    side = picture.shape[0]
    middle = 0.5 * (side - 1)
    c, s = ratio * np.cos(roll), ratio * np.sin(roll)
    count, sum_a, sum_b, sum_aa, sum_bb, sum_ab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    missed = 0.0
    for row in range(side):
        y0 = row - middle
        for column in range(side):
            if mask[row, column] == 0:
                continue
            x0 = column - middle
            x, y = u + c * x0 - s * y0, v + s * x0 + c * y0
            if x < 0.0 or y < 0.0 or x >= width - 1 or y >= height - 1:
                missed += channels
                continue
            ix, iy = int(x), int(y)
            ax, ay = x - ix, y - iy
            for k in range(channels):
                upper = image[iy, ix, k] + ax * (image[iy, ix + 1, k] - image[iy, ix, k])
                lower = image[iy + 1, ix, k] + ax * (image[iy + 1, ix + 1, k] - image[iy + 1, ix, k])
                a = upper + ay * (lower - upper) - 128.0
                b = np.float64(picture[row, column, k]) - 128.0
                count += 1.0
                sum_a += a
                sum_b += b
                sum_aa += a * a
                sum_bb += b * b
                sum_ab += a * b
    if count < 0.5 * (count + missed) or count < 1.0:
        return -1.0
    floor = count * NOISE * NOISE
    var_a = max(sum_aa - sum_a * sum_a / count, floor)
    var_b = max(sum_bb - sum_b * sum_b / count, floor)
    return (sum_ab - sum_a * sum_b / count) / np.sqrt(var_a * var_b) * count / (count + missed)


@kernel
def search(image, picture, mask, start, steps, halvings):  # type: ignore[no-untyped-def]
    """Pattern search (Hooke & Jeeves, 1961) for the best correlation of a view.

    Args:
        image: (H,W,3) float32.
        picture: (S,S,3) uint8 of the view; mask: (S,S), not 0 on the part.
        start, steps: (4,) u px, v px, roll rad, size in the image over size in the view.
        halvings: of the steps; after the last one the search ends at the first round without a gain.

    Returns:
        the best score and its (4,).
    """
    best = start.copy()
    top = _correlation(image, picture, mask, best[0], best[1], best[2], best[3])
    step = steps.copy()
    if not np.any(step > 0.0):
        return top, best
    left = halvings
    for _ in range(40):
        gained = False
        for k in range(4):
            for sign in (-1.0, 1.0):
                trial = best.copy()
                trial[k] += sign * step[k]
                score = _correlation(image, picture, mask, trial[0], trial[1], trial[2], trial[3])
                if score > top:
                    top, best, gained = score, trial, True
                    break
        if not gained:
            if left == 0:
                break
            left -= 1
            step *= 0.5
    return top, best


def _rolled(
    picture: NDArray[np.uint8], mask: NDArray[np.uint8], steps: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A view turned by full steps and made as small as the first search has it.

    Returns:
        grey templates (steps,W²), weighted, of mean 0 and unit norm; their weights (steps,W²).
    """
    shrink = SIDE_DIAMETER / WINDOW_DIAMETER
    on_part = (mask > 0).astype(np.float32)
    # Averages over the part alone, so that no background leaks in; the second channel is the weight.
    layers = cv2.GaussianBlur(np.dstack([picture.mean(axis=2) * on_part, on_part]), (0, 0), 0.4 * shrink)
    layers = layers.astype(np.float32)
    middle, small = 0.5 * (SIDE - 1), 0.5 * (WINDOW - 1)
    turned = np.empty((steps, WINDOW, WINDOW, 2), dtype=np.float32)
    for step in range(steps):
        roll = 2.0 * np.pi * step / steps
        c, s = shrink * np.cos(roll), shrink * np.sin(roll)
        # Place in the view of a place in the window: the window is the view turned by the roll.
        warp = np.array([[c, s, middle - (c + s) * small], [-s, c, middle + (s - c) * small]])
        cv2.warpAffine(layers, warp, (WINDOW, WINDOW), turned[step], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    sums, weights = turned.reshape(steps, -1, 2).transpose(2, 0, 1)
    values = sums / np.maximum(weights, 1e-3) - 128.0
    weights[weights < 0.5] = 0.0
    total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-3)
    values -= (values * weights).sum(axis=1, keepdims=True) / total
    square = (values * values * weights).sum(axis=1, keepdims=True)
    return values * weights / np.sqrt(np.maximum(square, NOISE * NOISE * total)), weights


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Metadata and checked arrays of a file. Raises InputError."""
    damaged = f"{path}: the learned views are damaged; delete the file to learn anew"
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = dict(json.loads(str(file["meta"])))
            arrays = {name: np.array(file[name]) for name in ("rotations", "pictures", "masks")}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(damaged) from error
    count = len(arrays["rotations"]) if arrays["rotations"].ndim else -1
    shapes = {
        "rotations": ((count, 3, 3), np.float64),
        "pictures": ((count, SIDE, SIDE, CHANNELS), np.uint8),
        "masks": ((count, SIDE, SIDE), np.uint8),
    }
    if any(arrays[name].shape != shape or arrays[name].dtype != kind for name, (shape, kind) in shapes.items()):
        raise InputError(damaged)
    products = arrays["rotations"] @ arrays["rotations"].transpose(0, 2, 1)
    if not np.allclose(products, np.eye(3), atol=1e-6):
        raise InputError(damaged)
    return meta, arrays
