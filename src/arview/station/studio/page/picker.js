// A click on a face: what is there, and which datum or feature it becomes.

import { post } from "./api.js";
import { find, icon, make, shown } from "./dom.js";

const LABELS = ["A", "B", "C"];

/** A feature in words: "hole ⌀12.000". */
export function wordsOf({ feature, diameter_mm, width_mm }) {
  if (feature === "slot") return `slot ${(width_mm ?? diameter_mm).toFixed(3)} wide`;
  return diameter_mm ? `${feature} ⌀${diameter_mm.toFixed(3)}` : feature;
}

/** A name for a new feature that no feature has. */
function freeName({ features, components }, kind) {
  const taken = new Set([...features.map((one) => one.label), ...components.map((one) => one.name)]);
  for (let number = 1; ; number += 1) if (!taken.has(`${kind}_${number}`)) return `${kind}_${number}`;
}

export class Picker {
  constructor(store, stage, marks) {
    Object.assign(this, { store, stage, marks });
    this.box = find("picked");
    this.box.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.close();
    });
    stage.addEventListener("drag", () => this.close());
  }

  async open({ hit, x, y }) {
    this.close();
    const request = this.request = {};
    const name = this.store.part.components[hit.component].name;
    const answer = await this.store.during("Looking for features", () => post("/api/pick", { component: name, face: hit.face, point_mm: hit.point }));
    if (!answer || this.request !== request) return;
    const rows = answer.features.map((one) => this.#row(one));
    this.box.replaceChildren(
      make("header", {}, make("b", {}, name), make("button", { class: "tool", type: "button", "aria-label": "Close", onclick: () => this.close() }, icon("close"))),
      make("ul", {}, rows.length ? rows : make("li", {}, "No plane, hole, cylinder or edge is recognised here.")),
    );
    this.box.hidden = false;
    find("hover").hidden = true;
    const left = Math.min(x + 14, this.stage.width - this.box.offsetWidth - 8), top = Math.min(y + 14, this.stage.height - this.box.offsetHeight - 8);
    this.box.style.transform = `translate(${Math.max(8, left)}px, ${Math.max(8, top)}px)`;
    this.box.querySelector("li button")?.focus({ preventScroll: true });
  }

  close() {
    this.request = null;
    this.box.hidden = true;
    this.marks.offer();
  }

  #row({ datum, size_mm }) {
    const free = LABELS.find((label) => !this.store.part.datums.some((one) => one.label === label));
    const preview = () => this.marks.offer(this.store.part, datum, size_mm);
    const buttons = LABELS.map((label) => {
      const isTaken = this.store.part.datums.some((one) => one.label === label);
      return make("button", {
        class: label === free ? "datum-button next" : "datum-button", type: "button", "data-label": label,
        "aria-label": `${wordsOf(datum)} becomes datum ${label}`, title: isTaken ? `Replaces datum ${label}` : `Becomes datum ${label}`,
        onclick: async () => {
          this.close();
          await this.store.edit({ kind: "datum", label, value: datum });
        },
      }, label);
    });
    const name = freeName(this.store.part, datum.feature);
    buttons.push(make("button", {
      class: "datum-button", type: "button", "data-label": "feature", "aria-label": `${wordsOf(datum)} becomes the feature ${name}`, title: `Becomes the feature ${name}, for what the drawing requires of it`,
      onclick: async () => {
        this.close();
        await this.store.edit({ kind: "feature", label: name, value: datum });
      },
    }, "+"));
    return make("li", { onpointerenter: preview, onfocusin: preview, onpointerleave: () => this.marks.offer() },
      make("span", { class: "feature" }, wordsOf(datum)), make("small", {}, `${shown(size_mm, 1)} mm`), make("span", { class: "datum-buttons" }, buttons));
  }
}
