// Continuous movement of the camera by keys, the pad on the screen, and gamepads.

import * as M from "./math.js";
import { runCommand } from "./commands.js";
import { element } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Vector} Vector */

/**
 * Movements to the right, up and forward, by the code of the key.
 *
 * @type {Record<string, Vector>}
 */
const PUSHES = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyE: [0, 1, 0],
  KeyQ: [0, -1, 0],
  ArrowUp: [0, 0, 1],
  ArrowDown: [0, 0, -1],
  ArrowLeft: [-1, 0, 0],
  ArrowRight: [1, 0, 0],
  PageUp: [0, 1, 0],
  PageDown: [0, -1, 0],
};
const FAST = 4;
const SLOW = 0.25;
/** A gamepad's stick counts as released if its value is below this. */
const DEAD_ZONE = 0.14;
/** Turning speed, in radians per second, for a stick that is pushed completely. */
const YAW_SPEED = 1.8;
const PITCH_SPEED = 1.4;
/** Buttons of a standard gamepad. */
const LEFT_SHOULDER = 4;
const RIGHT_SHOULDER = 5;
const LEFT_TRIGGER = 6;
const RIGHT_TRIGGER = 7;
/**
 * Measures of the pad on the screen, px: half its width, the reach of a finger, and the
 * knob.
 */
const PAD_CENTER = 55;
const PAD_REACH = 45;
const KNOB_REACH = 35;

export class Movement {
  /**
   * Codes of the keys that are held.
   *
   * @type {Set<string>}
   */
  keys = new Set();
  /** Whether Shift is held. */
  isFast = false;
  /** Whether Alt is held. */
  isSlow = false;
  /**
   * Position of the pad on the screen, to the right and down.
   *
   * @type {[number, number]}
   */
  padPush = [0, 0];
  pad = element("pad");

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    window.addEventListener("keydown", (event) => this.press(event));
    window.addEventListener("keyup", (event) => this.release(event));
    window.addEventListener("blur", () => this.keys.clear());
    window.addEventListener("gamepadconnected", () => app.redraw());
    this.listenToPad();
  }

  /**
   * Handles a key that is pressed.
   *
   * @param {KeyboardEvent} event
   */
  press(event) {
    this.noteModifiers(event);
    if (isTyping(event)) return;
    if (isPush(event)) {
      if (movesFocus(event)) return;
      this.keys.add(event.code);
      event.preventDefault();
      this.app.redraw();
    } else if (!event.repeat && runCommand(this.app, event)) {
      event.preventDefault();
    }
  }

  /**
   * Handles a key that is released.
   *
   * @param {KeyboardEvent} event
   */
  release(event) {
    this.noteModifiers(event);
    this.keys.delete(event.code);
    if (isTyping(event) || !isPush(event) || movesFocus(event)) return;
    event.preventDefault();
    this.app.redraw();
  }

  /**
   * Stores whether Shift and Alt are held.
   *
   * @param {KeyboardEvent} event
   */
  noteModifiers(event) {
    this.isFast = event.shiftKey;
    this.isSlow = event.altKey;
  }

  listenToPad() {
    const { pad } = this;
    pad.addEventListener("pointerdown", (event) => {
      pad.setPointerCapture(event.pointerId);
      this.followPad(event);
    });
    pad.addEventListener("pointermove", (event) => {
      if (pad.hasPointerCapture(event.pointerId)) this.followPad(event);
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      pad.addEventListener(kind, () => this.setPad(0, 0));
    }
  }

  /**
   * Moves the pad on the screen to the pointer.
   *
   * @param {PointerEvent} event
   */
  followPad(event) {
    const box = this.pad.getBoundingClientRect();
    const x = event.clientX - box.left - PAD_CENTER;
    const y = event.clientY - box.top - PAD_CENTER;
    this.setPad(x / PAD_REACH, y / PAD_REACH);
  }

  /**
   * Sets the position of the pad on the screen, to the right and down.
   *
   * @param {number} x
   * @param {number} y
   */
  setPad(x, y) {
    const length = Math.max(Math.hypot(x, y), 1);
    this.padPush = [x / length, y / length];
    const [right, down] = M.mul(this.padPush, KNOB_REACH);
    const knob = /** @type {HTMLElement} */ (this.pad.firstElementChild);
    knob.style.transform = `translate(${right}px, ${down}px)`;
    this.app.redraw();
  }

  /**
   * Moves the camera for some time. Returns whether it is moving.
   *
   * @param {number} seconds
   */
  advance(seconds) {
    const { camera } = this.app;
    const [right, down] = this.padPush;
    /** @type {Vector} */
    let push = [right, 0, -down];
    for (const key of this.keys) push = M.add(push, PUSHES[key]);
    let pace = this.paceOfKeys;
    const gamepads = connectedGamepads();
    for (const gamepad of gamepads) {
      const [x, y, turn, tilt] = gamepad.axes.map(withoutDeadZone);
      const pressed = (/** @type {number} */ button) => gamepad.buttons[button]?.value ?? 0;
      push = M.add(push, [x, pressed(RIGHT_TRIGGER) - pressed(LEFT_TRIGGER), -y]);
      if (pressed(RIGHT_SHOULDER)) pace = FAST;
      if (pressed(LEFT_SHOULDER)) pace = SLOW;
      if (turn || tilt) camera.turn(-turn * YAW_SPEED * seconds, -tilt * PITCH_SPEED * seconds);
    }
    const bounded = push.map((part) => M.clamp(part, -1, 1) * pace);
    camera.move(/** @type {Vector} */ (bounded), seconds);
    return gamepads.length > 0 || push.some(Boolean) || camera.velocity.some(Boolean);
  }

  get paceOfKeys() {
    if (this.keys.size === 0) return 1;
    if (this.isFast) return FAST;
    if (this.isSlow) return SLOW;
    return 1;
  }
}

/**
 * Returns whether a key moves the camera.
 *
 * @param {KeyboardEvent} event
 */
function isPush(event) {
  return Object.hasOwn(PUSHES, event.code) && !event.ctrlKey && !event.metaKey;
}

/**
 * Returns whether a key is meant for a control in which the user types or chooses.
 *
 * @param {KeyboardEvent} event
 */
function isTyping({ target }) {
  const typing = "input:not([type=range]):not([type=checkbox]), select";
  return target instanceof Element && target.closest(typing) !== null;
}

/**
 * Returns whether an arrow key is meant for a control of the panel.
 *
 * @param {KeyboardEvent} event
 */
function movesFocus({ code, target }) {
  const isArrow = code.startsWith("Arrow");
  return isArrow && target instanceof Element && target.matches("input, summary, button");
}

function connectedGamepads() {
  if (!navigator.getGamepads) return [];
  return [...navigator.getGamepads()].filter(
    (gamepad) => gamepad?.connected && gamepad.mapping === "standard",
  );
}

/**
 * Returns a stick's value without its dead zone.
 *
 * @param {number} value Value of an axis, -1 to 1.
 */
function withoutDeadZone(value) {
  if (Math.abs(value) < DEAD_ZONE) return 0;
  return (value - DEAD_ZONE * Math.sign(value)) / (1 - DEAD_ZONE);
}
