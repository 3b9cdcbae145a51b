"""A pose that is known from elsewhere, as by a robot: where a part is looked for, and what its covariance adds."""

from __future__ import annotations

import numpy as np
import pytest

from arview import PosePrior
from arview.errors import InputError
from arview.geometry import exp_so3, rigid
from arview.pose import Pose, TrackingState
from arview.tracking import SessionOptions, TrackedPart, TrackingSession
from helpers.synthetic import CAMERA, assembly, assembly_views, background, error, picture, pose_from, wrong

BEFORE, AFTER = pose_from(20.0, 45.0, 440.0), pose_from(-35.0, 38.0, 560.0, roll_deg=8.0)
RNG = np.random.default_rng(4)
SURE = np.diag([1e-4**2] * 3 + [0.02**2] * 3)
UNSURE = np.diag([0.05**2] * 3 + [15.0**2] * 3)


class NoFinder:
    """Never finds the part, so that only the prior leads to it."""

    def detect(self, image: np.ndarray) -> list[object]:
        return []


def started(options: SessionOptions | None = None) -> TrackingSession:
    session = TrackingSession.of(assembly_views(), CAMERA, assembly(), options, initial_cam_from_model=BEFORE)
    for index in range(3):
        (pose,) = session.process(picture(BEFORE, seed=index))
    assert pose.state is TrackingState.TRACKED
    return session


def after(session: TrackingSession, prior: PosePrior | None) -> Pose:
    return session.process(picture(AFTER, seed=7), prior=prior)[0]


def test_a_jump_that_is_known_is_followed_without_a_search() -> None:
    near = wrong(AFTER, np.random.default_rng(5), 4.0, 3.0)
    pose = after(started(SessionOptions(finder=NoFinder())), PosePrior(near))
    assert pose.state is TrackingState.TRACKED and pose.cam_from_model is not None
    mm, _, deg = error(pose.cam_from_model, AFTER)
    assert mm < 1.5 and deg < 0.5


def test_a_sure_prior_is_taken_and_makes_the_pose_surer() -> None:
    plain = after(started(), PosePrior(AFTER))
    joined = after(started(), PosePrior(AFTER, SURE))
    assert plain.cam_from_model is not None and joined.cam_from_model is not None
    assert plain.covariance is not None and joined.covariance is not None
    assert error(joined.cam_from_model, AFTER)[0] < 0.05
    assert np.all(np.diag(joined.covariance) <= np.diag(SURE) * 1.001)
    assert np.all(np.linalg.eigvalsh(plain.covariance - joined.covariance) > 0.0)
    np.testing.assert_allclose(joined.covariance, joined.covariance.T)


def test_a_prior_beside_the_part_changes_nothing() -> None:
    session, other = started(), started()
    aside = rigid(np.eye(3), [90.0, 40.0, 0.0]) @ BEFORE
    for index in range(3, 6):
        image = picture(BEFORE, seed=index)
        (with_prior,), (without,) = session.process(image, prior=PosePrior(aside, SURE)), other.process(image)
        assert with_prior.state is TrackingState.TRACKED and with_prior.cam_from_model is not None
        np.testing.assert_allclose(with_prior.cam_from_model, without.cam_from_model, atol=0.3)


def test_a_lost_part_is_found_at_the_prior() -> None:
    session = started(SessionOptions(finder=NoFinder()))
    for index in range(4):
        (pose,) = session.process(background(index))
    assert pose.state is TrackingState.LOST
    assert after(session, None).cam_from_model is None
    pose = after(session, PosePrior(wrong(AFTER, np.random.default_rng(6), 5.0, 8.0), UNSURE))
    assert pose.cam_from_model is not None
    mm, _, deg = error(pose.cam_from_model, AFTER)
    assert mm < 2.0 and deg < 0.6


@pytest.mark.parametrize(
    ("prior", "reason"),
    [
        (PosePrior(2.0 * np.eye(4)), "prior"),
        (PosePrior(BEFORE, np.eye(3)), "must be 6×6"),
        (PosePrior(BEFORE, -np.eye(6)), "finite and positive"),
        (PosePrior(BEFORE, np.full((6, 6), np.nan)), "finite and positive"),
    ],
)
def test_priors_that_are_none_are_refused(prior: PosePrior, reason: str) -> None:
    session = TrackingSession.of(assembly_views(), CAMERA, assembly())
    with pytest.raises(InputError, match=reason):
        session.process(background(0), prior=prior)


def test_a_prior_of_one_of_several_specimens_is_refused() -> None:
    parts = [TrackedPart(assembly_views(), assembly(), name) for name in "ab"]
    with pytest.raises(InputError, match="several specimens"):
        TrackingSession(parts, CAMERA).process(background(0), prior=PosePrior(BEFORE))


def test_a_joined_pose_is_the_weighted_mean() -> None:
    measured, body_from_model = rigid(exp_so3([0.1, 0.2, -0.3]), [10.0, 20.0, 500.0]), rigid(np.eye(3), [1.0, 2, 3])
    known = measured @ rigid(np.eye(3), [0.4, 0.0, 0.0])
    prior = PosePrior(known @ body_from_model, 3.0 * np.eye(6))
    pose, covariance = prior.joined(measured, body_from_model, np.eye(6))
    np.testing.assert_allclose(pose, measured @ rigid(np.eye(3), [0.1, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(covariance, 0.75 * np.eye(6), atol=1e-12)
