// One level of detail as objects of three.js: few draw calls, however many components there are.

const { THREE } = window;

const SELECTED = 0x2f8bff, HOVERED = 0xffffff;

/** Surfaces, see-through surfaces, edges and highlights of a mesh. */
export class Level {
  constructor(data) {
    this.data = data;
    this.group = new THREE.Group();
    const position = new THREE.BufferAttribute(data.positions, 3);
    this.colors = new THREE.BufferAttribute(new Float32Array(data.positions.length), 3);
    const corners = new THREE.BufferAttribute(data.corners, 1);
    const surface = (material) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", position);
      geometry.setAttribute("color", this.colors);
      geometry.setIndex(corners);
      return this.#add(new THREE.Mesh(geometry, [material]));
    };
    const lit = { vertexColors: true, flatShading: true, side: THREE.DoubleSide };
    const offset = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
    this.solid = surface(new THREE.MeshLambertMaterial({ ...lit, ...offset }));
    this.ghost = surface(new THREE.MeshLambertMaterial({ ...lit, transparent: true, opacity: 0.13, depthWrite: false }));
    const glow = (color, opacity) => surface(new THREE.MeshBasicMaterial({ color, opacity, transparent: true, depthWrite: false, side: THREE.DoubleSide }));
    this.selected = glow(SELECTED, 0.5);
    this.hovered = glow(HOVERED, 0.3);
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.BufferAttribute(data.lines, 3));
    this.lines = this.#add(new THREE.LineSegments(lines, [new THREE.LineBasicMaterial({ color: 0x0b0e13, transparent: true, opacity: 0.55 })]));
  }

  #add(object) {
    object.frustumCulled = false;
    this.group.add(object);
    return object;
  }

  /** Colour the components: hexadecimal strings by index. */
  paint(hexes) {
    const color = new THREE.Color();
    this.data.boxes.forEach(({ from, to }, index) => {
      color.set(hexes[index]);
      for (let vertex = from; vertex <= to; vertex++) this.colors.array.set([color.r, color.g, color.b], 3 * vertex);
    });
    this.colors.needsUpdate = true;
  }

  /** Which components, by index, are drawn solid, and which see-through. */
  show(solid, ghost) {
    draw(this.solid, this.data.ranges, solid, 3);
    draw(this.ghost, this.data.ranges, ghost, 3);
    draw(this.lines, this.data.lineRanges, solid, 2);
  }

  select(indices) {
    draw(this.selected, this.data.ranges, indices, 3);
  }

  hover(index) {
    draw(this.hovered, this.data.ranges, index === null ? [] : [index], 3);
  }

  dispose() {
    for (const { geometry, material } of this.group.children) {
      geometry.dispose();
      material[0].dispose();
    }
  }
}

/** Let an object draw some components only; neighbours in the buffers are drawn in one call. */
function draw(object, ranges, indices, width) {
  object.geometry.clearGroups();
  let [start, count] = [0, 0];
  for (const index of [...indices].sort((a, b) => a - b)) {
    const [first, more] = ranges[index];
    if (start + count !== width * first) {
      if (count) object.geometry.addGroup(start, count, 0);
      [start, count] = [width * first, 0];
    }
    count += width * more;
  }
  if (count) object.geometry.addGroup(start, count, 0);
}
