// The panel's folder for cropping an asset by a box, and saving the part as a new
// asset.

import * as controls from "./controls.js";
import { make } from "./elements.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Crop} CropMessage */

const PARTS = [
  ["inside", "Keep the inside"],
  ["outside", "Delete the inside"],
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
    const title = "Draw a box around the selected instance; its faces can be dragged";
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
    controls.addLabelled(
      this.options,
      "New file",
      this.name,
      "The end of the name selects the format",
    );
    const place = app.scene.writes_files
      ? "Saved beside the file that is shown; existing files are not overwritten"
      : "Saved by the browser";
    controls.addButton(this.options, "Save as a new asset", () => crop.save(), place);
  }

  sync() {
    const { crop } = this.app;
    this.options.hidden = !crop.isOn;
    this.text.textContent = crop.isOn
      ? crop.text
      : "keep or delete the inside of a box, as a new asset";
    this.part.set(crop.keep);
    if (document.activeElement !== this.name) this.name.value = crop.name;
  }
}
