"""One observation of all components: log odds from one picture and one pose that each is not where the CAD has it.

Edges are measured for every visible component; the presence network predicts for those that the edges do not already
confirm, and those that are not verified are also searched for at alternative placements.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.assembly.edge_support import EdgeSupport, EdgeSupportMeter, EdgeSupportOptions
from arview.assembly.log_odds import LogOddsOptions, edge_log_odds, fused_log_odds
from arview.assembly.placement_search import PlacementSearch, PlacementSearchOptions
from arview.assembly.placements import PlacementOptions, alternative_placements
from arview.assembly.presence_net import PartImage, PresenceNet, component_crops
from arview.assembly.visible_edges import VisibleEdgeCache, VisibleEdgeOptions
from arview.cad.model import Model
from arview.camera import Camera
from arview.detection.features.edge_net import EdgeNet
from arview.geometry import Array, apply, rigid
from arview.guideviews import GuideViewSet
from arview.refinement.projection import intrinsics_of


@dataclass(frozen=True)
class ObservationOptions:
    """How one picture is turned into log odds.

    Attributes:
        max_part_px: larger pictures of the part are shrunk to about this size.
        margin_px: border around the part that is cut out with it, after shrinking.
        occluded_share: share of supported edge points around a component up to which it counts as occluded.
        unoccluded_share: share from which on it counts as unoccluded; in between it counts in proportion.
        confirmed_log_odds: components with less by their edges are confirmed, and the network does not predict for
            them, because it is less certain on real pictures.
        nominal_edges: weight of edge evidence for the nominal placement in the log odds of an alternative one, which
            otherwise depend on the network alone.
        suspect_log_odds: components with more are suspects; occlusion is not considered here.
        expected_suspects: each suspect beyond this number halves the log odds against all components, because one
            wrong component is more likely than many.
        max_log_odds: bound on the log odds of one observation, in both directions.
        visible_edges, edge_support, log_odds, placements, placement_search: options of these steps.
    """

    max_part_px: float = 400.0
    margin_px: float = 44.0
    occluded_share: float = 0.42
    unoccluded_share: float = 0.67
    confirmed_log_odds: float = -2.0
    nominal_edges: float = 0.8
    suspect_log_odds: float = 1.0
    expected_suspects: int = 2
    max_log_odds: float = 4.0
    visible_edges: VisibleEdgeOptions = field(default_factory=VisibleEdgeOptions)
    edge_support: EdgeSupportOptions = field(default_factory=EdgeSupportOptions)
    log_odds: LogOddsOptions = field(default_factory=LogOddsOptions)
    placements: PlacementOptions = field(default_factory=PlacementOptions)
    placement_search: PlacementSearchOptions = field(default_factory=PlacementSearchOptions)


class Observation(NamedTuple):
    """Evidence of one picture about each component; all (C,).

    Attributes:
        log_odds: of "not at its nominal placement" to "there"; 0 without evidence.
        is_suspect: it may be missing or occluded, or is found at an alternative placement.
        is_visible: enough of it is visible to measure its edges.
        support: the measurements of its edges, -1 where it is not visible.
    """

    log_odds: Array
    is_suspect: NDArray[np.bool_]
    is_visible: NDArray[np.bool_]
    support: EdgeSupport


class PartCrop(NamedTuple):
    """The picture around the part, perhaps shrunk: (H,W,3) RGB, its intrinsics (10,), px per mm at the part's centre,
    and the pose (4,4) about the model's centre.
    """

    image: NDArray[np.uint8]
    intrinsics: Array
    px_per_mm: float
    cam_from_body: Array


class ComponentObserver:
    """Observes the components of one part with one camera. It has no state between pictures but caches.

    Args:
        views: guide views; their directions and camera are used.
        camera: of the pictures.
        model: of the guide views.
        options: see `ObservationOptions`.
    """

    def __init__(
        self, views: GuideViewSet, camera: Camera, model: Model, options: ObservationOptions | None = None
    ) -> None:
        self._options = options or ObservationOptions()
        o = self._options
        self._camera, self._surface, self._diameter_mm = camera, views.surface, views.diameter_mm
        self._model_from_body = rigid(np.eye(3), views.center_in_model)
        self._visible_edges = VisibleEdgeCache(views, model, o.visible_edges)
        self._meter = EdgeSupportMeter(views.diameter_mm, o.edge_support)
        self._edge_net, self._presence_net = EdgeNet(), PresenceNet()
        placements = alternative_placements(model, o.placements)
        self._search = PlacementSearch(
            placements, views.surface, views.diameter_mm, self._presence_net, o.placement_search
        )
        low, high = model.bounds_in_model
        self._corners_in_model = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])

    def observe(
        self, image: NDArray[np.uint8], cam_from_model: Array, is_searched: NDArray[np.bool_] | None = None
    ) -> Observation:
        """Observe all components at a pose.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm, exact to a pixel or two.
            is_searched: (C,) components that are also searched for at alternative placements; None: all.
        """
        o = self._options
        crop = self._part_crop(image, cam_from_model)
        edges = self._visible_edges.nearest(cam_from_model)
        support = self._meter.measure(crop.image, edges, crop.cam_from_body, crop.intrinsics, crop.px_per_mm)
        is_visible = support.supported >= 0.0
        is_searched = np.ones(len(is_visible), dtype=bool) if is_searched is None else is_searched
        by_edges = np.where(is_visible, edge_log_odds(support, o.log_odds), 0.0)
        unoccluded = self._unoccluded(support)
        is_predicted = is_visible & (by_edges > o.confirmed_log_odds)
        by_network, alternative = self._network_log_odds(crop, is_predicted, is_searched, unoccluded)
        alternative = alternative + o.nominal_edges * np.minimum(by_edges, 0.0)
        alternative = unoccluded * np.maximum(alternative, 0.0) + np.minimum(alternative, 0.0)
        plain = fused_log_odds(by_edges, by_network, o.log_odds)
        is_suspect = is_visible & (plain > o.suspect_log_odds) | (alternative > o.suspect_log_odds)
        fused = fused_log_odds(by_edges, by_network, o.log_odds, unoccluded)
        log_odds = np.maximum(np.where(is_visible, fused, 0.0), alternative)
        excess = max(0, int(np.count_nonzero(is_suspect)) - o.expected_suspects)
        log_odds = np.where(log_odds > 0.0, log_odds * 0.5**excess, log_odds)
        return Observation(np.clip(log_odds, -o.max_log_odds, o.max_log_odds), is_suspect, is_visible, support)

    def visible_from(self, cam_from_model: Array) -> NDArray[np.bool_]:
        """(C,) components that show enough edge points of their own from about the direction of a pose."""
        edges = self._visible_edges.nearest(cam_from_model)
        points = np.bincount(edges.component[edges.is_own], minlength=len(edges.starts) - 1)
        return np.asarray(points >= self._options.edge_support.points.min_points)

    def _unoccluded(self, support: EdgeSupport) -> Array:
        """(C,) 1 where the edges around a component, and those of all others, are found; 0 where they are not."""
        o = self._options
        found = np.minimum(support.surroundings, support.others)
        share = np.clip((found - o.occluded_share) / (o.unoccluded_share - o.occluded_share), 0.0, 1.0)
        return np.where(support.supported >= 0.0, share, 1.0)

    def _network_log_odds(
        self, crop: PartCrop, is_predicted: NDArray[np.bool_], is_searched: NDArray[np.bool_], unoccluded: Array
    ) -> tuple[Array, Array]:
        """Log odds (C,) by the network against the nominal placements, and for alternative placements.

        Args:
            crop: around the part.
            is_predicted: (C,) whose nominal placement is wanted; NaN for the others and those too small.
            is_searched: (C,) whose alternative placements are wanted; -inf for the others.
            unoccluded: (C,) discounts what counts against a nominal placement, see `fused_log_odds`.
        """
        nominal, alternative = np.full(len(is_predicted), np.nan), np.full(len(is_predicted), -np.inf)
        if not (is_predicted | is_searched).any():
            return nominal, alternative
        picture = PartImage(crop.image, self._edge_net.predict(crop.image), crop.intrinsics, crop.cam_from_body)
        wanted = np.flatnonzero(is_predicted | is_searched).tolist()
        crops = component_crops(picture, self._surface, self._diameter_mm, wanted)
        # Components that are only searched for need no averaging over mirrored crops.
        for is_exact in (True, False):
            some = [one for one in crops if is_predicted[one.index] == is_exact]
            nominal[[one.index for one in some]] = self._presence_net.log_odds(some, is_mirrored=is_exact)
        if is_searched.any():
            discounted = np.where(nominal > 0.0, unoccluded * nominal, nominal)
            alternative = self._search.log_odds(picture, discounted, is_searched)
        return np.where(is_predicted, nominal, np.nan), alternative

    def _part_crop(self, image: NDArray[np.uint8], cam_from_model: Array) -> PartCrop:
        """The picture around the part, shrunk by a whole factor where it is large."""
        o, camera = self._options, self._camera
        cam_from_body = cam_from_model @ self._model_from_body
        px_per_mm = camera.fx / max(float(cam_from_body[2, 3]), 1.0)
        shrink = max(1, round(self._diameter_mm * px_per_mm / o.max_part_px))
        size = np.array([camera.width, camera.height])
        corners = np.nan_to_num(camera.project(apply(cam_from_model, self._corners_in_model)))
        margin = o.margin_px * shrink
        low = np.clip(np.floor(corners.min(axis=0) - margin), 0, size - 8 * shrink).astype(int)
        small = (np.clip(np.ceil(corners.max(axis=0) + margin), low + 8 * shrink, size).astype(int) - low) // shrink
        high = low + small * shrink
        cut = image[low[1] : high[1], low[0] : high[0]]
        if shrink > 1:
            cut = np.asarray(cv2.resize(cut, (int(small[0]), int(small[1])), interpolation=cv2.INTER_AREA))
        cut_camera = camera.cropped(*low.tolist(), *(high - low).tolist()).scaled(*small.tolist())
        return PartCrop(cut, intrinsics_of(cut_camera), px_per_mm / shrink, cam_from_body)
