"""Options of a tracking session."""

from __future__ import annotations

from dataclasses import dataclass, field

from arview.detection.detector import DetectorOptions
from arview.detection.scene_change import SceneChangeOptions
from arview.errors import InputError
from arview.tracking.base_detection import BaseDetectionOptions
from arview.tracking.identity import IdentityOptions


@dataclass(frozen=True)
class SessionOptions:
    """Options of a session.

    Attributes:
        use_region: let the tracker use colours along the outline.
        use_edge: let the tracker use grey-level edges.
        use_texture: let the tracker use the part's own texture.
        use_recheck: run the detector's local search where a tracked pose is far from the predicted one.
        use_appearance_memory: remember how the part looks while it is tracked, and look for that after a loss.
        use_base_detection: search for the base alone where the search for the whole part fails.
        lock_quality: a detection of this quality is accepted at once; a weaker one must be confirmed by a second frame.
            Near a given initial pose ``tracked_quality`` is enough.
        tracked_quality: quality needed to become ``tracked``.
        critical_quality: a tracked pose becomes ``critical`` only below this quality (hysteresis).
        lost_quality: a pose below this quality for ``lost_frames`` frames is given up.
        lost_frames: frames in a row below ``lost_quality`` after which the part is lost.
        critical_frames: critical frames in a row after which the part is lost.
        eager_frames: frames after a loss in each of which the part is searched for.
        search_every: later the part is searched for only so many frames after the last search.
        thorough_every: frames from the end of one thorough search for a lost part to the next.
        thorough_parts: number of searches over which a thorough one is spread, so that no frame takes long.
        max_unchanged_frames: frames after which a picture in which nothing has changed is searched again.
        scene_change: what counts as a change of the picture.
        min_resting_score: correlation with the remembered appearance from which a place is examined in frames between
            these searches.
        align_again_frames: frames after a loss from which the part may be aligned with the guide view again.
        align_advice_every: frames between two checks of the picture while the session waits for the alignment.
        min_in_picture: share of the outline inside the picture below which no pose is kept.
        distance_margin: factor by which a pose may be nearer or farther than the declared range.
        detector: options of the detector; None chooses them by the declared range.
        base_detection: of the search for the base.
        identity: of the monitoring of the identity.
    """

    use_region: bool = True
    use_edge: bool = True
    use_texture: bool = True
    use_recheck: bool = True
    use_appearance_memory: bool = True
    use_base_detection: bool = True
    lock_quality: float = 0.8
    tracked_quality: float = 0.5
    critical_quality: float = 0.25
    lost_quality: float = 0.1
    lost_frames: int = 2
    critical_frames: int = 45
    eager_frames: int = 2
    search_every: int = 3
    thorough_every: int = 24
    thorough_parts: int = 3
    max_unchanged_frames: int = 30
    scene_change: SceneChangeOptions = field(default_factory=SceneChangeOptions)
    min_resting_score: float = 0.7
    align_again_frames: int = 60
    align_advice_every: int = 10
    min_in_picture: float = 0.25
    distance_margin: float = 2.0
    detector: DetectorOptions | None = None
    base_detection: BaseDetectionOptions = field(default_factory=BaseDetectionOptions)
    identity: IdentityOptions = field(default_factory=IdentityOptions)

    def __post_init__(self) -> None:
        if not 0 <= self.lost_quality <= self.critical_quality <= self.tracked_quality <= 1:
            raise InputError("session: expected 0 ≤ lost_quality ≤ critical_quality ≤ tracked_quality ≤ 1")
