"""The live server: a part is tracked in the video of a phone or a station camera and shown in the browser.

`arview.station.live.protocol` defines the messages between server and page. Folders, each importing only those before
it: ``security`` (access, limits, certificates, paired devices), ``stream`` (frames, tracking, drawing, recording),
``jobs`` (inspections that pages start: uploads, workers, numbers), ``transport`` (WebRTC, motion JPEG) and ``server``
(application and life cycle). ``page`` holds the static files of the browser page.
"""
