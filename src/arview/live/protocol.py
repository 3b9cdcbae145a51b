"""What server and page tell each other: endpoints, messages, units, errors.

Lengths mm, pixels as in OpenCV (integer = pixel centre), ``_ms`` milliseconds, matrices row-major. A **client** is a
page that takes part. A **feed** is one stream of frames with its tracking: each phone has its own, all pages of a
station camera share one. A frame's ``id`` is 0 to 2^20 - 1 and wraps around; it is counted by who made the frame (the
page for a phone, the server for a station camera).

Endpoints
=========
Everything needs the token: ``GET /?token=…`` sets the cookie (``HttpOnly; SameSite=Strict``) and gives the page,
which takes the token out of its address (``history.replaceState``); from then on the cookie goes along by itself.
POST and DELETE need the ``Origin`` that browsers send by themselves. JSON goes as ``application/json``.

``GET /`` and ``GET /watch``
    ``page/index.html``, and ``page/watch.html`` for screens that only watch.
``GET /static/NAME``
    A file of the folder ``page`` by its path in there, from a list made at the start.
``GET /watch.mjpg``
    ``multipart/x-mixed-replace`` of annotated JPEGs, without strip: of the station camera, or of the phone that came
    last. At most 15 a second; 503 ``busy`` when too many watch.
``GET /api/part``
    What to show: see *Part*. It changes when ``revision`` does.
``GET /api/model.glb``
    The CAD at its nominal places, in **mm in the model frame** (no change of unit or axes). Component i of the part
    document is node ``c<i>`` (triangles with flat normals) and node ``e<i>`` (its design edges, LINES). Has an ETag.
``GET /api/status``
    See *Status*.
``POST /api/clients`` with *Join*
    Take part: 201 ``{"client": CLIENT, "answer": {"type": "answer", "sdp": …} | null}``, 503 ``busy`` or ``loading``,
    400 ``bad_offer``.
``DELETE /api/clients/CLIENT``
    Leave (``fetch`` with ``keepalive`` on ``pagehide``): 204. Who is silent is left out by itself: jpeg after 15 s
    without a request, webrtc when its connection fails.
``GET /api/clients/CLIENT/status``, ``POST /api/clients/CLIENT/control`` with *Control*
    Both answer with this client's *Status*; 400 ``bad_control`` changes nothing.
``POST /api/clients/CLIENT/frame?id=N&turns=T``, body ``image/jpeg`` without strip
    A phone's frame, transport jpeg, one in flight (429 ``one_in_flight``). Way poses: 200 *Pose*. Way video: 200
    ``image/jpeg``, annotated, with the *Pose* as ASCII JSON in the header ``X-Arview-Answer``. ``turns`` as in the
    stamp.
``GET /api/clients/CLIENT/frame?after=N``
    A station's frame, transport jpeg: waits for one other than N, 204 after 5 s without. 200 ``image/jpeg``, plain
    (way poses) or annotated (way video), with ``X-Arview-Answer``.
``GET /api/clients/CLIENT/snapshot.png?id=N``
    Frame N with its overlay as the server draws it, and all about it as JSON in the PNG's text chunk ``arview``;
    without ``id`` the newest. 404 ``no_such_frame`` when it is no longer kept: the last 12 tracked are, and the held
    one.
``GET /api/recordings/N``
    A recording finished in this run, ``video/mp4``, as a download.

WebRTC
======
One peer connection made by the page, all ICE candidates gathered before the offer is sent, no ICE servers, with
**one** video transceiver, ``sendrecv`` for a phone (its camera out, annotated video back), ``recvonly`` for a
station; and **one** data channel ``arview``, ``{ordered: false, maxRetransmits: 0}``. The camera track wants
``contentHint = "detail"`` and ``degradationPreference = "maintain-resolution"``: frames that arrive smaller are
scaled back (notice ``frames_scaled``).

Every video frame, in both directions, carries the stamp below its picture: see `arview.live.stream.stamp`. Widths and
heights are even.

- page to server: each camera frame, stamped with an id of the page;
- server to page, way video: the annotated picture, stamped with the id of the frame that it was drawn on;
- server to page, way poses: a station's plain picture, stamped; for a phone nothing, as the page has the frame.

The way is changed by control, at any time; frames of the other way may arrive for a moment after.

The data channel carries JSON texts from server to page: a *Pose* for every tracked frame (left out, never queued,
when the channel is behind), a *Status* every second and whenever its revision, notices or recording change. What the
page sends there is ignored.

Messages
========
Join::

    {"transport": "webrtc" | "jpeg", "way": "poses" | "video", "offer": {"type": "offer", "sdp": …},
     "replaces": CLIENT}      offer: with webrtc only; replaces: who this page was before, if at all; it leaves

Pose::

    {"type": "pose", "id": N, "revision": of the part document,
     "state": "searching" | "tracked" | "critical" | "lost", "quality": 0 to 1, "reason": words,
     "remark": the reason, or of a tracked part what has not been seen yet,
     "mismatches": [words], "unverified": [components not seen yet], "ambiguous": how many other poses fit as well,
     "cam_from_model": [16] | null, "guide_cam_from_model": [16] | null,      the guide while waiting to be aligned with
     "camera": {"width", "height", "fx", "fy", "cx", "cy", "dist": [5]},   of the picture as the page has it
     "wait_ms": arrival to start of tracking, "track_ms": tracking, "server_ms": arrival to this answer,
     "dropped": frames of the feed passed over so far, "scale": received over sent size, 1 as it should be}

Status::

    {"type": "status", "revision": N, "way": "poses" | "video" | null, "look": {…} | null,   null: no client
     "feed": {"kind": "phone" | "station", "state": "waiting" | "live" | "reconnecting" | "frozen", "text": words,
              "age_ms": since the newest frame came | null, "received_fps", "tracked_fps", "received", "dropped",
              "unreadable": frames without a readable stamp or JPEG, "width": px | null, "height": px | null} | null,
     "notices": [{"code": see NOTICE_CODES, "level": "info" | "warning" | "error", "text": one line}],
     "recording": {"is_on": bool, "seconds": s, "finished": [N, …]},
     "clients": count, "most_clients": count}

Control, every key and every key of ``look`` may be absent::

    {"way": "poses" | "video",
     "look": {"ghost": bool, "edges": "none" | "visible" | "all", "labels": bool, "opacity": 0 to 1,
              "only": name of the component that alone is drawn | null, "status": bool},     of what the server draws
     "reset": true,               search again
     "hold": frame id | null,     keep this frame for a snapshot; 404 no_such_frame when it is no longer there
     "record": bool}

Part::

    {"revision": N, "state": "loading" | "ready" | "failed", "text": words,
     "source": "phone" | "station", "source_name": words, "wanted": {"width", "height", "fps"},     of a phone's camera
     "part": {"name", "serial", "model_hash", "diameter_mm",
              "center_in_model": [3], "bounds_in_model": [[3], [3]]} | null,
     "components": [{"name", "color": "#rrggbb", "anchor_in_model": [3], "rank": by urgency | null,
                     "verdict": "pass" | "fail" | "undecided" | "not_measured" | null,     null: not inspected,
                     "verdict_text": "PASS" | null, "verdict_color": "#rrggbb", "missing": bool,
                     "value_text", "detail_text", "distance_mm" | null, "uncertainty_mm" | null, "tolerance_mm" | null,
                     "displacement_mm": [3, null where undetermined]}],
     "inspection": {"part", "serial", "created": ISO 8601 UTC, "age_s", "note", "method"} | null,
     "arrow_scale": how much displacement arrows are exaggerated}

Error, with any status from 400 on::

    {"error": CODE, "message": one line}

400 ``bad_request``, 403 ``no_token`` ``other_origin``, 404 ``not_found`` ``no_such_client``, 405 ``bad_method``, 408
``too_slow``, 413 ``too_large``, 415 ``bad_type``, 421 ``other_host``, 429 ``too_many`` (with ``Retry-After``), 503
``busy`` ``loading``, 500 ``internal``. ``GET /`` and ``GET /watch`` without a valid token give a page in words with
403.
"""

from __future__ import annotations

from typing import Final, Literal

Transport = Literal["webrtc", "jpeg"]
Way = Literal["poses", "video"]

COOKIE: Final = "arview"
ANSWER_HEADER: Final = "X-Arview-Answer"
CHANNEL: Final = "arview"
FRAME_IDS: Final = 1 << 20

NOTICE_CODES: Final = {
    "camera_guessed": "no camera file was given: distances are wrong by as much as the guessed focal length",
    "frames_scaled": "the browser sends smaller pictures than it has",
    "inspection_none": "no inspection was given: ghosts have no verdicts",
    "inspection_old": "the inspection is older than set",
    "inspection_serial": "the inspection is of another serial number",
    "inspection_model": "the changed inspection file belongs to another model; the last good one is shown",
    "inspection_unreadable": "the changed inspection file cannot be read; the last good one is shown",
    "source_reconnecting": "the station camera is gone and tried again",
    "source_frozen": "the station camera gives the same or no picture",
    "size_refused": "the camera file does not fit the shape of the frames",
    "stamp_unreadable": "the frame counter cannot be read: the picture arrives damaged",
    "tracking_failed": "an error inside the tracking; it began anew",
    "recording_failed": "the recording could not be written",
}
