"""Scenes of many instances on a GPU: frames in comparison with gsplat, errors, memory,
moving instances and budgets.

There are two parts: a layout of instances of one asset, seen by a range of its cameras;
and fields of very many visible instances. The error of fields is measured on crops,
because nothing can draw all gaussians of a field in one picture.
"""

from __future__ import annotations

import math
import multiprocessing
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import v3dg
from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.assets import layout_bundle, read_layout
from benchmarks.evaluation.measure import Judge, Row, time_ms
from v3dg._judges import mean_of
from v3dg.cameras import Camera
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, to_8bit
from v3dg.render import Renderer
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

# Reference crops of fields need many samples per pixel: an instance may be smaller than
# a pixel, and the gaussians of level 0 have no filter.
_CROP_SUPERSAMPLING = 16
_STEP = 0.005


@dataclass
class Config:
    asset: Path | None = None
    """Trained asset, a .ply file; by default the generated asset."""
    layout: Path | None = None
    """Layout of instances of that asset; by default no layout is measured."""
    cameras: tuple[int, int] = (40, 60)
    """Range of the layout's cameras: the index of the first one, and the index after
    the last one."""
    tolerances: tuple[float, ...] = (DEFAULT_TOLERANCE, 9.0, 9.4)
    budget: int = 3_000_000
    fields: tuple[int, ...] = (100_000, 2_000_000)
    """Numbers of instances of the fields."""
    crops: int = 4
    """Number of crops of a field, each of 64 x 36 px, that are compared with all
    gaussians."""
    repeats: int = 11
    bundle: Path | None = None
    """Levels of that asset, a .v3dg file; by default the asset is built as a draft."""
    gsplat: bool = True
    errors: bool = True
    """Whether pictures are compared with all gaussians, which takes most of a run."""
    output: str | None = None


def main(config: Config) -> None:
    with gpu.PeakMemory():  # records the memory of an idle process
        torch.zeros(1, device=gpu.DEVICE)
    bundle = layout_bundle(config.bundle, config.asset, gpu.DEVICE)
    result: dict[str, Any] = {"repeats": config.repeats, "config": bundle.config}
    judge = Judge()
    if config.layout is not None:
        scene, cameras = read_layout(config.layout, bundle)
        chosen = list(cameras.values())[slice(*config.cameras)]
        result["layout"] = layout(scene, chosen, config, judge)
    result["fields"] = [field(bundle, count, config, judge) for count in config.fields]
    judge.close()
    record.write(config.output, result)


def layout(scene: Scene, cameras: Sequence[Camera], config: Config, judge: Judge) -> Row:
    # All times are measured before pictures are compared, because the comparison uses
    # all cores.
    runs = [frames(scene, cameras, {"tolerance": t}, config.repeats) for t in config.tolerances]
    runs.append(frames(scene, cameras, {"budget": config.budget}, config.repeats))
    moving = movement(scene, cameras[-1], config)
    flown = [flight(scene, cameras, {"tolerance": t}, config.repeats) for t in config.tolerances]
    about: Row = {"instances": len(scene), "cameras": config.cameras}
    if not config.errors:
        frame_rows = [row for row, _ in runs]
        print(*frame_rows, moving, *flown, sep="\n", flush=True)
        return {**about, "frames": frame_rows, "moving": moving, "flights": flown}
    for (row, _), gigabytes in zip(
        runs[:-1], gigabytes_alone(scene.bundles[0], config), strict=True
    ):
        row["gigabytes_alone"] = gigabytes
    truths = [draw_truth(scene, camera, gpu.DEVICE) for camera in cameras]
    peer_ms, peer_pictures = gsplat(scene, cameras, config) if config.gsplat else ([], [])
    rows = []
    for row, pictures in runs:
        errors = judge.errors(zip(truths, pictures, strict=True))
        row |= mean_of(errors, "flip", "psnr")
        row["flip_of_each"] = [e["flip"] for e in errors]
        if peer_ms:
            ratios = [
                ours / peer for ours, peer in zip(row["frame_ms_of_each"], peer_ms, strict=True)
            ]
            row["worst_ratio_to_gsplat"] = round(max(ratios), 4)
        print({k: v for k, v in row.items() if not k.endswith("of_each")}, flush=True)
        print(
            "  farthest:",
            row["frame_ms_of_each"][-1],
            "ms, FLIP",
            row["flip_of_each"][-1],
            flush=True,
        )
        rows.append(row)
    result: Row = {**about, "frames": rows, "moving": moving, "flights": flown}
    if peer_ms:
        errors = judge.errors(zip(truths, peer_pictures, strict=True))
        result["gsplat"] = {
            "frame_ms": round(statistics.fmean(peer_ms), 3),
            "frame_ms_of_each": [round(ms, 3) for ms in peer_ms],
            **mean_of(errors, "flip", "psnr"),
            "flip_of_each": [e["flip"] for e in errors],
        }
        print("gsplat", result["gsplat"]["frame_ms"], result["gsplat"]["flip"], flush=True)
    print(moving, *flown, sep="\n", flush=True)
    return result


def frames(
    scene: Scene, cameras: Sequence[Camera], options: dict[str, Any], repeats: int
) -> tuple[Row, list[Picture]]:
    """Draw every camera with one renderer, from near to far, as in a flight through the
    scene.

    Returns:
        A row of measurements, and the pictures.
    """
    ms, device_ms, select_ms, counts = [], [], [], []
    renderer, gigabytes = drawn_before(scene, cameras, options, repeats)
    for camera in cameras:

        def frame(camera: Camera = camera) -> Any:
            image = renderer.render(camera, **options)
            image.stats  # noqa: B018  waits for the picture
            return image

        ms.append(time_ms(frame, gpu.DEVICE, repeats).median)
        stats = [frame().stats for _ in range(repeats)]
        device_ms.append(statistics.median(s.select_ms + s.draw_ms for s in stats))
        select_ms.append(statistics.median(s.select_ms for s in stats))
        counts.append(stats[-1].gaussians_in_frustum)
    # The pictures are drawn last, so that their memory does not count as the
    # renderer's.
    pictures = [to_8bit(renderer.render(camera, **options).color) for camera in cameras]
    row = {
        **options,
        "frame_ms": round(statistics.fmean(ms), 3),
        "host_ms": round(statistics.fmean(ms) - statistics.fmean(device_ms), 3),
        "select_ms": round(statistics.fmean(select_ms), 4),
        "gaussians_in_frustum": round(statistics.fmean(counts)),
        "peak_gigabytes": round(gigabytes, 2),
        "frame_ms_of_each": [round(t, 3) for t in ms],
        "select_ms_of_each": [round(t, 4) for t in select_ms],
        "gaussians_in_frustum_of_each": counts,
    }
    return row, pictures


def drawn_before(
    scene: Scene, cameras: Sequence[Camera], options: dict[str, Any], repeats: int
) -> tuple[Renderer, float]:
    """Return a renderer that has drawn every camera, and its peak memory in gigabytes.
    No frame here is timed."""
    with gpu.PeakMemory() as peak:
        renderer = Renderer(scene, device=gpu.DEVICE)
        for camera in cameras:
            for _ in range(repeats):
                renderer.render(camera, **options).stats  # noqa: B018  waits for the picture
    return renderer, peak.gigabytes


def gigabytes_alone(bundle: v3dg.Bundle, config: Config) -> list[float]:
    """Return the memory in gigabytes of a process that only draws the layout, for each
    tolerance. The process builds nothing, because it reads the bundle from a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "levels.v3dg"
        bundle.write(path)
        with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as others:
            return [others.apply(_drawing_gigabytes, (path, config, t)) for t in config.tolerances]


def _drawing_gigabytes(path: Path, config: Config, tolerance: float) -> float:
    torch.zeros(1, device=gpu.DEVICE)  # loads what an idle process has loaded
    assert config.layout is not None
    scene, cameras = read_layout(config.layout, v3dg.Bundle.open(path))
    chosen = list(cameras.values())[slice(*config.cameras)]
    return round(drawn_before(scene, chosen, {"tolerance": tolerance}, config.repeats)[1], 3)


def flight(scene: Scene, cameras: Sequence[Camera], options: dict[str, Any], repeats: int) -> Row:
    """Return a row for frames in which each camera moves sideways. A step is 0.5 % of
    the distance between the camera and the middle of the scene."""
    renderer, middle = Renderer(scene, device=gpu.DEVICE), scene.positions.mean(axis=0)
    ms = []
    for camera in cameras:
        step = _STEP * float(np.linalg.norm(camera.position - middle))
        # The cameras are made in advance, because only the time from the call to the
        # finished picture counts.
        views = iter([_aside(camera, step * k) for k in range(3 + repeats)])

        def frame(views: Iterator[Camera] = views) -> None:
            renderer.render(next(views), **options).stats  # noqa: B018  waits for the picture

        ms.append(time_ms(frame, gpu.DEVICE, repeats).median)
    return {**options, "frame_ms": round(statistics.fmean(ms), 3), "step": _STEP}


def _aside(camera: Camera, distance: float) -> Camera:
    viewmat = camera.viewmat.copy()
    viewmat[0, 3] -= distance
    return replace(camera, viewmat=viewmat)


def movement(scene: Scene, camera: Camera, config: Config) -> Row:
    """Return a row with the cost of new positions and rotations of all instances in
    every frame."""
    renderer = Renderer(scene, device=gpu.DEVICE)
    tolerance = config.tolerances[-1]
    host = tuple(np.array(a) for a in (scene.positions, scene.quaternions, scene.scales))
    device = tuple(torch.from_numpy(rows).to(gpu.DEVICE) for rows in host)

    def still() -> None:
        renderer.render(camera, tolerance=tolerance).stats  # noqa: B018

    def moving(poses: tuple[Any, ...]) -> float:
        def frame() -> None:
            positions, quaternions, scales = poses
            scene.move(positions=positions, quaternions=quaternions, scales=scales)
            still()

        return round(time_ms(frame, gpu.DEVICE, 3 * config.repeats).median, 3)

    row = {
        "still_ms": round(time_ms(still, gpu.DEVICE, 3 * config.repeats).median, 3),
        "moved_from_numpy_ms": moving(host),
        "moved_on_device_ms": moving(device),
    }
    positions, quaternions, scales = host
    scene.move(positions=positions, quaternions=quaternions, scales=scales)
    return row


def gsplat(
    scene: Scene, cameras: Sequence[Camera], config: Config
) -> tuple[list[float], list[Picture]]:
    placed = gpu.placed_gaussians(scene)
    ms, pictures = [], []
    with torch.no_grad():
        for camera in cameras:
            ms.append(gpu.time_gsplat(placed, camera, max(3, config.repeats // 3)).median)
            pictures.append(to_8bit(gpu.gsplat_picture(placed, camera, packed=True)[0]))
    return ms, pictures


def field(bundle: v3dg.Bundle, count: int, config: Config, judge: Judge) -> Row:
    """Return a row for a square field of instances with random rotations and sizes, all
    of which are visible."""
    rng = np.random.default_rng(0)
    side = math.isqrt(count - 1) + 1
    means = bundle.level_gaussians(0).means
    pitch = 2.2 * float(np.ptp(means, axis=0).max())
    cells = np.stack(np.divmod(np.arange(count), side), 1) - (side - 1) / 2
    positions = np.concatenate([pitch * cells, np.zeros((count, 1))], 1)
    positions += 0.3 * pitch * rng.uniform(-1, 1, (count, 3))
    scene = Scene()
    scene.add(bundle, positions, rng.normal(size=(count, 4)), rng.uniform(0.7, 1.4, count))
    eye = side * pitch * np.array([0.0, -0.95, 0.45])
    camera = Camera.look_at(eye, (0, 0, -0.1 * side * pitch), width=1920, height=1080, fov_x=1.05)
    row, _ = frames(scene, [camera], {"tolerance": DEFAULT_TOLERANCE}, config.repeats)
    budget = round(0.7 * row["gaussians_in_frustum"])
    if budget > v3dg.select(scene, camera, tolerance=math.inf, device=gpu.DEVICE).num_gaussians:
        limited, _ = frames(scene, [camera], {"budget": budget}, config.repeats)
        row["with_budget"] = {key: limited[key] for key in ("budget", "frame_ms", "select_ms")}
    row |= {"instances": count, "gaussians": count * len(means)}
    if config.errors:
        row |= errors_of_crops(scene, camera, config, judge, rng)
    row = {key: value for key, value in row.items() if not key.endswith("of_each")}
    print(row, flush=True)
    return row


def errors_of_crops(
    scene: Scene, camera: Camera, config: Config, judge: Judge, rng: np.random.Generator
) -> Row:
    """Return the mean errors of crops of a picture, with levels and in full."""
    pairs: list[tuple[Picture, Picture]] = []
    full: list[tuple[Picture, Picture]] = []
    for _ in range(config.crops):
        x, y = rng.integers((400, 500), (1456, 800))
        K = camera.K - [[0, 0, x], [0, 0, y], [0, 0, 0]]
        crop = replace(camera, K=K, width=64, height=36)
        truth = draw_truth(scene, crop, gpu.DEVICE, _CROP_SUPERSAMPLING)
        for kind, tolerance in ((pairs, DEFAULT_TOLERANCE), (full, 0.0)):
            color = v3dg.render(scene, crop, tolerance=tolerance, device=gpu.DEVICE).color
            kind.append((truth, to_8bit(color)))
    row: Row = dict(mean_of(judge.errors(pairs), "flip", "psnr"))
    row["full"] = mean_of(judge.errors(full), "flip", "psnr")
    return row


if __name__ == "__main__":
    main(tyro.cli(Config))
