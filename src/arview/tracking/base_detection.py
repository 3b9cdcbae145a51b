"""Detection of a part by its base alone, for assemblies of which most is absent.

The detector looks for the part as it is when complete: where half of its outline is missing, the pose is found but not
believed, or another one fits better. The base carries the other components and is always there. It is searched for
where the search for the whole part fails; a pose found by it says nothing of the other components.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from arview.assembly.observation import base_of
from arview.cad.model import Model, make_model
from arview.camera import Camera
from arview.detection.detector import Detection, Detector, DetectorOptions, options_for
from arview.guideviews import GuideViewOptions, GuideViewSet
from arview.guideviews.cache import cached_guide_views


@dataclass(frozen=True)
class BaseDetectionOptions:
    """Options of the detection by the base.

    Attributes:
        min_quality: probability below which a pose of the base is not accepted: bases are plainer than whole parts.
        full_every: every so many-th of the full searches of the whole part that fail is followed by one of the base.
        views: options of the base's guide views; they are fewer than those of the part, because they are made while a
            session runs.
    """

    min_quality: float = 0.9
    full_every: int = 2
    views: GuideViewOptions = field(default_factory=lambda: GuideViewOptions(subdivisions=3))


class BaseDetection:
    """Finds the base of one part; its guide views and its detector are made when first needed.

    Args:
        views: guide views of the part.
        camera: of the pictures.
        model: of the guide views.
        detector: options of the detector; None chooses them by the declared range.
        options: see `BaseDetectionOptions`.
    """

    def __init__(
        self,
        views: GuideViewSet,
        camera: Camera,
        model: Model,
        detector: DetectorOptions | None = None,
        options: BaseDetectionOptions | None = None,
    ) -> None:
        self.options = options or BaseDetectionOptions()
        self._views, self._camera, self._model = views, camera, model
        self._detector_options = detector
        self._detector: Detector | None = None
        self._full_searches = 0

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
            is_due = self._full_searches % self.options.full_every == 0
            self._full_searches += 1
            if not is_due:
                return []
        found = self.detector.detect(image, max_results=1, searches=searches)
        return [one for one in found if one.quality >= self.options.min_quality]

    @property
    def detector(self) -> Detector:
        """The detector of the base; its poses are those of the part."""
        if self._detector is None:
            base = self._model.components[base_of(self._model)]
            model = make_model(f"{self._model.name} {base.name}", (base,))
            views = cached_guide_views(model, self._views.view_range, self.options.views)
            options = self._detector_options or options_for(views)
            # A search that ends early must not end with a pose that is not accepted.
            options = replace(options, min_quick_quality=max(options.min_quick_quality, self.options.min_quality))
            self._detector = Detector(views, self._camera, options)
        return self._detector
