// Pairs frames with poses: an overlay is only shown on the frame in which its pose was measured.

import { FrameRing } from "./transport/frames.js";
import { Intrinsics } from "./scene/projection.js";
import { partsOf } from "./transport/api.js";
import { FRAME_IDS, isNewer } from "./transport/stamp.js";

const KEPT_FRAMES = 20, KEPT_POSES = 60, KEPT_TIMES = 300;
const STALE_MS = 700; // without a pose for so long the overlay is removed and the plain camera picture is shown

export class Player {
  /** @param isPhone whether this page has its own camera. */
  constructor(isPhone) {
    this.isPhone = isPhone;
    this.own = new FrameRing(KEPT_FRAMES); // frames of this page's camera
    this.sent = new FrameRing(isPhone ? 4 : KEPT_FRAMES); // frames that the server sent
    this.mode = "poses";
    this.shown = null;
    this.isFrozen = false;
    this.reset();
  }

  /** Forget poses and frames of a connection; the picture stays until there is another. */
  reset() {
    this.poses = new Map();
    this.takenMs = new Map(); // capture times of this page's frames, by id
    this.answer = null;
    this.answeredMs = -Infinity;
    this.nextId = 0;
    this.own.clear();
    this.sent.clear();
  }

  /** Keep a frame of this page's camera; it does not replace the one whose response is outstanding. */
  takeOwn(video, takenMs, turns, waiting = null) {
    const width = video.videoWidth & ~1, height = video.videoHeight & ~1;
    if (width < 64 || height < 64) return null;
    const id = this.nextId;
    this.nextId = (id + 1) % FRAME_IDS;
    this.takenMs.set(id, takenMs);
    this.takenMs.delete((id - KEPT_TIMES + FRAME_IDS) % FRAME_IDS);
    return this.own.take(video, width, height, { id, takenMs, turns }, [this.shown?.frame, waiting]);
  }

  /** Keep a frame that the server sent; `arrivedMs` is the time of its arrival. */
  takeSent(source, width, height, id, arrivedMs) {
    const takenMs = this.takenMs.get(id) ?? arrivedMs;
    return this.sent.take(source, width, height, { id, takenMs }, [this.shown?.frame]);
  }

  /** Keep a pose. */
  takePose(pose, nowMs) {
    if (!this.camera?.isSame(pose.camera)) this.camera = new Intrinsics(pose.camera);
    pose.lens = this.camera;
    pose.parts = partsOf(pose);
    pose.isPosed = pose.parts.some((one) => one.cam_from_model);
    this.poses.set(pose.id, pose);
    if (this.poses.size > KEPT_POSES) this.poses.delete(this.poses.keys().next().value);
    // After STALE_MS an older id is accepted, too: the server may have started to count again.
    if (this.answer && !isNewer(pose.id, this.answer.id) && nowMs - this.answeredMs < STALE_MS) return;
    this.answer = pose;
    this.answeredMs = nowMs;
  }

  /** Whether poses arrive. */
  isAnswered(nowMs) {
    return nowMs - this.answeredMs < STALE_MS;
  }

  /**
   * What to show now: {frame, pose, guide, isAnnotated}. The frame is null while there is none; a pose of null means a
   * picture without overlay.
   */
  choose(nowMs) {
    if (this.isFrozen && this.shown) return this.shown;
    this.shown = this.#choose(nowMs);
    return this.shown;
  }

  #choose(nowMs) {
    const answer = this.isAnswered(nowMs) ? this.answer : null;
    const plain = {
      frame: (this.isPhone ? this.own : this.sent).newest, pose: null, guide: answer?.guide_cam_from_model ? answer : null,
      isAnnotated: false,
    };
    if (!answer?.isPosed) return plain;
    if (this.mode === "video") {
      const frame = this.sent.newest;
      if (!frame || nowMs - frame.takenMs > 4 * STALE_MS) return plain;
      return { frame, pose: this.poses.get(frame.id) ?? null, guide: null, isAnnotated: true };
    }
    const ring = this.isPhone ? this.own : this.sent;
    const frame = ring.newestWhere((id) => Boolean(this.poses.get(id)?.isPosed));
    if (!frame || nowMs - frame.takenMs > 4 * STALE_MS) return plain;
    return { frame, pose: this.poses.get(frame.id), guide: null, isAnnotated: false };
  }
}
