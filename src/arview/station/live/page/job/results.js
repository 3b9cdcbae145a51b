// The result of a job: measuring, first numbers, final; verdicts of the components; what people decided; the signature.

import { icon, make } from "../icons.js";
import { decimal, rounded } from "../rounding.js";
import { language, t } from "../texts/texts.js";
import { fileOf } from "./api.js";
import { leftText, shareDone } from "./time_left.js";
import { bySeverity, counts, verdictWord } from "./verdicts.js";

/** The newest decision about each component: name → decision. */
export function latestDecisions(decisions) {
  const latest = new Map();
  for (const one of decisions ?? []) if (one.component && typeof one.is_ok === "boolean") latest.set(one.component, one);
  return latest;
}

const when = (text) => new Date(text).toLocaleString([], { dateStyle: "short", timeStyle: "short" });

export class ResultsView {
  #key = "";

  /** @param events {onComponent(name), onMore(), onSign(), onRecheck(id), onBack(), onCancel()} */
  constructor(events) {
    this.events = events;
    this.element = make("div", "job-view");
    this.bar = make("progress", "", [], { max: "100", "aria-label": t("job.measuring") });
    this.left = make("p", "job-quiet");
  }

  /**
   * Show a job. `rechecks` are the job documents of its checks after rework; `parent` the job that this one checks again.
   * `waiting` photos are still on this device.
   */
  show(job, { rechecks = [], waiting = 0, parent = null } = {}) {
    const { state, inspection } = job, { measuring_s: _, expected_s: __, ...known } = job;
    this.#tell(job);
    const key = JSON.stringify([{ ...known, state: { ...state, step: "", done: 0, total: 0, updated: "" } }, rechecks, waiting]);
    if (key === this.#key) return;
    this.#key = key;
    const inside = [this.#head(job, parent), this.#progress(job, waiting)];
    if (parent) inside.push(...this.#beforeAfter(job));
    else if (inspection) inside.push(this.#banner(job), this.#components(job, rechecks));
    if (state.stage === "done") inside.push(...(parent ? this.#checked(parent) : this.#end(job)));
    inside.push(this.#photos(job));
    const { scrollTop } = this.element.parentElement ?? {};
    this.element.replaceChildren(...inside.filter(Boolean));
    if (scrollTop) this.element.parentElement.scrollTop = scrollTop;
  }

  #head(job, parent) {
    const back = make("button", "job-back", [icon("back"), t(parent ? "job.back_to_result" : "job.back")]);
    back.addEventListener("click", () => this.events.onBack());
    return make("div", "job-head", [back, make("h3", "", [t("job.title", { part: job.part_name, serial: job.serial })])]);
  }

  /** What is being done, with its share; nothing when all is done. */
  #progress({ state, photos }, waiting) {
    if (state.stage === "done") {
      const cloud = { waiting: "job.cloud_running", running: "job.cloud_running", failed: "job.cloud_failed" }[state.cloud];
      return cloud ? make("p", "job-quiet", [t(cloud)]) : null;
    }
    if (state.stage === "failed") {
      const more = make("button", "wide", [t("job.more_photos")]);
      more.addEventListener("click", () => this.events.onMore());
      return make("div", "job-progress failed", [make("p", "", [icon("error"), state.text || t("job.failed")]), ...original(state), more], { role: "alert" });
    }
    const cancel = make("button", "wide", [icon("stop"), t("job.cancel")]);
    cancel.addEventListener("click", () => this.events.onCancel());
    const words = waiting ? t("job.sending", { waiting }) : t("job.measuring_of", { photos: t(photos.length === 1 ? "job.photos_one" : "job.photos_count", { photos: photos.length }) });
    return make("div", "job-progress", [make("p", "", [icon("busy"), make("b", "", [words])]), this.bar, this.left, cancel], { role: "status" });
  }

  /** How far the measurement is, and the time left; often told anew, without drawing all again. */
  #tell(job) {
    const share = shareDone(job.state), text = job.is_ended ? leftText(job) : "";
    if (share === null) this.bar.removeAttribute("value");
    else this.bar.value = Math.max(this.bar.value ?? 0, Math.round(100 * share));
    if (this.left.textContent !== text) this.left.textContent = text;
  }

  #banner(job) {
    const { components, verdict, sentence } = job.inspection;
    if (isOpen(job)) {
      return make("div", "job-banner rough", [make("div", "what", [icon("busy"), make("b", "", [t("job.provisional")])]), make("p", "", [t("job.rough")])], { role: "status" });
    }
    const list = counts(components).map(([kind, count]) => make("span", `count ${kind}`, [icon(kind), `${count} ${verdictWord(kind)}`]));
    return make("div", `job-banner ${verdict}`, [
      make("div", "what", [icon(verdict), make("b", "", [verdictWord(verdict)])]),
      make("p", "", [language === "en" ? sentence : t("job.sentence", { count: components.length })]), make("div", "tally", list),
    ], { role: "status" });
  }

  #components(job, rechecks) {
    const decided = latestDecisions(job.decisions), again = new Map();
    for (const one of rechecks) for (const row of one.before_after ?? []) again.set(row.name, { ...row, stage: one.state.stage });
    const isRough = isOpen(job), found = job.inspection.components;
    const rows = (isRough ? found : bySeverity(found)).map((one) => {
      const kind = isRough ? "none" : one.verdict;
      const row = make("button", `component ${kind}`, [
        icon(kind), make("span", "name", [one.name]),
        make("span", "value", [one.value_text, ...(one.uncertainty_mm === null ? [] : [make("small", "", [`U ${rounded(one.uncertainty_mm, one.uncertainty_mm)}`])])]),
        make("span", "verdict", [isRough ? t("job.provisional_word") : verdictWord(kind)]), ...remarks(one, decided.get(one.name), again.get(one.name)),
      ]);
      row.dataset.name = one.name;
      row.addEventListener("click", () => this.events.onComponent(one.name));
      return make("li", "", [row]);
    });
    return make("ul", "components", rows);
  }

  /** The components of a check after rework: each with its new verdict first, then what it was before and is now. */
  #beforeAfter(job) {
    const isMeasured = !isOpen(job) && job.state.stage !== "failed";
    const rows = (job.before_after ?? []).map((one) => make("div", `before-after ${(isMeasured && one.verdict_after) || "none"}`, [
      make("div", "what", [icon(isMeasured ? one.verdict_after : "none"), make("b", "", [one.name]), ...(isMeasured ? [make("b", "now", [verdictWord(one.verdict_after)])] : [])]),
      make("span", "was", [make("small", "", [t("job.before")]), mm(one.before_mm), make("small", one.verdict_before, [verdictWord(one.verdict_before)])]),
      make("span", "arrow", ["→"], { "aria-hidden": "true" }),
      make("span", "is", [make("small", "", [t("job.after")]), mm(one.after_mm), make("small", "", [isMeasured ? verdictWord(one.verdict_after) : t("parts.measuring")])]),
    ]));
    return rows;
  }

  #checked(parent) {
    const back = make("button", "wide primary", [t("job.back_to_result")]);
    back.addEventListener("click", () => this.events.onRecheck(parent));
    return [back];
  }

  #end(job) {
    const open = counts(job.inspection?.components ?? []).filter(([kind]) => kind !== "pass" && kind !== "measured").length;
    const decided = latestDecisions(job.decisions).size;
    const sign = make("button", "wide primary", [icon("pen"), t(job.signed ? "job.sign_again" : "job.sign")]);
    sign.addEventListener("click", () => this.events.onSign());
    const isEarly = ["waiting", "running"].includes(job.state.cloud) && ["waiting", "running"].includes(job.worker);
    const report = make("a", "wide", [icon("list"), t("job.report")], { href: fileOf(job.id, "report.html"), target: "_blank", rel: "noopener" });
    const table = make("a", "job-link", [t("job.csv")], { href: fileOf(job.id, "decisions.csv"), download: "" });
    const signed = job.signed ? [make("p", "job-signed", [icon("tracked"), t("job.signed", { by: job.signed.by, when: when(job.signed.time ?? job.signed.created ?? job.signed.at) })])] : [];
    const early = isEarly ? [make("p", "job-quiet", [t("job.sign_early")])] : [];
    const hint = !job.signed && open && !decided ? [make("p", "job-quiet", [t("job.decide_first")])] : [];
    return [...signed, ...early, ...hint, make("div", "job-ends", [sign, report]), make("p", "", [table])];
  }

  #photos(job) {
    if (!job.photos?.length) return null;
    const pictures = job.photos.map((name) => make("a", "", [
      make("img", "", [], { src: fileOf(job.id, `photos/${name}`), alt: t("job.photo", { name }), loading: "lazy" }),
    ], { href: fileOf(job.id, `photos/${name}`), target: "_blank", rel: "noopener" }));
    return make("details", "job-photos", [make("summary", "", [t("job.photos", { photos: job.photos.length })]), make("div", "", pictures)]);
  }
}

/** What the station says of a failure in its own language, where the page has no words for it. */
const original = (state) => (state.original ? [make("details", "", [make("summary", "", [t("job.failed_why")]), make("p", "", [state.original], { lang: "en" })])] : []);

/** Whether numbers are still to come: none that is shown is a verdict. */
export const isOpen = ({ state }) => Boolean(state.is_rough) || ["collecting", "measuring"].includes(state.stage);

/** A length as text; a dash where there is none. */
const mm = (value) => make("b", "", [value === null || value === undefined ? "–" : `${decimal(value.toFixed(2))} mm`]);

/** What was decided about a component, and what the check after rework found. */
function remarks(one, decision, again) {
  const found = [];
  if (again?.after_mm !== null && again?.after_mm !== undefined) {
    found.push(make("span", `note ${again.verdict_after}`, [icon(again.verdict_after), t("job.again", { before: again.before_mm === null ? "–" : decimal(again.before_mm.toFixed(2)), after: decimal(again.after_mm.toFixed(2)), verdict: verdictWord(again.verdict_after) })]));
  }
  if (decision) {
    found.push(make("span", `note ${decision.is_ok ? "pass" : "fail"}`, [icon(decision.is_ok ? "pass" : "fail"), t(decision.is_ok ? "job.is_ok" : "job.is_not_ok", { by: decision.by }), decision.reason ? `: ${decision.reason}` : ""]));
  }
  return found;
}
