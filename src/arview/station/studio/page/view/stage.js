// The 3D view: camera, levels of detail, picking. What is drawn over it listens to "drawn".

import { directionOf, upOf } from "../geometry.js";
import { Level } from "./level.js";
import { MeshData } from "./mesh.js";

const { THREE } = window;

const LIGHT_FACES = 250_000; // drawn in full while dragging; more are drawn coarser then
const CLICK_PX = 4, FIT = 1.25, FIELD_DEG = 35;
const LOOKS = { iso: [-55, 32], front: [-90, 0], back: [90, 0], left: [180, 0], right: [0, 0], top: [-90, 89.9], bottom: [-90, -89.9] };

/** Events: "drawn", "click" ({hit, x, y}), "hover" (index or null), "drag" (begins). */
export class Stage extends EventTarget {
  isOpen = () => true;
  #levels = { coarse: null, full: null };
  #isAsked = false;
  #isDragged = false;
  #shown = { hexes: [], solid: [], ghost: [], selected: [], hovered: null };

  constructor(canvas) {
    super();
    this.canvas = canvas;
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: "high-performance" });
      this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    } catch {
      this.renderer = null; // without WebGL the part is not drawn; labels, dots and clicks work all the same
    }
    this.scene = new THREE.Scene();
    this.extras = new THREE.Group();
    this.camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 1, 1e5);
    this.camera.add(this.#lamp(-0.4, 0.7, 1, 1.9));
    this.scene.add(this.camera, this.extras, new THREE.HemisphereLight(0xffffff, 0x8a93a5, 1.6));
    this.center = new THREE.Vector3();
    this.radius = 100;
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#listen();
  }

  /** Set where the part is, and which axis is up; the camera is placed anew where either changed. */
  frame(center, radius, up) {
    const key = JSON.stringify([center, radius, up]);
    if (key === this.frameKey) return;
    this.frameKey = key;
    [this.up, this.radius] = [up, radius];
    this.center.set(...center);
    this.camera.up.set(...upOf(up));
    this.controls?.dispose();
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    this.controls.zoomToCursor = true;
    this.controls.rotateSpeed = 0.9;
    this.controls.addEventListener("start", () => this.#drag(true));
    this.controls.addEventListener("end", () => this.#drag(false));
    this.controls.addEventListener("change", () => this.draw());
    this.look("iso");
  }

  /** Take the binary of the mesh. A full one replaces the coarse one unless it is large. */
  setMesh(buffer) {
    const data = new MeshData(buffer), name = data.isCoarse ? "coarse" : "full";
    this.clearMesh(name);
    this.#levels[name] = new Level(data);
    this.scene.add(this.#levels[name].group);
    this.#apply(this.#levels[name]);
    this.draw();
  }

  clearMesh(name) {
    const level = this.#levels[name];
    if (!level) return;
    this.scene.remove(level.group);
    level.dispose();
    this.#levels[name] = null;
  }

  /** What is shown how: {hexes, solid, ghost, selected, hovered}, components by index; what is left out stays. */
  show(changes) {
    const same = (key) => JSON.stringify(changes[key] ?? this.#shown[key]) === JSON.stringify(this.#shown[key]);
    const stays = { hexes: same("hexes"), layers: same("solid") && same("ghost") };
    Object.assign(this.#shown, changes);
    for (const level of Object.values(this.#levels)) if (level) this.#apply(level, stays);
    this.draw();
  }

  /** Look from an azimuth and elevation, or at everything from where the camera is ("fit"). */
  look(name, reach = this.radius) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (LOOKS[name]) {
      offset.set(...directionOf(this.up, ...LOOKS[name]));
    }
    const half = Math.min(1, this.camera.aspect) * Math.tan(FIELD_DEG * Math.PI / 360);
    offset.setLength(FIT * reach / Math.sin(Math.atan(half)));
    this.controls.target.copy(this.center);
    this.camera.position.copy(this.center).add(offset);
    this.controls.update();
    this.draw();
  }

  /** Keep the direction of view, and stand so far off that a sphere of a radius about the part is seen. */
  reach(radius) {
    this.look("fit", radius);
  }

  /** Draw soon; calls are gathered. */
  draw() {
    if (this.#isAsked) return;
    this.#isAsked = true;
    requestAnimationFrame(() => {
      this.#isAsked = false;
      this.#render();
    });
  }

  /** Place on the page, px, of a point in the model; z > 1 is behind the camera. */
  project(point) {
    const { x, y, z } = new THREE.Vector3(...point).project(this.camera);
    return { x: 0.5 * (1 + x) * this.width, y: 0.5 * (1 - y) * this.height, z };
  }

  /** Ray through a place on the page. */
  ray(x, y) {
    const end = new THREE.Vector3(2 * x / this.width - 1, 1 - 2 * y / this.height, 0.5).unproject(this.camera);
    const origin = this.camera.position.clone();
    return { origin: origin.toArray(), direction: end.sub(origin).normalize().toArray() };
  }

  /** What is at a place on the page; `isExact` asks for the faces of the full mesh. */
  hit(x, y, isExact) {
    const { full, coarse } = this.#levels, level = isExact ? full : coarse ?? full;
    if (!level) return null;
    const { origin, direction } = this.ray(x, y);
    return level.data.hit(origin, direction, this.isOpen);
  }

  /** Corners of a component's faces in a plane, or none while the full mesh is not there. */
  planeOf(index, point, normal) {
    return this.#levels.full?.data.planeOf(index, point, normal) ?? [];
  }

  get isComplete() {
    return this.#levels.full !== null;
  }

  #apply(level, stays = {}) {
    if (!stays.hexes && this.#shown.hexes.length) level.paint(this.#shown.hexes);
    if (!stays.layers) level.show(this.#shown.solid, this.#shown.ghost);
    level.select(this.#shown.selected);
    level.hover(this.#shown.hovered);
  }

  #lamp(x, y, z, strength) {
    const lamp = new THREE.DirectionalLight(0xffffff, strength);
    lamp.position.set(x, y, z);
    this.camera.add(lamp.target);
    return lamp;
  }

  #resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    if (!clientWidth || !clientHeight) return;
    [this.width, this.height] = [clientWidth, clientHeight];
    this.renderer?.setSize(clientWidth, clientHeight);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.#render();
  }

  #render() {
    if (!this.controls || !this.width) return;
    const { full, coarse } = this.#levels;
    const isHeavy = full && coarse && full.data.faceCount > LIGHT_FACES;
    const active = isHeavy && this.#isDragged ? coarse : full ?? coarse;
    for (const level of [full, coarse]) if (level) level.group.visible = level === active;
    const distance = this.camera.position.distanceTo(this.center), span = 1.2 * Math.max(this.radius, this.extent ?? 0);
    this.camera.near = Math.max(1e-3 * this.radius, distance - span);
    this.camera.far = distance + span;
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
    this.renderer?.render(this.scene, this.camera);
    const clip_from_model = new THREE.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse).toArray();
    this.dispatchEvent(new CustomEvent("drawn", { detail: { level: active?.data.isCoarse ? "coarse" : active ? "full" : "none", clip_from_model } }));
  }

  #drag(isDragged) {
    this.#isDragged = isDragged;
    if (isDragged) this.dispatchEvent(new CustomEvent("drag"));
    this.draw();
  }

  #listen() {
    const { canvas } = this;
    let pressed = null;
    const place = (event) => {
      const { left, top } = canvas.getBoundingClientRect();
      return [event.clientX - left, event.clientY - top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      pressed = event.button === 0 ? place(event) : null;
    });
    canvas.addEventListener("pointerup", (event) => {
      const [x, y] = place(event);
      if (!pressed || Math.hypot(x - pressed[0], y - pressed[1]) > CLICK_PX) return;
      this.dispatchEvent(new CustomEvent("click", { detail: { hit: this.hit(x, y, true), x, y, event } }));
    });
    let next = null;
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) return;
      if (!next) requestAnimationFrame(() => {
        const [x, y] = next;
        next = null;
        this.dispatchEvent(new CustomEvent("hover", { detail: { index: this.hit(x, y, false)?.component ?? null, x, y } }));
      });
      next = place(event);
    });
    canvas.addEventListener("pointerleave", () => this.dispatchEvent(new CustomEvent("hover", { detail: { index: null } })));
    canvas.addEventListener("keydown", (event) => this.#turn(event));
  }

  /** Arrow keys turn, + and - zoom. */
  #turn(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }, step = steps[event.key];
    const zoom = { "+": 0.85, "=": 0.85, "-": 1 / 0.85 }[event.key];
    if ((!step && !zoom) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (zoom) offset.multiplyScalar(zoom);
    if (step) {
      const up = this.camera.up, side = new THREE.Vector3().crossVectors(up, offset).normalize();
      const turn = (axis, angle) => offset.applyQuaternion(new THREE.Quaternion().setFromAxisAngle(axis, angle));
      turn(up, 0.12 * step[0]);
      if (offset.clone().applyQuaternion(new THREE.Quaternion().setFromAxisAngle(side, -0.12 * step[1])).angleTo(up) > 0.05) turn(side, -0.12 * step[1]);
    }
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.draw();
  }
}
