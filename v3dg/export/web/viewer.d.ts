/** A camera with the OpenCV convention; matrices are row major. */
export interface Pinhole {
  /** World to camera, 16 numbers. */
  viewmat: ArrayLike<number>;
  /** Focal lengths and principal point, px, 9 numbers. */
  k: ArrayLike<number>;
  /** Depth before which no mean may lie, in world units. */
  near: number;
  /** Of the picture, px. */
  width: number;
  height: number;
}

export interface NamedCamera extends Pinhole {
  name: string;
}

export interface Settings {
  /** Most gaussians of a picture. */
  budget: number;
  /** px² that one gaussian of a coarser cluster may stand for. */
  tolerance: number;
  /** Factor around the tolerance within which levels blend; 1: none. */
  fade: number;
  /** Graphics memory for gaussians; fixed when the scene is opened. */
  poolBytes: number;
  /** Red, green and blue, 0 to 1. */
  background: number[];
}

/** The browser or the device cannot draw. The message is for users. */
export class NoDevice extends Error {}

/**
 * A scene on a canvas.
 *
 * Events: `opened`, `firstpicture`, `settled`, `progress` (detail: missing pages), `notice` (detail: text, empty when the state is over), `failure` (detail: text).
 */
export class Viewer extends EventTarget {
  readonly cameras: NamedCamera[];
  readonly up: "x" | "y" | "z" | "-x" | "-y" | "-z" | null;
  /** Centre and radius of the scene; null until it is open. */
  readonly ball: number[] | null;
  readonly numGaussians: number;
  /** Of the cut that is drawn. A budget raises it. */
  readonly tolerance: number;
  readonly numFrames: number;
  readonly receivedBytes: number;
  readonly memoryBytes: number;
  readonly isSettled: boolean;
  setCamera(camera: Pinhole): void;
  set(settings: Partial<Settings>): void;
  /** The picture of the present cut, height * width * 4 numbers. */
  picture(): Promise<Float32Array>;
  close(): void;
}

/** Show a scene file or a bundle on a canvas. */
export function open(
  canvas: HTMLCanvasElement,
  url: string,
  options?: Partial<Settings>,
): Promise<Viewer>;
