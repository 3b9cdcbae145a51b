"""Identity: another specimen of the part never gets the labels of the followed one, and the followed one keeps them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
import zxingcpp
from numpy.typing import NDArray

from arview.detection.detector import Detection
from arview.errors import InputError
from arview.fiducials.serial_code import SerialNumbers
from arview.geometry import Array, apply, invert, rigid
from arview.pose import Identity, Pose, TrackingState
from arview.refinement.evidence import PoseEvidence
from arview.tracking import Estimate, SpecimenTracking
from arview.tracking.identity import IdentityMonitor
from arview.tracking.identity.background_motion import BackgroundMotion, reduced
from arview.tracking.identity.doubt import ANOTHER_IN_VIEW, MOVED
from arview.tracking.identity.monitor import CHECKING
from arview.tracking.identity.part_outline import PartOutline, transfer
from arview.tracking.search.guided_init import GuidedPose
from helpers.synthetic import assembly, assembly_views
from helpers.turning_bench import CAMERA, LEFT, RIGHT, bench, covered, frame

EVIDENCE = PoseEvidence(1.0, 1.0, 0.5, 0.8, 0.9, 0.5, 1.0, 0.2)


@dataclass
class FakeFinders:
    """Searches that find the specimens of a list, in every picture."""

    poses: list[Array] = field(default_factory=list)
    searches: int = 0
    others: tuple[Array, ...] = ()

    def monitor(self, serials: SerialNumbers | None = None) -> IdentityMonitor:
        """A monitor that uses these searches."""
        return IdentityMonitor(assembly_views(), CAMERA, self.find, self.detect, serials)

    def detect(self, image: NDArray[np.uint8], max_results: int, is_thorough: bool) -> list[Detection]:
        self.searches += 1
        return [Detection(pose, 0.9) for pose in self.poses]

    def find(self, image: NDArray[np.uint8], cam_from_model: Array) -> GuidedPose | None:
        self.searches += 1
        for pose in self.poses:
            if np.linalg.norm((pose - cam_from_model)[:3, 3]) < 60.0:
                return GuidedPose(pose, EVIDENCE, 0.95)
        return GuidedPose(cam_from_model, EVIDENCE, 0.2)


def estimate(pose: Array, quality: float = 0.95) -> Estimate:
    return Estimate(pose, np.eye(6), quality, EVIDENCE)


def turned(yaw_deg: float, seed: int, pose: Array) -> tuple[NDArray[np.uint8], Array]:
    """A frame of the bench with both specimens, and the pose (4,4) of one of them there."""
    image, turn = frame(bench(True, True), yaw_deg, seed)
    return image, turn @ pose


def monitor_after(frames: int = 12) -> tuple[IdentityMonitor, FakeFinders]:
    """A monitor that has followed the left specimen."""
    finders = FakeFinders()
    monitor = finders.monitor()
    for i in range(frames):
        image, pose = turned(0.3 * i, i, LEFT)
        assert monitor.update(image, estimate(pose), i, i / 30.0, finders.others).identity is Identity.FOLLOWED
    assert finders.searches == 0
    return monitor, finders


# --- Background ------------------------------------------------------------------------------------------


def test_the_background_says_where_the_part_is_through_a_turn_of_the_camera() -> None:
    outline = PartOutline(assembly_views(), CAMERA)
    motion = BackgroundMotion(outline)
    image, before = turned(0.0, 0, LEFT)
    motion.start(reduced(image, 480), before)
    pose = before
    for i in range(1, 16):
        image, pose = turned(1.0 * i, i, LEFT)
        motion.follow(image, None)
    assert motion.homography is not None
    truth = outline.place(pose)
    assert np.linalg.norm(truth.center_px - outline.place(before).center_px) > 150.0
    pixel, scale, _ = transfer(motion.homography, outline.place(before).center_px)
    assert np.linalg.norm(pixel - truth.center_px) < 4.0
    assert scale == pytest.approx(1.0, abs=0.1)
    guess = outline.moved(before, motion.homography)
    assert np.linalg.norm(apply(guess, assembly().center_in_model) - apply(pose, assembly().center_in_model)) < 40.0


def test_a_background_without_features_says_nothing() -> None:
    motion = BackgroundMotion(PartOutline(assembly_views(), CAMERA))
    image, pose = turned(0.0, 0, LEFT)
    motion.start(reduced(image, 480), pose)
    motion.follow(np.full_like(image, 90), None)
    assert motion.homography is None
    # The chain stays broken, until the pictures before and after the gap are matched.
    image, pose = turned(4.0, 1, LEFT)
    motion.follow(image, None)
    assert motion.homography is None
    motion.match(pose)
    assert motion.homography is not None
    outline = PartOutline(assembly_views(), CAMERA)
    pixel, _, _ = transfer(motion.homography, outline.place(turned(0.0, 0, LEFT)[1]).center_px)
    assert np.linalg.norm(pixel - outline.place(pose).center_px) < 8.0


# --- Decisions, with searches whose results are known ----------------------------------------------------


def test_a_part_found_again_at_its_place_is_followed_at_once() -> None:
    monitor, finders = monitor_after()
    for i in range(12, 40):
        image, pose = turned(0.3 * i, i, LEFT)
        monitor.update(image, None, i, i / 30.0, finders.others)
    image, pose = turned(12.0, 40, LEFT)
    assert monitor.update(image, estimate(pose), 40, 40 / 30.0, finders.others).identity is Identity.FOLLOWED
    assert finders.searches == 0


@pytest.mark.parametrize("gap", [0, 1, 20])
def test_a_pose_on_another_specimen_withholds_the_labels(gap: int) -> None:
    monitor, finders = monitor_after()
    for i in range(12, 12 + gap):
        monitor.update(turned(3.6, i, LEFT)[0], None, i, i / 30.0, finders.others)
    finders.poses = [turned(3.6, 0, LEFT)[1], turned(3.6, 0, RIGHT)[1]]
    for i in range(12 + gap, 50 + gap):
        image, pose = turned(3.6, i, RIGHT)
        result = monitor.update(image, estimate(pose), i, i / 30.0, finders.others)
        assert result.identity is Identity.UNCONFIRMED
        assert result.reason == ANOTHER_IN_VIEW
    # A weak pose on it changes nothing, and the user's word ends it.
    assert monitor.update(image, estimate(pose, 0.3), 200, 200 / 30.0, finders.others).identity is Identity.UNCONFIRMED
    monitor.confirm()
    assert monitor.update(image, estimate(pose), 201, 201 / 30.0, finders.others).identity is Identity.CONFIRMED


def test_the_session_goes_back_to_the_followed_specimen_when_it_is_seen_again() -> None:
    monitor, finders = monitor_after()
    finders.poses = [turned(3.6, 0, RIGHT)[1]]
    back = None
    for i in range(12, 60):
        image, pose = turned(3.6, i, RIGHT)
        if i == 30:
            finders.poses.append(turned(3.6, 0, LEFT)[1])
        result = monitor.update(image, estimate(pose), i, i / 30.0, finders.others)
        assert result.identity is Identity.UNCONFIRMED
        if result.cam_from_model is not None:
            back = i
            break
    assert back is not None and 30 <= back <= 45
    image, pose = turned(3.6, 60, LEFT)
    assert monitor.update(image, estimate(pose), 60, 2.0, finders.others).identity is Identity.FOLLOWED


def test_a_lone_part_that_was_moved_has_its_labels_back_within_a_second() -> None:
    monitor, finders = monitor_after()
    first = None
    for i in range(12, 60):
        image, pose = turned(3.6, i, RIGHT)
        finders.poses = []
        result = monitor.update(image, estimate(pose), i, i / 30.0, finders.others)
        if i == 12:
            assert (result.identity, result.reason) == (Identity.UNCONFIRMED, CHECKING)
        if result.identity is Identity.FOLLOWED and first is None:
            first = i
    assert first is not None and first - 12 <= 30


def test_a_part_whose_place_was_not_in_view_before_stays_unconfirmed() -> None:
    finders = FakeFinders()
    monitor = finders.monitor()
    yaws = np.concatenate([np.full(10, 33.0), np.linspace(33.0, -10.0, 25)])
    for i in range(10):
        image, pose = turned(yaws[i], i, LEFT)
        monitor.update(image, estimate(pose), i, i / 30.0, finders.others)
    for i in range(10, 35):
        monitor.update(turned(yaws[i], i, LEFT)[0], None, i, i / 30.0, finders.others)
    for i in range(35, 80):
        image, pose = turned(-10.0, i, RIGHT)
        result = monitor.update(image, estimate(pose), i, i / 30.0, finders.others)
    assert (result.identity, result.reason) == (Identity.UNCONFIRMED, MOVED)


def test_without_a_background_a_lone_part_is_followed_and_one_of_two_is_not() -> None:
    for others, expected in (([], Identity.FOLLOWED), ([RIGHT], Identity.UNCONFIRMED)):
        monitor, finders = monitor_after()
        blank = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
        for i in range(12, 30):
            monitor.update(blank, None, i, i / 30.0, finders.others)
        finders.poses = [turned(3.6, 0, pose)[1] for pose in others]
        found = turned(3.6, 0, LEFT)[1].copy()
        found[0, 3] += 250.0
        # It is settled in the first frame: none is withheld of a lone part, and none shown of one of two.
        for i in range(30, 40):
            result = monitor.update(blank, estimate(found), i, i / 30.0, finders.others)
            assert result.identity is expected
        assert finders.searches > 0


def test_a_specimen_that_another_session_tracks_is_not_taken_for_this_one() -> None:
    for is_tracked, expected in ((True, Identity.FOLLOWED), (False, Identity.UNCONFIRMED)):
        finders = FakeFinders()
        monitor = finders.monitor()
        image, left = turned(0.0, 0, LEFT)
        right = turned(0.0, 0, RIGHT)[1]
        finders.others = (right,) if is_tracked else ()
        for i in range(12):
            monitor.update(image, estimate(left), i, i / 30.0, finders.others)
        blank = np.full_like(image, 90)
        for i in range(12, 30):
            monitor.update(blank, None, i, i / 30.0, finders.others)
        finders.poses = [right]
        moved = left.copy()
        moved[0, 3] -= 250.0
        for i in range(30, 40):
            result = monitor.update(blank, estimate(moved), i, i / 30.0, finders.others)
        assert result.identity is expected
    # But this session does not take over the place of the other one.
    finders.others = (right,)
    monitor.reset()
    for i in range(12):
        monitor.update(image, estimate(left), i, i / 30.0, finders.others)
    finders.others = ()
    assert monitor.update(image, estimate(right), 12, 0.4, finders.others).reason == ANOTHER_IN_VIEW


def test_the_user_names_the_specimen_by_a_pixel() -> None:
    finders = FakeFinders()
    monitor = finders.monitor()
    outline = PartOutline(assembly_views(), CAMERA)
    image, left = turned(0.0, 0, LEFT)
    right = turned(0.0, 0, RIGHT)[1]
    x, y = outline.place(right).center_px
    with pytest.raises(InputError, match="outside the picture of 960 × 480 px"):
        monitor.name_at(4, (5000.0, 10.0))
    monitor.name_at(4, (x, y))
    finders.poses = [left, right]
    for i in range(4):
        result = monitor.update(image, estimate(left), i, i / 30.0, finders.others)
        assert result.identity is Identity.UNCONFIRMED
        assert "in frame 4" in result.reason
    result = monitor.update(image, estimate(left), 4, 4 / 30.0, finders.others)
    assert result.cam_from_model is not None
    assert np.array_equal(result.cam_from_model, right)
    result = monitor.update(image, estimate(right), 5, 5 / 30.0, finders.others)
    assert result.identity is Identity.CONFIRMED
    # Where no part is found the labels stay away.
    monitor.reset()
    monitor.name_at(0, (5.0, 5.0))
    for i in range(3):
        result = monitor.update(image, estimate(left), i, i / 30.0, finders.others)
        assert result.identity is Identity.UNCONFIRMED
        assert result.reason.startswith("no part of this kind found at 5,5 in frame 0")


def labelled(text: str, seed: int) -> tuple[NDArray[np.uint8], Array]:
    """A frame with a QR code on the left specimen, and its pose."""
    image, pose = turned(0.0, seed, LEFT)
    made = zxingcpp.create_barcode(text, zxingcpp.BarcodeFormat.QRCode)
    code = np.array(made.to_image(scale=3, add_quiet_zones=True))
    code = code[..., 0] if code.ndim == 3 else code
    u, v = np.round(PartOutline(assembly_views(), CAMERA).place(pose).center_px).astype(int)
    half = code.shape[0] // 2
    image[v - half : v - half + code.shape[0], u - half : u - half + code.shape[1]] = code[..., None]
    return image, pose


def test_a_serial_code_confirms_the_part_or_withholds_its_labels() -> None:
    for text, expected in (("BP-0042", Identity.CONFIRMED), ("BP-0043", Identity.OTHER), ("X", Identity.FOLLOWED)):
        monitor = FakeFinders().monitor(SerialNumbers("BP-0042"))
        for i in range(4):
            image, pose = labelled(text, i)
            result = monitor.update(image, estimate(pose), i, i / 30.0)
        assert result.identity is expected
        assert result.serial == ("" if text == "X" else text)
        if expected is Identity.OTHER:
            assert result.reason == "the code on this part says BP-0043, the inspection is of BP-0042"
            # Another inspection is shown, to which this part belongs.
            monitor.expect(SerialNumbers("BP-0043"))
            assert monitor.update(image, estimate(pose), 4, 0.2).identity is Identity.CONFIRMED
            monitor.expect(SerialNumbers("BP-0044"))
            assert monitor.update(image, estimate(pose), 5, 0.2).identity is Identity.OTHER


def test_a_serial_code_settles_a_doubt() -> None:
    finders = FakeFinders()
    monitor = finders.monitor(SerialNumbers("BP-0042"))
    for i in range(5):
        image, pose = turned(0.0, i, RIGHT)
        monitor.update(image, estimate(pose), i, i / 30.0, finders.others)
    finders.poses = [turned(0.0, 0, LEFT)[1], turned(0.0, 0, RIGHT)[1]]
    found = []
    for i in range(5, 60):
        image, pose = labelled("BP-0042", i)
        found.append(monitor.update(image, estimate(pose), i, i / 30.0, finders.others).identity)
    assert found[0] is Identity.UNCONFIRMED
    assert found[-1] is Identity.CONFIRMED
    assert found.count(Identity.UNCONFIRMED) <= 15


def test_what_is_known_goes_over_to_the_session_of_another_camera() -> None:
    monitor, finders = monitor_after()
    finders.poses = [turned(3.6, 0, LEFT)[1], turned(3.6, 0, RIGHT)[1]]
    image, pose = turned(3.6, 12, RIGHT)
    assert monitor.update(image, estimate(pose), 12, 0.4, finders.others).reason == ANOTHER_IN_VIEW
    other = finders.monitor()
    other.take_over(monitor)
    for i in range(13, 50):
        result = other.update(image, estimate(pose), i, i / 30.0, finders.others)
        assert (result.identity, result.reason) == (Identity.UNCONFIRMED, ANOTHER_IN_VIEW)
    other.confirm()
    third = finders.monitor()
    third.take_over(other)
    assert third.update(image, estimate(pose), 50, 2.0, finders.others).identity is Identity.CONFIRMED


def test_without_the_monitoring_every_pose_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arview.tracking.identity.monitor.IS_USED", False)
    monitor = FakeFinders().monitor()
    for i, specimen_pose in enumerate((LEFT, RIGHT, LEFT)):
        image, pose = turned(0.0, i, specimen_pose)
        assert monitor.update(image, estimate(pose), i, i / 30.0).identity is Identity.FOLLOWED


def test_an_outline_holds_its_centre_and_not_the_pixels_beside_it() -> None:
    outline = PartOutline(assembly_views(), CAMERA)
    pose = turned(0.0, 0, LEFT)[1]
    place = outline.place(pose)
    assert outline.contains(pose, place.center_px)
    assert not outline.contains(pose, place.center_px + np.array([place.diameter_px, 0.0]))
    assert len(outline.hull_px(invert(rigid(np.eye(3), [0.0, 0.0, 300.0])))) == 0
    assert outline.is_in_picture(place, 0.7)
    assert not outline.is_in_picture(place._replace(center_px=np.array([-50.0, 240.0])), 0.7)


# --- Films -----------------------------------------------------------------------------------------------


def film(cover: int, with_right: bool, moved: bool = False, count: int = 78) -> list[Pose]:
    """The left specimen is tracked and covered from frame 20 on; with ``moved`` it then is at the right place."""
    start = frame(bench(True, False), 0.0, 0)[1] @ LEFT
    session = SpecimenTracking(assembly_views(), CAMERA, assembly(), initial_cam_from_model=start)
    results = []
    for i in range(count):
        wide = bench(not (moved and i >= 20 + cover), with_right or (moved and i >= 20 + cover))
        if 20 <= i < 20 + cover:
            wide = covered(wide, LEFT)
        results.append(session.process(frame(wide, 3.0 * np.sin(i / 12.0), i)[0], i, i / 30.0))
    return results


def specimen(pose: Pose) -> str:
    """``L`` or ``R``, or ``-`` without a pose."""
    if pose.cam_from_model is None:
        return "-"
    turn = frame(bench(True, False), 3.0 * np.sin(pose.index / 12.0), 0)[1]
    center = apply(pose.cam_from_model, assembly().center_in_model)
    for name, truth in (("L", LEFT), ("R", RIGHT)):
        if np.linalg.norm(apply(turn @ truth, assembly().center_in_model) - center) < 40.0:
            return name
    return "?"


@pytest.mark.slow
@pytest.mark.parametrize("cover", [5, 20])
def test_labels_never_go_over_to_another_specimen(cover: int) -> None:
    results = film(cover, with_right=True)
    assert [specimen(pose) for pose in results[5:20]] == ["L"] * 15
    assert all(not pose.is_label_withheld for pose in results[:20])
    labelled = {specimen(pose) for pose in results if pose.cam_from_model is not None and not pose.is_label_withheld}
    assert "R" not in labelled
    assert "R" in {specimen(pose) for pose in results}, "the session never took the other specimen"
    said = {pose.identity_reason for pose in results if specimen(pose) == "R"}
    assert ANOTHER_IN_VIEW in said


@pytest.mark.slow
def test_a_lone_part_has_its_labels_back_within_a_second_of_each_lock() -> None:
    results = film(20, with_right=False)
    assert TrackingState.LOST in {pose.state for pose in results}
    assert specimen(results[-1]) == "L"
    found = next(i for i in range(22, 78) if specimen(results[i]) == "L" and results[i - 1].cam_from_model is None)
    assert results[found + 30 :] and all(not pose.is_label_withheld for pose in results[found + 30 :])
    assert sum(pose.is_label_withheld for pose in results) <= 30


@pytest.mark.slow
def test_a_lone_part_that_was_carried_to_another_place_is_followed() -> None:
    results = film(10, with_right=False, moved=True)
    found = next(i for i in range(30, 78) if specimen(results[i]) == "R")
    assert all(pose.identity is Identity.FOLLOWED for pose in results[found + 30 :])
    assert len(results[found + 30 :]) > 10
