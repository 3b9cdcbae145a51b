// The status display: state and reason, figures, notices, messages that block the page, toasts.

import { icon, make } from "./icons.js";
import { t } from "./texts/texts.js";

/** The icon of each state; its word is the text state.NAME. */
export const STATES = {
  tracked: "tracked", critical: "critical", searching: "searching", lost: "lost", align: "align", loading: "busy",
  connecting: "busy", retrying: "offline", busy: "busy", denied: "offline", trouble: "camera", waiting: "busy", frozen: "pause",
};
/** Notices that the inspector must not miss, some with a text around that of the server. */
const STRONG = {
  inspection_old: "notice.inspection_old", inspection_serial: "", inspection_model: "", inspection_unreadable: "",
  inspection_future: "", disk_low: "notice.disk",
};
const RANKS = { error: 0, warning: 1, info: 2 };

/** A sentence with a capital at its beginning, unless it begins with a name such as post_1. */
const capitalized = (text) => (/^[^\s,;:]*[_\d]/.test(text) ? text : text.charAt(0).toUpperCase() + text.slice(1));

/** A duration as text, such as "12 s", in the largest unit of which there are at least two. */
export function spanText(seconds) {
  for (const [unit, length] of [["days", 86400], ["hours", 3600], ["minutes", 60]]) {
    if (seconds >= 2 * length) return t(`span.${unit}`, { count: Math.round(seconds / length) });
  }
  return t("span.seconds", { count: Math.max(0, Math.round(seconds)) });
}

export class StatusBar {
  /** @param elements {icon, word, why, quality, meter, latency, age, stale, body} */
  constructor(elements) {
    Object.assign(this, elements);
    this.#shown = "";
  }

  #shown;

  /** Show a state, one of STATES, and its reason. */
  show(state, reason = "") {
    const text = `${state} ${reason}`;
    if (text === this.#shown) return;
    this.#shown = text;
    const sign = STATES[state], word = t(`state.${state}`);
    this.body.dataset.state = state;
    this.icon.replaceChildren(icon(sign));
    if (this.word.textContent !== word) this.word.textContent = word;
    this.why.textContent = capitalized(reason);
  }

  /** Show the figures; null is shown as a dash. Of a server that is gone they stay, dimmed, with their age. */
  figures({ quality, latencyMs, ageMs, staleS = null }) {
    this.body.classList.toggle("is-stale", staleS !== null);
    this.stale.hidden = staleS === null;
    if (staleS !== null) {
      const text = t("figures.stale", { age: spanText(staleS) });
      if (this.stale.textContent !== text) this.stale.textContent = text;
      return;
    }
    const text = (value, unit, digits = 0) => (value === null ? "–" : `${value.toFixed(digits)} ${unit}`);
    this.quality.textContent = quality === null ? "–" : `${Math.round(100 * quality)} %`;
    this.meter.value = quality ?? 0;
    this.latency.textContent = text(latencyMs, "ms");
    this.age.textContent = ageMs === null ? "–" : ageMs < 1000 ? text(ageMs, "ms") : text(ageMs / 1000, "s", ageMs < 9950 ? 1 : 0);
    this.age.classList.toggle("old", ageMs !== null && ageMs > 1000);
  }
}

export class Notices {
  #shown = null;
  #isOpen = false;

  constructor(box) {
    this.box = box;
  }

  /** Show notices {level, text}: the most severe one, and all of them after a press on it. */
  show(notices) {
    const text = JSON.stringify(notices);
    if (text === this.#shown) return;
    this.#shown = text;
    this.notices = [...notices].sort((a, b) => RANKS[a.level] - RANKS[b.level] || (b.code in STRONG) - (a.code in STRONG));
    this.#draw();
  }

  #draw() {
    const shown = this.#isOpen ? this.notices : this.notices.slice(0, 1), more = this.notices.length - 1;
    this.box.replaceChildren(
      ...shown.map(({ code, level, text }, i) => {
        const inside = [icon(level), make("span", "text", [capitalized(STRONG[code] ? t(STRONG[code], { text }) : text)])];
        if (i === 0 && more > 0) inside.push(make("span", "more", [this.#isOpen ? t("notices.less") : `+${more}`]));
        const classes = `notice ${level} ${code in STRONG ? "strong" : ""} ${this.#isOpen ? "open" : ""}`;
        const line = make("button", classes, inside, { "aria-expanded": String(this.#isOpen) });
        if (i === 0 && more > 0) inside.at(-1).setAttribute("aria-label", this.#isOpen ? t("notices.fewer") : t("notices.more", { count: more }));
        line.addEventListener("click", () => {
          this.#isOpen = !this.#isOpen;
          this.#draw();
        });
        return line;
      }),
    );
  }
}

/** A card in the middle for what has to be resolved first. */
export class Message {
  #shown = null;

  constructor(box) {
    this.box = box;
  }

  /** Show an icon, a text and a button; null hides the card. */
  show(content) {
    const text = content && `${content.title}|${content.text}|${content.button}`;
    if (text === this.#shown) return;
    this.#shown = text;
    this.box.hidden = !content;
    if (!content) return this.box.replaceChildren();
    const inside = [icon(content.sign), make("h2", "", [content.title]), make("p", "", [capitalized(content.text)])];
    if (content.button) {
      const button = make("button", "wide", [content.button]);
      button.addEventListener("click", content.onPress);
      inside.push(button);
    }
    this.box.replaceChildren(...inside);
  }
}

/** A short message that disappears by itself. */
export class Toast {
  #timer = 0;

  constructor(box) {
    this.box = box;
  }

  /** Show a message, optionally with a link {href, text, download}. */
  show(text, link = null, seconds = link ? 12 : 5) {
    clearTimeout(this.#timer);
    const inside = [make("span", "", [text])];
    if (link) inside.push(make("a", "", [link.text], { href: link.href, download: link.download ?? "" }));
    this.box.replaceChildren(...inside);
    this.box.hidden = false;
    this.#timer = setTimeout(() => { this.box.hidden = true; }, 1000 * seconds);
  }
}
