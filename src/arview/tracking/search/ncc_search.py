"""Search for remembered views in a frame by masked normalised cross-correlation.

A first search correlates very small grey templates, at several rolls and distances, with all positions in the frame, as
a product of two matrices. The best positions are refined by a pattern search in colour at twice the resolution. The
results are rough poses; whether the part is there is decided by the detector.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.core.kernel import kernel
from arview.core.parallel import single_threaded_blas
from arview.geometry import Array, are_near, exp_so3, rigid, rolls_between, turns_to_rays
from arview.tracking.search.view_crops import PART_PX, ViewCropper
from arview.tracking.search.window_search import FINE_PART_PX, NOISE, WindowSearch

FINE_PAD = 6
"""Margin around the pictures of the refinement, px."""
MAX_ROUNDS = 40
"""Rounds of the pattern search at most."""
NEIGHBOUR_STEPS = np.array([1.0, 1.0, 0.1, 0.05])
"""First steps of a pattern search from a placement that is nearly right: u px, v px, roll rad, ratio of sizes."""


ROLL_STEPS = 20
"""Rolls searched in a full turn."""
STRETCH = 1.2
"""Ratio of neighbouring distances that are searched."""
RANGE_MARGIN = 0.1
"""Share by which the declared range of distances is enlarged at both ends."""
NEAR_VIEWS = 12
"""Views searched when only views near a known pose are wanted."""
NEAR_DEG = 45.0
"""Largest difference from the known pose in direction of view and in roll then."""
NEAR_STRETCH = 1.5
"""Largest ratio to the known distance then."""
WINDOWS = 18
"""Best windows of the first search that are examined at each distance."""
VIEWS_PER_WINDOW = 4
"""Views examined in each window."""
REFINED = 24
"""Placements refined by the pattern search."""
PER_PLACE = 3
"""Placements refined at one place in the picture."""
PLACE_REACH = 0.3
"""Size of a place, in diameters of the part."""
NEIGHBOUR_SEARCHES = 3
"""Best placements at which views from other directions are tried, too."""
NEIGHBOUR_VIEWS = 6
"""Views tried there."""
NEIGHBOUR_DEG = 40.0
"""Largest difference in direction of view of these views."""
MIN_SCORE = 0.55
"""Correlation of a result."""
MIN_SHARE = 0.8
"""Share of the best correlation that a result needs."""
MAX_RESULTS = 2
"""Results at most."""
SAME_DISTANCE = 0.15
"""Results closer than this share of the diameter are the same when their rotations are, too."""
SAME_DEG = 25.0
"""Rotations that differ by less are the same."""


class StoredViews(NamedTuple):
    """Remembered views in the form of the search.

    Attributes:
        rotations: (N,3,3) rotations from the model, as if the part were on the optical axis.
        pictures: (N,CROP_PX,CROP_PX,3) uint8 RGB.
        masks: (N,CROP_PX,CROP_PX) uint8, 255 on the part.
        templates: (N,R,W²) see `rolled_templates`.
        weights: (N,R,W²) see `rolled_templates`.
    """

    rotations: Array
    pictures: NDArray[np.uint8]
    masks: NDArray[np.uint8]
    templates: NDArray[np.float32]
    weights: NDArray[np.float32]

    def first(self, count: int) -> StoredViews:
        """The first views."""
        return StoredViews(
            self.rotations[:count],
            self.pictures[:count],
            self.masks[:count],
            self.templates[:count],
            self.weights[:count],
        )


class AppearanceMatch(NamedTuple):
    """A rough pose.

    Attributes:
        score: correlation with a remembered view.
        cam_from_model: (4,4) mm.
        view: index of the view.
    """

    score: float
    cam_from_model: Array
    view: int


class ViewPlacement(NamedTuple):
    """A view placed in a picture.

    Attributes:
        score: correlation.
        place: (4,) u px, v px, roll rad, size in the picture over size in the crop.
        level: index of the picture.
        view: index of the view.
    """

    score: float
    place: Array
    level: int
    view: int


class NccSearch:
    """Search for remembered views of one part with one camera.

    Args:
        cropper: part and camera.
    """

    def __init__(self, cropper: ViewCropper) -> None:
        self._cropper = cropper
        self._views = cropper.views
        self._camera = cropper.camera

    def find(self, image: NDArray[np.uint8], stored: StoredViews, near: Array | None = None) -> list[AppearanceMatch]:
        """Rough poses of the part in a frame, best first.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            stored: views to search for.
            near: (4,4) last known ``cam_from_model``. Only views, rolls and distances near it are searched, at all
                positions; None: all views, rolls and declared distances.
        """
        chosen, distances_mm = self._search_space(stored.rotations, near)
        if not len(chosen) or not len(distances_mm):
            return []
        views, rolls = chosen.T
        windows = WindowSearch(
            stored.templates[views, rolls], stored.weights[views, rolls], views, WINDOWS, VIEWS_PER_WINDOW
        )
        pictures = self._scaled_pictures(image, distances_mm)
        with single_threaded_blas():
            found = [windows.find(picture) for picture in pictures]
        starts = []
        for level, places in enumerate(found):
            for center, template in places:
                view, step = chosen[template]
                roll = 2.0 * np.pi * step / ROLL_STEPS
                starts.append(ViewPlacement(0.0, np.array([*center, roll, FINE_PART_PX / PART_PX]), level, int(view)))
        return self._select(self._refine(starts, pictures, stored), pictures, stored)

    def _search_space(self, rotations: Array, near: Array | None) -> tuple[NDArray[np.intp], Array]:
        """Views and rolls (T,2) to search for, and distances (D,) mm."""
        low, high = self._views.view_range.for_camera(self._camera, self._views.diameter_mm).distance_mm
        low, high = (1.0 - RANGE_MARGIN) * low, (1.0 + RANGE_MARGIN) * high
        rolls = 2.0 * np.pi * np.arange(ROLL_STEPS) / ROLL_STEPS
        if near is None:
            is_chosen = np.ones((len(rotations), ROLL_STEPS), dtype=bool)
        else:
            rotation, _, distance_mm = self._cropper.axis_pose(near)
            min_cosine = np.cos(np.deg2rad(NEAR_DEG))
            cosines = rotations[:, 2] @ rotation[2]
            is_near = (cosines > min_cosine) & (cosines >= np.sort(cosines)[-NEAR_VIEWS:][:1].min(initial=1.0))
            last = rolls_between(rotations, rotation)
            is_chosen = is_near[:, None] & (np.cos(rolls - last[:, None]) > min_cosine)
            low, high = max(low, distance_mm / NEAR_STRETCH), min(high, distance_mm * NEAR_STRETCH)
        count = int(np.ceil(np.log(max(high / low, 1.0)) / np.log(STRETCH))) + 1
        return np.argwhere(is_chosen), np.geomspace(low, max(high, low), count)

    def _scaled_pictures(self, image: NDArray[np.uint8], distances_mm: Array) -> list[NDArray[np.float32]]:
        """The frame (H,W,3) reduced for each distance, so that the part spans FINE_PART_PX, with margins."""
        pictures = []
        width, height = self._camera.width, self._camera.height
        # Successive halving is fast and hardly less accurate.
        source = image
        for distance_mm in distances_mm[::-1]:
            scale = min(1.0, FINE_PART_PX * distance_mm / (self._cropper.focal_px * self._views.diameter_mm))
            while scale * width < 0.35 * source.shape[1]:
                source = cv2.resize(source, (source.shape[1] // 2, source.shape[0] // 2), interpolation=cv2.INTER_AREA)
            small = cv2.resize(source, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
            padded = cv2.copyMakeBorder(small, FINE_PAD, FINE_PAD, FINE_PAD, FINE_PAD, cv2.BORDER_REPLICATE)
            pictures.append(padded.astype(np.float32))
        return pictures[::-1]

    def _refine(
        self, starts: list[ViewPlacement], pictures: list[NDArray[np.float32]], stored: StoredViews
    ) -> list[ViewPlacement]:
        """The best placements after a pattern search, best first."""
        if not starts:
            return []
        steps = np.array([1.0, 1.0, np.pi / ROLL_STEPS, 0.5 * (STRETCH - 1.0)])
        found = []
        for k in self._spread(starts, pictures, stored):
            start = starts[k]
            score, place = pattern_search(
                pictures[start.level], stored.pictures[start.view], stored.masks[start.view], start.place, steps, 2
            )
            found.append(ViewPlacement(float(score), place, start.level, start.view))
        found.sort(key=lambda item: -item.score)
        count = NEIGHBOUR_SEARCHES
        found[:count] = [self._try_neighbours(pictures[item.level], item, stored) for item in found[:count]]
        found.sort(key=lambda item: -item.score)
        return found

    def _spread(
        self, starts: list[ViewPlacement], pictures: list[NDArray[np.float32]], stored: StoredViews
    ) -> list[int]:
        """Indices of the best placements as they are, few at each place of the picture."""
        none = np.zeros(4)
        scores = np.array(
            [
                pattern_search(pictures[s.level], stored.pictures[s.view], stored.masks[s.view], s.place, none, 0)[0]
                for s in starts
            ]
        )
        # Places are compared in units of the picture's width, reach in diameters of the part at its distance.
        widths = np.array([pictures[s.level].shape[1] - 2 * FINE_PAD for s in starts])
        centers = (np.array([s.place[:2] for s in starts]) - FINE_PAD) / widths[:, None]
        reach = (PLACE_REACH * FINE_PART_PX / widths) ** 2
        chosen: list[int] = []
        for k in np.argsort(-scores):
            if len(chosen) == REFINED:
                break
            distances = ((centers[chosen] - centers[k]) ** 2).sum(axis=1)
            if np.count_nonzero(distances < reach[k]) < PER_PLACE:
                chosen.append(int(k))
        return chosen

    def _try_neighbours(self, picture: NDArray[np.float32], found: ViewPlacement, stored: StoredViews) -> ViewPlacement:
        """A placement, or that of a view from a direction nearby, if it correlates better at the same place."""
        best = found
        rotation = exp_so3(np.array([0.0, 0.0, found.place[2]])) @ stored.rotations[found.view]
        cosines = stored.rotations[:, 2] @ rotation[2]
        for k in np.argsort(-cosines)[: NEIGHBOUR_VIEWS + 1]:
            if k == found.view or cosines[k] < np.cos(np.deg2rad(NEIGHBOUR_DEG)):
                continue
            start = found.place.copy()
            start[2] = rolls_between(stored.rotations[k], rotation)
            score, place = pattern_search(picture, stored.pictures[k], stored.masks[k], start, NEIGHBOUR_STEPS, 1)
            if score > best.score:
                best = ViewPlacement(float(score), place, found.level, int(k))
        return best

    def _select(
        self, found: list[ViewPlacement], pictures: list[NDArray[np.float32]], stored: StoredViews
    ) -> list[AppearanceMatch]:
        """The best placements as poses, each different from the others."""
        min_score = max(MIN_SCORE, MIN_SHARE * found[0].score) if found else 0.0
        results: list[AppearanceMatch] = []
        for item in found:
            if item.score < min_score or len(results) == MAX_RESULTS:
                break
            pose = self._pose(pictures[item.level], stored.rotations[item.view], item.place)
            if not any(self._is_same(pose, other.cam_from_model) for other in results):
                results.append(AppearanceMatch(item.score, pose, item.view))
        return results

    def _pose(self, picture: NDArray[np.float32], rotation: Array, place: Array) -> Array:
        """Pose (4,4) of a view with a rotation (3,3), placed in a picture."""
        height, width = picture.shape[0] - 2 * FINE_PAD, picture.shape[1] - 2 * FINE_PAD
        scale = width / self._camera.width, height / self._camera.height
        u, v = ((place[k] - FINE_PAD + 0.5) / scale[k] - 0.5 for k in range(2))
        ray = self._camera.unproject(np.array([u, v]))
        ray /= np.linalg.norm(ray)
        size = np.sqrt(scale[0] * scale[1])
        distance_mm = self._cropper.focal_px * self._views.diameter_mm * size / (PART_PX * place[3])
        turned = turns_to_rays(ray) @ exp_so3(np.array([0.0, 0.0, place[2]])) @ rotation
        return rigid(turned, ray * distance_mm - turned @ self._views.center_in_model)

    def _is_same(self, a: Array, b: Array) -> bool:
        """Whether the detector would refine two poses (4,4) to the same one."""
        model_from_body = rigid(np.eye(3), self._views.center_in_model)
        return are_near(a @ model_from_body, b @ model_from_body, SAME_DISTANCE * self._views.diameter_mm, SAME_DEG)


@kernel(fastmath=True)
def _correlation(
    image: NDArray[np.float32],
    picture: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    u: float,
    v: float,
    roll: float,
    ratio: float,
) -> float:
    """Masked normalised correlation of a view with an image, all channels together; -1 mostly outside the image.

    The view is placed with its centre at (u, v) px, turned by ``roll`` rad and scaled by ``ratio``. Pixels outside the
    image lower the correlation by their share.
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
def pattern_search(
    image: NDArray[np.float32],
    picture: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    start: NDArray[np.float64],
    steps: NDArray[np.float64],
    halvings: int,
) -> tuple[float, NDArray[np.float64]]:
    """Pattern search (Hooke & Jeeves, 1961) for the best correlation of a view.

    Args:
        image: (H,W,3) float32.
        picture: (S,S,3) uint8 RGB of the view.
        mask: (S,S) uint8, not 0 on the part.
        start: (4,) u px, v px, roll rad, size in the image over size in the view.
        steps: (4,) first steps of these; all 0: only the correlation at the start is computed.
        halvings: number of times that the steps are halved; the search then ends at the first round without a gain.

    Returns:
        Best correlation and its placement (4,).
    """
    best = start.copy()
    top = _correlation(image, picture, mask, best[0], best[1], best[2], best[3])
    step = steps.copy()
    if not np.any(step > 0.0):
        return top, best
    left = halvings
    for _ in range(MAX_ROUNDS):
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
