// Tab "Range": the viewpoints that can occur, as numbers; the shell in the view is the same.

import { make, numberInput } from "../dom.js";

const ROWS = [
  ["distance_mm", "Distance", "mm from the camera to the middle of the part"],
  ["elevation_deg", "Elevation", "°: 0 is level with the part, 90 above it"],
  ["azimuth_deg", "Azimuth", "°: 0 is along +X, 90 along +Y"],
  ["roll_deg", "Roll", "°: of the camera about its axis"],
];

export class RangeTab {
  title = "Range";

  constructor(store, panel) {
    this.store = store;
    this.body = make("div", { class: "ranges" });
    this.declared = make("p", { class: "facts" });
    this.reset = make("button", { class: "wide", type: "button", onclick: () => store.edit({ kind: "view_range", value: null }) }, "Any viewpoint");
    panel.append(make("p", { class: "hint" }, "From where the camera may look. Drag the borders of the shell, or type. A narrower range is found sooner and more surely."), this.body, this.declared, this.reset);
    store.on("part", () => this.show(store.part.view_range));
  }

  /** Show a range, such as the one that is being dragged. */
  show(range) {
    this.declared.textContent = range.is_declared ? "" : "Not declared yet: this is what arview assumes. Any change declares it.";
    this.reset.hidden = !range.is_declared;
    this.body.replaceChildren(...ROWS.map(([key, title, hint]) => {
      const input = (side) => numberInput({
        value: Math.round(10 * range[key][side]) / 10, "data-key": `${key}-${side}`, "aria-label": `${title}, ${side ? "greatest" : "least"}`,
        onValue: (value) => value === null ? this.show(range) : this.#set(key, side, value),
      });
      return make("fieldset", { class: "interval" }, make("legend", {}, title), input(0), make("span", {}, "to"), input(1), make("small", {}, hint));
    }));
  }

  #set(key, side, value) {
    const values = [...this.store.part.view_range[key]];
    values[side] = value;
    declare(this.store, { ...this.store.part.view_range, [key]: values });
  }
}

/** Write a range into the part file. */
export function declare(store, range) {
  const rounded = ROWS.map(([key]) => [key, range[key].map((value) => Math.round(10 * value) / 10)]);
  return store.edit({ kind: "view_range", value: Object.fromEntries(rounded) });
}
