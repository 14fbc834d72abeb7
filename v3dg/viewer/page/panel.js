// The panel: statistics of the last picture, and folders of controls.

import { tableOf } from "./controls.js";
import { element, make } from "./elements.js";
import { figuresOf } from "./figures.js";
import { CropFolder } from "./panel_crop.js";
import { FileCamerasFolder, MovementFolder, PlacesFolder } from "./panel_camera.js";
import { PictureFolder } from "./panel_picture.js";
import { InstancesFolder, PathFolder } from "./panel_scene.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./protocol.js").Picture} Picture */
/** @typedef {{ sync: () => void }} Folder */

const KEYS = [
  ["drag", "turn"],
  ["right or Shift drag, two fingers", "move sideways"],
  ["wheel, pinch", "move closer or away"],
  ["click", "orbit around this point, select its instance"],
  ["double click", "fly there"],
  ["W A S D Q E", "fly"],
  ["Shift, Alt", "faster, slower"],
  ["+ −", "speed"],
  ["M", "orbit, fly, walk"],
  ["H", "show all"],
  ["F", "fly to the selected instance"],
  ["L", "turn upright"],
  ["B, 1 … 9", "add a bookmark, go to it"],
  ["G R T", "move, rotate, scale the instance"],
  ["Ctrl+Z", "undo"],
  ["Esc", "deselect"],
  ["P", "show or hide the panel"],
];

export class Panel {
  root = element("panel");
  figures = make("div");
  /**
   * All folders with controls. There are none until a scene is shown.
   *
   * @type {Folder[]}
   */
  folders = [];
  /** @type {MovementFolder} */
  movement = null;
  /** @type {PathFolder} */
  path = null;

  /** @param {App} app */
  constructor(app) {
    this.app = app;
  }

  /** Creates the panel anew for a scene. */
  build() {
    const { app } = this;
    this.figures.replaceChildren();
    this.root.replaceChildren(make("h1", {}, app.scene.name), this.figures);
    const picture = new PictureFolder(app, this.addOpenFolder("Picture"));
    this.movement = new MovementFolder(app, this.addOpenFolder("Movement"));
    this.folders = [picture, this.movement, new PlacesFolder(app, this.addFolder("Places"))];
    if (app.fileCameras.list.length) {
      this.folders.push(new FileCamerasFolder(app, this.addFolder("Cameras of the file")));
    }
    this.folders.push(new InstancesFolder(app, this.addFolder("Instances")));
    this.folders.push(new CropFolder(app, this.addFolder("Crop")));
    this.path = new PathFolder(app, this.addFolder("Path"));
    this.folders.push(this.path);
    const keys = KEYS.map(([key, meaning]) => [make("kbd", {}, key), meaning]);
    this.addFolder("Keys").append(tableOf(keys));
    this.sync();
  }

  /**
   * Adds a closed folder.
   *
   * @param {string} title
   */
  addFolder(title) {
    const folder = make("details", {}, make("summary", {}, title));
    this.root.append(folder);
    return folder;
  }

  /**
   * Adds an open folder.
   *
   * @param {string} title
   */
  addOpenFolder(title) {
    const folder = this.addFolder(title);
    folder.open = true;
    return folder;
  }

  /** Updates the controls after a change that was made elsewhere. */
  sync() {
    for (const folder of this.folders) folder.sync();
  }

  /**
   * Shows the statistics of a picture.
   *
   * @param {Picture} picture
   */
  showFigures(picture) {
    this.figures.replaceChildren(...figuresOf(picture, this.app.scene));
  }

  showPace() {
    this.movement.showPace();
  }

  /**
   * Shows whether a path is being recorded.
   *
   * @param {boolean} isRecording
   */
  showRecording(isRecording) {
    this.path.recording.set(isRecording);
  }

  /**
   * Shows the progress of saving.
   *
   * @param {number} share The fraction of the work that is done, 0 to 1.
   */
  showProgress(share) {
    this.path.progress.hidden = false;
    this.path.progress.value = share;
  }

  hideProgress() {
    this.path.progress.hidden = true;
  }
}
