// How fast the phone turns, from its gyroscope: a photo taken while it turns is blurred.

const EVERY_MS = 100, RAD = Math.PI / 180;

export class Motion {
  #isOn = false;
  #sentMs = -Infinity;

  /** @param onMotion called with the rate of the turn, rad/s, at most ten times a second. */
  constructor(onMotion) {
    this.onMotion = onMotion;
    this.listen = (event) => this.#take(event.rotationRate);
  }

  /** Start to listen; on some phones the user is asked, so that it has to be called from a press. */
  async start() {
    if (this.#isOn || !globalThis.DeviceMotionEvent) return;
    this.#isOn = true;
    if (DeviceMotionEvent.requestPermission && (await DeviceMotionEvent.requestPermission().catch(() => "denied")) !== "granted") return;
    if (this.#isOn) addEventListener("devicemotion", this.listen);
  }

  stop() {
    this.#isOn = false;
    removeEventListener("devicemotion", this.listen);
  }

  #take(rate) {
    const nowMs = performance.now();
    if (typeof rate?.alpha !== "number" || nowMs - this.#sentMs < EVERY_MS) return;
    this.#sentMs = nowMs;
    this.onMotion(RAD * Math.hypot(rate.alpha, rate.beta ?? 0, rate.gamma ?? 0));
  }
}
