// Instances of the scene: picking, selecting, moving, and undoing.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./handles.js").Grip} Grip */
/** @typedef {import("./page.js").Tool} Tool */
/** @typedef {import("./protocol.js").Picked} Picked */
/** @typedef {import("./protocol.js").Pose} Pose */

/** Distance between the camera and an instance after a flight to it, in sizes of its box. */
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
   * The handle that is dragged; null if there is none.
   *
   * @type {Grip}
   */
  grip = null;
  /**
   * Poses that `undo` restores, the most recent one last.
   *
   * @type {{ instance: number, pose: Pose }[]}
   */
  earlierPoses = [];
  /** Whether the camera flies to the next picked point. */
  fliesToPicked = false;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Forgets selection and poses when another scene is opened. */
  reset() {
    this.selected = null;
    this.earlierPoses = [];
  }

  /**
   * Asks for the instance at a place in the picture, to select it and to orbit around the point.
   *
   * @param {number} x Position as a fraction of the width.
   * @param {number} y Position as a fraction of the height.
   */
  pick(x, y) {
    this.sendPick(x, y, false);
  }

  /**
   * Picks like `pick`, and flies to the point.
   *
   * @param {number} x
   * @param {number} y
   */
  pickAndFly(x, y) {
    this.sendPick(x, y, true);
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {boolean} flies
   */
  sendPick(x, y, flies) {
    const { app } = this;
    if (!app.scene.shows_cuts) return;
    this.fliesToPicked = flies;
    const at = /** @type {[number, number]} */ ([M.clamp(x, 0, 1), M.clamp(y, 0, 1)]);
    app.connection.send({ type: "pick", look: app.look.message, at });
  }

  /**
   * Flies to an instance by its number.
   *
   * @param {number} instance
   */
  flyTo(instance) {
    this.fliesToPicked = true;
    this.app.connection.send({ type: "pick", look: this.app.look.message, instance });
  }

  /** @param {Picked} picked The answer of the server. */
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

  /** @param {Picked | null} picked */
  select(picked) {
    this.selected = picked;
    this.app.sync();
  }

  /**
   * Flies to the selected instance; if there is none, to the point around which the camera orbits.
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

  /** @param {Tool} tool */
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
   * @param {number} instance
   * @param {Pose} pose
   */
  sendPose(instance, pose) {
    const { app } = this;
    app.connection.send({ type: "move", instance, ...pose });
    app.requests.expire();
    app.redraw();
  }

  /** Ends the drag of a handle, and records its start for undoing. */
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
