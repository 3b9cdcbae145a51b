// HTML labels beside the parts with leader lines, and displacement arrows, drawn over the picture. The labels of all parts
// are laid out together.

import { icon, make } from "../icons.js";
import { rounded } from "../rounding.js";
import { LabelLayout } from "./layout.js";
import { toCam } from "./projection.js";
import { t } from "../texts/texts.js";

const MAX_LABELS = 12;
const NARROW_PX = 560, MAX_NARROW_LABELS = 4; // on a phone in portrait more labels would hide the part
const MAX_NARROW_SHARE = 0.25; // of the area for labels, which is hardly more than the picture while a panel is open
const MAX_HIDDEN = 0.06; // share of the visible cells of failed components that a label may cover
const LABEL_ROOM_PX = 55; // height of the area for each label
const MIN_ROOM_PX = 200; // in a lower area only an isolated component has a label
const CONTEXT_WEIGHT = 0.25; // cost of covering a component that was not inspected, relative to an inspected one
const REFUTED = ["missing", "displaced", "wrong", "next"]; // evidence that a component is not at its nominal place
const TAIL_LETTERS = 6; // end of a name that is never cut
const EDGE_PX = 22; // distance of the tail of an arrow at the border of the picture
const OUTSIDE = 1.3; // distance from the middle, relative to the border, of a point that stands for one behind the camera
const SVG = "http://www.w3.org/2000/svg";
const STUB_PX = 10, SIGN_PX = 26, ARROW_HEAD_PX = 11, FAR_PX = 1e6;

export class Labels {
  #layout = new LabelLayout();
  #labels = new Map(); // number of the component → {element, leader, dot, sign, pointer, width, height, isShown, key}
  #arrows = new Map();
  #integral = null;
  #visible = null;

  /** @param onPick called with name and part of a component whose label was pressed. */
  constructor(box, svg, onPick) {
    Object.assign(this, { box, svg, onPick });
    this.parts = [];
    this.tags = []; // names of the parts at their centres, where there are several
    this.banner = make("div", "banner", [], { role: "alert" });
    this.legend = make("div", "legend");
    this.banner.hidden = this.legend.hidden = true;
    box.append(this.banner, this.legend);
  }

  /** Set the parts; all labels are created again. The components of all of them are numbered through. */
  setParts(parts, centersInModel) {
    this.parts = parts;
    this.centers = centersInModel;
    this.clear();
    for (const label of this.#labels.values()) {
      [label.element, label.leader, label.dot, label.sign, label.pointer].forEach((one) => one.remove());
    }
    for (const arrow of this.#arrows.values()) arrow.remove();
    this.#labels.clear();
    this.#arrows.clear();
    this.all = parts.flatMap((part) => part.components.map((component) => ({ ...component, part: part.id })));
    this.all.forEach((component, index) => { component.index = index; });
    for (const component of this.all) this.#add(component);
    for (const tag of this.tags) tag.remove();
    this.tags = parts.length > 1 ? parts.map(tagOf) : [];
    this.box.prepend(...this.tags);
    this.setEvidence({ labels: new Map(), withheld: [], legend: [] });
  }

  /** Set what the pictures say: {labels: by the number of the component, withheld: by part, legend}, see Pose in the protocol. */
  setEvidence({ labels, withheld, legend }) {
    const rank = (component) => component.rank ?? Infinity;
    const isRefuted = (component) => REFUTED.includes(labels.get(component.index)?.evidence);
    this.seen = labels;
    this.withheld = withheld;
    // Of several parts the urgent components come first, the others in turns, so that each part gets its share of the room.
    const isLater = (component) => this.parts.length > 1 && !this.#isUrgent(component);
    this.inspected = this.all.filter((component) => component.rank !== null || isRefuted(component))
      .sort((a, b) => isRefuted(b) - isRefuted(a) || isLater(a) - isLater(b) || rank(a) - rank(b));
    for (const component of this.all) this.#fill(component);
    const reasons = withheld.flatMap((one, id) => (one ? [[id, one]] : []));
    this.banner.hidden = !reasons.length;
    this.banner.replaceChildren(...reasons.map(([id, { title, text }]) => {
      return make("div", "", [make("b", "", [...this.#mark(id), title]), make("span", "", [text])]);
    }));
    this.legend.hidden = !legend.length;
    this.legend.replaceChildren(...legend.map(({ kind, text }) => make("span", "", [make("i", `swatch ${kind}`), text])));
  }

  /** Set the map of visible components (see Ghost.visibility). */
  setVisibility({ columns, rows, cells, window }) {
    const integral = new Float64Array((columns + 1) * (rows + 1)), counts = new Map(), urgent = [];
    for (let row = 0; row < rows; row++) {
      let sum = 0;
      for (let column = 0; column < columns; column++) {
        const number = cells[row * columns + column];
        if (number) {
          counts.set(number - 1, (counts.get(number - 1) ?? 0) + 1);
          if (this.all[number - 1] && this.#isUrgent(this.all[number - 1])) urgent.push([column, row]);
          sum += this.all[number - 1]?.rank === null ? CONTEXT_WEIGHT : 1;
        }
        integral[(row + 1) * (columns + 1) + column + 1] = integral[row * (columns + 1) + column + 1] + sum;
      }
    }
    this.#integral = { columns, rows, integral, window, urgent };
    this.#visible = counts;
  }

  /** Remove all labels from the picture. */
  clear() {
    this.#layout.reset();
    this.#visible = this.#integral = null;
    this.hide();
  }

  hide() {
    this.box.classList.add("empty");
    for (const label of this.#labels.values()) {
      show(label, false);
      label.sign.classList.add("off");
      label.pointer.setAttribute("visibility", "hidden");
    }
    for (const arrow of this.#arrows.values()) arrow.setAttribute("visibility", "hidden");
  }

  /**
   * Place labels and arrows for the poses of a frame.
   * @param place {left, top, scale} position of the picture on the stage: CSS px = left + scale * (u + 0.5).
   * @param area {left, top, width, height} that labels may use, CSS px.
   * @param seen {left, top, right, bottom}: the piece of the picture that is in view, CSS px.
   */
  update(pose, place, area, { labels, only, only_part }, glides, seen) {
    const toScreen = (part, point) => {
      const { cam_from_model } = pose.parts[part], pixel = cam_from_model && pose.lens.project(toCam(cam_from_model, point));
      return pixel && [place.left + place.scale * (pixel[0] + 0.5), place.top + place.scale * (pixel[1] + 0.5)];
    };
    const picture = seen;
    this.box.classList.remove("empty");
    const wanted = this.inspected.filter(({ name, part }) => !this.withheld[part] && (!only || (name === only && part === only_part)));
    const tags = this.#putTags(toScreen, picture);
    this.#drawArrows(wanted.filter(({ index }) => !this.seen.has(index)), toScreen);
    this.banner.style.top = `${Math.max(area.top, picture.top) + 8}px`;
    if (!this.legend.hidden) {
      this.legend.style.left = `${area.left}px`;
      this.legend.style.maxWidth = `${area.width}px`;
      this.legend.style.top = `${area.top + area.height - this.legend.offsetHeight}px`;
      area = { ...area, height: Math.max(1, area.height - this.legend.offsetHeight - 6) };
    }
    this.box.style.setProperty("--widest", `${Math.floor((area.width - 6) / 2)}px`);
    const isNarrow = area.width < NARROW_PX, isCramped = area.height < MIN_ROOM_PX && !only;
    if (this.box.classList.contains("narrow") !== isNarrow) {
      this.box.classList.toggle("narrow", isNarrow);
      this.remeasure();
    }
    const maxLabels = isCramped ? 0 : isNarrow ? MAX_NARROW_LABELS : Math.min(MAX_LABELS, Math.floor(area.height / LABEL_ROOM_PX));
    const requests = [], signs = new Map(), roomPx = isNarrow ? MAX_NARROW_SHARE * area.width * area.height : Infinity;
    const away = new Set(); // out of view: without its label nothing would say so
    let usedPx = 0;
    for (const label of this.#labels.values()) label.pointer.setAttribute("visibility", "hidden");
    for (const component of labels ? wanted : []) {
      let anchor = toScreen(component.part, component.anchor_in_model) ?? this.#behind(pose, component, picture);
      const label = this.#labels.get(component.index), outside = anchor && !isInside(anchor, picture) && this.#isUrgent(component);
      if (outside) anchor = this.#pointOut(label, anchor, picture);
      this.#pointHere(label, component, outside, toScreen);
      if (!anchor || !isInside(anchor, picture) || !this.#isLabelled(component)) continue;
      if (outside) away.add(component.index);
      else signs.set(component.index, anchor);
      if (requests.length === maxLabels) continue;
      if (!label.width) [label.width, label.height] = [label.element.offsetWidth, label.element.offsetHeight];
      if (usedPx + label.width * label.height > roomPx && !only) continue; // its sign stays
      usedPx += label.width * label.height;
      requests.push({ key: component.index, width: label.width, height: label.height, x: anchor[0], y: anchor[1] });
    }
    const covered = (left, top, width, height) => this.#covered(place, left, top, width, height);
    const laid = this.#layout.place(area, requests, this.#extent(place, requests), covered, glides);
    const placed = laid.filter(({ key, left, top }) => away.has(key) || this.#hiddenBy(place, left, top, this.#labels.get(key)) <= MAX_HIDDEN);
    const anchors = new Map(requests.map((one) => [one.key, one]));
    const names = new Set(placed.map((one) => one.key));
    const boxes = placed.map(({ key, left, top }) => grown(left, top, this.#labels.get(key)));
    const taken = []; // signs must not overlap; the more urgent one stays
    for (const [index, label] of this.#labels) {
      if (!names.has(index)) show(label, false);
      let sign = names.has(index) ? null : signs.get(index);
      // A sign must not hide the digits of a label: an urgent one is moved beside it.
      if (sign && this.#isUrgent(this.all[index])) sign = pushedOut(sign, boxes);
      const isOnTag = sign && !this.#isUrgent(this.all[index]) && [...tags, ...boxes].some((box) => isInside(sign, box));
      if (isOnTag || (sign && taken.some((other) => Math.hypot(other[0] - sign[0], other[1] - sign[1]) < SIGN_PX))) {
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
    const element = make("button", "label", [], { tabindex: "-1" });
    element.addEventListener("click", () => this.onPick(component.name, component.part));
    const [leader, dot, pointer] = ["path", "circle", "path"].map((tag) => document.createElementNS(SVG, tag));
    // Where there is no room for the label, its sign is shown on the component.
    const sign = make("button", "sign off", [], { tabindex: "-1" });
    sign.addEventListener("click", () => this.onPick(component.name, component.part));
    this.box.append(element, sign);
    this.svg.append(leader, dot, pointer);
    const label = { element, leader, dot, sign, pointer, width: 0, height: 0, isShown: true, key: null };
    show(label, false);
    this.#labels.set(component.index, label);
    const hasArrow = component.displacement_mm && component.distance_mm > (component.uncertainty_mm ?? 0);
    if (component.verdict !== "pass" && hasArrow) {
      const arrow = document.createElementNS(SVG, "path");
      arrow.classList.add("arrow");
      this.svg.append(arrow);
      this.#arrows.set(component.index, arrow);
    }
  }

  /** Write the texts of a label: those of the inspection, or what the pictures say instead. */
  #fill(component) {
    const seen = this.seen.get(component.index), label = this.#labels.get(component.index), key = JSON.stringify(seen ?? null);
    if (label.key === key) return;
    label.key = key;
    label.width = 0;
    const kind = REFUTED.includes(seen?.evidence) ? seen.evidence : component.verdict ?? "none";
    const isPending = component.is_pending && seen?.evidence !== "displaced";
    const value = isPending ? t("parts.measuring") : seen ? seen.value : component.value_text || (component.missing ? t("parts.missing") : "");
    const u = kind === component.verdict ? component.uncertainty_mm : null;
    const detail = seen ? seen.notes.join(", ") : component.verdict !== "pass" ? whole(component.detail_text) : "";
    const what = [make("span", "verdict", [seen?.word ?? (component.verdict ? t(`verdict.${component.verdict}`) : component.verdict_text ?? "")])];
    if (u !== null && (seen || !detail)) what.unshift(make("span", "u", [`U ${rounded(u, u)}`]));
    if (value) what.unshift(make("span", "value", [value]));
    const rows = [make("span", "who", [...this.#mark(component.part), icon(kind), middled(component.name)]), make("span", "what", what)];
    if (detail) rows.push(make("span", "detail", [detail]));
    label.element.replaceChildren(...rows);
    label.sign.replaceChildren(icon(kind));
    for (const [element, name] of [[label.element, "label"], [label.leader, "leader"], [label.dot, "dot"], [label.sign, "sign"], [label.pointer, "pointer"]]) {
      for (const one of [...element.classList]) if (!["off", "arrives"].includes(one)) element.classList.remove(one);
      element.classList.add(name, kind);
      element.classList.toggle("dimmed", Boolean(seen?.is_dimmed));
      if (seen) element.style.setProperty("--tone", seen.color);
      else element.style.removeProperty("--tone");
    }
  }

  #isUrgent({ index, verdict }) {
    return this.seen.get(index)?.is_urgent ?? (verdict === "fail" || verdict === "undecided");
  }

  /** A point outside the picture in the direction of an urgent component that the lens does not see, because it is behind it or far aside. */
  #behind(pose, component, { left, top, right, bottom }) {
    const { cam_from_model } = pose.parts[component.part];
    if (!cam_from_model || !this.#isUrgent(component)) return null;
    const [x, y] = toCam(cam_from_model, component.anchor_in_model), half = [(right - left) / 2, (bottom - top) / 2];
    const reach = OUTSIDE * Math.min(half[0] / Math.max(Math.abs(x), 1e-6), half[1] / Math.max(Math.abs(y), 1e-6));
    return [left + half[0] + reach * x, top + half[1] + reach * y];
  }

  /** Arrow at the border of the picture towards an anchor outside; returns its tail. */
  #pointOut(label, [x, y], { left, top, right, bottom }) {
    const tail = [clamp(x, left + EDGE_PX, right - EDGE_PX), clamp(y, top + EDGE_PX, bottom - EDGE_PX)];
    const length = Math.hypot(x - tail[0], y - tail[1]) || 1;
    const tip = [0, 1].map((k) => tail[k] + (0.85 * EDGE_PX * ([x, y][k] - tail[k])) / length);
    label.pointer.setAttribute("visibility", "visible");
    label.pointer.setAttribute("d", arrowPath(tail, tip));
    return tail;
  }

  /** Arrow from the nominal place of a displaced component to where it is seen. */
  #pointHere(label, { index, part }, outside, toScreen) {
    const place = this.seen.get(index)?.model_from_nominal;
    if (outside || !place) return;
    const [from, to] = [this.centers[index], toCam(place, this.centers[index])].map((point) => toScreen(part, point));
    if (!from || !to || Math.hypot(to[0] - from[0], to[1] - from[1]) < 4) return;
    label.pointer.setAttribute("visibility", "visible");
    label.pointer.setAttribute("d", arrowPath(from, to));
  }

  /** Whether a component has a label: one that passed only while it is visible, others always. */
  #isLabelled(component) {
    return this.#isUrgent(component) || !this.#visible || (this.#visible.get(component.index) ?? 0) > 0;
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

  /** Share of the visible cells of failed and undecided components that a label would hide. */
  #hiddenBy(place, left, top, { width, height }) {
    if (!this.#integral?.urgent.length) return 0;
    const { columns, rows, window, urgent } = this.#integral;
    const column = (x) => (((x - place.left) / place.scale - window.left) / window.width) * columns;
    const row = (y) => (((y - place.top) / place.scale - window.top) / window.height) * rows;
    const [c0, c1, r0, r1] = [column(left), column(left + width), row(top), row(top + height)];
    return urgent.filter(([c, r]) => c + 0.5 > c0 && c + 0.5 < c1 && r + 0.5 > r0 && r + 0.5 < r1).length / urgent.length;
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

  /** The mark of a part in its colour, where there are several. */
  #mark(id) {
    if (this.parts.length < 2) return [];
    const made = make("span", "mark", [this.parts[id].mark]);
    made.style.color = this.parts[id].tag_color;
    return [made];
  }

  /**
   * Put the names of several parts at their centres; where they would overlap, the later one stands below.
   * @returns the boxes in which signs would cover them.
   */
  #putTags(toScreen, { left, top, right, bottom }) {
    const taken = [];
    for (const [id, tag] of this.tags.entries()) {
      const center = toScreen(id, this.parts[id].part.center_in_model);
      tag.classList.toggle("off", !center);
      if (!center) continue;
      const width = tag.offsetWidth, height = tag.offsetHeight;
      const x = clamp(center[0] - width / 2, left, Math.max(left, right - width));
      let y = clamp(center[1] - height / 2, top, Math.max(top, bottom - height));
      for (const one of taken) if (Math.abs(one.x - x) < Math.max(one.width, width) && Math.abs(one.y - y) < height) y = one.y + height + 2;
      taken.push({ x, y, width, height });
      tag.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
    return taken.map(({ x, y, ...size }) => grown(x, y, size));
  }

  #drawArrows(wanted, toScreen) {
    const shown = new Set(wanted.map((one) => one.index));
    for (const component of this.inspected) {
      const arrow = this.#arrows.get(component.index);
      if (!arrow) continue;
      const tail = this.centers[component.index];
      const tip = tail.map((value, k) => value + this.parts[component.part].arrow_scale * (component.displacement_mm[k] ?? 0));
      const [from, to] = [toScreen(component.part, tail), toScreen(component.part, tip)];
      const isDrawn = shown.has(component.index) && from && to && Math.hypot(to[0] - from[0], to[1] - from[1]) > 4;
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

/** Numbers with their names, which are never broken between the two. */
const whole = (text) => text.split(/ {2,}/).map((one) => one.replaceAll(" ", "\u00a0")).join("  ");

/** A name whose end stays whole where it is too long, so that it is shortened in its middle. */
function middled(name) {
  const letters = [...name], kept = Math.min(TAIL_LETTERS, letters.length >> 1);
  return make("b", "", [make("span", "", [letters.slice(0, letters.length - kept).join("")]), make("span", "", [letters.slice(letters.length - kept).join("")])]);
}

/** The box in which the middle of a sign would make it cover a label. */
function grown(left, top, { width, height }) {
  const reach = SIGN_PX / 2;
  return { left: left - reach, top: top - reach, right: left + width + reach, bottom: top + height + reach };
}

/** The nearest point that is in none of the boxes; one out of a box may be in the next, so that every way out is tried. */
function pushedOut(point, boxes, depth = 3) {
  const box = boxes.find((one) => isInside(point, one));
  if (!box || depth === 0) return point;
  const [x, y] = point;
  const ways = [[box.left - 0.5, y], [box.right + 0.5, y], [x, box.top - 0.5], [x, box.bottom + 0.5]];
  const isFree = (one) => !boxes.some((other) => isInside(one, other));
  const far = (one) => Math.hypot(one[0] - x, one[1] - y) + (isFree(one) ? 0 : FAR_PX);
  return ways.map((way) => pushedOut(way, boxes, depth - 1)).reduce((best, one) => (far(one) < far(best) ? one : best));
}

/** The tag with mark and name of a part. */
function tagOf({ mark, name, tag_color }) {
  const tag = make("span", "tag off", [`${mark} ${name}`]);
  tag.style.color = tag_color;
  return tag;
}

function show(label, isShown) {
  if (label.isShown === isShown) return;
  label.isShown = isShown;
  label.element.classList.toggle("off", !isShown);
  for (const line of [label.leader, label.dot]) line.setAttribute("visibility", isShown ? "visible" : "hidden");
}

const clamp = (value, low, high) => Math.max(low, Math.min(value, high));
const isInside = ([x, y], { left, top, right, bottom }) => x >= left && x < right && y >= top && y < bottom;
