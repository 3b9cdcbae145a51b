// Guide views and photos as signs on the shell, drawn on a canvas over the 3D view.

import { dot, plus, unit } from "../geometry.js";

const SIZE_PX = 5, REACH_PX = 9;

/** Signs: a disc for a view that is fine, a triangle for a plain one, a square for one that is confused, a camera for a photo. */
export class Dots {
  #rows = [];
  #radius = 1;
  #marked = null;

  /** onHover(index or null, x, y) and onChoose(index) tell of a sign under the pointer. */
  constructor(stage, canvas, { onHover, onChoose }) {
    Object.assign(this, { stage, canvas });
    stage.addEventListener("drawn", () => this.#draw());
    let last = null;
    stage.canvas.addEventListener("pointermove", (event) => {
      const { left, top } = canvas.getBoundingClientRect(), [x, y] = [event.clientX - left, event.clientY - top];
      const index = event.buttons ? null : this.at(x, y);
      if (index === last) return;
      last = index;
      onHover(index, x, y);
    });
    stage.canvas.addEventListener("pointerleave", () => onHover(null));
    stage.addEventListener("click", ({ detail }) => {
      const index = this.at(detail.x, detail.y);
      if (index === null) return;
      detail.isTaken = true;
      onChoose(index);
    });
  }

  /** Show signs: [{direction, sign: "" | "plain" | "alike" | "photo", label}] at a radius, mm. */
  show(rows, radius) {
    [this.#rows, this.#radius] = [rows, radius];
    this.stage.draw();
  }

  mark(index) {
    this.#marked = index;
    this.stage.draw();
  }

  /** Index of the sign at a place, or null; those behind the part do not count. */
  at(x, y) {
    let [best, nearest] = [null, REACH_PX];
    for (const { index, place, isBehind } of this.#places ?? []) {
      const distance = Math.hypot(place.x - x, place.y - y);
      if (!isBehind && distance < nearest) [best, nearest] = [index, distance];
    }
    return best;
  }

  #draw() {
    const { stage, canvas } = this, scale = Math.min(2, window.devicePixelRatio);
    if (canvas.width !== Math.round(scale * stage.width)) canvas.width = Math.round(scale * stage.width);
    if (canvas.height !== Math.round(scale * stage.height)) canvas.height = Math.round(scale * stage.height);
    const context = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.clearRect(0, 0, stage.width, stage.height);
    const center = stage.center.toArray(), toEye = unit(plus(stage.camera.position.toArray(), center, -1));
    this.#places = this.#rows.map((row, index) => ({
      index, row, place: stage.project(plus(center, row.direction, this.#radius)), isBehind: dot(row.direction, toEye) < 0,
    })).filter(({ place }) => place.z < 1).sort((a, b) => b.place.z - a.place.z);
    for (const { index, row, place, isBehind } of this.#places) {
      const tone = { plain: "--fail", alike: "--undecided", photo: "--blue" }[row.sign] ?? "--pass";
      context.globalAlpha = isBehind ? 0.3 : 1;
      context.fillStyle = style.getPropertyValue(tone);
      context.strokeStyle = style.getPropertyValue("--ink");
      context.lineWidth = 1.2;
      const size = index === this.#marked ? 1.8 * SIZE_PX : SIZE_PX;
      context.beginPath();
      outline(context, row.sign, place.x, place.y, size);
      context.fill();
      context.stroke();
      if (index !== this.#marked) continue;
      context.globalAlpha = 1;
      context.strokeStyle = style.getPropertyValue("--text");
      context.lineWidth = 2;
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  #places = [];
}

function outline(context, sign, x, y, size) {
  if (sign === "plain") {
    context.moveTo(x, y - 1.3 * size);
    context.lineTo(x + 1.2 * size, y + 0.9 * size);
    context.lineTo(x - 1.2 * size, y + 0.9 * size);
    context.closePath();
  } else if (sign === "alike") context.rect(x - size, y - size, 2 * size, 2 * size);
  else if (sign === "photo") {
    context.rect(x - 1.3 * size, y - 0.8 * size, 2.6 * size, 1.8 * size);
    context.rect(x - 0.5 * size, y - 1.4 * size, size, 0.6 * size);
  } else context.arc(x, y, size, 0, 2 * Math.PI);
}
