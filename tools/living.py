"""The live page in Chromium on this machine: what the server adds, and how late the picture with its ghost is shown.

The page reports each frame that it draws. When that frame was taken says the browser's camera (``captureTime``), when it
is on the screen the beginning of the next screen refresh. That the picture drawn is the frame it is said to be is read
off a counter in the film itself.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recordings import ROOT, SAMPLE

sys.path.insert(0, str(ROOT / "tests"))  # the browser and its film are those of the tests

import live_browser  # noqa: E402

WIDTH, HEIGHT, FPS, COUNT = 640, 480, 30, 44
VIEWPORT = {"width": 660, "height": 760}
WARM_UP_S, MEASURED_S, PATIENCE_S = 5, 20, 120
WAYS = {"poses": "data channel", "video": "annotated video", "jpeg": "JPEG"}
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
  const {id, pose, takenMs, drawnMs, isAnnotated} = detail;
  if (id === null || takenMs === window.lastTakenMs) return;
  window.lastTakenMs = takenMs;
  const canvas = document.querySelector("#picture");
  const entry = {id, takenMs, drawnMs, isAnnotated, hasGhost: Boolean(pose?.cam_from_model), serverMs: pose?.server_ms,
    trackMs: pose?.track_ms, waitMs: pose?.wait_ms, number: number(canvas, canvas.width / WIDTH), truly: taken.get(takenMs)};
  window.report.push(entry);
  requestAnimationFrame((nextMs) => { entry.shownMs = nextMs; });
});

const ask = HTMLVideoElement.prototype.requestVideoFrameCallback;
HTMLVideoElement.prototype.requestVideoFrameCallback = function (callback) {
  return ask.call(this, (now, about) => {
    if (this.id === "camera" && Math.random() < 0.2) {
      taken.set(about.captureTime, number(this, this.videoWidth / WIDTH));
      if (taken.size > 50) taken.delete(taken.keys().next().value);
    }
    callback(now, about);
  });
};
"""


def live_latencies() -> Iterator[tuple[str, dict[str, Any]]]:
    """For each way of the page: its name, and what was measured, ms."""
    with tempfile.TemporaryDirectory() as folder, _server(Path(folder)) as link:
        film = Path(folder) / "film.y4m"
        images = live_browser.frames(WIDTH, HEIGHT, 1, COUNT)
        live_browser.write_y4m(film, [images[k] for k in live_browser.there_and_back(COUNT)], FPS)
        with live_browser.browser(film) as browser:
            for transport, name in WAYS.items():
                context = browser.new_context(viewport=VIEWPORT)
                try:
                    yield name, _measure(context.new_page(), link, transport)
                finally:
                    context.close()


def _measure(page: Any, link: str, transport: str) -> dict[str, Any]:
    observer = OBSERVER
    for word in ("EDGE", "CELL"):
        observer = observer.replace(word, str(getattr(live_browser, f"{word}_PX")))
    page.add_init_script("{" + observer.replace("BITS", str(live_browser.BITS)).replace("WIDTH", str(WIDTH)) + "}")
    page.goto(link)
    choice = page.locator(f"#transports input[value={transport}]")
    choice.evaluate("input => input.click()")
    end_s = time.monotonic() + PATIENCE_S
    while not page.evaluate("window.report.some((one) => one.hasGhost)"):
        if time.monotonic() > end_s:
            raise SystemExit(f"live, {transport}: no ghost within {PATIENCE_S} s; {page.inner_text('#state')!r}")
        page.wait_for_timeout(500)
    page.wait_for_timeout(1e3 * WARM_UP_S)
    page.evaluate("window.report.length = 0")
    page.wait_for_timeout(1e3 * MEASURED_S)
    seen = [one for one in page.evaluate("window.report") if one["hasGhost"] and one.get("shownMs")]
    if not seen:
        raise SystemExit(f"live, {transport}: no ghost was drawn for {MEASURED_S} s")
    print([(o["number"],o.get("truly")) for o in seen][:30])
    known = [one for one in seen if one.get("truly") is not None]
    wrong = sum(one["number"] != one["truly"] for one in known)
    return {
        "frames_per_s": len(seen) / MEASURED_S,
        "server_ms": _spread([one["serverMs"] for one in seen]),
        "track_ms": _spread([one["trackMs"] for one in seen]),
        "glass_to_glass_ms": _spread([one["shownMs"] - one["takenMs"] for one in seen]),
        "counters_read": len(known),
        "counters_wrong": wrong,
    }


def _spread(values: list[float]) -> dict[str, float]:
    return {"p50": round(float(np.median(values)), 1), "p95": round(float(np.percentile(values, 95)), 1)}


@contextmanager
def _server(folder: Path) -> Iterator[str]:
    """`arview live` on the loopback interface; the link to its page."""
    lens = live_browser.camera(WIDTH, HEIGHT)
    about = {key: getattr(lens, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps({**about, "dist": lens.dist.tolist()}))
    arguments = [
        "--part", SAMPLE / "part.toml", "--inspection", SAMPLE / "inspection.json", "--camera", folder / "camera.json",
        "--http", "--port", "0", "--size", f"{WIDTH}x{HEIGHT}", "--fps", FPS,
    ]  # fmt: skip
    command = [sys.executable, "-m", "arview.cli", "live", *map(str, arguments)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=folder)
    try:
        assert server.stdout is not None
        found = next((match for line in server.stdout if (match := re.search(r"http://\S+token=\S+", line))), None)
        if found is None:
            raise SystemExit("live: the server did not start")
        yield found.group()
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()


def cpu_s(pid: int) -> float:
    """Processor seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
