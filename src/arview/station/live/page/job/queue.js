// The queue of photos on their way to the station: in order, in pieces, again after every failure, until the station has
// confirmed each one.

import { beginUpload, getOffset, sendPiece, takeBack } from "./api.js";
import { sha256 } from "./hash.js";
import { openStore } from "./store.js";

const PIECE_BYTES = 256 * 1024; // a piece must arrive within the time limit of a request, also in a slow network
const FIRST_PAUSE_MS = 1000, LONGEST_PAUSE_MS = 20_000, DISK_PAUSE_MS = 15_000, MAX_BAD_HASHES = 3;

export class UploadQueue {
  #entries = []; // {key, job, content, sha256, source, taken, hint, purpose, mediaType, upload, refused}
  #awaited = new Map(); // by key: what waits for the answer of the station
  #isRunning = false;
  #wake = () => {};
  sent = 0; // bytes of the photo that is being sent
  trouble = ""; // why nothing arrives: "offline", "disk_full", or empty

  /** @param events {onChange(), onStored(job, name), onRefused(entry, message)} */
  constructor(events) {
    this.events = events;
    this.isReady = this.#open();
    addEventListener("online", () => this.#wake());
  }

  get isDurable() {
    return this.store?.isDurable ?? true;
  }

  /** Photos of a job that are to be measured and that the station has not confirmed yet. */
  waiting(job) {
    return this.entries(job).length;
  }

  /** Photos of a job on their way, oldest first. */
  entries(job) {
    return this.#entries.filter((one) => one.job === job && one.purpose !== "decide" && !one.refused);
  }

  /** Photos of a job that the station will not take, with why. */
  refused(job) {
    return this.#entries.filter((one) => one.job === job && one.purpose !== "decide" && one.refused);
  }

  /**
   * Add a photo; resolves when it is kept on this device.
   * @param purpose "measure", or "decide" for one that shows a decision.
   * @returns {stored, sha256}: promise of its name, once the station has confirmed it; and its hash.
   */
  async add(job, blob, { source, taken, hint, purpose = "measure" }) {
    await this.isReady;
    const content = await blob.arrayBuffer();
    const entry = { job, content, sha256: await sha256(content), source, taken, hint, purpose, mediaType: blob.type || "image/jpeg", upload: null, refused: "" };
    entry.key = await this.store.add(entry);
    this.#entries.push(entry);
    const stored = new Promise((resolve, reject) => this.#awaited.set(entry.key, { resolve, reject }));
    stored.catch(() => {}); // a refusal is told by onRefused as well
    this.events.onChange();
    this.#run();
    return { stored, sha256: entry.sha256 };
  }

  /** Forget a photo that is on its way; it is taken back if it arrives all the same. */
  async drop(entry, why) {
    entry.dropped = why;
    await this.#remove(entry);
  }

  /** Try at once. */
  retry() {
    this.#wake();
    this.#run();
  }

  async #open() {
    this.store = await openStore();
    const kept = await this.store.all();
    this.#entries = kept;
    if (kept.length) this.events.onChange();
    this.#run();
  }

  async #remove(entry) {
    this.#entries = this.#entries.filter((one) => one !== entry);
    await this.store.remove(entry.key);
    this.events.onChange();
  }

  #run() {
    if (this.#isRunning || !this.#entries.some((one) => !one.refused)) return;
    this.#isRunning = true;
    // Of several windows of this page only one sends.
    const locked = navigator.locks ? navigator.locks.request("arview-upload", () => this.#sendAll()) : this.#sendAll();
    locked.finally(() => {
      this.#isRunning = false;
      this.#run(); // a photo may have come at the very end
    });
  }

  async #sendAll() {
    let pauseMs = FIRST_PAUSE_MS, badHashes = 0;
    for (let entry; (entry = this.#entries.find((one) => !one.refused)); ) {
      try {
        const name = await this.#send(entry);
        this.#say("");
        if (entry.dropped) await takeBack(entry.job, name, entry.dropped);
        await this.#remove(entry); // only now: the station has confirmed it
        this.#awaited.get(entry.key)?.resolve(name);
        this.#awaited.delete(entry.key);
        this.events.onStored(entry.job, name);
        [pauseMs, badHashes] = [FIRST_PAUSE_MS, 0];
      } catch (error) {
        if (error.code === undefined) throw error;
        if (entry.dropped) continue;
        if (error.code === "bad_hash" && ++badHashes < MAX_BAD_HASHES) {
          entry.upload = null;
          continue;
        }
        if (isFinal(error)) {
          entry.refused = error.message;
          await this.store.update(entry);
          this.#awaited.get(entry.key)?.reject(error);
          this.#awaited.delete(entry.key);
          this.events.onRefused(entry, error.message);
          this.events.onChange();
          continue;
        }
        this.#say(error.code === "disk_full" ? "disk_full" : "offline");
        await this.#pause(error.code === "disk_full" ? DISK_PAUSE_MS : Math.max(pauseMs, 1000 * error.waitS));
        pauseMs = Math.min(2 * pauseMs, LONGEST_PAUSE_MS);
      }
    }
  }

  /** Send a photo, from where an earlier attempt ended; returns its name at the station. */
  async #send(entry) {
    const { job, content } = entry;
    let offset = entry.upload ? await this.#resumed(entry) : null;
    if (offset === null) {
      const begun = await beginUpload(job, {
        bytes: content.byteLength, sha256: entry.sha256, source: entry.source, taken: entry.taken, hint: entry.hint, purpose: entry.purpose ?? "measure", media_type: entry.mediaType,
      });
      if (begun.photo) return begun.photo;
      [entry.upload, offset] = [begun.upload, begun.offset];
      if (!entry.dropped) await this.store.update(entry);
    }
    for (;;) {
      this.sent = offset;
      this.events.onChange();
      let answer;
      try {
        answer = await sendPiece(job, entry.upload, offset, content.slice(offset, offset + PIECE_BYTES));
      } catch (error) {
        if (error.code !== "bad_offset") throw error;
        answer = { offset: await getOffset(job, entry.upload) };
        if (answer.offset === offset) throw error; // the station asks for what it has just refused
      }
      if (answer.photo) return answer.photo;
      offset = answer.offset;
    }
  }

  /** Where an earlier attempt ended; null when the station has forgotten it. */
  async #resumed(entry) {
    try {
      return await getOffset(entry.job, entry.upload);
    } catch (error) {
      if (error.status !== 404) throw error;
      entry.upload = null;
      return null;
    }
  }

  #say(trouble) {
    if (this.trouble === trouble) return;
    this.trouble = trouble;
    this.events.onChange();
  }

  #pause(ms) {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, ms);
      this.#wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }
}

/** Whether a refusal will be the same again: the photo, or its job, is wrong. */
const isFinal = ({ status, code }) => code === "bad_hash" || code !== "bad_offset" && [400, 404, 409, 413, 415, 422].includes(status);
