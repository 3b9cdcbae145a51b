// One component of a result: how to put it right, with drawing and steps; the check again; the decision.

import { icon, make } from "../icons.js";
import { exact, rounded } from "../rounding.js";
import { hasText, t } from "../texts/texts.js";
import { fileOf } from "./api.js";
import { Drawing } from "./drawing.js";
import { DecisionPhoto, titleOf } from "./decision_photo.js";
import { isOpen, latestDecisions } from "./results.js";
import { verdictWord } from "./verdicts.js";

const MIN_TURN_DEG = 0.1; // smaller turns are not told
const REASONS = ["job.reason.reworked", "job.reason.accepted", "job.reason.no_function", "job.reason.scrap", "job.reason.other"];

/** Name of the person, remembered on this device. */
export const person = {
  get: () => localStorage.getItem("arview-person") ?? "",
  set: (name) => localStorage.setItem("arview-person", name),
};

/** The name of the person, or of who worked on this job last; empty where nobody has. */
const nameFor = (job) => person.get() || ((job.decisions ?? []).findLast((one) => one.by)?.by ?? "");

/** A field for the name of the person who decides. */
export function personField(id, name = person.get()) {
  const input = make("input", "", [], { id, type: "text", autocomplete: "name", maxlength: "80", required: "" });
  input.value = name;
  return { input, field: make("label", "job-field", [make("span", "", [t("job.by")]), input], { for: id }) };
}

export class ComponentView {
  #keys = {};

  /**
   * @param queue of the uploads. @param host of the page: camera, connection, state.
   * @param events {onBack(), onRecheck(name), onTick(name, step, isDone), onDecide(decision), onTrouble(text)}
   */
  constructor(queue, host, events) {
    Object.assign(this, { queue, host, events });
    this.result = make("div");
    this.decision = make("div");
    this.element = make("div", "job-view", [this.result, this.decision]);
  }

  /** Show a component; what is being typed stays. */
  show(job, name) {
    const component = job.inspection?.components.find((one) => one.name === name);
    if (!component) return this.events.onBack();
    const instruction = (job.rework ?? []).find((one) => one.component === name) ?? null;
    const decision = latestDecisions(job.decisions).get(name) ?? null;
    const ticks = stepsDone(job.decisions, name);
    const isDone = job.state.stage === "done";
    this.#update("decision", [job.id, name, decision, isDone], () => (isDone ? this.#decision(job, name, decision) : []));
    this.#update("result", [job.id, name, component, instruction, [...ticks], isDone, isOpen(job)], () => this.#result(job, component, instruction, ticks));
  }

  /** Make one half of the view again if what it shows has changed: what is typed in the other half stays. */
  #update(half, about, content) {
    const key = JSON.stringify(about);
    if (key === this.#keys[half]) return;
    this.#keys[half] = key;
    this[half].replaceChildren(...content());
  }

  #result(job, component, instruction, ticks) {
    const { name } = component, isRough = isOpen(job);
    const back = make("button", "job-back", [icon("back"), t("job.back_to_result")]);
    back.addEventListener("click", () => this.events.onBack());
    return [
      make("div", "job-head", [back, make("h3", "", [name])]),
      make("div", `job-banner ${isRough ? "rough" : component.verdict}`, [
        make("div", "what", [icon(isRough ? "busy" : component.verdict), make("b", "", [isRough ? t("job.provisional") : verdictWord(component.verdict)]), make("b", "big", [component.value_text])]),
        make("p", "numbers-of", numbersOf(component).map((text) => make("span", "", [text]))),
      ]),
      ...(instruction ? this.#rework(job, name, instruction, ticks) : []),
    ];
  }

  #rework(job, name, { moves = [], turn, text = "", place = "", steps = [], remark, pictures = [], how }, ticks) {
    const title = make("h3", "", [t("job.rework"), ...(how ? [make("small", "", [hasText(`job.how.${how}`) ? t(`job.how.${how}`) : how])] : [])]);
    // Each instruction once: the moves are said in the steps; only where they are not, they stand by themselves.
    const told = [...moves, ...(turn ? [typeof turn === "string" ? { text: turn } : turn] : [])].map((one) => one.text);
    const isMove = (step) => told.some((one) => step.toLowerCase().includes(one.toLowerCase()));
    const list = steps.some(isMove) ? [] : told.map((one) => make("li", "move", [icon("displaced"), make("b", "", [one])]));
    const drawing = new Drawing(job.id, name);
    const who = personField("job-tick-by", nameFor(job));
    who.input.addEventListener("change", () => { if (who.input.value.trim()) person.set(who.input.value.trim()); });
    const boxes = steps.map((text, step) => {
      const box = make("input", "", [], { type: "checkbox", id: `job-step-${step}` });
      box.checked = ticks.has(step);
      box.addEventListener("change", () => {
        if (who.input.value.trim()) person.set(who.input.value.trim());
        if (who.input.value.trim()) return this.events.onTick(name, step, box.checked);
        box.checked = !box.checked;
        this.events.onTrouble(t("job.name_needed"));
        who.input.focus();
      });
      return make("li", "", [make("label", "", [box, make("span", `${isMove(text) ? "move" : ""} ${isLower(text, name) ? "first-up" : ""}`, [text])], { for: `job-step-${step}` })]);
    });
    const more = pictures.map((picture) => make("img", "job-drawing", [], { src: fileOf(job.id, `rework/${picture}`), alt: "" }));
    const again = make("button", "wide primary", [icon("camera"), t("job.check_again")]);
    again.addEventListener("click", () => this.events.onRecheck(name));
    return [
      title, ...[text, steps.some((one) => place && one.includes(place)) ? "" : place].filter(Boolean).map((one) => make("p", "first-up", [one])),
      ...(list.length ? [make("ul", "job-moves", list)] : []), ...(remark ? [make("p", "job-remark", [icon("warning"), remark])] : []),
      ...(boxes.length ? [make("ol", "job-steps", boxes), who.field] : []), drawing.element, ...more, ...(job.state.stage === "done" ? [again] : []),
    ];
  }

  #decision(job, name, decision) {
    const title = make("h3", "", [t("job.decision")]);
    if (decision) {
      const change = make("button", "wide", [t("job.decide_again")]);
      const shown = make("div", "", [
        make("p", `job-decided ${decision.is_ok ? "pass" : "fail"}`, [icon(decision.is_ok ? "pass" : "fail"), make("b", "", [t(decision.is_ok ? "job.is_ok" : "job.is_not_ok", { by: decision.by })])]),
        make("p", "", [[decision.reason, decision.note].filter(Boolean).join(". ")]),
        ...(decision.photo ? [make("img", "job-drawing", [], { src: fileOf(job.id, `photos/${decision.photo}`), alt: t("job.photo", { name: titleOf(decision.photo) }) })] : []),
        change,
      ]);
      change.addEventListener("click", () => shown.replaceWith(this.#form(job, name)));
      return [title, shown];
    }
    return [title, this.#form(job, name)];
  }

  #form(job, name) {
    const choice = (value, key, sign) => {
      const input = make("input", "", [], { type: "radio", name: "job-ok", value, id: `job-ok-${value}`, required: "" });
      return make("label", `job-choice ${sign}`, [input, icon(sign), make("b", "", [t(key)])], { for: `job-ok-${value}` });
    };
    const reason = make("input", "", [], { id: "job-reason", type: "text", list: "job-reasons", maxlength: "200" });
    const reasons = make("datalist", "", REASONS.map((key) => make("option", "", [], { value: t(key) })), { id: "job-reasons" });
    const note = make("textarea", "", [], { id: "job-note", rows: "2", maxlength: "2000" });
    const { input: by, field } = personField("job-by", nameFor(job));
    this.photo?.close();
    const photo = (this.photo = new DecisionPhoto(job, this.queue, this.host, this.events.onTrouble));
    const save = make("button", "wide primary", [t("job.save_decision")], { type: "submit" });
    const form = make("form", "job-form", [
      make("div", "job-choices", [choice("yes", "job.ok", "pass"), choice("no", "job.not_ok", "fail")], { role: "radiogroup", "aria-label": t("job.decision") }),
      make("label", "job-field", [make("span", "", [t("job.reason")]), reason], { for: "job-reason" }), reasons,
      make("label", "job-field", [make("span", "", [t("job.note")]), note], { for: "job-note" }),
      photo.element, field, save,
    ]);
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const chosen = form.querySelector("input[name=job-ok]:checked");
      if (!chosen) return this.events.onTrouble(t("job.choose"));
      if (!by.value.trim()) return this.events.onTrouble(t("job.name_needed"));
      person.set(by.value.trim());
      const said = { component: name, is_ok: chosen.value === "yes", reason: reason.value.trim(), note: note.value.trim(), by: by.value.trim() };
      save.disabled = true;
      try {
        await this.events.onDecide({ ...said, photo: await photo.name() });
      } catch (error) {
        this.events.onTrouble(t("job.photo_refused", { why: error.message }));
      } finally {
        save.disabled = false;
      }
    });
    return form;
  }
}

/** What was measured of a component, each number with its name: tolerance, displacement by axes, turns, U. */
function numbersOf({ tolerance_mm: tolerance, displacement_mm: moved, tilt_deg: tilt, twist_deg: twist, uncertainty_mm: u, detail_text: text }) {
  if (!moved) return text ? [text] : [];
  const signed = (value) => `${value < 0 ? "−" : "+"}${rounded(Math.abs(value), u ?? 0)}`;
  return [
    ...(tolerance ? [t("card.tolerance", { tolerance: exact(tolerance) })] : []), ...(u === null ? [] : [t("card.u", { u: rounded(u, u) })]),
    ...moved.map((value, k) => `d${"xyz"[k]}\u00a0${value === null ? "?" : signed(value)}`),
    ...(Math.abs(tilt ?? 0) >= MIN_TURN_DEG ? [t("card.tilt", { angle: exact(Number(tilt.toFixed(1))) })] : []),
    ...(Math.abs(twist ?? 0) >= MIN_TURN_DEG ? [t("card.twist", { angle: exact(Number(twist.toFixed(1))) })] : []),
  ];
}

/** Whether a sentence begins with a small letter that is not that of a name. */
const isLower = (text, name) => /^\p{Ll}/u.test(text) && !text.startsWith(name);

/** Steps of a component that are ticked: the newest tick of each step counts. */
function stepsDone(entries, name) {
  const done = new Set();
  for (const one of entries ?? []) {
    if (one.component !== name || typeof one.is_done !== "boolean" || !Number.isInteger(one.step)) continue;
    if (one.is_done) done.add(one.step);
    else done.delete(one.step);
  }
  return done;
}

/** The form in which a person signs the whole result. */
export function signForm(job, { onSign, onBack, onTrouble }) {
  const failing = (job.inspection?.components ?? []).filter((one) => ["fail", "undecided", "not_measured"].includes(one.verdict));
  const decided = latestDecisions(job.decisions), open = failing.filter((one) => !decided.has(one.name));
  const { input: by, field } = personField("job-sign-by", nameFor(job));
  const note = make("textarea", "", [], { id: "job-sign-note", rows: "2", maxlength: "2000" });
  const back = make("button", "job-back", [icon("back"), t("job.back_to_result")], { type: "button" });
  back.addEventListener("click", onBack);
  const form = make("form", "job-form job-view", [
    make("div", "job-head", [back, make("h3", "", [t("job.sign")])]),
    make("p", "", [t("job.sign_what", { part: job.part_name, serial: job.serial, verdict: verdictWord(job.inspection?.verdict) })]),
    ...(open.length ? [make("p", "job-remark", [icon("warning"), t("job.undecided", { names: open.map((one) => one.name).join(", ") })])] : []),
    field, make("label", "job-field", [make("span", "", [t("job.note")]), note], { for: "job-sign-note" }),
    make("button", "wide primary", [icon("pen"), t("job.sign_now")], { type: "submit" }),
  ]);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (!by.value.trim()) return onTrouble(t("job.name_needed"));
    person.set(by.value.trim());
    onSign(by.value.trim(), note.value.trim());
  });
  return form;
}
