// The shaders of the ghost.

export const SURFACE_VERTEX = `
precision highp float;
in vec3 position;
uniform mat4 view, projection;
out vec3 v_place;
void main() {
  vec4 place = view * vec4(position, 1.0);
  v_place = place.xyz;
  gl_Position = projection * place;
}`;
// Faces at grazing angles are a little denser, like glass; faces towards the camera are brighter.
export const SURFACE_FRAGMENT = `
precision highp float;
in vec3 v_place;
uniform vec4 color;
uniform float dimming, width, pattern;
out vec4 result;
// Hatched ghosts: pattern 1 has stripes, pattern 2 crossed lines, and both are faint in between.
float hatch() {
  if (pattern < 0.5) return 1.0;
  float period = max(6.0, 7.0 * width), u = mod(gl_FragCoord.x + gl_FragCoord.y, period);
  float v = mod(gl_FragCoord.x - gl_FragCoord.y, period);
  bool isOn = pattern < 1.5 ? u < 0.5 * period : u < 0.25 * period || v < 0.25 * period;
  return isOn ? 1.0 : 0.2;
}
void main() {
  float facing = abs(dot(normalize(cross(dFdx(v_place), dFdy(v_place))), normalize(v_place)));
  float alpha = min(1.0, color.a * dimming * hatch() * (1.25 - 0.35 * facing));
  result = vec4(color.rgb * (0.45 + 0.55 * facing) * alpha, alpha);
}`;
// A line is a rectangle with the length of the edge and the given width on the screen plus one pixel, over which it
// fades. It is drawn nearer than it is by a thousandth of its distance, so that adjacent faces do not cover it.
export const LINE_VERTEX = `
precision highp float;
in vec3 position, otherEnd;
in vec2 corner;
uniform mat4 view, projection;
uniform vec2 viewport;
uniform float width;
out float v_aside, v_steep;
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  v_aside = v_steep = 0.0;
  vec3 here = (view * vec4(position, 1.0)).xyz, there = (view * vec4(otherEnd, 1.0)).xyz;
  if (here.z > -1.0 && there.z > -1.0) return;
  if (here.z > -1.0) here = mix(there, here, (-1.0 - there.z) / (here.z - there.z));
  if (there.z > -1.0) there = mix(here, there, (-1.0 - here.z) / (there.z - here.z));
  vec4 place = projection * vec4(0.999 * here, 1.0), other = projection * vec4(0.999 * there, 1.0);
  vec2 along = (other.xy / other.w - place.xy / place.w) * viewport * corner.x;
  float length_px = length(along);
  along = length_px > 1e-4 ? along / length_px : vec2(1.0, 0.0);
  v_aside = corner.y * 0.5 * (width + 1.0);
  v_steep = abs(along.y) > abs(along.x) ? 1.0 : 0.0;
  vec2 offset_px = vec2(-along.y, along.x) * v_aside - along * corner.x * 0.25 * width;
  gl_Position = place + vec4(2.0 * offset_px / viewport * place.w, 0.0, 0.0);
}`;
export const LINE_FRAGMENT = `
precision highp float;
in float v_aside, v_steep;
uniform vec4 color;
uniform float dimming, width, dashed;
out vec4 result;
void main() {
  // Dashes are counted along the major axis of the line, so that short pieces of a curve are dashed, too.
  float along = v_steep > 0.5 ? gl_FragCoord.y : gl_FragCoord.x;
  if (dashed > 0.5 && mod(floor(along / (2.0 + 3.0 * width)), 2.0) > 0.5) discard;
  float cover = clamp(0.5 * (width + 1.0) - abs(v_aside), 0.0, 1.0);
  result = vec4(color.rgb, 1.0) * color.a * dimming * cover;
}`;
export const NUMBER_FRAGMENT = `
precision highp float;
uniform vec2 number;
out vec4 result;
void main() { result = vec4(number, 0.0, 1.0); }`;
export const QUAD_VERTEX = `
precision highp float;
in vec2 position, uv;
out vec2 v_uv;
void main() {
  v_uv = uv;
  gl_Position = vec4(2.0 * position.x - 1.0, 1.0 - 2.0 * position.y, 0.0, 1.0);
}`;
export const QUAD_FRAGMENT = `
precision highp float;
in vec2 v_uv;
uniform sampler2D image;
out vec4 result;
void main() { result = texture(image, v_uv); }`;
