// Tab "Text": the part file as text.

import { make } from "../dom.js";

export class TextTab {
  title = "Text";

  constructor(store, panel) {
    this.store = store;
    this.area = make("textarea", { spellcheck: false, "aria-label": "Text of the part file", oninput: () => this.#mark() });
    this.apply = make("button", { class: "wide main", type: "button", onclick: () => this.#apply() }, "Apply");
    this.reset = make("button", { class: "wide", type: "button", onclick: () => this.#show() }, "Discard");
    panel.classList.add("is-filled");
    panel.append(this.area, make("div", { class: "pair" }, this.apply, this.reset));
    store.on("part", () => {
      if (!this.isChanged || this.area.value === store.part.text) this.#show();
    });
    this.area.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) this.#apply();
    });
  }

  #show() {
    this.area.value = this.store.part.text;
    this.#mark();
  }

  #mark() {
    this.isChanged = this.area.value !== this.store.part.text;
    this.apply.disabled = this.reset.disabled = !this.isChanged;
  }

  async #apply() {
    if (await this.store.edit({ kind: "text", value: this.area.value })) this.#show();
  }
}
