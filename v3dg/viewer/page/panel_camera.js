// The panel's folders about the camera: movement, places, and the cameras of the file.

import * as controls from "./controls.js";
import { make } from "./elements.js";
import { degrees, radians } from "./math.js";

/** @typedef {import("./app.js").App} App */
/** @typedef {import("./page.js").Axis} Axis */

const UP_AXES = ["z", "y", "x", "-z", "-y", "-x"];
/** The option for an up direction that is not an axis. Choosing it has no effect. */
const OTHER = "other";

export class MovementFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    this.speed = this.addSpeed(parent);
    this.fov = this.addFieldOfView(parent);
    this.up = this.addUp(parent);
    const row = controls.addRow(parent);
    controls.addButton(row, "Show all", () => app.places.showAll(), "H");
    controls.addButton(row, "Level", () => app.places.level(), "Turn the camera upright (L)");
    this.pace = controls.addFaintText(parent);
  }

  sync() {
    const { camera, places } = this.app;
    this.speed.set(camera.speed);
    this.fov.set(degrees(camera.fov_y));
    this.up.set(places.upAxis ?? OTHER);
  }

  showPace() {
    const { camera, scene } = this.app;
    const pace = Number(camera.pace.toPrecision(2));
    const radius = controls.shortText(scene.radius);
    this.pace.textContent = `${pace} units a second; the scene's radius is ${radius}`;
  }

  /**
   * Adds the slider of the speed.
   *
   * @param {HTMLElement} parent
   */
  addSpeed(parent) {
    const range = {
      low: 0.02,
      high: 20,
      isLogarithmic: true,
      value: this.app.camera.speed,
      text: (/** @type {number} */ speed) => `× ${Number(speed.toPrecision(2))}`,
      title: "Speed of flying and walking. 1 adapts to the size of the scene and to near objects.",
    };
    return controls.addSlider(parent, "Speed", range, (speed) => {
      this.app.camera.setSpeed(speed);
      this.app.sync();
    });
  }

  /**
   * Adds the slider of the field of view.
   *
   * @param {HTMLElement} parent
   */
  addFieldOfView(parent) {
    const range = {
      low: 10,
      high: 120,
      step: 1,
      value: degrees(this.app.camera.fov_y),
      text: (/** @type {number} */ angle) => `${Math.round(angle)}°`,
    };
    return controls.addSlider(parent, "Field of view", range, (angle) => {
      this.app.camera.fov_y = radians(angle);
      this.app.sync();
    });
  }

  /**
   * Adds the list of up axes.
   *
   * @param {HTMLElement} parent
   */
  addUp(parent) {
    const state = {
      options: [...UP_AXES, OTHER].map((axis) => [axis, axis]),
      value: this.app.places.upAxis ?? OTHER,
      title: "The axis that points up. The camera orbits around it.",
    };
    return controls.addSelect(parent, "Up", state, (axis) => {
      if (axis === OTHER) this.app.sync();
      else this.app.places.setUp(/** @type {Axis} */ (axis));
    });
  }
}

export class PlacesFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    const placeholder = "x y z, #12 or a camera's name";
    this.text = make("input", { type: "text", placeholder });
    const title = "A point, the number of an instance, or the name of a camera";
    controls.addLabelled(parent, "Go to", this.text, title);
    this.text.addEventListener("keydown", (event) => {
      if (event.key === "Enter") this.go();
    });
    const row = controls.addRow(parent);
    controls.addButton(row, "Go", () => this.go());
    controls.addButton(row, "Add bookmark", () => app.bookmarks.add(), "B");
    const copyTitle = "An address of this view with these settings";
    controls.addButton(row, "Copy link", () => app.linkState.copy(), copyTitle);
    this.bookmarks = make("ul");
    parent.append(this.bookmarks);
  }

  go() {
    this.app.places.goTo(this.text.value);
  }

  sync() {
    const { bookmarks } = this.app;
    const items = bookmarks.list.map(({ name }, i) => {
      const item = make("li");
      controls.addButton(item, `${i + 1}  ${name}`, () => bookmarks.open(i));
      controls.addButton(item, "✕", () => bookmarks.remove(i), "Remove");
      return item;
    });
    this.bookmarks.replaceChildren(...items);
  }
}

export class FileCamerasFolder {
  /**
   * @param {App} app
   * @param {HTMLElement} parent
   */
  constructor(app, parent) {
    this.app = app;
    this.addCameras(parent);
    this.frusta = this.addFrusta(parent);
    this.addFrustumSize(parent);
    if (app.fileCameras.hasPhotographs) this.addOpacity(parent);
  }

  sync() {
    this.frusta.set(this.app.fileCameras.showsFrusta);
  }

  /**
   * Adds the list of cameras.
   *
   * @param {HTMLElement} parent
   */
  addCameras(parent) {
    const { fileCameras } = this.app;
    const names = fileCameras.list.map(({ name }, i) => [String(i), name]);
    const state = { options: [["", ""], ...names], value: "" };
    controls.addSelect(parent, "Camera", state, (index) => {
      if (index !== "") fileCameras.lookThrough(Number(index));
    });
  }

  /**
   * Adds the checkbox that shows frusta.
   *
   * @param {HTMLElement} parent
   */
  addFrusta(parent) {
    const { fileCameras } = this.app;
    const state = {
      value: fileCameras.showsFrusta,
      title: "Click a frustum to look through its camera",
    };
    return controls.addCheckbox(parent, "Show as frusta", state, (isOn) => {
      fileCameras.showFrusta(isOn);
    });
  }

  /**
   * Adds the slider of the size of frusta.
   *
   * @param {HTMLElement} parent
   */
  addFrustumSize(parent) {
    const { fileCameras } = this.app;
    const value = fileCameras.frustumSize;
    const range = { low: 0.005, high: 0.5, isLogarithmic: true, value };
    controls.addSlider(parent, "Size of frusta", range, (size) => {
      fileCameras.setFrustumSize(size);
    });
  }

  /**
   * Adds the slider of the opacity of photographs.
   *
   * @param {HTMLElement} parent
   */
  addOpacity(parent) {
    const { fileCameras } = this.app;
    const range = { low: 0, high: 100, step: 5, value: 100 * fileCameras.opacity };
    controls.addSlider(parent, "Photograph %", range, (percent) => {
      fileCameras.setOpacity(percent / 100);
    });
  }
}
