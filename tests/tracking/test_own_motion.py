"""A part in the hand that is lost for a moment: it is the same where it is found on its way, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from arview.geometry import Array, exp_so3, rigid
from arview.tracking.identity.own_motion import OwnMotion
from arview.tracking.identity.part_outline import PartOutline
from helpers.synthetic import CAMERA, assembly_views, pose_from

START = pose_from(20, 45, 520)
DIAMETER_MM = assembly_views().diameter_mm
STEP = np.array([0.04 * DIAMETER_MM, 0.0, 3.0])
"""Motion from frame to frame, mm in the camera frame."""
LAST = 9


def moved(offset_mm: Array, turn_deg: float = 0.0) -> Array:
    """The first pose, turned about the part's centre and shifted in the camera frame."""
    center = START[:3, :3] @ assembly_views().center_in_model + START[:3, 3]
    turn = exp_so3([0.0, np.deg2rad(turn_deg), 0.0])
    about = rigid(turn, center - turn @ center + np.asarray(offset_mm))
    return about @ START


def followed(noise_mm: float = 0.4) -> OwnMotion:
    rng = np.random.default_rng(0)
    motion = OwnMotion(PartOutline(assembly_views(), CAMERA))
    for frame in range(LAST + 1):
        motion.add(frame, moved(frame * STEP + rng.normal(0.0, noise_mm, 3)))
    return motion


@pytest.mark.parametrize(
    ("frame", "offset", "turn_deg", "is_same"),
    [
        (LAST + 6, (LAST + 6) * STEP, 0.0, True),
        (LAST + 12, (LAST + 12) * STEP, 20.0, True),
        (LAST + 6, (LAST + 6) * STEP, 90.0, False),
        # Another specimen beside it, or behind it, and one where the part would be much later.
        (LAST + 6, (LAST + 6) * STEP + [0.5 * DIAMETER_MM, 0.0, 0.0], 0.0, False),
        (LAST + 6, (LAST + 6) * STEP + [0.0, 0.0, DIAMETER_MM], 0.0, False),
        (LAST + 30, (LAST + 30) * STEP, 0.0, False),
        (LAST + 14, (LAST + 20) * STEP, 0.0, False),
    ],
)
def test_a_part_found_on_its_way_is_the_same(frame: int, offset: Array, turn_deg: float, is_same: bool) -> None:
    assert followed().leads_to(frame, moved(offset, turn_deg)) is is_same


def test_wrong_poses_just_before_the_loss_do_not_lead_astray() -> None:
    motion = followed()
    motion.add(LAST + 1, moved((LAST + 1) * STEP + [0.0, 0.0, -0.6 * DIAMETER_MM]))
    assert motion.leads_to(LAST + 8, moved((LAST + 8) * STEP))


def test_a_frame_in_doubt_before_the_loss_does_not_end_the_motion() -> None:
    motion = followed()
    motion.add(LAST + 2, moved((LAST + 2) * STEP + [0.0, 0.0, -0.6 * DIAMETER_MM]))
    assert motion.leads_to(LAST + 8, moved((LAST + 8) * STEP))
    assert not motion.leads_to(LAST + 8, moved((LAST + 8) * STEP + [0.0, 0.5 * DIAMETER_MM, 0.0]))
    # After a longer break nothing is known of the motion until two more poses show it.
    motion.add(LAST + 9, moved((LAST + 9) * STEP))
    assert not motion.leads_to(LAST + 12, moved((LAST + 12) * STEP))


def test_nothing_is_said_without_a_motion() -> None:
    motion = OwnMotion(PartOutline(assembly_views(), CAMERA))
    assert not motion.leads_to(1, START)
    motion.add(0, START)
    assert not motion.leads_to(1, START)
    motion.add(5, START)
    assert not motion.leads_to(6, START)
    motion = followed()
    motion.reset()
    assert not motion.leads_to(LAST + 2, moved((LAST + 2) * STEP))
