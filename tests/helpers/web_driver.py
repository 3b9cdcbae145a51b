"""Browsers beside Chromium: WebKitGTK by WebKitWebDriver, and Firefox by its own protocol, Marionette."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from PIL import Image as PilImage

from arview.video import Image

START_S, ANSWER_S = 60.0, 120.0
MINI_BROWSERS = ("webkit2gtk-4.1", "webkit2gtk-4.0", "webkitgtk-6.0")
SMALL_WIDGETS = "* { min-width: 0; min-height: 0; padding: 0; margin: 0; border: 0; font-size: 1px; }"
"""Style of GTK's widgets: with the usual one the tool bar would not let the window be as narrow as a phone."""
FIREFOX_PREFS: dict[str, Any] = {
    "browser.shell.checkDefaultBrowser": False, "browser.aboutwelcome.enabled": False,
    "app.update.disabledForTesting": True,
    "datareporting.policy.dataSubmissionEnabled": False, "toolkit.telemetry.reportingpolicy.firstRun": False,
    "browser.startup.page": 0, "browser.sessionstore.resume_from_crash": False,
    "network.captive-portal-service.enabled": False, "network.connectivity-service.enabled": False,
    "services.settings.server": "http://127.0.0.1:9/", "intl.accept_languages": "en-US",
    "media.navigator.streams.fake": True, "media.navigator.permission.disabled": True, "webgl.force-enabled": True,
    "media.peerconnection.ice.loopback": True, "media.peerconnection.ice.obfuscate_host_addresses": False,
    "media.autoplay.default": 0, "ui.prefersReducedMotion": 1,
}  # fmt: skip


class Browser(Protocol):
    """What the tests need of a browser with one window."""

    name: str

    def go(self, address: str) -> None: ...

    def run(self, script: str) -> Any:
        """The value that a function body returns in the page."""

    def resize(self, width: int, height: int) -> None:
        """Give the page this size, CSS px."""

    def screenshot(self) -> Image: ...


def until(browser: Browser, condition: str, timeout_s: float = ANSWER_S) -> Any:
    """Wait until an expression of the page is true; returns its value."""
    end_s = time.monotonic() + timeout_s
    while not (value := browser.run(f"return {condition}")):
        if time.monotonic() > end_s:
            shown = browser.run("return document.body.innerText.slice(0, 600)")
            raise AssertionError(f"{browser.name}: not within {timeout_s:.0f} s: {condition}; the page shows {shown!r}")
        time.sleep(0.15)
    return value


class ChromiumPage:
    """A page of Playwright's Chromium."""

    name = "chromium"

    def __init__(self, page: Any) -> None:
        self._page = page

    def go(self, address: str) -> None:
        self._page.goto(address)

    def run(self, script: str) -> Any:
        return self._page.evaluate(f"() => {{ {script} }}")

    def resize(self, width: int, height: int) -> None:
        self._page.set_viewport_size({"width": width, "height": height})

    def screenshot(self) -> Image:
        return _decoded(self._page.screenshot())


class WebKit:
    """A window of WebKitGTK's MiniBrowser."""

    name = "webkit"

    def __init__(self, port: int, binary: str) -> None:
        self._port = port
        options = {"binary": binary, "args": ["--automation"]}
        wanted = {"alwaysMatch": {"webkitgtk:browserOptions": options}}
        self._session = self._ask("POST", "/session", {"capabilities": wanted})["sessionId"]

    def go(self, address: str) -> None:
        self._ask("POST", f"/session/{self._session}/url", {"url": address})

    def run(self, script: str) -> Any:
        return self._ask("POST", f"/session/{self._session}/execute/sync", {"script": script, "args": []})

    def resize(self, width: int, height: int) -> None:
        frame_px = 0
        for _ in range(3):
            self._ask(
                "POST",
                f"/session/{self._session}/window/rect",
                {"x": 0, "y": 0, "width": width, "height": height + frame_px},
            )
            for _ in range(20):
                size = self.run("return [innerWidth, innerHeight]")
                if size == [width, height]:
                    return
                time.sleep(0.1)
            frame_px += height - size[1]
        raise AssertionError(f"the window has {size} px, wanted {width} × {height}")

    def screenshot(self) -> Image:
        return _decoded(base64.b64decode(self._ask("GET", f"/session/{self._session}/screenshot")))

    def _ask(self, method: str, path: str, content: Any = None) -> Any:
        body = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}{path}", body, method=method)
        request.add_header("Content-Type", "application/json")
        try:
            with urllib.request.urlopen(request, timeout=ANSWER_S) as answer:
                return json.loads(answer.read())["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(f"WebKitWebDriver: {error.read().decode()[:300]}") from error


class Firefox:
    """A window of Firefox, driven by Marionette."""

    name = "firefox"

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=ANSWER_S)
        self._rest = b""
        self._count = 0
        self._receive()  # its greeting
        self._ask("WebDriver:NewSession", {"capabilities": {"alwaysMatch": {"acceptInsecureCerts": True}}})

    def close(self) -> None:
        self._socket.close()

    def go(self, address: str) -> None:
        self._ask("WebDriver:Navigate", {"url": address})

    def run(self, script: str) -> Any:
        return self._ask("WebDriver:ExecuteScript", {"script": script, "args": []})["value"]

    def resize(self, width: int, height: int) -> None:
        # Firefox's window is never as narrow as a phone, but what it shows in it can be.
        self._ask("Marionette:SetContext", {"value": "chrome"})
        names = {
            f"{limit}-{side}": f"{px}px"
            for side, px in (("width", width), ("height", height))
            for limit in ("min", "max")
        }
        self.run(
            f"for (const [name, value] of Object.entries({json.dumps(names)}))"
            " gBrowser.selectedBrowser.style.setProperty(name, value);"
        )
        self._ask("Marionette:SetContext", {"value": "content"})
        for _ in range(50):
            if (size := self.run("return [innerWidth, innerHeight]")) == [width, height]:
                return
            time.sleep(0.1)
        raise AssertionError(f"the page has {size} px, wanted {width} × {height}")

    def screenshot(self) -> Image:
        return _decoded(base64.b64decode(self._ask("WebDriver:TakeScreenshot", {"full": False})["value"]))

    def send_keys(self, selector: str, text: str) -> None:
        """Type into an element; into a choice of files: their paths."""
        found = self._ask("WebDriver:FindElement", {"using": "css selector", "value": selector})["value"]
        self._ask("WebDriver:ElementSendKeys", {"id": next(iter(found.values())), "text": text})

    def press_keys(self, *keys: str) -> None:
        """Press keys one after another and hold them, then let go."""
        actions = [{"type": kind, "value": key} for kind in ("keyDown", "keyUp") for key in keys]
        self._ask("WebDriver:PerformActions", {"actions": [{"type": "key", "id": "keys", "actions": actions}]})

    def drag_mouse(self, *way: tuple[float, float], key: str = "") -> None:
        """Press at the first place, px, move along the others and let go; one place is a click. A key may be held."""
        moves = [{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 60} for x, y in way]
        press, release = ({"type": kind, "button": 0} for kind in ("pointerDown", "pointerUp"))
        mouse = [moves[0], press, *moves[1:], release]
        pauses = [{"type": "pause"}] * (len(mouse) - 2)
        held = [{"type": "keyDown", "value": key}, *pauses, {"type": "pause"}, {"type": "keyUp", "value": key}]
        sources = [{"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": mouse}]
        if key:
            sources.append({"type": "key", "id": "keys", "actions": held})
        self._ask("WebDriver:PerformActions", {"actions": sources})
        self._ask("WebDriver:ReleaseActions", {})

    def _ask(self, command: str, about: dict[str, Any]) -> Any:
        self._count += 1
        message = json.dumps([0, self._count, command, about]).encode()
        self._socket.sendall(b"%d:%s" % (len(message), message))
        _, _, error, result = self._receive()
        if error:
            raise RuntimeError(f"Firefox: {error['error']}: {error['message'][:300]}")
        return result

    def _receive(self) -> Any:
        while b":" not in self._rest:
            self._read()
        length, _, self._rest = self._rest.partition(b":")
        while len(self._rest) < int(length):
            self._read()
        message, self._rest = self._rest[: int(length)], self._rest[int(length) :]
        return json.loads(message)

    def _read(self) -> None:
        received = self._socket.recv(1 << 16)
        if not received:
            raise RuntimeError("Firefox has closed the connection")
        self._rest += received


@contextmanager
def webkit(folder: Path) -> Iterator[WebKit]:
    """WebKitGTK on a screen of its own; skips the test when it is not installed."""
    found = (path for name in MINI_BROWSERS for path in Path("/usr/lib").glob(f"*/{name}/MiniBrowser"))
    binary = next(found, None)
    if binary is None or not shutil.which("WebKitWebDriver") or not shutil.which("Xvfb"):
        pytest.skip("WebKitGTK is not installed: apt-get install webkit2gtk-driver xvfb")
    (folder / "gtk-3.0").mkdir(parents=True)
    (folder / "gtk-3.0" / "gtk.css").write_text(SMALL_WIDGETS)
    port = _free_port()
    with _xvfb() as display:
        environment = {**os.environ, "DISPLAY": display, "XDG_CONFIG_HOME": str(folder), "LIBGL_ALWAYS_SOFTWARE": "1"}
        for name in ("XDG_DATA_HOME", "XDG_CACHE_HOME"):
            environment[name] = str(folder / name)
        with _process(["WebKitWebDriver", f"--port={port}"], environment):
            _wait_for(port)
            yield WebKit(port, str(binary))


@contextmanager
def firefox(folder: Path) -> Iterator[Firefox]:
    """Firefox on a screen of its own, where it has WebGL; skips the test when it is not installed."""
    binary = shutil.which("firefox-esr") or shutil.which("firefox")
    if binary is None or not shutil.which("Xvfb"):
        pytest.skip("Firefox is not installed: apt-get install firefox-esr xvfb")
    port = _free_port()
    folder.mkdir(parents=True)
    prefs = {**FIREFOX_PREFS, "marionette.port": port}
    (folder / "user.js").write_text(
        "".join(f"user_pref({json.dumps(k)}, {json.dumps(v)});\n" for k, v in prefs.items())
    )
    command = [binary, "--marionette", "-remote-allow-system-access", "--no-remote", "--profile", str(folder)]
    with _xvfb() as display:
        environment = {**os.environ, "HOME": str(folder), "DISPLAY": display, "LIBGL_ALWAYS_SOFTWARE": "1"}
        with _process([*command, "--width", "1380", "--height", "1380"], environment):
            _wait_for(port)
            running = Firefox(port)
            try:
                yield running
            finally:
                running.close()


@contextmanager
def _process(command: list[str], environment: dict[str, str]) -> Iterator[None]:
    running = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield
    finally:
        # With its children, which a browser leaves behind otherwise.
        for signal_number in (15, 9):
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(running.pid, signal_number)
            with suppress(subprocess.TimeoutExpired):
                running.wait(5)


@contextmanager
def _xvfb() -> Iterator[str]:
    reading, writing = os.pipe()
    running = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1400x1400x24", "-nolisten", "tcp"],
        pass_fds=[writing], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(writing)
    try:
        with os.fdopen(reading) as numbers:
            yield f":{numbers.readline().strip()}"
    finally:
        running.terminate()
        running.wait(10)


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def _wait_for(port: int) -> None:
    end_s = time.monotonic() + START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        except OSError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.2)


def _decoded(png: bytes) -> Image:
    return np.array(PilImage.open(io.BytesIO(png)).convert("RGB"))
