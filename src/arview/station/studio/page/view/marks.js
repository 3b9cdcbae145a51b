// Datums, features and the frame, drawn in the 3D view with labels.

import { across, dot, plus, unit } from "../geometry.js";
import { make } from "../dom.js";

const { THREE } = window;

const AXES = [["X", 0xe5484d, [1, 0, 0]], ["Y", 0x3aa655, [0, 1, 0]], ["Z", 0x3b82f6, [0, 0, 1]]];
const DATUM = 0xd97706, OFFERED = 0xff2d9b, ROUND_STEPS = 48;

/** Datum features as outlines with their letter, axes at the frame's origin, and what a click would take. */
export class Marks {
  #labels = [];

  constructor(stage, parent) {
    Object.assign(this, { stage, parent });
    this.group = new THREE.Group();
    this.preview = new THREE.Group();
    stage.extras.add(this.group, this.preview);
    stage.addEventListener("drawn", () => this.#place());
  }

  /** Show the datums and features of a part. */
  show(part) {
    clear(this.group);
    this.#labels.forEach(({ element }) => element.remove());
    this.#labels = [];
    const scale = 0.12 * part.diameter_mm;
    for (const datum of [...part.datums, ...part.features]) {
      const size = Math.min(2 * scale, datum.size_mm ?? scale);
      this.group.add(lines(outlineOf(datum, size), DATUM), this.#face(part, datum, DATUM));
      const lift = plus(datum.point_mm, datum.direction, datum.feature === "plane" ? 0.6 * scale : 0.5 * scale);
      this.#label(lift, datum.label, "datum");
    }
    const origin = originOf(part.datums, part.center_mm);
    for (const [name, color, direction] of AXES) {
      this.group.add(lines([origin, plus(origin, direction, 1.4 * scale)], color));
      this.#label(plus(origin, direction, 1.6 * scale), name, `axis ${name}`);
    }
    this.stage.draw();
  }

  /** Show a feature that is offered, or nothing. */
  offer(part, table, size_mm) {
    clear(this.preview);
    if (table) {
      const datum = { ...table, direction: table.normal ?? table.axis };
      this.preview.add(lines(outlineOf(datum, Math.max(1e-6, size_mm)), OFFERED), this.#face(part, datum, OFFERED));
    }
    this.stage.draw();
  }

  /** The faces of a plane, coloured. */
  #face(part, datum, color) {
    const geometry = new THREE.BufferGeometry(), index = part.components.findIndex((one) => one.name === datum.component);
    const corners = datum.feature === "plane" && index >= 0 ? this.stage.planeOf(index, datum.point_mm, unit(datum.direction)) : [];
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners), 3));
    const material = new THREE.MeshBasicMaterial({ color, transparent: true, opacity: 0.35, side: THREE.DoubleSide, depthWrite: false });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    return mesh;
  }

  #label(point, text, kind) {
    const element = make("span", { class: `mark ${kind}` }, text);
    this.parent.append(element);
    this.#labels.push({ element, point });
  }

  #place() {
    for (const { element, point } of this.#labels) {
      const { x, y, z } = this.stage.project(point);
      element.hidden = z > 1;
      element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -50%)`;
    }
  }
}

/**
 * Where the axes are drawn: the second datum's point brought onto the first one's plane, as in a 3-2-1 system; without
 * datums the model's own origin.
 */
export function originOf(datums) {
  const [first, second] = datums;
  if (!first) return [0, 0, 0];
  if (!second || first.feature !== "plane") return first.point_mm;
  const height = dot(plus(second.point_mm, first.point_mm, -1), first.direction);
  return plus(second.point_mm, first.direction, -height);
}

/** Ends of line segments, point after point, that outline a feature. */
function outlineOf(datum, size) {
  const direction = unit(datum.direction), point = datum.point_mm, [one, other] = across(direction);
  const at = (a, b, c = 0) => plus(plus(plus(point, one, a), other, b), direction, c);
  const ring = (radius, height) => Array.from({ length: ROUND_STEPS }, (_, k) => [k, k + 1]).flat()
    .map((k) => 2 * Math.PI * k / ROUND_STEPS).map((angle) => at(radius * Math.cos(angle), radius * Math.sin(angle), height));
  const half = 0.5 * size;
  if (datum.feature === "plane") {
    const short = 0.2 * half;
    return [at(-short, 0), at(short, 0), at(0, -short), at(0, short), point, at(0, 0, 0.5 * half)];
  }
  if (datum.feature === "edge") return [at(0, 0, -half), at(0, 0, half)];
  if (datum.diameter_mm ?? datum.width_mm) {
    const radius = 0.5 * (datum.diameter_mm ?? datum.width_mm), height = datum.feature === "cylinder" ? half : 0;
    return [...ring(radius, height), ...(height ? ring(radius, -height) : []), at(0, 0, -1.2 * radius - height), at(0, 0, 1.6 * radius + height)];
  }
  return [at(-half, 0), at(half, 0), at(0, -half), at(0, half), point, at(0, 0, half)];
}

/** Lines that are seen through the part. */
function lines(points, color) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points.flat()), 3));
  const object = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color, depthTest: false, transparent: true }));
  object.renderOrder = 5;
  return object;
}

function clear(group) {
  for (const object of [...group.children]) {
    group.remove(object);
    object.geometry.dispose();
    object.material.dispose();
  }
}
