// Which picture to show with which pose: a ghost only ever lies on the very frame that its pose was found in.

import { FrameRing } from "./transport/frames.js";
import { Intrinsics } from "./scene/projection.js";
import { FRAME_IDS, isNewer } from "./transport/stamp.js";

const KEPT_FRAMES = 20, KEPT_POSES = 60, KEPT_TIMES = 300;
const STALE_MS = 700; // without an answer for so long the ghost goes and the camera is shown as it is

export class Player {
  /** @param isPhone whether this page has a camera of its own. */
  constructor(isPhone) {
    this.isPhone = isPhone;
    this.own = new FrameRing(KEPT_FRAMES); // of this page's camera
    this.sent = new FrameRing(isPhone ? 4 : KEPT_FRAMES); // by the server
    this.mode = "poses";
    this.shown = null;
    this.isFrozen = false;
    this.reset();
  }

  /** Forget what belongs to a connection; the picture stays until there is another. */
  reset() {
    this.poses = new Map();
    this.takenMs = new Map(); // of this page's camera, by id
    this.answer = null;
    this.answeredMs = -Infinity;
    this.nextId = 0;
    this.own.clear();
    this.sent.clear();
  }

  /** Keep a picture of this page's camera; not in place of the one that waits for its answer. */
  takeOwn(video, takenMs, turns, waiting = null) {
    const width = video.videoWidth & ~1, height = video.videoHeight & ~1;
    if (width < 64 || height < 64) return null;
    const id = this.nextId;
    this.nextId = (id + 1) % FRAME_IDS;
    this.takenMs.set(id, takenMs);
    this.takenMs.delete((id - KEPT_TIMES + FRAME_IDS) % FRAME_IDS);
    return this.own.take(video, width, height, { id, takenMs, turns }, [this.shown?.frame, waiting]);
  }

  /** Keep a picture that the server sent; `cameMs` is when. */
  takeSent(source, width, height, id, cameMs) {
    const takenMs = this.takenMs.get(id) ?? cameMs;
    return this.sent.take(source, width, height, { id, takenMs }, [this.shown?.frame]);
  }

  /** Keep an answer. */
  takePose(pose, nowMs) {
    if (!this.camera?.isSame(pose.camera)) this.camera = new Intrinsics(pose.camera);
    pose.lens = this.camera;
    this.poses.set(pose.id, pose);
    if (this.poses.size > KEPT_POSES) this.poses.delete(this.poses.keys().next().value);
    // A server that begins to count anew is not an old answer.
    if (this.answer && !isNewer(pose.id, this.answer.id) && nowMs - this.answeredMs < STALE_MS) return;
    this.answer = pose;
    this.answeredMs = nowMs;
  }

  /** Whether answers come. */
  isAnswered(nowMs) {
    return nowMs - this.answeredMs < STALE_MS;
  }

  /**
   * What belongs on the screen now: {frame, pose, guide, isAnnotated}; frame is null while there is none. A pose of null
   * means a picture without ghost.
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
    if (!answer?.cam_from_model) return plain;
    if (this.mode === "video") {
      const frame = this.sent.newest;
      if (!frame || nowMs - frame.takenMs > 4 * STALE_MS) return plain;
      return { frame, pose: this.poses.get(frame.id) ?? null, guide: null, isAnnotated: true };
    }
    const ring = this.isPhone ? this.own : this.sent;
    const frame = ring.newestWhere((id) => Boolean(this.poses.get(id)?.cam_from_model));
    if (!frame || nowMs - frame.takenMs > 4 * STALE_MS) return plain;
    return { frame, pose: this.poses.get(frame.id), guide: null, isAnnotated: false };
  }
}
