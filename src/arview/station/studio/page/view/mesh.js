// The mesh of the whole CAD, as the server packs it (arview.station.studio.mesh_data), and where a ray meets it.

/** One level of detail: positions, corners of the faces, edge lines, and what belongs to which component. */
export class MeshData {
  constructor(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    let at = 4 + length;
    const take = (Type, count) => {
      const array = new Type(buffer, at, count);
      at += array.byteLength;
      return array;
    };
    this.positions = take(Float32Array, 3 * header.vertices);
    this.corners = take(Uint32Array, 3 * header.faces);
    this.lines = take(Float32Array, 6 * header.edges);
    this.ranges = header.ranges;
    this.lineRanges = header.edge_ranges;
    this.faceCount = header.faces;
    this.isCoarse = header.is_coarse;
    this.boxes = this.ranges.map((range) => this.#box(range));
  }

  /** First and last vertex, and the bounding box, of a component. */
  #box([first, count]) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    let [from, to] = [Infinity, -1];
    for (let k = 3 * first; k < 3 * (first + count); k++) {
      const vertex = this.corners[k];
      if (vertex < from) from = vertex;
      if (vertex > to) to = vertex;
    }
    for (let vertex = from; vertex <= to; vertex++) {
      for (let axis = 0; axis < 3; axis++) {
        const value = this.positions[3 * vertex + axis];
        if (value < low[axis]) low[axis] = value;
        if (value > high[axis]) high[axis] = value;
      }
    }
    return { low, high, from, to };
  }

  /**
   * The first face that a ray meets.
   * @param isOpen whether a component, by index, takes part.
   * @returns {component, face, point, distance}: its index, its face and the point; null for none.
   */
  hit(origin, direction, isOpen) {
    const boxed = [];
    this.boxes.forEach((box, index) => {
      if (!isOpen(index)) return;
      const distance = boxDistance(box, origin, direction);
      if (distance !== null) boxed.push([distance, index]);
    });
    boxed.sort((a, b) => a[0] - b[0]);
    let best = null;
    for (const [distance, index] of boxed) {
      if (best && distance > best.distance) break;
      const found = this.#hitComponent(index, origin, direction, best?.distance ?? Infinity);
      if (found) best = found;
    }
    return best;
  }

  /** Positions of the corners of a component's faces in a plane. */
  planeOf(index, point, normal) {
    const { positions: p, corners: c } = this, [first, count] = this.ranges[index], { low, high } = this.boxes[index];
    const limit = 1e-4 * Math.hypot(...low.map((value, axis) => high[axis] - value)), level = point[0] * normal[0] + point[1] * normal[1] + point[2] * normal[2];
    const found = [];
    for (let k = 3 * first; k < 3 * (first + count); k += 3) {
      const isFlat = [0, 1, 2].every((step) => {
        const at = 3 * c[k + step];
        return Math.abs(p[at] * normal[0] + p[at + 1] * normal[1] + p[at + 2] * normal[2] - level) < limit;
      });
      if (isFlat) for (let step = 0; step < 3; step++) found.push(...p.subarray(3 * c[k + step], 3 * c[k + step] + 3));
    }
    return found;
  }

  /** Möller and Trumbore (1997). */
  #hitComponent(index, [ox, oy, oz], [dx, dy, dz], limit) {
    const { positions: p, corners: c } = this, [first, count] = this.ranges[index];
    let face = -1;
    for (let k = first; k < first + count; k++) {
      const a = 3 * c[3 * k], b = 3 * c[3 * k + 1], d = 3 * c[3 * k + 2];
      const ax = p[a], ay = p[a + 1], az = p[a + 2];
      const ux = p[b] - ax, uy = p[b + 1] - ay, uz = p[b + 2] - az;
      const vx = p[d] - ax, vy = p[d + 1] - ay, vz = p[d + 2] - az;
      const hx = dy * vz - dz * vy, hy = dz * vx - dx * vz, hz = dx * vy - dy * vx;
      const det = ux * hx + uy * hy + uz * hz;
      if (det > -1e-12 && det < 1e-12) continue;
      const sx = ox - ax, sy = oy - ay, sz = oz - az, s = (sx * hx + sy * hy + sz * hz) / det;
      if (s < 0 || s > 1) continue;
      const qx = sy * uz - sz * uy, qy = sz * ux - sx * uz, qz = sx * uy - sy * ux, t = (dx * qx + dy * qy + dz * qz) / det;
      if (t < 0 || s + t > 1) continue;
      const distance = (vx * qx + vy * qy + vz * qz) / det;
      if (distance > 0 && distance < limit) [limit, face] = [distance, k];
    }
    if (face < 0) return null;
    return { component: index, face: face - first, distance: limit, point: [ox + limit * dx, oy + limit * dy, oz + limit * dz] };
  }
}

/** Distance at which a ray enters a box; null where it passes by. */
function boxDistance({ low, high }, origin, direction) {
  let [near, far] = [0, Infinity];
  for (let axis = 0; axis < 3; axis++) {
    const one = (low[axis] - 1e-3 - origin[axis]) / direction[axis], other = (high[axis] + 1e-3 - origin[axis]) / direction[axis];
    near = Math.max(near, Math.min(one, other));
    far = Math.min(far, Math.max(one, other));
  }
  return near <= far ? near : null;
}
