// The edges of a mesh to draw: creases, open borders and candidates for the silhouette, which lies between a face that
// is turned to the camera and one that is turned away.

const WELD_MM = 1e-4; // vertices closer than this are merged: exporters duplicate them at creases and seams
const CREASE_COS = Math.cos((30 * Math.PI) / 180); // faces that meet at a larger angle form a crease
const FLAT_COS = Math.cos((0.05 * Math.PI) / 180); // at a smaller angle they lie in one plane

/** Triangles whose coincident vertices are merged: {positions (x y z …), indices}. */
export function welded(positions, indices) {
  const count = positions.length / 3, number = new Int32Array(count), kept = [];
  let size = 1024;
  while (size < 2 * count) size *= 2;
  const table = new Int32Array(size).fill(-1), key = new Int32Array(3 * count);
  for (let i = 0; i < key.length; i++) key[i] = Math.round(positions[i] / WELD_MM);
  for (let i = 0; i < count; i++) {
    const [x, y, z] = [key[3 * i], key[3 * i + 1], key[3 * i + 2]];
    let place = (Math.imul(x, 73856093) ^ Math.imul(y, 19349663) ^ Math.imul(z, 83492791)) & (size - 1);
    for (;;) {
      const other = table[place];
      if (other < 0) {
        table[place] = i;
        number[i] = kept.push(i) - 1;
        break;
      }
      if (key[3 * other] === x && key[3 * other + 1] === y && key[3 * other + 2] === z) {
        number[i] = number[other];
        break;
      }
      place = (place + 1) & (size - 1);
    }
  }
  const result = new Float32Array(3 * kept.length);
  kept.forEach((from, to) => { for (let k = 0; k < 3; k++) result[3 * to + k] = positions[3 * from + k]; });
  return { positions: result, indices: Uint32Array.from(indices, (i) => number[i]) };
}

/**
 * Edges of triangles.
 * @param positions (x y z …) of the vertices, mm, welded.
 * @param indices three for each triangle.
 */
export class MeshEdges {
  constructor(positions, indices) {
    const total = positions.length / 3, faceNormals = [], edges = new Map();
    let volume = 0, isClosed = true;
    for (let i = 0; i < indices.length; i += 3) {
      const corners = [indices[i], indices[i + 1], indices[i + 2]], normal = unitNormal(positions, corners);
      if (!normal) continue;
      const face = faceNormals.push(normal) - 1, at = 3 * corners[0];
      volume += normal.area * (normal[0] * positions[at] + normal[1] * positions[at + 1] + normal[2] * positions[at + 2]);
      for (let k = 0; k < 3; k++) {
        const a = corners[k], b = corners[(k + 1) % 3], key = Math.min(a, b) * total + Math.max(a, b);
        const faces = edges.get(key);
        if (faces) faces.push(face);
        else edges.set(key, [face]);
      }
    }
    const starts = [], ends = [], normals = [], kinds = [], outward = volume < 0 ? -1 : 1;
    for (const [key, faces] of edges) {
      isClosed &&= faces.length === 2;
      const one = faceNormals[faces[0]], other = faces.length === 2 ? faceNormals[faces[1]] : one;
      const cosine = faces.length === 2 ? one[0] * other[0] + one[1] * other[1] + one[2] * other[2] : -1;
      if (cosine >= FLAT_COS) continue;
      const a = Math.floor(key / total), b = key % total;
      starts.push(positions[3 * a], positions[3 * a + 1], positions[3 * a + 2]);
      ends.push(positions[3 * b], positions[3 * b + 1], positions[3 * b + 2]);
      normals.push(...one.map((value) => outward * value), ...other.map((value) => outward * value));
      kinds.push(cosine < CREASE_COS ? 1 : 0);
    }
    this.starts = new Float32Array(starts);
    this.ends = new Float32Array(ends);
    this.count = kinds.length;
    this.#normals = new Float32Array(normals);
    this.#isCrease = new Uint8Array(kinds);
    this.#isClosed = isClosed;
  }

  #normals;
  #isCrease;
  #isClosed;

  /** Call a function with the number of each edge that may be visible from a point [3] in the model frame. */
  forEachVisible([x, y, z], act) {
    const { starts } = this, normals = this.#normals;
    for (let i = 0; i < this.count; i++) {
      const dx = x - starts[3 * i], dy = y - starts[3 * i + 1], dz = z - starts[3 * i + 2], at = 6 * i;
      const isFront = normals[at] * dx + normals[at + 1] * dy + normals[at + 2] * dz > 0;
      const isOtherFront = normals[at + 3] * dx + normals[at + 4] * dy + normals[at + 5] * dz > 0;
      // Edges between two faces turned away are invisible if the body is closed.
      if (isFront !== isOtherFront || (this.#isCrease[i] && (isFront || !this.#isClosed))) act(i);
    }
  }
}

function unitNormal(positions, [a, b, c]) {
  const side = (from, to) => [0, 1, 2].map((k) => positions[3 * to + k] - positions[3 * from + k]);
  const [p, q] = [side(a, b), side(a, c)];
  const n = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
  const length = Math.hypot(...n);
  return length > 1e-9 ? Object.assign(n.map((value) => value / length), { area: length / 2 }) : null;
}
