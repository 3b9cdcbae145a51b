"""The protocol between server and page: endpoints, messages, units, errors.

Lengths are in mm, pixels as in OpenCV (an integer is the centre of a pixel), ``_ms`` in milliseconds, matrices
row-major. A **client** is a page that takes part. A **feed** is one stream of frames with its tracking: each phone has
its own, and all pages of a station camera share one. A frame's ``id`` is 0 to 2^20 - 1 and wraps around; it is assigned
by the page for a phone and by the server for a station camera.

Endpoints
=========
All requests need a token: ``GET /?token=…`` with the token of the run pairs the browser, unless it is paired. It sets
the cookie (``HttpOnly; SameSite=Strict``) with a token of this device, which stays valid over restarts, and returns the
page, which removes the token from its address (``history.replaceState``); later requests carry the cookie. POST, PATCH
and DELETE need the ``Origin`` header that browsers send. JSON is sent as ``application/json``.

``GET /`` and ``GET /watch``
    ``page/index.html``, and ``page/watch.html`` for screens that only watch.
``GET /static/NAME``
    A file of the folder ``page``, by its path below it, from a list made at the start.
``GET /watch.mjpg``
    ``multipart/x-mixed-replace`` of annotated JPEGs without strip: of the station camera, or of the phone that joined
    last. At most 15 per second; 503 ``busy`` when too many screens watch.
``GET /api/part``, ``GET /api/part?client=CLIENT``
    The parts to show: see *Part*. It changes when ``revision`` does. For a client that is bound to a job it holds the
    numbers of that job; without ``client`` it never does.
``GET /api/model.glb?part=N``
    The CAD model of part N, without ``part`` of the first, in **mm in the model frame** (units and axes are not
    converted). Component i of the part document is node ``c<i>`` (triangles with flat normals) and node ``e<i>`` (its
    design edges, LINES). The response has an ETag.
``GET /api/status``
    See *Status*.
``POST /api/clients`` with *Join*
    Take part: 201 ``{"client": CLIENT, "answer": {"type": "answer", "sdp": …} | null}``, 503 ``busy`` or ``loading``,
    400 ``bad_offer``.
``DELETE /api/clients/CLIENT``
    Leave (``fetch`` with ``keepalive`` on ``pagehide``): 204. Silent clients are removed: with jpeg after 15 s without
    a request, with webrtc when the connection fails.
``GET /api/clients/CLIENT/status``, ``POST /api/clients/CLIENT/control`` with *Control*
    Both return the *Status* of this client; 400 ``bad_control`` changes nothing.
``POST /api/clients/CLIENT/frame?id=N&turns=T``, body ``image/jpeg`` without strip
    A frame of a phone, transport jpeg, one at a time (429 ``one_in_flight``). In mode poses: 200 *Pose*. In mode video:
    200 ``image/jpeg``, annotated, with the *Pose* as ASCII JSON in the header ``X-Arview-Answer``. ``turns`` is defined
    as in the stamp.
``GET /api/clients/CLIENT/frame?after=N``
    A frame of a station camera, transport jpeg: waits for a frame other than N; 204 when none arrives within 5 s. 200
    ``image/jpeg``, plain (mode poses) or annotated (mode video), with ``X-Arview-Answer``.
``GET /api/clients/CLIENT/snapshot.png?id=N``
    Frame N, without ``id`` the newest, with the overlay that the server draws. The PNG's text chunk ``arview`` holds
    its data as JSON. 404 ``no_such_frame`` when the frame is no longer kept: the last 12 tracked frames and the held
    one are.
``POST /api/clients/CLIENT/snapshots?id=N``
    The same snapshot, kept at the station beside the recordings: 201 ``{"name"}``, 507 ``disk_full``.
``GET /api/snapshots``, ``GET /api/snapshots/NAME``
    ``{"snapshots": [{"name", "bytes", "created"}]}``, the newest first; and one of them, ``image/png``.
``GET /api/recordings``
    ``{"recordings": [{"number", "name", "bytes", "seconds" | null, "created", "is_recovered": cut off by a crash}]}``:
    the finished recordings in the folder, those of earlier runs included.
``GET /api/recordings/N``
    The video of one of them, ``video/mp4``, as a download. Its poses stay at the station.
``GET /api/devices``, ``DELETE /api/devices/NAME``
    ``{"devices": [{"name", "created", "last_used", "is_this"}]}``: the paired devices; and forget one (204), whose
    pages stop at once.

Jobs
====
A job is the inspection of one specimen, from its first photo to the signature, in a folder at the station. Whatever is
answered with 200 or 201 here is on the disk, and there after a crash. 404 ``no_such_job``, 507 ``disk_full`` where
something could not be stored; then it is not confirmed.

``GET /api/jobs``
    ``{"jobs": [{"id", "part": its number here | null, "part_name", "serial", "created", "stage", "verdict" | null,
    "photos": count, "parent" | null, "is_ended"}]}``, the oldest first.
``POST /api/jobs`` ``{"part": N, "serial": text}``
    201 *Job*; 200 where a job of that part and serial number is not finished: it is continued.
``GET /api/jobs/JOB``
    *Job*.
``GET /api/jobs/JOB/capture``
    ``{"cells": [{"azimuth_deg", "elevation_deg", "direction_in_model": [3]}], "distance_mm": [near, far],
    "wanted_photos"}`` of guided capture; 503 ``loading`` while it begins.
``POST /api/jobs/JOB/uploads`` ``{"bytes", "sha256", "source", "taken", "hint", "media_type"}``
    Announce a photo: JPEG, PNG or HEIC. ``source``: "still" | "stream" | "upload" | "station"; ``hint`` | null:
    ``{"cam_from_model": [16] | null, "camera": as in *Pose* | null, "quality": 0 to 1 | null}``. 201 ``{"upload",
    "offset"}``: where to go on, above 0 for one that was begun before; 200 ``{"photo": name}`` if it is stored. 413
    ``too_large``, 415 ``bad_type``, 429 ``too_many``. With ``"purpose": "decide"`` the photo is kept for a decision
    and not measured: its name is ``decisions/`` and the hash.
``GET /api/jobs/JOB/uploads/UPLOAD``
    ``{"offset"}``, of a stored photo with ``photo``; 404 ``no_such_upload``.
``PATCH /api/jobs/JOB/uploads/UPLOAD?offset=N``, body: the next bytes, 1 MiB at most
    ``{"offset"}``, or after the last ones ``{"photo": name}``. 409 ``bad_offset`` with the right ``offset``; 422
    ``bad_hash`` and ``bad_photo``: the upload is dropped, and can be begun again.
``POST /api/jobs/JOB/take`` ``{"client"}``
    Store the newest frame of a client that is bound to the job, with its pose: 201 ``{"photo"}``. With
    ``"purpose": "decide"`` it is kept for a decision, as in an announcement. 409 ``other_job``,
    ``no_such_frame``.
``POST /api/jobs/JOB/end``, ``POST /api/jobs/JOB/reopen``
    No more photos come, or more come after all: *Job*. A photo that was announced before still counts after the end.
    A measurement that runs is ended by the second, and begins anew after the next end.
``DELETE /api/jobs/JOB/photos/NAME?why=blurred``
    *Job* without this photo, which counts no more; ``why``: a word for the log. 400 after the end.
``POST /api/jobs/JOB/recheck`` ``{"components": [names]}``
    201 *Job* that measures these components again; 409 ``not_done`` before the first measurement.
``POST /api/jobs/JOB/decisions`` ``{"component", "is_ok", "reason", "note", "by", "photo": name | null}``, ``…/ticks``
``{"component", "step": index, "is_done", "by"}``, ``…/sign`` ``{"by", "note"}``
    201, the entry of the log, see `arview.quality.decisions`, which a job and its re-checks share; 409 ``not_done``
    while there is no result. A signature holds for the values and verdicts: it is void if the cloud changes one of
    them.
``GET /api/jobs/JOB/report.html``, ``inspection.json``, ``decisions.csv``, ``photos/NAME``, ``rework/COMPONENT.svg``,
``rework/PICTURE``
    Files of the job; a picture by the name that an instruction has for it, a drawing with ``?screen`` for a page.

WebRTC
======
The page creates one peer connection without ICE servers and gathers all ICE candidates before it sends the offer. The
connection has **one** video transceiver, ``sendrecv`` for a phone (its camera out, annotated video back) and
``recvonly`` for a station camera, and **one** data channel ``arview``, ``{ordered: false, maxRetransmits: 0}``. The
camera track should have ``contentHint = "detail"`` and ``degradationPreference = "maintain-resolution"``: frames that
arrive smaller are scaled back (notice ``frames_scaled``).

Every video frame, in both directions, carries a stamp below its picture: see `arview.station.live.stream.stamp`. Widths
and heights are even.

- page to server: each camera frame, stamped with an id assigned by the page;
- server to page, mode video: the annotated picture, stamped with the id of the frame that it was drawn on;
- server to page, mode poses: the plain picture of a station camera, stamped; nothing for a phone, whose page has the
  frame.

*Control* can change the mode at any time; a few frames of the previous mode may still arrive.

The data channel carries JSON texts from server to page: a *Pose* for every tracked frame (dropped, never queued, when
the channel is congested), and a *Status* every second and whenever its revision, notices, recording or job change. The
page may send ``{"type": "motion", "gyro_rad_s": rate of turn}`` there, ten times a second, for guided capture (with
jpeg: ``&gyro=`` in the address of its frames); other messages are ignored.

Messages
========
**Several parts.** *Part* and *Pose* describe one part. Where several parts, or specimens of one, are shown, they
describe the first one, and have ``parts`` in addition: a list of all of them, each with its number ``id`` (from 0) and
the keys that are marked ``(part)`` below. This came with version 2 of the protocol; a page of version 1 shows the first
part. Version 3 has jobs; a page of version 2 works as before.

Join::

    {"transport": "webrtc" | "jpeg", "mode": "poses" | "video", "offer": {"type": "offer", "sdp": …},
     "replaces": CLIENT}      offer: with webrtc only; replaces: an earlier client of this page, which then leaves

**Texts.** All texts are English. *Pose*, *Status*, *Part*, *Job* and ``capture`` have ``"messages": {text: {"key",
"values": {name: text, number, {"key", "values"} or a list of those}}}`` for those of their texts that are sentences of
the catalogue (`arview.core.messages`), so that a page can say them in its own language; of a text of several sentences
with ``; `` between them, each is looked up by itself where the whole is not there. Errors and notices without one have
their code.

Pose::

    {"type": "pose", "id": N, "revision": of the part document,
     (part) "state": "searching" | "tracked" | "critical" | "lost", "quality": 0 to 1, "reason": text,
     "remark": the reason, or of a tracked part what has not been seen yet,
     "mismatches": [words], "unverified": [components not seen yet], "ambiguous": how many other poses fit as well,
     "completeness": "COMPLETE", "INCOMPLETE: 1 missing", "NOT YET CHECKED" or empty,
     "withheld": {"title", "text"} | null,     of another specimen: nothing that was measured is shown
     "steps": {"text": what is to be done now, "faults": [texts], "rows": [{"step": number from 1, "name",
               "components": [names], "state": "done" | "current" | "locked", "started_s", "done_s": time
               stamp of a frame | null}, …, {"fault": text, "kind", "began_s", "ended_s"}, …]}
               | null,     of a part with [[steps]]
     "identity": "followed" | "confirmed" | "unconfirmed" | "other",   is it the part that was followed, see Identity
     "serial": read from a code on the part, or empty,
     "legend": [{"kind": evidence, "text"}],   kinds of evidence that need an explanation
     "labels": [{"index": of the component, "evidence": "seen" | "unverified" | "uncertain" | "missing" | "displaced" |
                     "next" | "later" (not to be drawn) | "wrong",      the last three of a part with steps
                 "value", "word": on the label instead of the verdict, "notes": [texts], "color": "#rrggbb",
                 "is_dimmed": measured, but not seen so here, "is_urgent": bool,
                 "model_from_nominal": [16] | null}],     only of components that differ from *Part*
     "cam_from_model": [16] | null, "guide_cam_from_model": [16] | null,      guide: while it waits to be aligned with
     (all)
     "camera": {"width", "height", "fx", "fy", "cx", "cy", "dist": [5]},   intrinsics for the picture on the page
     "wait_ms": arrival to start of tracking, "track_ms": tracking, "server_ms": arrival to this response,
     "dropped": frames dropped by the feed so far, "scale": received over sent size, 1 when unscaled,
     "capture": {"job", "take_id", "takes": take a photo now, once for each take_id, "text", "reason": why not now,
                 "progress": 0 to 1, "is_enough", "photos", "distance": "near" | "good" | "far",
                 "cells": a letter for each, "0" open, "1" filled, "2" wanted,
                 "components": [{"index", "photos", "U_mm" | null, "is_enough", "text"}] when changed, or every second}}
                                                                                 with guided capture only

Status::

    {"type": "status", "revision": N, "mode": "poses" | "video" | null, "style": {…} | null,   null: no client
     "feed": {"kind": "phone" | "station", "state": "waiting" | "live" | "reconnecting" | "frozen", "text": text,
              "age_ms": since the newest frame arrived | null, "received_fps", "tracked_fps", "received", "dropped",
              "unreadable": frames without a readable stamp or JPEG, "width": px | null, "height": px | null} | null,
     "notices": [{"code": see NOTICE_CODES, "level": "info" | "warning" | "error", "text": one line}],
     "recording": {"is_on": bool, "seconds": s, "finished": [N, …] in this run},
     "job": {"id", "serial", "part": number, "stage": "collecting" | "measuring" | "done" | "failed", "text",
             "state": state.json, see `WalkState`, "photos": count, "uploads": count, "revision",
             "worker": "none" | "waiting" | "running" | "failed"} | null,     the client's
     "clients": count, "max_clients": count}

Control, every key and every key of ``style`` may be absent::

    {"mode": "poses" | "video",
     "style": {"ghost": bool, "edges": "none" | "visible" | "all", "labels": bool, "opacity": 0 to 1,
               "only": name of the only component to draw | null, "only_part": its part's id, without it 0,
               "status": bool},     for the server
     "reset": true | id,          search again for all parts, or for one
     "confirm": true | id,        the part in view is the one to which the labels belong: see withheld of *Pose*; true
                                  where there is one part only
     "screen": {"width", "height": px of the screen that the picture fills, "density": px for each CSS px} | null,
                                  annotated video is made no larger, with labels that can be read there
     "hold": frame id | null,     keep this frame for a snapshot; 404 no_such_frame when it is no longer kept
     "job": JOB | null,           show the numbers of this job, and nothing measured of another one; 404, 409 other_part
     "capture": JOB | null,       guided capture for the job that is shown
     "record": bool}

Job::

    {"id", "part": number | null, "part_name", "serial", "model_hash", "created", "camera", "parent", "components",
     "state": state.json, "is_ended", "photos": [names],
     "attachments": [names of photos taken for decisions], "uploads": [{"upload", "bytes", "offset"}],
     "worker": as above,
     "measuring_s": since the end of the photos | null, "expected_s": from there to the verdict, by earlier jobs of the
     part | null,
     "faults": [texts], damaged lines of the list of photos,
     "inspection": {"created", "verdict", "sentence", "note", "components": [{"name", "verdict", "value_text",
                    "detail_text", "distance_mm", "uncertainty_mm", "tolerance_mm", "displacement_mm", "tilt_deg",
                    "twist_deg"}]} | null,
     "rework": [instructions, see `arview.quality.rework.instruction_document`],
     "decisions": [entries of the log, ticks included], "signed": entry | null: a signature that holds,
     "record": {"sentence", "is_released", …} | null, see `arview.quality.decisions.state_document`,
     "rechecks": [ids], "before_after": [{"name", "before_mm", "after_mm", "verdict_before", "verdict_after"}]}

Part::

    {"protocol": 3, "revision": N, "state": "loading" | "ready" | "failed", "text": text,
     "source": "phone" | "station", "source_name": text, "wanted": {"width", "height", "fps"},     for a phone's camera
     (part)
     "name": of the specimen, "mark": sign of its labels, "tag_color": "#rrggbb" of that sign,     only in ``parts``
     "part": {"name", "serial", "model_hash", "diameter_mm",
              "center_in_model": [3], "bounds_in_model": [[3], [3]]} | null,
     "components": [{"name", "color": "#rrggbb", "anchor_in_model": [3], "rank": by urgency | null,
                     "verdict": "pass" | "fail" | "undecided" | "measured" | "not_measured" | null, null: not inspected,
                     "verdict_text": "PASS" | null, "verdict_color": "#rrggbb", "missing": bool,
                     "value_text": "measuring" while a job has no number, then "is_pending" is true, "detail_text",
                     "distance_mm" | null, "uncertainty_mm" | null, "tolerance_mm" | null,
                     "displacement_mm": [3, null where undetermined]}],
     "inspection": {"part", "serial", "created": ISO 8601 UTC, "age_s", "note", "method"} | null,
     "arrow_scale": exaggeration of the displacement arrows}

Error, with any status of 400 or above::

    {"error": CODE, "message": one line}

400 ``bad_request``, 403 ``no_token`` ``other_origin``, 404 ``not_found`` ``no_such_client``, 405 ``bad_method``, 408
``too_slow``, 413 ``too_large``, 415 ``bad_type``, 421 ``other_host``, 429 ``too_many`` (with ``Retry-After``), 503
``busy`` ``loading``, 500 ``internal``. ``GET /`` and ``GET /watch`` without a valid token return an HTML page with
403.
"""

from __future__ import annotations

from typing import Final, Literal

Transport = Literal["webrtc", "jpeg"]
ViewMode = Literal["poses", "video"]

PROTOCOL: Final = 3
"""Version of the protocol: 2 since there may be several parts, 3 with jobs."""
COOKIE: Final = "arview"
ANSWER_HEADER: Final = "X-Arview-Answer"
CHANNEL: Final = "arview"
FRAME_IDS: Final = 1 << 20

NOTICE_CODES: Final = {
    "camera_guessed": "no camera file was given: the error of the assumed focal length becomes an error of distances",
    "camera_estimated": "no camera file was given: the focal length was estimated from the tracked frames",
    "frames_scaled": "the browser sends smaller pictures than it has",
    "inspection_none": "no inspection was given: ghosts have no verdicts",
    "inspection_future": "the inspection was made in the future: a clock is wrong",
    "inspection_old": "the inspection is older than the maximum age",
    "inspection_rough": "the numbers of the job are provisional: from its first photos",
    "inspection_serial": "the inspection has another serial number than the part",
    "inspection_model": "the changed inspection file belongs to another model; the last valid one is shown",
    "inspection_unreadable": "the changed inspection file cannot be read; the last valid one is shown",
    "job_damaged": "a line of the job's list of photos was cut off or damaged; its photo was never confirmed",
    "job_failed": "the photos of the job could not be measured",
    "source_reconnecting": "the station camera is disconnected; the server reconnects",
    "source_frozen": "the station camera delivers the same picture or none",
    "size_refused": "the camera file does not match the aspect ratio of the frames",
    "stamp_unreadable": "the frame counter cannot be read: the picture arrives damaged",
    "tracking_failed": "an internal error of the tracking, which was restarted",
    "recording_failed": "the recording could not be written",
    "recording_ended": "the recording has ended by itself: its longest duration, its quota, or the disk is almost full",
    "disk_low": "there is little room left for the recording",
}
