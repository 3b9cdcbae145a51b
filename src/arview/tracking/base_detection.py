"""Detection of a part by its base alone, for assemblies of which most is absent.

The detector looks for the part as it is when complete: where half of its outline is missing, the pose is found but not
believed, or another one fits better. The base carries the other components and is always there. It is searched for
where the search for the whole part fails; a pose found by it says nothing of the other components.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.assembly import AssemblyMonitor, base_of
from arview.cad import Model, make_model
from arview.camera import Camera
from arview.detection import Detection, Detector, DetectorOptions, local_search_for, options_for
from arview.geometry import Array, apply, rigid
from arview.guideviews import GuideViewOptions, GuideViewSet, cached_guide_views
from arview.refinement import PartView

MIN_QUALITY = 0.9
"""Probability below which a pose of the base is not accepted: bases are plainer than whole parts."""
MIN_WIDTH = 0.25
"""Smaller side of the base's outline, in diameters of the base, below which a pose is not accepted: a plate seen
edge-on fits every strip."""
RECHECK_FRAMES = 15
"""While no component but the base is seen, it is searched for again after so many frames, because it may have been
mistaken; no component is called missing before it is found there once more."""
RESTLESS_FRAMES = 8
"""Frames after which the base is searched for again where the pose jumps while components are absent."""
WHOLE_FRAMES = 15
"""While a pose rests on the base alone, the whole part is searched for again after so many frames, because another
thing may have been mistaken for the base."""
SAME_SHARE = 0.1
SAME_DEG = 12.0
"""Distance in diameters and rotation within which two poses are the same."""
FULL_EVERY = 2
"""Every so many-th of the full searches of the whole part that fail is followed by one of the base."""
VIEWS: GuideViewOptions = GuideViewOptions(subdivisions=3)
"""Options of the base's guide views; they are fewer than those of the part, because they are made while a session
runs."""


class BaseDetection:
    """Finds the base of one part; its guide views and its detector are made when first needed.

    Args:
        views: guide views of the part.
        camera: of the pictures.
        model: of the guide views.
        detector: options of the detector; None chooses them by the declared range.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        model: Model,
        detector: DetectorOptions | None = None,
    ) -> None:
        self._views, self._camera, self._model = views, camera, model
        self._detector_options = detector
        self._detector: Detector | None = None
        self._part: PartView | None = None
        self._full_searches = self._frames_since = self._frames_since_whole = self._whole_searches = 0

    @property
    def is_possible(self) -> bool:
        """Whether the part has other components than its base."""
        return len(self._model.components) > 1

    def detect(self, image: NDArray[np.uint8], searches: list[int] | None) -> list[Detection]:
        """The pose of the part, or none, after a search for the whole part has failed.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            searches: those that were made for the whole part, see `Detector.detect`.
        """
        if not self.is_possible:
            return []
        if searches is None:
            is_due = self._full_searches % FULL_EVERY == 0
            self._full_searches += 1
            if not is_due:
                return []
        self._frames_since = 0
        found = self.detector.detect(image, searches=searches)
        is_accepted = [one.quality >= MIN_QUALITY and self._is_wide(one.cam_from_model) for one in found]
        return [one for one, is_good in zip(found, is_accepted, strict=True) if is_good][:1]

    def is_recheck_due(self, is_bare: bool, is_restless: bool) -> bool:
        """Whether the base of a part that is followed is to be searched for again.

        It is asked in each frame in which components are absent.

        Args:
            is_bare: no component but the base has been seen.
            is_restless: the pose jumps.
        """
        self._frames_since += 1
        wait = RESTLESS_FRAMES if is_restless else RECHECK_FRAMES
        return (is_bare or is_restless) and self._frames_since >= wait

    def find_whole(
        self,
        image: NDArray[np.uint8],
        detector: Detector,
        components: AssemblyMonitor,
        cam_from_model: Array,
        min_quality: float,
    ) -> Detection | None:
        """The whole part, for a pose that rests on the base alone: there, or elsewhere if that was another thing.

        It is asked in each frame with such a pose and mostly searches for nothing.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            detector: of the whole part; its searches are made one at a time.
            components: of the part; at a pose elsewhere the picture must show more of them.
            cam_from_model: (4,4) mm, the pose so far.
            min_quality: of the detection.
        """
        self._frames_since_whole += 1
        if self._frames_since_whole < WHOLE_FRAMES:
            return None
        self._frames_since_whole = 0
        self._whole_searches += 1
        searches = [0, *detector.wider_searches]
        found = detector.detect(image, max_results=1, searches=[searches[self._whole_searches % len(searches)]])
        if not found or found[0].quality < min_quality:
            return None
        pose = found[0].cam_from_model
        is_there = self.is_same(components, pose, cam_from_model)
        return found[0] if is_there or components.observer.shows_more(image, pose, cam_from_model) else None

    def is_same(self, components: AssemblyMonitor, a: Array, b: Array) -> bool:
        """Whether two poses (4,4) are the same, or would be if the base had no other components."""
        return components.is_same_but_turned(a, b, SAME_SHARE * self._views.diameter_mm, SAME_DEG)

    def _is_wide(self, cam_from_model: Array) -> bool:
        """Whether enough of the base is seen at a pose (4,4) for it not to fit every strip."""
        base = self._model.components[base_of(self._model)]
        in_cam = apply(cam_from_model, base.vertices_in_model)
        if in_cam[:, 2].min() <= 0.0:
            return True
        flat = (in_cam[:, :2] / in_cam[:, 2:]).astype(np.float32)
        width = min(cv2.minAreaRect(flat)[1]) * float(in_cam[:, 2].mean())
        return bool(width >= MIN_WIDTH * np.linalg.norm(np.ptp(base.bounds_in_model, axis=0)))

    @property
    def detector(self) -> Detector:
        """The detector of the base; its poses are those of the part."""
        if self._detector is None:
            base = self._model.components[base_of(self._model)]
            model = make_model(f"{self._model.name} {base.name}", (base,))
            views = cached_guide_views(model, self._views.view_range, VIEWS)
            options = self._detector_options or options_for(views)
            # A search that ends early must not end with a pose that is not accepted.
            options = replace(options, min_quick_quality=max(options.min_quick_quality, MIN_QUALITY))
            local = local_search_for(views, self._camera, options)
            self._detector = Detector(views, self._camera, options, local=local)
            self._part = _about(local.refiner.part, self._views.center_in_model)
        return self._detector

    @property
    def part(self) -> PartView | None:
        """Guide views of the base about the centre of the part, for the tracker; None before the first search.

        Those of the whole part lack the lines of the base that the other components hide.
        """
        return self._part


def _about(part: PartView, center_in_model: Array) -> PartView:
    """Guide views about another centre (3,) in mm, which becomes the origin of their frame."""
    shifted, shift_mm = copy.copy(part), part.views.center_in_model - center_in_model
    arrays, offset = part.arrays, shift_mm.astype(np.float32)
    shifted.arrays = arrays._replace(
        contour_points=arrays.contour_points + offset, edge_points=arrays.edge_points + offset
    )
    shifted.surface = part.surface._replace(points=part.surface.points + offset)
    shifted.model_from_body = rigid(np.eye(3), center_in_model)
    shifted.body_from_model = rigid(np.eye(3), -np.asarray(center_in_model))
    return shifted
