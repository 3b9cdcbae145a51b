"""What *Pose* tells the page of the components: only what differs from the part document."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from arview.cad import load_part
from arview.core.messages import sentence, with_messages
from arview.geometry import rigid
from arview.inspection import load_inspection
from arview.overlay import OverlayOptions
from arview.pose import ComponentPresence, Identity, Pose, Presence, StepReport, TrackingState, Visibility
from arview.station.live.stream.documents import _part_pose_document, evidence_document
from helpers.live_sample import INSPECTION, PART

MOVED = rigid(np.eye(3), [0.0, 35.0, 0.0])


@pytest.fixture(scope="module")
def subject() -> Any:
    part = load_part(PART)
    inspection = load_inspection(INSPECTION, part.model)
    return SimpleNamespace(
        pending=frozenset(),
        part=part, inspection=inspection, serial=inspection.serial, label_options=OverlayOptions()
    )  # fmt: skip


def seen(presence: Presence, **more: Any) -> ComponentPresence:
    return ComponentPresence(presence, Visibility.VISIBLE, 0.5, 6, 30.0, **more)


def posed(subject: Any, **special: ComponentPresence) -> Pose:
    components = {one.name: seen(Presence.PRESENT) for one in subject.part.model.components}
    place = rigid(np.eye(3), [0.0, 0.0, 400.0])
    return Pose(place, None, 0.9, TrackingState.TRACKED, 0.0, 0, components={**components, **special})


def test_a_complete_part_needs_no_words(subject: Any) -> None:
    document = evidence_document(posed(subject), subject)
    assert document == {"completeness": "COMPLETE", "withheld": None, "legend": [], "labels": []}
    lost = replace(posed(subject), cam_from_model=None)
    assert evidence_document(lost, subject)["labels"] == []


def test_labels_say_what_is_seen(subject: Any) -> None:
    pose = posed(
        subject,
        post_1=seen(Presence.MISSING),
        nut_1=seen(Presence.UNVERIFIED),
        bracket_1=seen(Presence.DISPLACED, model_from_nominal=MOVED),
    )
    document = evidence_document(pose, subject)
    json.dumps(document, allow_nan=False)
    assert document["completeness"] == "INCOMPLETE: 1 missing, 1 displaced"
    assert [one["kind"] for one in document["legend"]] == ["missing", "displaced", "unverified"]
    names = [one.name for one in subject.part.model.components]
    labels = {names[one["index"]]: one for one in document["labels"]}
    assert set(labels) == {"post_1", "nut_1", "bracket_1"}
    missing, unverified, displaced = (labels[name] for name in ("post_1", "nut_1", "bracket_1"))
    assert (missing["word"], missing["value"], missing["notes"]) == ("MISSING", "", ["changed since measured"])
    assert (unverified["word"], unverified["value"]) == ("UNDECIDED", "0.45 mm")
    assert unverified["is_dimmed"] and unverified["notes"] == ["measured, not verified here"]
    assert (displaced["word"], displaced["value"]) == ("DISPLACED", "≈ 35 mm away")
    assert displaced["model_from_nominal"] == MOVED.ravel().tolist() and missing["model_from_nominal"] is None
    assert not any("PASS" in one["word"] for one in labels.values())


def test_nothing_is_told_of_another_specimen(subject: Any) -> None:
    pose = replace(
        posed(subject, nut_1=seen(Presence.UNVERIFIED)),
        identity=Identity.OTHER, identity_reason="measured on BP-0417", serial="BP-0001",
    )  # fmt: skip
    document = evidence_document(pose, subject)
    assert document["withheld"] == {"title": "Labels withheld: this is BP-0001", "text": "measured on BP-0417"}
    assert document["labels"] == []


def test_each_label_says_that_the_inspection_is_of_another_serial(subject: Any) -> None:
    other = SimpleNamespace(**{**vars(subject), "serial": "BP-0001"})
    labels = evidence_document(posed(subject), other)["labels"]
    assert len(labels) == len(subject.inspection.components)
    for one in labels:
        assert one["is_dimmed"] and one["notes"] == [f"measured on {subject.inspection.serial}, not on this one"]


def test_steps_of_an_assembly(subject: Any) -> None:
    assert _part_pose_document(posed(subject), subject)["steps"] is None
    fault = sentence("steps.wrong_order", name="nut_1", others="post_1")
    steps = StepReport(
        ("post_1", "nut_1"),
        (("post_1",), ("nut_1",)),
        (True, False),
        (0.0, None),
        (None, None),
        (fault,),
        ((fault, 1.0, None),),
    )
    pose = posed(subject, post_1=seen(Presence.NEXT), nut_1=seen(Presence.LATER))
    document = with_messages(_part_pose_document(replace(pose, steps=steps), subject))
    json.dumps(document, allow_nan=False)
    assert document["steps"]["text"] == "1/2 mount post_1" and document["steps"]["faults"] == [fault]
    assert [row.get("state") for row in document["steps"]["rows"]] == ["current", "locked", None]
    assert {"1/2 mount post_1", fault, "NEXT"} <= document["messages"].keys()
    labels = {one["evidence"]: one["word"] for one in document["labels"]}
    assert labels == {"next": "NEXT", "later": ""}
