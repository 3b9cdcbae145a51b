// The connection to the server: choice of the transport, reconnection after failures, and messages about both.

import { Refusal, control, getModel, getPart, partsOf } from "./api.js";
import { JpegLink } from "./jpeg.js";
import { NoWebrtc, WebrtcLink } from "./webrtc.js";
import { t } from "../texts/texts.js";

export const CHOICES = ["auto", "poses", "video", "jpeg"];
const FIRST_PAUSE_S = 1, LONGEST_PAUSE_S = 15, LOADING_PAUSE_S = 1, BUSY_PAUSE_S = 4;
const MUTE_MS = 6000; // connected and sending for so long while nothing arrives: WebRTC does not work here

export class Connection {
  link = null;
  choice = "auto";
  hasGhost = true; // whether this page can draw the overlay
  status = null;
  #part = null;
  #models = new Map(); // GLB by the hash of the model
  #shownModels = "";
  #noWebrtc = null; // why WebRTC does not work here: see NoWebrtc
  #isOver = false;
  #skipPause = () => {};
  #abort = new AbortController();

  /**
   * @param video element for the video that the server sends.
   * @param events {onPhase({name, text, inS}), onPart(part), onModels(buffers, part), onOpen(link), onPose, onStatus,
   *     onFrame}. Names of phases: loading, connecting, connected, retrying, busy, denied.
   */
  constructor(video, events) {
    Object.assign(this, { video, events });
  }

  get mode() {
    return this.choice === "video" || (!this.hasGhost && this.choice !== "poses") ? "video" : "poses";
  }

  /** Why the automatic choice has fallen back from WebRTC to JPEG, see NoWebrtc; null if it has not. */
  get fallback() {
    return this.choice === "jpeg" ? null : this.#noWebrtc;
  }

  /** Stay connected until `end`. */
  async run() {
    let pauseS = FIRST_PAUSE_S;
    while (!this.#isOver) {
      try {
        await this.#refreshPart();
        const reason = await this.#connect(() => { pauseS = FIRST_PAUSE_S; });
        if (reason === null) continue; // another transport was chosen
        this.#phase("retrying", reason, pauseS);
      } catch (error) {
        if (this.#isOver) return;
        if (error instanceof NoWebrtc && this.choice === "auto") {
          this.#noWebrtc = error.reason;
          continue;
        }
        if (!(error instanceof Refusal || error instanceof NoWebrtc || error.name === "AbortError")) console.error(error);
        if (error.code === "loading") this.#phase("loading", error.message, LOADING_PAUSE_S);
        else if (error.code === "busy") this.#phase("busy", error.message.replace(/^busy: /, ""), (pauseS = BUSY_PAUSE_S));
        else if (error.code === "no_token") this.#phase("denied", t("message.denied.text"), LONGEST_PAUSE_S);
        else this.#phase("retrying", error.message, Math.max(pauseS, error.waitS ?? 0));
        if (error.code === "loading") pauseS = 0.5;
      }
      await this.#pause();
      pauseS = Math.min(2 * pauseS, LONGEST_PAUSE_S);
    }
  }

  /** Choose the transport: one of CHOICES. */
  choose(choice) {
    const previous = this.choice;
    this.choice = choice;
    this.#noWebrtc = null;
    if (!this.link || choice === previous) return;
    const kind = choice === "jpeg" ? "jpeg" : "webrtc";
    if (kind === this.link.kind) this.ask({ mode: this.mode });
    else this.#restart();
  }

  /** Send a Control request; returns the error message, or "" on success. */
  async ask(request) {
    if (!this.link?.client) return t("link.gone");
    try {
      this.#handleStatus(await control(this.link.client, request));
      return "";
    } catch (error) {
      return error.message;
    }
  }

  /** Try again now. */
  retryNow() {
    this.#skipPause();
  }

  /** Leave for good. */
  end() {
    this.#isOver = true;
    this.#abort.abort();
    this.link?.close();
    this.#skipPause();
  }

  #ended = () => {};

  #restart() {
    this.link?.close();
    this.#ended(null);
  }

  #phase(name, text = "", inS = 0) {
    this.#nextInS = inS;
    this.events.onPhase({ name, text, inS });
  }

  #nextInS = 0;

  #pause() {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, 1e3 * this.#nextInS);
      this.#skipPause = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }

  async #refreshPart() {
    const part = await getPart(this.link?.client);
    if (part.state === "loading") throw new Refusal(503, "loading", part.text);
    if (part.state === "failed") throw new Refusal(503, "failed", part.text);
    this.#part = part;
    this.events.onPart(part);
    const hashes = partsOf(part).map((one) => one.part.model_hash);
    if (hashes.join() === this.#shownModels) return;
    for (const [id, hash] of hashes.entries()) if (!this.#models.has(hash)) this.#models.set(hash, await getModel(id));
    await this.events.onModels(hashes.map((hash) => this.#models.get(hash)), part);
    this.#shownModels = hashes.join();
  }

  /** Connect until the connection ends; returns the reason, or null when another transport was chosen. */
  async #connect(onOpen) {
    const isPhone = this.#part.source === "phone";
    const ended = new Promise((resolve) => { this.#ended = resolve; });
    const events = {
      onPose: (pose) => {
        if (pose.revision !== this.#part.revision) this.#refreshSoon();
        this.events.onPose(pose);
      },
      onStatus: (status) => this.#handleStatus(status),
      onFrame: this.events.onFrame,
      onEnd: this.#ended,
    };
    const isJpeg = this.choice === "jpeg" || this.#noWebrtc !== null;
    this.#phase("connecting", isJpeg ? "" : t("why.webrtc"));
    const link = isJpeg ? new JpegLink(isPhone, events) : new WebrtcLink(isPhone, this.video, events);
    const { choice } = this;
    this.link = null;
    await link.open(this.mode, this.#abort.signal);
    if (this.#isOver || this.choice !== choice) {
      link.close();
      return null;
    }
    this.link = link;
    this.#openMs = performance.now();
    onOpen();
    this.#phase("connected");
    this.events.onOpen(link);
    const reason = await ended;
    this.link = null;
    if (reason === MUTE) throw new NoWebrtc("blocked");
    return reason;
  }

  #openMs = 0;
  #isRefreshing = false;

  #handleStatus(status) {
    this.status = status;
    if (this.#part && status.revision !== this.#part.revision) this.#refreshSoon();
    const { link } = this;
    const isMute = link?.kind === "webrtc" && link.isPhone && link.sent > 60 && performance.now() - this.#openMs > MUTE_MS;
    if (isMute && status.feed && status.feed.received === 0) {
      link.close();
      this.#ended(MUTE);
    }
    this.events.onStatus(status);
  }

  async #refreshSoon() {
    if (this.#isRefreshing) return;
    this.#isRefreshing = true;
    try {
      await this.#refreshPart();
    } catch (error) {
      if (!(error instanceof Refusal)) console.error(error);
      await new Promise((resolve) => setTimeout(resolve, 1000)); // the next answer triggers another attempt
    } finally {
      this.#isRefreshing = false;
    }
  }
}

const MUTE = Symbol("mute");
