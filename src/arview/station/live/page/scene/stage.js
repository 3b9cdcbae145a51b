// The stage: position of the picture on the screen, and the drawing over it.

import { CANVAS_OPTIONS } from "../graphics.js";
import { Ghost } from "./ghost.js";
import { Gestures } from "./gestures.js";
import { Labels } from "./labels.js";
import { toCam } from "./projection.js";
import { Viewport } from "./viewport.js";
import { partsOf } from "../transport/api.js";

const MAX_CANVAS_PX = 1600; // longer side; larger canvases cost time without visible benefit
const VISIBILITY_EVERY_MS = 150;
const LINE_CSS_PX = 1.7, THINNEST_PX = 1.2;
const RESIZED = 1.1; // the canvas is only resized after its size is wrong by this factor: while a view moves it would be costly
const PASS_DIMMING = 0.65; // ghosts of components that passed are fainter, so that the others stand out
const NEUTRAL = "#46c4ff", CONTEXT = "#e2e8f0", CONTEXT_ALPHA = 0.5;
const HATCH_ALPHA = 0.75; // the lines of a hatched ghost cover little
const DIMMED = 0.45; // factor of the opacity of ghosts that the pictures do not verify
const PATTERNS = { missing: 2, displaced: 1, wrong: 1 };
const NEXT_ALPHA = 0.6; // ghost of a component that is to be mounted now
const COVERED = 0.55; // with less of the stage free than this share, the picture avoids all that covers it
const ROOMY = 0.8; // the picture avoids the bars if it keeps this fraction of its size
const MARGIN_PX = 8;
const NO_EVIDENCE = { key: "", labels: new Map(), legend: [], withheld: [] };

export class Stage {
  #visibilityMs = -Infinity;
  #place = null;
  #size = null;
  #areas = null;

  /**
   * @param elements {stage, canvas, leaders, labels, obstacles: [bar, notices, actions, card, side], controls}: neither picture
   *     nor labels use the room of obstacles; controls lie over the picture, but labels avoid them.
   * @param onPick called with name and part of a component that was pressed in the picture, or null for a press beside all.
   * @param onResize called when everything has to be redrawn.
   */
  constructor(elements, style, onPick, onResize) {
    Object.assign(this, elements, { style, onPick, onResize });
    try {
      this.ghost = new Ghost(this.canvas);
    } catch {
      this.ghost = null;
      this.context = this.canvas.getContext("2d", CANVAS_OPTIONS);
    }
    this.components = null; // of all parts, with the number of their part
    this.isChanged = true; // whether style, part or window have changed since the last drawing
    this.labelBoxes = new Labels(this.labels, this.leaders, onPick);
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
    this.viewport = new Viewport();
    this.isFollowing = false; // whether the view may follow the parts
    let before = null;
    this.gestures = new Gestures(this.stage, this.viewport, {
      onChange: () => this.moved(),
      onTap: (event) => {
        before = [this.style.only, this.style.only_part];
        this.#pick(event);
      },
      onDouble: () => before && this.onPick(...before), // the first of two taps was no choice
    });
    let isAsked = false;
    const observer = new ResizeObserver(() => {
      if (isAsked) return;
      isAsked = true;
      requestAnimationFrame(() => { // not at once: measuring may change the size of what is observed
        isAsked = false;
        this.measure();
      });
    });
    for (const one of [this.stage, ...this.obstacles, this.controls]) observer.observe(one);
    document.fonts?.ready.then(() => this.labelBoxes.remeasure());
  }

  /** Whether this browser can draw the overlay. */
  get hasGhost() {
    return this.ghost !== null;
  }

  /** Set the part document. */
  setPart(document) {
    this.parts = partsOf(document);
    this.components = this.parts.flatMap((part) => part.components.map((one) => ({ ...one, part: part.id })));
    if (this.ghost?.components.length === this.components.length) this.#arrange();
  }

  /** Set the CAD models of the parts, one for each. */
  async setModels(buffers, document) {
    await this.ghost?.load(partsOf(document).map(({ components }, id) => ({ buffer: buffers[id], count: components.length })));
    this.#arrange();
  }

  setStyle(style) {
    this.style = style;
    this.isChanged = true;
    if (this.ghost?.components.length) this.ghost.style(this.#styles());
    this.#visibilityMs = -Infinity;
  }

  /** Update the layout after a change of the window. */
  measure() {
    this.#areas = null;
    this.isChanged = true;
    this.labelBoxes.remeasure();
    this.onResize();
  }

  /** Draw again after a change of zoom or position. */
  moved() {
    this.isChanged = true;
    this.#visibilityMs = -Infinity;
    this.onResize();
  }

  /** Position of the picture on the stage: CSS px = left + scale * (u + 0.5); null while there is none. */
  get place() {
    return this.#place;
  }

  /** The area that labels may use, CSS px on the stage. */
  get free() {
    return this.#areas?.labels ?? null;
  }

  /** Size of the picture on the screen, CSS px; null while there is none. */
  get size() {
    return this.#size;
  }

  /** Where a point of a part in the model frame is drawn, CSS px on the stage; null where it is not in view. */
  toScreen(part, point) {
    const pose = this.#drawn, cam_from_model = pose?.parts[part]?.cam_from_model;
    const pixel = cam_from_model && pose.lens.project(toCam(cam_from_model, point));
    return pixel ? [this.#place.left + this.#place.scale * (pixel[0] + 0.5), this.#place.top + this.#place.scale * (pixel[1] + 0.5)] : null;
  }

  /** Draw the choice of the player. */
  draw({ frame, pose, guide, isAnnotated }) {
    this.isChanged = false;
    if (!frame) return this.labelBoxes.hide();
    this.#lay(frame, pose, isAnnotated);
    const isReady = this.ghost?.components.length > 0 && this.components !== null;
    const ownPose = isReady && pose && !isAnnotated && frame.width === pose.lens.width && frame.height === pose.lens.height ? pose : null;
    const ownGuide = isReady && guide && frame.width === guide.lens.width ? guide : null;
    if (ownPose) this.#takeEvidence(ownPose);
    if (!this.ghost) {
      this.context.drawImage(frame.canvas, 0, 0, this.canvas.width, this.canvas.height);
    } else {
      this.ghost.draw({
        source: frame.canvas,
        poses: (ownPose?.parts ?? []).map((one) => ({ cam_from_model: one.cam_from_model, isCritical: one.state === "critical" })),
        guide: ownPose ? null : ownGuide?.guide_cam_from_model ?? null,
        camera: (ownPose ?? ownGuide)?.lens,
        lineWidth: Math.max(THINNEST_PX, (LINE_CSS_PX * this.canvas.width) / this.#size.width),
      });
    }
    this.#drawn = ownPose;
    if (this.viewport.isMoving) {
      this.isChanged = true;
      this.onResize();
    }
    if (!ownPose?.isPosed) return this.labelBoxes.hide();
    const nowMs = performance.now();
    if (nowMs - this.#visibilityMs > VISIBILITY_EVERY_MS) {
      this.#visibilityMs = nowMs;
      this.labelBoxes.setVisibility(this.ghost.visibility());
    }
    this.labelBoxes.update(ownPose, this.#place, this.#areas.labels, this.style, !this.calm.matches, this.#areas.seen);
  }

  #drawn = null;
  #evidence = NO_EVIDENCE;

  /** Take over what a pose says of the components, where it has changed; they are numbered through all parts. */
  #takeEvidence({ parts }) {
    const key = JSON.stringify(parts.map(({ labels, withheld }) => [labels, withheld]));
    if (key === this.#evidence.key) return;
    const labels = new Map(), legend = new Map();
    let first = 0;
    for (const [id, part] of parts.entries()) {
      for (const one of part.labels) labels.set(first + one.index, one);
      for (const one of part.legend) legend.set(one.kind, one);
      first += this.parts[id].components.length;
    }
    this.#evidence = { key, labels, legend: [...legend.values()], withheld: parts.map((one) => one.withheld) };
    this.ghost.style(this.#styles());
    this.labelBoxes.setEvidence(this.#evidence);
  }

  #arrange() {
    this.isChanged = true;
    this.#evidence = NO_EVIDENCE;
    this.labelBoxes.setParts(this.parts, this.ghost?.components.map((one) => one.center_in_model) ?? []);
    this.ghost?.style(this.#styles());
  }

  #styles() {
    const { ghost, edges, opacity, only, only_part } = this.style, { labels } = this.#evidence;
    return this.components.map((one, index) => {
      const { inspection, tag_color } = this.parts[one.part], isInspected = inspection !== null;
      const withheld = this.#evidence.withheld[one.part], isOnly = only === one.name && only_part === one.part;
      const seen = labels.get(index), pattern = PATTERNS[seen?.evidence] ?? 0;
      const isContext = (isInspected && one.verdict === null && !pattern) || withheld;
      const color = rgb(isContext ? CONTEXT : seen?.color ?? one.verdict_color ?? tag_color ?? NEUTRAL);
      let alpha = isOnly || one.verdict !== "pass" ? opacity : opacity * PASS_DIMMING;
      if (pattern) alpha = HATCH_ALPHA;
      else if (seen?.evidence === "next") alpha = NEXT_ALPHA;
      else if (seen?.is_dimmed) alpha *= DIMMED;
      if (!ghost || withheld || (isContext && !isOnly)) alpha = 0;
      const edgeAlpha = edges === "none" ? 0 : isContext && !withheld ? CONTEXT_ALPHA : 1;
      return {
        ghost: [...color, alpha],
        edges: [...color.map((value) => 0.75 * value + 0.25), edgeAlpha],
        isShown: seen?.evidence !== "later" && (!only || isOnly),
        pattern: withheld ? 0 : pattern,
        isDashed: !withheld && ["unverified", "uncertain", "displaced"].includes(seen?.evidence),
        place: withheld ? null : seen?.model_from_nominal ?? null,
        placeAlpha: ghost ? opacity : 0,
      };
    });
  }

  /** Position the canvas for the picture of this frame. */
  #lay(frame, pose, isAnnotated) {
    const { whole, free } = (this.#areas ??= this.#measured());
    const fit = (area) => Math.min(area.width / frame.width, area.height / frame.height);
    const isFollowing = this.isFollowing && !isAnnotated; // labels that the station has drawn must stay in view
    const isCovered = free.width * free.height < COVERED * whole.width * whole.height; // by the side sheet: the part would be behind it
    const isRoomy = this.viewport.isManual || isFollowing || isCovered || fit(free) >= ROOMY * fit(whole), area = isRoomy ? free : whole;
    const { left, top, scale } = this.viewport.place(frame, area, isFollowing ? this.#boxOf(pose, frame) : null, !this.calm.matches);
    const width = frame.width * scale, height = frame.height * scale, old = this.#place;
    // Of the picture only this is seen: the bars cover the rest.
    this.#areas.seen = {
      left: Math.max(left, free.left), top: Math.max(top, free.top), right: Math.min(left + width, free.left + free.width),
      bottom: Math.min(top + height, free.top + free.height),
    };
    if (old && old.left === left && old.top === top && old.scale === scale && this.#size.width === width && this.#size.height === height) return;
    Object.assign(this.canvas.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
    const goal = [frame.width, frame.height].map((side) => side * this.viewport.goalScale);
    const density = Math.min(devicePixelRatio || 1, MAX_CANVAS_PX / Math.max(...goal)), size = goal.map((side) => Math.max(1, Math.round(side * density)));
    const ratio = size[0] / this.canvas.width, isSameShape = Math.abs(size[1] / this.canvas.height / ratio - 1) < 0.01;
    if (!isSameShape || !this.viewport.isMoving || ratio > RESIZED || ratio < 1 / RESIZED) {
      if (this.ghost) this.ghost.resize(...size);
      else if (this.canvas.width !== size[0] || this.canvas.height !== size[1]) [this.canvas.width, this.canvas.height] = size;
    }
    this.#size = { width, height };
    this.#place = { left, top, scale };
    if (!this.viewport.isMoving) this.#visibilityMs = -Infinity;
  }

  #measured() {
    const box = this.stage.getBoundingClientRect(), free = freeOf(box, this.obstacles);
    return { whole: { left: 0, top: 0, width: box.width, height: box.height }, free, labels: inset(freeOf(box, [...this.obstacles, this.controls]), MARGIN_PX) };
  }

  /** Box around the parts in a frame, px; null without a pose. The station may send the frame smaller than it was tracked. */
  #boxOf(pose, frame) {
    const box = { left: Infinity, top: Infinity, right: -Infinity, bottom: -Infinity };
    for (const [id, { cam_from_model }] of (pose?.parts ?? []).entries()) {
      const bounds = this.parts?.[id]?.part?.bounds_in_model;
      if (!cam_from_model || !bounds) continue;
      for (let k = 0; k < 8; k++) {
        const pixel = pose.lens.project(toCam(cam_from_model, [bounds[k & 1][0], bounds[(k >> 1) & 1][1], bounds[k >> 2][2]]));
        if (!pixel) continue;
        box.left = Math.min(box.left, pixel[0]);
        box.right = Math.max(box.right, pixel[0]);
        box.top = Math.min(box.top, pixel[1]);
        box.bottom = Math.max(box.bottom, pixel[1]);
      }
    }
    if (!(box.right > box.left)) return null;
    const scale = frame.width / pose.lens.width;
    return { left: box.left * scale, top: box.top * scale, right: box.right * scale, bottom: box.bottom * scale };
  }

  #pick(event) {
    if (!this.#drawn || !this.ghost) return;
    const { columns, rows, cells, window } = this.ghost.visibility(), { scale } = this.#place;
    const box = this.canvas.getBoundingClientRect();
    const column = (((event.clientX - box.left) / scale - window.left) / window.width) * columns;
    const row = (((event.clientY - box.top) / scale - window.top) / window.height) * rows;
    const reach = Math.ceil(((24 / scale) * columns) / window.width); // a thumb is 48 px wide
    let best = null, nearest = Infinity;
    for (let r = Math.floor(row) - reach; r <= row + reach; r++) {
      for (let c = Math.floor(column) - reach; c <= column + reach; c++) {
        if (r < 0 || c < 0 || r >= rows || c >= columns) continue;
        const component = this.components[cells[r * columns + c] - 1];
        const distance = Math.hypot(c + 0.5 - column, r + 0.5 - row);
        if (component && component.rank !== null && distance < nearest && distance <= reach) [best, nearest] = [component, distance];
      }
    }
    this.onPick(best?.name ?? null, best?.part ?? 0);
  }
}

/** The area of the stage that the bars along its sides leave free, in its own coordinates. */
function freeOf(whole, obstacles) {
  let [left, top, right, bottom] = [0, 0, whole.width, whole.height];
  for (const one of obstacles) {
    const box = one.getBoundingClientRect();
    const covers = getComputedStyle(one).getPropertyValue("--covers").trim() !== "0"; // not the visibility, which changes with a delay
    const shown = covers && box.width > 0 && box.height > 0 && one.childElementCount > 0;
    const x0 = box.left - whole.left, x1 = box.right - whole.left, y0 = box.top - whole.top, y1 = box.bottom - whole.top;
    if (!shown || x1 <= left || x0 >= right || y1 <= top || y0 >= bottom) continue;
    // Cut off the side that costs the least area.
    const costs = {
      top: (y1 - top) * (right - left), bottom: (bottom - y0) * (right - left),
      left: (x1 - left) * (bottom - top), right: (right - x0) * (bottom - top),
    };
    const side = Object.keys(costs).reduce((a, b) => (costs[a] <= costs[b] ? a : b));
    if (side === "top") top = y1;
    else if (side === "bottom") bottom = y0;
    else if (side === "left") left = x1;
    else right = x0;
  }
  return { left, top, width: Math.max(1, right - left), height: Math.max(1, bottom - top) };
}

const inset = ({ left, top, width, height }, by) => ({
  left: left + by, top: top + by, width: Math.max(1, width - 2 * by), height: Math.max(1, height - 2 * by),
});

const rgb = (hex) => [1, 3, 5].map((from) => parseInt(hex.slice(from, from + 2), 16) / 255);
