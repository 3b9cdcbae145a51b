// The states of several parts below the status bar, what they come to, and the buttons that confirm parts.

import { icon, make } from "./icons.js";
import { STATES } from "./status.js";
import { hasText, t } from "./texts/texts.js";

const SEVERITY = ["tracked", "critical", "searching", "lost"];

/** What a pose says of a part in one line: faults and the step to be done, incomplete, withheld, the reason of its state, mismatches. */
export function reasonOf({ state, remark, completeness, withheld, mismatches, steps = null }) {
  const reason = remark || (hasText(`why.${state}`) ? t(`why.${state}`) : "");
  const found = completeness.startsWith("INCOMPLETE") ? [t("why.incomplete")] : [];
  return [...(steps ? [...steps.faults, steps.text] : []), ...found, ...(withheld ? [`${withheld.title}: ${withheld.text}`] : []), ...(reason ? [reason] : []), ...mismatches].join("; ");
}

/** State and reason of several parts together: tracked if all are, else the most severe, with how many are tracked. */
export function summaryOf(parts, names) {
  const tracked = parts.filter((one) => one.state === "tracked").length;
  const isWaiting = parts.filter((one) => one.withheld);
  const worst = parts.reduce((a, b) => (SEVERITY.indexOf(b.state) > SEVERITY.indexOf(a.state) ? b : a));
  const words = [t(tracked === parts.length ? "why.all_parts" : "why.some_parts", { tracked, count: parts.length })];
  if (isWaiting.length) words.push(t("why.to_confirm", { names: isWaiting.map(({ id }) => names[id]).join(", ") }));
  const isPartly = worst.state === "searching" && tracked > 0;
  return [isPartly ? "critical" : worst.state, words.join("; ")];
}

export class Specimens {
  #shown = null;
  #waiting = [];

  /**
   * @param elements {list, confirms, confirm}: of the states, of all buttons, and the button of the only part.
   * @param onConfirm called with the number of a part, and its name.
   */
  constructor(elements, onConfirm) {
    Object.assign(this, elements, { onConfirm });
    this.parts = [];
    this.rows = [];
    this.buttons = [this.confirm];
    this.confirm.addEventListener("click", () => onConfirm(0));
  }

  get isSeveral() {
    return this.parts.length > 1;
  }

  get names() {
    return this.parts.map(({ mark, name }) => `${mark} ${name}`);
  }

  /** Numbers of the parts that wait for a confirmation. */
  get waiting() {
    return this.#waiting;
  }

  /** Set the parts of a part document. */
  setParts(parts) {
    if (JSON.stringify(parts.map((one) => one.name)) === JSON.stringify(this.parts.map((one) => one.name))) return;
    this.parts = parts;
    this.#shown = null;
    for (const button of this.buttons) if (button !== this.confirm) button.remove();
    this.buttons = this.isSeveral ? parts.map((one) => this.#button(one)) : [this.confirm];
    this.rows = this.isSeveral ? parts.map((one) => row(one)) : [];
    this.list.replaceChildren(...this.rows.map((one) => one.element));
    this.list.hidden = !this.isSeveral;
  }

  /** Show the states of the parts of a pose; null while there is none. */
  show(pose) {
    const states = pose?.parts ?? [];
    const key = JSON.stringify(states.map((one) => [one.state, one.quality, one.completeness, reasonOf(one)]));
    if (key === this.#shown) return;
    this.#shown = key;
    this.#waiting = states.filter((one) => one.withheld).map((one) => one.id);
    for (const [id, button] of this.buttons.entries()) button.hidden = !this.#waiting.includes(id);
    if (this.isSeveral) this.confirm.hidden = true;
    for (const [id, { sign, word, quality, why, element }] of this.rows.entries()) {
      const one = states[id], state = one?.state ?? "waiting", name = STATES[state], text = t(`state.${state}`);
      element.className = one?.completeness.startsWith("INCOMPLETE") ? "fail" : state;
      sign.replaceChildren(icon(name));
      word.textContent = text;
      quality.textContent = one?.cam_from_model ? `${Math.round(100 * one.quality)} %` : "";
      why.textContent = one ? reasonOf(one) : "";
    }
  }

  #button({ id, mark, name, tag_color }) {
    const sign = make("span", "mark", [mark]);
    sign.style.color = tag_color;
    const button = make("button", "wide", [sign, t("confirm.named", { name }), make("kbd", "", [String(id + 1)])], { "aria-keyshortcuts": String(id + 1) });
    button.hidden = true;
    button.addEventListener("click", () => this.onConfirm(id, name));
    this.confirms.append(button);
    return button;
  }
}

/** The line of a part: mark, name, state, quality, reason. */
function row({ mark, name, tag_color }) {
  const made = make("span", "mark", [mark]);
  made.style.color = tag_color;
  const [sign, word, quality, why] = ["sign", "word", "quality", "why"].map((kind) => make("span", kind));
  return { element: make("li", "waiting", [made, make("b", "", [name]), sign, word, quality, why]), sign, word, quality, why };
}
