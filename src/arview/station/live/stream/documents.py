"""The JSON documents of the protocol: *Pose*, *Part* and the parts of *Status*."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from arview import overlay
from arview.camera import Camera
from arview.inspection import ComponentDeviation, Finding, Inspection
from arview.pose import Pose
from arview.station.live.options import LiveOptions
from arview.station.live.protocol import PROTOCOL
from arview.station.live.stream.feed import Feed, TrackedFrame
from arview.station.live.stream.notices import Notice
from arview.station.live.stream.subject import OverlayStyle, Subject
from arview.station.live.stream.subjects import Subjects

Document = dict[str, Any]


def pose_document(tracked: TrackedFrame, now_s: float) -> Document:
    """*Pose*: the result of a frame; ``now_s`` is the monotonic time of the response."""
    subjects: list[Subject | None] = [None] * len(tracked.poses) if tracked.subjects is None else [*tracked.subjects]
    parts = [_part_pose_document(*of) for of in zip(tracked.poses, subjects, strict=True)]
    return {
        "type": "pose",
        "id": tracked.frame.frame_id,
        "revision": tracked.revision,
        **parts[0],
        **_list_of_several(parts),
        "camera": camera_document(tracked.camera),
        "wait_ms": _ms(tracked.started_s - tracked.arrived_s),
        "track_ms": _ms(tracked.done_s - tracked.started_s),
        "server_ms": _ms(now_s - tracked.arrived_s),
        "dropped": tracked.dropped,
        "scale": round(tracked.frame.scale, 3),
    }


def _list_of_several(parts: list[Document]) -> Document:
    """The ``parts`` of *Part* and *Pose*: each part with its number; nothing where there is only one."""
    return {"parts": [{"id": number, **one} for number, one in enumerate(parts)]} if len(parts) > 1 else {}


def _part_pose_document(pose: Pose, subject: Subject | None) -> Document:
    """What *Pose* says of one part."""
    guide, steps = pose.guide_cam_from_model, pose.steps
    return {
        "state": str(pose.state),
        "quality": round(pose.quality, 3),
        "reason": pose.reason,
        "remark": pose.remark,
        "mismatches": list(pose.mismatches),
        "unverified": list(pose.unverified),
        **evidence_document(pose, subject),
        "steps": steps and {"text": steps.text, "faults": list(steps.faults), "rows": steps.rows()},
        "identity": str(pose.identity),
        "serial": pose.serial,
        "ambiguous": len(pose.alternatives),
        "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.ravel().tolist(),
        "guide_cam_from_model": None if guide is None else guide.ravel().tolist(),
    }


def evidence_document(pose: Pose, subject: Subject | None) -> Document:
    """What the pictures say of the components: of *Pose*, only those that are not drawn as *Part* has them."""
    document: Document = {"completeness": "", "withheld": None, "legend": [], "labels": []}
    if subject is None or pose.cam_from_model is None:
        return document
    components, inspection, options = subject.part.model.components, subject.inspection, subject.label_options
    if len(components) > 1:
        document["completeness"] = overlay.completeness_text(pose)
    if pose.is_label_withheld:
        document["withheld"] = {"title": overlay.withheld_title(pose), "text": pose.identity_reason}
        document["legend"] = _legend([overlay.DrawnEvidence.WITHHELD])
        return document
    doubt = overlay.inspection_doubt(inspection, subject.serial, options) if inspection else ""
    found = {one.name: one for one in inspection.components} if inspection else {}
    shown = []
    for index, component in enumerate(components):
        presence, deviation = overlay.presence_of(pose, component.name, len(components)), found.get(component.name)
        evidence = overlay.evidence_of(presence)
        shown.append(evidence)
        is_back = deviation is not None and deviation.finding is Finding.MISSING and presence is not None
        if evidence is overlay.DrawnEvidence.SEEN and not is_back and not (doubt and deviation is not None):
            continue
        center = component.bounds_in_model.mean(axis=0)
        text = overlay.label_text(
            component.name,
            deviation,
            presence,
            options,
            center_in_model=center,
            doubt=doubt,
            is_pending=component.name in subject.pending,
        )
        moved = None if presence is None else presence.model_from_nominal
        document["labels"].append(
            {
                "index": index,
                "evidence": str(evidence),
                "value": text.value,
                "word": text.word,
                "notes": list(text.notes),
                "color": _hex(text.rgb),
                "is_dimmed": text.is_dimmed,
                "is_urgent": text.is_urgent,
                "model_from_nominal": None if moved is None else moved.ravel().tolist(),
            }
        )
    document["legend"] = _legend(shown)
    return document


def _legend(evidence: list[overlay.DrawnEvidence]) -> list[Document]:
    return [{"kind": str(kind), "text": text} for kind, text in overlay.legend_entries(evidence)]


def camera_document(camera: Camera) -> Document:
    """Intrinsics of a camera, px."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "dist": camera.dist.tolist(),
    }


def loading_document(options: LiveOptions, state: str, text: str) -> Document:
    """*Part* while the part is not loaded."""
    return {
        "protocol": PROTOCOL,
        "revision": 0,
        "state": state,
        "text": text,
        "source": "phone" if options.is_phone else "station",
        "source_name": "phone" if options.is_phone else _source_name(options.source),
        "wanted": {"width": options.width, "height": options.height, "fps": options.fps},
        "part": None,
        "components": [],
        "inspection": None,
        "arrow_scale": 1.0,
    }


def parts_document(subjects: Subjects) -> Document:
    """*Part*: the parts, their components and their measured deviations."""
    parts = [part_document(subject) for subject in subjects]
    names = [
        {"name": one.name, "mark": overlay.specimen_mark(number), "tag_color": _hex(overlay.specimen_rgb(number))}
        for number, one in enumerate(subjects)
    ]
    return {
        **loading_document(subjects.options, "ready", ""),
        "revision": subjects.revision,
        **parts[0],
        **_list_of_several([{**of, **one} for of, one in zip(names, parts, strict=True)]),
    }


def with_ages(document: Document, subjects: Subjects) -> Document:
    """*Part* with the present ages of the inspections."""

    def with_age(part: Document, subject: Subject) -> Document:
        inspection = subject.inspection
        if inspection is None or part["inspection"] is None:
            return part
        return {**part, "inspection": {**part["inspection"], "age_s": round(inspection.age_s())}}

    parts = [with_age(part, one) for part, one in zip(document.get("parts", []), subjects, strict=False)]
    return {**with_age(document, subjects[0]), **({"parts": parts} if parts else {})}


def part_document(subject: Subject) -> Document:
    """What *Part* says of one part."""
    model, inspection = subject.part.model, subject.inspection
    order = overlay.label_order([one.name for one in model.components], inspection, subject.pending)
    ranks = {name: rank for rank, name in enumerate(order)}
    components = []
    for component in model.components:
        found = inspection.find(component.name) if inspection else None
        components.append(
            {
                "name": component.name,
                "color": _hex(tuple(round(255 * value) for value in component.color)),
                "anchor_in_model": overlay.anchor_in_model(component, overlay.topology(component)).tolist(),
                "rank": ranks.get(component.name),
                **_deviation_document(found, component.name in subject.pending),
            }
        )
    return {
        "part": {
            "name": subject.part.name,
            "serial": subject.serial or "",
            "model_hash": model.source_hash,
            "diameter_mm": model.diameter_mm,
            "center_in_model": model.center_in_model.tolist(),
            "bounds_in_model": model.bounds_in_model.tolist(),
        },
        "components": components,
        "inspection": _inspection_document(inspection),
        "arrow_scale": overlay.arrow_scale(inspection, model.diameter_mm, overlay.OverlayOptions())
        if inspection
        else 1.0,
    }


def feed_document(feed: Feed) -> Document:
    """The ``feed`` of *Status*."""
    state, text = feed.state
    newest = feed.newest
    return {
        "kind": feed.kind,
        "state": state,
        "text": text,
        "age_ms": None if feed.age_ms is None else round(feed.age_ms, 1),
        "received_fps": feed.received_rate.value(),
        "tracked_fps": feed.tracked_rate.value(),
        "received": feed.received,
        "dropped": feed.dropped,
        "unreadable": feed.unreadable,
        "width": None if newest is None else newest.camera.width,
        "height": None if newest is None else newest.camera.height,
    }


def notice_documents(notices: list[Notice]) -> list[Document]:
    """The ``notices`` of *Status*."""
    return [{"code": one.code, "level": one.level, "text": one.text} for one in notices]


def style_document(style: OverlayStyle) -> Document:
    """The ``style`` of *Status* and *Control*."""
    return {
        "ghost": style.ghost,
        "edges": style.edges,
        "labels": style.labels,
        "opacity": style.opacity,
        "only": style.only,
        "only_part": style.only_part,
        "status": style.status,
    }


def _deviation_document(found: ComponentDeviation | None, is_pending: bool = False) -> Document:
    if found is None:
        names = ("verdict", "verdict_text", "verdict_color", "distance_mm", "uncertainty_mm", "tolerance_mm")
        value = overlay.MEASURING if is_pending else ""
        empty = {"displacement_mm": None, "missing": False, "value_text": value, "detail_text": ""}
        return {**dict.fromkeys(names), **empty, "is_pending": is_pending}
    return {
        "verdict": str(found.verdict),
        "verdict_text": overlay.VERDICT_WORD[found.verdict],
        "verdict_color": _hex(overlay.VERDICT_RGB[found.verdict]),
        "distance_mm": found.distance_mm,
        "uncertainty_mm": found.uncertainty_mm,
        "tolerance_mm": found.tolerance_mm,
        "displacement_mm": list(found.displacement_mm),
        "missing": found.finding is Finding.MISSING,
        "value_text": overlay.value_text(found),
        "detail_text": overlay.detail_text(found),
        "is_pending": False,
    }


def _inspection_document(inspection: Inspection | None) -> Document | None:
    if inspection is None:
        return None
    return {
        "part": inspection.part,
        "serial": inspection.serial,
        "created": inspection.created.isoformat().replace("+00:00", "Z"),
        "age_s": round(inspection.age_s(datetime.now(UTC))),
        "note": inspection.provenance.note,
        "method": inspection.provenance.method,
    }


def _source_name(source: str) -> str:
    """A source without passwords in its address and without the folder of a file."""
    if "://" in source:
        scheme, rest = source.split("://", 1)
        return f"{scheme}://{rest.split('/', 1)[0].rsplit('@', 1)[-1]}"
    return f"camera {source}" if source.isdecimal() else source.replace("\\", "/").rsplit("/", 1)[-1]


def _hex(rgb: tuple[int, ...]) -> str:
    return "#" + "".join(f"{value:02x}" for value in rgb)


def _ms(seconds: float) -> float:
    return round(1e3 * seconds, 2)
