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

/** The work that the page requested has ended. */
export interface Done {
  type: "done";
}

/** Says why the requested picture is not drawn. */
export interface Failed {
  type: "failed";
  text: string;
}

/**
 * The statistics of a picture.
 *
 * Attributes:
 *     gaussians_selected, gaussians_in_frustum, tolerance, select_ms, draw_ms, levels,
 *     missing: See `v3dg.Stats`. memory_bytes: Memory of the viewer's process.
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
 *     photograph: Whether the photograph of this camera is available.
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
 *     version: Version of the viewer; a page of another version reloads itself.
 *     up: The direction that is up, in the world.
 *     asks_up: Whether `up` is only assumed, so that the page asks the user.
 *     settings: The initial settings of a tab.
 *     defaults: The default of each setting.
 */
export interface Hello {
  type: "hello";
  version: string;
  up: [number, number, number];
  asks_up: boolean;
  settings: Settings;
  defaults: Settings;
  limits: Limits;
  cameras: FileCamera[];
}

/**
 * The first view of a tab in a window of a certain aspect.
 *
 * Attributes:
 *     focus: The point that orbits go around.
 */
export interface Home {
  view: View;
  focus: [number, number, number];
}

/**
 * The limits of values that the viewer accepts.
 *
 * Attributes:
 *     picture_px: Largest length of a picture's longer side.
 *     path_seconds: Largest duration of a path.
 */
export interface Limits {
  tolerance: [number, number];
  budget: [number, number];
  gain: [number, number];
  picture_px: number;
  path_seconds: number;
}

/**
 * Requests a picture; replaces the previous request.
 *
 * Attributes:
 *     size: Width and height of the picture, px.
 *     number: Identifies the pictures that answer this request.
 */
export interface Look {
  type: "look";
  view: View;
  size: [number, number];
  settings?: Settings;
  number?: number;
}

/** Sets the pose of an instance. */
export interface Move {
  type: "move";
  instance: number;
  position: [number, number, number];
  quaternion: [number, number, number, number];
  scale: number;
}

/** A message for the user, shown once. */
export interface Notice {
  type: "notice";
  text: string;
}

/**
 * Announces a file that follows as binary data and is then shown.
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
 * Asks what is at a point of the picture, or where an instance is.
 *
 * Attributes:
 *     at: The point, as fractions of width and height from the upper left corner.
 *     instance: The instance to describe, whatever is at the point.
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
 *     point: The picked point, in the world.
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
 *     final: Whether this is the last picture for its request.
 *     number: Number of the request.
 *     size: Width and height, px.
 *     view: The viewpoint of the picture.
 *     range: The values of the darkest and the brightest colour, if colours represent
 *         values.
 *     distance: Median depth around the middle, world units; null if nothing is there,
 *         or if it is unknown.
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

/** The views of a path, for playback. */
export interface Play {
  type: "play";
  fps: number;
  views: View[];
}

/** The pose of an instance. */
export interface Pose {
  position: [number, number, number];
  quaternion: [number, number, number, number];
  scale: number;
}

/** Progress of the film that is being saved, 0 to 1. */
export interface Progress {
  type: "progress";
  share: number;
}

/**
 * Requests a file; or the views of a path, to play it.
 *
 * Attributes:
 *     what: The file: a picture, a film of the path, its cameras, or the scene.
 *     look: The content and size.
 *     up: The axis that is up, for a scene's file; null for other directions.
 *     path: Views, each with the seconds since the one before.
 */
export interface Save {
  type: "save";
  what: "cameras" | "film" | "picture" | "play" | "scene";
  look: Look;
  up: "-x" | "-y" | "-z" | "x" | "y" | "z" | null;
  path: [number, View][];
}

/**
 * The subject that the tab shows from now on.
 *
 * Attributes:
 *     center, radius: A ball that contains nearly all of it, world units.
 *     near: Distance of the near plane, world units.
 *     homes: First views, from narrow windows to wide ones.
 *     instances: Number of instances.
 *     has_files: Whether all its bundles are in files, so that the scene can be saved.
 *     writes_files: Whether the server writes new assets, beside the file that is
 *         shown; otherwise the browser saves them.
 *     level_colors: Colour of each level.
 *     ramp: Colours from the smallest value to the largest.
 *     most_counted: Number of gaussians in a pixel that gets the last colour of the
 *         ramp.
 *     modes: The available display modes.
 *     shows_cuts: Whether freezing, splitting and picking are available.
 *     missing_colors: Colours of gaussians whose pages miss no, one, two and three
 *         levels.
 */
export interface Scene {
  type: "scene";
  name: string;
  center: [number, number, number];
  radius: number;
  near: number;
  homes: Home[];
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
 * The content and quality of a picture.
 *
 * Attributes:
 *     shows: The gaussians' colours; the colours of levels or clusters; the error,
 *         which is the screen area per gaussian of a coarser cluster; expected depth;
 *         alpha; the number of gaussians blended in a pixel; or the difference to the
 *         picture of all gaussians.
 *     tolerance, budget, min_level, fade: As in `v3dg.render`, but a tolerance is
 *         always set.
 *     gain: Factor of differences.
 *     split: Fraction of the width, from the left, that shows all gaussians; 0 for
 *         none.
 *     frozen: The view that the cut is selected for; None for the view of the picture.
 *     background: Red, green and blue, 0 to 1, behind colours of gaussians; the other
 *         modes are drawn on black.
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
  background: [number, number, number];
}

/** Ends the work that `Save` started. */
export interface Stop {
  type: "stop";
}

/**
 * A camera without a size in pixels.
 *
 * Attributes:
 *     wxyz: Rotation from camera (x right, y down, z forward) to world, a quaternion
 *         of any nonzero length.
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
