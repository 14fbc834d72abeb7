"""The effect of each setting of the build: one setting at a time is changed, and the
results are drawn in a layout of many instances.

The study measures gaussians in the frustum, FLIP and PSNR against a given picture at
three tolerances, and the CPU seconds of the build.
docs/notes/experiments/2026-11-22-levels-each-setting.md has the table.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg import metrics

CHANGES: dict[str, dict[str, Any]] = {
    "defaults": {},
    "merge, no fit": {"steps": 0},
    "prune, no fit": {"steps": 0, "init": "prune"},
    "prune, no growth, no fit": {"steps": 0, "init": "prune", "prune_growth": 1.0},
    "prune": {"init": "prune"},
    "200 steps at all levels": {"steps": 200},
    "at most 400 steps": {"steps": 400},
    "800 steps at all levels": {"first_steps": 800},
    "targets: previous level": {"targets": "previous"},
    "targets: not supersampled": {"supersample": 1},
    "no filter": {"filter_px2": 0.0},
    "filter 0.05": {"filter_px2": 0.05},
    "filter 0.2": {"filter_px2": 0.2},
    "fitted at 1 px²": {"px2_per_gaussian": 1.0},
    "fitted at 4 px²": {"px2_per_gaussian": 4.0},
    "128 a cluster": {"cluster_size": 128},
    "512 a cluster": {"cluster_size": 512},
    "D-SSIM 0.2": {"loss_l1": 0.8, "loss_dssim": 0.2},
    "no alpha loss": {"loss_alpha": 0.0},
}


@dataclass
class Config:
    asset: Path
    layout: Path
    truth: Path
    camera: int = 59
    tolerances: tuple[float, ...] = (8.0, 4.4, 3.0)
    only: tuple[str, ...] = ()
    """Names of the changes to measure; by default all."""
    output: str | None = None


def main(config: Config) -> None:
    asset = v3dg.read_asset(config.asset)
    truth = np.asarray(Image.open(config.truth).convert("RGB"), np.float32) / 255
    rows = []
    for change in config.only or tuple(CHANGES):
        start = time.process_time()
        bundle = v3dg.build_bundle(
            asset, config=replace(v3dg.BuildConfig(), **CHANGES[change]), progress=False
        )
        row: dict[str, Any] = {
            "change": change,
            "build_cpu_seconds": round(time.process_time() - start, 1),
        }
        scene, cameras = read_layout(config.layout, bundle)
        camera = list(cameras.values())[config.camera]
        row["frames"] = []
        for tolerance in config.tolerances:
            image = v3dg.render(scene, camera, tolerance=tolerance, device="cpu")
            color = np.round(np.clip(image.color, 0, 1) * 255) / np.float32(255)
            row["frames"].append(
                {
                    "tolerance": tolerance,
                    "gaussians_in_frustum": image.stats.gaussians_in_frustum,
                    "flip": round(metrics.flip(truth, color), 4),
                    "psnr": round(metrics.psnr(truth, color), 2),
                }
            )
        rows.append(row)
        cells = "".join(
            f" | {f['gaussians_in_frustum'] / 1e6:.2f} M {f['flip']:.4f} {f['psnr']:.2f}"
            for f in row["frames"]
        )
        print(f"{change:26s} {row['build_cpu_seconds']:6.1f} s{cells}", flush=True)
    record.write(config.output, {"asset_gaussians": len(asset), "rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Config))
