// Guided capture: the dome and the ring, what is lacking, and the photos themselves, which are taken at the right moment.

import { icon, make } from "../icons.js";
import { t } from "../texts/texts.js";
import { getCells, takeAtStation } from "./api.js";
import { Dome } from "./dome.js";
import { Motion } from "./motion.js";
import { Needs } from "./needs.js";
import { asJpeg, takePhoto } from "./photo.js";
import { allowSound, signal } from "./signals.js";
import { Taken } from "./taken.js";

const RETRY_MS = 3000; // a photo that could not be taken is asked for again after this time
const CELLS_EVERY_MS = 1500;
const SILENT_MS = 1500; // without advice for so long, the page says that the part is not tracked

export class CaptureView {
  #lastTake = null;
  #isBusy = false;
  #advice = null;
  #adviceMs = -Infinity;
  #pose = null;
  #wasEnough = false;
  #cellsMs = -Infinity;

  /**
   * @param host of the page. @param queue of the uploads.
   * @param events {onEnd(): all photos are taken, onLeave(), onTrouble(text), onJob(job): it has changed}
   */
  constructor(host, queue, events) {
    Object.assign(this, { host, queue, events });
    this.job = null;
    this.dome = new Dome();
    this.motion = new Motion((rate) => host.connection.link?.tell({ type: "motion", gyro_rad_s: rate }));
    this.#build();
    this.hasCells = false;
    this.needs = new Needs(host.layer, (part, point) => host.stage.toScreen(part, point));
  }

  #build() {
    const button = (classes, sign, key, act) => {
      const made = make("button", classes, [make("span", "sign", [icon(sign)]), make("span", "", [t(key)])]);
      made.addEventListener("click", () => {
        allowSound();
        act();
      });
      return made;
    };
    this.text = make("strong", "hud-text", [], { "aria-live": "polite" });
    this.reason = make("span", "hud-reason");
    this.first = make("div", "hud-first", [], { "aria-live": "polite" });
    this.taken = new Taken(this.queue, { onTrouble: (text) => this.events.onTrouble(text), onChange: (job) => (job ? this.events.onJob(job) : this.refresh()) });
    this.bar = make("i");
    this.meter = make("div", "hud-meter", [this.bar], { role: "progressbar", "aria-valuemin": "0", "aria-valuemax": "100", "aria-label": t("job.progress") });
    this.count = make("b", "hud-count");
    this.state = make("span", "hud-state", [], { "aria-live": "polite" });
    this.shutter = make("button", "shutter", [make("span")], { "aria-label": t("job.shutter"), title: t("job.shutter") });
    this.shutter.addEventListener("click", () => {
      allowSound();
      this.take();
    });
    this.done = button("hud-done", "tracked", "job.done", () => this.events.onEnd());
    this.leave = button("hud-leave", "close", "job.leave", () => this.events.onLeave());
    this.files = make("input", "", [], { type: "file", accept: "image/jpeg,image/png", capture: "environment", multiple: "", hidden: "", "aria-label": t("job.file") });
    this.files.addEventListener("change", () => this.#addFiles());
    this.pick = button("hud-pick", "camera", "job.file", () => this.files.click());
    this.element = make("div", "", [
      make("div", "hud-words", [this.text, this.reason, this.meter, this.first]),
      this.dome.element,
      this.shutter,
      make("div", "hud-figures", [this.count, this.state]),
      this.taken.element,
      make("div", "hud-buttons", [this.leave, this.pick, this.done]),
      this.files,
    ], { id: "job-hud", role: "region", "aria-label": t("job.capture") });
    this.element.hidden = true;
  }

  get isOpen() {
    return this.job !== null;
  }

  get #isPhone() {
    return this.host.state.part?.source !== "station";
  }

  /** Begin, or go on, to take photos of a job; `part` is the number of its part, `components` its components. */
  open(job, part, document) {
    if (this.job?.id === job.id) return this.refresh(job);
    Object.assign(this, { job, part });
    this.#lastTake = this.#advice = null;
    this.#wasEnough = false;
    this.hasCells = false;
    this.#cellsMs = -Infinity;
    this.needs.setComponents(document.components, part);
    this.element.hidden = false;
    this.motion.start();
    this.center = document.part.center_in_model;
    this.refresh(job);
  }

  /** Get the cells of the dome, again until the station has made them. */
  async #getCells() {
    const { job } = this, nowMs = performance.now();
    if (nowMs - this.#cellsMs < CELLS_EVERY_MS) return;
    this.#cellsMs = nowMs;
    const cells = await getCells(job.id).catch(() => null);
    if (this.job?.id !== job.id || !cells?.cells) return;
    this.hasCells = true;
    this.dome.setGeometry(cells, this.center);
    this.#draw();
  }

  close() {
    this.job = null;
    this.motion.stop();
    this.element.hidden = true;
    this.needs.clear();
  }

  /** Take over the advice of a pose, and take the photo that it asks for. */
  takePose(pose) {
    if (!this.job) return;
    this.#pose = pose;
    const { capture } = pose;
    if (!capture || capture.job !== this.job.id) return;
    this.#advice = { ...this.#advice, ...capture };
    this.#adviceMs = performance.now();
    if (capture.components) this.needs.set(capture.components);
    if (capture.takes && capture.take_id !== this.#lastTake && !this.#isBusy) {
      this.#lastTake = capture.take_id;
      this.take(pose);
    }
    if (capture.is_enough && !this.#wasEnough) signal("enough");
    this.#wasEnough = capture.is_enough;
    this.#draw();
  }

  /** Put the signs on the components of the pose that is drawn. */
  takeDrawn(pose) {
    if (this.job) this.needs.place(Boolean(pose));
  }

  /** Show the job as the station has it, and the state of the uploads. */
  refresh(job = this.job) {
    if (!job) return;
    this.job = job;
    if (!this.hasCells) this.#getCells();
    this.#draw();
  }

  /** Whether a photo is being taken that is not yet among those that wait for the station. */
  get isTaking() {
    return this.#isBusy;
  }

  /** Take a photo now, by itself or by a press. */
  async take(pose = this.#pose) {
    if (this.#isBusy || !this.job) return;
    const { job } = this;
    this.#isBusy = true;
    this.element.classList.add("is-taking");
    try {
      if (this.#isPhone) {
        const taken = new Date().toISOString(), hint = this.#hint(pose);
        const photo = await takePhoto(this.host.camera.track, this.host.camera.video);
        signal("taken");
        this.taken.keep(photo.blob, await this.queue.add(job.id, photo.blob, { source: photo.source, taken, hint }));
      } else {
        await takeAtStation(job.id, this.host.connection.link?.client ?? "");
        signal("taken");
      }
    } catch (error) {
      signal("failed");
      this.events.onTrouble(t("job.no_photo", { why: error.code ? error.message : t("job.no_camera") }));
      setTimeout(() => { this.#lastTake = null; }, RETRY_MS);
    } finally {
      this.#isBusy = false;
      this.element.classList.remove("is-taking");
      this.#draw();
      this.events.onTaken();
    }
  }

  /** Where the part was tracked when the photo was taken, in the stream's picture; null where it was not. */
  #hint(pose) {
    const part = pose?.parts?.[this.part] ?? pose;
    if (!part?.cam_from_model) return null;
    return { cam_from_model: [...part.cam_from_model], camera: pose.camera, quality: part.quality };
  }

  async #addFiles() {
    const { job } = this;
    for (const file of this.files.files) {
      const jpeg = await asJpeg(file).catch(() => null);
      if (jpeg) this.taken.keep(jpeg, await this.queue.add(job.id, jpeg, { source: "upload", taken: new Date(file.lastModified || Date.now()).toISOString(), hint: null }));
      else this.events.onTrouble(t("job.not_jpeg", { name: file.name }));
    }
    this.files.value = "";
  }

  #draw() {
    if (!this.job) return;
    const { job, queue } = this, isFresh = performance.now() - this.#adviceMs < SILENT_MS, advice = this.#advice;
    const isTracked = isFresh && Boolean(this.#pose?.isPosed);
    const put = (element, text) => { if (element.textContent !== text) element.textContent = text; };
    const waiting = queue.waiting(job.id), stored = job.photos?.length ?? 0, isEnough = Boolean(advice?.is_enough);
    put(this.text, advice ? advice.text : t("job.point_at_part"));
    put(this.reason, !isFresh ? t("job.not_tracked") : advice?.takes ? t("job.hold_still") : advice?.reason ?? "");
    const share = Math.round(100 * (advice?.progress ?? 0));
    this.bar.style.width = `${share}%`;
    this.meter.setAttribute("aria-valuenow", String(share));
    put(this.count, t(stored + waiting === 1 ? "job.photos_one" : "job.photos_count", { photos: stored + waiting }));
    this.taken.show(job);
    put(this.state, this.#stateText(waiting, stored));
    this.state.classList.toggle("bad", Boolean(queue.trouble) || queue.refused(job.id).length > 0);
    this.element.classList.toggle("is-enough", isEnough);
    this.#drawFirst(job.inspection);
    this.done.disabled = stored + waiting === 0;
    this.pick.hidden = !this.#isPhone;
    this.shutter.hidden = this.#isPhone && !this.host.camera.isOn;
    if (advice) this.dome.update(advice.cells, isTracked ? (this.#pose.parts?.[this.part] ?? this.#pose).cam_from_model : null);
  }

  /** How many components have a first number; none is a verdict yet. */
  #drawFirst(inspection) {
    const all = inspection?.components ?? [], count = all.filter((one) => one.distance_mm !== null).length;
    const text = count ? t("job.first_numbers", { count, all: all.length }) : "";
    if (this.first.textContent !== text) this.first.textContent = text;
  }

  #stateText(waiting, stored) {
    const { queue, job } = this, refused = queue.refused(job.id).length;
    if (refused) return t("job.refused", { refused });
    if (queue.trouble === "disk_full") return t("job.disk_full", { waiting });
    if (queue.trouble) return t("job.offline", { waiting });
    if (waiting) return t(queue.isDurable ? "job.to_send" : "job.to_send_in_memory", { waiting });
    return stored ? t("job.all_stored") : "";
  }
}
