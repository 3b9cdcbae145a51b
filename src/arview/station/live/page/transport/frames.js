// A ring of the last frames with their ids, so that a pose that arrives later finds the frame it belongs to.

import { CANVAS_OPTIONS } from "../graphics.js";
import { isNewer } from "./stamp.js";

export class FrameRing {
  #slots = [];
  newest = null;

  /** @param size number of frames to keep. */
  constructor(size) {
    this.size = size;
  }

  /**
   * Keep a copy of a frame.
   * @param source video or canvas whose upper width × height px are the picture.
   * @param about {id, turns, takenMs}
   * @param pinned frames that must not be overwritten because they are shown or being sent.
   */
  take(source, width, height, about, pinned) {
    const slot = this.#slots.length < this.size ? this.#add() : this.#oldest(pinned);
    if (slot.canvas.width !== width || slot.canvas.height !== height) {
      slot.canvas.width = width;
      slot.canvas.height = height;
    }
    slot.context.drawImage(source, 0, 0, width, height, 0, 0, width, height);
    Object.assign(slot, about, { width, height, order: (this.newest?.order ?? 0) + 1 });
    this.newest = slot;
    return slot;
  }

  find(id) {
    return this.#slots.find((slot) => slot.id === id) ?? null;
  }

  /** The newest frame whose id satisfies a predicate. */
  newestWhere(is) {
    return this.#slots.reduce((best, slot) => (is(slot.id) && (!best || isNewer(slot.id, best.id)) ? slot : best), null);
  }

  clear() {
    for (const slot of this.#slots) slot.id = null;
    this.newest = null;
  }

  #add() {
    const canvas = document.createElement("canvas"), context = canvas.getContext("2d", CANVAS_OPTIONS);
    const slot = { canvas, context, id: null, order: 0 };
    this.#slots.push(slot);
    return slot;
  }

  #oldest(pinned) {
    return this.#slots.reduce((best, slot) => (!pinned.includes(slot) && (!best || slot.order < best.order) ? slot : best), null);
  }
}
