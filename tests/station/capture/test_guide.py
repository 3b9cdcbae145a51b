"""Guided capture: what is asked for, when photos are taken, and what is said."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.cad.model import Model, make_model
from arview.cad.part import ComponentSettings, Part
from arview.cad.view_range import ViewRange
from arview.cad.viewpoint import Viewpoint, pose_at
from arview.camera import Camera
from arview.core.messages import sentence
from arview.errors import InputError
from arview.geometry import Array, exp_so3, rigid
from arview.pose import Identity, Pose, TrackingState
from arview.station.capture import CaptureAdvice, CaptureGuide, CaptureOptions, capture_document
from arview.station.capture.information import expected_error
from arview.station.capture.options import MAX_STEP_DEG
from helpers.cad_files import box
from helpers.synthetic import component

CAMERA = Camera(640, 480, 720.0, 720.0, 319.5, 239.5)
MIDDLE_MM = 420.0


def rectangles() -> np.ndarray:
    """A picture of sharp edges in all directions, with noise."""
    rng = np.random.default_rng(0)
    image = np.full((480, 640, 3), 90, dtype=np.uint8)
    for _ in range(400):
        corners = rng.uniform((0, 0), (640, 480)) + 18 * rng.standard_normal((4, 2))
        cv2.fillConvexPoly(image, cv2.convexHull(corners.astype(np.int32)), rng.uniform(0, 255, 3).tolist())
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


TEXTURE = rectangles()
SOFT = cv2.GaussianBlur(TEXTURE, (0, 0), 4.0)


def model() -> Model:
    """A plate with a wall along its middle, a bracket on its +x side and a nut on its -x side, close to the wall."""
    return make_model(
        "part",
        (
            component("plate", box((-80, -80, -8), (80, 80, 0)), (0.5, 0.5, 0.5)),
            component("wall", box((-3, -80, 0), (3, 80, 50)), (0.5, 0.5, 0.5)),
            component("bracket_2", box((4, -10, 0), (20, 10, 14)), (0.5, 0.5, 0.5)),
            component("nut_1", box((-16, -8, 0), (-4, 8, 10)), (0.5, 0.5, 0.5)),
        ),
    )


def part(elevation_deg: tuple[float, float] = (15.0, 60.0), azimuth_deg: tuple[float, float] = (-180.0, 180.0)) -> Part:
    settings = [ComponentSettings("plate", role="base")]
    settings += [ComponentSettings(name, position_tolerance_mm=0.5) for name in ("wall", "bracket_2", "nut_1")]
    view_range = ViewRange((300.0, 600.0), elevation_deg=elevation_deg, azimuth_deg=azimuth_deg)
    return Part("part", Path("part.toml"), Path("part.step"), model(), tuple(settings), view_range)


def at(azimuth_deg: float, elevation_deg: float, distance_mm: float = MIDDLE_MM, roll_deg: float = 0.0) -> Array:
    return pose_at(Viewpoint(distance_mm, elevation_deg, azimuth_deg, roll_deg), model().center_in_model)


def tracked(cam_from_model: Array | None, time_s: float, quality: float = 0.9, **changes: object) -> Pose:
    state = TrackingState.LOST if cam_from_model is None else TrackingState.TRACKED
    values: dict[str, object] = {"state": state, "time_s": time_s, "index": 0, **changes}
    return Pose(cam_from_model, None, quality, **values)  # type: ignore[arg-type]


class Walk:
    """Frames at 20 per second, one after another."""

    def __init__(self, guide: CaptureGuide) -> None:
        self.guide = guide
        self.time_s = 0.0

    def frame(self, pose: Array | None, image: np.ndarray | None = None, **changes: object) -> CaptureAdvice:
        self.time_s += 0.05
        gyro = changes.pop("gyro", None)
        return self.guide.update(tracked(pose, self.time_s, **changes), image, self.time_s, gyro)  # type: ignore

    def stay(self, pose: Array, frames: int = 40, image: np.ndarray | None = None, **changes: object) -> CaptureAdvice:
        """Frames at a place, until a photo is asked for."""
        for _ in range(frames):
            advice = self.frame(pose, image, **changes)
            if advice.takes:
                break
        return advice


@pytest.fixture
def walk() -> Walk:
    return Walk(CaptureGuide(part(), CAMERA))


def test_a_still_sharp_new_view_is_taken_once(walk: Walk) -> None:
    advice = walk.stay(at(0, 35), image=TEXTURE)
    assert advice.takes and advice.take_id == 1 and advice.reason == ""
    # It is asked for until it is reported, and not again under another number.
    again = walk.frame(at(0, 35), TEXTURE)
    assert again.takes and again.take_id == 1 and again.reason == sentence("capture.taking")
    walk.guide.photo_taken(at(0, 35))
    after = walk.stay(at(0, 35), image=TEXTURE)
    assert not after.takes and after.reason == sentence("capture.already_taken") and after.photos == 1
    # Not from a place beside it either, whatever its distance and roll.
    assert not walk.stay(at(6, 37, 460.0, 30.0), image=TEXTURE).takes
    assert walk.stay(at(25, 35), image=TEXTURE).take_id == 2


@pytest.mark.slow
def test_nothing_is_taken_while_the_camera_moves(walk: Walk) -> None:
    for index in range(100):  # 40° a second
        advice = walk.frame(at(2.0 * index, 35), TEXTURE)
        assert not advice.takes
    assert advice.reason == sentence("capture.hold_still")
    assert walk.stay(at(2.0 * 99, 35), image=TEXTURE).takes


def test_nothing_is_taken_while_the_gyroscope_turns(walk: Walk) -> None:
    advice = walk.stay(at(0, 35), image=TEXTURE, gyro=0.6)
    assert not advice.takes and advice.reason == sentence("capture.hold_still")
    assert walk.stay(at(0, 35), image=TEXTURE, gyro=0.03).takes


def test_nothing_is_taken_while_the_picture_is_blurred(walk: Walk) -> None:
    for _ in range(3):
        walk.frame(at(0, 35), TEXTURE)
    advice = walk.stay(at(0, 35), frames=8, image=SOFT)
    assert not advice.takes and advice.reason == sentence("capture.not_sharp")
    assert walk.stay(at(0, 35), image=TEXTURE).takes


@pytest.mark.slow
def test_a_stream_that_was_sharp_is_not_taken_out_of_focus(walk: Walk) -> None:
    assert walk.stay(at(0, 35), image=TEXTURE).takes
    walk.guide.photo_taken(at(0, 35))
    advice = walk.stay(at(30, 35), frames=80, image=SOFT)  # longer than sharpness is remembered
    assert not advice.takes and advice.reason in (sentence("capture.not_sharp"), sentence("capture.out_of_focus"))
    assert advice.reason == sentence("capture.out_of_focus")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"state": TrackingState.CRITICAL}, sentence("capture.uncertain")),
        ({"quality": 0.3}, sentence("capture.not_tracked")),
        ({"identity": Identity.UNCONFIRMED}, sentence("capture.other_specimen")),
        ({"alternatives": (np.eye(4),)}, sentence("capture.ambiguous")),
    ],
)
def test_nothing_is_taken_of_an_uncertain_pose(walk: Walk, changes: dict[str, object], reason: str) -> None:
    advice = walk.stay(at(0, 35), image=TEXTURE, **changes)
    assert not advice.takes and advice.reason == reason
    assert walk.stay(at(0, 35), image=TEXTURE).takes


def test_nothing_is_taken_of_a_lost_part(walk: Walk) -> None:
    for _ in range(30):
        advice = walk.frame(None, TEXTURE)
    assert not advice.takes and advice.reason == sentence("capture.not_tracked") and advice.text == "20 more photos"
    first = walk.frame(at(0, 35), TEXTURE)
    assert not first.takes and first.reason == sentence("capture.hold_still")  # its motion is not known yet


def test_quality_has_a_hysteresis(walk: Walk) -> None:
    for _ in range(20):
        assert not walk.frame(at(0, 35), quality=0.45).takes  # below the limit at which it counts as certain
    assert walk.stay(at(0, 35), quality=0.6).takes
    walk.guide.photo_taken(at(0, 35))
    assert walk.stay(at(40, 35), quality=0.45).takes  # above that at which it no longer does


def test_distance_and_picture(walk: Walk) -> None:
    near, far = walk.guide.dome.distance_mm
    assert 300.0 <= near < far <= 600.0
    advice = walk.stay(at(0, 35, 590.0 + 200.0))
    assert (advice.takes, advice.distance, advice.reason) == (False, "far", sentence("capture.closer"))
    advice = walk.stay(at(0, 35, 0.8 * near))
    assert (advice.takes, advice.distance, advice.reason) == (False, "near", sentence("capture.farther"))
    aside = rigid(exp_so3([0.0, 0.45, 0.0]), np.zeros(3)) @ at(0, 35)
    advice = walk.stay(aside)
    assert (advice.takes, advice.distance, advice.reason) == (False, "good", sentence("capture.not_inside"))
    assert walk.stay(at(0, 35)).takes


def test_the_next_place_is_the_one_that_lowers_the_error_most(walk: Walk) -> None:
    needs, dome = walk.guide.needs, walk.guide.dome
    for azimuth in (0, 25, 50):
        walk.guide.photo_taken(at(azimuth, 35))
    next_cell = needs.plan[0]
    known, weights = needs._known, needs._weights
    after = expected_error(known.with_each(dome.views)) @ weights
    photos = np.array(needs._directions)
    in_reach = (dome.directions @ photos.T).max(axis=1) >= np.cos(np.radians(MAX_STEP_DEG))
    is_open = np.array([index not in needs.filled for index in range(len(after))])
    assert is_open[next_cell] and in_reach[next_cell]
    assert after[next_cell] == pytest.approx(after[in_reach & is_open].min())
    # The nut is behind the wall for all three: the place must be one from which it is seen.
    assert dome.is_seen[next_cell, 3]
    azimuth, elevation = dome.angles_deg[next_cell]
    middle_mm = float(np.sqrt(np.prod(dome.distance_mm)))
    walk.guide.photo_taken(at(azimuth, elevation, middle_mm))
    assert expected_error(needs._known.information()) @ weights == pytest.approx(after[next_cell])


@pytest.mark.slow
def test_the_text_names_the_side_and_what_is_hidden(walk: Walk) -> None:
    # From +x the camera's right is +y, that is growing azimuth; photos on that side are taken.
    for azimuth in range(0, 181, 22):
        walk.guide.photo_taken(at(azimuth, 25))
        walk.guide.photo_taken(at(azimuth, 48))
    sides = [walk.guide.dome.angles_deg[cell][0] % 360.0 for cell in walk.guide.needs.plan]
    assert sides and all(180.0 < azimuth < 360.0 for azimuth in sides)
    advice = walk.frame(at(0, 35))
    assert "from the left" in advice.text and "right" not in advice.text
    assert "the right" in walk.frame(at(180, 35)).text
    # Held upside down, the picture's left and right change places.
    assert "from the right" in walk.frame(at(0, 35, roll_deg=180.0)).text


def test_a_component_that_lacks_photos_is_named_where_it_is_hidden(walk: Walk) -> None:
    hidden = walk.frame(at(0, 20)).text
    assert "nut_1 is hidden from here" in hidden and "bracket_2" not in hidden
    assert "bracket_2 is hidden from here" in walk.frame(at(180, 20)).text
    rows = {row.name: row for row in walk.frame(at(180, 20)).components}
    assert rows["bracket_2"].text == "hidden from here; 4 more photos" and not rows["bracket_2"].is_enough


@pytest.mark.slow
def test_following_the_advice_is_enough_after_the_wanted_photos(walk: Walk) -> None:
    guide, asked = walk.guide, []
    while not guide.needs.is_enough and len(asked) < 45:
        azimuth, elevation = guide.dome.angles_deg[guide.needs.plan[0]]
        advice = walk.stay(at(azimuth, elevation), image=TEXTURE)
        assert advice.takes, advice.reason
        guide.photo_taken(at(azimuth, elevation))
        asked.append((azimuth, elevation))
    assert len(asked) == guide.options.wanted_photos
    # Less than a minute for a person who is led to one place a second.
    assert walk.time_s < 60.0
    advice = walk.frame(at(0, 35))
    assert advice.is_enough and advice.progress == 1.0 and not advice.takes and advice.text == "enough photos"
    assert sum(cell.is_filled for cell in advice.cells) == 20 and not any(cell.is_wanted for cell in advice.cells)
    assert all(row.is_enough and row.photos >= 4 and row.directions >= 3 for row in advice.components)
    assert all(row.predicted_u_mm is not None and row.predicted_u_mm < 0.15 for row in advice.components)


def test_a_component_that_no_photo_can_show_does_not_go_on_for_ever() -> None:
    guide = CaptureGuide(part(elevation_deg=(15.0, 30.0), azimuth_deg=(-20.0, 20.0)), CAMERA)
    for azimuth, elevation in guide.dome.angles_deg:
        guide.photo_taken(at(azimuth, elevation))
    advice = guide.update(tracked(at(0, 25), 0.0), None, 0.0)
    assert advice.is_enough
    nut = advice.components[3]
    assert nut.photos == 0 and nut.predicted_u_mm is None and not nut.is_enough
    assert nut.text == "other components hide it from every direction asked for"


@pytest.mark.slow
def test_a_failed_photo_is_asked_for_again(walk: Walk) -> None:
    assert walk.stay(at(0, 35)).take_id == 1
    walk.guide.photo_failed()
    assert walk.stay(at(0, 35)).take_id == 2
    # One that is never reported counts as failed after a while.
    for _ in range(200):
        advice = walk.frame(at(0, 35))
    assert advice.take_id == 3 and advice.photos == 0


def test_only_some_components_for_a_part_that_is_checked_again() -> None:
    guide = CaptureGuide(part(), CAMERA, CaptureOptions(wanted_photos=5, components=("nut_1",)))
    assert 5 <= len(guide.needs.plan) <= 8
    assert all(guide.dome.is_seen[cell, 3] for cell in guide.needs.plan)
    with pytest.raises(InputError, match="nut_9"):
        CaptureGuide(part(), CAMERA, CaptureOptions(components=("nut_9",)))


def test_photos_of_before_count() -> None:
    before = [at(azimuth, 35) for azimuth in range(0, 360, 40)]
    guide = CaptureGuide(part(), CAMERA, taken=before)
    advice = guide.update(tracked(at(0, 35), 0.0), None, 0.0)
    assert advice.photos == 9 and len(guide.needs.plan) == 11 and advice.progress == pytest.approx(9 / 20)
    with pytest.raises(InputError, match="taken"):
        CaptureGuide(part(), CAMERA, taken=[np.zeros((4, 4))])


def test_the_document_and_the_layout_agree(walk: Walk) -> None:
    walk.guide.photo_taken(at(0, 35))
    advice = walk.frame(at(30, 35))
    document = capture_document(advice, job="part_1")
    layout = walk.guide.layout()
    assert document["job"] == "part_1" and len(document["cells"]) == len(layout["cells"]) == len(advice.cells)
    assert document["cells"].count("1") == 1 and document["cells"].count("2") == 19
    assert [row["index"] for row in document["components"]] == [0, 1, 2, 3]
    assert document["components"][0]["U_mm"] is None
    assert "components" not in capture_document(advice, has_components=False)
    near, far = layout["distance_mm"]
    assert near < far and layout["wanted_photos"] == 20
    for cell in layout["cells"]:
        assert np.linalg.norm(cell["direction_in_model"]) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("wanted", [0, 2, 41, 1000])
def test_numbers_of_photos_that_contradict_each_other(wanted: int) -> None:
    with pytest.raises(InputError, match="photos"):
        CaptureOptions(wanted_photos=wanted)
