// The pinhole camera with Brown distortion, in OpenCV's conventions: pixel (u, v), integers are pixel centres; camera
// frame +X right, +Y down, +Z forward. The ghost is distorted to fit the picture; the picture is not undistorted.

const NEAR_MM = 1;

/** Transform a point [3] from the model to the camera frame; the pose is 16 numbers, row-major. */
export function toCam(pose, [x, y, z]) {
  return [
    pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
    pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
    pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
  ];
}

/** Product of two rigid transforms, 16 numbers each, row-major. */
export function multiplied(a, b) {
  return Array.from({ length: 16 }, (_, at) => {
    const row = 4 * Math.floor(at / 4), column = at % 4;
    return a[row] * b[column] + a[row + 1] * b[4 + column] + a[row + 2] * b[8 + column] + a[row + 3] * b[12 + column];
  });
}

/** Position of the camera in the model frame [3]. */
export function eyeInModel(pose) {
  return [0, 1, 2].map((k) => -(pose[k] * pose[3] + pose[4 + k] * pose[7] + pose[8 + k] * pose[11]));
}

export class Intrinsics {
  /** @param camera `camera` of a Pose message. */
  constructor({ width, height, fx, fy, cx, cy, dist }) {
    Object.assign(this, { width, height, fx, fy, cx, cy, dist });
    this.isDistorted = dist.some((term) => term !== 0);
    this.limitR2 = this.#monotoneLimit();
  }

  isSame(other) {
    return ["width", "height", "fx", "fy", "cx", "cy"].every((key) => this[key] === other[key]) &&
      this.dist.every((term, i) => term === other.dist[i]);
  }

  /** Distorted normalised coordinates of ideal ones (Brown 1966, OpenCV's formula). */
  distort(x, y) {
    const [k1, k2, p1, p2, k3] = this.dist, r2 = x * x + y * y;
    const radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
    return [
      x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
      y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ];
  }

  /** Pixel [u, v] of a point in the camera frame; null behind the camera and where the distortion is not monotone. */
  project([x, y, z]) {
    if (z <= NEAR_MM) return null;
    let a = x / z, b = y / z;
    if (this.isDistorted) {
      if (a * a + b * b > this.limitR2) return null;
      [a, b] = this.distort(a, b);
    }
    return [this.fx * a + this.cx, this.fy * b + this.cy];
  }

  /** The undistorted pixel, with the same K, of pixel (u, v). */
  ideal(u, v) {
    const xd = (u - this.cx) / this.fx, yd = (v - this.cy) / this.fy;
    let x = xd, y = yd;
    for (let i = 0; i < 20; i++) {
      const [xe, ye] = this.distort(x, y);
      x += xd - xe;
      y += yd - ye;
    }
    return [this.fx * x + this.cx, this.fy * y + this.cy];
  }

  /** Largest squared radius, up to 1.5 × the radius of the corner, at which the distortion is monotone. */
  #monotoneLimit() {
    let corner = 0;
    for (const u of [0, this.width]) {
      for (const v of [0, this.height]) {
        corner = Math.max(corner, ((u - this.cx) / this.fx) ** 2 + ((v - this.cy) / this.fy) ** 2);
      }
    }
    const [k1, k2, , , k3] = this.dist, max = 2.25 * corner;
    for (let i = 1; i <= 400; i++) {
      const r2 = (max * i) / 400;
      if (1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) < 0.05) return (max * (i - 1)) / 400;
    }
    return max;
  }
}

/**
 * GL projection matrix (16 numbers, column-major) of an ideal lens onto the window {left, top, width, height} of the image
 * plane, px, where pixel (u, v) reaches from u to u + 1: its centre lies at u + 0.5.
 */
export function glProjection({ fx, fy, cx, cy }, window, nearMm, farMm) {
  const { left, top, width, height } = window, depth = farMm - nearMm;
  return [
    (2 * fx) / width, 0, 0, 0,
    0, (2 * fy) / height, 0, 0,
    1 - (2 * (cx + 0.5 - left)) / width, (2 * (cy + 0.5 - top)) / height - 1, -(farMm + nearMm) / depth, -1,
    0, 0, (-2 * farMm * nearMm) / depth, 0,
  ];
}

/** GL view matrix (column-major) of a pose: GL looks along -Z, with +Y up. */
export function glView(pose) {
  const signs = [1, -1, -1], view = [];
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 3; row++) view.push(signs[row] * pose[4 * row + column]);
    view.push(column === 3 ? 1 : 0);
  }
  return view;
}

const NODES = 48;

/**
 * Grid that distorts an ideal picture like the lens: nodes over the real image with the ideal pixel of each, and the
 * window of the image plane that contains them all.
 */
export function distortionGrid(camera) {
  const columns = camera.isDistorted ? NODES : 1;
  const rows = camera.isDistorted ? Math.max(1, Math.round((NODES * camera.height) / camera.width)) : 1;
  const places = [], ideals = [], triangles = [];
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  for (let row = 0; row <= rows; row++) {
    for (let column = 0; column <= columns; column++) {
      const x = (column / columns) * camera.width, y = (row / rows) * camera.height;
      let [u, v] = camera.isDistorted ? camera.ideal(x - 0.5, y - 0.5) : [x - 0.5, y - 0.5];
      // Where the distortion is not monotone no ray exists; such nodes are kept near the image.
      u = Math.min(1.5 * camera.width, Math.max(-0.5 * camera.width, Number.isFinite(u) ? u : -1));
      v = Math.min(1.5 * camera.height, Math.max(-0.5 * camera.height, Number.isFinite(v) ? v : -1));
      places.push(x / camera.width, y / camera.height);
      ideals.push(u + 0.5, v + 0.5);
      left = Math.min(left, u + 0.5);
      right = Math.max(right, u + 0.5);
      top = Math.min(top, v + 0.5);
      bottom = Math.max(bottom, v + 0.5);
      if (row && column) {
        const here = row * (columns + 1) + column, above = here - columns - 1;
        triangles.push(above - 1, here - 1, here, above - 1, here, above);
      }
    }
  }
  return { places, ideals, triangles, window: { left, top, width: right - left, height: bottom - top } };
}
