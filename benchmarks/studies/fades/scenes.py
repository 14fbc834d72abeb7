"""Measures whether a fade removes pops in scenes: in thousands of instances, in crowds
of captured assets, and in rooms seen from inside.

A picture is divided into windows. The camera of each window drifts towards and away
from the object in the middle of the window, so slowly that no other motion hides a pop.
The cuts are the same as in `fades`.
docs/notes/experiments/2026-11-23-fades-scenes-unfiltered.md discusses the results.

A subject has one of these forms:

- SCENE.json@CAMERA@CAMERA is a scene file or a published layout, seen by some of its
  own cameras.
- BUNDLE.v3dg+CAMERAS.json@CAMERA is a bundle, seen by cameras of another file.
- BUNDLE.v3dg:UP,BUNDLE.v3dg:UP is a crowd of bundles that are scaled to one size, seen
  from within and from above.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.evaluation.evaluation import resized
from benchmarks.evaluation.measure import Row
from benchmarks.evaluation.record import write
from benchmarks.evaluation.steadiness import SUPERSAMPLING, paths_from
from benchmarks.studies.fades.measure import axes, filtered, line, measure, verdict
from v3dg import (
    DEFAULT_FADE,
    DEFAULT_TOLERANCE,
    Bundle,
    Camera,
    Scene,
    read_cameras,
    read_scene,
    render,
)
from v3dg._device import to_host
from v3dg.cleaning import ball_of_most

# Distance between members of a crowd, in radii of the ball around most gaussians.
_PITCH = 2.2
_COVERED, _SEEN = (
    0.9,
    0.25,
)  # minimum alpha of a pixel that shows an object, and minimum fraction of such pixels


@dataclass
class Config:
    subjects: tyro.conf.Positional[tuple[str, ...]]
    """What to draw; the docstring of the module describes the forms."""
    frames: int = 24
    picture: tuple[int, int] = (1920, 1080)
    window: tuple[int, int] = (320, 180)
    windows: int = 0
    """Number of windows per camera, evenly spaced among the windows that show an
    object; 0 for all of them."""
    side: int = 10
    """Number of members per side of a square crowd."""
    fades: tuple[float, ...] = (DEFAULT_FADE,)
    tolerance: float = DEFAULT_TOLERANCE
    paths: tuple[str, ...] = ("drift in", "drift out")
    samples: int = SUPERSAMPLING
    """Samples per side of a pixel of the reference pictures."""
    level_0_filter: float = 0.0
    """Variance in px² of a filter with compensated opacities for level 0; 0 for
    none."""
    device: str = "cpu"
    json: Path | None = None


@dataclass(frozen=True)
class Subject:
    name: str
    scene: Scene
    cameras: dict[str, Camera]


def subject_of(text: str, config: Config) -> Subject:
    """Return the subject that an argument of the command describes."""
    files, *names = text.split("@")
    path, _, camera_file = files.partition("+")
    if ".v3dg:" in files:
        subject = crowd_of(files.split(","), config.side)
    elif camera_file:
        subject = Subject(Path(path).stem, Scene.of(Bundle.open(path)), read_cameras(camera_file))
    else:
        subject = Subject(Path(path).stem, *read_scene(path))
    cameras = {name: subject.cameras[name] for name in names or subject.cameras}
    return Subject(subject.name, with_filter(subject.scene, config.level_0_filter), cameras)


def with_filter(scene: Scene, filter_px2: float) -> Scene:
    """Return the scene with a filter at level 0 of all bundles."""
    changed = Scene()
    for b, bundle in enumerate(scene.bundles):
        mine = scene.instance_bundle == b
        where = scene.positions[mine], scene.quaternions[mine], scene.scales[mine]
        changed.add(filtered(bundle, filter_px2), *where)
    return changed


def crowd_of(members: list[str], side: int) -> Subject:
    """Return a square crowd of assets, scaled to one size and rotated upright. All
    assets occur equally often."""
    random = np.random.default_rng(0)
    who = np.resize(np.arange(len(members)), side * side)
    random.shuffle(who)
    steps = np.arange(side) - 0.5 * (side - 1)
    places = _PITCH * np.stack([*np.meshgrid(steps, steps), np.zeros((side, side))], -1).reshape(
        -1, 3
    )
    scene = Scene()
    for k, member in enumerate(members):
        path, _, up = member.partition(":")
        bundle = Bundle.open(path)
        center, radius = ball_of_most(bundle.level_gaussians(0).means)
        mine = places[who == k]
        yaw = random.uniform(0, 2 * math.pi, len(mine))
        upright = _upright(up or "z")
        turns = np.array([_about_z(angle) @ upright for angle in yaw])
        scene.add(
            bundle,
            positions=mine - (turns @ center) / radius,
            quaternions=np.array([_quaternion(turn) for turn in turns]),
            scales=np.full(len(mine), 1 / radius),
        )
    reach = _PITCH * side / 2
    near: Any = {"width": 1920, "height": 1080, "near": 0.01}
    cameras = {
        "within": Camera.look_at((0, -0.5 * reach, 0.6), (0.2 * reach, reach, -0.2), **near),
        "above": Camera.look_at((0.3 * reach, -2.2 * reach, 1.2 * reach), (0, 0, 0), **near),
    }
    name = "crowd of " + ", ".join(Path(member.partition(":")[0]).stem for member in members)
    return Subject(name, scene, cameras)


def _upright(up: str) -> Any:
    """Return the (3, 3) rotation that maps the asset's vertical axis to z."""
    axis, aside = axes(up)
    return np.stack([aside, np.cross(axis, aside), axis])


def _about_z(angle: float) -> Any:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _quaternion(turn: Any) -> Any:
    """Return the quaternion (w, x, y, z) of a (3, 3) rotation: the eigenvector of the
    largest eigenvalue of a symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    return np.linalg.eigh(np.array(rows))[1][:, -1]


def windows_of(scene: Scene, camera: Camera, config: Config) -> Iterator[tuple[str, Camera, Any]]:
    """Yield windows of a camera's picture: the name, the camera, and the position in
    world space of the object in the middle."""
    camera = resized(camera, config.picture)
    width, height = config.window
    image = render(scene, resized(camera, (480, 270)), depth=True, device=config.device)
    depths, alphas = to_host(image.depth), to_host(image.alpha)
    found = []
    for top in range(0, camera.height - height + 1, height):
        for left in range(0, camera.width - width + 1, width):
            rows = slice(270 * top // camera.height, 270 * (top + height) // camera.height)
            columns = slice(480 * left // camera.width, 480 * (left + width) // camera.width)
            seen = alphas[rows, columns] > _COVERED
            if seen.mean() < _SEEN:
                continue
            K = camera.K.copy()
            K[:2, 2] -= left, top
            part = replace(camera, K=K, width=width, height=height)
            depth = float(np.median(depths[rows, columns][seen]))
            ray = np.array([(width / 2 - part.cx) / part.fx, (height / 2 - part.cy) / part.fy, 1.0])
            place = camera.position + depth * (ray @ camera.viewmat[:3, :3])
            found.append((f"{left},{top}", part, place))
    chosen = range(len(found))
    if config.windows and config.windows < len(found):
        chosen = [
            round((k + 0.5) * len(found) / config.windows - 0.5) for k in range(config.windows)
        ]
    yield from (found[k] for k in chosen)


def main(config: Config) -> None:
    rows: list[Row] = []
    for text in config.subjects:
        subject = subject_of(text, config)
        print(
            f"{subject.name}: {len(subject.scene)} instances of {len(subject.scene.bundles)} "
            "bundles"
        )
        for camera_name, camera in subject.cameras.items():
            for window, first, place in windows_of(subject.scene, camera, config):
                of = {"asset": subject.name, "camera": camera_name, "window": window}
                of["away"] = round(float(np.linalg.norm(first.position - place)), 4)
                for path in paths_from(first, place, config.frames):
                    if path.name in config.paths:
                        found = measure(subject.scene, path, config, of, along_motion=False)
                        rows += found
                        print(f"{subject.name} {camera_name} {window}, {of['away']} away")
                        print(*map(line, found), sep="\n", flush=True)
                report(rows, config)  # writes the results of an interrupted run, too


def report(rows: list[Row], config: Config) -> None:
    """Write all rows that have been measured."""
    settings = {k: v for k, v in vars(config).items() if k not in ("subjects", "json", "device")}
    verdicts = [verdict(rows, fade, ("asset", "camera")) for fade in config.fades]
    write(config.json, {**settings, "rows": rows, "verdict": verdicts}, config.device)


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
