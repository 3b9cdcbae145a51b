"""Latency of the live page in Chromium on this machine: time added by the server, and glass to glass.

Glass to glass: each picture of the video that is the browser's camera has a counter drawn into it. The counter is read
from the camera's picture, whose capture time the browser reports (``captureTime``), and from the canvas right after the
page has drawn it; the picture is on the screen at the next screen refresh.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from live_server import live_server
from recordings import ROOT, SAMPLE, skip

sys.path.insert(0, str(ROOT / "tests"))  # the tests' browser and video

from helpers import live_browser

WIDTH, HEIGHT, FPS, COUNT = 640, 480, 30, 44
VIEWPORT = {"width": 660, "height": 760}
WARM_UP_S, MEASURED_S, TIMEOUT_S = 5, 20, 120
TRANSPORTS = {"poses": "data channel", "video": "annotated video", "jpeg": "JPEG"}
OBSERVER = """
window.report = [];
const cells = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
const [edge, cell, bits] = [EDGE, CELL, BITS];

function number(source, scale) {
  cells.canvas.width = bits;
  cells.canvas.height = 2;
  cells.imageSmoothingEnabled = false;
  cells.drawImage(source, scale * edge, scale * edge, scale * bits * cell, scale * 2 * cell, 0, 0, bits, 2);
  const pixels = cells.getImageData(0, 0, bits, 2).data;
  let value = 0;
  for (let bit = 0; bit < bits; bit++) value = 2 * value + (pixels[4 * bit] > pixels[4 * (bits + bit)] ? 1 : 0);
  return value;
}

const taken = new Map();
document.addEventListener("arview:drawn", ({detail}) => {
  const {id, pose, takenMs, drawnMs} = detail;
  if (id === null || takenMs === window.lastTakenMs) return;
  window.lastTakenMs = takenMs;
  const entry = {hasGhost: Boolean(pose?.cam_from_model), saidMs: drawnMs - takenMs};
  [entry.serverMs, entry.trackMs] = [pose?.server_ms, pose?.track_ms];
  window.report.push(entry);
  if (!entry.hasGhost || Math.random() > 0.25) return; // reading a picture back takes time itself
  const canvas = document.querySelector("#picture"), takenThen = taken.get(number(canvas, canvas.width / WIDTH));
  requestAnimationFrame((nextMs) => { if (takenThen !== undefined) entry.glassMs = nextMs - takenThen; });
});

const ask = HTMLVideoElement.prototype.requestVideoFrameCallback;
HTMLVideoElement.prototype.requestVideoFrameCallback = function (callback) {
  return ask.call(this, (now, about) => {
    callback(now, about);
    if (this.id !== "camera") return;
    const seen = number(this, this.videoWidth / WIDTH);
    taken.set(seen, about.captureTime ?? now);
    for (let ahead = 1; ahead < FRAMES / 2; ahead++) taken.delete((seen + ahead) % FRAMES); // of the round before
  });
};
"""


def live_latencies() -> Iterator[tuple[str, dict[str, Any]]]:
    """For each transport its name and the measured latencies, ms; nothing, with a message, without a browser."""
    if live_browser.CHROMIUM is None or find_spec("playwright") is None:
        skip("live", "needs Chromium and Playwright: apt-get install chromium, pip install playwright")
        return
    with tempfile.TemporaryDirectory() as folder, _server(Path(folder)) as link:
        video = Path(folder) / "video.y4m"
        images = live_browser.plain_frames(WIDTH, HEIGHT, 1, COUNT)
        played = live_browser.numbered([images[k] for k in live_browser.there_and_back(COUNT)])
        live_browser.write_y4m(video, played, FPS)
        with live_browser.browser(video) as browser:
            for transport, name in TRANSPORTS.items():
                context = browser.new_context(viewport=VIEWPORT)
                try:
                    yield name, _measure(context.new_page(), link, transport)
                finally:
                    context.close()


def _measure(page: Any, link: str, transport: str) -> dict[str, Any]:
    """Latencies of a page with one transport, after a warm-up."""
    observer = OBSERVER
    for word in ("EDGE", "CELL"):
        observer = observer.replace(word, str(getattr(live_browser, f"{word}_PX")))
    for word, value in (("BITS", live_browser.BITS), ("WIDTH", WIDTH), ("FRAMES", 2 * COUNT - 2)):
        observer = observer.replace(word, str(value))
    page.add_init_script("{" + observer + "}")
    page.goto(link)
    choice = page.locator(f"#transports input[value={transport}]")
    choice.evaluate("input => input.click()")
    end_s = time.monotonic() + TIMEOUT_S
    while not page.evaluate("window.report.some((one) => one.hasGhost)"):
        if time.monotonic() > end_s:
            raise SystemExit(f"live, {transport}: no ghost within {TIMEOUT_S} s; {page.inner_text('#state')!r}")
        page.wait_for_timeout(500)
    page.wait_for_timeout(1e3 * WARM_UP_S)
    page.evaluate("window.report.length = 0")
    page.wait_for_timeout(1e3 * MEASURED_S)
    drawn = [one for one in page.evaluate("window.report") if one["hasGhost"]]
    if not any("glassMs" in one for one in drawn):
        raise SystemExit(f"live, {transport}: no ghost was drawn for {MEASURED_S} s")
    return {
        "frames_per_s": len(drawn) / MEASURED_S,
        "server_ms": _spread([one["serverMs"] for one in drawn]),
        "track_ms": _spread([one["trackMs"] for one in drawn]),
        "glass_to_glass_ms": _spread([one["glassMs"] for one in drawn if "glassMs" in one]),
        "reported_by_the_page_ms": _spread([one["saidMs"] for one in drawn]),
        "counters_read": sum("glassMs" in one for one in drawn),
    }


def _spread(values: list[float]) -> dict[str, float]:
    return {"p50": round(float(np.median(values)), 1), "p95": round(float(np.percentile(values, 95)), 1)}


@contextmanager
def _server(folder: Path) -> Iterator[str]:
    """Run `arview live` on the loopback interface; yields the link to its page."""
    lens = live_browser.camera(WIDTH, HEIGHT)
    about = {key: getattr(lens, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps({**about, "dist": lens.dist.tolist()}))
    arguments = [
        "--part", SAMPLE / "part.toml", "--inspection", SAMPLE / "inspection.json", "--camera", folder / "camera.json",
        "--http", "--port", "0", "--size", f"{WIDTH}x{HEIGHT}", "--fps", FPS,
    ]  # fmt: skip
    with live_server(arguments, folder) as (_, link):
        yield link
