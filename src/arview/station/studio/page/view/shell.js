// The range of viewpoints as a shell around the part, with handles on its borders.

import { anglesOf, directionOf, dot, plus, unit } from "../geometry.js";
import { make } from "../dom.js";

const { THREE } = window;

const STEPS_DEG = 5, FULL_DEG = 359.5, HANDLE_PX = [62, 26];
const BORDERS = [
  ["azimuth_deg", 0, "Least azimuth"], ["azimuth_deg", 1, "Greatest azimuth"],
  ["elevation_deg", 0, "Least elevation"], ["elevation_deg", 1, "Greatest elevation"],
  ["distance_mm", 0, "Least distance"], ["distance_mm", 1, "Greatest distance"],
];

/** Draws a range, and tells of a range that is dragged: onDrag(range) while, onDrop(range) after. */
export class Shell {
  #range = null;
  #isShown = false;
  #canDrag = false;

  constructor(stage, handles, { onDrag, onDrop }) {
    Object.assign(this, { stage, onDrag, onDrop });
    this.group = new THREE.Group();
    stage.extras.add(this.group);
    this.near = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({ color: 0x4aa3ff, transparent: true, opacity: 0.14, side: THREE.DoubleSide, depthWrite: false }));
    this.lines = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0x4aa3ff, transparent: true, opacity: 0.8 }));
    this.group.add(this.near, this.lines);
    this.handles = BORDERS.map(([key, side, label]) => this.#handle(handles, key, side, label));
    stage.addEventListener("drawn", () => this.#place());
  }

  /** Show a range, or none; handles only where it can be dragged. */
  show(range, canDrag) {
    this.#isShown = Boolean(range);
    this.#canDrag = canDrag && this.#isShown;
    if (range) this.#range = range;
    this.group.visible = this.#isShown;
    if (range) this.#build();
    this.stage.extent = this.#isShown ? 1.05 * this.#range.distance_mm[1] : 0;
    this.stage.draw();
  }

  /** Radius at which the dots of views and photos are drawn, mm. */
  get radius() {
    return this.#range?.distance_mm[0] ?? 1;
  }

  #build() {
    const { distance_mm: [near, far], azimuth_deg: [a0, a1], elevation_deg: [e0, e1] } = this.#range;
    const columns = Math.max(1, Math.ceil((a1 - a0) / STEPS_DEG)), rows = Math.max(1, Math.ceil((e1 - e0) / STEPS_DEG));
    const at = (i, j, distance) => this.#point(a0 + (a1 - a0) * i / columns, e0 + (e1 - e0) * j / rows, distance);
    const points = [], corners = [], lines = [];
    for (let j = 0; j <= rows; j++) for (let i = 0; i <= columns; i++) points.push(...at(i, j, near));
    for (let j = 0; j < rows; j++) {
      for (let i = 0; i < columns; i++) {
        const k = j * (columns + 1) + i;
        corners.push(k, k + 1, k + columns + 1, k + 1, k + columns + 2, k + columns + 1);
      }
    }
    const isWhole = a1 - a0 >= FULL_DEG;
    for (const distance of [near, far]) {
      for (const j of [0, rows]) for (let i = 0; i < columns; i++) lines.push(...at(i, j, distance), ...at(i + 1, j, distance));
      for (const i of isWhole ? [] : [0, columns]) for (let j = 0; j < rows; j++) lines.push(...at(i, j, distance), ...at(i, j + 1, distance));
    }
    for (const j of [0, rows]) for (const i of isWhole ? [] : [0, columns]) lines.push(...at(i, j, near), ...at(i, j, far));
    this.near.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points), 3));
    this.near.geometry.setIndex(corners);
    this.lines.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(lines), 3));
    for (const { geometry } of [this.near, this.lines]) geometry.computeBoundingSphere();
  }

  #point(azimuth, elevation, distance) {
    return plus(this.stage.center.toArray(), directionOf(this.stage.up, azimuth, elevation), distance);
  }

  /** Where the handle of a border is. */
  #anchor(key, side) {
    const { distance_mm: [near], azimuth_deg: [a0, a1], elevation_deg: [e0, e1] } = this.#range;
    const middle = [0.5 * (a0 + a1), 0.5 * (e0 + e1)];
    if (key === "distance_mm") return this.#point(...middle, this.#range.distance_mm[side]);
    if (key === "azimuth_deg") return this.#point([a0, a1][side] + (a1 - a0 >= FULL_DEG ? [4, -4][side] : 0), middle[1], near);
    return this.#point(middle[0], [e0, e1][side], near);
  }

  #place() {
    const placed = [];
    for (const { element, key, side } of this.handles) {
      element.hidden = !this.#canDrag;
      if (element.hidden) continue;
      const anchor = this.#anchor(key, side), { x, y, z } = this.stage.project(anchor);
      element.hidden = z > 1 || x < 0 || y < 0 || x > this.stage.width || y > this.stage.height;
      const toEye = unit(plus(this.stage.camera.position.toArray(), this.stage.center.toArray(), -1));
      const isBehind = dot(toEye, unit(plus(anchor, this.stage.center.toArray(), -1))) < -0.1;
      element.classList.toggle("behind", isBehind);
      const free = element.hidden ? y : freeHeight(placed, x, y);
      if (!element.hidden) placed.push([x, free]);
      element.style.transform = `translate(${x.toFixed(1)}px, ${free.toFixed(1)}px) translate(-50%, -50%)`;
      const unitText = key === "distance_mm" ? " mm" : "°", text = `${Math.round(this.#range[key][side])}${unitText}`;
      element.querySelector("span").textContent = text;
      element.setAttribute("aria-valuenow", Math.round(this.#range[key][side]));
      element.setAttribute("aria-valuetext", text);
    }
  }

  #handle(parent, key, side, label) {
    const element = make("button", { class: `handle ${key}`, role: "slider", "aria-label": label, title: `${label}: drag, or arrow keys`, type: "button" }, make("span"));
    parent.append(element);
    let isDragged = false;
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      isDragged = true;
      element.setPointerCapture(event.pointerId);
      event.preventDefault();
      element.focus();
    });
    element.addEventListener("pointermove", (event) => {
      if (!isDragged) return;
      const { left, top } = this.stage.canvas.getBoundingClientRect();
      this.#move(key, side, this.#valueAt(key, side, event.clientX - left, event.clientY - top));
      this.onDrag(this.#range);
    });
    const drop = () => {
      if (isDragged) this.onDrop(this.#range);
      isDragged = false;
    };
    element.addEventListener("pointerup", drop);
    element.addEventListener("pointercancel", drop);
    element.addEventListener("keydown", (event) => {
      const sign = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1 }[event.key];
      if (!sign) return;
      event.preventDefault();
      const step = key === "distance_mm" ? Math.max(1, Math.round(0.02 * this.#range.distance_mm[0])) : 1;
      this.#move(key, side, this.#range[key][side] + sign * step);
      this.onDrop(this.#range);
    });
    return { element, key, side };
  }

  /** The value of a border where the pointer is. */
  #valueAt(key, side, x, y) {
    const { origin, direction } = this.stage.ray(x, y), center = this.stage.center.toArray(), from = plus(origin, center, -1);
    if (key === "distance_mm") {
      const axis = unit(plus(this.#anchor(key, side), center, -1)), b = dot(axis, direction);
      return (dot(from, axis) - b * dot(from, direction)) / Math.max(1e-3, 1 - b * b); // nearest point of two lines
    }
    const along = -dot(from, direction), nearest = plus(from, direction, along), miss = dot(nearest, nearest);
    const half = Math.sqrt(Math.max(0, this.radius ** 2 - miss));
    const anchor = plus(this.#anchor(key, side), center, -1);
    const [found] = [-half, half].map((step) => plus(nearest, direction, step))
      .sort((one, other) => dist(one, anchor) - dist(other, anchor));
    const [azimuth, elevation] = anglesOf(this.stage.up, found);
    if (key === "elevation_deg") return elevation;
    const before = this.#range.azimuth_deg[side];
    return before + ((azimuth - before + 540) % 360 + 360) % 360 - 180;
  }

  #move(key, side, value) {
    const values = [...this.#range[key]], least = key === "distance_mm" ? 0.02 * values[0] : 1;
    let moved = Math.round(value);
    if (key === "elevation_deg") moved = Math.max(-90, Math.min(90, moved));
    moved = side ? Math.max(moved, Math.ceil(values[0] + least)) : Math.min(moved, Math.floor(values[1] - least));
    if (key === "distance_mm") moved = Math.max(1, moved);
    if (key === "azimuth_deg") moved = side ? Math.min(moved, values[0] + 360) : Math.max(moved, values[1] - 360);
    values[side] = moved;
    this.#range = { ...this.#range, [key]: values };
    this.#build();
    this.stage.extent = 1.05 * this.#range.distance_mm[1];
    this.stage.draw();
  }
}

/** The height at which a handle covers none of those that are placed already: further down where it would. */
function freeHeight(placed, x, y) {
  for (const [left, top] of [...placed].sort((one, other) => one[1] - other[1])) {
    if (Math.abs(left - x) < HANDLE_PX[0] && Math.abs(top - y) < HANDLE_PX[1]) y = top + HANDLE_PX[1];
  }
  return y;
}

const dist = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
