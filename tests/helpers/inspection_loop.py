"""The whole inspection on the page, as a person would do it, with rendered photos as the camera.

The picture of the camera is that photo of a walk at which the person stands; `takePhoto` gives it at full size. The
person goes on when the page has taken the photo, so that the walk takes as long as the machine needs.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from arview.geometry import Array
from arview.pose import ComponentPresence, Pose, Presence, TrackingState, Visibility
from arview.video import Image
from helpers.paths import SAMPLES

PLATE = SAMPLES / "plate"
COMPONENT = "link_1"
"""The component that is put right between the two sets of photos."""
BITS, CELL_PX, EDGE_PX = 8, 12, 4
"""The counter in the upper left corner of the stream: the number of the photo and, below, the same inverted."""
STREAM = 640, 480

CAMERA_SCRIPT = """
(() => {
  const [BITS, CELL, EDGE] = [%d, %d, %d], [WIDTH, HEIGHT] = [%d, %d];
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
  [canvas.width, canvas.height] = [WIDTH, HEIGHT];
  const walk = { index: null, picture: null, taken: [], isNumbered: %s };
  window.walk = walk;
  const full = async (index) => (await fetch(`/full-size/${index}`)).blob();
  walk.show = async (index) => {
    const size = { resizeWidth: WIDTH, resizeHeight: HEIGHT, resizeQuality: "high" };
    walk.picture = await createImageBitmap(await full(index), size);
    walk.index = index;
  };
  const draw = () => {
    if (!walk.picture) return;
    context.drawImage(walk.picture, 0, 0);
    if (!walk.isNumbered) return;
    context.fillStyle = "#808080";
    context.fillRect(0, 0, BITS * CELL + 2 * EDGE, 2 * (CELL + EDGE));
    for (let bit = 0; bit < BITS; bit++) {
      const isSet = (walk.index >> (BITS - 1 - bit)) & 1;
      for (const row of [0, 1]) {
        context.fillStyle = Boolean(isSet) === (row === 0) ? "#fff" : "#000";
        context.fillRect(EDGE + bit * CELL, EDGE + row * CELL, CELL, CELL);
      }
    }
  };
  setInterval(draw, 125);
  navigator.mediaDevices.getUserMedia = async () => canvas.captureStream(8);
  window.ImageCapture = class {
    async getPhotoCapabilities() { return {}; }
    async takePhoto() {
      const { index } = walk, photo = await full(index);
      walk.taken.push(index);
      return photo;
    }
  };
})();
"""


def camera_script(is_numbered: bool) -> str:
    """The script that stands in for the camera; with a counter in the picture where the poses are told."""
    return CAMERA_SCRIPT % (BITS, CELL_PX, EDGE_PX, *STREAM, json.dumps(is_numbered))


@dataclass(frozen=True)
class Stop:
    """A place of the walk: the photo that is taken there, as JPEG, and its true pose (4,4) mm."""

    jpeg: bytes
    cam_from_model: Array


def stops(folder: Path, truth: Path, numbers: Sequence[int] | None = None, width_px: int | None = None) -> list[Stop]:
    """The photos of a folder as stops, some of them only, and smaller if a width is given."""
    poses = json.loads(truth.read_text())["cam_from_model_mm"]
    names = sorted(poses) if numbers is None else [sorted(poses)[k] for k in numbers]
    return [Stop(_sized(folder / name, width_px), np.array(poses[name])) for name in names]


def first_walk(numbers: Sequence[int] | None = None, width_px: int | None = None) -> list[Stop]:
    """The photos of the plate as it was built."""
    return stops(PLATE / "photos", PLATE / "truth.json", numbers, width_px)


def second_walk(numbers: Sequence[int] | None = None, width_px: int | None = None) -> list[Stop]:
    """The photos of the plate after the component was put right."""
    return stops(PLATE / "rework", PLATE / "rework" / "truth.json", numbers, width_px)


def _sized(path: Path, width_px: int | None) -> bytes:
    """A photo as JPEG with its EXIF data, which hold the focal length."""
    if width_px is None:
        return path.read_bytes()
    from io import BytesIO

    from PIL import Image as Pillow

    with Pillow.open(path) as photo:
        exif = photo.getexif()
        height_px = round(photo.height * width_px / photo.width)
        exif.get_ifd(0x8769).update({0xA002: width_px, 0xA003: height_px})
        content = BytesIO()
        smaller = photo.resize((width_px, height_px), Pillow.Resampling.LANCZOS)
        smaller.save(content, "JPEG", quality=90, exif=exif)
    return content.getvalue()


def number_in(image: Image) -> int | None:
    """The number that the camera script has drawn into a picture of the stream; None where it cannot be read."""
    scale, number = image.shape[1] / STREAM[0], 0
    for bit in range(BITS):
        u = round(scale * (EDGE_PX + (bit + 0.5) * CELL_PX))
        upper, lower = (float(image[round(scale * (EDGE_PX + at * CELL_PX)), u].mean()) for at in (0.5, 1.5))
        if abs(upper - lower) < 80:
            return None
        number = 2 * number + int(upper > lower)
    return number


class WalkSession:
    """A session that is told where the camera is: at the place whose number the picture shows."""

    estimate = None

    def __init__(self, walk: Sequence[Stop], names: Sequence[str], camera: Any) -> None:
        self.walk, self.camera = walk, camera
        present = ComponentPresence(Presence.PRESENT, Visibility.VISIBLE, 0.99, 9, 40.0)
        self._components = dict.fromkeys(names, present)

    def process(self, image: Image, index: int, time_s: float) -> tuple[Pose, ...]:
        number = number_in(image)
        if number is None or number >= len(self.walk):
            return (Pose(None, None, 0.0, TrackingState.SEARCHING, time_s, index, 1.0),)
        pose, trust = self.walk[number].cam_from_model, 1e-4 * np.eye(6)
        return (Pose(pose, trust, 0.95, TrackingState.TRACKED, time_s, index, 1.0, components=self._components),)

    def expect(self, serials: Any) -> None:
        pass

    def reset(self, part: int | None = None) -> None:
        pass

    def confirm(self, part: int | None = None) -> None:
        pass

    def finish(self) -> None:
        pass


@dataclass
class Inspector:
    """A person with a phone: walks, looks at the page, presses its buttons.

    Attributes:
        page: of Playwright, with the camera script.
        walk: all places, of both walks; their numbers are those of the stream.
        say: told what was done, with the seconds that it took.
        patience_s: at a place before the shutter is pressed by hand.
        limit_s: of every wait.
        by_hand: photos that the page had wanted and for which the shutter was pressed.
        times_s: of the steps.
    """

    page: Any
    walk: Sequence[Stop]
    say: Callable[[str, float], None]
    patience_s: float = 8.0
    limit_s: float = 300.0
    by_hand: int = 0
    times_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Serve the photos at full size to the camera script."""
        self.page.route("**/full-size/*", self._serve)

    def _serve(self, route: Any) -> None:
        number = int(route.request.url.rsplit("/", 1)[1])
        route.fulfill(body=self.walk[number].jpeg, content_type="image/jpeg")

    def until(self, is_there: Callable[[], Any], what: str) -> Any:
        """Wait until something is there; returns it."""
        end_s = time.monotonic() + self.limit_s
        while not (value := is_there()):
            if time.monotonic() > end_s:
                raise AssertionError(f"not within {self.limit_s:.0f} s: {what}; the page says: {self.text()}")
            self.page.wait_for_timeout(100)
        return value

    def text(self) -> str:
        """What the page says: state, notices, capture and job."""
        parts = ("#state", "#notices", "#toast", "#job-hud", "#job")
        return " | ".join(" ".join(str(self.page.inner_text(one)).split()) for one in parts)

    def job(self, path: str = "") -> Any:
        """The document of the job that the page is in."""
        return self.page.evaluate(
            """async (path) => (await fetch(`/api/jobs/${localStorage.getItem("arview-job")}${path}`)).json()""", path
        )

    def timed(self, step: str, begun_s: float) -> None:
        """Note how long a step took."""
        self.times_s[step] = time.monotonic() - begun_s
        self.say(step, self.times_s[step])

    def start(self, serial: str) -> None:
        """Start the job of a specimen."""
        self.page.evaluate("number => window.walk.show(number)", 0)
        opener = self.page.locator("#open-job")
        self.until(lambda: self.page.locator("#job-serial").count(), "the page of jobs")
        if opener.is_visible():
            opener.click()
        self.page.fill("#job-serial", serial)
        self.page.locator("#job .primary").click()
        self.until(lambda: self.page.locator("#job-hud .shutter").is_visible(), "the display for photos")

    def photograph(self, numbers: Sequence[int], step: str) -> None:
        """Walk past places, and let the page take the photos; the shutter is pressed where it does not."""
        begun_s = time.monotonic()
        self.until(lambda: self.page.locator("#job-hud .dome circle").count() > 3, "the dome of directions")
        for number in numbers:
            self.page.evaluate("number => window.walk.show(number)", number)
            end_s = time.monotonic() + self.patience_s
            while not self._has(number) and time.monotonic() < end_s and not self._is_enough():
                self.page.wait_for_timeout(100)
            if not self._has(number):
                self.by_hand += not self._is_enough()
                self.page.click("#job-hud .shutter")
                self.until(partial(self._has, number), f"photo {number}")
        self.until(lambda: "stored" in self.page.inner_text(".hud-state"), "that all photos are stored")
        self.timed(step, begun_s)

    def _is_enough(self) -> bool:
        """Whether the page asks for no more photos: those that come then are taken by the shutter."""
        return bool(self.page.locator("#job-hud.is-enough").count())

    def _has(self, number: int) -> bool:
        return bool(self.page.evaluate("number => window.walk.taken.includes(number)", number))

    def measure(self, step: str) -> Any:
        """End the photos and wait for the verdicts; returns the document of the job."""
        begun_s = time.monotonic()
        self.page.click("#job-hud .hud-done")

        def is_measured() -> bool:
            stage = self.job()["state"]["stage"]
            assert stage != "failed", self.text()
            return bool(stage == "done")

        self.until(is_measured, "the verdicts")
        self.timed(step, begun_s)
        return self.job()

    def decide(self, component: str, is_ok: bool, reason: str, by: str) -> None:
        """Decide about a component, in its view."""
        self.page.click(f"#job .component[data-name={component}]")
        self.page.check("#job-ok-yes" if is_ok else "#job-ok-no")
        self.page.fill("#job-reason", reason)
        self.page.fill("#job-by", by)
        self.page.locator("#job .job-form .primary").click()
        row = self.page.locator(f"#job .component[data-name={component}]")
        self.until(lambda: row.count() and by in row.inner_text(), f"the decision about {component}")

    def check_again(self, component: str, numbers: Sequence[int], by: str) -> Any:
        """Follow the rework instruction of a component and check it again; returns the re-check's document."""
        self.page.click(f"#job .component[data-name={component}]")
        self.until(lambda: self.page.locator("#job .job-moves .move, #job .job-steps input").count(), "the instruction")
        if self.page.locator("#job-tick-by").is_visible():
            self.page.fill("#job-tick-by", by)
        for box in self.page.locator("#job .job-steps input").all():
            box.check()
        self.page.locator("#job .primary", has_text="Check again").click()
        self.until(lambda: self.page.locator("#job-hud .shutter").is_visible(), "the display for photos")
        self.photograph(numbers, "photos of the check again")
        return self.measure("last photo to the verdict of the check again")

    def sign(self, by: str) -> None:
        """Sign the result, when cloud and report are there: one before would be void if the cloud changed a value."""
        begun_s = time.monotonic()
        self.until(self._has_cloud, "the cloud and the report")
        self.timed("until cloud and report are there", begun_s)
        self.page.locator("#job .job-ends .primary").click()
        self.page.fill("#job-sign-by", by)
        self.page.locator("#job .job-form .primary").click()
        self.until(lambda: "Signed by" in self.page.inner_text("#job"), "the signature")

    def _has_cloud(self) -> bool:
        """Whether the result is shown, without the remark that the cloud is still made."""
        ready = self.page.locator("#job .job-ends .primary:enabled").count()
        return bool(ready) and "point cloud is still being made" not in self.page.inner_text("#job")

    def report(self, by: str) -> str:
        """The report of the job; waits until the signature is in it."""
        address = "`/api/jobs/${localStorage.getItem('arview-job')}/report.html`"
        found = [""]

        def is_signed() -> bool:
            found[0] = str(self.page.evaluate(f"async () => (await fetch({address})).text()"))
            return by in found[0]

        self.until(is_signed, "the report with the signature")
        return found[0]
