// Transport by WebRTC: the page sends its camera and receives poses by a data channel and pictures as video.

import { CANVAS_OPTIONS } from "../graphics.js";
import { ask, join, leave } from "./api.js";
import { watchFrames } from "../camera.js";
import { t, translated } from "../texts/texts.js";
import { drawStrip, readStamp, stripHeight } from "./stamp.js";

const GATHER_MS = 1500, CONNECT_MS = 9000, SILENT_MS = 5000, RTT_EVERY_MS = 2000;
const BITRATE = 8_000_000;

/** WebRTC does not work here; the cause is "unsupported" by the browser, "disagree" (no common codec) or "blocked" by the network. */
export class NoWebrtc extends Error {
  constructor(cause) {
    super(t(`link.${cause}`));
    this.reason = cause;
  }
}

export class WebrtcLink {
  kind = "webrtc";
  client = null;
  rttMs = null;
  sent = 0;
  #ended = false;

  /**
   * @param isPhone whether this page sends its camera.
   * @param video element for the video that the server sends.
   * @param events {onPose, onStatus, onFrame(source, width, height, id, ms), onEnd(reason)}
   */
  constructor(isPhone, video, events) {
    Object.assign(this, { isPhone, video, events });
  }

  /** Connect; throws NoWebrtc or a Refusal. */
  async open(mode, signal) {
    if (!globalThis.RTCPeerConnection) throw new NoWebrtc("unsupported");
    const peer = (this.peer = new RTCPeerConnection({ iceServers: [] }));
    try {
      const channel = this.channel = peer.createDataChannel("arview", { ordered: false, maxRetransmits: 0 });
      channel.addEventListener("message", (event) => this.#process(translated(JSON.parse(event.data))));
      channel.addEventListener("close", () => this.#end(t("link.closed")));
      this.#addVideo(peer);
      await peer.setLocalDescription(await peer.createOffer());
      await gathered(peer);
      const offer = { type: "offer", sdp: peer.localDescription.sdp };
      const joined = await join({ transport: "webrtc", mode, offer }, signal);
      this.client = joined.client;
      await peer.setRemoteDescription(joined.answer);
      await connected(peer, channel);
    } catch (error) {
      this.close();
      if (error.code === "bad_offer" || error instanceof DOMException && error.name !== "AbortError") {
        throw new NoWebrtc("disagree");
      }
      throw error;
    }
    peer.addEventListener("connectionstatechange", () => {
      if (["failed", "closed"].includes(peer.connectionState)) this.#end(t("link.lost"));
    });
    this.#receivedMs = performance.now();
    this.#timer = setInterval(() => this.#watch(), RTT_EVERY_MS);
    return this;
  }

  /** Send a frame of the camera. */
  send(frame) {
    const { context } = this, { canvas } = context, height = frame.height + stripHeight(frame.width);
    if (canvas.width !== frame.width || canvas.height !== height) {
      canvas.width = frame.width;
      canvas.height = height;
    }
    context.drawImage(frame.canvas, 0, 0);
    drawStrip(context, frame);
    this.track.requestFrame?.();
    this.sent += 1;
  }

  /** Tell the server something that may get lost. */
  tell(document) {
    if (this.channel?.readyState === "open") this.channel.send(JSON.stringify(document));
  }

  close() {
    this.#ended = true;
    clearInterval(this.#timer);
    this.#stopWatching();
    this.track?.stop();
    this.peer?.close();
    this.video.srcObject = null;
    if (this.client) leave(this.client);
    this.client = null;
  }

  #timer = 0;
  #receivedMs = 0;
  #stopWatching = () => {};

  #addVideo(peer) {
    if (this.isPhone) {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [640, 500];
      this.context = canvas.getContext("2d", CANVAS_OPTIONS);
      const byHand = "requestFrame" in (globalThis.CanvasCaptureMediaStreamTrack?.prototype ?? {});
      [this.track] = (byHand ? canvas.captureStream(0) : canvas.captureStream()).getVideoTracks();
      this.track.contentHint = "detail"; // prefer fewer frames to smaller ones
      const { sender } = peer.addTransceiver(this.track, { direction: "sendrecv" });
      const parameters = sender.getParameters();
      parameters.degradationPreference = "maintain-resolution";
      if (parameters.encodings?.length) parameters.encodings[0].maxBitrate = BITRATE;
      sender.setParameters(parameters).catch(() => {});
    } else {
      peer.addTransceiver("video", { direction: "recvonly" });
    }
    peer.addEventListener("track", ({ track, receiver }) => {
      if ("jitterBufferTarget" in receiver) receiver.jitterBufferTarget = 0;
      if ("playoutDelayHint" in receiver) receiver.playoutDelayHint = 0;
      this.video.srcObject = new MediaStream([track]);
      this.video.play().catch(() => {});
      this.#stopWatching = watchFrames(this.video, (moment) => this.#takeFrame(moment));
    });
  }

  #takeFrame(moment) {
    const { video } = this, { videoWidth: width, videoHeight: height } = video;
    if (width < 64) return;
    const stamp = readStamp(video, width, height);
    if (stamp) this.events.onFrame(video, width, height - stripHeight(width), stamp.id, moment);
  }

  #process(document) {
    this.#receivedMs = performance.now();
    if (document.type === "pose") this.events.onPose(document);
    else if (document.type === "status") this.events.onStatus(document);
  }

  async #watch() {
    if (performance.now() - this.#receivedMs > SILENT_MS) {
      // The server sends a message every second; try HTTP before giving up.
      try {
        this.events.onStatus(translated(await (await ask(`/api/clients/${this.client}/status`)).json()));
      } catch (error) {
        return this.#end(error.message);
      }
      return this.#end(t("link.no_data"));
    }
    const report = await this.peer.getStats().catch(() => []);
    for (const entry of report.values?.() ?? []) {
      if (entry.type === "candidate-pair" && entry.nominated && entry.currentRoundTripTime !== undefined) {
        this.rttMs = 1e3 * entry.currentRoundTripTime;
      }
    }
  }

  #end(reason) {
    if (this.#ended) return;
    this.close();
    this.events.onEnd(reason);
  }
}

function gathered(peer) {
  if (peer.iceGatheringState === "complete") return Promise.resolve();
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, GATHER_MS);
    peer.addEventListener("icegatheringstatechange", () => {
      if (peer.iceGatheringState !== "complete") return;
      clearTimeout(timer);
      resolve();
    });
  });
}

function connected(peer, channel) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(() => reject(new NoWebrtc("blocked")), CONNECT_MS);
    channel.addEventListener("open", () => {
      clearTimeout(timer);
      resolve();
    });
    peer.addEventListener("connectionstatechange", () => {
      if (peer.connectionState !== "failed") return;
      clearTimeout(timer);
      reject(new NoWebrtc("blocked"));
    });
  });
}
