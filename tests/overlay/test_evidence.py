"""What the pictures say of a component decides how its ghost and label are drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from numpy.typing import NDArray
from overlay.test_overlay import CAMERA, GREY, NOW, box, deviation, inspection, orbit, pose, post

from arview.cad.model import Model, make_model
from arview.core.messages import sentence
from arview.geometry import apply, rigid
from arview.inspection import ComponentDeviation, Finding, Inspection, Verdict
from arview.overlay import OverlayOptions, OverlayRenderer, labels
from arview.overlay.annotations import LaidOutLabel
from arview.overlay.evidence import DISPLACED_RGB, NEXT_RGB, DrawnEvidence
from arview.overlay.legend import legend_entries
from arview.overlay.status import completeness_text
from arview.pose import ComponentPresence, Identity, Pose, Presence, StepReport, Visibility

MOVED = rigid(np.eye(3), [40.0, 0.0, 0.0])
BARE = {"show_labels": False, "show_status": False, "show_legend": False}


@pytest.fixture(scope="module")
def model() -> Model:
    posts = [post(f"p{i}", -60.0 + 60 * i, 0.0, 14.0, 50.0) for i in range(3)]
    return make_model("plate", (box("base", (0, 0, -4), (200, 120, 8)), *posts))


@pytest.fixture(scope="module")
def record(model: Model) -> Inspection:
    return inspection(model, *(deviation(f"p{i}", (0.03, 0.01, -0.04), "pass") for i in range(3)))


def seen(presence: Presence, **more: object) -> ComponentPresence:
    return ComponentPresence(presence, Visibility.VISIBLE, 0.5, 6, 30.0, **more)  # type: ignore[arg-type]


def posed(special: Mapping[str, ComponentPresence] | None = None, identity: Identity = Identity.FOLLOWED) -> Pose:
    present = {name: seen(Presence.PRESENT) for name in ("base", "p0", "p1", "p2")}
    return replace(
        pose(orbit(90.0, 40.0, 480.0)),
        components={**present, **(special or {})},
        identity=identity,
        identity_reason="another plate is in view: confirm which one it is",
    )


def label(renderer: OverlayRenderer, name: str) -> LaidOutLabel:
    (found,) = (one for one in renderer.laid_out.labels if one.text.name == name)
    return found


def place_of(name: str, model: Model, moved: NDArray[np.float64] | None = None) -> tuple[slice, slice]:
    """The middle of a component in the picture."""
    points = apply(moved if moved is not None else np.eye(4), model.component(name).vertices_in_model)
    pixels = CAMERA.project(apply(orbit(90.0, 40.0, 480.0), points))
    (u0, v0), (u1, v1) = pixels.min(axis=0), pixels.max(axis=0)
    u, v = round(0.5 * (u0 + u1)), round(0.5 * (v0 + v1))
    return slice(v - 14, v + 15), slice(u - 9, u + 10)


def changed(picture: NDArray[np.uint8], grey: NDArray[np.uint8] = GREY) -> NDArray[np.float64]:
    return np.abs(picture.astype(float) - grey).max(axis=-1)


@pytest.mark.parametrize("presence", [Presence.UNVERIFIED, Presence.UNCERTAIN, Presence.MISSING, Presence.DISPLACED])
def test_only_a_present_component_has_an_undimmed_pass(model: Model, record: Inspection, presence: Presence) -> None:
    renderer = OverlayRenderer(model, CAMERA, record)
    found = seen(presence, model_from_nominal=MOVED if presence is Presence.DISPLACED else None)
    renderer.draw(GREY, posed({"p1": found}), now=NOW)
    shown = label(renderer, "p1")
    assert shown.text.is_dimmed or "PASS" not in shown.lines
    assert ("0.05 mm" in shown.lines) == (presence in (Presence.UNVERIFIED, Presence.UNCERTAIN))
    for name in ("p0", "p2"):
        assert label(renderer, name).lines == (name, "0.05 mm", "PASS")
        assert not label(renderer, name).text.is_dimmed


def test_texts_by_evidence(record: Inspection) -> None:
    options = OverlayOptions()
    passed = record.find("p1")
    center = np.array([0.0, 0.0, 25.0])

    def text(found: ComponentPresence, measured: ComponentDeviation | None = passed) -> labels.LabelText:
        return labels.label_text("p1", measured, found, options, center_in_model=center)

    unverified = text(seen(Presence.UNVERIFIED))
    assert (unverified.word, unverified.notes, unverified.is_dimmed) == ("PASS", ("measured, not verified here",), True)
    missing = text(seen(Presence.MISSING))
    assert (missing.value, missing.word, missing.notes) == ("", "MISSING", ("changed since measured",))
    assert text(seen(Presence.MISSING), None).notes == ()
    displaced = text(seen(Presence.DISPLACED, model_from_nominal=MOVED))
    assert (displaced.value, displaced.word) == ("≈ 40 mm away", "DISPLACED")
    assert displaced.notes == ("changed since measured",)
    measured_so = deviation("p1", (39.5, 0.3, 0.0), "fail")
    assert text(seen(Presence.DISPLACED, model_from_nominal=MOVED), measured_so).notes == ()
    turned = rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [6.0, 0.0, 0.0])
    assert text(seen(Presence.DISPLACED, model_from_nominal=turned), None).notes == ("turned 90°",)
    assert text(seen(Presence.DISPLACED, model_from_nominal=turned), None).value == "≈ 6.0 mm away"
    absent = ComponentDeviation(
        "p1", (None,) * 3, None, (False,) * 6, None, None, Verdict.FAIL, finding=Finding.MISSING
    )
    assert text(seen(Presence.MISSING), absent).notes == ("as measured",)
    back = text(seen(Presence.PRESENT), absent)
    assert back.is_dimmed and back.notes == ("seen now: changed since measured",)
    withheld = labels.label_text("p1", passed, seen(Presence.PRESENT), options, is_withheld=True)
    assert (withheld.value, withheld.word, withheld.verdict) == ("", "WITHHELD", None)


@pytest.mark.usefixtures("no_arrows")
def test_a_missing_component_is_hatched(model: Model, record: Inspection) -> None:
    options = OverlayOptions(show_edges="none", **BARE)
    renderer = OverlayRenderer(model, CAMERA, record, options)
    where = place_of("p1", model)
    plain = changed(renderer.draw(GREY, posed(), now=NOW))[where]
    hatched = changed(renderer.draw(GREY, posed({"p1": seen(Presence.MISSING)}), now=NOW))[where]
    # A plain ghost changes slowly from pixel to pixel; of a hatched one a part is strong and the rest faint.
    assert plain.min() > 5 and plain.max() - plain.min() < 25
    strong = hatched > 60
    assert 0.3 < strong.mean() < 0.8
    assert hatched[~strong].max() < 45
    for name in ("p0", "p2"):
        there = place_of(name, model)
        assert np.array_equal(changed(renderer.draw(GREY, posed(), now=NOW))[there] > 5, np.ones_like(strong))


@pytest.mark.usefixtures("no_arrows")
def test_a_displaced_component_is_drawn_at_both_places(model: Model, record: Inspection) -> None:
    options = OverlayOptions(show_edges="none", **BARE)
    moved = rigid(np.eye(3), [0.0, 45.0, 0.0])
    renderer = OverlayRenderer(model, CAMERA, record, options)
    found = {"p1": seen(Presence.DISPLACED, model_from_nominal=moved)}
    picture = renderer.draw(GREY, posed(found), now=NOW)
    nominal, there = changed(picture)[place_of("p1", model)], picture[place_of("p1", model, moved)].astype(float)
    assert np.ptp(nominal) > 40
    tint = (there - there.mean(axis=2, keepdims=True)).mean(axis=(0, 1))
    expected = np.array(DISPLACED_RGB) - np.mean(DISPLACED_RGB)
    assert tint @ expected / np.linalg.norm(tint) / np.linalg.norm(expected) > 0.9
    without = changed(renderer.draw(GREY, posed(), now=NOW))[place_of("p1", model, moved)]
    assert without.mean() < changed(picture)[place_of("p1", model, moved)].mean()


@pytest.mark.usefixtures("no_arrows")
def test_the_outline_of_an_unverified_component_is_dashed(model: Model) -> None:
    options = OverlayOptions(show_ghost=False, **BARE)
    renderer = OverlayRenderer(model, CAMERA, options=options)
    whole = changed(renderer.draw(GREY, posed(), now=NOW)) > 10
    dashed = changed(renderer.draw(GREY, posed({"p1": seen(Presence.UNVERIFIED)}), now=NOW)) > 10
    v, u = place_of("p1", model)
    near = (slice(v.start - 30, v.stop + 30), slice(u.start - 18, u.stop + 18))
    assert 0.35 < dashed[near].sum() / whole[near].sum() < 0.75
    assert dashed.sum() - dashed[near].sum() == whole.sum() - whole[near].sum()


@pytest.mark.parametrize("identity", [Identity.UNCONFIRMED, Identity.OTHER])
def test_labels_of_another_specimen_are_withheld(model: Model, record: Inspection, identity: Identity) -> None:
    renderer = OverlayRenderer(model, CAMERA, record)
    renderer.draw(GREY, posed(), now=NOW)
    assert len(renderer.laid_out.labels) == 3
    picture = renderer.draw(GREY, posed(identity=identity), now=NOW)
    assert renderer.laid_out.labels == () and renderer.laid_out.pointers == ()
    # No colour of a verdict is on the part, and the reason is written above it.
    for name in ("p0", "p1", "p2"):
        rgb = picture[place_of(name, model)].astype(int)
        assert np.ptp(rgb, axis=2).max() <= 16
    assert changed(picture[:70], GREY[:70]).any()


def test_a_part_of_one_component_is_not_checked_and_others_are_unverified(record: Inspection) -> None:
    single = make_model("m", (post("only", 0.0, 0.0, 14.0, 50.0),))
    result = inspection(single, deviation("only", (0.03, 0.01, -0.04), "pass"))
    plain = Pose(orbit(90.0, 40.0, 480.0), None, 0.9, posed().state, 0.0, 0)
    renderer = OverlayRenderer(single, CAMERA, result)
    renderer.draw(GREY, plain, now=NOW)
    assert not label(renderer, "only").text.is_dimmed
    two = make_model("m", (post("a", -40.0, 0.0), post("b", 40.0, 0.0)))
    result = inspection(two, deviation("a", (0.03, 0, 0), "pass"), deviation("b", (0.03, 0, 0), "pass"))
    renderer = OverlayRenderer(two, CAMERA, result)
    renderer.draw(GREY, plain, now=NOW)
    assert {one.text.is_dimmed for one in renderer.laid_out.labels} == {True}
    renderer = OverlayRenderer(two, CAMERA, result, OverlayOptions(show_evidence=False))
    renderer.draw(GREY, plain, now=NOW)
    assert {one.text.is_dimmed for one in renderer.laid_out.labels} == {False}


def test_a_stale_or_other_inspection_is_said_on_each_label(model: Model, record: Inspection) -> None:
    aged = OverlayOptions(max_age_days=30)
    for renderer, now, note in (
        (OverlayRenderer(model, CAMERA, record, aged), NOW + timedelta(days=45), "measured 45 d ago"),
        (OverlayRenderer(model, CAMERA, record, serial="SN 8"), NOW, "measured on SN 7, not on this one"),
    ):
        renderer.draw(GREY, posed(), now=now)
        assert len(renderer.laid_out.labels) == 3
        assert all(one.text.is_dimmed and note in one.text.notes for one in renderer.laid_out.labels)
    for renderer in (
        OverlayRenderer(model, CAMERA, record, aged),
        OverlayRenderer(model, CAMERA, record, serial="SN 7"),
    ):
        renderer.draw(GREY, posed(), now=NOW)
        assert not any(one.text.is_dimmed for one in renderer.laid_out.labels)


def test_a_component_that_something_hides_says_so(model: Model, record: Inspection) -> None:
    renderer = OverlayRenderer(model, CAMERA, record)
    hidden = {"p1": replace(seen(Presence.PRESENT), visibility=Visibility.HIDDEN)}
    renderer.draw(GREY, posed(hidden), now=NOW)
    assert label(renderer, "p1").text.notes == ()
    for _ in range(5):
        renderer.draw(GREY, posed(hidden), now=NOW)
    assert label(renderer, "p1").text.notes == (labels.OCCLUDED,)
    assert label(renderer, "p0").text.notes == ()


def test_the_legend_explains_only_what_is_in_the_picture(model: Model, record: Inspection) -> None:
    assert legend_entries([DrawnEvidence.SEEN] * 3) == ()
    entries = legend_entries(
        [DrawnEvidence.SEEN, DrawnEvidence.MISSING, DrawnEvidence.UNVERIFIED, DrawnEvidence.UNCERTAIN]
    )
    assert [kind for kind, _ in entries] == [DrawnEvidence.MISSING, DrawnEvidence.UNVERIFIED]
    pictures = {}
    for shown in (True, False):
        renderer = OverlayRenderer(model, CAMERA, record, OverlayOptions(show_legend=shown))
        pictures[shown] = renderer.draw(GREY, posed({"p1": seen(Presence.MISSING)}), now=NOW)
        legend_top = 480 - renderer.status_height_px - 30
        if shown:
            assert all(one.box.y + one.box.height <= legend_top for one in renderer.laid_out.labels)
    differs = np.flatnonzero(np.any(pictures[True] != pictures[False], axis=(1, 2)))
    assert len(differs) and differs.min() >= legend_top - 4


def test_completeness_in_words() -> None:
    assert completeness_text(posed()) == "COMPLETE"
    assert completeness_text(posed({"p1": seen(Presence.UNVERIFIED)})) == "NOT YET CHECKED"
    found = {"p1": seen(Presence.MISSING), "p2": seen(Presence.DISPLACED), "p0": seen(Presence.MISSING)}
    assert completeness_text(posed(found)) == "INCOMPLETE: 2 missing, 1 displaced"


def test_missing_components_are_labelled_without_an_inspection(model: Model) -> None:
    renderer = OverlayRenderer(model, CAMERA)
    renderer.draw(GREY, posed(), now=NOW)
    assert renderer.laid_out.labels == ()
    renderer.draw(GREY, posed({"p2": seen(Presence.MISSING)}), now=NOW)
    assert [one.lines for one in renderer.laid_out.labels] == [("p2", "MISSING")]


def test_the_next_component_is_ghosted_and_later_ones_are_not_drawn(model: Model) -> None:
    steps = StepReport(
        ("p0", "p1", "p2"), (("p0",), ("p1",), ("p2",)), (False, True, False), (0.0,) * 3, (1.0, None, None)
    )
    awaited = posed({"p1": seen(Presence.NEXT), "p2": seen(Presence.LATER)})
    renderer = OverlayRenderer(model, CAMERA, options=OverlayOptions(show_status=False))
    picture = renderer.draw(GREY, replace(awaited, steps=steps))
    found = label(renderer, "p1").text
    assert (
        found.word == "NEXT" and found.rgb == NEXT_RGB and [one.text.name for one in renderer.laid_out.labels] == ["p1"]
    )
    bare = OverlayRenderer(model, CAMERA, options=OverlayOptions(**BARE))
    ghosts = bare.draw(GREY, replace(awaited, steps=steps))
    red, _, blue = ghosts[place_of("p1", model)].reshape(-1, 3).mean(axis=0)
    assert red > blue + 40
    # Where the last one is to come the picture shows the base alone, as if the model ended there.
    without = OverlayRenderer(make_model("plate", model.components[:3]), CAMERA, options=OverlayOptions(**BARE))
    expected = without.draw(GREY, replace(awaited, components=dict(list(awaited.components.items())[:3])))
    assert changed(ghosts, expected)[place_of("p2", model)].max() <= 2
    assert changed(picture)[place_of("p0", model)].max() > 20


def test_a_wrong_part_is_hatched_and_named(model: Model) -> None:
    fault = sentence("steps.wrong_part", name="p1")
    steps = StepReport(("p1",), (("p1",),), (True,), (0.0,), (None,), (fault,), ((fault, 1.0, None),))
    renderer = OverlayRenderer(model, CAMERA)
    named = replace(posed({"p1": seen(Presence.WRONG)}), steps=steps)
    picture = renderer.draw(GREY, named)
    assert label(renderer, "p1").text.word == "WRONG PART"
    calm = renderer.draw(GREY, replace(named, steps=replace(steps, faults=())))
    top = np.s_[: CAMERA.height // 10]
    assert changed(picture, calm)[top].max() > 40
    entries = dict(legend_entries([DrawnEvidence.WRONG, DrawnEvidence.NEXT, DrawnEvidence.LATER]))
    assert list(entries.values()) == ["another part at its place", "to be mounted now"]
