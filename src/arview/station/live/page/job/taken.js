// The photos taken so far as small pictures, the newest first; each can be looked at and taken back.

import { choice } from "../confirm.js";
import { icon, make } from "../icons.js";
import { t } from "../texts/texts.js";
import { fileOf, takeBack } from "./api.js";

const THUMB_PX = 160; // longer side of a small picture

export class Taken {
  #key = "";
  #thumbs = new Map(); // addresses of small pictures, by hash of a photo on its way and by name of a stored one

  /** @param queue of the uploads. @param events {onChange(job | null), onTrouble(text)}: job as the station has it afterwards. */
  constructor(queue, events) {
    Object.assign(this, { queue, events });
    this.undo = make("button", "undo", [icon("undo"), make("span", "", [t("job.undo")])], { type: "button", title: t("job.undo_what") });
    this.undo.addEventListener("click", () => this.photos.length && this.#ask(this.photos[0]));
    this.list = make("div", "thumbs");
    this.element = make("div", "hud-taken", [this.undo, this.list], { role: "group", "aria-label": t("job.taken") });
    this.photos = [];
  }

  /** Keep a small picture of a photo that waits, until the station has given it a name. */
  async keep(blob, { sha256, stored }) {
    const address = await small(blob).catch(() => "");
    if (!address) return;
    this.#thumbs.set(sha256, address);
    this.#key = "";
    this.events.onChange(null);
    stored.then((name) => {
      this.#thumbs.set(`${this.job.id}/${name}`, address);
      this.#thumbs.delete(sha256);
    }, () => {});
  }

  /** Show the photos of a job: those at the station, then those on their way. */
  show(job) {
    this.job = job;
    const stored = (job.photos ?? []).map((name) => ({ name }));
    const waiting = this.queue.entries(job.id).map((entry) => ({ entry }));
    this.photos = [...stored, ...waiting].map((one, index) => ({ ...one, number: index + 1 })).reverse();
    const key = JSON.stringify(this.photos.map(({ name, entry }) => [name, entry?.sha256])) + this.#thumbs.size;
    if (key === this.#key) return;
    this.#key = key;
    this.undo.disabled = !this.photos.length;
    this.element.hidden = !this.photos.length;
    this.list.replaceChildren(...this.photos.map((one) => this.#thumb(one)));
  }

  #address({ name, entry }) {
    return this.#thumbs.get(entry ? entry.sha256 : `${this.job.id}/${name}`) ?? (name ? fileOf(this.job.id, `photos/${name}`) : "");
  }

  #thumb(photo) {
    const address = this.#address(photo), { number } = photo;
    const inside = address ? make("img", "", [], { src: address, alt: "", loading: "lazy" }) : icon("camera");
    const button = make("button", "thumb", [inside, make("b", "", [String(number)])], { type: "button", "aria-label": t("job.photo_number", { number }) });
    button.addEventListener("click", () => this.#ask(photo));
    return button;
  }

  /** Show a photo and ask whether it is to be taken back. */
  async #ask(photo) {
    const { number, name, entry } = photo, { job } = this;
    const picture = name ? fileOf(job.id, `photos/${name}`) : URL.createObjectURL(new Blob([entry.content], { type: entry.mediaType }));
    const why = await choice({ title: t("job.photo_number", { number }), picture }, [
      { text: t("job.was_blurred"), value: "blurred" }, { text: t("job.take_back"), value: "unwanted", classes: "danger" }, { text: t("job.keep"), value: "" },
    ]);
    if (entry) URL.revokeObjectURL(picture);
    if (!why) return;
    try {
      const left = name ? await takeBack(job.id, name, why) : await this.queue.drop(entry, why);
      this.events.onTrouble(t(why === "blurred" ? "job.taken_back_blurred" : "job.taken_back", { number }));
      this.events.onChange(left ?? null);
    } catch (error) {
      if (error.code === undefined) throw error;
      this.events.onTrouble(t("job.not_taken_back", { number, why: error.message }));
    }
  }
}

/** Address of a small picture of a photo. */
async function small(blob) {
  const whole = await createImageBitmap(blob), scale = Math.min(1, THUMB_PX / Math.max(whole.width, whole.height));
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [Math.round(whole.width * scale), Math.round(whole.height * scale)];
  canvas.getContext("2d").drawImage(whole, 0, 0, canvas.width, canvas.height);
  whole.close();
  return canvas.toDataURL("image/jpeg", 0.7);
}
