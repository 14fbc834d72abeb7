// The actions of keys, except for keys that move the camera while they are held.

import { MODES } from "./camera.js";

/** @typedef {import("./app.js").App} App */

const SPEED_STEP = 1.5;

/**
 * Actions by the code of a key. The code depends on the position of the key on the
 * keyboard.
 */
const COMMANDS = /** @type {Record<string, (app: App) => void>} */ ({
  KeyH: (app) => app.places.showAll(),
  KeyL: (app) => app.places.level(),
  KeyM: (app) => app.setMode(MODES[(MODES.indexOf(app.camera.mode) + 1) % MODES.length]),
  KeyB: (app) => app.bookmarks.add(),
  KeyP: (app) => app.toolbar.togglePanel(),
  KeyF: (app) => app.instances.flyToSelected(),
  KeyG: (app) => app.instances.setTool("move"),
  KeyR: (app) => app.instances.setTool("turn"),
  KeyT: (app) => app.instances.setTool("size"),
  Escape: (app) => app.letGo(),
});

/**
 * Executes the action of a key. Returns false if the key has none.
 *
 * @param {App} app
 * @param {KeyboardEvent} event
 */
export function runCommand(app, event) {
  if (!app.scene) return false;
  if (event.ctrlKey || event.metaKey) {
    if (event.code !== "KeyZ") return false;
    app.instances.undo();
    return true;
  }
  if (/^Digit[1-9]$/.test(event.code)) {
    app.bookmarks.open(Number(event.code.at(-1)) - 1);
    return true;
  }
  if (event.key === "+" || event.key === "=") {
    changeSpeed(app, SPEED_STEP);
    return true;
  }
  if (event.key === "-") {
    changeSpeed(app, 1 / SPEED_STEP);
    return true;
  }
  if (!Object.hasOwn(COMMANDS, event.code)) return false;
  COMMANDS[event.code](app);
  return true;
}

/**
 * Multiplies the speed of the camera by a factor.
 *
 * @param {App} app
 * @param {number} factor
 */
function changeSpeed(app, factor) {
  app.camera.setSpeed(app.camera.speed * factor);
  app.sync();
}
