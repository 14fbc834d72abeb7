"""Measures whether a fade between levels removes pops. Bundles on slow paths are drawn
with fades, with the hard cut, and with all gaussians.

The hard cut is drawn twice: at the tolerance of the fade, and at a lower tolerance at
which it has as many gaussians as the fade. A constant cut, selected in the middle of
the path, is drawn in all frames as well. Its flicker is not popping, and no fade can be
steadier. docs/fades.md discusses the results.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.evaluation.measure import Row
from benchmarks.evaluation.record import write
from benchmarks.evaluation.steadiness import SUPERSAMPLING, Cut, Options, compare, paths_from
from benchmarks.evaluation.steadiness import Path as CameraPath
from v3dg import DEFAULT_FADE, DEFAULT_TOLERANCE, Bundle, Camera, Scene, Selection, select
from v3dg.cleaning import ball_of_most

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_HALVINGS = 24
# Distance of the nearest camera, in radii of the ball around most gaussians.
_FILLS = 2.0
_SPACING = 2.5  # distance between copies in a field, in the same radii


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "bundles",
        nargs="+",
        type=Path,
        help=(".v3dg files, each as PATH or PATH:UP, where UP is an axis such as -y or z"),
    )
    parser.add_argument("--frames", type=int, default=60, help="number of frames of each path")
    parser.add_argument(
        "--side",
        type=int,
        default=1,
        help=("number of copies per side of a square field; 1 for a single copy"),
    )
    parser.add_argument(
        "--size", type=int, default=160, help=("width and height of the pictures in px")
    )
    parser.add_argument(
        "--distances",
        type=float,
        nargs="+",
        default=[1.0, 2.0],
        help=("distances from which paths begin, relative to the nearest one"),
    )
    parser.add_argument("--fades", type=float, nargs="+", default=[DEFAULT_FADE])
    parser.add_argument("--tolerance", type=float, default=DEFAULT_TOLERANCE)
    parser.add_argument("--paths", nargs="+", help="names of the paths to measure; by default all")
    parser.add_argument(
        "--samples",
        type=int,
        default=SUPERSAMPLING,
        help=("samples per side of a pixel of the reference pictures"),
    )
    parser.add_argument(
        "--level-0-filter",
        type=float,
        default=0.0,
        help=("variance in px2 of a filter with compensated opacities for level 0"),
    )
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--json", type=Path, help="JSON file for the results")
    options = parser.parse_args(arguments)

    rows = []
    for name in map(str, options.bundles):
        path, _, up = name.partition(":")
        bundle = filtered(Bundle.open(path), options.level_0_filter)
        scene = field_of(bundle, options.side, up or "z")
        of = {"asset": Path(path).stem, "side": options.side}
        for distance in options.distances:
            first, center = first_camera(bundle, up or "z", distance, options.size)
            for camera_path in paths_from(first, center, options.frames):
                if options.paths and camera_path.name not in options.paths:
                    continue
                rows += measure(scene, camera_path, options, {**of, "distance": distance})
                print(*(line(row) for row in rows[-4 - len(options.fades) :]), sep="\n", flush=True)
    result = {
        "frames": options.frames,
        "size": options.size,
        "tolerance": options.tolerance,
        "rows": rows,
    }
    result |= {"level_0_filter": options.level_0_filter, "samples": options.samples}
    result["verdict"] = [verdict(rows, fade) for fade in options.fades]
    print(*result["verdict"], sep="\n")
    write(options.json, result, options.device)
    return 0


def filtered(bundle: Bundle, filter_px2: float) -> Bundle:
    """Return the bundle with a filter and compensated opacities at level 0, which
    coarser levels already have."""
    if filter_px2 == 0.0:
        return bundle
    clusters = bundle.clusters
    is_fine = clusters.level == 0
    changed = replace(
        clusters,
        filter_px2=np.where(is_fine, np.float32(filter_px2), clusters.filter_px2),
        antialiased=np.where(is_fine, np.uint8(1), clusters.antialiased),
    )
    return Bundle(changed, bundle.groups, bundle.gaussians, bundle.config)


def field_of(bundle: Bundle, side: int, up: str) -> Scene:
    """Return a square field of copies of the bundle. Each copy is rotated about its
    vertical axis by a random angle; the only copy of a field of side 1 is not
    rotated."""
    if side == 1:
        return Scene.of(bundle)
    center, radius = ball_of_most(bundle.level_gaussians(0).means)
    axis, aside = axes(up)
    half_turns = np.random.default_rng(0).uniform(0, math.pi, side * side)[:, None]
    steps = np.arange(side) - side // 2
    across, along = np.meshgrid(steps, steps)
    places = across.reshape(-1, 1) * aside + along.reshape(-1, 1) * np.cross(axis, aside)
    scene = Scene()
    turns = np.concatenate([np.cos(half_turns), np.sin(half_turns) * axis], axis=1)
    scene.add(bundle, positions=_SPACING * radius * places, quaternions=turns)
    scene.move(positions=scene.positions + center - scene.rotations @ center)
    return scene


def axes(up: str) -> tuple[Any, Any]:
    """Return the vertical axis, and an axis perpendicular to it."""
    axis = np.array(_AXES[up[-1]]) * (-1 if up[0] == "-" else 1)
    return axis, np.roll(axis, 1)


def first_camera(bundle: Bundle, up: str, distance: float, size: int) -> tuple[Camera, Any]:
    """Return a camera and the centre of the bundle. `distance` is relative to the
    distance at which the bundle fills a picture."""
    center, radius = ball_of_most(bundle.level_gaussians(0).means)
    axis, aside = axes(up)
    direction = math.cos(0.45) * aside + math.sin(0.45) * axis
    eye = center + distance * _FILLS * radius * direction / np.linalg.norm(direction)
    return Camera.look_at(eye, center, axis, width=size, height=size, near=1e-3 * radius), center


class Stays:
    """The hard cut of one camera, drawn in all frames. It has weights like a fade, so
    that level 0 is drawn with a filter as in a fade."""

    def __init__(self, camera: Camera, tolerance: float) -> None:
        self.camera, self.tolerance = camera, tolerance
        self.cut: Selection | None = None

    def __call__(self, scene: Scene, camera: Camera) -> Options:
        if self.cut is None:
            cut = select(scene, self.camera, tolerance=self.tolerance, cull=False, device="cpu")
            self.cut = replace(cut, given_weights=np.ones(len(cut), np.float32))
        return {"cut": self.cut}


def measure(
    scene: Scene, path: CameraPath, options: Any, of: Row, *, along_motion: bool = True
) -> list[Row]:
    """Measure one path.

    Returns:
        The rows of all gaussians, the hard cut, each fade, the hard cut with as many
        gaussians as the first fade, and the constant cut.
    """
    tolerance = options.tolerance
    cuts: dict[str, Cut] = {"all": {"tolerance": 0.0}, "hard": {"tolerance": tolerance}}
    cuts |= {f"fade {fade:g}": {"tolerance": tolerance, "fade": fade} for fade in options.fades}
    cameras = [
        path.seen_from(k) for k in range(0, len(path.cameras), max(1, len(path.cameras) // 8))
    ]
    count = _mean_count(scene, cameras, tolerance=tolerance, fade=options.fades[0])
    cuts["hard, equal count"] = {"tolerance": _tolerance_of_count(scene, cameras, count, tolerance)}
    cuts["stays"] = Stays(path.seen_from(len(path.cameras) // 2), tolerance)
    rows = compare(
        scene, path, cuts, options.device, along_motion=along_motion, samples=options.samples
    )
    return [{**of, "path": path.name, "is_drift": path.is_drift, **row} for row in rows]


def _mean_count(scene: Scene, cameras: list[Camera], **how: Any) -> float:
    cuts = select(scene, cameras, **how, device="cpu")
    return float(np.mean([cut.num_gaussians for cut in cuts]))


def _tolerance_of_count(scene: Scene, cameras: list[Camera], count: float, most: float) -> float:
    """Return the smallest tolerance, at most `most`, at which the hard cut has at most
    `count` gaussians per frame."""
    low, high = most / 4, most
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        if _mean_count(scene, cameras, tolerance=middle) > count:
            low = middle
        else:
            high = middle
    return high


def verdict(rows: list[Row], fade: float, keys: tuple[str, ...] = ("asset", "distance")) -> Row:
    """Return the result of a fade for each start: its worst values relative to those of
    the hard cut and of all gaussians.

    A start is a combination of values of `keys`. The worst value is taken over drifts,
    if there are any, else over all paths.
    """
    starts = sorted({tuple(row[key] for key in keys) for row in rows})
    found = []
    for start in starts:
        mine = [row for row in rows if tuple(row[key] for key in keys) == start]
        has_drifts = any(row["is_drift"] for row in mine)
        names = {"all": "all", "hard": "hard", "equal": "hard, equal count", "stays": "stays"}
        cuts = {short: [r for r in mine if r["cut"] == name] for short, name in names.items()}
        cuts["fade"] = [r for r in mine if r.get("fade") == fade]
        worst, pop = (
            {
                name: max(r[of] for r in cut if r["is_drift"] or not has_drifts)
                for name, cut in cuts.items()
            }
            for of in ("tile_worst", "pop_worst")
        )
        pairs = list(zip(cuts["fade"], cuts["hard"], cuts["equal"], strict=True))
        found.append(
            {
                **dict(zip(keys, start, strict=True)),
                "worst_tile": worst,
                "worst_pop": pop,
                "of_hard_at_equal_count": round(worst["fade"] / worst["equal"], 3),
                "of_hard": round(worst["fade"] / worst["hard"], 3),
                "of_all": round(worst["fade"] / worst["all"], 3),
                "of_stays": round(worst["fade"] / worst["stays"], 3),
                "pop_of_hard_at_equal_count": round(pop["fade"] / pop["equal"], 3)
                if pop["equal"]
                else None,
                "least_psnr_gain": round(min(f["psnr"] - h["psnr"] for f, h, _ in pairs), 3),
                "mean_psnr_gain": round(
                    float(np.mean([f["psnr"] - h["psnr"] for f, h, _ in pairs])), 3
                ),
                "gaussians": round(
                    float(np.mean([f["gaussians"] / h["gaussians"] for f, h, _ in pairs])), 3
                ),
            }
        )
    return {"fade": fade, "starts": found}


def line(row: Row) -> str:
    """Return a row as a line of text."""
    start = f"{row['asset']:>10} {row['distance']:4g} " if "distance" in row else ""
    warped = (
        f"warped {row['warped_mean']:.3f} {row['warped_worst']:.3f}  "
        if "warped_mean" in row
        else ""
    )
    return (
        f"{start}{row['path']:14} {row['cut']:18} "
        f"{row['gaussians']:9,.0f}  rms {row['rms']:.3f}  tile {row['tile_mean']:.3f} "
        f"{row['tile_p99']:.3f} {row['tile_worst']:.3f}  pop {row['pop_mean']:.3f} "
        f"{row['pop_worst']:.3f}  {warped}changed {row['changed_items']:.0f}  PSNR "
        f"{row['psnr']:.2f}"
    )
