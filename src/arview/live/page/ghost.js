// Picture and ghost in one WebGL canvas, so that they cannot drift apart.
//
// The model is drawn as an ideal lens sees it into a texture, and the texture is bent like the lens over the picture.

import { bend, eyeInModel, glProjection, glView } from "./projection.js";
import { meshEdges } from "./mesh_edges.js";

const THREE = globalThis.THREE;

const SAMPLES = 4; // of antialiasing
const CELLS_ACROSS = 160; // of the map of who is seen where
const CRITICAL_DIMMING = 0.55;
const GUIDE_RGB = [1, 0.867, 0.341], HALO_RGB = [0.063, 0.078, 0.106];

const SURFACE_VERTEX = `
precision highp float;
in vec3 position;
in vec3 normal;
uniform mat4 view, projection;
out vec3 v_place, v_normal;
void main() {
  vec4 place = view * vec4(position, 1.0);
  v_place = place.xyz;
  v_normal = mat3(view) * normal;
  gl_Position = projection * place;
}`;
// Grazing faces a little denser, like glass; faces towards the camera brighter.
const SURFACE_FRAGMENT = `
precision highp float;
in vec3 v_place, v_normal;
uniform vec4 color;
uniform float dimming;
out vec4 result;
void main() {
  float facing = abs(dot(normalize(v_normal), normalize(v_place)));
  float alpha = min(1.0, color.a * dimming * (1.25 - 0.35 * facing));
  result = vec4(color.rgb * (0.45 + 0.55 * facing) * alpha, alpha);
}`;
// A line is a rectangle as long as the edge and as wide as asked for on the screen. It is drawn a thousandth of its
// distance nearer than it is, or the faces beside it would cover it.
const LINE_VERTEX = `
precision highp float;
in vec2 position;
in vec3 start, end, normal, otherNormal;
in float kind;
uniform mat4 view, projection;
uniform vec3 eye;
uniform vec2 viewport;
uniform float width;
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (kind < 0.5 && dot(normal, eye - start) * dot(otherNormal, eye - start) > 0.0) return;
  vec3 a = (view * vec4(start, 1.0)).xyz, b = (view * vec4(end, 1.0)).xyz;
  if (a.z > -1.0 && b.z > -1.0) return;
  if (a.z > -1.0) a = mix(b, a, (-1.0 - b.z) / (a.z - b.z));
  if (b.z > -1.0) b = mix(a, b, (-1.0 - a.z) / (b.z - a.z));
  vec4 from = projection * vec4(0.999 * a, 1.0), to = projection * vec4(0.999 * b, 1.0);
  vec2 along = (to.xy / to.w - from.xy / from.w) * viewport;
  float length_px = length(along);
  along = length_px > 1e-4 ? along / length_px : vec2(1.0, 0.0);
  vec4 place = position.x < 0.5 ? from : to;
  vec2 aside = width * (vec2(-along.y, along.x) * position.y + along * (2.0 * position.x - 1.0) * 0.5);
  gl_Position = place + vec4(aside / viewport * place.w, 0.0, 0.0);
}`;
const LINE_FRAGMENT = `
precision highp float;
uniform vec4 color;
uniform float dimming;
out vec4 result;
void main() { result = vec4(color.rgb, 1.0) * color.a * dimming; }`;
const NUMBER_FRAGMENT = `
precision highp float;
uniform vec2 number;
out vec4 result;
void main() { result = vec4(number, 0.0, 1.0); }`;
const QUAD_VERTEX = `
precision highp float;
in vec2 position, uv;
out vec2 v_uv;
void main() {
  v_uv = uv;
  gl_Position = vec4(2.0 * position.x - 1.0, 1.0 - 2.0 * position.y, 0.0, 1.0);
}`;
const QUAD_FRAGMENT = `
precision highp float;
in vec2 v_uv;
uniform sampler2D image;
out vec4 result;
void main() { result = texture(image, v_uv); }`;

export class Ghost {
  /** Raises an Error when the browser has no WebGL 2. */
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({
      canvas, antialias: false, alpha: false, depth: false, powerPreference: "high-performance",
    });
    this.renderer.autoClear = false;
    this.renderer.sortObjects = false; // surfaces come before lines anyway, as these are transparent
    this.renderer.setPixelRatio(1);
    this.shared = {
      view: { value: new THREE.Matrix4() },
      projection: { value: new THREE.Matrix4() },
      eye: { value: new THREE.Vector3() },
      viewport: { value: new THREE.Vector2(1, 1) },
      width: { value: 2 },
      dimming: { value: 1 },
    };
    this.nobody = new THREE.Camera(); // the shaders have their own matrices
    this.components = []; // {surface, lines, number, center_in_model, corners_in_model}
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

  /** Take the model from a GLB: component i is node c<i>. */
  async load(buffer, count) {
    const gltf = await new THREE.GLTFLoader().parseAsync(buffer, "");
    gltf.scene.updateMatrixWorld(true);
    for (const { surface, lines, number } of this.components) {
      this.model.remove(surface, lines);
      this.numbers.remove(number);
      surface.geometry.dispose();
      lines.geometry.dispose();
    }
    this.components = [];
    for (let i = 0; i < count; i++) {
      const mesh = gltf.scene.getObjectByName(`c${i}`);
      if (!mesh?.isMesh) throw new Error(`the model holds no component ${i}`);
      this.components.push(this.#component(mesh.geometry.applyMatrix4(mesh.matrixWorld), i));
    }
  }

  /** Colours of every component: {ghost: [r, g, b, alpha], edges: [r, g, b, alpha], isShown}, in 0 to 1. */
  style(styles) {
    this.components.forEach(({ surface, lines, number }, i) => {
      const { ghost, edges, isShown } = styles[i];
      surface.material.uniforms.color.value.set(...ghost);
      lines.material.uniforms.color.value.set(...edges);
      surface.visible = number.visible = isShown;
      lines.visible = isShown && edges[3] > 0;
    });
  }

  /** Size of the canvas in device pixels. */
  resize(width, height) {
    if (this.canvas.width !== width || this.canvas.height !== height) this.renderer.setSize(width, height, false);
  }

  /**
   * Draw a picture and, over it, the model.
   * @param source canvas with the picture; null leaves it black.
   * @param pose 16 numbers, or null.
   * @param guide pose of the outline to align with, or null.
   * @param camera Intrinsics of the picture, needed with a pose or guide.
   * @param lineWidth of edges, device pixels.
   */
  draw({ source, pose, guide, camera, isCritical, lineWidth }) {
    const { renderer } = this, shown = pose || guide;
    if (shown) {
      this.#look(camera, shown, lineWidth);
      this.shared.dimming.value = pose && isCritical ? CRITICAL_DIMMING : 1;
      renderer.setRenderTarget(this.target);
      renderer.setClearColor(0x000000, 0);
      renderer.clear();
      if (pose) renderer.render(this.model, this.nobody);
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
      renderer.render(this.picture.scene, this.nobody);
    }
    if (shown) renderer.render(this.layer.scene, this.nobody);
  }

  /**
   * Who is seen where, in cells of the picture of the last pose drawn.
   * @returns {columns, rows, cells}: number of the component + 1 in each cell, 0 for none.
   */
  seen() {
    const { window } = this.bent, columns = CELLS_ACROSS;
    const rows = Math.max(1, Math.round((columns * window.height) / window.width));
    if (!this.small || this.small.height !== rows) {
      this.small?.dispose();
      this.small = new THREE.WebGLRenderTarget(columns, rows, { minFilter: THREE.NearestFilter });
    }
    const { renderer } = this, pixels = new Uint8Array(4 * columns * rows);
    renderer.setRenderTarget(this.small);
    renderer.setClearColor(0x000000, 0);
    renderer.clear();
    renderer.render(this.numbers, this.nobody);
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

  /** Set matrices and targets for a camera and a pose. */
  #look(camera, pose, lineWidth) {
    if (!this.camera?.isSame(camera)) this.#bendLike(camera);
    const { window } = this.bent;
    const scale = this.canvas.width / camera.width;
    const width = Math.ceil(window.width * scale), height = Math.ceil(window.height * scale);
    if (this.target?.width !== width || this.target?.height !== height) {
      this.target?.dispose();
      this.target = new THREE.WebGLRenderTarget(width, height, { samples: SAMPLES, colorSpace: THREE.NoColorSpace });
      this.layer.material.uniforms.image.value = this.target.texture;
    }
    let [near, far] = [Infinity, 0];
    for (const { corners_in_model: corners } of this.components) {
      for (const [x, y, z] of corners) {
        const depth = pose[8] * x + pose[9] * y + pose[10] * z + pose[11];
        near = Math.min(near, depth);
        far = Math.max(far, depth);
      }
    }
    near = Math.max(1, 0.95 * near);
    this.shared.view.value.fromArray(glView(pose));
    this.shared.projection.value.fromArray(glProjection(camera, window, near, Math.max(1.05 * far, near + 1)));
    this.shared.eye.value.set(...eyeInModel(pose));
    this.shared.viewport.value.set(width, height);
    this.shared.width.value = lineWidth;
  }

  #bendLike(camera) {
    this.camera = camera;
    this.bent = bend(camera);
    const { places, ideals, triangles, window } = this.bent, uvs = [];
    for (let i = 0; i < ideals.length; i += 2) {
      uvs.push((ideals[i] - window.left) / window.width, 1 - (ideals[i + 1] - window.top) / window.height);
    }
    const { geometry } = this.layer;
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(places, 2));
    geometry.setAttribute("uv", new THREE.Float32BufferAttribute(uvs, 2));
    geometry.setIndex(triangles);
  }

  /** The model's edges in two tones, so that they show on bright and on dark pictures. */
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
      this.renderer.render(this.model, this.nobody);
      for (const { surface } of kept) surface.visible = false; // their depth is there by now
    }
    for (const { surface, lines, material, color, isSurfaceShown, isLineShown } of kept) {
      lines.material = material;
      surface.material.uniforms.color.value = color;
      surface.visible = isSurfaceShown;
      lines.visible = isLineShown;
    }
  }

  #component(geometry, index) {
    const positions = geometry.attributes.position.array;
    const indices = geometry.index?.array ?? Uint32Array.from({ length: positions.length / 3 }, (_, i) => i);
    geometry.computeBoundingBox();
    const { min, max } = geometry.boundingBox;
    const surface = new THREE.Mesh(geometry, this.#surfaceMaterial());
    const lines = new THREE.Mesh(lineGeometry(meshEdges(positions, indices)), this.#lineMaterial([1, 1, 1, 1]));
    const number = new THREE.Mesh(geometry, this.#numberMaterial(index + 1));
    for (const mesh of [surface, lines, number]) mesh.frustumCulled = false;
    this.model.add(surface, lines);
    this.numbers.add(number);
    return {
      surface, lines, number,
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

  /** The foremost surface replaces what is behind it: one layer of glass, however many there are. */
  #surfaceMaterial() {
    const uniforms = { ...this.shared, color: { value: new THREE.Vector4() } };
    return this.#material(SURFACE_VERTEX, SURFACE_FRAGMENT, uniforms, {
      blending: THREE.NoBlending, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
    });
  }

  #lineMaterial(color) {
    const uniforms = { ...this.shared, color: { value: new THREE.Vector4(...color) } };
    return this.#material(LINE_VERTEX, LINE_FRAGMENT, uniforms, { ...OVER, depthWrite: false });
  }

  #numberMaterial(number) {
    const uniforms = { ...this.shared, number: { value: new THREE.Vector2((number & 255) / 255, (number >> 8) / 255) } };
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

/** Blending of colours that are multiplied by their alpha. */
const OVER = {
  transparent: true,
  blending: THREE.CustomBlending,
  blendSrc: THREE.OneFactor,
  blendDst: THREE.OneMinusSrcAlphaFactor,
  blendSrcAlpha: THREE.OneFactor,
  blendDstAlpha: THREE.OneMinusSrcAlphaFactor,
};

function lineGeometry({ starts, ends, normals, otherNormals, kinds }) {
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, -1, 1, -1, 0, 1, 1, 1], 2));
  geometry.setIndex([0, 1, 2, 2, 1, 3]);
  for (const [name, values] of Object.entries({ start: starts, end: ends, normal: normals, otherNormal: otherNormals })) {
    geometry.setAttribute(name, new THREE.InstancedBufferAttribute(values, 3));
  }
  geometry.setAttribute("kind", new THREE.InstancedBufferAttribute(kinds, 1));
  geometry.instanceCount = kinds.length;
  return geometry;
}
