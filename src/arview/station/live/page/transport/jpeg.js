// Transport without WebRTC: JPEG pictures over HTTP, one at a time.

import { translated } from "../texts/texts.js";
import { ask, getStatus, join, leave } from "./api.js";

const QUALITY = 0.85, STATUS_EVERY_MS = 1000, MAX_FAILURES = 3;

export class JpegLink {
  kind = "jpeg";
  client = null;
  rttMs = null;
  sent = 0;
  inFlight = null; // the frame whose response is outstanding
  #abort = new AbortController();
  #waiting = null; // wakes the loop when there is a picture to send

  /** As WebrtcLink, without a video element. */
  constructor(isPhone, events) {
    Object.assign(this, { isPhone, events });
  }

  /** Join; throws a Refusal. */
  async open(mode, signal) {
    this.mode = mode;
    this.client = (await join({ transport: "jpeg", mode }, signal)).client;
    this.#run();
    return this;
  }

  /** Offer a frame of the camera; it is sent if it is still the newest when no other is in flight. */
  send(frame) {
    this.newest = frame;
    this.#waiting?.();
  }

  /** Tell the server something with the next picture: how fast the phone turns. */
  tell({ type, gyro_rad_s: gyro }) {
    if (type === "motion") this.#gyro = gyro;
  }

  #gyro = null;

  close() {
    this.#abort.abort();
    this.#waiting?.();
    if (this.client) leave(this.client);
    this.client = null;
  }

  async #run() {
    const { signal } = this.#abort;
    let failures = 0, statusMs = -Infinity, after = -1;
    while (!signal.aborted) {
      try {
        if (performance.now() - statusMs > STATUS_EVERY_MS) {
          statusMs = performance.now();
          this.events.onStatus(await getStatus(this.client, signal));
        }
        after = this.isPhone ? await this.#exchange(signal) : await this.#fetch(after, signal);
        failures = 0;
      } catch (error) {
        if (signal.aborted) return;
        failures += 1;
        const isOver = error.code === "no_such_client" || error.code === "no_token" || failures >= MAX_FAILURES;
        if (isOver) {
          this.close();
          this.events.onEnd(error.message);
          return;
        }
        await new Promise((resolve) => setTimeout(resolve, 1000 * Math.max(error.waitS ?? 0, 0.3 * failures)));
      }
    }
  }

  /** Send the newest frame and process the response. */
  async #exchange(signal) {
    if (!this.newest) {
      await new Promise((resolve) => {
        this.#waiting = resolve;
        setTimeout(resolve, STATUS_EVERY_MS);
      });
      this.#waiting = null;
      if (!this.newest) return -1;
    }
    const frame = this.newest, { id, turns, takenMs } = frame;
    this.newest = null;
    this.inFlight = frame;
    const body = await new Promise((resolve) => frame.canvas.toBlob(resolve, "image/jpeg", QUALITY));
    if (signal.aborted) return -1;
    const sentMs = performance.now(), gyro = this.#gyro;
    this.#gyro = null;
    const answer = await ask(`/api/clients/${this.client}/frame?id=${id}&turns=${turns}${gyro === null ? "" : `&gyro=${gyro.toFixed(4)}`}`, {
      method: "POST", body, headers: { "Content-Type": "image/jpeg" }, signal,
    });
    this.sent += 1;
    await this.#process(answer, takenMs, sentMs);
    return -1;
  }

  /** Get the next frame of the station camera. */
  async #fetch(after, signal) {
    const sentMs = performance.now();
    const answer = await ask(`/api/clients/${this.client}/frame${after < 0 ? "" : `?after=${after}`}`, { signal });
    return answer.status === 204 ? after : this.#process(answer, null, sentMs);
  }

  async #process(answer, takenMs, sentMs) {
    const header = answer.headers.get("X-Arview-Answer");
    const pose = translated(header ? JSON.parse(header) : await answer.json());
    // The round trip can only be measured for a phone: a request for a station's frame waits for an unknown time.
    if (takenMs !== null) this.rttMs = Math.max(0, performance.now() - sentMs - pose.server_ms);
    if (header) {
      const picture = await createImageBitmap(await answer.blob());
      this.events.onFrame(picture, picture.width, picture.height, pose.id, performance.now());
      picture.close();
    }
    this.events.onPose(pose);
    return pose.id;
  }
}
