"""The live server: a part is tracked in the video of a phone or a station camera and shown in the browser.

`arview.station.live.protocol` defines the messages between server and page. Folders, each importing only those before
it: ``security`` (access, limits, certificates, paired devices), ``stream`` (frames, tracking, drawing, recording),
``jobs`` (inspections that pages start: uploads, workers, numbers), ``transport`` (WebRTC, motion JPEG) and ``server``
(application and life cycle). ``page`` holds the static files of the browser page.
"""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.station.live.options import JobOptions as JobOptions
    from arview.station.live.options import LiveOptions as LiveOptions
    from arview.station.live.options import RecordingOptions as RecordingOptions
    from arview.station.live.security.access import Access as Access
    from arview.station.live.security.access import Gate as Gate
    from arview.station.live.security.addresses import LOOPBACK as LOOPBACK
    from arview.station.live.security.devices import Devices as Devices
    from arview.station.live.security.devices import devices_path as devices_path
    from arview.station.live.security.devices import read_devices as read_devices
    from arview.station.live.security.limits import RateLimit as RateLimit
    from arview.station.live.security.limits import body as body
    from arview.station.live.security.limits import json_body as json_body
    from arview.station.live.security.refusals import Refusal as Refusal
    from arview.station.live.security.trust_page import fingerprint as fingerprint
    from arview.station.live.server.app import refusal_handlers as refusal_handlers
    from arview.station.live.server.app import static_files as static_files
    from arview.station.live.server.app import static_response as static_response
    from arview.station.live.server.hub import Hub as Hub
    from arview.station.live.server.live_server import LiveServer as LiveServer
    from arview.station.live.server.live_server import open_endpoint as open_endpoint
    from arview.station.live.server.loading import load_subjects as load_subjects
    from arview.station.live.server.loading import warm_up as warm_up
    from arview.station.live.server.uvicorn_server import UvicornServer as UvicornServer
    from arview.station.live.server.workers import WorkerPool as WorkerPool
    from arview.station.live.stream.subjects import Subjects as Subjects

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "options": (
            "JobOptions",
            "LiveOptions",
            "RecordingOptions",
        ),
        "security.access": (
            "Access",
            "Gate",
        ),
        "security.addresses": ("LOOPBACK",),
        "security.devices": (
            "Devices",
            "devices_path",
            "read_devices",
        ),
        "security.limits": (
            "RateLimit",
            "body",
            "json_body",
        ),
        "security.refusals": ("Refusal",),
        "security.trust_page": ("fingerprint",),
        "server.app": (
            "refusal_handlers",
            "static_files",
            "static_response",
        ),
        "server.hub": ("Hub",),
        "server.live_server": (
            "LiveServer",
            "open_endpoint",
        ),
        "server.loading": (
            "load_subjects",
            "warm_up",
        ),
        "server.uvicorn_server": ("UvicornServer",),
        "server.workers": ("WorkerPool",),
        "stream.subjects": ("Subjects",),
    },
)
