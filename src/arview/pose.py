"""Pose: the result of detection and tracking for one frame: uncertainty, tracking state, components and identity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import isfinite
from types import MappingProxyType
from typing import Any

from arview.core.messages import key_of, sentence
from arview.geometry import Array


class TrackingState(StrEnum):
    """State of a tracking session."""

    SEARCHING = "searching"
    TRACKED = "tracked"
    CRITICAL = "critical"
    LOST = "lost"


class Presence(StrEnum):
    """What all frames so far say of a component; the measured verdict is another matter."""

    UNVERIFIED = "unverified"
    """Too little was seen of its place."""
    UNCERTAIN = "uncertain"
    """The evidence conflicts, or another pose fits as well in which it would be elsewhere."""
    PRESENT = "present"
    """Seen at its nominal place."""
    MISSING = "missing"
    """Its nominal place was seen without it."""
    DISPLACED = "displaced"
    """Not seen at its nominal place but at another, see `ComponentPresence.model_from_nominal`."""
    NEXT = "next"
    """A step of the assembly that mounts it is to be done now."""
    LATER = "later"
    """A later step mounts it."""
    WRONG = "wrong"
    """It is to be mounted now, and something else stands at its place."""


class Visibility(StrEnum):
    """Whether one frame shows the place of a component."""

    VISIBLE = "visible"
    HIDDEN = "hidden"
    """By the part itself or by something before it."""
    OUTSIDE = "outside"
    """Of the picture."""


@dataclass(frozen=True)
class ComponentPresence:
    """Whether a component is where the CAD has it, by all frames since the lock, and whether this frame shows it.

    Attributes:
        presence: see `Presence`.
        visibility: see `Visibility`; of this frame only.
        probability: 0–1, calibrated, that the component is at its nominal place; 0.5 without evidence.
        observations: pictures that showed its place and count.
        spread_deg: largest angle between the directions from which these were taken.
        model_from_nominal: (4,4) mm, where a displaced component was found: applied to its nominal place in the model
            frame; None unless it is displaced.
    """

    presence: Presence = Presence.UNVERIFIED
    visibility: Visibility = Visibility.HIDDEN
    probability: float = 0.5
    observations: int = 0
    spread_deg: float = 0.0
    model_from_nominal: Array | None = None


class Completeness(StrEnum):
    """The presence of all components in one word."""

    COMPLETE = "complete"
    """All are present."""
    INCOMPLETE = "incomplete"
    """At least one is missing or displaced."""
    NOT_YET_CHECKED = "not yet checked"
    """None is missing or displaced, but not all are known to be present."""


class Identity(StrEnum):
    """Whether the specimen in view is the one that was followed before, to which labels of a serial number belong."""

    FOLLOWED = "followed"
    """Since the first lock, or again where motion and scene allow no other; or there is only one."""
    CONFIRMED = "confirmed"
    """By the user, or by a serial code in the picture that agrees with the inspection."""
    UNCONFIRMED = "unconfirmed"
    """It may be another specimen of the same part: labels are withheld."""
    OTHER = "other"
    """A serial code in the picture names another specimen than the inspection: labels are withheld."""


@dataclass(frozen=True)
class StepReport:
    """How far the assembly of a part is, by the steps of its part file; all tuples but the last two have one of each.

    Attributes:
        names, components: of the steps.
        is_current: the step is to be done now: all before it are done.
        started_s: time stamp of the frame since which it is to be done; None: not yet.
        done_s: time stamp of the frame in which the last of its components was first seen; None: it is not done.
        faults: what is wrong now, one sentence for each fault: wrong order, wrong part, or a component that is gone.
        history: all faults so far, each with the time stamps at which it began and ended; None: it has not ended.
    """

    names: tuple[str, ...]
    components: tuple[tuple[str, ...], ...]
    is_current: tuple[bool, ...]
    started_s: tuple[float | None, ...]
    done_s: tuple[float | None, ...]
    faults: tuple[str, ...] = ()
    history: tuple[tuple[str, float, float | None], ...] = ()

    @property
    def text(self) -> str:
        """What is to be done now, in one sentence, such as ``3/12 mount post_3``."""
        count, waiting = len(self.names), [k for k, done_s in enumerate(self.done_s) if done_s is None]
        if not waiting:
            return sentence("steps.done", count=count)
        name, listed = self.names[waiting[0]], ", ".join(self.components[waiting[0]])
        key = "steps.mount" if name == listed else "steps.named"
        return sentence(key, number=waiting[0] + 1, count=count, names=listed, name=name)

    def rows(self) -> list[dict[str, object]]:
        """Each step as JSON values: step, name, components, state, started_s, done_s; then each fault so far: fault,
        kind, began_s, ended_s.
        """
        columns = zip(self.names, self.components, self.is_current, self.started_s, self.done_s, strict=True)
        steps: list[dict[str, object]] = [
            {
                "step": number,
                "name": name,
                "components": list(components),
                "state": "done" if done_s is not None else "current" if is_current else "locked",
                "started_s": started_s,
                "done_s": done_s,
            }
            for number, (name, components, is_current, started_s, done_s) in enumerate(columns, 1)
        ]
        faults: list[dict[str, object]] = [
            {"fault": text, "kind": key_of(text).removeprefix("steps."), "began_s": began_s, "ended_s": ended_s}
            for text, began_s, ended_s in self.history
        ]
        return steps + faults

    def since(self, zero_s: float) -> StepReport:
        """The same with times from another zero, a time stamp."""
        started_s, done_s = (
            tuple(None if one is None else one - zero_s for one in times) for times in (self.started_s, self.done_s)
        )
        history = tuple(
            (text, began_s - zero_s, None if ended_s is None else ended_s - zero_s)
            for text, began_s, ended_s in self.history
        )
        return replace(self, started_s=started_s, done_s=done_s, history=history)


MAX_NAMES = 3
"""Unverified components listed by name in a status line; of more than these only the number is given."""


@dataclass(frozen=True)
class Pose:
    """The result for one frame.

    Attributes:
        cam_from_model: (4,4) OpenCV camera from model, mm; None while searching or lost.
        covariance: (6,6) of the twist (rotation rad, translation mm) applied on the right of
            ``cam_from_model`` about the model's centre; None without a pose.
        quality: 0–1, probability that the pose is right within 5 cm, 5° and a tenth of the part's diameter; 0 without
            a pose.
        state: see `TrackingState`.
        time_s: time stamp of the frame.
        index: index of the frame in its source.
        ms: time spent on detection and tracking of this frame, milliseconds.
        reason: why the state is ``searching``, ``critical`` or ``lost``, in words.
        mismatches: components that are not as in the CAD, e.g. ``mismatch: nut_2 not seen where expected``. A part
            with any is ``critical``, never ``tracked``, because it may be another member of a product family.
        unverified: names of the components that no frame so far has shown clearly at their nominal place, because
            they are hidden, face away or show too little. Any of them may be missing or displaced.
        alternatives: other poses (4,4) that the frames so far support equally well; if there are any, the view is
            ambiguous.
        guide_cam_from_model: (4,4) where the user should bring the part; None unless the session waits for that.
        components: presence of each component by its name; empty without a pose, and of a part of one component.
        identity: see `Identity`.
        identity_reason: why the identity is unconfirmed or another, in words that say what to do.
        serial: serial number read from a code on the part in view, or empty.
        instance: names the part and which specimen of it this is where several are tracked at once, or empty.
        steps: of the assembly; None of a part without steps.
    """

    cam_from_model: Array | None
    covariance: Array | None
    quality: float
    state: TrackingState
    time_s: float
    index: int
    ms: float = 0.0
    reason: str = ""
    mismatches: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()
    alternatives: tuple[Array, ...] = ()
    guide_cam_from_model: Array | None = None
    components: Mapping[str, ComponentPresence] = field(default_factory=lambda: MappingProxyType({}))
    identity: Identity = Identity.FOLLOWED
    identity_reason: str = ""
    serial: str = ""
    instance: str = ""
    steps: StepReport | None = None

    def __repr__(self) -> str:
        if self.cam_from_model is None:
            return f"<Pose {self.index}: {self.state}>"
        x, y, z = self.cam_from_model[:3, 3]
        return f"<Pose {self.index}: {self.state}, quality {self.quality:.2f}, at {x:.1f}, {y:.1f}, {z:.1f} mm>"

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "components": dict(self.components)}  # a read-only view cannot be pickled or copied

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state | {"components": MappingProxyType(state["components"])})

    def to_dict(self) -> dict[str, object]:
        """The pose as JSON values, as in ``poses.jsonl``; a covariance that is not finite becomes None.

        Of a pose, ``presence`` maps each component to its `Presence`, ``presence_details`` to its visibility,
        probability, observations, spread_deg and, if it is displaced, model_from_nominal (4×4). ``completeness`` is a
        summary; ``identity``, ``identity_reason``, ``serial`` and ``instance`` say which specimen is meant.
        ``steps``, of a part that has them, holds what is to be done (``text``) and what is wrong (``faults``).
        """
        covariance = None if self.covariance is None else self.covariance.tolist()
        if covariance is not None and not all(isfinite(value) for row in covariance for value in row):
            covariance = None
        return {
            "index": self.index,
            "time_s": self.time_s,
            "state": str(self.state),
            "quality": self.quality,
            "cam_from_model": None if self.cam_from_model is None else self.cam_from_model.tolist(),
            "covariance": covariance,
            "ms": round(self.ms, 4),
            "reason": self.reason,
            "mismatches": list(self.mismatches),
            "unverified": list(self.unverified),
            "alternatives": [alternative.tolist() for alternative in self.alternatives],
            **self._specimen(),
            **({} if self.steps is None else {"steps": {"text": self.steps.text, "faults": list(self.steps.faults)}}),
        }

    def _specimen(self) -> dict[str, object]:
        """Components and identity of a pose as JSON values."""
        if self.cam_from_model is None:
            return {"instance": self.instance} if self.instance else {}
        details = {}
        for name, one in self.components.items():
            moved = {} if one.model_from_nominal is None else {"model_from_nominal": one.model_from_nominal.tolist()}
            details[name] = {
                "visibility": str(one.visibility),
                "probability": round(one.probability, 4),
                "observations": one.observations,
                "spread_deg": round(one.spread_deg, 1),
                **moved,
            }
        return {
            "completeness": str(self.completeness),
            "presence": {name: str(one.presence) for name, one in self.components.items()},
            "presence_details": details,
            "identity": str(self.identity),
            "identity_reason": self.identity_reason,
            "serial": self.serial,
            "instance": self.instance,
        }

    @property
    def is_label_withheld(self) -> bool:
        """Whether the labels of a serial number must not be shown with this pose."""
        return self.identity in (Identity.UNCONFIRMED, Identity.OTHER)

    @property
    def completeness(self) -> Completeness:
        """The presence of all components in one word; of a part of one component it is not checked."""
        found = {one.presence for one in self.components.values()}
        if found & {Presence.MISSING, Presence.DISPLACED}:
            return Completeness.INCOMPLETE
        return Completeness.COMPLETE if found == {Presence.PRESENT} else Completeness.NOT_YET_CHECKED

    @property
    def remark(self) -> str:
        """Text for a status line: the reason, or, of a tracked part, the components not verified yet."""
        if self.state is not TrackingState.TRACKED or not self.unverified:
            return self.reason
        if len(self.unverified) > MAX_NAMES:
            return sentence("tracking.not_verified_many", count=len(self.unverified))
        return sentence("tracking.not_verified", names=", ".join(self.unverified))
