// HTML labels beside the part with leader lines, and displacement arrows, drawn over the picture.

import { icon, make } from "../icons.js";
import { LabelLayout } from "./layout.js";
import { toCam } from "./projection.js";

const MAX_LABELS = 12;
const NARROW_PX = 560, MAX_NARROW_LABELS = 4; // on a phone in portrait more labels would hide the part
const LABEL_ROOM_PX = 55; // height of the area for each label
const MIN_ROOM_PX = 200; // in a lower area only an isolated component has a label
const CONTEXT_WEIGHT = 0.25; // cost of covering a component that was not inspected, relative to an inspected one
const SVG = "http://www.w3.org/2000/svg";
const STUB_PX = 10, SIGN_PX = 24, ARROW_HEAD_PX = 11;

export class Labels {
  #layout = new LabelLayout();
  #labels = new Map(); // name → {element, leader, dot, sign, width, height}
  #arrows = new Map();
  #integral = null;
  #visible = null;

  /** @param onPick called with the name of a component whose label was pressed. */
  constructor(box, svg, onPick) {
    Object.assign(this, { box, svg, onPick });
    this.part = null;
  }

  /** Set the part document; all labels are created again. */
  setPart(part, centersInModel) {
    this.part = part;
    this.centers = centersInModel;
    this.clear();
    for (const { element, leader, dot, sign } of this.#labels.values()) [element, leader, dot, sign].forEach((one) => one.remove());
    for (const arrow of this.#arrows.values()) arrow.remove();
    this.#labels.clear();
    this.#arrows.clear();
    this.inspected = part.components
      .map((component, index) => ({ ...component, index }))
      .filter((component) => component.rank !== null)
      .sort((a, b) => a.rank - b.rank);
    for (const component of this.inspected) this.#add(component);
  }

  /** Set the map of visible components (see Ghost.visibility). */
  setVisibility({ columns, rows, cells, window }) {
    const integral = new Float64Array((columns + 1) * (rows + 1)), counts = new Map();
    for (let row = 0; row < rows; row++) {
      let sum = 0;
      for (let column = 0; column < columns; column++) {
        const number = cells[row * columns + column];
        if (number) {
          counts.set(number - 1, (counts.get(number - 1) ?? 0) + 1);
          sum += this.part.components[number - 1]?.rank === null ? CONTEXT_WEIGHT : 1;
        }
        integral[(row + 1) * (columns + 1) + column + 1] = integral[row * (columns + 1) + column + 1] + sum;
      }
    }
    this.#integral = { columns, rows, integral, window };
    this.#visible = counts;
  }

  /** Remove all labels from the picture. */
  clear() {
    this.#layout.reset();
    this.#visible = this.#integral = null;
    this.hide();
  }

  hide() {
    for (const label of this.#labels.values()) {
      show(label, false);
      label.sign.classList.add("off");
    }
    for (const arrow of this.#arrows.values()) arrow.setAttribute("visibility", "hidden");
  }

  /**
   * Place labels and arrows for a pose.
   * @param place {left, top, scale} position of the picture on the stage: CSS px = left + scale * (u + 0.5).
   * @param area {left, top, width, height} that labels may use, CSS px.
   */
  update(pose, place, area, { labels, only }, glides) {
    const toScreen = (point) => {
      const pixel = pose.lens.project(toCam(pose.cam_from_model, point));
      return pixel && [place.left + place.scale * (pixel[0] + 0.5), place.top + place.scale * (pixel[1] + 0.5)];
    };
    const picture = {
      left: place.left, top: place.top, right: place.left + place.scale * pose.lens.width,
      bottom: place.top + place.scale * pose.lens.height,
    };
    const wanted = this.inspected.filter((component) => !only || component.name === only);
    this.#drawArrows(wanted, toScreen);
    this.box.style.setProperty("--widest", `${Math.floor((area.width - 6) / 2)}px`);
    const isNarrow = area.width < NARROW_PX, isCramped = area.height < MIN_ROOM_PX && !only;
    if (this.box.classList.contains("narrow") !== isNarrow) {
      this.box.classList.toggle("narrow", isNarrow);
      this.remeasure();
    }
    const maxLabels = isCramped ? 0 : isNarrow ? MAX_NARROW_LABELS : Math.min(MAX_LABELS, Math.floor(area.height / LABEL_ROOM_PX));
    const requests = [], signs = new Map();
    for (const component of labels ? wanted : []) {
      const anchor = toScreen(component.anchor_in_model);
      if (!anchor || !isInside(anchor, picture) || !this.#isLabelled(component)) continue;
      signs.set(component.name, anchor);
      if (requests.length === maxLabels) continue;
      const label = this.#labels.get(component.name);
      if (!label.width) [label.width, label.height] = [label.element.offsetWidth, label.element.offsetHeight];
      requests.push({ key: component.name, width: label.width, height: label.height, x: anchor[0], y: anchor[1] });
    }
    const covered = (left, top, width, height) => this.#covered(place, left, top, width, height);
    const placed = this.#layout.place(area, requests, this.#extent(place, requests), covered, glides);
    const anchors = new Map(requests.map((one) => [one.key, one]));
    const names = new Set(placed.map((one) => one.key));
    const taken = []; // signs must not overlap; the more urgent one stays
    for (const [name, label] of this.#labels) {
      if (!names.has(name)) show(label, false);
      const sign = names.has(name) ? null : signs.get(name);
      if (sign && taken.some((other) => Math.hypot(other[0] - sign[0], other[1] - sign[1]) < SIGN_PX)) {
        label.sign.classList.add("off");
        continue;
      }
      if (sign) taken.push(sign);
      label.sign.classList.toggle("off", !sign);
      if (sign) label.sign.style.transform = `translate(${sign[0].toFixed(1)}px, ${sign[1].toFixed(1)}px)`;
    }
    for (const one of placed) this.#put(one, anchors.get(one.key));
  }

  /** Measure the labels again, after a change of window or font. */
  remeasure() {
    for (const label of this.#labels.values()) label.width = 0;
  }

  #add(component) {
    const value = component.value_text || (component.missing ? "missing" : ""), u = component.uncertainty_mm;
    const isLong = component.verdict !== "pass" && component.detail_text, what = [make("span", "verdict", [component.verdict_text])];
    if (u !== null && !isLong) what.unshift(make("span", "u", [`U ${u.toFixed(2)}`]));
    if (value) what.unshift(make("span", "value", [value]));
    const who = make("span", "who", [icon(component.verdict), make("b", "", [component.name])]);
    const rows = [who, make("span", "what", what)];
    if (isLong) rows.push(make("span", "detail", [component.detail_text]));
    const element = make("button", `label ${component.verdict}`, rows, { tabindex: "-1" });
    element.addEventListener("click", () => this.onPick(component.name));
    const leader = document.createElementNS(SVG, "path"), dot = document.createElementNS(SVG, "circle");
    leader.classList.add("leader", component.verdict);
    dot.classList.add("dot", component.verdict);
    // Where there is no room for the label, its sign is shown on the component.
    const sign = make("button", `sign off ${component.verdict}`, [icon(component.verdict)], { tabindex: "-1" });
    sign.addEventListener("click", () => this.onPick(component.name));
    this.box.append(element, sign);
    this.svg.append(leader, dot);
    const label = { element, leader, dot, sign, width: 0, height: 0, isShown: true };
    show(label, false);
    this.#labels.set(component.name, label);
    const hasArrow = component.displacement_mm && component.distance_mm > (component.uncertainty_mm ?? 0);
    if (component.verdict !== "pass" && hasArrow) {
      const arrow = document.createElementNS(SVG, "path");
      arrow.classList.add("arrow");
      this.svg.append(arrow);
      this.#arrows.set(component.name, arrow);
    }
  }

  /** Whether a component has a label: one that passed only while it is visible, others always. */
  #isLabelled({ index, verdict }) {
    return verdict === "fail" || verdict === "undecided" || !this.#visible || (this.#visible.get(index) ?? 0) > 0;
  }

  /** First and last column of the screen with a component that should not be covered. */
  #extent(place, requests) {
    if (!this.#integral) return { left: Math.min(...requests.map((r) => r.x)), right: Math.max(...requests.map((r) => r.x)) };
    const { columns, rows, integral, window } = this.#integral;
    const bottom = (column) => integral[rows * (columns + 1) + column];
    let first = 0, last = columns;
    while (first < columns && bottom(first + 1) === 0) first += 1;
    while (last > first && bottom(last - 1) === bottom(columns)) last -= 1;
    const x = (column) => place.left + place.scale * (window.left + (column / columns) * window.width);
    return { left: x(first), right: x(last) };
  }

  /** Fraction of a box on the screen that covers components. */
  #covered(place, left, top, width, height) {
    if (!this.#integral) return 0;
    const { columns, rows, integral, window } = this.#integral;
    const column = (x) => clamp(Math.round((((x - place.left) / place.scale - window.left) / window.width) * columns), 0, columns);
    const row = (y) => clamp(Math.round((((y - place.top) / place.scale - window.top) / window.height) * rows), 0, rows);
    const [c0, c1, r0, r1] = [column(left), column(left + width), row(top), row(top + height)], step = columns + 1;
    const sum = integral[r1 * step + c1] - integral[r0 * step + c1] - integral[r1 * step + c0] + integral[r0 * step + c0];
    const cell = (place.scale * window.width) / columns;
    return (sum * cell * cell) / (width * height);
  }

  #put({ key, left, top, side, isNew }, anchor) {
    const label = this.#labels.get(key), { element, leader, dot, width, height } = label;
    element.style.transform = `translate(${left.toFixed(1)}px, ${top.toFixed(1)}px)`;
    if (isNew) {
      element.classList.remove("arrives");
      void element.offsetWidth; // restarts the animation
      element.classList.add("arrives");
    }
    show(label, true);
    const isLeft = side === "left", x = isLeft ? left + width : left, stub = isLeft ? STUB_PX : -STUB_PX;
    let path;
    if ((anchor.x - x - stub) * stub > 0) {
      const y = top + Math.min(height, 34) / 2;
      path = `M${x} ${y}L${x + stub} ${y}L${anchor.x} ${anchor.y}`;
    } else {
      const inside = clamp(anchor.x, left + 6, left + width - 6);
      path = `M${inside} ${anchor.y < top ? top : top + height}L${anchor.x} ${anchor.y}`;
    }
    leader.setAttribute("d", path);
    dot.setAttribute("cx", anchor.x);
    dot.setAttribute("cy", anchor.y);
    dot.setAttribute("r", 4.5);
  }

  #drawArrows(wanted, toScreen) {
    const shown = new Set(wanted.map((one) => one.name));
    for (const component of this.inspected) {
      const arrow = this.#arrows.get(component.name);
      if (!arrow) continue;
      const tail = this.centers[component.index];
      const tip = tail.map((value, k) => value + this.part.arrow_scale * (component.displacement_mm[k] ?? 0));
      const [from, to] = [toScreen(tail), toScreen(tip)];
      const isDrawn = shown.has(component.name) && from && to && Math.hypot(to[0] - from[0], to[1] - from[1]) > 4;
      arrow.setAttribute("visibility", isDrawn ? "visible" : "hidden");
      if (isDrawn) arrow.setAttribute("d", arrowPath(from, to));
    }
  }
}

function arrowPath([x0, y0], [x1, y1]) {
  const length = Math.hypot(x1 - x0, y1 - y0), [ux, uy] = [(x1 - x0) / length, (y1 - y0) / length];
  const head = Math.min(ARROW_HEAD_PX, 0.7 * length), half = 0.55 * head, shaft = 0.18 * head;
  const at = (along, aside) => `${(x0 + along * ux - aside * uy).toFixed(1)} ${(y0 + along * uy + aside * ux).toFixed(1)}`;
  const neck = length - head;
  return `M${at(0, shaft)}L${at(neck, shaft)}L${at(neck, half)}L${at(length, 0)}L${at(neck, -half)}L${at(neck, -shaft)}L${at(0, -shaft)}Z`;
}

function show(label, isShown) {
  if (label.isShown === isShown) return;
  label.isShown = isShown;
  label.element.classList.toggle("off", !isShown);
  for (const line of [label.leader, label.dot]) line.setAttribute("visibility", isShown ? "visible" : "hidden");
}

const clamp = (value, low, high) => Math.max(low, Math.min(value, high));
const isInside = ([x, y], { left, top, right, bottom }) => x >= left && x < right && y >= top && y < bottom;
