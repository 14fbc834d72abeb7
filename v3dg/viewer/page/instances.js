// Instances of the scene: one is picked, selected, moved, and put back.

import * as M from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./handles.js").Grip} Grip */
/** @typedef {import("./page.js").Tool} Tool */
/** @typedef {import("./protocol.js").Picked} Picked */
/** @typedef {import("./protocol.js").Pose} Pose */

/** Distance to an instance that the camera flies to, in sizes of its box. */
const SIZES_AWAY = 1.5;

export class Instances {
  /**
   * The selected instance, or null.
   *
   * @type {Picked}
   */
  selected = null;
  /**
   * What dragging a handle changes.
   *
   * @type {Tool}
   */
  tool = "move";
  /**
   * The handle that is dragged, or null.
   *
   * @type {Grip}
   */
  grip = null;
  /**
   * Poses that `undo` goes back to, the last one first to go.
   *
   * @type {{ instance: number, pose: Pose }[]}
   */
  earlierPoses = [];
  /** Whether the camera flies to what is picked next. */
  fliesToPicked = false;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Forgets those of another scene. */
  reset() {
    this.selected = null;
    this.earlierPoses = [];
  }

  /**
   * Asks what is at a place of the picture, to turn around it and to select it.
   *
   * @param {number} x Share of the width.
   * @param {number} y Share of the height.
   */
  pick(x, y) {
    this.sendPick(x, y, false);
  }

  /**
   * As `pick`, and flies there.
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
   * Flies to an instance, wherever it is.
   *
   * @param {number} instance
   */
  flyTo(instance) {
    this.fliesToPicked = true;
    this.app.connection.send({ type: "pick", look: this.app.look.message, instance });
  }

  /** @param {Picked} picked What the server answers. */
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

  /** Flies to the selected instance; without one, to what the camera turns around. */
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
   * Moves the selected instance, as its handle is dragged.
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

  /** Lets go of the handle; from now on the movement can be undone. */
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
 * The diagonal of an instance's box, world units.
 *
 * @param {Picked} picked
 */
function sizeOf({ pose, box }) {
  return pose.scale * M.length(M.sub(box[1], box[0]));
}
