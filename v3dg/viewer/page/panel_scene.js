// The panel's folders about the selected instance, and about paths and saving.

import * as controls from "./controls.js";
import { make } from "./elements.js";
import { grouped } from "./figures.js";
import { AS_THE_WINDOW } from "./path.js";

/** @typedef {import("./app.js").App} App */

export class InstancesFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    this.text = controls.addFaintText(parent);
    const row = controls.addRow(parent);
    controls.addButton(row, "Undo", () => app.instances.undo(), "Ctrl+Z");
    if (app.scene.has_files) {
      const title = "Save the current instances and the cameras of the path";
      controls.addButton(row, "Save scene (.json)", () => app.path.save("scene"), title);
    }
  }

  sync() {
    this.text.textContent = this.description;
  }

  get description() {
    const { instances, scene } = this.app;
    const count = grouped(scene.instances);
    if (!instances.selected) {
      const hint = scene.shows_cuts ? "; click one to select it" : "";
      return `${count} in the scene${hint}`;
    }
    const { instance, bundle, pose } = instances.selected;
    const position = pose.position.map(fourDigits).join(" ");
    const name = bundle || "asset";
    return `#${instance} of ${count}: ${name}, at ${position}, scale ${fourDigits(pose.scale)}`;
  }
}

export class PathFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    const { path } = app;
    this.text = controls.addFaintText(parent);
    const range = { low: 0.5, high: 10, step: 0.5, value: path.secondsOfNextStop };
    controls.addSlider(parent, "Seconds per view", range, (seconds) => {
      path.secondsOfNextStop = seconds;
    });
    const row = controls.addRow(parent);
    controls.addButton(row, "Add this view", () => path.addStop());
    controls.addButton(row, "Clear", () => path.clear());
    controls.addButton(row, "Play", () => path.save("play"));
    this.recording = this.addRecording(parent);
    this.addFilmSize(parent);
    const files = controls.addRow(parent);
    controls.addButton(files, "Save film (.mp4)", () => path.save("film"));
    controls.addButton(files, "Save cameras (transforms.json)", () => path.save("cameras"));
    controls.addButton(files, "Stop", () => path.stop());
    this.progress = make("progress", { max: 1, value: 0, hidden: true });
    parent.append(this.progress);
  }

  sync() {
    const { stops, duration } = this.app.path;
    this.text.textContent = "no views yet";
    if (stops.length) this.text.textContent = `${stops.length} views, ${duration.toFixed(1)} s`;
  }

  /**
   * Adds the buttons that record a path.
   *
   * @param {HTMLElement} parent
   */
  addRecording(parent) {
    const { path } = this.app;
    const state = { value: false, title: "Record every view while you fly." };
    return controls.addCheckbox(parent, "Record", state, (isOn) => {
      if (isOn) path.startRecording();
      else path.stopRecording();
    });
  }

  /**
   * Adds the list of film sizes.
   *
   * @param {HTMLElement} parent
   */
  addFilmSize(parent) {
    const { path } = this.app;
    const sizes = ["1280 x 720", "1920 x 1080", AS_THE_WINDOW];
    const state = { options: sizes.map((size) => [size, size]), value: path.filmSize };
    controls.addSelect(parent, "Size", state, (size) => {
      path.filmSize = size;
    });
  }
}

/**
 * Rounds a number to four digits.
 *
 * @param {number} value
 */
function fourDigits(value) {
  return Number(value.toPrecision(4));
}
