"""The order of work: hand-made evidence with noise, and a film of an assembly in twelve steps with two faults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest

from arview.assembly.observation import Glimpse
from arview.assembly.steps import StepMonitor
from arview.cad.model import Model, Step
from arview.pose import Pose, Presence, StepReport
from arview.tracking import TrackingSession
from helpers import step_film, synthetic
from helpers.step_film import Mounting, in_order, look_alike

NAMES = [component.name for component in synthetic.assembly().components]
FPS = 25.0
ABSENT, THERE, OTHER, COVERED, UNSEEN = "absent", "there", "other", "covered", "unseen"


def model(*steps: Step) -> Model:
    """The assembly of a plate with posts, blocks and a rail, mounted by steps."""
    return replace(synthetic.assembly(), steps=steps)


FOUR = (
    Step("post_1", ("post_1",)),
    Step("posts", ("post_2", "post_3"), ("post_1",)),
    Step("block_1", ("block_1",), ("posts",)),
    Step("rail", ("rail",), ("posts",)),
)


class Bench:
    """A monitor that is shown what is said of some components, in every third frame with noise."""

    def __init__(self, steps: tuple[Step, ...] = FOUR) -> None:
        self.monitor = StepMonitor(model(*steps), NAMES.index("plate"))
        self.rng, self.frame = np.random.default_rng(1), 0
        self.gone = np.zeros(len(NAMES), dtype=bool)

    def show(self, seconds: float, looks: Mapping[str, str]) -> StepReport:
        """Show components for a time; of others nothing is seen."""
        for _ in range(round(seconds * FPS)):
            time_s = self.frame / FPS
            if self.frame % 3 == 0:
                self.monitor.add(self.glimpse(looks), time_s)
            self.monitor.update(time_s, self.gone)
            self.frame += 1
        return self.monitor.report

    def glimpse(self, looks: Mapping[str, str]) -> Glimpse:
        kinds = [looks.get(name, UNSEEN) for name in NAMES]
        edges = {ABSENT: 6.0, THERE: -6.0, OTHER: 5.0, COVERED: 9.0, UNSEEN: 0.0}
        by_edges = np.array([edges[kind] for kind in kinds]) + self.rng.normal(0.0, 1.5, len(kinds))
        by_edges[[kind == UNSEEN for kind in kinds]] = 0.0
        bare = np.array([{ABSENT: 0.9, OTHER: 0.1, COVERED: 0.1}.get(kind, -1.0) for kind in kinds])
        return Glimpse(by_edges, bare, np.array([kind in (ABSENT, OTHER) for kind in kinds]))

    @property
    def now(self) -> float:
        return self.frame / FPS


def expected(report: StepReport) -> list[str]:
    return [name for name, is_current in zip(report.names, report.is_current, strict=True) if is_current]


def test_steps_are_done_in_order_and_timed() -> None:
    bench = Bench()
    report = bench.show(2.0, {"post_1": ABSENT, "post_2": ABSENT})
    assert expected(report) == ["post_1"] and report.text == "1/4 mount post_1" and report.started_s[0] == 0.0
    report = bench.show(1.0, {"post_1": THERE, "post_2": ABSENT})
    assert report.done_s[0] == pytest.approx(2.0, abs=0.15) and report.started_s[1] == report.done_s[0]
    assert expected(report) == ["posts"] and report.text == "2/4 posts: mount post_2, post_3"
    report = bench.show(1.0, {"post_2": THERE, "post_3": ABSENT})
    assert report.done_s[1] is None
    report = bench.show(1.0, {"post_2": THERE, "post_3": THERE})
    assert report.done_s[1] == pytest.approx(4.0, abs=0.15) and expected(report) == ["block_1", "rail"]
    report = bench.show(1.0, {"rail": THERE, "block_1": ABSENT})
    assert report.done_s[3] == pytest.approx(5.0, abs=0.15) and expected(report) == ["block_1"]
    report = bench.show(1.0, {"block_1": THERE})
    assert report.text == "all 4 steps done" and not report.history
    assert [row["state"] for row in report.rows()] == ["done"] * 4


def test_presence_of_what_is_not_mounted_yet() -> None:
    bench = Bench()
    bench.show(1.0, {"post_1": THERE})
    presences = dict(zip(NAMES, bench.monitor.presences, strict=True))
    assert presences["plate"] is presences["post_1"] is presences["block_2"] is None
    assert presences["post_2"] is presences["post_3"] is Presence.NEXT
    assert presences["block_1"] is presences["rail"] is Presence.LATER
    bench.show(2.0, {"post_2": OTHER})
    assert dict(zip(NAMES, bench.monitor.presences, strict=True))["post_2"] is Presence.WRONG


def test_wrong_order_is_named_until_it_is_put_right() -> None:
    bench = Bench()
    bench.show(1.0, {"post_1": ABSENT})
    report = bench.show(2.0, {"post_1": ABSENT, "rail": THERE})
    assert report.faults == ("wrong order: rail before post_1, post_2, post_3",)
    assert report.done_s[3] is None and expected(report) == ["post_1"]
    report = bench.show(1.0, {"post_1": COVERED, "rail": THERE})
    assert len(report.faults) == len(report.history) == 1
    report = bench.show(1.0, {"post_1": THERE, "post_2": THERE, "post_3": THERE})
    assert not report.faults and report.done_s[3] == pytest.approx(1.0, abs=0.15)
    (fault,) = report.history
    assert fault[1] == pytest.approx(1.0, abs=0.15) and fault[2] == pytest.approx(4.0, abs=0.5)


def test_wrong_part_is_named_until_it_is_exchanged() -> None:
    bench = Bench()
    bench.show(1.0, {"post_1": ABSENT})
    report = bench.show(2.0, {"post_1": OTHER})
    assert report.faults == ("wrong part in the place of post_1",) and report.done_s[0] is None
    report = bench.show(1.0, {"post_1": THERE})
    assert not report.faults and report.done_s[0] == pytest.approx(3.0, abs=0.15) and len(report.history) == 1


def test_a_component_that_is_gone_is_named() -> None:
    bench = Bench()
    bench.show(1.0, {"post_1": THERE})
    bench.gone[NAMES.index("post_1")] = bench.gone[NAMES.index("rail")] = True
    assert bench.show(0.5, {}).faults == ("post_1 is gone",)
    bench.gone[:] = False
    assert not bench.show(0.5, {}).faults


@pytest.mark.parametrize("look", [ABSENT, COVERED, UNSEEN])
def test_what_is_not_mounted_hidden_or_unseen_is_no_fault(look: str) -> None:
    bench = Bench()
    report = bench.show(20.0, dict.fromkeys(["post_1", "post_2", "post_3", "block_1", "rail"], look))
    assert not report.history and expected(report) == ["post_1"]


def test_an_unseen_step_is_not_called_left_out() -> None:
    report = Bench().show(10.0, {"post_1": UNSEEN, "post_2": THERE})
    assert not report.history and report.done_s == (None,) * 4


def test_short_sights_are_no_faults() -> None:
    bench = Bench()
    for _ in range(20):
        bench.show(0.6, {"post_1": OTHER})
        report = bench.show(0.6, {"post_1": ABSENT})
    assert not report.history


def test_a_film_that_begins_with_a_finished_part_has_no_faults() -> None:
    bench = Bench()
    for late in ("post_2", "post_1", "post_3"):
        bench.show(0.1, {name: THERE for name in NAMES if name != late})
    report = bench.show(1.0, dict.fromkeys(NAMES, THERE))
    assert report.text == "all 4 steps done" and not report.history


def test_what_was_done_survives_a_loss_but_not_another_specimen() -> None:
    bench = Bench()
    bench.show(1.0, {"post_1": THERE})
    bench.monitor.restart()
    assert expected(bench.show(0.2, {})) == ["posts"]
    bench.monitor.forget()
    assert expected(bench.show(0.2, {})) == ["post_1"]


def test_times_from_another_zero() -> None:
    bench = Bench()
    report = bench.show(2.0, {"post_1": OTHER}).since(-10.0)
    assert report.started_s[0] == 10.0 and report.history[0][1] == pytest.approx(10.0, abs=0.2)
    *steps, fault = report.rows()
    assert len(steps) == 4 and fault["kind"] == "wrong_part" and fault["ended_s"] is None


def tracked(done: list[Mounting], end_s: float, seed: int) -> Iterator[Pose]:
    """The poses of a film of the twelve steps."""
    session = TrackingSession.of(step_film.views(), step_film.CAMERA, step_film.assembly())
    for index, (time_s, image, truth) in enumerate(step_film.frames(done, end_s, fps=10.0, seed=seed)):
        (pose,) = session.process(image, index, time_s)
        assert pose.cam_from_model is not None
        assert synthetic.error(pose.cam_from_model, truth, step_film.assembly())[2] < 2.0
        yield pose


@pytest.mark.slow
@pytest.mark.parametrize("has_faults", [False, True])
def test_a_film_of_twelve_steps(has_faults: bool) -> None:
    names = [component.name for component in step_film.assembly().components[1:]]
    order = list(names)
    if has_faults:
        order[4], order[5] = order[5], order[4]
    done = in_order(order, 1.6)
    if has_faults:
        # The look-alike stands for 2.5 s before it is exchanged.
        later = [replace(one, time_s=one.time_s + 2.5) for one in done[8:]]
        done = [*done[:8], Mounting(done[8].time_s, look_alike(order[8], 1.3)), *later]
    truth_s = {one.component.name: one.time_s for one in done}
    poses = list(tracked(done, done[-1].time_s + 1.5, seed=int(has_faults)))
    report = poses[-1].steps
    assert report is not None and report.text == "all 12 steps done"
    off_s = [done_s - truth_s[name] for name, done_s in zip(report.names, report.done_s, strict=True) if done_s]
    assert len(off_s) == 12 and np.abs(off_s).max() < 0.5
    named = ["wrong order: rail_1 before block_2", "wrong part in the place of block_3"]
    assert [text for text, _, _ in report.history] == (named if has_faults else [])
    # Steps that are still to be done are no reason to doubt the part.
    assert not any(pose.mismatches for pose in poses) and poses[5].components["post_6"].presence is Presence.LATER
    assert sum(str(pose.state) == "tracked" for pose in poses) > 0.95 * len(poses)
