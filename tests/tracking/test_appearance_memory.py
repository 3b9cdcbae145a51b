"""Appearance memory: new views are kept, found again, and never accepted without the detector."""

from __future__ import annotations

import time
import zipfile
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from arview.errors import InputError, MismatchError, OutputError
from arview.geometry import Array, apply, rotation_angle_rad
from arview.guideviews import GuideViewOptions, GuideViewSet, make_guide_views
from arview.pose import TrackingState
from arview.refinement.evidence import PoseEvidence
from arview.tracking import Estimate, SessionOptions, SpecimenTracking, appearance_memory
from arview.tracking import session as session_module
from arview.tracking.appearance_memory import MAX_VIEWS, AppearanceMemory
from arview.tracking.search import search_plan
from arview.tracking.search.ncc_search import MAX_RESULTS
from arview.tracking.search.view_crops import CROP_PX, ViewCropper
from helpers.synthetic import CAMERA, RANGE, assembly, assembly_views, bracket, error, path, picture, pose_from

SIDES = [(azimuth, elevation) for azimuth in (-40, 0, 40) for elevation in (30, 55)]


def estimate(pose: Array, quality: float = 1.0, support: float = 0.9, in_picture: float = 1.0) -> Estimate:
    return Estimate(pose, np.eye(6), quality, PoseEvidence(support, 0.9, 0.3, 0.9, 0.9, 0.3, in_picture))


def taught(sides: list[tuple[int, int]]) -> AppearanceMemory:
    """Memory of the assembly from some sides, each tracked for some frames."""
    memory = AppearanceMemory(assembly_views(), CAMERA)
    for azimuth, elevation in sides:
        pose = pose_from(azimuth, elevation, 520)
        image = picture(pose, seed=100 + azimuth + elevation, scene=1)
        for _ in range(8):
            memory.learn(image, estimate(pose), True)
    return memory


@cache
def six_sides() -> AppearanceMemory:
    return taught(SIDES)


def is_near(found: Array, truth: Array) -> bool:
    """Whether a pose is within 15°, 15 % of the distance and 15 % of the diameter sideways."""
    center = assembly().center_in_model
    a, b = apply(found, center), apply(truth, center)
    turned = np.rad2deg(rotation_angle_rad(found, truth))
    across_mm = error(found, truth)[1]
    return bool(turned < 15 and abs(a[2] / b[2] - 1) < 0.15 and across_mm < 0.15 * assembly().diameter_mm)


def moved(azimuth: float, elevation: float, rng: np.random.Generator) -> Array:
    """A pose from about that side at another place, distance and roll."""
    azimuth, elevation = azimuth + rng.uniform(-6, 6), elevation + rng.uniform(-6, 6)
    pose = pose_from(azimuth, elevation, rng.uniform(440, 620), None, rng.uniform(-180, 180))
    pose[:2, 3] += rng.uniform([-90, -50], [90, 50])
    return pose


@pytest.mark.slow
def test_kept_sides_are_found_anywhere_in_other_scenes_and_light() -> None:
    memory, rng = six_sides(), np.random.default_rng(5)
    assert len(memory) == len(SIDES)
    right = 0
    for k in range(24):
        truth = moved(*SIDES[k % len(SIDES)], rng)
        image = picture(truth, seed=k, scene=k % 9, noise=6.0, gain=rng.uniform(0.7, 1.3))
        proposals = memory.propose(image)
        assert len(proposals) <= MAX_RESULTS
        right += any(is_near(p.cam_from_model, truth) for p in proposals)
    assert right >= 16


@pytest.mark.slow
def test_a_search_near_the_last_pose_is_fast() -> None:
    memory, rng = taught(SIDES), np.random.default_rng(6)
    for azimuth in range(-75, 76, 10):
        for elevation in (20, 42, 65):
            pose = pose_from(azimuth, elevation, 520)
            memory.add(picture(pose, scene=1), pose, is_new=True)
    assert len(memory) == MAX_VIEWS
    right, seconds = 0, []
    for k in range(12):
        last = pose_from(*SIDES[k % len(SIDES)], 520)
        truth = pose_from(
            SIDES[k % 6][0] + rng.uniform(-15, 15),
            SIDES[k % 6][1] + 5,
            rng.uniform(450, 600),
            None,
            rng.uniform(-25, 25),
        )
        truth[:2, 3] += rng.uniform([-90, -50], [90, 50])
        image = picture(truth, seed=k, scene=k % 9)
        began = time.thread_time()
        proposals = memory.propose(image, last)
        seconds.append(time.thread_time() - began)
        right += any(is_near(p.cam_from_model, truth) for p in proposals)
    assert right >= 10
    assert np.median(seconds) < 0.1  # about 25 ms on a quiet core


def test_memory_is_bounded_and_views_close_together_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(appearance_memory, "MAX_VIEWS", 4)
    monkeypatch.setattr(appearance_memory, "VIEW_STEP_DEG", 2)
    memory = taught([*SIDES, (-40, 33), (37, 30)])
    assert len(memory) == 4
    directions = memory.rotations[:, 2]
    cosines = directions @ directions.T - 2 * np.eye(4)
    assert cosines.max() < np.cos(np.deg2rad(10.0))


def test_only_new_views_of_a_well_tracked_part_are_learned() -> None:
    memory = AppearanceMemory(assembly_views(), CAMERA)
    pose = pose_from(0, 40, 520)
    image = picture(pose, scene=1)

    def see(frames: int, seen: Estimate, is_sure: bool = True, shown: np.ndarray = image) -> int:
        for _ in range(frames):
            memory.learn(shown, seen, is_sure)
        return len(memory)

    assert see(30, estimate(pose), is_sure=False) == 0
    assert see(30, estimate(pose, quality=0.5)) == 0
    assert see(30, estimate(pose, in_picture=0.5)) == 0
    assert see(30, estimate(pose)) == 1
    assert see(60, estimate(pose)) == 1
    assert see(30, estimate(pose_from(30, 40, 520), support=0.5)) == 1  # a hand over it
    # From the same side, but with a different appearance.
    other = np.asarray(cv2.GaussianBlur(255 - image, (0, 0), 8))
    assert see(30, estimate(pose), shown=other) == 2
    began = time.thread_time()
    see(400, estimate(pose))
    assert (time.thread_time() - began) / 400 < 0.5e-3  # 0.02 ms on a quiet core


def test_the_silhouette_is_that_of_the_part() -> None:
    cropper = ViewCropper(assembly_views(), CAMERA)
    for azimuth, elevation in SIDES:
        pose = pose_from(azimuth, elevation, 480)
        cut = cropper.crop(picture(pose, scene=2), pose)
        assert cut is not None
        shown, mask = cut
        assert shown.shape == (CROP_PX, CROP_PX, 3)
        empty = cropper.crop(picture(None, scene=2), pose)
        assert empty is not None
        is_part = np.abs(shown.astype(int) - empty[0]).max(axis=2) > 12
        inside = mask > 0
        assert np.count_nonzero(is_part & inside) > 0.8 * np.count_nonzero(is_part | inside)
    far = pose_from(0, 40, 20000)
    assert cropper.crop(picture(None, scene=2), far) is None


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The detector never searches the whole picture."""
    for module in (search_plan, session_module):
        monkeypatch.setattr(module, "EAGER_FRAMES", 0)
    monkeypatch.setattr(search_plan, "SEARCH_EVERY", 10_000)


@pytest.mark.slow
@pytest.mark.usefixtures("no_search")
def test_no_pose_is_accepted_without_the_part() -> None:
    session = SpecimenTracking(assembly_views(), CAMERA, assembly())
    session.search.memory = six_sides()
    session._state.state = TrackingState.LOST
    for k in range(12):
        session._state.last_sure_pose = pose_from(*SIDES[k % 6], 520)
        assert session.process(picture(None, seed=k, scene=10 + k), k, 0.0).cam_from_model is None
    # The bracket is another part, in the same place.
    for k in range(6):
        session._state.last_sure_pose = pose_from(*SIDES[k], 520)
        image = picture(pose_from(*SIDES[k], 400, bracket()), bracket(), seed=k, scene=k)
        assert session.process(image, k, 0.0).cam_from_model is None


@pytest.mark.slow
@pytest.mark.usefixtures("no_search")
def test_a_lost_part_is_found_by_its_appearance() -> None:
    found = {}
    for use_appearance_memory in (True, False):
        options = SessionOptions(use_appearance_memory=use_appearance_memory)
        session = SpecimenTracking(assembly_views(), CAMERA, assembly(), options, initial_cam_from_model=path(1)[0])
        for k, pose in enumerate(path(20)):
            tracked = session.process(picture(pose, seed=k, scene=1), k, k / 30)
        assert tracked.state == TrackingState.TRACKED
        assert len(session.search.memory) == (1 if use_appearance_memory else 0)
        while session.state != TrackingState.LOST:
            session.process(np.full((480, 640, 3), 90, dtype=np.uint8), 20, 1.0)
        truth = path(20)[-1]
        truth[:2, 3] += [-90, -40]
        pose = session.process(picture(truth, seed=99, scene=1), 21, 1.0).cam_from_model
        found[use_appearance_memory] = pose is not None and error(pose, truth)[0] < 5
    assert found == {True: True, False: False}


def test_views_are_saved_and_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory, file = six_sides(), tmp_path / "assembly.learned"
    memory.save(file)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]
    other = AppearanceMemory(assembly_views(), CAMERA)
    other.load(file)
    assert np.array_equal(other.rotations, memory.rotations)
    image = picture(pose_from(2, 32, 500), scene=3)
    mine, theirs = memory.propose(image), other.propose(image)
    assert mine and np.allclose(mine[0].cam_from_model, theirs[0].cam_from_model)
    monkeypatch.setattr(appearance_memory, "MAX_VIEWS", 3)
    small = AppearanceMemory(assembly_views(), CAMERA)
    small.load(file)
    assert len(small) == 3


@cache
def bracket_views() -> GuideViewSet:
    return make_guide_views(bracket(), RANGE, GuideViewOptions(subdivisions=2, renderer="zbuffer"))


def test_other_files_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "views.learned"
    six_sides().save(file)
    with pytest.raises(MismatchError, match=r"views\.learned: learned views of model 'assembly'.*'bracket'"):
        AppearanceMemory(bracket_views(), CAMERA).load(file)
    whole = file.read_bytes()
    memory = AppearanceMemory(assembly_views(), CAMERA)
    for content in (b"", b"text", whole[: len(whole) // 2], whole[:-4000] + bytes(4000)):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"views\.learned.*delete the file") as caught:
            memory.load(file)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="cannot be read"):
        memory.load(tmp_path / "none")
    with pytest.raises(OutputError, match="cannot be written"):
        memory.save(tmp_path / "no" / "folder")


@pytest.mark.parametrize("member", ["meta", "rotations", "pictures", "masks"])
@pytest.mark.parametrize("header", ["(2473901161920,)", "(2,", "(1, 2)", "()"])
def test_members_whose_headers_lie_are_refused(tmp_path: Path, member: str, header: str) -> None:
    file = tmp_path / "views.learned"
    six_sides().save(file)
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    text = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {header}, }}\n".encode()
    members[f"{member}.npy"] = b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + bytes(64)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(InputError, match=r"views\.learned.*damaged.*delete the file"):
        AppearanceMemory(assembly_views(), CAMERA).load(file)
