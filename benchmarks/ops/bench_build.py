"""The cost of building bundles: seconds, GPU memory on each device, and the error of
the pictures.

The parts "default" and "paper" build the asset with the default settings and with the
paper's. The part "split" sorts the points of many copies of the asset, and "large"
builds the copies as one asset. If a layout of instances and a reference picture are
given, the results of "default" and "paper" are also drawn, with several numbers of
gaussians in the frustum.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from PIL import Image

import v3dg
from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.assets import many_copies, read_layout
from benchmarks.worlds.procedural import make_asset
from v3dg import _core, metrics
from v3dg.bundle import Bundle
from v3dg.levels import BuildConfig, build_bundle

# tolerance in px² at which every instance is drawn from its coarsest level
_MOST_TOLERANCE = 1e4

Part = Literal["default", "paper", "split", "large"]


@dataclass
class Config:
    parts: tuple[Part, ...] = ("default", "paper", "split", "large")
    devices: tuple[str, ...] = ("cuda",)
    """Devices to build on, "cuda" and "cpu"; the part "large" takes very long on the
    CPU."""
    asset: Path | None = None
    """Trained asset, a .ply file; by default the generated asset."""
    copies: int = 285
    """Copies of the asset in "split" and "large"; 285 copies of the paper's donut are
    13 million gaussians."""
    layout: Path | None = None
    """Layout of instances of that asset."""
    truth: Path | None = None
    """Reference picture for the layout's camera `camera`."""
    camera: int = 59
    in_frustum: tuple[float, ...] = (2.9e6, 5.7e6, 11.5e6, 22.9e6)
    """Numbers of gaussians in the frustum at which the layout is drawn. A search finds
    the tolerance for each number; a bundle's coarsest cut limits how few are
    possible."""
    repeats: int = 3
    output: str | None = None


def main(config: Config) -> None:
    asset = make_asset() if config.asset is None else v3dg.read_asset(config.asset)
    rows = []
    for part in config.parts:
        for device in config.devices:
            if part == "split":
                row = split(many_copies(asset, config.copies).means, device, config.repeats)
            elif part == "large":
                row, _ = build(many_copies(asset, config.copies), BuildConfig(), device, 1)
            else:
                settings = BuildConfig.paper() if part == "paper" else BuildConfig()
                row, bundle = build(asset, settings, device, config.repeats)
                row["pictures"] = pictures(bundle, config)
            row = {"part": part, "device": device, **row}
            print(row, flush=True)
            rows.append(row)
    record.write(config.output, {"asset_gaussians": len(asset), "results": rows}, gpu.DEVICE)


def build(
    asset: v3dg.Gaussians, settings: BuildConfig, device: str, repeats: int
) -> tuple[dict[str, Any], Bundle]:
    """Build several times; return a row with the median time, and the bundle.

    With several repeats, one more run comes first, because the first run of a process
    also loads the kernels.
    """
    seconds = []
    with gpu.PeakMemory() as peak:
        for _ in range(repeats + (repeats > 1)):
            start = time.perf_counter()
            bundle = build_bundle(
                asset, config=settings, progress=False, device=device, quality="draft"
            )
            seconds.append(time.perf_counter() - start)
    row = {
        "gaussians": len(asset),
        "first_seconds": round(seconds[0], 3),
        "seconds": round(float(np.median(seconds[1:] or seconds)), 3),
        "peak_gigabytes": round(peak.gigabytes, 2),
        "levels": bundle.num_levels,
        "mean_error": [round(float(e), 5) for e in bundle.groups.error.mean(axis=0)],
    }
    return row, bundle


def split(means: Any, device: str, repeats: int) -> dict[str, Any]:
    ends = np.array([0, len(means)])
    depth = _core.num_halvings(len(means), BuildConfig().cluster_size)
    points = torch.from_numpy(means).to(gpu.DEVICE) if device == "cuda" else means
    seconds = []
    with gpu.PeakMemory() as peak:
        for _ in range(repeats + 1):
            torch.cuda.synchronize()
            start = time.perf_counter()
            order, offset = _core.median_split(points, ends, depth)
            torch.cuda.synchronize()
            seconds.append(time.perf_counter() - start)
    expected, expected_offset = _core.median_split(means, ends, depth)
    return {
        "points": len(means),
        "seconds": round(float(np.median(seconds[1:])), 4),
        "peak_gigabytes": round(peak.gigabytes, 2),
        "same_as_cpu": bool(
            np.array_equal(torch.as_tensor(order).cpu().numpy(), expected)
            and np.array_equal(offset, expected_offset)
        ),
    }


def pictures(bundle: Bundle, config: Config) -> list[dict[str, Any]]:
    """Return FLIP and PSNR of pictures of the layout with this bundle, for each number
    of gaussians in the frustum."""
    if config.layout is None or config.truth is None:
        return []
    scene, cameras = read_layout(config.layout, bundle)
    camera = list(cameras.values())[config.camera]
    truth = np.asarray(Image.open(config.truth).convert("RGB"), np.float32) / 255

    def draw(tolerance: float) -> Any:
        return v3dg.render(scene, camera, tolerance=tolerance, device=gpu.DEVICE)

    rows = []
    least = draw(_MOST_TOLERANCE).stats.gaussians_in_frustum
    for wanted in config.in_frustum:
        if wanted < least:
            continue
        low, high = math.log(1e-3), math.log(_MOST_TOLERANCE)
        for _ in range(24):  # a lower tolerance selects more gaussians
            middle = (low + high) / 2
            if draw(math.exp(middle)).stats.gaussians_in_frustum > wanted:
                low = middle
            else:
                high = middle
        frame = draw(math.exp(high))
        color = torch.as_tensor(frame.color).cpu().numpy()
        color = np.round(np.clip(color, 0, 1) * 255) / np.float32(255)
        rows.append(
            {
                "tolerance": round(math.exp(high), 4),
                "gaussians_in_frustum": frame.stats.gaussians_in_frustum,
                "flip": round(metrics.flip(truth, color), 4),
                "psnr": round(metrics.psnr(truth, color), 2),
            }
        )
        print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    main(tyro.cli(Config))
