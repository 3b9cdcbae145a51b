// The result of a job: measuring, first numbers, final; verdicts of the components; what people decided; the signature.

import { icon, make } from "../icons.js";
import { rounded } from "../rounding.js";
import { language, t } from "../texts/texts.js";
import { fileOf } from "./api.js";
import { bySeverity, counts, verdictSign, verdictWord } from "./verdicts.js";

/** The newest decision about each component: name → decision. */
export function latestDecisions(decisions) {
  const latest = new Map();
  for (const one of decisions ?? []) if (one.component && typeof one.is_ok === "boolean") latest.set(one.component, one);
  return latest;
}

const when = (text) => new Date(text).toLocaleString([], { dateStyle: "short", timeStyle: "short" });

export class ResultsView {
  #key = "";

  /** @param events {onComponent(name), onMore(), onSign(), onRecheck(id), onBack(), onEnd()} */
  constructor(events) {
    this.events = events;
    this.element = make("div", "job-view");
  }

  /**
   * Show a job. `rechecks` are the job documents of its checks after rework; `parent` the job that this one checks again.
   * `waiting` photos are still on this device.
   */
  show(job, { rechecks = [], waiting = 0, parent = null } = {}) {
    const key = JSON.stringify([job, rechecks, waiting]);
    if (key === this.#key) return;
    this.#key = key;
    const { state, inspection } = job;
    const inside = [this.#head(job, parent), this.#progress(job, waiting)];
    if (inspection) inside.push(this.#banner(job));
    if (parent) inside.push(...this.#beforeAfter(job));
    else if (inspection) inside.push(this.#components(job, rechecks));
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
  #progress({ state }, waiting) {
    if (state.stage === "done") {
      const cloud = { waiting: "job.cloud_running", running: "job.cloud_running", failed: "job.cloud_failed" }[state.cloud];
      return cloud ? make("p", "job-quiet", [t(cloud)]) : null;
    }
    if (state.stage === "failed") {
      const more = make("button", "wide", [t("job.more_photos")]);
      more.addEventListener("click", () => this.events.onMore());
      return make("div", "job-progress failed", [make("p", "", [icon("error"), state.text || t("job.failed")]), ...original(state), more], { role: "alert" });
    }
    const total = state.total || 0, share = total ? Math.min(100, Math.round((100 * state.done) / total)) : null;
    const bar = make("progress", "", [], { max: "100", "aria-label": t("job.measuring") });
    if (share !== null) bar.value = share;
    const lines = waiting ? t("job.sending", { waiting }) : state.text || t("job.measuring");
    const placed = state.placed ? t("job.placed", { placed: state.placed, photos: state.photos }) : "";
    return make("div", "job-progress", [make("p", "", [icon("busy"), lines]), bar, make("p", "job-quiet", [placed])], { role: "status" });
  }

  #banner({ state, inspection, components: checked }) {
    // A check again is about its own components only.
    const components = inspection.components.filter((one) => !checked || checked.includes(one.name));
    const verdict = checked ? bySeverity(components)[0]?.verdict : inspection.verdict, sentence = checked ? "" : language === "en" ? inspection.sentence : t("job.sentence", { count: components.length });
    const isRough = Boolean(state.is_rough) || state.stage !== "done";
    const list = counts(components).map(([kind, count]) => make("span", `count ${kind}`, [icon(kind), `${count} ${verdictWord(kind)}`]));
    const words = [make("b", "", [isRough ? t("job.provisional") : verdictWord(verdict)])];
    return make("div", `job-banner ${isRough ? "rough" : verdict}`, [
      make("div", "what", [isRough ? icon("busy") : icon(verdict), ...words]),
      ...(isRough || sentence ? [make("p", "", [isRough ? t("job.rough") : sentence])] : []), make("div", "tally", list),
    ], { role: "status" });
  }

  #components(job, rechecks) {
    const decided = latestDecisions(job.decisions), again = new Map();
    for (const one of rechecks) for (const row of one.before_after ?? []) again.set(row.name, { ...row, stage: one.state.stage });
    const rows = bySeverity(job.inspection.components).map((one) => {
      const row = make("button", `component ${one.verdict}`, [
        icon(one.verdict), make("span", "name", [one.name]),
        make("span", "value", [one.value_text, ...(one.uncertainty_mm === null ? [] : [make("small", "", [`U ${rounded(one.uncertainty_mm, one.uncertainty_mm)}`])])]),
        make("span", "verdict", [verdictWord(one.verdict)]), ...remarks(one, decided.get(one.name), again.get(one.name)),
      ]);
      row.dataset.name = one.name;
      row.addEventListener("click", () => this.events.onComponent(one.name));
      return make("li", "", [row]);
    });
    return make("ul", "components", rows);
  }

  #beforeAfter(job) {
    const rows = (job.before_after ?? []).map((one) => make("div", `before-after ${one.verdict_after ?? "none"}`, [
      make("b", "", [one.name]),
      make("span", "was", [make("small", "", [t("job.before")]), mm(one.before_mm), make("small", one.verdict_before, [verdictWord(one.verdict_before)])]),
      make("span", "arrow", ["→"], { "aria-hidden": "true" }),
      make("span", "is", [make("small", "", [t("job.after")]), mm(one.after_mm), make("small", one.verdict_after ?? "", [icon(one.verdict_after ?? "busy"), verdictWord(one.verdict_after)])]),
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

/** A length as text; a dash where there is none. */
const mm = (value) => make("b", "", [value === null || value === undefined ? "–" : `${value.toFixed(2)} mm`]);

/** What was decided about a component, and what the check after rework found. */
function remarks(one, decision, again) {
  const found = [];
  if (again?.after_mm !== null && again?.after_mm !== undefined) {
    found.push(make("span", `note ${again.verdict_after}`, [icon(again.verdict_after), t("job.again", { before: again.before_mm?.toFixed(2) ?? "–", after: again.after_mm.toFixed(2), verdict: verdictWord(again.verdict_after) })]));
  }
  if (decision) {
    found.push(make("span", `note ${decision.is_ok ? "pass" : "fail"}`, [icon(decision.is_ok ? "pass" : "fail"), t(decision.is_ok ? "job.is_ok" : "job.is_not_ok", { by: decision.by }), decision.reason ? `: ${decision.reason}` : ""]));
  }
  return found;
}
