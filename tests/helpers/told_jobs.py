"""Jobs as a test wants them: answers to the page's requests about jobs, without a station that measures."""

from __future__ import annotations

import hashlib
import json
import math
import re
from dataclasses import dataclass, field
from typing import Any


def _direction(azimuth_deg: float, elevation_deg: float) -> list[float]:
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    flat = math.cos(elevation)
    return [flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)]


CELLS = [
    {"azimuth_deg": azimuth, "elevation_deg": elevation, "direction_in_model": _direction(azimuth, elevation)}
    for elevation, count in ((30, 12), (50, 9), (70, 5))
    for azimuth in [360.0 * k / count - 180.0 for k in range(count)]
]


@dataclass
class ToldJobs:
    """The jobs of a station, as one page sees them.

    Attributes:
        jobs: documents by id.
        stored: content of the photos that arrived, in order.
        attached: content of those that were taken for decisions.
        uploads: content so far by the name of an upload.
        begun: what was said of an upload when it began, by its name.
        names: of the photos that arrived, by the name of their upload.
        refusals: the next answers to pieces: status and document; an empty list answers as a station does.
        drawings: of components, by name; another one without.
        lost: number of the next pieces that arrive while their answers do not.
        is_gone: no request is answered.
    """

    jobs: dict[str, dict[str, Any]] = field(default_factory=dict)
    stored: list[bytes] = field(default_factory=list)
    attached: list[bytes] = field(default_factory=list)
    uploads: dict[str, bytearray] = field(default_factory=dict)
    begun: dict[str, dict[str, Any]] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    refusals: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    said: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    drawings: dict[str, bytes] = field(default_factory=dict)
    lost: int = 0
    is_gone: bool = False

    def attach(self, page: Any) -> None:
        """Answer the requests of a page."""
        page.route(re.compile(r"/api/jobs"), self._answer)
        page.route(re.compile(r"/control$"), _without_job)

    def add(self, name: str, **more: Any) -> dict[str, Any]:
        """Add a job."""
        job: dict[str, Any] = {
            "id": name, "part": "bracket_plate/part.toml", "part_name": "bracket_plate", "serial": "BP-1",
            "created": "2026-11-27T06:12:00Z", "parent": None, "photos": [], "attachments": [], "inspection": None,
            "rework": [], "decisions": [], "signed": None,
            "is_ended": False, "measuring_s": None, "expected_s": None,
            "rechecks": [], "before_after": [], "components": None,
            "state": {"stage": "collecting", "text": "", "photos": 0, "placed": 0, "step": "", "done": 0, "total": 0,
                      "is_rough": False, "cloud": "waiting"},
        }  # fmt: skip
        job.update(more)
        self.jobs[name] = job
        return job

    def _answer(self, route: Any) -> None:
        request = route.request
        if self.is_gone:
            return route.abort()
        path = request.url.split("/api/jobs", 1)[1].split("?")[0].strip("/")
        content = request.post_data_buffer if request.method != "GET" else None
        status, document = self._document(request.method, path, request.url, content)
        if isinstance(document, bytes):
            kind = "image/svg+xml" if path.endswith(".svg") else "image/jpeg"
            return route.fulfill(status=status, body=document, content_type=kind)
        return route.fulfill(status=status, body=json.dumps(document), content_type="application/json")

    def _document(self, method: str, path: str, url: str, content: bytes | None) -> tuple[int, Any]:
        name, _, rest = path.partition("/")
        if not name:
            if method == "GET":
                return 200, {"jobs": [_row(one) for one in self.jobs.values()]}
            said = json.loads(content or b"{}")
            return 201, self.add(f"job_{said['serial']}", serial=said["serial"])
        if name not in self.jobs:
            return 404, {"error": "no_such_job", "message": "there is no such job"}
        job = self.jobs[name]
        if rest.startswith("uploads"):
            return self._upload(job, method, rest, url, content or b"")
        if method == "GET":
            if rest == "capture":
                return 200, {"cells": CELLS, "distance_mm": [330.0, 520.0], "wanted_photos": 20}
            if rest.startswith("photos/decisions/"):
                return 200, self.attached[job["attachments"].index(rest.split("/", 1)[1])]
            if rest.startswith("photos/") and self.stored:
                return 200, self.stored[job["photos"].index(rest.split("/")[1]) % len(self.stored)]
            if rest.startswith("rework"):
                return 200, self.drawings.get(rest.split("/")[1].removesuffix(".svg"), DRAWING)
            return (200, job) if not rest else (404, {})
        if method == "DELETE":
            self.said.append((rest, {"why": url.rsplit("why=", 1)[1]}))
            job["photos"].remove(rest.split("/")[1])
            return 200, job
        said = json.loads(content or b"{}")
        self.said.append((rest, said))
        if rest == "end":
            job["state"] = {**job["state"], "stage": "measuring", "step": "placing", "done": 3, "total": 12}
            job.update(is_ended=True, measuring_s=40.0, expected_s=160.0)
        elif rest == "reopen":
            job["state"] = {**job["state"], "stage": "collecting", "step": ""}
            job.update(is_ended=False, measuring_s=None)
        elif rest == "decisions":
            job["decisions"].append({**said, "time": "2026-11-27T06:20:00Z"})
        elif rest == "ticks":
            job["decisions"].append(said)
        elif rest == "sign":
            job["signed"] = {**said, "time": "2026-11-27T06:22:00Z"}
        elif rest == "recheck":
            job["rechecks"].append(f"{name}_r1")
            return 201, self.add(f"{name}_r1", parent=name, components=said["components"], serial=job["serial"])
        return 200, job

    def _upload(self, job: dict[str, Any], method: str, rest: str, url: str, content: bytes) -> tuple[int, Any]:
        if method == "POST":
            about = json.loads(content)
            upload = f"up-{about['sha256'][:8]}"
            while upload in self.names:  # another photo may show just the same
                upload += "-again"
            self.begun[upload] = about
            return 201, {"upload": upload, "offset": len(self.uploads.setdefault(upload, bytearray()))}
        upload = rest.split("/")[1]
        if upload not in self.uploads:
            return 404, {"error": "not_found", "message": "no such upload"}
        kept = self.uploads[upload]
        if upload in self.names:  # its answer was lost, or came too late for the page
            return 200, {"photo": self.names[upload], "offset": len(kept)}
        if method == "GET":
            return 200, {"offset": len(kept)}
        if self.refusals:
            return self.refusals.pop(0)
        offset = int(url.rsplit("offset=", 1)[1])
        if offset != len(kept):
            return 409, {"error": "bad_offset", "message": "another offset", "offset": len(kept)}
        kept += content
        if self.lost:
            self.lost -= 1
            return 503, {"error": "busy", "message": "busy"}
        about = self.begun[upload]
        if len(kept) < about["bytes"]:
            return 200, {"offset": len(kept)}
        if hashlib.sha256(kept).hexdigest() != about["sha256"]:
            del self.uploads[upload]
            return 422, {"error": "bad_hash", "message": "the photo arrived damaged"}
        if about["purpose"] == "decide":
            self.attached.append(bytes(kept))
            job["attachments"].append(f"decisions/{about['sha256']}.jpg")
            self.names[upload] = job["attachments"][-1]
            return 200, {"photo": job["attachments"][-1]}
        self.stored.append(bytes(kept))
        self.names[upload] = photo = f"{len(self.stored):04d}.jpg"
        job["photos"].append(photo)
        job["state"]["photos"] = len(job["photos"])
        return 200, {"photo": photo}


def _row(job: dict[str, Any]) -> dict[str, Any]:
    found = job["inspection"]
    about = {key: job[key] for key in ("id", "part", "serial", "created", "parent")}
    return {
        **about,
        "stage": job["state"]["stage"],
        "photos": len(job["photos"]),
        "verdict": found and found["verdict"],
    }


def _without_job(route: Any) -> None:
    """Let a Control request pass without what it says of jobs."""
    said = json.loads(route.request.post_data or "{}")
    route.continue_(post_data=json.dumps({key: said[key] for key in said if key not in ("job", "capture")}))


DRAWING = (
    b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 300 160"><rect width="300" height="160" fill="#fff"/>'
    b'<rect x="90" y="50" width="60" height="40" fill="none" stroke="#c00" stroke-width="2"/>'
    b'<rect x="110" y="60" width="60" height="40" fill="none" stroke="#080" stroke-dasharray="5"/></svg>'
)
