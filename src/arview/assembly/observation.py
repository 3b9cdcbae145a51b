"""One observation of all components: log odds from one picture and one pose that each is not where the CAD has it.

Edges are measured for every visible component; the presence network predicts for those that the edges do not already
confirm, and those that are not verified are also searched for at alternative placements.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.assembly.bare_place import BarePlaceMeter, BarePlaces
from arview.assembly.edge_support import POINTS, EdgeSupportMeter, MeasuredSupport
from arview.assembly.log_odds import Evidence, edge_log_odds, place_log_odds, place_odds
from arview.assembly.placement_search import Alternatives, PlacementSearch
from arview.assembly.placements import alternative_placements
from arview.assembly.presence_net import PartImage, PresenceNet, component_crops
from arview.assembly.turned_poses import TurnEvidence
from arview.assembly.visible_edges import VisibleEdgeCache, VisibleEdges
from arview.cad import Model, make_model
from arview.camera import Camera
from arview.detection import EdgeNet
from arview.geometry import Array, apply, rigid
from arview.guideviews import GuideViewSet, Surface
from arview.refinement import intrinsics_of

MAX_PART_PX = 400.0
"""Larger pictures of the part are shrunk to about this size."""
MARGIN_PX = 44.0
"""Border around the part that is cut out with it, after shrinking."""
CONFIRMED_LOG_ODDS = -2.0
"""Components with less by their edges are confirmed, and the network does not predict for them, because it is less
certain on real pictures."""
NOMINAL_EDGES = 0.8
"""Weight of edge evidence for the nominal placement in the log odds of an alternative one, which otherwise depend on
the network alone."""
TRUSTED_LOG_ODDS = -2.0
"""Components with less by their edges are taken to be there, like those seen in earlier pictures: they are what is seen
behind absent ones."""
SUSPECT_LOG_ODDS = 1.0
"""Components with more are suspects."""
MIN_OPEN, MIN_AROUND = 0.75, 0.45
"""A place is open where more of the pixels beside it look as they should; share of the edges around it from which on
these are found."""
MAX_EXTENT = (0.65, 0.35)
"""How far beside an open place what stands there may go on, see `BarePlaces`, if the edges around are found, and if
not: a hand or a tool goes on to the border of the picture."""
POSE_FOUND = (0.4, 0.55)
"""Share of the edge points of the base, and of others that are there, up to which the pose counts as wrong, and from
which on it counts as right."""
OCCLUDED_PROBABILITY = 0.5
"""Components with more are hidden by something before them."""
MAX_SEEN = 3.0
"""Bound on the log odds for a component in the comparison of poses."""
MAX_LOG_ODDS = 4.0
"""Bound on the log odds of one observation, in both directions."""


class Known(NamedTuple):
    """What earlier pictures have shown of the components; all (C,).

    Attributes:
        is_present: seen at their nominal placement.
        is_absent: seen not to be there: they hide nothing.
        is_searched: to be searched for at alternative placements.
        is_awaited: not mounted yet: they are not measured; None: all are mounted.
    """

    is_present: NDArray[np.bool_]
    is_absent: NDArray[np.bool_]
    is_searched: NDArray[np.bool_]
    is_awaited: NDArray[np.bool_] | None = None


def nothing_known(count: int) -> Known:
    """Nothing is known of C components, and all are searched for."""
    return Known(np.zeros(count, dtype=bool), np.zeros(count, dtype=bool), np.ones(count, dtype=bool))


class Observation(NamedTuple):
    """Evidence of one picture about each component; all (C,) but the shifts.

    Attributes:
        log_odds: of "not at its nominal placement" to "there"; 0 without evidence.
        is_suspect: it may be missing, or is found at an alternative placement.
        is_visible: enough of it is visible to measure its edges, if nothing is before it.
        is_occluded: something is before it.
        alternative: log odds of "at an alternative placement" to "at its nominal placement"; -inf without a search.
        shifts: (C,3) mm in the model frame to the best alternative placement.
    """

    log_odds: Array
    is_suspect: NDArray[np.bool_]
    is_visible: NDArray[np.bool_]
    is_occluded: NDArray[np.bool_]
    alternative: Array
    shifts: Array


class Glimpse(NamedTuple):
    """What one picture shows at places of components without any network; all (C,).

    Attributes:
        by_edges: log odds of "not at its nominal placement" to "there" by the edges alone; 0 where it is not visible.
        bare: share of the place that looks as it does without the component; -1: not known.
        is_open: nothing before the place interrupts what is beside it.
    """

    by_edges: Array
    bare: Array
    is_open: NDArray[np.bool_]


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
    """

    def __init__(self, views: GuideViewSet, camera: Camera, model: Model) -> None:
        self._camera, self._surface, self._diameter_mm = camera, views.surface, views.diameter_mm
        self._model_from_body = rigid(np.eye(3), views.center_in_model)
        self._visible_edges = VisibleEdgeCache(views, model)
        self._meter = EdgeSupportMeter(views.diameter_mm)
        self._shown: tuple[VisibleEdges, NDArray[np.bool_]] | None = None
        self._count, self.base = len(views.component_names), base_of(model)
        base = model.components[self.base]
        self._base_edges = VisibleEdgeCache(views, make_model(base.name, (base,)))
        self._places = BarePlaceMeter(views.surface, self._count, views.diameter_mm)
        self._edge_net, self._presence_net = EdgeNet(), PresenceNet()
        self._model = model
        low, high = model.bounds_in_model
        self._corners_in_model = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])

    @cached_property
    def _search(self) -> PlacementSearch:
        """The search for components at other placements, made when one is first searched for."""
        placements = alternative_placements(self._model)
        return PlacementSearch(placements, self._surface, self._diameter_mm, self._presence_net)

    def shows_more(self, image: NDArray[np.uint8], pose: Array, than: Array) -> bool:
        """Whether a picture shows more components at a pose (4,4) than at another."""
        there, here = (self.pose_evidence(image, one).seen.sum() for one in (pose, than))
        return bool(there > here)

    def observe(self, image: NDArray[np.uint8], cam_from_model: Array, known: Known | None = None) -> Observation:
        """Observe all components at a pose.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm, exact to a pixel or two.
            known: what earlier pictures have shown; None: nothing, and all components are searched for.
        """
        known = known or nothing_known(self._count)
        evidence, picture = self.measure(image, cam_from_model, known)
        is_visible = evidence.support.supported >= 0.0
        odds = place_odds(evidence)
        by_place = place_log_odds(evidence)
        occluded = np.where(is_visible, odds.occluded, 0.0)
        # The base carries the pose: where it is not seen, nothing is known.
        by_place[self.base] = min(by_place[self.base], 0.0)
        found = Alternatives(np.full(self._count, -np.inf), np.zeros((self._count, 3)))
        if picture is not None and known.is_searched.any():
            nominal = np.where(evidence.network > 0.0, (1.0 - occluded) * evidence.network, evidence.network)
            found = self._search.search(picture, nominal, known.is_searched)
        alternative = found.log_odds + NOMINAL_EDGES * np.minimum(by_place, 0.0)
        alternative = np.where(alternative > 0.0, (1.0 - occluded) * alternative, alternative)
        log_odds = np.maximum(by_place, alternative)
        # A wrong pose leaves the base's edges unsupported, too: nothing then counts against a component.
        low, high = POSE_FOUND
        is_right = float(np.clip((evidence.base - low) / (high - low), 0.0, 1.0))
        log_odds = np.clip(np.where(log_odds > 0.0, is_right * log_odds, log_odds), -MAX_LOG_ODDS, MAX_LOG_ODDS)
        return Observation(
            log_odds=log_odds,
            is_suspect=log_odds > SUSPECT_LOG_ODDS,
            is_visible=is_visible,
            is_occluded=is_visible & (occluded > OCCLUDED_PROBABILITY),
            alternative=alternative,
            shifts=found.shifts,
        )

    def measure(
        self, image: NDArray[np.uint8], cam_from_model: Array, known: Known
    ) -> tuple[Evidence, PartImage | None]:
        """All measurements but the search for alternative placements, and the picture around the part for that."""
        crop = self._part_crop(image, cam_from_model)
        measured, is_doubtful, places, base = self._measure_places(crop, cam_from_model, known)
        network, picture = np.full(self._count, np.nan), None
        if (is_doubtful | known.is_searched).any():
            picture = PartImage(crop.image, self._edge_net.predict(crop.image), crop.intrinsics, crop.cam_from_body)
            network = self._network_log_odds(picture, known, is_doubtful)
        return Evidence(*measured, network, places, base), picture

    def glimpse(self, image: NDArray[np.uint8], cam_from_model: Array, known: Known) -> Glimpse | None:
        """What a picture shows of components that may be mounted at any time; None where the pose may be wrong.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm, exact to a pixel or two.
            known: of the components; only places of those that are neither seen nor awaited are looked at.
        """
        measured, _, places, base = self._measure_places(self._part_crop(image, cam_from_model), cam_from_model, known)
        if base < POSE_FOUND[1]:
            return None
        is_open = (places.ring > MIN_OPEN) & (places.extent < np.where(places.around > MIN_AROUND, *MAX_EXTENT))
        return Glimpse(edge_log_odds(measured), places.bare, is_open)

    def _measure_places(
        self, crop: PartCrop, cam_from_model: Array, known: Known
    ) -> tuple[MeasuredSupport, NDArray[np.bool_], BarePlaces, float]:
        """Edges of all components, (C,) which of them the edges leave doubtful, the places of these, and the share of
        the edge points of trusted components that are found.
        """
        edges = self._visible_edges.nearest(cam_from_model, known.is_absent)
        measured = self._meter.measure(
            crop.image, edges, crop.cam_from_body, crop.intrinsics, crop.px_per_mm, known.is_absent
        )
        by_edges = edge_log_odds(measured)
        is_doubtful = (measured.support.supported >= 0.0) & (by_edges > CONFIRMED_LOG_ODDS)
        if known.is_awaited is not None:
            is_doubtful &= ~known.is_awaited
        is_trusted = known.is_present | (by_edges < TRUSTED_LOG_ODDS)
        is_trusted[self.base] = True
        points = self._meter.found_points(edges, is_trusted)
        is_doubtful[self.base] = False
        places = self._places.measure(
            crop.image,
            crop.cam_from_body,
            crop.intrinsics,
            is_doubtful,
            is_trusted,
            known.is_absent,
            points,
            self._meter.found_behind(self._base_edges.nearest(cam_from_model), points.shift),
        )
        base = float(np.mean(points.is_found)) if len(points.is_found) else 0.0
        return measured, is_doubtful, places, base

    def pose_evidence(self, image: NDArray[np.uint8], cam_from_model: Array) -> TurnEvidence:
        """How much of the base, and of components at their nominal placements, a picture shows at a pose."""
        crop = self._part_crop(image, cam_from_model)
        edges = self._visible_edges.nearest(cam_from_model)
        measured = self._meter.measure(crop.image, edges, crop.cam_from_body, crop.intrinsics, crop.px_per_mm)
        by_edges = edge_log_odds(measured)
        is_base = np.arange(self._count) == self.base
        points = self._meter.found_points(edges, is_base)
        seen = np.where(is_base, 0.0, np.clip(-by_edges, 0.0, MAX_SEEN))
        return TurnEvidence(seen, float(np.mean(points.is_found)) if len(points.is_found) else 0.0)

    def motion_px(self, before: Array | None, cam_from_model: Array) -> float:
        """Largest motion of a corner of the part's box between two poses, px after shrinking; 0 for an unknown one."""
        if before is None:
            return 0.0
        px_per_mm = self._camera.fx / max(float(apply(cam_from_model, self._model_from_body[:3, 3])[2]), 1.0)
        shrink = max(1, round(self._diameter_mm * px_per_mm / MAX_PART_PX))
        moved_mm = apply(cam_from_model, self._corners_in_model) - apply(before, self._corners_in_model)
        return float(np.max(np.linalg.norm(moved_mm[:, :2], axis=1))) * px_per_mm / shrink

    def visible_from(self, cam_from_model: Array, is_absent: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """(C,) components that show enough edge points of their own from about the direction of a pose.

        Args:
            cam_from_model: (4,4).
            is_absent: (C,) components that hide nothing, because they are not there; None: all are there.
        """
        edges = self._visible_edges.nearest(cam_from_model, is_absent)
        if self._shown is None or self._shown[0] is not edges:
            points = np.bincount(edges.component[edges.is_own], minlength=len(edges.starts) - 1)
            self._shown = edges, np.asarray(points >= POINTS.min_points)
        return self._shown[1]

    def _network_log_odds(self, picture: PartImage, known: Known, is_exact: NDArray[np.bool_]) -> Array:
        """Log odds (C,) by the network against the nominal placements of some components, and of those searched for.

        NaN for the others and those too small. Components that are only searched for need no averaging over mirrored
        crops.
        """
        nominal = np.full(self._count, np.nan)
        crops = []
        for index in np.flatnonzero(is_exact | known.is_searched):
            surface = self._surface_without(known.is_absent & (np.arange(self._count) != index))
            crops += component_crops(picture, surface, self._diameter_mm, [int(index)])
        for is_mirrored in (True, False):
            some = [one for one in crops if is_exact[one.index] == is_mirrored]
            nominal[[one.index for one in some]] = self._presence_net.log_odds(some, is_mirrored)
        return nominal

    def _surface_without(self, is_absent: NDArray[np.bool_]) -> Surface:
        """The surface without some components."""
        surface = self._surface
        if not is_absent.any():
            return surface
        kept = ~is_absent[surface.component]
        return surface._replace(
            faces=surface.faces[kept], normals=surface.normals[kept], component=surface.component[kept]
        )

    def _part_crop(self, image: NDArray[np.uint8], cam_from_model: Array) -> PartCrop:
        """The picture around the part, shrunk by a whole factor where it is large."""
        camera = self._camera
        cam_from_body = cam_from_model @ self._model_from_body
        px_per_mm = camera.fx / max(float(cam_from_body[2, 3]), 1.0)
        shrink = max(1, round(self._diameter_mm * px_per_mm / MAX_PART_PX))
        size = np.array([camera.width, camera.height])
        corners = np.nan_to_num(camera.project(apply(cam_from_model, self._corners_in_model)))
        margin = MARGIN_PX * shrink
        low = np.clip(np.floor(corners.min(axis=0) - margin), 0, size - 8 * shrink).astype(int)
        small = (np.clip(np.ceil(corners.max(axis=0) + margin), low + 8 * shrink, size).astype(int) - low) // shrink
        high = low + small * shrink
        cut = image[low[1] : high[1], low[0] : high[0]]
        if shrink > 1:
            cut = np.asarray(cv2.resize(cut, (int(small[0]), int(small[1])), interpolation=cv2.INTER_AREA))
        cut_camera = camera.cropped(*low.tolist(), *(high - low).tolist()).scaled(*small.tolist())
        return PartCrop(cut, intrinsics_of(cut_camera), px_per_mm / shrink, cam_from_body)


def base_of(model: Model) -> int:
    """Index of the component with the box of the largest surface: it carries the others, and the pose."""
    sides = np.array([np.ptp(one.bounds_in_model, axis=0) for one in model.components])
    return int(np.argmax(sides[:, 0] * sides[:, 1] + sides[:, 1] * sides[:, 2] + sides[:, 2] * sides[:, 0]))
