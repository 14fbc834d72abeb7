// Where instances stand in front of a camera, in the layout of project.wgsl. Computed in
// double precision and then rounded, as csrc/math/similarity.h and view.h do.

/**
 * @typedef {object} Pinhole A camera with the OpenCV convention; matrices are row major.
 * @property {ArrayLike<number>} viewmat World to camera, 16 numbers.
 * @property {ArrayLike<number>} k Focal lengths and principal point, px, 9 numbers.
 * @property {number} near Depth before which no mean may lie, in world units.
 * @property {number} width
 * @property {number} height
 */
/**
 * @typedef {object} Instances
 * @property {Int32Array} bundle Bundle of each of I instances.
 * @property {Float64Array} positions I * 3.
 * @property {Float64Array} quaternions I * 4, w x y z.
 * @property {Float64Array} scales I.
 * @property {Float32Array} importance I.
 * @property {Float32Array} factors I * 4: red, green, blue, opacity; null if all are 1.
 */

export const FLOATS_OF_PLACEMENT = 24;
export const FLOATS_OF_CAMERA = 16;
/** Slopes are clamped this far outside of the picture, in halves of the field of view. */
const FOV_MARGIN = 0.3;

/**
 * Return the position of a camera in the world.
 *
 * @param {ArrayLike<number>} viewmat
 * @returns {number[]}
 */
export function eyeOf(viewmat) {
  const eye = [0, 0, 0];
  let determinant = 0;
  for (let a = 0; a < 3; a += 1) {
    const b = (a + 1) % 3;
    const c = (a + 2) % 3;
    for (let row = 0; row < 3; row += 1) {
      const next = 4 * ((row + 1) % 3);
      const after = 4 * ((row + 2) % 3);
      const cofactor =
        viewmat[next + b] * viewmat[after + c] - viewmat[next + c] * viewmat[after + b];
      eye[a] -= viewmat[4 * row + 3] * cofactor;
      if (row === 0) determinant += viewmat[a] * cofactor;
    }
  }
  return eye.map((part) => part / determinant);
}

/**
 * Return the row-major rotation matrix of a quaternion of any length but zero.
 *
 * @param {number} w
 * @param {number} x
 * @param {number} y
 * @param {number} z
 */
export function rotationOf(w, x, y, z) {
  const s = 2 / (w * w + x * x + y * y + z * z);
  return [
    1 - s * (y * y + z * z),
    s * (x * y - w * z),
    s * (x * z + w * y),
    s * (x * y + w * z),
    1 - s * (x * x + z * z),
    s * (y * z - w * x),
    s * (x * z - w * y),
    s * (y * z + w * x),
    1 - s * (x * x + y * y),
  ];
}

/**
 * Write the placement of one instance.
 *
 * @param {ArrayLike<number>} viewmat
 * @param {number[]} eye Position of the camera in the world.
 * @param {Instances} instances
 * @param {number} index Of the instance.
 * @param {Float32Array} out FLOATS_OF_PLACEMENT numbers.
 */
function place(viewmat, eye, instances, index, out) {
  const { positions, quaternions, scales, factors } = instances;
  const scale = scales[index];
  const [w, x, y, z] = quaternions.subarray(4 * index, 4 * index + 4);
  const rotation = rotationOf(w, x, y, z);
  const fromOrigin = [0, 1, 2].map((a) => eye[a] - positions[3 * index + a]);
  for (let a = 0; a < 3; a += 1) {
    let ownEye = 0;
    for (let k = 0; k < 3; k += 1) ownEye += rotation[3 * k + a] * fromOrigin[k];
    ownEye /= scale;
    const leading = Math.fround(ownEye);
    out[12 + a] = leading;
    out[16 + a] = ownEye - leading;
  }
  for (let row = 0; row < 3; row += 1) {
    let rest = 0;
    for (let k = 0; k < 3; k += 1) rest -= viewmat[4 * row + k] * fromOrigin[k];
    for (let k = 0; k < 3; k += 1) {
      let axis = 0;
      for (let j = 0; j < 3; j += 1) axis += viewmat[4 * row + j] * rotation[3 * j + k];
      out[4 * row + k] = scale * axis;
      rest += scale * axis * out[12 + k];
    }
    out[4 * row + 3] = rest;
  }
  const tint = factors === null ? [1, 1, 1] : factors.subarray(4 * index, 4 * index + 3);
  out.set(tint, 20);
}

/**
 * Return the placements of some instances, FLOATS_OF_PLACEMENT numbers each.
 *
 * @param {Pinhole} camera
 * @param {Instances} instances
 * @param {Int32Array} indices
 */
export function placementsOf(camera, instances, indices) {
  const eye = eyeOf(camera.viewmat);
  const out = new Float32Array(FLOATS_OF_PLACEMENT * indices.length);
  indices.forEach((index, k) => {
    const own = out.subarray(FLOATS_OF_PLACEMENT * k, FLOATS_OF_PLACEMENT * (k + 1));
    place(camera.viewmat, eye, instances, index, own);
  });
  return out;
}

/**
 * Return the camera in the layout of shared.wgsl.
 *
 * @param {Pinhole} camera
 * @param {number} count Gaussians of the cut.
 * @param {number[]} background Red, green and blue, 0 to 1.
 * @param {number} minTransmittance Behind which pixels stop.
 */
export function cameraBlock({ k, near, width, height }, count, background, minTransmittance) {
  const [fx, , cx, , fy, cy] = Array.from(k);
  const marginX = (FOV_MARGIN * width) / (2 * fx);
  const marginY = (FOV_MARGIN * height) / (2 * fy);
  const block = new Float32Array(FLOATS_OF_CAMERA);
  block.set([fx, fy, cx, cy, width, height, near]);
  new Uint32Array(block.buffer)[7] = count;
  block.set([-(cx / fx + marginX), -(cy / fy + marginY)], 8);
  block.set([(width - cx) / fx + marginX, (height - cy) / fy + marginY], 10);
  block.set(background, 12);
  block[15] = minTransmittance;
  return block;
}
