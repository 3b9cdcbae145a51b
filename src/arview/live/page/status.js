// What the page says of itself: the state in a word, why, the figures, notices, and what keeps it from working.

import { icon, make } from "./icons.js";

const STATES = {
  tracked: ["tracked", "Tracked"],
  critical: ["critical", "Critical"],
  searching: ["searching", "Searching"],
  lost: ["lost", "Lost"],
  align: ["align", "Align"],
  loading: ["busy", "Loading"],
  connecting: ["busy", "Connecting"],
  retrying: ["offline", "Connection lost"],
  busy: ["busy", "Busy"],
  denied: ["offline", "Not admitted"],
  trouble: ["camera", "No camera"],
  waiting: ["busy", "Waiting"],
  frozen: ["pause", "Frozen"],
};
/** Notices of which the inspector must not go on without knowing. */
const STRONG = { inspection_old: "Stale inspection: ", inspection_serial: "", inspection_model: "", inspection_unreadable: "" };
const RANKS = { error: 0, warning: 1, info: 2 };

const upper = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export class StatusBar {
  /** @param elements {icon, word, why, quality, meter, latency, age, body} */
  constructor(elements) {
    Object.assign(this, elements);
    this.#said = "";
  }

  #said;

  /** Say a state, one of STATES, and why. */
  say(state, why = "") {
    const said = `${state} ${why}`;
    if (said === this.#said) return;
    this.#said = said;
    const [sign, word] = STATES[state];
    this.body.dataset.state = state;
    this.icon.replaceChildren(icon(sign));
    if (this.word.textContent !== word) this.word.textContent = word;
    this.why.textContent = upper(why);
  }

  /** Show the figures; null is a dash. */
  figures({ quality, latencyMs, ageMs }) {
    const text = (value, unit, digits = 0) => (value === null ? "–" : `${value.toFixed(digits)} ${unit}`);
    this.quality.textContent = quality === null ? "–" : `${Math.round(100 * quality)} %`;
    this.meter.value = quality ?? 0;
    this.latency.textContent = text(latencyMs, "ms");
    this.age.textContent = ageMs === null ? "–" : ageMs < 1000 ? text(ageMs, "ms") : text(ageMs / 1000, "s", ageMs < 9950 ? 1 : 0);
    this.age.classList.toggle("old", ageMs !== null && ageMs > 1000);
  }
}

export class Notices {
  #said = null;
  #isOpen = false;

  constructor(box) {
    this.box = box;
  }

  /** Show notices {level, text}; the gravest one, and the others when it is pressed. */
  show(notices) {
    const said = JSON.stringify(notices);
    if (said === this.#said) return;
    this.#said = said;
    this.notices = [...notices].sort((a, b) => RANKS[a.level] - RANKS[b.level] || (b.code in STRONG) - (a.code in STRONG));
    this.#draw();
  }

  #draw() {
    const shown = this.#isOpen ? this.notices : this.notices.slice(0, 1), more = this.notices.length - 1;
    this.box.replaceChildren(
      ...shown.map(({ code, level, text }, i) => {
        const inside = [icon(level), make("span", "text", [upper((STRONG[code] ?? "") + text)])];
        if (i === 0 && more > 0) inside.push(make("span", "more", [this.#isOpen ? "less" : `+${more}`]));
        const classes = `notice ${level} ${code in STRONG ? "strong" : ""} ${this.#isOpen ? "open" : ""}`;
        const line = make("button", classes, inside, { "aria-expanded": String(this.#isOpen) });
        line.addEventListener("click", () => {
          this.#isOpen = !this.#isOpen;
          this.#draw();
        });
        return line;
      }),
    );
  }
}

/** A card in the middle, for what has to be dealt with first. */
export class Message {
  #said = null;

  constructor(box) {
    this.box = box;
  }

  /** Show words with a sign and a button, or nothing for null. */
  show(content) {
    const said = content && `${content.title}|${content.text}|${content.button}`;
    if (said === this.#said) return;
    this.#said = said;
    this.box.hidden = !content;
    if (!content) return this.box.replaceChildren();
    const inside = [icon(content.sign), make("h2", "", [content.title]), make("p", "", [upper(content.text)])];
    if (content.button) {
      const button = make("button", "wide", [content.button]);
      button.addEventListener("click", content.onPress);
      inside.push(button);
    }
    this.box.replaceChildren(...inside);
  }
}

/** A short word that goes away by itself. */
export class Toast {
  #timer = 0;

  constructor(box) {
    this.box = box;
  }

  /** Say something; a link {href, text, download} may be offered with it. */
  say(text, link = null, seconds = link ? 12 : 5) {
    clearTimeout(this.#timer);
    const inside = [make("span", "", [text])];
    if (link) inside.push(make("a", "", [link.text], { href: link.href, download: link.download ?? "" }));
    this.box.replaceChildren(...inside);
    this.box.hidden = false;
    this.#timer = setTimeout(() => { this.box.hidden = true; }, 1000 * seconds);
  }
}
