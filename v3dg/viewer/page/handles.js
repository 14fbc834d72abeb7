// The selected instance: its box, and the handles that move, rotate and scale it.

import * as M from "./math.js";
import { AXIS_COLORS } from "./compass.js";
import { WORLD_AXES, draggedPose } from "./grip.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./grip.js").Grip} Grip */
/** @typedef {import("./page.js").Place} Place */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {import("./projection.js").Line} Line */
/** @typedef {import("./projection.js").Projection} Projection */
/** @typedef {import("./protocol.js").Picked} Picked */

const BOX_COLOR = "#ffbe3c";
/** Length of handles, px. */
const REACH = 85;
/** Radius of the ring that scales, px. */
const SIZE_RING = 0.7 * REACH;
const NUM_SEGMENTS = 48;

export class Handles {
  /**
   * @param {App} app
   * @param {Projection} projection
   */
  constructor(app, projection) {
    this.app = app;
    this.projection = projection;
  }

  get pose() {
    return this.app.instances.selected.pose;
  }

  /** Length of the handles at the depth of the instance, in world units. */
  get reach() {
    const [, , ahead] = this.projection.inCamera(this.pose.position);
    const depth = Math.max(ahead, 1e-6 * this.app.camera.radius);
    return (REACH * depth) / this.projection.focal;
  }

  /**
   * Returns the end of the handle along an axis.
   *
   * @param {number} axis The index of the axis.
   */
  tip(axis) {
    return M.add(this.pose.position, M.mul(WORLD_AXES[axis], this.reach));
  }

  /**
   * Returns points of the handle around an axis. The last point equals the first.
   *
   * @param {number} axis The index of the axis.
   */
  ring(axis) {
    const { position } = this.pose;
    const { reach } = this;
    const u = WORLD_AXES[(axis + 1) % 3];
    const v = WORLD_AXES[(axis + 2) % 3];
    return Array.from({ length: NUM_SEGMENTS + 1 }, (_, i) => {
      const angle = (2 * Math.PI * i) / NUM_SEGMENTS;
      const across = M.mul(u, reach * Math.cos(angle));
      return M.add(position, M.add(across, M.mul(v, reach * Math.sin(angle))));
    });
  }

  draw() {
    const { context } = this.projection;
    const { tool } = this.app.instances;
    this.drawBox();
    const middle = this.projection.place(this.pose.position);
    if (!middle) return;
    if (tool === "turn") this.drawRings();
    if (tool === "move") this.drawArrows();
    context.fillStyle = BOX_COLOR;
    context.fillRect(middle[0] - 6, middle[1] - 6, 12, 12);
    if (tool === "size") {
      context.strokeStyle = BOX_COLOR;
      context.lineWidth = 3;
      context.beginPath();
      context.arc(...middle, SIZE_RING, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  drawBox() {
    this.projection.stroke(BOX_COLOR, 1.5, edgesOf(this.app.instances.selected));
  }

  drawRings() {
    WORLD_AXES.forEach((_, axis) => {
      const ring = this.ring(axis);
      const width = this.isGripped(axis) ? 4 : 2.5;
      const lines = ring.slice(1).map((point, i) => /** @type {Line} */ ([ring[i], point]));
      this.projection.stroke(AXIS_COLORS[axis], width, lines);
    });
  }

  drawArrows() {
    const { context } = this.projection;
    WORLD_AXES.forEach((_, axis) => {
      const width = this.isGripped(axis) ? 5 : 3;
      this.projection.stroke(AXIS_COLORS[axis], width, [[this.pose.position, this.tip(axis)]]);
      const tip = this.projection.place(this.tip(axis));
      if (!tip) return;
      context.fillStyle = AXIS_COLORS[axis];
      context.beginPath();
      context.arc(...tip, 6, 0, 2 * Math.PI);
      context.fill();
    });
  }

  /**
   * Returns whether the handle of an axis is being dragged.
   *
   * @param {number} axis
   */
  isGripped(axis) {
    return this.app.instances.grip?.axis === axis;
  }

  /**
   * Returns the handle at a position in the picture, or null.
   *
   * @param {number} x
   * @param {number} y
   * @param {number} slack Largest distance from the handle, px.
   * @returns {Grip | null}
   */
  gripAt(x, y, slack) {
    const { selected, tool } = this.app.instances;
    if (!selected) return null;
    const middle = this.projection.place(this.pose.position);
    if (!middle) return null;
    const start = /** @type {Place} */ ([x, y]);
    const grip = { start, pose: structuredClone(this.pose), middle, axis: -1 };
    const away = Math.hypot(x - middle[0], y - middle[1]);
    const isInMiddle = away < slack;
    if (tool === "size") {
      const isOnRing = Math.abs(away - SIZE_RING) < slack;
      return isOnRing || isInMiddle ? { ...grip, kind: "size" } : null;
    }
    if (tool === "move" && isInMiddle) return { ...grip, kind: "slide" };
    const axis = this.axisAt(x, y, slack);
    return axis < 0 ? null : { ...grip, kind: tool, axis };
  }

  /**
   * Returns the axis whose handle is nearest to a position in the picture, or -1 if
   * none is near.
   *
   * @param {number} x
   * @param {number} y
   * @param {number} slack Largest distance from the handle, px.
   */
  axisAt(x, y, slack) {
    let nearest = slack;
    let result = -1;
    WORLD_AXES.forEach((_, axis) => {
      const distance = distanceToLines([x, y], this.placesOfHandle(axis));
      if (distance < nearest) {
        nearest = distance;
        result = axis;
      }
    });
    return result;
  }

  /**
   * Returns the positions in the picture of the points of an axis's handle.
   *
   * @param {number} axis
   */
  placesOfHandle(axis) {
    const isRing = this.app.instances.tool === "turn";
    const points = isRing ? this.ring(axis) : [this.pose.position, this.tip(axis)];
    return points.map((point) => this.projection.place(point));
  }

  /**
   * Returns the pose of the instance when its handle is dragged to a position in the
   * picture.
   *
   * @param {number} x
   * @param {number} y
   */
  drag(x, y) {
    const { grip } = this.app.instances;
    return draggedPose(grip, [x, y], this.projection, this.reach);
  }
}

/**
 * Returns the edges of an instance's box in the world.
 *
 * @param {Pick<Picked, "pose" | "box">} placed
 */
export function edgesOf(placed) {
  const corners = cornersOf(placed);
  /** @type {Line[]} */
  const edges = [];
  // Each bit of a corner's index tells which end of an axis the corner is at.
  corners.forEach((corner, i) => {
    for (const bit of [1, 2, 4]) {
      if ((i & bit) === 0) edges.push([corner, corners[i | bit]]);
    }
  });
  return edges;
}

/**
 * Returns the corners of an instance's box in the world.
 *
 * @param {Pick<Picked, "pose" | "box">} placed
 */
function cornersOf({ pose, box }) {
  return Array.from({ length: 8 }, (_, i) => {
    /** @type {Vector} */
    const corner = [box[i & 1][0], box[(i >> 1) & 1][1], box[(i >> 2) & 1][2]];
    return M.add(pose.position, M.mul(M.rotate(pose.quaternion, corner), pose.scale));
  });
}

/**
 * Returns the distance of a position from a polyline, px.
 *
 * @param {Place} place
 * @param {(Place | null)[]} places The points of the polyline; null for points that are
 *   not visible.
 */
function distanceToLines(place, places) {
  let result = Infinity;
  places.slice(1).forEach((end, i) => {
    const start = places[i];
    if (!start || !end) return;
    const along = M.sub(end, start);
    const projected = M.dot(M.sub(place, start), along) / (M.dot(along, along) || 1);
    const nearest = M.add(start, M.mul(along, M.clamp(projected, 0, 1)));
    result = Math.min(result, M.length(M.sub(place, nearest)));
  });
  return result;
}
