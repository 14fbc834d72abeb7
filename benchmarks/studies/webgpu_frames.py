"""Frames that WebGPU draws in comparison with frames of CUDA, on one GPU.

    python -m benchmarks.studies.webgpu_frames donut.v3dg donutsea.json -o OUTPUT.json

The study selects one cut for each view, draws it with both, and measures times of
frames without reading pictures back, the time of each step on the device, a whole call
of `v3dg.render`, and the difference of the pictures. docs/webgpu.md has results.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg import Camera, Scene, Selection
from v3dg.metrics import flip, psnr
from v3dg.render.webgpu import frame
from v3dg.render.webgpu.drawer import Drawer, dispatch
from v3dg.render.webgpu.gpu import Gpu

_MOST_STEPS = 64


@dataclass
class Config:
    bundle: tyro.conf.Positional[Path]
    layout: tyro.conf.Positional[Path]
    views: tuple[tuple[int, int], ...] = (
        (50, 1_000_000),
        (50, 2_000_000),
        (50, 4_000_000),
        (42, 1_000_000),
        (59, 4_000_000),
    )
    """Index of a camera, and the budget of its cut."""
    scale: float = 1.0
    """Factor of the size of the pictures."""
    frames: int = 40
    device: str = "cuda"
    """Device to compare with."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None


class TimedDrawer(Drawer):
    """A drawer that can measure each step."""

    def __init__(self) -> None:
        super().__init__(Gpu(["timestamp-query"]))
        self.is_timing = False
        self.names: list[str] = []
        from wgpu import BufferUsage

        self._queries = self.gpu.device.create_query_set(type="timestamp", count=2 * _MOST_STEPS)
        usage = BufferUsage.QUERY_RESOLVE | BufferUsage.COPY_SRC
        self._ticks = self.gpu.buffer(16 * _MOST_STEPS, usage)

    def encode(self, encoder: Any, steps: Any) -> None:
        if not self.is_timing:
            super().encode(encoder, steps)
            return
        self.names = []
        for step in steps:
            first = 2 * len(self.names)
            self.names.append(step.pipeline.label)
            writes = {
                "query_set": self._queries,
                "beginning_of_pass_write_index": first,
                "end_of_pass_write_index": first + 1,
            }
            computing = encoder.begin_compute_pass(timestamp_writes=writes)
            dispatch(computing, step)
            computing.end()
        encoder.resolve_query_set(self._queries, 0, 2 * len(self.names), self._ticks, 0)

    def step_ms(self) -> dict[str, float]:
        """Return the time of each step of the last picture, and of all together."""
        words = self.gpu.read(self._ticks, 16 * len(self.names))
        ticks = words.view(np.uint64).astype(np.float64).reshape(-1, 2)
        times = {"all": (ticks.max() - ticks.min()) / 1e6}
        number_of_sorts = 0
        for name, (first, last) in zip(self.names, ticks, strict=True):
            number_of_sorts += name == "count_digits"
            if name in ("count_digits", "sum_counts", "move_keys"):
                name += " by depth" if number_of_sorts <= 3 else " by tile"
            times[name] = times.get(name, 0.0) + (last - first) / 1e6
        return times


def main(config: Config) -> None:
    bundle = v3dg.Bundle.open(config.bundle)
    scene, cameras = read_layout(config.layout, bundle)
    named = list(cameras.values())
    drawer = TimedDrawer()
    frame._shared._drawer = drawer
    rows = []
    for number, budget in config.views:
        camera = scaled(named[number], config.scale)
        row: dict[str, Any] = {"camera": number, "size": [camera.width, camera.height]}
        cut = v3dg.select(scene, camera, budget=budget, device="cpu")
        row |= {"gaussians": cut.num_gaussians, "tolerance": cut.tolerance}
        row |= measured(scene, camera, cut, drawer, config)
        rows.append(row)
        print(json.dumps(row), flush=True)
        if config.output is not None:
            result = {"adapter": drawer.gpu.name, "frames": config.frames, "views": rows}
            provenance = record.provenance(config.device)
            config.output.write_text(json.dumps({**provenance, **result}, indent=1) + "\n")


def scaled(camera: Camera, scale: float) -> Camera:
    """Return a camera with a smaller picture."""
    k = np.array(camera.K, np.float64)
    k[:2] *= scale
    width = round(camera.width * scale)
    height = round(camera.height * scale)
    return Camera(viewmat=camera.viewmat, K=k, width=width, height=height, near=camera.near)


def measured(
    scene: Scene, camera: Camera, cut: Selection, drawer: TimedDrawer, config: Config
) -> dict[str, Any]:
    """Return errors and times of one cut."""

    def render() -> v3dg.RenderedImage:
        return v3dg.render(scene, camera, cut=cut, device="webgpu")

    picture = render().color
    renderer = v3dg.Renderer(scene, device=config.device, memory=None)
    expected = to_host(renderer.render(camera, cut=cut).color)
    row: dict[str, Any] = {
        "psnr": round(float(psnr(clipped(picture), clipped(expected))), 2),
        "flip": round(float(flip(clipped(picture), clipped(expected))), 5),
    }
    row["render_ms"] = median_ms(render, 3)
    row["frame_ms"] = round(frame_ms(cut, scene, camera, drawer, config.frames), 4)
    row["step_ms"] = steps_of(cut, scene, camera, drawer)
    row["pairs"] = drawer._num_items("pair_sizes")
    if config.device == "cuda":
        row["cuda_frame_ms"] = round(cuda_frame_ms(renderer, camera, cut, config.frames), 4)
        row["ratio"] = round(row["frame_ms"] / row["cuda_frame_ms"], 2)
    return row


def laid_out(cut: Selection, scene: Scene, drawer: Drawer) -> Any:
    codes = [frame._codes_of(bundle) for bundle in scene.bundles]
    places = drawer.pool.bring_in(scene.bundles, frame._pages_of(cut, scene, codes))
    return frame.lay_out(scene, cut.instance_ids, cut.cluster_ids, cut.given_weights, codes, places)


def frame_ms(
    cut: Selection, scene: Scene, camera: Camera, drawer: TimedDrawer, count: int
) -> float:
    """Return the time of a frame, without reading it back, of frames that are enqueued
    one after another. The frame must have been drawn before."""
    packed = laid_out(cut, scene, drawer)
    drawer.draw(packed, scene, camera, 1e-4)
    start = time.perf_counter()
    for _ in range(count):
        drawer._submit(packed.num_gaussians, camera)
    drawer._num_items("sizes")  # waits
    return 1e3 * (time.perf_counter() - start) / count


def steps_of(cut: Selection, scene: Scene, camera: Camera, drawer: TimedDrawer) -> dict[str, float]:
    """Return median times of all steps."""
    packed = laid_out(cut, scene, drawer)
    drawer.is_timing = True
    rows = []
    for _ in range(7):
        drawer._submit(packed.num_gaussians, camera)
        rows.append(drawer.step_ms())
    drawer.is_timing = False
    return {name: round(statistics.median(row[name] for row in rows), 4) for name in rows[0]}


def cuda_frame_ms(renderer: v3dg.Renderer, camera: Camera, cut: Selection, count: int) -> float:
    """Return the time of a frame of CUDA with the same tolerance, of frames that are
    enqueued one after another; selection on the device is included."""
    import torch

    for _ in range(3):
        image = renderer.render(camera, tolerance=cut.tolerance)
        assert image.stats.gaussians_selected == cut.num_gaussians
    events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
    events[0].record()
    for _ in range(count):
        renderer.render(camera, tolerance=cut.tolerance)
    events[1].record()
    torch.cuda.synchronize()
    return float(events[0].elapsed_time(events[1])) / count


def to_host(array: Any) -> Any:
    if isinstance(array, np.ndarray):
        return array
    return array.cpu().numpy()


def clipped(picture: Any) -> Any:
    return np.clip(picture, 0, 1)


def median_ms(call: Callable[[], object], count: int) -> float:
    times = []
    for _ in range(count):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return round(statistics.median(times), 2)


if __name__ == "__main__":
    main(tyro.cli(Config))
