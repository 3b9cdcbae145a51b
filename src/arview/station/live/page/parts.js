// The list of components with their verdicts, and the card of the isolated component.

import { icon, make } from "./icons.js";
import { exact, rounded } from "./rounding.js";
import { spanText } from "./status.js";
import { t } from "./texts/texts.js";

const ORDER = ["fail", "undecided", "not_measured", "measured", "pass"];
const COMPLETENESS = { COMPLETE: "none", INCOMPLETE: "fail", "NOT YET CHECKED": "none" }; // seen is not yet judged

/** An age as text, such as "3 h ago", in the largest unit of which there are at least two. */
export function ageText(seconds) {
  if (seconds < -60) return t("age.future");
  for (const [unit, length] of [["days", 86400], ["hours", 3600]]) {
    if (seconds >= 2 * length) return t(`age.${unit}`, { count: Math.round(seconds / length) });
  }
  return seconds >= 60 ? t("age.minutes", { count: Math.round(seconds / 60) }) : t("age.now");
}

/** The lists of all parts, and one card. */
export class PartLists {
  #lists = [];

  /**
   * @param box element of the lists.
   * @param card element of the card.
   * @param onPick called with name and part of a component, or with null for all of them.
   */
  constructor(box, card, onPick) {
    Object.assign(this, { box, card, onPick });
    this.only = { name: null, part: 0 };
  }

  /** Show the parts of a part document. */
  setParts(parts) {
    if (parts.length !== this.#lists.length) {
      const pick = (id) => (name) => this.onPick(name, id);
      this.#lists = parts.map(({ id }) => new PartList(pick(id), (step) => this.step(step)));
      this.box.replaceChildren(...this.#lists.map((list) => list.section));
    }
    parts.forEach((part, id) => this.#lists[id].setPart(part));
    this.show(this.only.name, this.only.part);
  }

  /** Say that the verdicts are as old as this, s, because the server is gone; null while it is not. */
  setStale(seconds) {
    const text = seconds === null ? "" : t("parts.stale", { age: spanText(seconds) });
    for (const list of this.#lists) {
      list.stale.hidden = seconds === null;
      if (list.stale.textContent !== text) list.stale.textContent = text;
    }
  }

  /** Take over what a pose says of the components of all parts. */
  setEvidence(pose) {
    for (const { id, ...part } of pose?.parts ?? []) if (this.#lists[id]?.setEvidence(part)) this.show(this.only.name, this.only.part);
  }

  /** Mark the isolated component and show its card; null for none. */
  show(name, part = 0) {
    const list = this.#lists[part], isThere = Boolean(list?.components.some((one) => one.name === name));
    this.only = { name: isThere ? name : null, part };
    this.#lists.forEach((one, id) => one.mark(id === part ? this.only.name : null));
    this.card.hidden = !isThere;
    this.card.replaceChildren(...(isThere ? list.details(name) : []));
    this.card.className = isThere ? list.kindOf(name) : "none";
  }

  /** Isolate the inspected component after (step 1) or before (step -1) the isolated one, of all parts. */
  step(by) {
    const all = this.#lists.flatMap((list, part) => (list.inspected.length ? list.inspected : list.components).map(({ name }) => ({ name, part })));
    if (!all.length) return;
    const at = all.findIndex((one) => one.name === this.only.name && one.part === this.only.part);
    const { name, part } = all[(at + by + all.length) % all.length];
    this.onPick(name, part);
  }
}

/** The list of the components of one part. */
class PartList {
  /**
   * @param onPick called with the name of a component, or null for all of them.
   * @param onStep called with 1 or -1 for the next or previous component.
   */
  constructor(onPick, onStep) {
    Object.assign(this, { onPick, onStep });
    this.name = make("p", "part-name");
    this.stale = make("p", "stale-note");
    this.stale.hidden = true;
    this.tally = make("div", "tally");
    this.list = make("ul", "components");
    this.provenance = make("p", "provenance");
    this.section = make("div", "panel", [this.name, this.stale, this.tally, this.list, this.provenance]);
    this.only = null;
    this.components = [];
    this.seen = new Map();
    this.withheld = null;
  }

  /** Take over what a pose says of the components: a verdict stands only beside what is seen now; returns whether it is new. */
  setEvidence(pose) {
    if (!pose.cam_from_model) return false;
    const key = JSON.stringify([pose.labels, pose.withheld, pose.completeness]);
    if (key === this.key) return false;
    this.key = key;
    this.withheld = pose.withheld;
    this.completeness = pose.completeness;
    this.completenessText = pose.completeness_text ?? pose.completeness;
    this.seen = new Map(pose.labels.map((one) => [this.names[one.index], one]));
    this.#list();
    return true;
  }

  /** Show a part of a part document. */
  setPart({ part, components, inspection, name, mark, tag_color }) {
    const rank = (one) => one.rank ?? Infinity;
    this.components = [...components].sort((a, b) => rank(a) - rank(b));
    this.inspected = this.components.filter((one) => one.rank !== null);
    const serial = inspection?.serial || part.serial;
    const sign = mark ? [make("span", "mark", [mark])] : [];
    for (const one of sign) one.style.color = tag_color;
    this.name.replaceChildren(...sign, make("b", "", [name || part.name]), serial ? ` ${serial}` : "");
    const provenance = inspection
      ? t(inspection.method ? "parts.inspected_by" : "parts.inspected", { age: ageText(inspection.age_s), method: inspection.method })
      : t("parts.not_inspected");
    this.provenance.replaceChildren(provenance);
    this.names = components.map((one) => one.name);
    this.seen = new Map();
    this.withheld = this.completeness = this.key = null;
    this.#list();
  }

  #list() {
    const counts = this.withheld ? [make("span", "count none", [this.withheld.title])] : tally(this.components);
    if (this.completeness) counts.push(make("span", `count ${COMPLETENESS[this.completeness.split(":")[0]]}`, [this.completenessText]));
    this.tally.replaceChildren(...counts);
    this.list.replaceChildren(...this.components.map((one) => this.#row(one)));
  }

  /** Classes, value, U, word and notes of a component, by what was measured and what is seen. */
  #state(one) {
    if (this.withheld) return { kind: "none", value: "", u: null, word: t("parts.withheld"), notes: [] };
    const seen = this.seen.get(one.name);
    const plain = { kind: one.verdict ?? "none", value: one.is_pending ? t("parts.measuring") : one.value_text || (one.missing ? t("parts.missing") : "–"), u: one.uncertainty_mm, word: one.verdict ? t(`verdict.${one.verdict}`) : one.verdict_text ?? (one.is_pending ? "" : t("parts.no_verdict")), notes: [] };
    if (!seen || (one.verdict === null && seen.is_dimmed)) return plain;
    if (!["missing", "displaced", "wrong", "next"].includes(seen.evidence)) return { ...plain, kind: `${plain.kind}${seen.is_dimmed ? " dimmed" : ""}`, notes: seen.notes };
    return { kind: seen.evidence, value: one.is_pending && seen.evidence === "missing" ? "" : seen.value, u: null, word: seen.word, notes: seen.notes };
  }

  /** Mark the isolated component; null for none. */
  mark(name) {
    this.only = name;
    for (const row of this.list.querySelectorAll("button")) {
      row.setAttribute("aria-pressed", String(row.dataset.name === name));
    }
  }

  /** Classes of the card of a component. */
  kindOf(name) {
    return this.#state(this.#find(name)).kind;
  }

  /** Content of the card of a component. */
  details(name) {
    return this.#details(this.#find(name));
  }

  #find(name) {
    return this.components.find((one) => one.name === name);
  }

  #row(one) {
    const { kind, value, u, word, notes } = this.#state(one);
    const shown = make("span", "value", [value]);
    if (u !== null) shown.append(make("small", "", [`U ${rounded(u, u)}`]));
    const row = make("button", kind, [
      icon(kind.split(" ")[0]), make("span", "name", [one.name]), shown, make("span", "verdict", [[word, ...notes].filter(Boolean).join(", ")]),
    ], { "aria-pressed": "false" });
    row.dataset.name = one.name;
    row.addEventListener("click", () => this.onPick(this.only === one.name ? null : one.name));
    return make("li", "", [row]);
  }

  #details(one) {
    const button = (name, label, onClick) => {
      const made = make("button", "step", [icon(name)], { "aria-label": label });
      made.addEventListener("click", onClick);
      return made;
    };
    const forward = button("back", t("card.next"), () => this.onStep(1));
    forward.classList.add("forward");
    const { kind, word, value, notes } = this.#state(one);
    const remark = notes.length ? [make("p", "axes", [make("span", "", [notes.join(", ")])])] : [];
    const head = make("div", "head", [
      button("back", t("card.previous"), () => this.onStep(-1)),
      make("span", "title", [make("b", "", [one.name]), make("span", "verdict", [icon(kind.split(" ")[0]), word])]),
      forward, button("close", t("card.all"), () => this.onPick(null)),
    ]);
    if (this.withheld) return [head, make("p", "rest", [this.withheld.text])];
    if (["wrong", "next"].includes(kind)) return [head, make("p", "big", [word]), ...remark];
    if (["missing", "displaced"].includes(kind)) return [head, make("p", "big", [value || t("parts.missing")]), ...remark];
    if (one.distance_mm === null) {
      return [head, make("p", "big", [one.is_pending ? t("parts.measuring") : one.value_text || t(one.verdict ? "card.not_measured" : "card.not_inspected")])];
    }
    const u = one.uncertainty_mm ?? 0;
    const numbers = make("p", "numbers", [
      make("span", "big", [one.value_text]),
      make("span", "rest", [t("card.u", { u: rounded(u, u) }), ...(one.tolerance_mm === null ? [] : [make("br"), t("card.tolerance", { tolerance: exact(one.tolerance_mm) })])]),
    ]);
    const axes = one.displacement_mm.map((value, k) => {
      const text = value === null ? "?" : `${value < 0 ? "−" : "+"}${rounded(Math.abs(value), u)}`;
      return make("span", value !== null && Math.abs(value) <= u ? "small" : "", [`d${"xyz"[k]}\u00a0${text}`]);
    });
    const turn = one.detail_text.split("   ").filter((text) => text.startsWith("tilt") || text.startsWith("twist"));
    return [head, numbers, ...remark, ...gauge(one), make("p", "axes", [...axes, ...turn.map((text) => make("span", "", [text]))])];
  }
}

/** A bar that shows the distance and its U against the tolerance, to scale. */
function gauge({ distance_mm: d, uncertainty_mm: u, tolerance_mm: tolerance }) {
  if (tolerance === null) return [];
  const end = Math.max(1.5 * tolerance, 1.1 * (d + (u ?? 0))), share = (value) => `${(100 * Math.min(1, Math.max(0, value / end))).toFixed(2)}%`;
  const part = (name, left, right) => {
    const made = make("span", name);
    made.style.left = share(left);
    if (right !== undefined) made.style.right = `calc(100% - ${share(right)})`;
    return made;
  };
  const bar = make("div", "gauge", [part("allowed", 0, tolerance), part("band", d - (u ?? 0), d + (u ?? 0)), part("limit", tolerance), part("mark", d)], {
    role: "img", "aria-label": t("card.gauge", { value: rounded(d, u), u: rounded(u ?? 0, u), tolerance: exact(tolerance) }),
  });
  return [bar];
}

/** Number of components by verdict, the most severe first. */
export function tally(components) {
  return ORDER.flatMap((verdict) => {
    const count = components.filter((one) => one.verdict === verdict).length;
    return count ? [make("span", `count ${verdict}`, [icon(verdict), t("parts.count", { count, verdict: t(`verdict.${verdict}`) })])] : [];
  });
}
