// Draws picture and ghosts (the transparent CAD models) in one WebGL canvas, so that they cannot drift apart.
//
// The models are rendered into a texture by an ideal lens; the texture is then distorted like the real lens and drawn over
// the picture.

import { SAMPLES } from "../graphics.js";
import { distortionGrid, eyeInModel, glProjection, glView, multiplied, toCam } from "./projection.js";
import { MeshEdges, welded } from "./mesh_edges.js";
import {
  LINE_FRAGMENT, LINE_VERTEX, NUMBER_FRAGMENT, QUAD_FRAGMENT, QUAD_VERTEX, SURFACE_FRAGMENT, SURFACE_VERTEX,
} from "./shaders.js";

const THREE = globalThis.THREE;

const BOX_MARGIN_PX = 8;
const CELLS_ACROSS = 160; // columns of the map of visible components
const CRITICAL_DIMMING = 0.55;
const GUIDE_RGB = [1, 0.867, 0.341], HALO_RGB = [0.063, 0.078, 0.106];

export class Ghost {
  /** Throws an Error when the browser does not support WebGL 2. */
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({
      canvas, antialias: false, alpha: false, depth: false, powerPreference: "high-performance",
    });
    this.renderer.autoClear = false;
    this.renderer.sortObjects = false; // surfaces are drawn before lines anyway, because lines are transparent
    this.renderer.setPixelRatio(1);
    this.shared = {
      view: { value: new THREE.Matrix4() },
      projection: { value: new THREE.Matrix4() },
      viewport: { value: new THREE.Vector2(1, 1) },
      width: { value: 2 },
      dimming: { value: 1 },
    };
    this.unusedCamera = new THREE.Camera(); // the shaders have their own matrices
    this.parts = [{ view: this.shared.view, dimming: this.shared.dimming, pose: null }]; // in one scene, so that they hide each other
    this.components = []; // of all parts: {part, surface, lines, number, edges, center_in_model, corners_in_model}
    this.model = new THREE.Scene();
    this.numbers = new THREE.Scene();
    this.picture = this.#quad();
    this.layer = this.#quad();
    this.layer.material.transparent = true;
    this.guide = [this.#lineMaterial([...HALO_RGB, 0.7]), this.#lineMaterial([...GUIDE_RGB, 0.9])];
    this.texture = new THREE.Texture();
    Object.assign(this.texture, {
      flipY: false, generateMipmaps: false, minFilter: THREE.LinearFilter, colorSpace: THREE.NoColorSpace,
    });
    this.picture.material.uniforms.image.value = this.texture;
    this.camera = null;
  }

  /** Load the models of the parts, {buffer, count} each: a GLB, in which component i is node c<i>. */
  async load(models) {
    const shapes = new Map(); // of each GLB, which specimens of a part share
    for (const { buffer, count } of models) if (!shapes.has(buffer)) shapes.set(buffer, await shapesOf(buffer, count));
    for (const { surface, lines, number, moved } of this.components) {
      this.model.remove(surface, lines);
      if (moved) {
        this.model.remove(moved.surface, moved.lines);
        moved.lines.geometry.dispose();
      }
      this.numbers.remove(number);
      surface.geometry.dispose();
      lines.geometry.dispose();
    }
    this.components = [];
    this.parts = models.map((_, id) => this.parts[id] ?? { view: { value: new THREE.Matrix4() }, dimming: { value: 1 }, pose: null });
    models.forEach(({ buffer }, id) => {
      for (const shape of shapes.get(buffer)) this.components.push(this.#component(shape, this.parts[id], this.components.length));
    });
  }

  /**
   * Appearance of every component: {ghost: [r, g, b, alpha], edges: [r, g, b, alpha], isShown, pattern, isDashed, place,
   * placeAlpha}, colours from 0 to 1. The place, 16 numbers row-major, is where a displaced component is drawn, too; else
   * null.
   */
  style(styles) {
    this.components.forEach((component, i) => {
      const { surface, lines } = component;
      const { ghost, edges, isShown, pattern, isDashed } = styles[i];
      surface.material.uniforms.pattern.value = pattern;
      lines.material.uniforms.dashed.value = isDashed ? 1 : 0;
      this.#move(component, styles[i]);
      surface.material.uniforms.color.value.set(...ghost);
      lines.material.uniforms.color.value.set(...edges);
      component.isShown = isShown;
      component.hasLines = edges[3] > 0;
      // Surfaces without a colour only occlude. They are drawn first, so that they do not erase others.
      surface.material.colorWrite = ghost[3] > 0;
    });
    this.model.children.sort((a, b) => Number(a.material.colorWrite) - Number(b.material.colorWrite));
  }

  /** Set the size of the canvas, device pixels. */
  resize(width, height) {
    if (this.canvas.width !== width || this.canvas.height !== height) this.renderer.setSize(width, height, false);
  }

  /**
   * Draw a picture and, over it, the models.
   * @param source canvas with the picture; null leaves it black.
   * @param poses {cam_from_model, isCritical} of each part; cam_from_model is 16 numbers row-major, or null.
   * @param guide pose of the outline to align the first part with, or null.
   * @param camera Intrinsics of the picture, needed with a pose or guide.
   * @param lineWidth of edges, device pixels.
   */
  draw({ source, poses, guide, camera, lineWidth }) {
    const { renderer } = this, isPosed = poses.some((one) => one.cam_from_model), shown = isPosed || guide;
    this.parts.forEach((part, id) => {
      part.pose = isPosed ? poses[id]?.cam_from_model ?? null : id === 0 ? guide : null;
      part.dimming.value = isPosed && poses[id]?.isCritical ? CRITICAL_DIMMING : 1;
    });
    if (shown) {
      this.#prepare(camera, lineWidth);
      this.target.scissor.set(...this.#box(camera, this.distortion.window, this.target.height, false));
      renderer.setRenderTarget(this.target);
      renderer.setClearColor(0x000000, 0);
      renderer.clear();
      for (const { part, moved } of this.components) {
        if (moved) moved.surface.visible = moved.lines.visible = isPosed && Boolean(part.pose) && moved.isShown;
      }
      if (isPosed) renderer.render(this.model, this.unusedCamera);
      else this.#drawGuide(lineWidth);
      renderer.setRenderTarget(null);
    }
    renderer.setClearColor(0x000000, 1);
    renderer.clear();
    if (source) {
      const old = this.texture.image;
      if (old && (old.width !== source.width || old.height !== source.height)) this.texture.dispose();
      this.texture.image = source;
      this.texture.needsUpdate = true;
      renderer.render(this.picture.scene, this.unusedCamera);
    }
    if (!shown) return;
    const whole = { left: 0, top: 0, width: camera.width, height: camera.height };
    renderer.setScissorTest(true);
    renderer.setScissor(...this.#box(camera, whole, this.canvas.height, true));
    renderer.render(this.layer.scene, this.unusedCamera);
    renderer.setScissorTest(false);
  }

  /**
   * Map of the visible components for the last poses that were drawn.
   * @returns {columns, rows, cells, window}: number of the component + 1 in each cell, 0 for none.
   */
  visibility() {
    const { window } = this.distortion, columns = CELLS_ACROSS;
    const rows = Math.max(1, Math.round((columns * window.height) / window.width));
    if (!this.small || this.small.height !== rows) {
      this.small?.dispose();
      this.small = new THREE.WebGLRenderTarget(columns, rows, { minFilter: THREE.NearestFilter });
    }
    const { renderer } = this, pixels = new Uint8Array(4 * columns * rows);
    renderer.setRenderTarget(this.small);
    renderer.setClearColor(0x000000, 0);
    renderer.clear();
    renderer.render(this.numbers, this.unusedCamera);
    renderer.readRenderTargetPixels(this.small, 0, 0, columns, rows, pixels);
    renderer.setRenderTarget(null);
    const cells = new Uint16Array(columns * rows);
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const from = 4 * ((rows - 1 - row) * columns + column); // GL counts rows from below
        cells[row * columns + column] = pixels[from] + 256 * pixels[from + 1];
      }
    }
    return { columns, rows, cells, window };
  }

  /** Set matrices and render targets for a camera and the poses of the parts. */
  #prepare(camera, lineWidth) {
    if (!this.camera?.isSame(camera)) this.#distortLike(camera);
    const { window } = this.distortion;
    const scale = this.canvas.width / camera.width;
    const width = Math.ceil(window.width * scale), height = Math.ceil(window.height * scale);
    if (this.target?.width !== width || this.target?.height !== height) {
      this.target?.dispose();
      this.target = new THREE.WebGLRenderTarget(width, height, { samples: SAMPLES, colorSpace: THREE.NoColorSpace });
      this.target.scissorTest = true;
      this.layer.material.uniforms.image.value = this.target.texture;
    }
    let [near, far] = [Infinity, 0];
    for (const [place, corners] of this.#places()) {
      for (const [x, y, z] of corners) {
        const depth = place[8] * x + place[9] * y + place[10] * z + place[11];
        near = Math.min(near, depth);
        far = Math.max(far, depth);
      }
    }
    near = Math.max(1, 0.95 * near);
    this.shared.projection.value.fromArray(glProjection(camera, window, near, Math.max(1.05 * far, near + 1)));
    for (const part of this.parts) {
      if (!part.pose) continue;
      part.view.value.fromArray(glView(part.pose));
      part.eye = eyeInModel(part.pose);
    }
    for (const component of this.components) {
      const { part, surface, number, lines, edges, moved } = component, isShown = Boolean(part.pose) && component.isShown;
      surface.visible = number.visible = isShown;
      lines.visible = isShown && component.hasLines;
      if (lines.visible) chooseLines(lines.geometry, edges, part.eye);
      if (!part.pose || !moved?.isShown) continue;
      const place = multiplied(part.pose, moved.place);
      moved.view.value.fromArray(glView(place));
      chooseLines(moved.lines.geometry, edges, eyeInModel(place));
    }
    this.shared.viewport.value.set(width, height);
    this.shared.width.value = lineWidth;
  }

  /**
   * Bounding box [x, y, width, height] of the models in a drawing, `height` rows high, of a window of the image plane; y
   * counts from below as in GL. It limits the drawing.
   */
  #box(camera, window, height, isDistorted) {
    const scale = height / window.height, reach = { left: Infinity, top: Infinity, right: -Infinity, bottom: -Infinity };
    const all = [0, 0, Math.ceil(window.width * scale), height];
    for (const [place, corners] of this.#places()) {
      for (const corner of corners) {
        const [x, y, z] = toCam(place, corner);
        const pixel = isDistorted ? camera.project([x, y, z]) : z > 1 && [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy];
        if (!pixel) return all;
        reach.left = Math.min(reach.left, pixel[0]);
        reach.right = Math.max(reach.right, pixel[0]);
        reach.top = Math.min(reach.top, pixel[1]);
        reach.bottom = Math.max(reach.bottom, pixel[1]);
      }
    }
    // Distortion moves the sides of a box outwards by a few per cent at most.
    const margin = BOX_MARGIN_PX + (isDistorted ? 0.03 * Math.max(reach.right - reach.left, reach.bottom - reach.top) : 0);
    const clamp = (value, max) => Math.min(max, Math.max(0, value));
    const left = clamp(Math.floor((reach.left - margin - window.left) * scale), all[2]);
    const right = clamp(Math.ceil((reach.right + margin - window.left) * scale), all[2]);
    const top = clamp(Math.floor((reach.top - margin - window.top) * scale), height);
    const bottom = clamp(Math.ceil((reach.bottom + margin - window.top) * scale), height);
    return [left, height - bottom, right - left, bottom - top];
  }

  /** Pairs of a pose and the corners of a component that is drawn at it. */
  *#places() {
    for (const { part: { pose }, corners_in_model: corners, moved } of this.components) {
      if (!pose) continue;
      yield [pose, corners];
      if (moved?.isShown) yield [multiplied(pose, moved.place), corners];
    }
  }

  /** Draw a component at a second place, or no longer. */
  #move(component, { ghost, edges, isShown, place, placeAlpha }) {
    if (place && !component.moved) {
      const view = { value: new THREE.Matrix4() }, surface = new THREE.Mesh(component.surface.geometry, this.#surfaceMaterial({ view, dimming: component.part.dimming }));
      const lines = new THREE.Mesh(lineGeometry(component.edges), this.#lineMaterial([1, 1, 1, 1], { view, dimming: component.part.dimming }));
      for (const mesh of [surface, lines]) mesh.frustumCulled = false;
      this.model.add(surface, lines);
      component.moved = { surface, lines, view };
    }
    const { moved } = component;
    if (!moved) return;
    moved.isShown = Boolean(place) && isShown;
    if (!place) return;
    moved.place = place;
    moved.surface.material.uniforms.color.value.set(ghost[0], ghost[1], ghost[2], placeAlpha);
    moved.surface.material.colorWrite = placeAlpha > 0;
    moved.lines.material.uniforms.color.value.set(...edges);
  }

  #distortLike(camera) {
    this.camera = camera;
    this.distortion = distortionGrid(camera);
    const { places, ideals, triangles, window } = this.distortion, uvs = [];
    for (let i = 0; i < ideals.length; i += 2) {
      uvs.push((ideals[i] - window.left) / window.width, 1 - (ideals[i + 1] - window.top) / window.height);
    }
    const { geometry } = this.layer;
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(places, 2));
    geometry.setAttribute("uv", new THREE.Float32BufferAttribute(uvs, 2));
    geometry.setIndex(triangles);
  }

  /** Draw the edges of the model in two tones, so that they are visible on bright and on dark pictures. */
  #drawGuide(lineWidth) {
    const kept = this.components.map(({ surface, lines }) => ({
      surface, lines, material: lines.material, color: surface.material.uniforms.color.value,
      isSurfaceShown: surface.visible, isLineShown: lines.visible,
    }));
    const nothing = new THREE.Vector4(0, 0, 0, 0);
    for (const { surface, lines } of kept) {
      surface.material.uniforms.color.value = nothing;
      surface.visible = lines.visible = true;
    }
    for (const [material, times] of [[this.guide[0], 3], [this.guide[1], 1.4]]) {
      this.shared.width.value = times * lineWidth;
      for (const { lines } of kept) lines.material = material;
      this.renderer.render(this.model, this.unusedCamera);
      for (const { surface } of kept) surface.visible = false; // their depth is in the buffer now
    }
    for (const { surface, lines, material, color, isSurfaceShown, isLineShown } of kept) {
      lines.material = material;
      surface.material.uniforms.color.value = color;
      surface.visible = isSurfaceShown;
      lines.visible = isLineShown;
    }
  }

  #component({ geometry, edges }, part, index) {
    const { min, max } = geometry.boundingBox, own = { view: part.view, dimming: part.dimming };
    const surface = new THREE.Mesh(geometry, this.#surfaceMaterial(own));
    const lines = new THREE.Mesh(lineGeometry(edges), this.#lineMaterial([1, 1, 1, 1], own));
    const number = new THREE.Mesh(geometry, this.#numberMaterial(index + 1, own));
    for (const mesh of [surface, lines, number]) mesh.frustumCulled = false;
    this.model.add(surface, lines);
    this.numbers.add(number);
    return {
      part, surface, lines, number, edges, isShown: true, hasLines: true,
      center_in_model: [(min.x + max.x) / 2, (min.y + max.y) / 2, (min.z + max.z) / 2],
      corners_in_model: [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [
        (k & 1 ? max : min).x, (k & 2 ? max : min).y, (k & 4 ? max : min).z,
      ]),
    };
  }

  #material(vertexShader, fragmentShader, uniforms, more) {
    return new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader, fragmentShader, uniforms, side: THREE.DoubleSide, ...more,
    });
  }

  /** The foremost surface replaces those behind it, so that only one layer is visible. */
  #surfaceMaterial(own = {}) {
    const uniforms = { ...this.shared, color: { value: new THREE.Vector4() }, pattern: { value: 0 }, ...own };
    return this.#material(SURFACE_VERTEX, SURFACE_FRAGMENT, uniforms, {
      blending: THREE.NoBlending, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
    });
  }

  #lineMaterial(color, own = {}) {
    const uniforms = { ...this.shared, color: { value: new THREE.Vector4(...color) }, dashed: { value: 0 }, ...own };
    return this.#material(LINE_VERTEX, LINE_FRAGMENT, uniforms, { ...OVER, depthWrite: false });
  }

  #numberMaterial(number, own) {
    const uniforms = { ...this.shared, ...own, number: { value: new THREE.Vector2((number & 255) / 255, (number >> 8) / 255) } };
    return this.#material(SURFACE_VERTEX, NUMBER_FRAGMENT, uniforms, { blending: THREE.NoBlending });
  }

  #quad() {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, 0, 1, 0, 0, 1, 1, 1], 2));
    geometry.setAttribute("uv", new THREE.Float32BufferAttribute([0, 0, 1, 0, 0, 1, 1, 1], 2));
    geometry.setIndex([0, 2, 1, 1, 2, 3]);
    const material = this.#material(QUAD_VERTEX, QUAD_FRAGMENT, { image: { value: null } }, {
      ...OVER, depthTest: false, depthWrite: false,
    });
    const mesh = new THREE.Mesh(geometry, material), scene = new THREE.Scene();
    mesh.frustumCulled = false;
    scene.add(mesh);
    return { geometry, material, scene };
  }
}

/** Blending of colours with premultiplied alpha. */
const OVER = {
  transparent: true,
  blending: THREE.CustomBlending,
  blendSrc: THREE.OneFactor,
  blendDst: THREE.OneMinusSrcAlphaFactor,
  blendSrcAlpha: THREE.OneFactor,
  blendDstAlpha: THREE.OneMinusSrcAlphaFactor,
};

/** Geometry and edges of the components of a GLB, in which component i is node c<i>. */
async function shapesOf(buffer, count) {
  const gltf = await new THREE.GLTFLoader().parseAsync(buffer, "");
  gltf.scene.updateMatrixWorld(true);
  return Array.from({ length: count }, (_, i) => {
    const mesh = gltf.scene.getObjectByName(`c${i}`);
    if (!mesh?.isMesh) throw new Error(`the model has no component ${i}`);
    const given = mesh.geometry.applyMatrix4(mesh.matrixWorld), corners = given.attributes.position.array;
    const order = given.index?.array ?? Uint32Array.from({ length: corners.length / 3 }, (_, k) => k);
    const { positions, indices } = welded(corners, order);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    geometry.setIndex(new THREE.BufferAttribute(indices, 1));
    geometry.computeBoundingBox();
    return { geometry, edges: new MeshEdges(positions, indices) };
  });
}

/** Four corners for each line; `corner` is (1 at the start or -1 at the end, side). chooseLines sets the index. */
function lineGeometry({ starts, ends, count }) {
  const position = new Float32Array(12 * count), otherEnd = new Float32Array(12 * count), corner = new Float32Array(8 * count);
  for (let line = 0; line < count; line++) {
    const [start, end] = [starts.subarray(3 * line, 3 * line + 3), ends.subarray(3 * line, 3 * line + 3)];
    for (let k = 0; k < 4; k++) {
      position.set(k < 2 ? start : end, 3 * (4 * line + k));
      otherEnd.set(k < 2 ? end : start, 3 * (4 * line + k));
      corner.set([k < 2 ? 1 : -1, k % 2 ? 1 : -1], 2 * (4 * line + k));
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setAttribute("otherEnd", new THREE.BufferAttribute(otherEnd, 3));
  geometry.setAttribute("corner", new THREE.BufferAttribute(corner, 2));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(6 * count), 1).setUsage(THREE.DynamicDrawUsage));
  return geometry;
}

/** Select the lines that may be visible from a point in the model frame. */
function chooseLines(geometry, edges, eye) {
  const { index } = geometry, { array } = index;
  let count = 0;
  edges.forEachVisible(eye, (line) => {
    for (const k of [0, 1, 2, 2, 1, 3]) array[count++] = 4 * line + k;
  });
  geometry.setDrawRange(0, count);
  index.clearUpdateRanges();
  index.addUpdateRange(0, count);
  index.needsUpdate = true;
}
