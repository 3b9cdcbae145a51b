// The assessed guide views of the part as it is now; they are made anew after an edit that changes them.

import { ask } from "./api.js";
import { delayed } from "./dom.js";

const WAIT_MS = 700, FIRST_MS = 1500;

/** Events of the store: "views" (found, made, or being made: `store.views` and `store.isAssessing`). */
export class Views {
  constructor(store) {
    this.store = store;
    store.views = null;
    store.isAssessing = false;
    this.again = delayed(() => this.#ask(), FIRST_MS);
    store.on("part", () => {
      const { part } = store, key = JSON.stringify([part.model_hash, part.view_range, part.up, part.components.map((one) => one.role)]);
      if (key === this.key) return;
      this.key = key;
      store.isAssessing = true;
      store.emit("views");
      this.again();
    });
  }

  async #ask() {
    const { store, key } = this;
    await store.ready;
    if (key !== this.key) return;
    try {
      const answer = await ask("/api/views"), found = await answer.json();
      if (key !== this.key) return;
      if (answer.status === 202) {
        setTimeout(() => this.#ask(), WAIT_MS);
        return;
      }
      store.views = { ...found, key: (this.count = (this.count ?? 0) + 1) };
    } catch (error) {
      if (key !== this.key) return;
      store.views = { is_sufficient: false, reason: error.message, views: [], error: true };
    }
    store.isAssessing = false;
    store.emit("views");
  }
}

/** The verdict on the views: the kind (pass, alike, fail) that gives it colour and icon, and its words. */
export function verdictOf({ is_sufficient: isFine, look_alikes: found }) {
  const names = (found ?? []).filter((one) => one.is_confusable).map((one) => one.other);
  return {
    kind: !isFine ? "fail" : names.length ? "alike" : "pass",
    words: [isFine ? "sufficient" : "insufficient", ...(names.length ? [`confusable with ${names.join(", ")}`] : [])].join(", "),
  };
}

export const pictureOf = (views, index) => `/api/views/${index}.png?n=${views.key}`;

/** A view in words. */
export function wordsOfView(view) {
  const weak = view.weak === "plain" ? "plain: too few lines" : view.weak === "alike" ? `confused with view ${view.confused_with}` : "distinct";
  return `azimuth ${Math.round(view.azimuth_deg)}°, elevation ${Math.round(view.elevation_deg)}°: ${weak}, ${view.lines} lines`;
}
