// Computes the pose of an instance while one of its handles is dragged.

import * as M from "./math.js";
import { AXES } from "./camera.js";

/** @typedef {import("./page.js").Place} Place */
/** @typedef {import("./projection.js").Projection} Projection */
/** @typedef {import("./protocol.js").Pose} Pose */

/**
 * The drag of a handle: along an axis, in the plane of the picture, around an axis, or
 * away from the middle.
 *
 * @typedef {object} Grip
 * @property {"move" | "slide" | "turn" | "size"} kind
 * @property {number} axis The index of the axis, or -1.
 * @property {Place} start The position in the picture at which the drag started.
 * @property {Pose} pose The pose of the instance at the start.
 * @property {Place} middle The position of the instance in the picture at the start.
 */

export const WORLD_AXES = [AXES.x, AXES.y, AXES.z];
const MIN_SCALE = 1e-6;
const MAX_SCALE = 1e6;
/**
 * Minimum length of an axis in the picture. Without it, dragging along an axis that
 * points to the eye would move the instance infinitely far.
 */
const LEAST_AXIS_PX = 5;
/**
 * Minimum distance from the middle. A drag that starts closer than this does not scale
 * faster.
 */
const LEAST_RADIUS_PX = 5;

/**
 * Returns the pose of an instance when its handle is dragged to a position in the
 * picture.
 *
 * @param {Grip} grip
 * @param {Place} place
 * @param {Projection} projection
 * @param {number} reach The length of an axis handle in world units.
 * @returns {Pose}
 */
export function draggedPose(grip, place, projection, reach) {
  const pose = structuredClone(grip.pose);
  switch (grip.kind) {
    case "move":
      pose.position = alongAxis(grip, place, projection, reach);
      break;
    case "slide":
      pose.position = inPlane(grip, place, projection);
      break;
    case "turn":
      pose.quaternion = aroundAxis(grip, place, projection);
      break;
    case "size":
      pose.scale = scaleAt(grip, place);
      break;
  }
  return pose;
}

/**
 * Returns the pose after a drag along an axis.
 *
 * @param {Grip} grip
 * @param {Place} place
 * @param {Projection} projection
 * @param {number} reach The length of an axis handle in world units.
 */
function alongAxis({ axis, pose, middle, start }, place, projection, reach) {
  const direction = WORLD_AXES[axis];
  const tip = projection.place(M.add(pose.position, M.mul(direction, reach)));
  const along = M.sub(tip ?? middle, middle);
  const squaredLength = Math.max(M.dot(along, along), LEAST_AXIS_PX ** 2);
  const share = M.dot(M.sub(place, start), along) / squaredLength;
  return M.add(pose.position, M.mul(direction, share * reach));
}

/**
 * Returns the pose after a drag in the plane of the picture.
 *
 * @param {Grip} grip
 * @param {Place} place
 * @param {Projection} projection
 */
function inPlane({ pose, start }, place, projection) {
  const { camera, focal } = projection;
  const [, , depth] = projection.inCamera(pose.position);
  const [right, down] = M.mul(M.sub(place, start), depth / focal);
  const step = M.add(M.mul(camera.right, right), M.mul(camera.down, down));
  return M.add(pose.position, step);
}

/**
 * Returns the pose after a drag around an axis.
 *
 * @param {Grip} grip
 * @param {Place} place
 * @param {Projection} projection
 */
function aroundAxis({ axis, pose, middle, start }, place, projection) {
  const direction = WORLD_AXES[axis];
  const sign = M.dot(direction, projection.camera.forward) < 0 ? -1 : 1;
  const angle = angleAround(middle, place) - angleAround(middle, start);
  return M.unit(M.product(M.about(direction, sign * angle), pose.quaternion));
}

/**
 * Returns the pose after a drag that scales the instance.
 *
 * @param {Grip} grip
 * @param {Place} place
 */
function scaleAt({ pose, middle, start }, place) {
  const factor = distanceFrom(middle, place) / distanceFrom(middle, start);
  return M.clamp(pose.scale * factor, MIN_SCALE, MAX_SCALE);
}

/**
 * Returns the angle of a position around the middle.
 *
 * @param {Place} middle
 * @param {Place} place
 */
function angleAround(middle, place) {
  const [x, y] = M.sub(place, middle);
  return Math.atan2(y, x);
}

/**
 * Returns the distance of a position from the middle.
 *
 * @param {Place} middle
 * @param {Place} place
 */
function distanceFrom(middle, place) {
  return Math.max(M.length(M.sub(place, middle)), LEAST_RADIUS_PX);
}
