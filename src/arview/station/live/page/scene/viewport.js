// Zoom and pan: which piece of the picture fills the stage. Without a choice of the user the whole picture is shown or, where a
// wide picture would leave most of a tall screen empty, the piece around the parts.

const MAX_ZOOM = 8, STEP = 1.5;
const EMPTY = 0.62; // a picture that fills less than this share of the free height follows the parts
const TALLEST = 0.72; // share of the free height that a picture which follows the parts may fill; the rest is for labels
const PART_SHARE = 0.86; // share of the free width that the parts fill then
const RESCALE = 1.2; // the scale follows only after it is wrong by this factor
const DEAD_SHARE = 0.1; // shift of the parts, relative to the free width, that is not followed
const GLIDE = 0.18; // share of the remaining path in each drawing

export class Viewport {
  zoom = 1; // relative to the whole picture
  isMoving = false;
  #mode = "auto"; // or "manual" after a choice of the user
  #center = null; // of the free area, picture px
  #goal = null; // {zoom, center} that an automatic view moves to
  #last = null; // {frame, area, fit} of the last placement

  /** Whether the user has chosen this view. */
  get isManual() {
    return this.#mode === "manual";
  }

  /** Whether an automatic view is more than the whole picture here. */
  get canFollow() {
    return this.#last !== null && isEmpty(this.#last);
  }

  /** Scale to which the view moves, CSS px for each picture px: the size at which the picture should be drawn. */
  get goalScale() {
    return this.#last.fit * (this.isManual ? this.zoom : this.#goal?.zoom ?? 1);
  }

  /**
   * Place the picture.
   * @param frame {width, height}, px.
   * @param area {left, top, width, height} of the stage that is free, CSS px.
   * @param box {left, top, right, bottom} of the parts, picture px, or null.
   * @param glides whether an automatic view moves gradually.
   * @returns {left, top, scale}: CSS px = left + scale * (u + 0.5).
   */
  place(frame, area, box, glides) {
    const fit = Math.min(area.width / frame.width, area.height / frame.height);
    const hasChanged = this.#last && (this.#last.frame.width !== frame.width || this.#last.frame.height !== frame.height);
    if (hasChanged && this.#center) {
      this.#center = this.#center.map((value, k) => (value * (k ? frame.height : frame.width)) / (k ? this.#last.frame.height : this.#last.frame.width));
      this.#goal = null;
    }
    this.#last = { frame: { width: frame.width, height: frame.height }, area, fit };
    this.#center ??= [frame.width / 2, frame.height / 2];
    if (!this.isManual) this.#follow(box, glides && !hasChanged);
    this.#center = this.#clamped(this.#center, this.zoom);
    const scale = fit * this.zoom;
    return {
      left: area.left + area.width / 2 - scale * this.#center[0], top: area.top + area.height / 2 - scale * this.#center[1], scale,
    };
  }

  /** Zoom by a factor so that what is at (x, y), CSS px on the stage, stays there. */
  zoomBy(factor, x, y) {
    if (!this.#last) return;
    const { area, fit } = this.#last, before = fit * this.zoom;
    this.#mode = "manual";
    this.zoom = Math.min(MAX_ZOOM, Math.max(1, this.zoom * factor));
    const after = fit * this.zoom, offset = [x - area.left - area.width / 2, y - area.top - area.height / 2];
    this.#center = this.#clamped(this.#center.map((value, k) => value + offset[k] / before - offset[k] / after), this.zoom);
  }

  /** Zoom by one step about the middle. */
  step(direction) {
    if (!this.#last) return;
    const { area } = this.#last;
    this.zoomBy(direction > 0 ? STEP : 1 / STEP, area.left + area.width / 2, area.top + area.height / 2);
  }

  /** Move the picture by (dx, dy) CSS px. */
  pan(dx, dy) {
    if (!this.#last || this.zoom <= 1) return;
    const scale = this.#last.fit * this.zoom;
    this.#mode = "manual";
    this.#center = this.#clamped([this.#center[0] - dx / scale, this.#center[1] - dy / scale], this.zoom);
  }

  /** Show the whole picture; once more: follow the parts, where that is more. */
  reset() {
    if (this.isManual && this.zoom === 1 && this.canFollow) {
      this.#mode = "auto";
      return;
    }
    this.#mode = this.canFollow ? "manual" : "auto";
    this.zoom = 1;
    this.#goal = null;
  }

  #follow(box, glides) {
    const { frame, area, fit } = this.#last;
    const whole = { zoom: 1, center: [frame.width / 2, frame.height / 2] };
    if (!box || !isEmpty(this.#last)) this.#goal = whole;
    else {
      const wide = (PART_SHARE * area.width) / Math.max(1, box.right - box.left), tall = (TALLEST * area.height) / frame.height;
      const zoom = Math.max(1, Math.min(wide, tall, MAX_ZOOM * fit) / fit), center = [(box.left + box.right) / 2, (box.top + box.bottom) / 2];
      const old = this.#goal ?? whole, isWrong = zoom / old.zoom > RESCALE || old.zoom / zoom > RESCALE;
      const kept = isWrong ? zoom : old.zoom, shift = Math.hypot(center[0] - old.center[0], center[1] - old.center[1]) * fit * kept;
      this.#goal = { zoom: kept, center: isWrong || shift > DEAD_SHARE * area.width ? center : old.center };
    }
    const goal = { zoom: this.#goal.zoom, center: this.#clamped(this.#goal.center, this.#goal.zoom) };
    const left = Math.abs(Math.log(goal.zoom / this.zoom)) + (Math.hypot(...goal.center.map((value, k) => value - this.#center[k])) * fit) / area.width;
    this.isMoving = glides && left > 0.004;
    const share = this.isMoving ? GLIDE : 1;
    this.zoom *= (goal.zoom / this.zoom) ** share;
    this.#center = this.#center.map((value, k) => value + share * (goal.center[k] - value));
  }

  /** A centre at which the picture leaves nothing of the area empty that it could fill. */
  #clamped(center, zoom) {
    const { frame, area, fit } = this.#last, scale = fit * zoom;
    return center.map((value, k) => {
      const size = k ? frame.height : frame.width, half = (k ? area.height : area.width) / 2 / scale;
      return half >= size / 2 ? size / 2 : Math.min(size - half, Math.max(half, value));
    });
  }
}

/** Whether the whole picture leaves much of the height empty. */
const isEmpty = ({ frame, area, fit }) => fit * frame.height < EMPTY * area.height && frame.width > frame.height;
