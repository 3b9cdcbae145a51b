// The camera of the phone: its frames as they arrive, and messages about its failures.

const MESSAGES = {
  NotAllowedError: "The browser may not use the camera. Allow it for this page (at the lock beside the address), then try again.",
  SecurityError: "The browser may not use the camera. Allow it for this page (at the lock beside the address), then try again.",
  NotFoundError: "This device has no camera that the browser can use.",
  NotReadableError: "The camera is in use by another app. Close that app, then try again.",
  AbortError: "The camera did not start. Try again.",
  OverconstrainedError: "The camera does not support this picture size or frame rate.",
};
const INSECURE = "Browsers allow the camera on secure pages only. Open the https address that the station shows and trust it once.";

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
  async start({ width, height, fps }) {
    this.stop();
    if (!navigator.mediaDevices?.getUserMedia) {
      this.onTrouble(window.isSecureContext ? MESSAGES.NotFoundError : INSECURE);
      return false;
    }
    try {
      const video = {
        facingMode: { ideal: "environment" }, width: { ideal: width }, height: { ideal: height },
        frameRate: { ideal: fps, max: Math.max(fps, 30) },
      };
      this.#stream = await navigator.mediaDevices.getUserMedia({ audio: false, video });
    } catch (error) {
      this.onTrouble(MESSAGES[error.name] ?? `The camera did not start: ${error.message}`);
      return false;
    }
    const [track] = this.#stream.getVideoTracks();
    track.addEventListener("ended", () => this.#lose("The camera was disconnected. Try again."));
    track.addEventListener("mute", () => this.onTrouble("This device has paused the camera."));
    track.addEventListener("unmute", () => this.onTrouble(""));
    this.video.srcObject = this.#stream;
    await this.video.play().catch(() => {});
    this.onTrouble("");
    this.#stopWatching = watchFrames(this.video, (moment) => this.onFrame(this.video, moment));
    return true;
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
