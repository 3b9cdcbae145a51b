// Gestures on the picture: pinch, wheel, drag, double tap, and a single press.

const TAP_PX = 9, DOUBLE_MS = 320, DOUBLE_PX = 40;
const WHEEL = 0.0022, PINCH_WHEEL = 0.011; // logarithm of the zoom for each pixel of the wheel; touch pads report a pinch as ctrl + wheel
const DOUBLE_ZOOM = 2.5;

export class Gestures {
  #pointers = new Map(); // id → [x, y]
  #isDrag = false;
  #tap = { ms: -Infinity, x: 0, y: 0 };

  /**
   * @param element the stage.
   * @param viewport a Viewport.
   * @param events {onChange() after zoom or pan, onTap(event), onDouble() before the zoom of a double tap}
   */
  constructor(element, viewport, events) {
    Object.assign(this, { element, viewport, events });
    element.addEventListener("pointerdown", (event) => this.#down(event));
    element.addEventListener("pointermove", (event) => this.#move(event));
    for (const name of ["pointerup", "pointercancel"]) window.addEventListener(name, (event) => this.#up(event));
    element.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    // A drag that ends on a label must not press it.
    element.addEventListener("click", (event) => {
      if (!this.#isDrag) return;
      this.#isDrag = false;
      event.stopPropagation();
      event.preventDefault();
    }, { capture: true });
    element.addEventListener("click", (event) => { if (event.target.tagName === "CANVAS") this.#click(event); });
    for (const name of ["gesturestart", "gesturechange"]) element.addEventListener(name, (event) => event.preventDefault());
  }

  #down(event) {
    if (event.pointerType === "mouse" && event.button !== 0) return;
    if (this.#pointers.size === 0) this.#isDrag = false;
    this.#pointers.set(event.pointerId, this.#at(event));
    if (this.#pointers.size > 1) this.#isDrag = true;
    this.#start ??= this.#at(event);
  }

  #start = null;

  #move(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const now = this.#at(event);
    if (this.#pointers.size === 1) {
      if (!this.#isDrag && Math.hypot(now[0] - this.#start[0], now[1] - this.#start[1]) < TAP_PX) return;
      this.#isDrag = true;
      this.viewport.pan(now[0] - before[0], now[1] - before[1]);
    } else if (this.#pointers.size === 2) {
      const other = [...this.#pointers].find(([id]) => id !== event.pointerId)[1];
      const middle = (one) => [(one[0] + other[0]) / 2, (one[1] + other[1]) / 2], [from, to] = [middle(before), middle(now)];
      const length = (one) => Math.max(10, Math.hypot(one[0] - other[0], one[1] - other[1]));
      this.viewport.zoomBy(length(now) / length(before), ...to);
      this.viewport.pan(to[0] - from[0], to[1] - from[1]);
    }
    this.#pointers.set(event.pointerId, now);
    this.events.onChange();
  }

  #up(event) {
    this.#pointers.delete(event.pointerId);
    if (this.#pointers.size === 0) this.#start = null;
  }

  #wheel(event) {
    event.preventDefault();
    const px = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
    this.viewport.zoomBy(Math.exp(-px * (event.ctrlKey ? PINCH_WHEEL : WHEEL)), ...this.#at(event));
    this.events.onChange();
  }

  #click(event) {
    const [x, y] = this.#at(event), { ms } = this.#tap;
    // The browser counts clicks by the user's own double-click time; some count no taps, and so they are timed here, too.
    const isSoon = event.timeStamp - ms < DOUBLE_MS && Math.hypot(x - this.#tap.x, y - this.#tap.y) < DOUBLE_PX;
    const isDouble = isSoon || (event.detail > 1 && event.detail % 2 === 0);
    this.#tap = { ms: isDouble ? -Infinity : event.timeStamp, x, y };
    if (!isDouble) return this.events.onTap(event);
    this.events.onDouble();
    if (this.viewport.isManual && this.viewport.zoom > 1) this.viewport.reset();
    else this.viewport.zoomBy(DOUBLE_ZOOM, x, y);
    this.events.onChange();
  }

  #at({ clientX, clientY }) {
    const { left, top } = this.element.getBoundingClientRect();
    return [clientX - left, clientY - top];
  }
}
