// The panel's folder that crops an asset by a box and saves the part as a new asset.

import * as controls from "./controls.js";
import { make } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Crop} CropMessage */

const PARTS = [
  ["inside", "Keep what is inside"],
  ["outside", "Delete what is inside"],
];

export class CropFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    const { crop } = app;
    this.text = controls.addFaintText(parent);
    const row = controls.addRow(parent);
    const title = "A box around the selected instance, whose faces can be dragged";
    controls.addButton(row, "Draw a box", () => crop.begin(), title);
    controls.addButton(row, "Remove the box", () => crop.end(), "Esc");
    this.options = make("div");
    parent.append(this.options);
    const state = { options: PARTS, value: crop.keep };
    this.part = controls.addSelect(this.options, "Part", state, (key) => {
      crop.keep = /** @type {CropMessage["keep"]} */ (key);
    });
    this.name = make("input", { type: "text" });
    this.name.addEventListener("input", () => {
      crop.name = this.name.value;
    });
    controls.addLabelled(this.options, "New file", this.name, "Its end is the format");
    const place = app.scene.writes_files
      ? "Beside the file that is shown; no file is ever overwritten"
      : "Where the browser saves files";
    controls.addButton(this.options, "Save as a new asset", () => crop.save(), place);
  }

  sync() {
    const { crop } = this.app;
    this.options.hidden = !crop.isOn;
    this.text.textContent = crop.isOn ? crop.text : "crop or delete by a box, as a new asset";
    this.part.set(crop.keep);
    if (document.activeElement !== this.name) this.name.value = crop.name;
  }
}
