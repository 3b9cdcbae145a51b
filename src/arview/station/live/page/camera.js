// The camera of the phone: its frames as they arrive, and messages about its failures.

import { t } from "./texts/texts.js";

/** Texts for the errors of getUserMedia. */
const MESSAGES = {
  NotAllowedError: "camera.denied", SecurityError: "camera.denied", NotFoundError: "camera.none", NotReadableError: "camera.in_use",
  AbortError: "camera.aborted", OverconstrainedError: "camera.size",
};
const DEVICE_KEY = "arview-camera"; // the camera that was chosen last

export class Camera {
  #stream = null;
  #stopWatching = () => {};

  /**
   * @param video element that plays the camera stream.
   * @param onFrame called with (video, time in ms) for every frame.
   * @param onTrouble called with a message, or with "" when the camera works.
   */
  constructor(video, onFrame, onTrouble) {
    Object.assign(this, { video, onFrame, onTrouble });
  }

  get isOn() {
    return this.#stream !== null;
  }

  /** Start the rear camera, or another one; returns whether it delivers pictures. */
  async start(wanted) {
    const { width, height, fps } = (this.wanted = wanted), device = localStorage.getItem(DEVICE_KEY);
    this.stop();
    if (!navigator.mediaDevices?.getUserMedia) {
      this.onTrouble(t(window.isSecureContext ? "camera.none" : "camera.insecure"));
      return false;
    }
    try {
      const video = {
        ...(device ? { deviceId: { exact: device } } : { facingMode: { ideal: "environment" } }), width: { ideal: width }, height: { ideal: height },
        frameRate: { ideal: fps, max: Math.max(fps, 30) },
      };
      this.#stream = await navigator.mediaDevices.getUserMedia({ audio: false, video });
    } catch (error) {
      if (device && ["OverconstrainedError", "NotFoundError"].includes(error.name)) {
        localStorage.removeItem(DEVICE_KEY); // the chosen camera is gone
        return this.start(wanted);
      }
      this.onTrouble(error.name in MESSAGES ? t(MESSAGES[error.name]) : t("camera.failed", { reason: error.message }));
      return false;
    }
    const [track] = this.#stream.getVideoTracks();
    track.addEventListener("ended", () => this.#lose(t("camera.unplugged")));
    track.addEventListener("mute", () => this.onTrouble(t("camera.paused")));
    track.addEventListener("unmute", () => this.onTrouble(""));
    this.video.srcObject = this.#stream;
    await this.video.play().catch(() => {});
    this.onTrouble("");
    this.onStart?.();
    this.#stopWatching = watchFrames(this.video, (moment) => this.onFrame(this.video, moment));
    return true;
  }

  /** The video track of the running camera, or null. */
  get track() {
    return this.#stream?.getVideoTracks()[0] ?? null;
  }

  /** Use another camera, by its deviceId; the choice is kept. */
  choose(device) {
    localStorage.setItem(DEVICE_KEY, device);
    return this.start(this.wanted);
  }

  stop() {
    this.#stopWatching();
    this.#stream?.getTracks().forEach((track) => track.stop());
    this.#stream = null;
    this.video.srcObject = null;
  }

  #lose(message) {
    this.stop();
    this.onTrouble(message);
  }
}

/** Call a function for every new frame of a video with its time of capture or arrival, ms; returns a function that stops. */
export function watchFrames(video, onFrame) {
  let isOn = true;
  if (video.requestVideoFrameCallback) {
    const next = (now, about) => {
      if (!isOn) return;
      video.requestVideoFrameCallback(next);
      const taken = about.captureTime;
      onFrame(taken > now - 2000 && taken <= now ? taken : now);
    };
    video.requestVideoFrameCallback(next);
  } else {
    let previous = -1;
    const next = (now) => {
      if (!isOn) return;
      requestAnimationFrame(next);
      if (video.readyState < 2 || video.currentTime === previous) return;
      previous = video.currentTime;
      onFrame(now);
    };
    requestAnimationFrame(next);
  }
  return () => { isOn = false; };
}

/** Quarter turns clockwise by which the browser rotated the picture of the sensor to show it upright. */
export function quarterTurns(orientation = screen.orientation) {
  // Older iPhones report the angle in window.orientation and do not report the type.
  if (!orientation) return "orientation" in window ? (1 - window.orientation / 90 + 8) % 4 : 0;
  const isUpright = orientation.type.startsWith("portrait"), isPhone = isUpright === (orientation.angle % 180 === 0);
  return ((isPhone ? 1 : 0) - orientation.angle / 90 + 8) % 4;
}
