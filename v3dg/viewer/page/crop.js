// The box that crops an asset. Its faces can be dragged. The inside or the outside of
// the box is saved as a new asset.

import * as M from "./math.js";
import { AXIS_COLORS } from "./compass.js";
import { AXES } from "./camera.js";
import { edgesOf } from "./handles.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Place} Place */
/** @typedef {import("./page.js").Vector} Vector */
/** @typedef {import("./projection.js").Projection} Projection */
/** @typedef {import("./protocol.js").Crop} CropMessage */
/** @typedef {import("./protocol.js").Picked} Picked */
/**
 * A box, given by its minimum and its maximum corner.
 *
 * @typedef {[Vector, Vector]} Box Minimum and maximum corner.
 */
/** @typedef {{ axis: number, end: 0 | 1 }} Face One of the six faces, by axis and corner. */

const BOX_COLOR = "#5ad1ff";
const HANDLE_RADIUS = 7;
/**
 * A face can only be dragged if the angle between its axis and the line of sight is
 * large enough. This is the square of the smallest sine.
 */
const LEAST_SINE2 = 1e-3;
const LOCAL_AXES = [AXES.x, AXES.y, AXES.z];
/** @type {Face[]} */
const FACES = [0, 1, 2].flatMap((axis) => [
  { axis, end: /** @type {0} */ (0) },
  { axis, end: /** @type {1} */ (1) },
]);

export class Crop {
  /**
   * The instance whose bundle is cropped; null if there is no crop.
   *
   * @type {Picked}
   */
  subject = null;
  /**
   * The box in the coordinates of the bundle.
   *
   * @type {Box}
   */
  box = null;
  /**
   * The part of the asset that is saved.
   *
   * @type {CropMessage["keep"]}
   */
  keep = "inside";
  /** Name of the new file. */
  name = "";
  /** Whether the viewer waits for the server to send the subject. */
  isWaiting = false;
  /**
   * The face that is being dragged, with the pointer's position and the box at the
   * start of the drag; null if there is none.
   *
   * @type {{ face: Face, start: Place, box: Box }}
   */
  grip = null;

  /**
   * @param {App} app
   * @param {Projection} projection
   */
  constructor(app, projection) {
    this.app = app;
    this.projection = projection;
  }

  get isOn() {
    return this.subject !== null;
  }

  /** Starts a crop of the selected instance, or of the only instance. */
  begin() {
    const { connection, instances, look } = this.app;
    if (instances.selected) {
      this.take(instances.selected);
      return;
    }
    this.isWaiting = true;
    connection.send({ type: "pick", look: look.message, instance: 0 });
  }

  /**
   * Begins the crop of a bundle.
   *
   * @param {Picked} picked An instance of the bundle.
   */
  take(picked) {
    this.isWaiting = false;
    if (picked.instance === undefined) return;
    const stem = (picked.bundle || this.app.scene.name).replace(/\.[^.]*$/, "");
    this.name = `${stem}_crop.ply`;
    this.subject = picked;
    this.box = this.nearlyAll(picked);
    this.app.sync();
  }

  /**
   * Returns a box around nearly all of a bundle. If the bundle is the whole scene,
   * distant outliers are outside the box.
   *
   * @param {Picked} picked
   * @returns {Box}
   */
  nearlyAll({ pose, box }) {
    const { center, instances, radius } = this.app.scene;
    if (instances > 1) return structuredClone(box);
    const turned = M.rotate(M.inverse(pose.quaternion), M.sub(center, pose.position));
    const middle = M.mul(turned, 1 / pose.scale);
    const reach = radius / pose.scale;
    return [
      /** @type {Vector} */ (box[0].map((low, axis) => Math.max(low, middle[axis] - reach))),
      /** @type {Vector} */ (box[1].map((high, axis) => Math.min(high, middle[axis] + reach))),
    ];
  }

  /** Removes the box when another scene is opened. */
  reset() {
    this.subject = null;
    this.box = null;
    this.grip = null;
    this.isWaiting = false;
  }

  end() {
    this.reset();
    this.app.sync();
  }

  /** The box as text that `v3dg convert --crop` accepts. */
  get text() {
    return `box:${this.box.flat().map(fiveDigits).join(",")}`;
  }

  save() {
    const { box, keep, name, subject } = this;
    this.app.connection.send({ type: "crop", instance: subject.instance, box, keep, name });
  }

  /**
   * Converts a point to world coordinates.
   *
   * @param {Vector} point A point in the coordinates of the bundle.
   */
  inWorld(point) {
    const { pose } = this.subject;
    return M.add(pose.position, M.mul(M.rotate(pose.quaternion, point), pose.scale));
  }

  /**
   * Returns the middle of a face, in the coordinates of the bundle.
   *
   * @param {Face} face
   */
  middleOf({ axis, end }) {
    const middle = M.mix(this.box[0], this.box[1], 0.5);
    middle[axis] = this.box[end][axis];
    return middle;
  }

  draw() {
    const { context } = this.projection;
    const { pose } = this.subject;
    this.projection.stroke(BOX_COLOR, 2, edgesOf({ pose, box: this.box }));
    for (const face of FACES) {
      const place = this.projection.place(this.inWorld(this.middleOf(face)));
      if (!place) continue;
      context.fillStyle = AXIS_COLORS[face.axis];
      context.strokeStyle = BOX_COLOR;
      context.lineWidth = 2;
      context.beginPath();
      context.arc(...place, HANDLE_RADIUS, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    }
  }

  /**
   * Starts to drag the face whose handle is nearest to a position in the picture.
   * Returns false if there is none.
   *
   * @param {number} x
   * @param {number} y
   * @param {number} slack Largest distance from the handle, px.
   */
  gripAt(x, y, slack) {
    if (!this.isOn) return false;
    let nearest = slack;
    for (const face of FACES) {
      const place = this.projection.place(this.inWorld(this.middleOf(face)));
      const distance = place ? Math.hypot(x - place[0], y - place[1]) : Infinity;
      if (distance >= nearest) continue;
      nearest = distance;
      this.grip = { face, start: [x, y], box: structuredClone(this.box) };
    }
    return this.grip !== null;
  }

  /**
   * Moves the dragged face along its axis, up to the opposite face.
   *
   * @param {number} x
   * @param {number} y
   */
  drag(x, y) {
    const { box, face, start } = this.grip;
    const { axis, end } = face;
    this.box = structuredClone(box);
    const from = this.alongAxis(face, start);
    const to = this.alongAxis(face, [x, y]);
    if (from === null || to === null) return;
    const moved = box[end][axis] + to - from;
    const opposite = box[1 - end][axis];
    this.box[end][axis] = end === 1 ? Math.max(moved, opposite) : Math.min(moved, opposite);
  }

  /**
   * Finds the point on a face's axis that is closest to the ray through a position in
   * the picture. Returns its distance from the face along the axis, or null if the axis
   * points to the eye.
   *
   * @param {Face} face
   * @param {Place} place
   */
  alongAxis(face, place) {
    const { pose } = this.subject;
    const ray = this.projection.ray(place);
    const axis = M.mul(M.rotate(pose.quaternion, LOCAL_AXES[face.axis]), pose.scale);
    const apart = M.sub(this.inWorld(this.middleOf(face)), this.app.camera.position);
    const across = M.dot(axis, ray);
    const squares = M.dot(axis, axis) * M.dot(ray, ray);
    const sine2 = squares - across * across;
    if (sine2 < LEAST_SINE2 * squares) return null;
    return (across * M.dot(ray, apart) - M.dot(ray, ray) * M.dot(axis, apart)) / sine2;
  }

  letGo() {
    this.grip = null;
    this.app.sync();
  }
}

/**
 * Rounds a number to five digits.
 *
 * @param {number} value
 */
function fiveDigits(value) {
  return Number(value.toPrecision(5));
}
