// The dome of directions that photos are wanted from, and the ring for the distance, as one small drawing.

import { t } from "../texts/texts.js";
import { eyeInModel } from "../scene/projection.js";

const SVG = "http://www.w3.org/2000/svg";
const SIZE = 128, RADIUS = 47, MIDDLE = [64, 66];
const TILT = (50 * Math.PI) / 180; // the dome is seen from here, with the side of the camera in front
const RING = 60, RING_FROM = 215, RING_TO = 325; // degrees clockwise from the right: below the dome
const SPAN = 1.6; // the ring reaches from the nearest good distance divided by this to the farthest times it
const CELL_PX = 5.2;

const shape = (name, attributes, parent) => {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent?.append(made);
  return made;
};
const point = (degrees, radius) => [MIDDLE[0] + radius * Math.cos((degrees * Math.PI) / 180), MIDDLE[1] - radius * Math.sin((degrees * Math.PI) / 180)];
const arc = (from, to, radius) => `M${point(from, radius).join(" ")}A${radius} ${radius} 0 0 0 ${point(to, radius).join(" ")}`;

export class Dome {
  #cells = [];
  #states = "";
  #azimuth = null;
  #shown = "";

  constructor() {
    this.element = shape("svg", { viewBox: `0 0 ${SIZE} ${SIZE}`, class: "dome", role: "img" });
    this.rim = shape("ellipse", { cx: MIDDLE[0], cy: MIDDLE[1], rx: RADIUS, ry: RADIUS * Math.sin(TILT), class: "rim" }, this.element);
    this.dots = shape("g", {}, this.element);
    this.here = shape("path", { class: "here", d: "M-8 0A8 8 0 1 1 8 0A8 8 0 1 1-8 0M0-12V-5M0 12V5M-12 0H-5M12 0H5" }, this.element);
    this.ring = shape("g", { class: "ring" }, this.element);
    shape("path", { class: "way", d: arc(RING_FROM, RING_TO, RING) }, this.ring);
    this.good = shape("path", { class: "good" }, this.ring);
    this.mark = shape("circle", { class: "mark", r: 5 }, this.ring);
    this.here.setAttribute("visibility", "hidden");
    this.mark.setAttribute("visibility", "hidden");
  }

  /** Set the answer to GET …/capture, and the centre of the part [3]. */
  setGeometry({ cells, distance_mm: range }, centerInModel) {
    this.#cells = cells.map(({ azimuth_deg: azimuth, elevation_deg: elevation, direction_in_model: direction }) => {
      const [a, e] = [(azimuth * Math.PI) / 180, (elevation * Math.PI) / 180];
      return { own: [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)], direction };
    });
    this.range = range;
    this.center = centerInModel;
    this.turn = rotation(this.#cells);
    this.dots.replaceChildren();
    for (const cell of this.#cells) cell.dot = shape("circle", {}, this.dots);
    const [near, far] = range;
    this.good.setAttribute("d", arc(this.#angle(near), this.#angle(far), RING));
    this.#states = this.#shown = "";
    this.#azimuth = null;
  }

  /**
   * Draw the state of the cells, and where the camera is.
   * @param states a letter for each cell: 0 open, 1 filled, 2 wanted.
   * @param pose cam_from_model [16], or null while the part is not tracked.
   */
  update(states, pose) {
    if (!this.#cells.length) return;
    const eye = pose && eyeInModel(pose).map((value, k) => value - this.center[k]);
    const distance = eye && Math.hypot(...eye), own = eye && this.turn(eye.map((value) => value / distance));
    if (own) this.#azimuth = Math.atan2(own[1], own[0]);
    const key = `${states}|${own?.map((value) => value.toFixed(2))}|${distance?.toFixed(0)}`;
    if (key === this.#shown) return;
    this.#shown = key;
    this.#states = states;
    for (const [index, cell] of this.#cells.entries()) this.#drawCell(cell, states[index] ?? "0");
    this.here.setAttribute("visibility", own ? "visible" : "hidden");
    this.mark.setAttribute("visibility", own ? "visible" : "hidden");
    if (own) {
      const { x, y } = this.#project(own);
      this.here.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
      const [cx, cy] = point(this.#angle(distance), RING);
      this.mark.setAttribute("cx", cx.toFixed(1));
      this.mark.setAttribute("cy", cy.toFixed(1));
      this.mark.classList.toggle("off", distance < this.range[0] || distance > this.range[1]);
    }
    const filled = [...states].filter((state) => state === "1").length, wanted = [...states].filter((state) => state === "2").length;
    this.element.setAttribute("aria-label", t("job.dome", { filled, wanted }));
  }

  #drawCell({ own, dot }, state) {
    const { x, y, depth } = this.#project(own);
    dot.setAttribute("cx", x.toFixed(1));
    dot.setAttribute("cy", y.toFixed(1));
    dot.setAttribute("r", (CELL_PX * (0.78 + 0.22 * depth)).toFixed(1));
    dot.setAttribute("class", `${["open", "filled", "wanted"][Number(state)] ?? "open"}${depth < 0 ? " behind" : ""}`);
  }

  /** Position in the drawing of a direction [3], with the camera's side in front. */
  #project([x, y, z]) {
    const turn = this.#azimuth ?? 0, toward = x * Math.cos(turn) + y * Math.sin(turn), aside = -x * Math.sin(turn) + y * Math.cos(turn);
    return {
      x: MIDDLE[0] + RADIUS * aside,
      y: MIDDLE[1] + RADIUS * (toward * Math.sin(TILT) - z * Math.cos(TILT)),
      depth: toward * Math.cos(TILT) + z * Math.sin(TILT),
    };
  }

  /** Angle on the ring of a distance, mm: near on the left, far on the right. */
  #angle(distance) {
    const [near, far] = this.range, from = Math.log(near / SPAN), to = Math.log(far * SPAN);
    const share = Math.min(1, Math.max(0, (Math.log(distance) - from) / (to - from)));
    return RING_FROM + share * (RING_TO - RING_FROM);
  }
}

/** The linear map from directions in the model to those of the dome, by least squares over the cells. */
function rotation(cells) {
  const sums = (of, by) => [0, 1, 2].map((r) => [0, 1, 2].map((c) => cells.reduce((sum, cell) => sum + cell[of][r] * cell[by][c], 0)));
  const product = sums("own", "direction"), square = inverse(sums("direction", "direction"));
  if (!square) return (direction) => direction;
  const matrix = product.map((row) => [0, 1, 2].map((c) => row.reduce((sum, value, k) => sum + value * square[k][c], 0)));
  return (direction) => matrix.map((row) => row.reduce((sum, value, k) => sum + value * direction[k], 0));
}

function inverse([[a, b, c], [d, e, f], [g, h, i]]) {
  const rows = [[e * i - f * h, c * h - b * i, b * f - c * e], [f * g - d * i, a * i - c * g, c * d - a * f], [d * h - e * g, b * g - a * h, a * e - b * d]];
  const determinant = a * rows[0][0] + b * rows[1][0] + c * rows[2][0];
  return Math.abs(determinant) < 1e-9 ? null : rows.map((row) => row.map((value) => value / determinant));
}
