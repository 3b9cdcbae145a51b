// The inspection as a job on the page: start, guided capture, result, rework, check again, decisions, signature. What is
// confirmed is at the station; this page only remembers which job it is in.

import { confirmed } from "../confirm.js";
import { icon, make } from "../icons.js";
import { partsOf } from "../transport/api.js";
import { t } from "../texts/texts.js";
import * as api from "./api.js";
import { CaptureView } from "./capture.js";
import { ComponentView, person, signForm } from "./component.js";
import { UploadQueue } from "./queue.js";
import { ResultsView } from "./results.js";
import { StartView, numberOf } from "./start.js";
import "./texts.js";

const STALE_MS = 15_000; // without an answer for so long, what is shown is called old
const POLL_MS = 2000, BIND_MS = 1500, JOBS_MS = 5000;
const KEY = "arview-job", ENDING_KEY = "arview-job-ending";

/** Mount the job on the page; see main.js for the host. */
export const mountJob = (host) => new JobPage(host);

class JobPage {
  #view = "start"; // start, capture, results, component, sign
  #component = "";
  #revision = null;
  #boundMs = -Infinity;
  #refreshedMs = -Infinity;
  #isRefreshing = false;
  #heardMs = performance.now(); // when the station has answered last
  #rechecks = [];

  constructor(host) {
    this.host = host;
    this.job = null;
    this.jobs = null;
    this.section = document.getElementById("job");
    this.queue = new UploadQueue({
      onChange: () => this.#queueChanged(),
      onStored: (job) => { if (job === this.job?.id) this.#refresh(); },
      onRefused: (_, message) => host.toast.show(t("job.photo_refused", { why: message })),
    });
    const trouble = (text) => host.toast.show(text);
    this.capture = new CaptureView(hostOf(host, document.getElementById("job-layer")), this.queue, {
      onEnd: () => this.#end(), onTaken: () => this.#endWhenStored(), onLeave: () => this.#leave(), onTrouble: trouble,
      onJob: (job) => this.#take(job),
    });
    this.start = new StartView(host, { onStart: (part, serial) => this.#begin(part, serial), onOpen: (id) => this.#open(id) });
    this.results = new ResultsView({
      onComponent: (name) => this.#show("component", name), onMore: () => this.#reopen(), onSign: () => this.#show("sign"),
      onBack: () => this.#back(), onRecheck: (id) => this.#open(id), onCancel: () => this.#cancel(),
    });
    this.component = new ComponentView(this.queue, host, {
      onBack: () => this.#show("results"), onTrouble: trouble,
      onRecheck: (name) => this.#act(async () => this.#adopt(await api.recheckJob(this.job.id, [name]))),
      onTick: (component, step, isDone) => this.#act(() => api.tick(this.job.id, { component, step, is_done: isDone, by: person.get() })),
      onDecide: (decision) => this.#act(async () => {
        await api.decide(this.job.id, decision);
        host.toast.show(t("job.decided"));
        this.#show("results");
      }),
    });
    this.stale = make("p", "job-remark job-stale", [icon("offline"), make("span", "", [t("job.stale")])], { role: "alert" });
    this.stale.hidden = true;
    this.body = make("div", "job-body");
    this.section.append(make("h2", "", [t("job.title_section")]), this.stale, this.body);
    document.getElementById("actions").append(this.capture.element);
    host.on("part", (part) => this.#takePart(part));
    host.on("pose", (pose) => {
      this.start.takePose(pose);
      this.capture.takePose(pose);
    });
    host.on("status", (status) => this.#takeStatus(status));
    host.on("drawn", (pose) => this.capture.takeDrawn(pose));
    setInterval(() => this.#tick(), POLL_MS);
    this.#show("start");
    const kept = localStorage.getItem(KEY);
    if (kept) this.#open(kept, true);
  }

  // --- the job ------------------------------------------------------------------------------------------

  #begin(part, serial) {
    return this.#act(async () => this.#adopt(await api.openJob(part, serial)));
  }

  /** Open a job by its id; `isQuiet` when the page remembers it from before a reload. */
  async #open(id, isQuiet = false) {
    try {
      this.#adopt(await api.getJob(id), isQuiet);
    } catch (error) {
      if (error.status === 404) localStorage.removeItem(KEY);
      else if (isQuiet) setTimeout(() => { if (!this.job) this.#open(id, true); }, POLL_MS);
      if (!isQuiet) this.host.toast.show(error.message);
    }
  }

  #adopt(job, isQuiet = false) {
    this.job = job;
    this.#rechecks = [];
    this.#revision = null;
    this.#boundMs = -Infinity;
    localStorage.setItem(KEY, job.id);
    this.#show(job.state.stage === "collecting" && !this.#isEnding ? "capture" : "results", "", isQuiet);
    this.#bind();
    this.#refreshRechecks();
  }

  get #isEnding() {
    return localStorage.getItem(ENDING_KEY) === this.job?.id;
  }

  /** All photos are taken: when the station has confirmed them, the job ends. */
  #end() {
    localStorage.setItem(ENDING_KEY, this.job.id);
    this.#show("results");
    this.#endWhenStored();
  }

  async #endWhenStored() {
    const { job } = this;
    if (this.capture.isTaking) return; // the photo that is being taken belongs to the job: it ends with it
    if (!job || !this.#isEnding || this.queue.waiting(job.id) || this.isEndAsked) return;
    this.isEndAsked = true;
    try {
      const ended = await api.endJob(job.id);
      localStorage.removeItem(ENDING_KEY);
      if (this.job?.id === job.id) {
        this.job = ended;
        this.#draw();
      }
    } catch (error) {
      if (error.status >= 400 && error.status < 500) { // it cannot end as it is, for instance without photos
        localStorage.removeItem(ENDING_KEY);
        this.host.toast.show(error.message);
        this.#show("capture");
      }
    } finally {
      this.isEndAsked = false;
    }
  }

  /** End the measurement, after a question: photos can be taken and taken back again, and it can be measured anew. */
  async #cancel() {
    const isSure = await confirmed({ title: t("job.cancel_title"), text: t("job.cancel_text"), yes: t("job.cancel_sure"), no: t("job.cancel_not") });
    if (isSure) await this.#reopen();
  }

  /** Go on to take photos of a job that was ended. */
  #reopen() {
    localStorage.removeItem(ENDING_KEY);
    return this.#act(async () => {
      this.#take(this.job.is_ended || this.job.state.stage !== "collecting" ? await api.reopenJob(this.job.id) : this.job);
      this.#show("capture");
    });
  }

  /** Take over the job as the station has it now. */
  #take(job) {
    if (this.job?.id !== job.id) return;
    this.job = job;
    this.#draw();
  }

  #leave() {
    localStorage.removeItem(KEY);
    this.job = null;
    this.#show("start");
    this.#bind();
    this.#refreshJobs();
  }

  #back() {
    if (this.job?.parent) this.#open(this.job.parent);
    else this.#leave();
  }

  /** Do something at the station, say what went wrong, and show the job as it is then. */
  async #act(act) {
    try {
      await act();
    } catch (error) {
      if (error.code === undefined) console.error(error);
      this.host.toast.show(error.message);
    }
    return this.#refresh();
  }

  // --- news from the station ----------------------------------------------------------------------------

  #takePart(part) {
    if (part.part || part.parts) this.start.setPart(part);
    if (this.#view === "capture" && this.job) this.#draw();
  }

  #takeStatus(status) {
    this.#bind(status);
    const { job } = status;
    if (!job || job.id !== this.job?.id || job.revision === this.#revision) return;
    this.#revision = job.revision;
    this.#refresh();
  }

  /** Tell the station which job this page is in, and whether it takes photos of it. */
  #bind(status = this.host.connection.status) {
    const nowMs = performance.now(), wanted = this.job?.id ?? null, capture = this.#view === "capture" ? wanted : null;
    const { link } = this.host.connection;
    if (!link?.client || nowMs - this.#boundMs < BIND_MS) return;
    const key = `${link.client} ${wanted} ${capture}`;
    if (key === this.bound && (status?.job?.id ?? null) === wanted) return;
    this.bound = key;
    this.#boundMs = nowMs;
    this.host.connection.ask({ job: wanted, capture });
  }

  #tick() {
    const nowMs = performance.now();
    this.#bind();
    this.#endWhenStored();
    if (this.job && nowMs - this.#refreshedMs > POLL_MS - 100) this.#refresh();
    if (!this.job && this.#isShown() && nowMs - (this.jobsMs ?? -Infinity) > JOBS_MS) this.#refreshJobs();
    if (this.#view === "capture") this.capture.refresh();
  }

  async #refresh() {
    if (!this.job || this.#isRefreshing) return;
    this.#isRefreshing = true;
    const { id } = this.job;
    try {
      const job = await api.getJob(id);
      this.#hear();
      if (this.job?.id !== id) return;
      this.job = job;
      await this.#refreshRechecks();
    } catch (error) {
      if (error.code === undefined) throw error;
    } finally {
      this.#isRefreshing = false;
      this.#refreshedMs = performance.now();
      this.#draw();
    }
  }

  async #refreshRechecks() {
    const { job } = this, ids = job?.rechecks ?? [];
    if (!ids.length || this.#view === "capture") return;
    const known = new Map(this.#rechecks.map((one) => [one.id, one]));
    const found = await Promise.all(ids.map((id) => (known.get(id)?.state.stage === "done" ? known.get(id) : api.getJob(id).catch(() => null))));
    if (this.job?.id !== job.id) return;
    this.#rechecks = found.filter(Boolean);
    this.#draw();
  }

  async #refreshJobs() {
    this.jobsMs = performance.now();
    try {
      this.jobs = await api.listJobs();
      this.#hear();
    } catch (error) {
      if (error.code === undefined) throw error;
    }
    this.start.setJobs(this.jobs);
    this.#showStale();
  }

  #queueChanged() {
    if (this.#view === "capture") this.capture.refresh();
    else this.#draw();
    this.#endWhenStored();
  }

  // --- what is shown -------------------------------------------------------------------------------------

  #isShown() {
    return this.section.offsetParent !== null;
  }

  #show(view, component = "", isQuiet = false) {
    this.#view = view;
    this.#component = component;
    document.body.dataset.job = view;
    const elements = { start: this.start.element, results: this.results.element, component: this.component.element };
    if (view === "sign") elements.sign = signForm(this.job, { onBack: () => this.#show("results"), onTrouble: (text) => this.host.toast.show(text), onSign: (by, note) => this.#sign(by, note) });
    this.body.replaceChildren(...(elements[view] ? [elements[view]] : []));
    this.section.parentElement.scrollTop = 0;
    if (view === "capture") this.host.openSide("");
    else {
      this.capture.close();
      if (!isQuiet && view !== "start" && document.body.dataset.side !== "job") this.host.openSide("job");
    }
    if (view === "start" && !this.jobs) this.#refreshJobs();
    this.host.isolate(view === "component" ? component : null, this.job ? this.#part : 0);
    this.#boundMs = -Infinity;
    this.#bind();
    this.#draw();
    this.host.stage.measure();
  }

  #sign(by, note) {
    return this.#act(async () => {
      await api.sign(this.job.id, by, note);
      this.host.toast.show(t("job.signed_now"));
      this.#show("results");
    });
  }

  get #part() {
    return this.host.state.part ? numberOf(this.job, this.host.state.part) : 0;
  }

  #hear() {
    this.#heardMs = performance.now();
    this.#showStale();
  }

  #showStale() {
    this.stale.hidden = performance.now() - this.#heardMs < STALE_MS;
  }

  #draw() {
    const { job } = this;
    this.#showStale();
    if (!job) return;
    const { part } = this.host.state;
    if (this.#view === "capture" && (part?.part || part?.parts)) {
      if (job.state.stage === "done") return this.#show("results"); // another phone has ended it
      this.capture.open(job, this.#part, partsOf(part)[this.#part]);
    } else if (this.#view === "results") {
      this.results.show(job, { rechecks: this.#rechecks, waiting: this.queue.waiting(job.id), parent: job.parent });
    } else if (this.#view === "component") {
      this.component.show(job, this.#component);
    }
  }
}

/** The parts of the host that the capture needs; getters stay live. */
function hostOf(host, layer) {
  return {
    get state() { return host.state; }, get camera() { return host.camera; }, get connection() { return host.connection; },
    get stage() { return host.stage; }, layer,
  };
}
