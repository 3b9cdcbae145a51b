"""Snapshot: one frame with its overlay as PNG, with all about it inside."""

from __future__ import annotations

import io
import json
from datetime import UTC, datetime

from arview import __version__
from arview.live.stream.documents import Document, camera_document
from arview.live.stream.drawing import Drawing
from arview.live.stream.feed import Tracked
from arview.live.stream.subject import Subject

CHUNK = "arview"
"""Name of the PNG's text chunk that holds the JSON."""


def snapshot_png(subject: Subject, drawing: Drawing, tracked: Tracked) -> bytes:
    """PNG of an annotated frame with a text chunk of JSON about it; takes some ten milliseconds."""
    from PIL import Image, PngImagePlugin

    image = drawing.draw_record(tracked).image
    about = PngImagePlugin.PngInfo()
    about.add_itxt(CHUNK, json.dumps(_about(subject, tracked), ensure_ascii=False, allow_nan=False))
    about.add_itxt("Software", f"arview {__version__}")
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", pnginfo=about, compress_level=3)
    return file.getvalue()


def _about(subject: Subject, tracked: Tracked) -> Document:
    pose, inspection = tracked.pose, subject.inspection
    return {
        "arview": __version__,
        "taken": datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "part": subject.part.name,
        "serial": subject.serial or "",
        "model_hash": subject.part.model.source_hash,
        "frame_id": tracked.picture.frame_id,
        "state": str(pose.state),
        "quality": pose.quality,
        "reason": pose.reason,
        "mismatches": list(pose.mismatches),
        "unverified": list(pose.unverified),
        "cam_from_model": None if pose.cam_from_model is None else pose.cam_from_model.tolist(),
        "camera": camera_document(tracked.camera),
        "is_camera_guessed": subject.options.camera is None,
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
        "notices": [notice.text for notice in subject.notices()],
    }
