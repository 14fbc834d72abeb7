// Vectors as arrays of 3; rotations as quaternions [w, x, y, z].

export const add = (a, b) => a.map((x, i) => x + b[i]);
export const sub = (a, b) => a.map((x, i) => x - b[i]);
export const mul = (a, s) => a.map((x) => x * s);
export const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(...a);
export const unit = (a) => mul(a, 1 / (length(a) || 1));
export const mix = (a, b, t) => a.map((x, i) => x + t * (b[i] - x));
export const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

export function product(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}
export const about = (axis, angle) => [Math.cos(angle / 2), ...mul(unit(axis), Math.sin(angle / 2))];
export const inverse = (q) => [q[0], -q[1], -q[2], -q[3]];
export const rotate = (q, v) => product(product(q, [0, ...v]), inverse(q)).slice(1);

export function slerp(a, b, t) {
  let cosine = dot(a, b);
  if (cosine < 0) [b, cosine] = [mul(b, -1), -cosine];
  if (cosine > 0.9995) return unit(mix(a, b, t));
  const angle = Math.acos(cosine);
  return add(mul(a, Math.sin((1 - t) * angle) / Math.sin(angle)), mul(b, Math.sin(t * angle) / Math.sin(angle)));
}

// The rotation whose columns are these three, right-handed and of length one.
export function fromAxes(x, y, z) {
  const trace = x[0] + y[1] + z[2];
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

// From camera (x right, y down, z forward) to world, for one that looks along `forward`.
export function looking(forward, up) {
  const z = unit(forward);
  let x = cross(z, up);
  if (length(x) < 1e-6) x = cross(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  x = unit(x);
  return fromAxes(x, cross(z, x), z);
}

// The homography that shows an old picture from a new view, for what lies on a plane at a distance from the
// old one; as a CSS transform of an element of that size in px with its origin in the upper left corner.
export function warp(before, now, distance, width, height) {
  const axis = (q, v) => rotate(q, v);
  const oldAxes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((v) => axis(before.wxyz, v));
  const newAxes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((v) => axis(now.wxyz, v));
  const turn = newAxes.map((n) => oldAxes.map((o) => dot(n, o))); // rows
  let shift = newAxes.map((n) => dot(n, sub(before.position, now.position)) / distance);
  if (length(shift) > 0.7) shift = mul(shift, 0.7 / length(shift)); // a plane says little of what is near
  turn.forEach((row, i) => (row[2] += shift[i]));
  const oldFocal = height / 2 / Math.tan(before.fov_y / 2);
  const newFocal = height / 2 / Math.tan(now.fov_y / 2);
  const back = [[1 / oldFocal, 0, -width / 2 / oldFocal], [0, 1 / oldFocal, -height / 2 / oldFocal], [0, 0, 1]];
  const there = [[newFocal, 0, width / 2], [0, newFocal, height / 2], [0, 0, 1]];
  const times = (a, b) => a.map((row) => [0, 1, 2].map((j) => row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j]));
  const h = times(there, times(turn, back));
  if (h[2][2] <= 0.05) return null; // the middle of the old picture is behind the new view
  const m = [h[0][0], h[1][0], 0, h[2][0], h[0][1], h[1][1], 0, h[2][1], 0, 0, 1, 0, h[0][2], h[1][2], 0, h[2][2]];
  return `matrix3d(${m.map((x) => (x / h[2][2]).toFixed(12)).join(",")})`;
}
