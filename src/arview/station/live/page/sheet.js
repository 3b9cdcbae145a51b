// The sheet with parts, job, files and view: one section at a time on a small screen, all of them beside the picture on a large one.

import { make } from "./icons.js";
import { t } from "./texts/texts.js";

export class Sheet {
  #opener = null;

  /**
   * @param side element with `section[data-section]` children, and a `#tabs` element.
   * @param onChange called with the name of the section that is open now, or "".
   */
  constructor(side, onChange) {
    Object.assign(this, { side, onChange });
    this.open = "";
    this.sections = [...side.querySelectorAll(":scope > section[data-section]")];
    this.tabs = side.querySelector("#tabs");
    for (const section of this.sections) {
      const name = section.dataset.section;
      const tab = make("button", "tab", [t(`side.${name}`)], { "aria-pressed": "false", "aria-controls": section.id });
      tab.dataset.tab = name;
      tab.addEventListener("click", () => this.show(name));
      this.tabs.append(tab);
    }
    new MutationObserver(() => this.#mark()).observe(side, { childList: true, subtree: true });
    for (const button of document.querySelectorAll("[data-opens]")) this.connect(button);
    document.getElementById("close-side").addEventListener("click", () => this.show(""));
    this.#mark();
  }

  /** Let a button open the section that its data-opens names. */
  connect(button) {
    button.addEventListener("click", () => this.toggle(button.dataset.opens, button));
  }

  toggle(name, opener = null) {
    this.show(this.open === name ? "" : name, opener);
  }

  /** Open a section; "" closes the sheet, and the focus returns to what had opened it. */
  show(name, opener = null) {
    const wasOpen = this.open;
    this.open = name;
    document.body.dataset.side = name;
    if (name && opener) this.#opener = opener;
    this.#mark();
    if (name && !wasOpen) document.getElementById("close-side").focus({ preventScroll: true });
    if (!name && wasOpen) {
      this.#opener?.focus({ preventScroll: true });
      this.#opener = null;
    }
    if (name !== wasOpen) this.side.scrollTop = 0;
    this.onChange(name);
  }

  #mark() {
    for (const section of this.sections) {
      section.classList.toggle("is-open", section.dataset.section === this.open);
      const tab = this.tabs.querySelector(`[data-tab="${section.dataset.section}"]`);
      const isEmpty = section.childElementCount === 0;
      if (tab.hidden !== isEmpty) tab.hidden = isEmpty;
      tab.setAttribute("aria-pressed", String(section.dataset.section === this.open));
    }
    for (const button of document.querySelectorAll("[data-opens]")) {
      const isOpen = String(button.dataset.opens === this.open);
      if (button.getAttribute("aria-expanded") !== isOpen) button.setAttribute("aria-expanded", isOpen);
    }
  }
}
