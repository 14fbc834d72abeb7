"""The effect of a page pool on frames: flights and teleports over a field of many
different copies.

Copies of a bundle are written with slightly different colours of all gaussians, so that
no two copies share a page. They are placed in a grid. Pools have several sizes,
relative to the memory that a view needs. Runs begin with or without the files in the
system's cache. The study measures the time of frames, the bytes read, the number of
missing pages, and the error against the settled picture. After a teleport, it also
measures the errors of both pictures against all gaussians at 4 x 4 samples per pixel.
The row without a pool shows the frames when everything is resident. On a GPU, rows also
have the device memory of the process.
"""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
import os
import time
from collections.abc import Collection
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.steadiness import true_picture
from v3dg import _device
from v3dg.metrics import psnr


@dataclass
class Config:
    bundle: Path
    """A .v3dg file to copy."""
    side: int = 3
    """Number of copies per side of the grid."""
    size: tuple[int, int] = (640, 360)
    tolerance: float = 3.0
    frames: int = 120
    """Number of frames of a flight across the field."""
    hz: float = 0.0
    """Frames per second of flights and teleports; 0 for as fast as possible."""
    shares: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    """Numbers of slots of the pools, relative to the largest number that a view of the
    flight needs."""
    pools: tuple[str, ...] = ()
    """Sizes of more pools, such as 2GB."""
    device: str = "cpu"
    is_whole_drawn: bool = True
    """Whether the field is also drawn without a pool."""
    folder: Path | None = None
    """Folder for the copies; by default a temporary one."""
    output: str | None = None


def write_copies(config: Config, folder: Path) -> list[Path]:
    """Write copies of the bundle, each with different colours."""
    paths = [folder / f"copy_{number}.v3dg" for number in range(config.side**2)]
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as processes:
        list(processes.map(write_copy, [config.bundle] * len(paths), range(len(paths)), paths))
    return paths


def write_copy(of: Path, number: int, path: Path) -> None:
    if path.exists():
        return
    bundle = v3dg.Bundle.open(of)
    gaussians = bundle.gaussians
    sh = gaussians.sh.copy()
    sh[:, 0] += np.random.default_rng(number).normal(0, 0.05, sh[:, 0].shape).astype(np.float32)
    changed = dataclasses.replace(gaussians, sh=sh)
    v3dg.Bundle(bundle.clusters, bundle.groups, changed, bundle.config, bundle.codec).write(path)


class Field:
    """A grid of copies at distances of 1, and cameras above it."""

    def __init__(self, config: Config, paths: list[Path]) -> None:
        self.config, self.paths = config, paths
        self.scene = v3dg.Scene()
        for number, path in enumerate(paths):
            bundle = v3dg.Bundle.open(path)
            box = bundle.clusters.box[bundle.clusters.parent_group < 0]
            low, high = box[:, 0].min(axis=0), box[:, 1].max(axis=0)
            scale = 1 / float((high - low)[:2].max())
            place = np.array([number % config.side, number // config.side, 0.0])
            middle = scale * np.append((low + high)[:2] / 2, low[2])
            self.scene.add(bundle, positions=place - middle, scales=scale)

    def camera(self, at: float) -> v3dg.Camera:
        """Return a camera above the field; `at` is 0 at the near edge and 1 at the far
        edge."""
        width, height = self.config.size
        across, along = 0.5 * (self.config.side - 1), at * self.config.side - 0.8
        eye = (across + 0.3 * np.sin(6 * at), along, 0.6)
        target = (across, along + 1.0, 0.1)
        return v3dg.Camera.look_at(eye, target, (0, 0, 1), 1.0, width=width, height=height)

    def flight(self) -> list[v3dg.Camera]:
        return [self.camera(at) for at in np.linspace(0, 0.8, self.config.frames)]

    def drop_cached_pages(self) -> None:
        """Ask the operating system to drop the files from its cache, where it supports
        that."""
        for path in self.paths:
            descriptor = os.open(path, os.O_RDONLY)
            os.fsync(descriptor)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(descriptor)

    def memory(self, num_slots: int) -> int:
        """Return the bytes of a pool with about `num_slots` slots."""
        bundles = self.scene.bundles
        degree = max(bundle.sh_degree for bundle in bundles)
        num_sh = 3 * (degree + 1) ** 2
        of_row, of_cluster = 4 * (11 + num_sh), 0
        if all(bundle.codec == "quantized" for bundle in bundles):
            of_row, of_cluster = 16 + 8 * degree, 72 + 16 * degree
        elif self.config.device != "cpu":
            of_row = 4 * (16 + (-(-num_sh // 4) * 4 if degree else 0))

        def size(of_each: int, firsts: list[np.ndarray]) -> int:
            counts = [np.diff(first) for first in firsts]
            most = max(int(count[:-1].max()) for count in counts)
            return of_each * (sum(int(count[-1]) for count in counts) + num_slots * most)

        num_bytes = size(of_row, [bundle._layout.first_gaussian for bundle in bundles])
        num_bytes += size(of_cluster, [bundle._layout.first_cluster for bundle in bundles])
        most_on_the_way = (64 if self.config.device == "cpu" else 128) << 20
        return num_bytes + min(most_on_the_way, num_bytes // 7) + 4096


def timed(
    config: Config, renderer: v3dg.Renderer, cameras: list[v3dg.Camera], kept: Collection[int] = ()
) -> list[dict[str, Any]]:
    """Draw pictures one after the other; return the time and the statistics of each,
    and the pictures whose numbers are in `kept`."""
    frames, start = [], time.perf_counter()
    for number, camera in enumerate(cameras):
        if config.hz:
            time.sleep(max(0.0, start + number / config.hz - time.perf_counter()))
        begin = time.perf_counter()
        image = renderer.render(camera, tolerance=config.tolerance)
        stats = image.stats._asdict()
        frames.append({"ms": 1e3 * (time.perf_counter() - begin), **stats})
        if number in kept:
            frames[-1]["picture"] = pixels(image)
    return frames


def summary(frames: list[dict[str, Any]]) -> dict[str, Any]:
    ms = np.array([frame["ms"] for frame in frames])
    result = {f"p{q}_ms": float(np.percentile(ms, q)) for q in (50, 95, 99)} | {
        "worst_ms": float(ms.max())
    }
    for name in ("missing", "bytes_in", "gaussians_selected"):
        values = np.array([frame[name] for frame in frames])
        result |= {f"mean_{name}": float(values.mean()), f"most_{name}": int(values.max())}
    return result | {"most_tolerance": max(frame["tolerance"] for frame in frames)}


def errors(frames: list[dict[str, Any]], truth: dict[int, np.ndarray]) -> dict[str, Any]:
    """Return the mean and the smallest PSNR of pictures against the settled ones; equal
    pictures count as 100 dB."""
    values = [min(100.0, float(psnr(truth[number], frames[number]["picture"]))) for number in truth]
    return {"mean_psnr": float(np.mean(values)), "least_psnr": float(np.min(values))}


def bytes_on_device(config: Config) -> int | None:
    """Return the memory in use on the GPU; other processes must not use the GPU
    meanwhile."""
    if config.device == "cpu":
        return None
    import torch

    free, total = torch.cuda.mem_get_info()
    return total - free


def pixels(image: v3dg.Image) -> np.ndarray:
    return np.clip(_device.to_host(image.color), 0, 1)


def teleport(
    config: Config, field: Field, memory: int, truth: np.ndarray, *, cold: bool
) -> dict[str, Any]:
    """Teleport from one end of the field to the other, and draw pictures until no page
    is missing."""
    renderer = v3dg.Renderer(field.scene, device=config.device, memory=memory)
    renderer.settle(field.camera(0), tolerance=config.tolerance)
    renderer.render(field.camera(0), tolerance=config.tolerance).stats  # noqa: B018
    if cold:
        field.drop_cached_pages()
    start, curve = time.perf_counter(), []
    while time.perf_counter() - start < 20:
        if config.hz:
            time.sleep(max(0.0, start + len(curve) / config.hz - time.perf_counter()))
        image = renderer.render(field.camera(0.8), tolerance=config.tolerance)
        missing, seconds = image.stats.missing, time.perf_counter() - start
        curve.append({"seconds": seconds, "missing": missing, "picture": pixels(image)})
        if len(curve) > 3 and not any(frame["missing"] for frame in curve[-2:]):
            break
    renderer.settle(field.camera(0.8), tolerance=config.tolerance)
    settled = pixels(renderer.render(field.camera(0.8), tolerance=config.tolerance))
    best = float(psnr(truth, settled))
    for frame in curve:
        picture = frame.pop("picture")
        frame["psnr"] = min(100.0, float(psnr(settled, picture)))
        frame["psnr_to_truth"] = float(psnr(truth, picture))
    far = [number for number, frame in enumerate(curve, 1) if frame["psnr_to_truth"] < best - 0.5]
    # Number of the first picture after which all pictures are within 0.5 dB.
    near = far[-1] if far else 0
    return {
        "cold": cold,
        "frames_until_settled": len(curve),
        "settled_psnr_to_truth": best,
        "frames_until_half_a_db": near + 1,
        "seconds_until_half_a_db": curve[near]["seconds"],
        "curve": curve[:200],
    }


def main(config: Config) -> None:
    idle = bytes_on_device(config)
    with TemporaryDirectory() as temporary:
        folder = config.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        field = Field(config, write_copies(config, folder))
        cameras = field.flight()
        begin = time.perf_counter()
        roomy = v3dg.Renderer(field.scene, device=config.device, memory=field.memory(10**9 // 400))
        roomy.render(cameras[0], tolerance=config.tolerance).stats  # noqa: B018
        first_ms = 1e3 * (time.perf_counter() - begin)
        truth, most_needed = {}, 0
        for number in range(0, len(cameras), max(1, len(cameras) // 12)):
            roomy.settle(cameras[number], tolerance=config.tolerance)
            most_needed = max(most_needed, roomy._frame._pool.core.status().needed)
            truth[number] = pixels(roomy.render(cameras[number], tolerance=config.tolerance))
        del roomy
        result: dict[str, Any] = {
            # Paths are recorded without their folders.
            "config": {k: str(getattr(v, "name", v)) for k, v in vars(config).items()},
            "gaussians": sum(bundle.num_gaussians for bundle in field.scene.bundles),
            "leaves": sum(
                int(b.clusters.offset[b.level_range(0).stop]) for b in field.scene.bundles
            ),
            "file_bytes": sum(path.stat().st_size for path in field.paths),
            "first_picture_ms": first_ms,
            "most_needed_slots": most_needed,
            "flights": [],
            "teleports": [],
        }
        if config.is_whole_drawn:
            renderer = v3dg.Renderer(field.scene, device=config.device)
            timed(config, renderer, cameras[:3])
            frames = timed(config, renderer, cameras, truth)
            result["flights"].append({"share": None, **summary(frames), **errors(frames, truth)})
            print(result["flights"][-1], flush=True)
            del renderer
            v3dg.residency.residency.clear()
        pools: list[tuple[float | None, int | str]] = [(None, memory) for memory in config.pools]
        pools += [(share, field.memory(int(share * most_needed))) for share in config.shares]
        for (share, memory), cold in itertools.product(pools, (False, True)):
            renderer = v3dg.Renderer(field.scene, device=config.device, memory=memory)
            renderer.settle(cameras[0], tolerance=config.tolerance)
            if cold:
                field.drop_cached_pages()
            frames = timed(config, renderer, cameras, truth)
            row = {
                "share": share,
                "memory": memory,
                "cold": cold,
                **summary(frames),
                **errors(frames, truth),
            }
            if idle is not None:
                row["bytes_of_process"] = (bytes_on_device(config) or 0) - idle
            result["flights"].append(row)
            print(row, flush=True)
            del renderer
        far_end = true_picture(field.scene, field.camera(0.8), config.device)
        v3dg.residency.residency.clear()
        for cold in (False, True):
            row = teleport(config, field, field.memory(2 * most_needed), far_end, cold=cold)
            result["teleports"].append(row)
            print({k: v for k, v in row.items() if k != "curve"}, flush=True)
        record.write(config.output, {"device": config.device, **result}, config.device)
