"""The time of each kernel of a frame on a GPU, the time of the frame, and a digest of
its picture.

    python -m benchmarks.studies.frame_kernels \\
        --layout donutsea.json --asset donut.ply --captured ASSETS --names Fungi \\
        -o frame_kernels_h200

ASSETS is a folder as for `pairs`. Captured assets are drawn at full detail, and with
levels at the default tolerance. Random gaussians are drawn at full detail. Instances of
a layout are drawn with levels at several tolerances; 0 is full detail. The time of a
frame is the median of 25, from idle device to idle device with Python's overhead. Times
of kernels are means over a dozen frames under torch's profiler. To compare two
versions, run the study with each version in alternation on one machine; equal digests
show that both versions draw the same bits.
"""

from __future__ import annotations

import collections
import re
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import layout_bundle, read_layout
from benchmarks.evaluation.measure import times_ms
from benchmarks.studies.peers import scenes
from benchmarks.studies.two_versions import digest
from v3dg.cameras import Camera

Row = dict[str, Any]
Frame = tuple[str, Any, Camera, float | None]
"""Name, renderer, camera, and tolerance; the tolerance is None for a subject without
levels."""

_WARM_UPS, _FRAMES, _PROFILED = 4, 25, 12


@dataclass
class Config:
    asset: Path | None = None
    """Trained asset, a .ply file; by default the generated asset."""
    layout: Path | None = None
    """Layout of instances of that asset; by default no layout is measured."""
    cameras: tuple[int, ...] = (40, 45, 50, 55, 59)
    """Indices of cameras of the layout."""
    captured: Path | None = None
    """Folder with assets.json; by default no captured asset is measured."""
    names: tuple[str, ...] = ()
    """Names of assets in that folder."""
    bundle: Path | None = None
    """Levels of the layout's asset, a .v3dg file; by default the asset is built as a
    draft."""
    tolerances: tuple[float, ...] = (9.4, 3.0, 0.0)
    """Tolerances of the layout's frames."""
    counts: tuple[int, ...] = (1_000_000, 4_000_000)
    """Numbers of random gaussians."""
    widths: tuple[int, ...] = (1920, 3840)
    """Widths of pictures in px. Pictures of captured assets and of random gaussians
    have an aspect ratio of 16:9."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File for the results."""


def frames(config: Config) -> Iterator[Frame]:
    if config.captured is not None:
        for name in config.names:
            subject = scenes.captured(config.captured, name, "cuda")
            yield from _sized(
                config, f"{name}, whole", v3dg.Renderer(subject.gaussians), subject.cameras, None
            )
            bundle = v3dg.build_bundle(
                subject.gaussians.numpy(), device="cuda", progress=False, quality="draft"
            )
            yield from _sized(
                config,
                f"{name}, levels",
                v3dg.Renderer(bundle, device="cuda"),
                subject.cameras,
                3.0,
            )
    for count in config.counts:
        subject = scenes.random(count, 3, "cuda")
        yield from _sized(
            config, subject.name, v3dg.Renderer(subject.gaussians), subject.cameras, None
        )
    if config.layout is not None:
        bundle = layout_bundle(config.bundle, config.asset, "cuda")
        scene, views = read_layout(config.layout, bundle)
        renderer = v3dg.Renderer(scene, device="cuda")
        for tolerance in config.tolerances:
            for number in config.cameras:
                name = list(views)[number]
                yield (
                    f"{config.layout.stem}, {name}, tolerance {tolerance:g}",
                    renderer,
                    views[name],
                    tolerance,
                )


def _sized(
    config: Config, name: str, renderer: Any, cameras: Mapping[str, Camera], tolerance: float | None
) -> Iterator[Frame]:
    for view, camera in cameras.items():
        for width in config.widths:
            yield (
                f"{name}, {view}, {width} px",
                renderer,
                scenes.at_size(camera, width, width * 9 // 16),
                tolerance,
            )


def measure(frame: Frame) -> Row:
    """Measure a frame; return the milliseconds of the frame and of each of its kernels,
    and its statistics."""
    import torch
    from torch.profiler import ProfilerActivity, profile

    name, renderer, camera, tolerance = frame
    options = {} if tolerance is None else {"tolerance": tolerance}

    def draw() -> Any:
        image = renderer.render(camera, **options)
        return image, image.stats  # reading the statistics waits for the picture

    for _ in range(_WARM_UPS):
        image, stats = draw()
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        for _ in range(_PROFILED):
            draw()
        torch.cuda.synchronize()
    kernels: collections.Counter[str] = collections.Counter()
    for event in profiled.events():
        if event.device_type.name == "CUDA":
            kernels[_short(event.name)] += event.device_time_total / 1e3 / _PROFILED
    return {
        "frame": name,
        "gaussians_in_frustum": stats.gaussians_in_frustum,
        "milliseconds": round(statistics.median(times_ms(draw, "cuda", _FRAMES)), 4),
        "kernels": {kernel: round(ms, 4) for kernel, ms in kernels.most_common()},
        "digest": digest(image.color),
    }


def _short(name: str) -> str:
    """Return the name of a kernel without namespaces and arguments."""
    found = re.findall(r"(\w+)(?:<|\(|$)", name.replace("(anonymous namespace)::", ""))
    return found[0].removesuffix("_kernel") if found else name


def main(config: Config) -> None:
    rows: list[Row] = []
    for frame in frames(config):
        rows.append(measure(frame))
        record.write(config.output, {"rows": rows}, "cuda")
        kernels = " ".join(
            f"{kernel} {ms:.3f}" for kernel, ms in list(rows[-1]["kernels"].items())[:8]
        )
        print(f"{rows[-1]['frame']}: {rows[-1]['milliseconds']:.3f} ms; {kernels}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config))
