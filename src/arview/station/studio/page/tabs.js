// The tabs on the right. A tab is a class with a title, made with the store and its panel; open() and close() are optional.

import { make } from "./dom.js";

export class Tabs {
  current = "";
  #all = new Map();

  /** onOpen(name, before) tells of the tab that has been opened. */
  constructor(bar, panels, onOpen) {
    Object.assign(this, { bar, panels, onOpen });
    bar.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const names = [...this.#all.keys()], at = names.indexOf(this.current);
      this.open(names[(at + step + names.length) % names.length]);
      this.#all.get(this.current).button.focus();
    });
  }

  add(Tab, store, ...more) {
    const panel = make("section", { class: "panel", role: "tabpanel", tabindex: "-1", hidden: true });
    const tab = new Tab(store, panel, ...more), id = tab.title.toLowerCase();
    panel.id = `panel-${id}`;
    panel.setAttribute("aria-labelledby", `tab-${id}`);
    const button = make("button", { role: "tab", type: "button", id: `tab-${id}`, "aria-controls": panel.id, "aria-selected": "false", tabindex: "-1", onclick: () => this.open(tab.title) }, tab.title);
    this.bar.append(button);
    this.panels.append(panel);
    this.#all.set(tab.title, { tab, panel, button });
  }

  of(name) {
    return this.#all.get(name).tab;
  }

  open(name) {
    if (name === this.current) return;
    const before = this.current;
    this.current = name;
    for (const [title, { tab, panel, button }] of this.#all) {
      const isOpen = title === name;
      if (tab.isOpen && !isOpen) tab.close?.();
      tab.isOpen = isOpen;
      panel.hidden = !isOpen;
      button.setAttribute("aria-selected", String(isOpen));
      button.tabIndex = isOpen ? 0 : -1;
      if (isOpen) tab.open?.();
    }
    this.onOpen(name, before);
  }
}
