"""AppearanceMemory: how the part looked while it was tracked, so that it is found sooner after a loss.

A remembered view is a small crop of the part with its silhouette and its direction of view. After a loss these views
are searched for by correlation, see `ncc_search`; the results are rough poses for the detector.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.geometry import Array, rolls_between
from arview.guideviews import GuideViewSet
from arview.tracking.appearance_file import SavedViews, load_views, save_views
from arview.tracking.estimate import Estimate
from arview.tracking.search.ncc_search import (
    NEIGHBOUR_STEPS,
    ROLL_STEPS,
    AppearanceMatch,
    NccSearch,
    StoredViews,
    pattern_search,
)
from arview.tracking.search.view_crops import CHANNELS, CROP_PX, ViewCrop, ViewCropper
from arview.tracking.search.window_search import WINDOW_PX, rolled_templates

MAX_VIEWS = 48
"""Views kept at most; each takes 4 kB in a file and 80 kB in memory."""
VIEW_STEP_DEG = 8.0
"""A direction that differs by more from all kept ones is a new view."""
LEARN_EVERY = 4
"""Frames between two checks whether the direction of view is new."""
COMPARE_EVERY = 16
"""Frames between two checks whether the part looks different from the kept views."""
SAME_SCORE = 0.75
"""Correlation with the nearest kept view below which the part looks different."""
MIN_QUALITY = 0.8
"""Quality of the pose needed to learn from a frame."""
MIN_IN_PICTURE = 0.75
"""Share of the outline in the picture needed to learn from a frame."""
MIN_SUPPORT = 0.85
"""Share of the usual support of the outline needed, because a hand over the part lowers it."""
SUPPORT_DECAY = 0.99
"""Factor by which the usual support decreases in each frame."""
STEADY_FRAMES = 5
"""Frames in a row that must fulfil these conditions."""


class AppearanceMemory:
    """A bounded number of views of one part, learned while it was tracked.

    Args:
        views: guide views of the part, from which its silhouettes are drawn.
        camera: intrinsics of the frames; saved views can be used with any camera.
    """

    def __init__(self, views: GuideViewSet, camera: Camera) -> None:
        self.views = views
        self._cropper = ViewCropper(views, camera)
        self._search = NccSearch(self._cropper)
        count, rolls = MAX_VIEWS, ROLL_STEPS
        self._count = 0
        self._stored = StoredViews(
            rotations=np.zeros((count, 3, 3)),
            pictures=np.zeros((count, CROP_PX, CROP_PX, CHANNELS), dtype=np.uint8),
            masks=np.zeros((count, CROP_PX, CROP_PX), dtype=np.uint8),
            templates=np.zeros((count, rolls, WINDOW_PX * WINDOW_PX), dtype=np.float32),
            weights=np.zeros((count, rolls, WINDOW_PX * WINDOW_PX), dtype=np.float32),
        )
        self._added_at = np.zeros(count, dtype=np.int64)
        self._added = 0
        self._frame = self._steady_frames = self._compared_at = 0
        self._usual_support = 0.0

    def __len__(self) -> int:
        return self._count

    @property
    def rotations(self) -> Array:
        """Rotations (N,3,3) of the kept views from the model, as if the part were on the optical axis."""
        return self._stored.rotations[: self._count]

    # --- Learn ------------------------------------------------------------------------------------------------

    def learn(self, image: NDArray[np.uint8], estimate: Estimate, is_sure: bool) -> bool:
        """Keep a view of the part if it is tracked well and looks new; True when a view was kept.

        Args:
            image: (H,W,3) uint8 RGB.
            estimate: estimate of the tracker in this frame.
            is_sure: whether the part is tracked and nothing contradicts its pose.
        """
        evidence = estimate.evidence
        self._frame += 1
        self._usual_support = max(SUPPORT_DECAY * self._usual_support, evidence.contour_support)
        is_clear = evidence.contour_support >= MIN_SUPPORT * self._usual_support
        is_good = estimate.quality >= MIN_QUALITY and evidence.points_in_picture >= MIN_IN_PICTURE
        self._steady_frames = self._steady_frames + 1 if is_sure and is_clear and is_good else 0
        if self._steady_frames < STEADY_FRAMES or self._frame % LEARN_EVERY:
            return False
        cam_from_model = estimate.cam_from_model
        cosines = self.rotations[:, 2] @ self._cropper.axis_pose(cam_from_model).rotation[2]
        is_new = self._count == 0 or cosines.max() < np.cos(np.deg2rad(VIEW_STEP_DEG))
        if not is_new and self._frame - self._compared_at < COMPARE_EVERY:
            return False
        self._compared_at = self._frame
        return self.add(image, cam_from_model, is_new)

    def add(self, image: NDArray[np.uint8], cam_from_model: Array, is_new: bool = False) -> bool:
        """Keep the view of a pose (4,4); True when it was kept.

        A view is not kept where the part is too small, or, unless ``is_new``, where a view from about that direction
        looks the same.
        """
        crop = self._cropper.crop(image, cam_from_model)
        if crop is None:
            return False
        rotation = self._cropper.axis_pose(cam_from_model).rotation
        if not is_new and self._looks_known(crop, rotation):
            return False
        self._store(rotation, crop.picture, crop.mask)
        return True

    def _looks_known(self, crop: ViewCrop, rotation: Array) -> bool:
        """Whether a kept view from about the direction of a rotation (3,3) correlates with a crop."""
        cosines = self.rotations[:, 2] @ rotation[2]
        near = np.flatnonzero(cosines > np.cos(np.deg2rad(VIEW_STEP_DEG)))
        middle = 0.5 * (CROP_PX - 1)
        picture = crop.picture.astype(np.float32)
        for k in near:
            start = np.array([middle, middle, rolls_between(self._stored.rotations[k], rotation), 1.0])
            score, _ = pattern_search(
                picture, self._stored.pictures[k], self._stored.masks[k], start, NEIGHBOUR_STEPS, 1
            )
            if score >= SAME_SCORE:
                return True
        return False

    def _store(self, rotation: Array, picture: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
        """Keep a view; beyond the limit it replaces the older of the two views nearest in direction."""
        place = self._count
        if place == MAX_VIEWS:
            directions = self.rotations[:, 2]
            nearness = directions @ directions.T
            np.fill_diagonal(nearness, -1.0)
            nearest = np.maximum(nearness.max(axis=1), directions @ rotation[2])
            densest = np.flatnonzero(nearest >= nearest.max() - 1e-6)
            place = int(densest[np.argmin(self._added_at[densest])])
        self._count = max(self._count, place + 1)
        stored = self._stored
        stored.rotations[place] = rotation
        stored.pictures[place] = picture
        stored.masks[place] = mask
        self._added_at[place] = self._added = self._added + 1
        templates = rolled_templates(picture, mask, ROLL_STEPS)
        stored.templates[place], stored.weights[place] = templates

    # --- Search -----------------------------------------------------------------------------------------------

    def propose(self, image: NDArray[np.uint8], near: Array | None = None) -> list[AppearanceMatch]:
        """Rough poses where a frame looks like a kept view, best first; none is certain.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            near: (4,4) last known ``cam_from_model``, see `NccSearch.find`; None searches for all views.
        """
        return self._search.find(image, self._stored.first(self._count), near)

    # --- Files ------------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write the views to a file, oldest first, atomically. Raises OutputError."""
        order = np.argsort(self._added_at[: self._count])
        stored = self._stored
        saved = SavedViews(stored.rotations[order], stored.pictures[order], stored.masks[order])
        save_views(path, saved, self.views)

    def load(self, path: Path) -> None:
        """Replace the kept views by those of a file.

        Raises:
            InputError: the file is missing, damaged, of another kind or of another format version.
            MismatchError: the views are of another model.
        """
        saved = load_views(path, self.views)
        self._count = 0
        for rotation, picture, mask in zip(*saved, strict=True):
            self._store(rotation, picture, mask)
