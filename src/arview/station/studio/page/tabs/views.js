// Tab "Views": the verdict on the guide views, what would help, and their contact sheet.

import { get } from "../api.js";
import { icon, make, percent } from "../dom.js";
import { pictureOf, verdictOf, wordsOfView } from "../views.js";

export class ViewsTab {
  title = "Views";

  /** onMark(index or null) tells of the view under the pointer. */
  constructor(store, panel, onMark) {
    Object.assign(this, { store, onMark });
    this.verdict = make("div", { class: "verdict-box", role: "status" });
    this.shares = make("p", { class: "facts" });
    this.help = make("button", { class: "wide", type: "button", onclick: () => this.#advise() }, "What would help?");
    this.advice = make("ul", { class: "cards" });
    this.sheet = make("div", { class: "sheet", role: "list", "aria-label": "Guide views" });
    panel.append(this.verdict, this.shares, this.help, this.advice, make("h3", {}, "Contact sheet"),
      make("p", { class: "key" }, sign("fine", "distinct"), sign("plain", "plain"), sign("alike", "confused")), this.sheet);
    store.on("views part", () => this.#facts());
    store.on("views", () => this.#show());
  }

  #show() {
    const { views, isAssessing } = this.store;
    if (isAssessing || !views) {
      this.verdict.className = "verdict-box busy";
      this.verdict.replaceChildren(make("b", {}, "The guide views are being made …"));
      this.sheet.replaceChildren(); // its pictures would be those of the part before the edit
      return;
    }
    const { kind, words } = verdictOf(views);
    this.verdict.className = `verdict-box ${kind}`;
    this.verdict.replaceChildren(icon(ICONS[kind]), make("div", {}, make("b", {}, words), make("div", {}, reasonOf(views)),
      ...(views.look_alikes ?? []).map((one) => make("p", { class: one.is_confusable ? "warning" : "" }, `${one.is_confusable ? "⚠ " : ""}${one.text}`))));
    this.advice.replaceChildren();
    this.help.hidden = Boolean(views.error);
    this.#facts();
    this.sheet.replaceChildren(...views.views.map((view, index) => this.#tile(view, index)));
  }

  #facts() {
    const { views } = this.store;
    this.shares.textContent = !views || views.error ? "" : [
      `${views.views.length} views are assessed: ${percent(views.plain_share)} plain, ${percent(views.confusable_share)} confused with another`, views.most_alike,
      this.store.part.symmetries.length && views.confusable_share > 0 ? "the verdict does not know the declared symmetry: views that it maps onto each other may be confused" : "",
    ].filter(Boolean).join("; ");
  }

  #tile(view, index) {
    const picture = make("img", { alt: "", loading: "lazy", width: "320", height: "320" });
    picture.src = pictureOf(this.store.views, index);
    const mark = () => this.onMark(index), unmark = () => this.onMark(null);
    return make("button", {
      class: `tile ${view.weak || "fine"}`, role: "listitem", type: "button", "aria-label": `View ${index}: ${wordsOfView(view)}`, title: wordsOfView(view),
      onpointerenter: mark, onfocus: mark, onpointerleave: unmark, onblur: unmark,
    }, picture, make("span", {}, make("i", { class: `sign ${view.weak || "fine"}` }), `${Math.round(view.azimuth_deg)}° / ${Math.round(view.elevation_deg)}°`));
  }

  /** Bring a view of the sheet into sight. */
  reveal(index) {
    const tile = this.sheet.children[index];
    tile?.scrollIntoView({ block: "center" });
    tile?.focus({ preventScroll: true });
  }

  async #advise() {
    this.help.disabled = true;
    const answer = await this.store.during("Trying what would help", () => get("/api/advice"));
    this.help.disabled = false;
    if (!answer) return;
    const rows = answer.advice.map(({ text, score, edit }) => make("li", { class: "card" },
      make("div", {}, make("b", {}, text), make("small", {}, `share of distinct views: ${percent(this.store.views?.score ?? 0)} → ${percent(score)}`)),
      make("button", { class: "small-button", type: "button", onclick: () => this.store.edit(edit) }, "Apply")));
    this.advice.replaceChildren(...(rows.length ? rows : [make("li", { class: "card" }, (this.store.views?.score ?? 0) >= 1 ? "Every view is distinct already: no change is needed." : "None of the changes that were tried is better. Components around the part, once they are in the CAD, would help.")]));
  }
}

/** Icons of the verdicts: the shape tells them apart where colour does not. */
export const ICONS = { pass: "pass", alike: "warning", fail: "fail" };

/** The reason without the verdict, which stands before it. */
const reasonOf = (views) => (views.reason || "the part can be told from its surroundings").replace(/^(in)?sufficient:\s*/, "");

export const sign = (kind, text) => make("span", { class: "sign-key" }, make("i", { class: `sign ${kind}` }), text);
