// What the viewer's page and its server say to each other.
// Made by tests/support/page_protocol.py; do not edit.

/** The modes of a picture. */
export type Shows =
  | "appearance"
  | "level"
  | "cluster"
  | "error"
  | "residency"
  | "depth"
  | "alpha"
  | "count"
  | "difference";

/**
 * Asks for a new asset, of the gaussians of a bundle whose centres lie in a box, or
 * of all others.
 *
 * Attributes:
 *     instance: One that shows the bundle.
 *     box: Lower and upper corner, in the bundle's own coordinates.
 *     name: Name of the file, whose end is the format.
 */
export interface Crop {
  type: "crop";
  instance: number;
  box: [[number, number, number], [number, number, number]];
  keep: "inside" | "outside";
  name: string;
}

/** The work that the page asked for has ended. */
export interface Done {
  type: "done";
}

/** Says why the picture that was asked for is not drawn. */
export interface Failed {
  type: "failed";
  text: string;
}

/**
 * What a picture cost.
 *
 * Attributes:
 *     gaussians_selected, gaussians_in_frustum, tolerance, select_ms, draw_ms, levels,
 *     missing: As in `v3dg.Stats`.
 *     memory_bytes: Memory that the viewer's process holds.
 */
export interface Figures {
  gaussians_selected: number;
  gaussians_in_frustum: number;
  tolerance: number;
  select_ms: number;
  draw_ms: number;
  levels: number[];
  missing: number;
  memory_bytes: number;
}

/** A file to save, as bytes. */
export interface File {
  type: "file";
  name: string;
}

/**
 * A camera of the file.
 *
 * Attributes:
 *     photograph: Whether the picture that it took is there.
 */
export interface FileCamera {
  name: string;
  photograph: boolean;
  view: View;
}

/**
 * The first message of a connection.
 *
 * Attributes:
 *     version: Version of the viewer; a page of another one loads itself anew.
 *     up: The direction that is up, in the world.
 *     asks_up: Whether `up` is only assumed, so that the page asks.
 *     home: A view of all of the scene.
 *     settings: What a tab begins with.
 *     defaults: What a setting is that nobody has asked for.
 */
export interface Hello {
  type: "hello";
  version: string;
  up: [number, number, number];
  asks_up: boolean;
  home: View;
  settings: Settings;
  defaults: Settings;
  limits: Limits;
  cameras: FileCamera[];
}

/**
 * The smallest and the largest values that the viewer takes.
 *
 * Attributes:
 *     picture_px: The longer side of a picture, at most.
 *     path_seconds: The length of a path, at most.
 */
export interface Limits {
  tolerance: [number, number];
  budget: [number, number];
  gain: [number, number];
  picture_px: number;
  path_seconds: number;
}

/**
 * Asks for a picture, in place of what was asked for before.
 *
 * Attributes:
 *     size: Width and height of the picture, px.
 *     number: By which the page knows the pictures that answer.
 */
export interface Look {
  type: "look";
  view: View;
  size: [number, number];
  settings?: Settings;
  number?: number;
}

/** Gives an instance a pose. */
export interface Move {
  type: "move";
  instance: number;
  position: [number, number, number];
  quaternion: [number, number, number, number];
  scale: number;
}

/** Something for a person to read, once. */
export interface Notice {
  type: "notice";
  text: string;
}

/**
 * Says that a file follows as bytes, which is then shown.
 *
 * Attributes:
 *     size: Number of bytes.
 */
export interface Open {
  type: "open";
  name: string;
  size: number;
}

/**
 * Asks what is at a place of the picture, or where an instance is.
 *
 * Attributes:
 *     at: The place, in shares of width and height from the upper left corner.
 *     instance: The instance to tell about, whatever is at the place.
 */
export interface Pick {
  type: "pick";
  look: Look;
  at?: [number, number];
  instance?: number | null;
}

/**
 * The instance that was asked about; all fields are unset if there is none.
 *
 * Attributes:
 *     box: Lower and upper corner of its bundle, in the bundle's own coordinates.
 *     bundle: Name of the bundle's file; empty if the bundle is not in a file.
 *     point: The place that was picked, in the world.
 */
export interface Picked {
  type: "picked";
  instance?: number;
  pose?: Pose;
  box?: [[number, number, number], [number, number, number]];
  bundle?: string;
  point?: [number, number, number];
}

/**
 * A picture, as the bytes of a JPEG.
 *
 * Attributes:
 *     final: Whether no other picture follows for the same request.
 *     number: Number of the request.
 *     size: Width and height, px.
 *     view: From where it is seen.
 *     range: The values of the darkest and the brightest colour, where colours are
 *         values.
 *     distance: How deep what is in its middle mostly is, world units; null where
 *         nothing is, or not known.
 */
export interface Picture {
  type: "picture";
  final: boolean;
  number: number;
  size: [number, number];
  view: View;
  shows: Shows;
  range: [number, number] | null;
  distance: number | null;
  figures: Figures;
}

/** The views of a path, to be flown along. */
export interface Play {
  type: "play";
  fps: number;
  views: View[];
}

/** Where an instance is. */
export interface Pose {
  position: [number, number, number];
  quaternion: [number, number, number, number];
  scale: number;
}

/** How far the film that is saved is, 0 to 1. */
export interface Progress {
  type: "progress";
  share: number;
}

/**
 * Asks for a file; or, to play it, for the views of a path.
 *
 * Attributes:
 *     what: The file: a picture, a film of the path, its cameras, or the scene.
 *     look: What is shown, and in which size.
 *     up: The axis that is up, which a scene's file says; null for another direction.
 *     path: Views, each with the seconds from the one before.
 */
export interface Save {
  type: "save";
  what: "cameras" | "film" | "picture" | "play" | "scene";
  look: Look;
  up: "-x" | "-y" | "-z" | "x" | "y" | "z" | null;
  path: [number, View][];
}

/**
 * What the tab shows from now on.
 *
 * Attributes:
 *     center, radius: A ball that holds nearly all of it, world units.
 *     near: Distance of the near plane, world units.
 *     instances: How many there are.
 *     has_files: Whether all its bundles are files, so that it can be saved.
 *     writes_files: Whether the server writes new assets, beside the file that is
 *         shown; otherwise the browser saves them.
 *     level_colors: Colour of each level.
 *     ramp: Colours from the smallest value to the largest.
 *     most_counted: Gaussians in a pixel that get the last colour of the ramp.
 *     modes: What can be shown.
 *     shows_cuts: Whether cuts can be frozen, split and picked from.
 *     missing_colors: Colours of gaussians of whose pages none, one, two and three
 *         levels are missing.
 */
export interface Scene {
  type: "scene";
  name: string;
  center: [number, number, number];
  radius: number;
  near: number;
  instances: number;
  has_files: boolean;
  writes_files: boolean;
  level_colors: [number, number, number][];
  ramp: [number, number, number][];
  most_counted: number;
  modes: Shows[];
  shows_cuts: boolean;
  missing_colors: [number, number, number][];
}

/**
 * What a picture shows, and how finely.
 *
 * Attributes:
 *     shows: The colours, those of a level or a cluster, the error, which is the
 *         screen area that a gaussian of a coarser cluster stands for, expected depth,
 *         alpha, how many gaussians a pixel is blended of, or the difference to the
 *         picture of all gaussians.
 *     tolerance, budget, min_level, fade: As in `v3dg.render`, but that a tolerance is
 *         always given.
 *     gain: What a difference is multiplied by.
 *     split: Share of the width, from the left, that shows all gaussians; 0 for none.
 *     frozen: The view that the cut is chosen for; None for the one that is looked
 *         from.
 */
export interface Settings {
  shows: Shows;
  tolerance: number;
  budget: number | null;
  min_level: number;
  fade: number | null;
  gain: number;
  split: number;
  frozen: View | null;
}

/** Ends the work that `Save` began. */
export interface Stop {
  type: "stop";
}

/**
 * A camera without a size in pixels.
 *
 * Attributes:
 *     wxyz: Rotation from camera (x right, y down, z forward) to world, a quaternion
 *         of any length but zero.
 *     position: Position of the eye, world units.
 *     fov_y: Vertical field of view in radians.
 *     aspect: Width over height.
 */
export interface View {
  wxyz: [number, number, number, number];
  position: [number, number, number];
  fov_y: number;
  aspect: number;
}

/** What the page says. */
export type FromPage = Look | Pick | Move | Save | Crop | Stop | Open;

/** What the viewer says. */
export type FromViewer =
  | Hello
  | Scene
  | Picture
  | Failed
  | Notice
  | Progress
  | Done
  | File
  | Picked
  | Play;
