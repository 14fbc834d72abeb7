// Types that several modules of the page use.

import type { App } from "./app.js";

export type Vector = [number, number, number];
/** [w, x, y, z]; of length one if it is a rotation. */
export type Quaternion = [number, number, number, number];
/** A position in the picture or on the page, in px from the upper left corner. */
export type Place = [number, number];
/** The name of a world axis. */
export type Axis = "x" | "y" | "z" | "-x" | "-y" | "-z";
/** The way in which dragging and keys move the camera. */
export type Mode = "orbit" | "fly" | "walk";
/** The part of a pose that dragging a handle of the selected instance changes. */
export type Tool = "move" | "turn" | "size";

/** A camera's pose and field of view (vertical, radians). */
export interface Pinhole {
  wxyz: Quaternion;
  position: Vector;
  fov_y: number;
}

declare global {
  interface Window {
    viewer: App;
  }
}
