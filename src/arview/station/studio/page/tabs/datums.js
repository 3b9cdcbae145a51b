// Tab "Datums": the lists of datums and features; they are made by a click in the view.

import { icon, make, shown } from "../dom.js";
import { wordsOf } from "../picker.js";

const ORDER = ["A", "B", "C"];

export class DatumsTab {
  title = "Datums";

  constructor(store, panel) {
    this.store = store;
    this.list = make("ol", { class: "cards" });
    panel.append(make("p", { class: "hint" }, "Click a plane, a hole, a cylinder or an edge in the view, and choose the letter. A is usually the plane on which the part stands, B the hole that locates it, C what stops it from turning. + makes it a feature, of which [[characteristics]] in the text can require something."), this.list);
    store.on("part", () => this.#show());
  }

  #show() {
    const { datums, features } = this.store.part, labels = [...new Set([...ORDER, ...datums.map((one) => one.label)])].sort();
    const cards = labels.map((label) => this.#card("datum", label, datums.find((one) => one.label === label)));
    this.list.replaceChildren(...cards, ...features.map((one) => this.#card("feature", one.label, one)));
  }

  #card(kind, label, datum) {
    return make("li", { class: datum ? "card" : "card is-empty" },
      make("b", { class: "letter" }, label),
      datum ? make("div", {},
        make("b", {}, wordsOf(datum)), make("div", {}, datum.component),
        make("small", {}, `at ${datum.point_mm.map((one) => shown(one, 3)).join(", ")} mm, along ${datum.direction.map((one) => shown(one, 3)).join(", ")}`),
      ) : make("div", {}, "not set"),
      datum ? make("button", { class: "tool", type: "button", "aria-label": `Remove ${kind} ${label}`, title: "Remove", onclick: () => this.store.edit({ kind, label, value: null }) }, icon("trash")) : null);
  }
}
