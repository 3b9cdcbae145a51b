// The photo of a decision: one of the job, one that is taken now from the live picture, or a file.

import { icon, make } from "../icons.js";
import { t } from "../texts/texts.js";
import { fileOf, takeAtStation } from "./api.js";
import { asJpeg, takePhoto } from "./photo.js";

export class DecisionPhoto {
  #taken = null; // promise of the name of the photo that was taken, once the station has confirmed it
  #address = "";

  /**
   * @param job its document. @param queue of the uploads. @param host of the page: camera, connection, state.
   * @param onTrouble called with a text when no photo could be taken.
   */
  constructor(job, queue, host, onTrouble) {
    Object.assign(this, { job, queue, host, onTrouble });
    const names = [...(job.photos ?? []), ...(job.attachments ?? [])];
    this.select = make("select", "", [make("option", "", [t("job.no_photo_chosen")], { value: "" }), ...names.map((one) => make("option", "", [titleOf(one)], { value: one }))], { id: "job-photo" });
    this.select.addEventListener("change", () => this.#choose());
    this.preview = make("img", "job-drawing", [], { alt: t("job.photo_of"), hidden: "" });
    this.state = make("p", "job-quiet", [], { role: "status", "aria-live": "polite" });
    this.file = make("input", "", [], { type: "file", accept: "image/jpeg,image/png", capture: "environment", hidden: "", "aria-label": t("job.photo_file") });
    this.file.addEventListener("change", () => this.#act(async () => this.#send(await asJpeg(this.file.files[0]), "upload")));
    const live = make("button", "wide job-photo-live", [icon("camera"), t("job.photo_take")], { type: "button" });
    live.addEventListener("click", () => this.#act(() => this.#take()));
    const file = make("button", "wide", [t("job.photo_file")], { type: "button" });
    file.addEventListener("click", () => this.file.click());
    this.buttons = [live, file];
    this.element = make("div", "job-photo", [
      make("label", "job-field", [make("span", "", [t("job.photo_of")]), this.select], { for: "job-photo" }),
      make("div", "job-ends", this.buttons), this.file, this.state, this.preview,
    ]);
  }

  /** Name of the photo, or null without one; of one that was taken when the station has confirmed it. Throws if it refuses. */
  async name() {
    return this.#taken ? this.#taken : this.select.value || null;
  }

  /** Forget what is only on this page. */
  close() {
    if (this.#address) URL.revokeObjectURL(this.#address);
    this.#address = "";
  }

  async #act(act) {
    for (const one of this.buttons) one.disabled = true;
    try {
      await act();
    } catch (error) {
      this.onTrouble(t("job.no_photo", { why: error.code ? error.message : t("job.no_camera") }));
    } finally {
      for (const one of this.buttons) one.disabled = false;
      this.file.value = "";
    }
  }

  async #take() {
    const { host, job } = this;
    if (host.state.part?.source === "station") {
      const { photo } = await takeAtStation(job.id, host.connection.link?.client ?? "", "decide");
      return this.#settle(Promise.resolve(photo));
    }
    const { blob, source } = await takePhoto(host.camera.track, host.camera.video);
    return this.#send(blob, source);
  }

  /** Give a photo to the queue, which sends it until the station has confirmed it. */
  async #send(blob, source) {
    const taken = new Date().toISOString();
    const { stored } = await this.queue.add(this.job.id, blob, { source, taken, hint: null, purpose: "decide" });
    this.close();
    this.#address = this.preview.src = URL.createObjectURL(blob);
    this.preview.hidden = false;
    this.#settle(stored);
  }

  #settle(stored) {
    this.select.value = "";
    this.#taken = stored;
    this.state.textContent = t("job.photo_sending");
    stored.then((name) => {
      if (this.#taken !== stored) return;
      this.state.textContent = t("job.photo_stored");
      if (!this.#address) {
        this.preview.src = fileOf(this.job.id, `photos/${name}`);
        this.preview.hidden = false;
      }
    }, (error) => {
      if (this.#taken !== stored) return;
      this.#taken = null;
      this.preview.hidden = true;
      this.state.textContent = t("job.photo_refused", { why: error.message });
    });
  }

  #choose() {
    this.#taken = null;
    this.close();
    this.state.textContent = "";
    this.preview.hidden = !this.select.value;
    if (this.select.value) this.preview.src = fileOf(this.job.id, `photos/${this.select.value}`);
  }
}

/** The name of a photo for people: of one that was taken for a decision the beginning of its hash. */
export function titleOf(name) {
  const hash = name.match(/^decisions\/([0-9a-f]{8})/)?.[1];
  return hash ? t("job.photo_taken", { hash }) : name;
}
