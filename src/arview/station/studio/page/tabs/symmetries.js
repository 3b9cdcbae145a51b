// Tab "Symmetries": those found in the geometry, to be confirmed or denied, and those that the part file declares.

import { get } from "../api.js";
import { icon, make } from "../dom.js";

const tableOf = ({ axis, through_mm, order }) => ({ axis, through_mm, order });

/** Whether two symmetries are the same turn about the same axis. */
function isSame(one, other) {
  const along = Math.abs(one.axis.reduce((sum, value, k) => sum + value * other.axis[k], 0));
  return one.order === other.order && along > 0.999;
}

export class SymmetriesTab {
  title = "Symmetries";
  #denied = new Set();

  constructor(store, panel) {
    this.store = store;
    this.found = make("ul", { class: "cards" });
    this.declared = make("ul", { class: "cards" });
    panel.append(make("p", { class: "hint" }, "A part that looks the same after a turn has several right poses. Confirm a symmetry only if nobody needs to tell these poses apart."),
      make("h3", {}, "Found in the geometry"), this.found, make("h3", {}, "Declared in the part file"), this.declared);
    store.on("part", () => {
      this.#show();
      if (this.isOpen) this.open();
    });
  }

  async open() {
    const { part } = this.store, key = part.model_hash + JSON.stringify(part.components.map((one) => one.role));
    if (this.key === key) return;
    this.key = key;
    this.found.replaceChildren(make("li", { class: "card" }, "Being looked for …"));
    const answer = await this.store.during("Looking for symmetries", () => get("/api/symmetries"));
    this.rows = answer?.symmetries ?? [];
    this.#show();
  }

  #show() {
    const { symmetries } = this.store.part;
    const put = (rows) => this.store.edit({ kind: "symmetries", value: rows.map(tableOf) });
    const open = (this.rows ?? []).filter((row) => !symmetries.some((one) => isSame(one, row)));
    this.found.replaceChildren(...(open.length ? open.map((row) => this.#card(row, put)) : [make("li", { class: "card" }, this.rows ? "None that is not declared." : "Not looked for yet.")]));
    this.declared.replaceChildren(...(symmetries.length ? symmetries.map((row, k) => make("li", { class: "card" }, make("div", {}, make("b", {}, row.text)),
      make("button", { class: "tool", type: "button", "aria-label": `Remove: ${row.text}`, title: "Remove", onclick: () => put(symmetries.filter((_, other) => other !== k)) }, icon("trash")))) : [make("li", { class: "card" }, "None.")]));
  }

  #card(row, put) {
    const isDenied = this.#denied.has(row.text);
    const why = row.is_exact ? "exact" : row.broken_by.length ? `near; broken by ${row.broken_by.join(", ")}` : "near";
    return make("li", { class: isDenied ? "card is-empty" : "card" },
      make("div", {}, make("b", {}, row.text), make("small", {}, isDenied ? `${why}; denied: the poses are told apart` : why)),
      make("button", { class: "small-button", type: "button", onclick: () => put([...this.store.part.symmetries, row]) }, "Confirm"),
      isDenied ? null : make("button", { class: "small-button", type: "button", onclick: () => {
        this.#denied.add(row.text);
        this.#show();
      } }, "Deny"));
  }
}
