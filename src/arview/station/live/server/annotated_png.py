"""Snapshots: a frame with its overlay as PNG, which also holds the data of the frame."""

from __future__ import annotations

import io
import json
from datetime import UTC, datetime

from arview.pose import Pose
from arview.station.live.stream.annotator import FrameAnnotator
from arview.station.live.stream.documents import Document, camera_document
from arview.station.live.stream.feed import TrackedFrame
from arview.station.live.stream.subject import Subject
from arview.station.live.stream.subjects import Subjects
from arview.version import __version__

CHUNK = "arview"
"""Name of the text chunk of the PNG that holds the data as JSON."""


def annotated_png(subjects: Subjects, annotator: FrameAnnotator, tracked: TrackedFrame) -> bytes:
    """PNG of an annotated frame with its data as JSON in a text chunk; it takes tens of milliseconds."""
    from PIL import Image, PngImagePlugin

    image = annotator.draw_with_status(tracked).image
    chunks = PngImagePlugin.PngInfo()
    chunks.add_itxt(CHUNK, json.dumps(_frame_data(subjects, tracked), ensure_ascii=False, allow_nan=False))
    chunks.add_itxt("Software", f"arview {__version__}")
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", pnginfo=chunks, compress_level=3)
    return file.getvalue()


def _frame_data(subjects: Subjects, tracked: TrackedFrame) -> Document:
    parts = [_part_data(subject, pose) for subject, pose in zip(subjects, tracked.poses, strict=True)]
    return {
        "arview": __version__,
        "taken": datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "frame_id": tracked.frame.frame_id,
        "camera": camera_document(tracked.camera),
        "is_camera_guessed": subjects.options.camera is None,
        "notices": [notice.text for notice in subjects.notices()],
        **parts[0],
        **({"parts": [{"id": number, **one} for number, one in enumerate(parts)]} if len(parts) > 1 else {}),
    }


def _part_data(subject: Subject, pose: Pose) -> Document:
    inspection = subject.inspection
    return {
        **({"instance": pose.instance} if pose.instance else {}),
        "part": subject.part.name,
        "serial": subject.serial or "",
        "model_hash": subject.part.model.source_hash,
        "state": str(pose.state),
        "quality": pose.quality,
        "reason": pose.reason,
        "mismatches": list(pose.mismatches),
        "unverified": list(pose.unverified),
        "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.tolist(),
        "inspection": None
        if inspection is None
        else {
            "serial": inspection.serial,
            "created": inspection.created.isoformat().replace("+00:00", "Z"),
            "components": {
                one.name: {
                    "verdict": str(one.verdict),
                    "distance_mm": one.distance_mm,
                    "uncertainty_mm": one.uncertainty_mm,
                    "tolerance_mm": one.tolerance_mm,
                }
                for one in inspection.components
            },
        },
    }
