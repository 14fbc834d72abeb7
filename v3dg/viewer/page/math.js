// Vector functions. Vectors are arrays, and rotations are quaternions [w, x, y, z].

/** @typedef {import("./page.js").Pinhole} Pinhole */
/** @typedef {import("./page.js").Quaternion} Quaternion */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {[Vector, Vector, Vector]} Matrix Three rows. */

/** @type {Matrix} */
const IDENTITY = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];
/** Maximum shift of the picture's plane, as a multiple of its distance. */
const MOST_SHIFT = 0.7;

/**
 * @template {number[]} V
 * @param {V} a
 * @param {V} b
 */
export function add(a, b) {
  return /** @type {V} */ (a.map((x, i) => x + b[i]));
}

/**
 * @template {number[]} V
 * @param {V} a
 * @param {V} b
 */
export function sub(a, b) {
  return /** @type {V} */ (a.map((x, i) => x - b[i]));
}

/**
 * @template {number[]} V
 * @param {V} a
 * @param {number} factor
 */
export function mul(a, factor) {
  return /** @type {V} */ (a.map((x) => x * factor));
}

/**
 * @param {number[]} a
 * @param {number[]} b
 */
export function dot(a, b) {
  return a.reduce((sum, x, i) => sum + x * b[i], 0);
}

/**
 * @param {Vector} a
 * @param {Vector} b
 * @returns {Vector}
 */
export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/**
 * @param {number[]} a
 */
export function length(a) {
  return Math.hypot(...a);
}

/**
 * Returns a vector of the same direction with length 1. The zero vector is not changed.
 * @template {number[]} V
 * @param {V} a
 */
export function unit(a) {
  return mul(a, 1 / (length(a) || 1));
}

/**
 * Interpolates linearly from `a` (t = 0) to `b` (t = 1).
 * @template {number[]} V
 * @param {V} a
 * @param {V} b
 * @param {number} t
 */
export function mix(a, b, t) {
  return /** @type {V} */ (a.map((x, i) => x + t * (b[i] - x)));
}

/**
 * Returns the number in [low, high] that is closest to x.
 * @param {number} x
 * @param {number} low
 * @param {number} high
 */
export function clamp(x, low, high) {
  return Math.min(Math.max(x, low), high);
}

/**
 * Returns whether no component differs by more than `difference`.
 * @param {number[]} a
 * @param {number[]} b
 * @param {number} difference
 */
export function isNear(a, b, difference) {
  return a.every((x, i) => Math.abs(x - b[i]) <= difference);
}

/**
 * @param {number} angle In radians.
 */
export function degrees(angle) {
  return (angle * 180) / Math.PI;
}

/**
 * @param {number} angle In degrees.
 */
export function radians(angle) {
  return (angle * Math.PI) / 180;
}

/**
 * Returns the numbers in a text. They are separated by spaces or commas. A word that is
 * not a number gives NaN.
 * @param {string} text
 */
export function numbersOf(text) {
  return text
    .split(/[\s,]+/)
    .filter(Boolean)
    .map(Number);
}

/**
 * Returns a world axis that is not parallel to a direction of length 1.
 * @param {Vector} direction
 * @returns {Vector}
 */
export function axisAcross(direction) {
  if (Math.abs(direction[0]) < 0.9) return [1, 0, 0];
  return [0, 1, 0];
}

/**
 * Returns the rotation by `b`, followed by the rotation by `a`.
 * @param {Quaternion} a
 * @param {Quaternion} b
 * @returns {Quaternion}
 */
export function product(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

/**
 * Returns the rotation about an axis of length 1.
 * @param {Vector} axis
 * @param {number} angle In radians.
 * @returns {Quaternion}
 */
export function about(axis, angle) {
  return [Math.cos(angle / 2), ...mul(unit(axis), Math.sin(angle / 2))];
}

/**
 * Returns the inverse of a rotation.
 * @param {Quaternion} q
 * @returns {Quaternion}
 */
export function inverse(q) {
  return [q[0], -q[1], -q[2], -q[3]];
}

/**
 * Returns the vector after a rotation.
 * @param {Quaternion} q
 * @param {Vector} v
 * @returns {Vector}
 */
export function rotate(q, v) {
  const [, x, y, z] = product(product(q, [0, ...v]), inverse(q));
  return [x, y, z];
}

/**
 * Interpolates from `a` (t = 0) to `b` (t = 1) along the shorter arc.
 * @param {Quaternion} a
 * @param {Quaternion} b
 * @param {number} t
 */
export function slerp(a, b, t) {
  let end = b;
  if (dot(a, b) < 0) end = mul(b, -1);
  const cosine = dot(a, end);
  if (cosine > 0.9995) return unit(mix(a, end, t));
  const angle = Math.acos(cosine);
  const shareOfStart = Math.sin((1 - t) * angle) / Math.sin(angle);
  const shareOfEnd = Math.sin(t * angle) / Math.sin(angle);
  return add(mul(a, shareOfStart), mul(end, shareOfEnd));
}

/**
 * Returns the rotation whose matrix has three right-handed axes of length 1 as columns.
 * @param {Vector} x
 * @param {Vector} y
 * @param {Vector} z
 */
export function fromAxes(x, y, z) {
  const trace = x[0] + y[1] + z[2];
  /** @type {Quaternion} */
  let q;
  if (trace > 0) {
    q = [1 + trace, y[2] - z[1], z[0] - x[2], x[1] - y[0]];
  } else if (x[0] > y[1] && x[0] > z[2]) {
    q = [y[2] - z[1], 1 + x[0] - y[1] - z[2], y[0] + x[1], z[0] + x[2]];
  } else if (y[1] > z[2]) {
    q = [z[0] - x[2], y[0] + x[1], 1 + y[1] - x[0] - z[2], z[1] + y[2]];
  } else {
    q = [x[1] - y[0], z[0] + x[2], z[1] + y[2], 1 + z[2] - x[0] - y[1]];
  }
  return unit(q);
}

/**
 * Returns the rotation from the camera's axes (x right, y down, z forward) to the
 * world, for a camera that looks along `forward`.
 * @param {Vector} forward
 * @param {Vector} up
 */
export function looking(forward, up) {
  const z = unit(forward);
  let x = cross(z, up);
  if (length(x) < 1e-6) x = cross(z, axisAcross(z));
  x = unit(x);
  return fromAxes(x, cross(z, x), z);
}

/**
 * Returns the homography that shows a picture of one view as seen from another. It is
 * exact for points on a plane at a given distance from the first view.
 * @param {Pinhole} before
 * @param {Pinhole} now
 * @param {number} distance
 * @param {number} width The width of the element, px.
 * @param {number} height
 * @returns {string | null} The CSS transform of an element whose origin is its upper
 *   left corner. It is null if the middle of the picture is behind the other view.
 */
export function warp(before, now, distance, width, height) {
  const oldAxes = IDENTITY.map((axis) => rotate(before.wxyz, axis));
  const newAxes = IDENTITY.map((axis) => rotate(now.wxyz, axis));
  const step = sub(before.position, now.position);
  let shift = newAxes.map((axis) => dot(axis, step) / distance);
  // For near objects, a plane is a bad approximation, so the shift is limited.
  if (length(shift) > MOST_SHIFT) shift = mul(shift, MOST_SHIFT / length(shift));
  const turn = /** @type {Matrix} */ (
    newAxes.map((axis) => oldAxes.map((oldAxis) => dot(axis, oldAxis)))
  );
  turn.forEach((row, i) => (row[2] += shift[i]));
  const oldFocal = height / 2 / Math.tan(before.fov_y / 2);
  const newFocal = height / 2 / Math.tan(now.fov_y / 2);
  /** @type {Matrix} */
  const toRays = [
    [1 / oldFocal, 0, -width / 2 / oldFocal],
    [0, 1 / oldFocal, -height / 2 / oldFocal],
    [0, 0, 1],
  ];
  /** @type {Matrix} */
  const toPixels = [
    [newFocal, 0, width / 2],
    [0, newFocal, height / 2],
    [0, 0, 1],
  ];
  return cssTransform(times(toPixels, times(turn, toRays)));
}

/**
 * @param {Matrix} a
 * @param {Matrix} b
 */
function times(a, b) {
  return /** @type {Matrix} */ (
    a.map((row) => [0, 1, 2].map((j) => row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j]))
  );
}

/**
 * Returns a homography as text for CSS.
 * @param {Matrix} homography
 */
function cssTransform([x, y, w]) {
  if (w[2] <= 0.05) return null;
  const columns = [x[0], y[0], 0, w[0], x[1], y[1], 0, w[1], 0, 0, 1, 0, x[2], y[2], 0, w[2]];
  return `matrix3d(${columns.map((value) => (value / w[2]).toFixed(12)).join(",")})`;
}
