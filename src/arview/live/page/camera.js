// The phone's camera: its pictures as they come, and its troubles in words.

const WORDS = {
  NotAllowedError: "The browser may not use the camera. Allow it for this page (at the lock beside the address), then try again.",
  SecurityError: "The browser may not use the camera. Allow it for this page (at the lock beside the address), then try again.",
  NotFoundError: "This device has no camera that the browser can use.",
  NotReadableError: "The camera is in use by another app. Close that app, then try again.",
  AbortError: "The camera did not start. Try again.",
  OverconstrainedError: "The camera cannot give such pictures.",
};
const INSECURE = "Browsers give the camera to secure pages only. Open the https address that the station shows, and trust it once.";

export class Camera {
  #stream = null;
  #stopWatching = () => {};

  /**
   * @param video element that plays the camera.
   * @param onFrame called with (video, moment in ms) for every picture.
   * @param onTrouble called with words, or with "" when all is well.
   */
  constructor(video, onFrame, onTrouble) {
    Object.assign(this, { video, onFrame, onTrouble });
  }

  get isOn() {
    return this.#stream !== null;
  }

  /** Switch the back camera on, or another one; true when it gives pictures. */
  async start({ width, height, fps }) {
    this.stop();
    if (!navigator.mediaDevices?.getUserMedia) {
      this.onTrouble(window.isSecureContext ? WORDS.NotFoundError : INSECURE);
      return false;
    }
    try {
      const video = {
        facingMode: { ideal: "environment" }, width: { ideal: width }, height: { ideal: height },
        frameRate: { ideal: fps, max: Math.max(fps, 30) },
      };
      this.#stream = await navigator.mediaDevices.getUserMedia({ audio: false, video });
    } catch (error) {
      this.onTrouble(WORDS[error.name] ?? `The camera did not start: ${error.message}`);
      return false;
    }
    const [track] = this.#stream.getVideoTracks();
    track.addEventListener("ended", () => this.#lose("The camera was taken away. Try again."));
    track.addEventListener("mute", () => this.onTrouble("The camera is paused by this device."));
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

  #lose(words) {
    this.stop();
    this.onTrouble(words);
  }
}

/** Call a function for every new picture of a video, with the moment it was taken or came, in ms; returns how to end it. */
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
    let before = -1;
    const next = (now) => {
      if (!isOn) return;
      requestAnimationFrame(next);
      if (video.readyState < 2 || video.currentTime === before) return;
      before = video.currentTime;
      onFrame(now);
    };
    requestAnimationFrame(next);
  }
  return () => { isOn = false; };
}

/** Quarter turns clockwise by which the browser has turned the sensor's picture to show it upright. */
export function quarterTurns(orientation = screen.orientation) {
  // Older iPhones say the angle elsewhere, and not the shape.
  if (!orientation) return "orientation" in window ? (1 - window.orientation / 90 + 8) % 4 : 0;
  const isUpright = orientation.type.startsWith("portrait"), isPhone = isUpright === (orientation.angle % 180 === 0);
  return ((isPhone ? 1 : 0) - orientation.angle / 90 + 8) % 4;
}
