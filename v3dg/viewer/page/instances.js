// The instances of the scene: picking, selecting, moving, and undoing.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./handles.js").Grip} Grip */
/** @typedef {import("./page.js").Tool} Tool */
/** @typedef {import("./protocol.js").Picked} Picked */
/** @typedef {import("./protocol.js").Pose} Pose */

/**
 * Distance of the camera from an instance after a flight to it, as a multiple of the
 * size of its box.
 */
const SIZES_AWAY = 1.5;

export class Instances {
  /**
   * The selected instance; null if there is none.
   *
   * @type {Picked}
   */
  selected = null;
  /**
   * The part of a pose that dragging a handle changes.
   *
   * @type {Tool}
   */
  tool = "move";
  /**
   * The handle that is being dragged; null if there is none.
   *
   * @type {Grip}
   */
  grip = null;
  /**
   * Poses that `undo` restores, most recent last.
   *
   * @type {{ instance: number, pose: Pose }[]}
   */
  earlierPoses = [];
  /** Whether the camera will fly to the next point that is picked. */
  fliesToPicked = false;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Removes the selection and the stored poses when another scene is opened. */
  reset() {
    this.selected = null;
    this.earlierPoses = [];
  }

  /**
   * Asks the server for the instance at a position in the picture, to select it and to
   * orbit around the point.
   *
   * @param {number} x The position as a fraction of the width.
   * @param {number} y The position as a fraction of the height.
   */
  pick(x, y) {
    this.sendPick(x, y, false);
  }

  /**
   * Like `pick`, but also flies to the point.
   *
   * @param {number} x
   * @param {number} y
   */
  pickAndFly(x, y) {
    this.sendPick(x, y, true);
  }

  /**
   * Sends the request to pick.
   *
   * @param {number} x
   * @param {number} y
   * @param {boolean} flies Whether the camera then flies to the point.
   */
  sendPick(x, y, flies) {
    const { app } = this;
    if (!app.scene.shows_cuts) return;
    this.fliesToPicked = flies;
    const at = /** @type {[number, number]} */ ([M.clamp(x, 0, 1), M.clamp(y, 0, 1)]);
    app.connection.send({ type: "pick", look: app.look.message, at });
  }

  /**
   * Flies to an instance.
   *
   * @param {number} instance The number of the instance.
   */
  flyTo(instance) {
    this.fliesToPicked = true;
    this.app.connection.send({ type: "pick", look: this.app.look.message, instance });
  }

  /**
   * Handles the answer to a request to pick.
   *
   * @param {Picked} picked The answer of the server.
   */
  take(picked) {
    if (picked.instance === undefined) {
      this.select(null);
      return;
    }
    const { camera, scene } = this.app;
    let selected = null;
    if (scene.instances > 1) selected = picked;
    this.select(selected);
    const point = picked.point ?? picked.pose.position;
    if (!this.fliesToPicked) {
      camera.focus = point;
    } else if (picked.point) {
      camera.lookAt(point, 0.35 * M.length(M.sub(camera.position, point)));
    } else {
      camera.lookAt(point, SIZES_AWAY * sizeOf(picked));
    }
    this.app.redraw();
  }

  /**
   * Selects an instance; null deselects it.
   *
   * @param {Picked | null} picked
   */
  select(picked) {
    this.selected = picked;
    this.app.sync();
  }

  /**
   * Flies to the selected instance. If there is none, flies to the point that the
   * camera orbits.
   */
  flyToSelected() {
    const { camera } = this.app;
    if (this.selected) {
      camera.lookAt(this.selected.pose.position, SIZES_AWAY * sizeOf(this.selected));
    } else {
      camera.lookAt(camera.focus, camera.distance);
    }
    this.app.redraw();
  }

  /**
   * Selects which handles are shown.
   *
   * @param {Tool} tool
   */
  setTool(tool) {
    this.tool = tool;
    this.app.sync();
  }

  /**
   * Changes the pose of the selected instance while its handle is dragged.
   *
   * @param {Pose} pose
   */
  setPose(pose) {
    this.selected.pose = pose;
    this.sendPose(this.selected.instance, pose);
  }

  /**
   * Sends the pose of an instance to the server.
   *
   * @param {number} instance
   * @param {Pose} pose
   */
  sendPose(instance, pose) {
    const { app } = this;
    app.connection.send({ type: "move", instance, ...pose });
    app.requests.expire();
    app.redraw();
  }

  /** Ends the drag of a handle, and stores the earlier pose for `undo`. */
  letGo() {
    this.earlierPoses.push({ instance: this.selected.instance, pose: this.grip.pose });
    this.grip = null;
    this.app.sync();
  }

  undo() {
    const earlier = this.earlierPoses.pop();
    if (!earlier) return;
    if (this.selected?.instance === earlier.instance) this.selected.pose = earlier.pose;
    this.sendPose(earlier.instance, earlier.pose);
    this.app.sync();
  }
}

/**
 * Returns the length of the diagonal of an instance's box in world units.
 *
 * @param {Picked} picked
 */
function sizeOf({ pose, box }) {
  return pose.scale * M.length(M.sub(box[1], box[0]));
}
