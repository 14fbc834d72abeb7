// Mouse, touch, keys and gamepad.

import * as M from "./math.js";

const WAYS = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0],
  ArrowUp: [0, 0, 1], ArrowDown: [0, 0, -1], ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0],
  PageUp: [0, 1, 0], PageDown: [0, -1, 0],
};
const CLICK_PX = 5;
const CLICK_MS = 500;
const DEAD = 0.14; // of a stick that rests

export class Input {
  constructor(element, pad, app) {
    this.element = element;
    this.app = app;
    this.keys = new Set();
    this.pointers = new Map();
    this.padPush = [0, 0];
    this.isFast = this.isSlow = false;
    this.lastClick = null;
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel"]) element.addEventListener(kind, (event) => this.release(event));
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    window.addEventListener("keydown", (event) => this.key(event, true));
    window.addEventListener("keyup", (event) => this.key(event, false));
    window.addEventListener("blur", () => this.keys.clear());
    this.addPad(pad);
  }

  place(event) {
    const box = this.element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    this.element.focus({ preventScroll: true });
    this.element.setPointerCapture(event.pointerId);
    const [x, y] = this.place(event);
    const { app } = this;
    this.pointers.set(event.pointerId, { x, y });
    const slack = event.pointerType === "touch" ? 24 : 11;
    if (this.pointers.size === 1) {
      this.start = { x, y, time: performance.now(), moved: false, button: event.button };
      app.held = event.button === 0 ? app.overlay.handleAt(x, y, slack) : null;
    } else {
      this.start.moved = true; // two fingers are no click
      app.held = null;
    }
  }

  move(event) {
    const [x, y] = this.place(event);
    const { app } = this;
    const before = this.pointers.get(event.pointerId);
    if (!before) {
      const hovered = app.overlay.cameraAt(x, y);
      if (hovered !== app.hovered) {
        app.hovered = hovered;
        this.element.title = hovered < 0 ? "" : app.cameras[hovered].name;
        app.redraw();
      }
      return;
    }
    if (Math.hypot(x - this.start.x, y - this.start.y) > CLICK_PX) this.start.moved = true;
    const { camera } = app;
    const height = this.element.clientHeight;
    const [dx, dy] = [x - before.x, y - before.y];
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const spread = (p) => Math.max(Math.hypot(p.x - other.x, p.y - other.y), 10);
      camera.approach(M.clamp(spread(before) / spread({ x, y }), 0.5, 2));
      this.pan(dx / 2, dy / 2);
    } else if (app.held) {
      app.setPose(app.overlay.dragged(app.held, x, y));
    } else if (!this.start.moved) {
      return; // until it is clear that it is no click
    } else if (this.start.button !== 0 || event.shiftKey) {
      this.pan(dx, dy);
    } else if (camera.mode === "orbit") {
      camera.turn((-Math.PI * dx) / height, (-Math.PI * dy) / height);
    } else {
      camera.turn((camera.fov_y * dx) / height, (camera.fov_y * dy) / height);
    }
    this.pointers.set(event.pointerId, { x, y });
    app.redraw();
  }

  pan(dx, dy) {
    const { camera } = this.app;
    const step = (2 * Math.tan(camera.fov_y / 2) * Math.max(camera.distance, 0.05 * camera.radius)) / this.element.clientHeight;
    camera.shift(-dx * step, -dy * step, 0);
  }

  release(event) {
    const { app } = this;
    if (!this.pointers.delete(event.pointerId)) return;
    if (app.held) {
      app.letGo();
    } else if (event.type === "pointerup" && !this.start.moved && this.start.button === 0 && performance.now() - this.start.time < CLICK_MS) {
      this.click(...this.place(event));
    }
  }

  click(x, y) {
    const { app } = this;
    const now = performance.now();
    const isDouble = this.lastClick && now - this.lastClick.time < 400 && Math.hypot(x - this.lastClick.x, y - this.lastClick.y) < 12;
    this.lastClick = { x, y, time: now };
    const camera = app.overlay.cameraAt(x, y);
    if (camera >= 0) app.lookThrough(camera);
    else app.pick(x / this.element.clientWidth, y / this.element.clientHeight, isDouble);
  }

  wheel(event) {
    event.preventDefault();
    const lines = event.deltaY * (event.deltaMode === 1 ? 33 : 1);
    const { camera } = this.app;
    if (camera.mode === "orbit") camera.approach(Math.exp(M.clamp(lines, -300, 300) * 0.0012));
    else camera.shift(0, 0, -M.clamp(lines, -300, 300) * 0.002 * camera.pace);
    this.app.redraw();
  }

  key(event, isDown) {
    [this.isFast, this.isSlow] = [event.shiftKey, event.altKey];
    const isTyping = event.target.closest?.("input:not([type=range]):not([type=checkbox]), select");
    if (!isDown) this.keys.delete(event.code);
    if (isTyping) return;
    if (event.code in WAYS && !event.ctrlKey && !event.metaKey) {
      if (event.code.startsWith("Arrow") && event.target.matches?.("input, summary, button")) return;
      if (isDown) this.keys.add(event.code);
      event.preventDefault();
      this.app.redraw();
    } else if (isDown && !event.repeat && this.app.command(event)) {
      event.preventDefault();
    }
  }

  addPad(pad) {
    const knob = pad.firstElementChild;
    const set = (x, y) => {
      const far = Math.max(Math.hypot(x, y), 1);
      this.padPush = [x / far, y / far];
      knob.style.transform = `translate(${35 * this.padPush[0]}px, ${35 * this.padPush[1]}px)`;
      this.app.redraw();
    };
    const follow = (event) => {
      const box = pad.getBoundingClientRect();
      set((event.clientX - box.left - 55) / 45, (event.clientY - box.top - 55) / 45);
    };
    pad.addEventListener("pointerdown", (event) => {
      pad.setPointerCapture(event.pointerId);
      follow(event);
    });
    pad.addEventListener("pointermove", (event) => pad.hasPointerCapture(event.pointerId) && follow(event));
    for (const kind of ["pointerup", "pointercancel"]) pad.addEventListener(kind, () => set(0, 0));
  }

  // Move the camera for so many seconds; returns whether anything pushes it.
  advance(seconds) {
    const { camera } = this.app;
    let push = [this.padPush[0], 0, -this.padPush[1]];
    for (const key of this.keys) push = M.add(push, WAYS[key]);
    let pace = this.isFast && this.keys.size ? 4 : this.isSlow && this.keys.size ? 0.25 : 1;
    const pads = navigator.getGamepads ? [...navigator.getGamepads()].filter((pad) => pad?.connected && pad.mapping === "standard") : [];
    for (const pad of pads) {
      const [x, y, turn, tilt] = pad.axes.map((value) => (Math.abs(value) < DEAD ? 0 : (value - DEAD * Math.sign(value)) / (1 - DEAD)));
      const pressed = (i) => pad.buttons[i]?.value ?? 0;
      push = M.add(push, [x, pressed(7) - pressed(6), -y]);
      if (pressed(5)) pace = 4;
      if (pressed(4)) pace = 0.25;
      if (turn || tilt) camera.turn(-turn * 1.8 * seconds, -tilt * 1.4 * seconds);
    }
    camera.move(push.map((part) => M.clamp(part, -1, 1) * pace), seconds);
    return pads.length > 0 || push.some(Boolean) || camera.velocity.some(Boolean);
  }
}
