"""The live server: part tracked in the video of a phone or a station camera, shown in the browser.

`arview.live.protocol` says what server and page tell each other; `arview.live.server.serve` runs it.
"""
