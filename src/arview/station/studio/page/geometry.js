// Directions of the upright frame, and small vector helpers. Vectors are arrays of three numbers, in the model's frame.

// Images of the model's +X, +Y and +Z in the frame whose +Z is up, as in arview.cad.view_range.
const IN_UPRIGHT = {
  z: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
  y: [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
  "-y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
  x: [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
  "-x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
};
const RAD = Math.PI / 180;

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const plus = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => {
  const length = Math.hypot(...a) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
};

/** Two unit vectors that are perpendicular to a direction and to each other. */
export function across(direction) {
  const helper = Math.abs(direction[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const first = unit(cross(helper, direction));
  return [first, cross(direction, first)];
}

/** Unit vector from the middle of the part to a viewpoint. */
export function directionOf(up, azimuth_deg, elevation_deg) {
  const level = Math.cos(elevation_deg * RAD);
  const upright = [level * Math.cos(azimuth_deg * RAD), level * Math.sin(azimuth_deg * RAD), Math.sin(elevation_deg * RAD)];
  return IN_UPRIGHT[up].map((row) => dot(row, upright));
}

/** [azimuth, elevation] in degrees of a direction. */
export function anglesOf(up, direction) {
  const rows = IN_UPRIGHT[up], upright = [0, 1, 2].map((k) => rows[0][k] * direction[0] + rows[1][k] * direction[1] + rows[2][k] * direction[2]);
  const [x, y, z] = unit(upright);
  return [Math.atan2(y, x) / RAD, Math.asin(Math.max(-1, Math.min(1, z))) / RAD];
}

/** Unit vector of the up axis. */
export const upOf = (up) => directionOf(up, 0, 90).map(Math.round);
