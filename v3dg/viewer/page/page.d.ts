// Types of the page's own values, which several of its modules use.

import type { App } from "./app.js";

export type Vector = [number, number, number];
/** [w, x, y, z], of length one where it is a rotation. */
export type Quaternion = [number, number, number, number];
/** Position in the picture or on the page, px from the upper left corner. */
export type Place = [number, number];
/** Name of a world axis: "x", "-z" and so on. */
export type Axis = "x" | "y" | "z" | "-x" | "-y" | "-z";
/** How dragging and keys move the camera. */
export type Mode = "orbit" | "fly" | "walk";
/** What dragging a handle of the selected instance changes. */
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
