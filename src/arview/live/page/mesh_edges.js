// The edges of a mesh worth drawing: creases, open borders and candidates for the silhouette. Which candidates are on
// the silhouette the graphics card finds for each pose, from the normals of the two faces at the edge.

const WELD_MM = 1e-4; // vertices closer than this are one: exporters repeat them at creases and seams
const CREASE_COS = Math.cos((30 * Math.PI) / 180); // faces that meet at a larger angle form a crease
const FLAT_COS = Math.cos((0.05 * Math.PI) / 180); // at a smaller angle they lie in one plane

/** For each vertex of positions (x y z …) the number of the first one at the same place. */
function weld(positions) {
  const count = positions.length / 3, first = new Int32Array(count);
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
        table[place] = first[i] = i;
        break;
      }
      if (key[3 * other] === x && key[3 * other + 1] === y && key[3 * other + 2] === z) {
        first[i] = other;
        break;
      }
      place = (place + 1) & (size - 1);
    }
  }
  return first;
}

/**
 * Edges of triangles.
 * @param positions (x y z …) of the vertices, mm.
 * @param indices three a triangle.
 * @returns {starts, ends, normals, otherNormals, kinds}: Float32Arrays of 3 a line (kinds: 1; 1 is always drawn, 0 only
 *     where it is on the silhouette).
 */
export function meshEdges(positions, indices) {
  const vertex = weld(positions), total = positions.length / 3, faceNormals = [], edges = new Map();
  for (let i = 0; i < indices.length; i += 3) {
    const corners = [vertex[indices[i]], vertex[indices[i + 1]], vertex[indices[i + 2]]];
    const normal = unitNormal(positions, corners);
    if (!normal) continue;
    const face = faceNormals.push(normal) - 1;
    for (let k = 0; k < 3; k++) {
      const a = corners[k], b = corners[(k + 1) % 3], key = Math.min(a, b) * total + Math.max(a, b);
      const faces = edges.get(key);
      if (faces) faces.push(face);
      else edges.set(key, [face]);
    }
  }
  const starts = [], ends = [], normals = [], otherNormals = [], kinds = [];
  for (const [key, faces] of edges) {
    const one = faceNormals[faces[0]], other = faces.length === 2 ? faceNormals[faces[1]] : null;
    const cosine = other ? one[0] * other[0] + one[1] * other[1] + one[2] * other[2] : -1;
    if (cosine >= FLAT_COS) continue;
    const a = Math.floor(key / total), b = key % total;
    starts.push(positions[3 * a], positions[3 * a + 1], positions[3 * a + 2]);
    ends.push(positions[3 * b], positions[3 * b + 1], positions[3 * b + 2]);
    normals.push(...one);
    otherNormals.push(...(other || one));
    kinds.push(cosine < CREASE_COS ? 1 : 0);
  }
  const packed = { starts, ends, normals, otherNormals, kinds };
  for (const name of Object.keys(packed)) packed[name] = new Float32Array(packed[name]);
  return packed;
}

function unitNormal(positions, [a, b, c]) {
  const side = (from, to) => [0, 1, 2].map((k) => positions[3 * to + k] - positions[3 * from + k]);
  const [p, q] = [side(a, b), side(a, c)];
  const n = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
  const length = Math.hypot(...n);
  return length > 1e-9 ? n.map((value) => value / length) : null;
}
