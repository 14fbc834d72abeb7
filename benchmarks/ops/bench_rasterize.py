"""One asset that fills the picture: frames per second, times of the stages of a frame,
and the error against double precision."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.worlds.procedural import make_asset
from v3dg import _core
from v3dg.cameras import Camera


@dataclass
class Config:
    asset: Path | None = None
    """Trained asset, a .ply file; by default the generated asset."""
    size: int = 800
    repeats: int = 20
    output: str | None = None


def camera_that_fills(gaussians: v3dg.Gaussians, width: int, height: int) -> Camera:
    """Return a camera that looks at the asset from the front and above, at the distance
    where the asset fills the picture."""
    low, high = np.quantile(gaussians.means, [0.01, 0.99], axis=0)
    center, extent = (low + high) / 2, np.linalg.norm(high - low)
    eye = center + extent * np.array([0.0, -0.42, 0.7])
    return Camera.look_at(eye, center, (0.0, 0.0, 1.0), fov_x=0.785, width=width, height=height)


def main(config: Config) -> None:
    gaussians = make_asset() if config.asset is None else v3dg.read_asset(config.asset)
    camera = camera_that_fills(gaussians, config.size, config.size)
    look = {"filter_px2": 0.0, "antialiased": False, "background": [0.0] * 3}
    options = {**look, "with_depth": False, "keep_tape": False}
    rows = gaussians.rows
    in_double = _core.Rows(
        *(getattr(gaussians, f.name).astype(np.float64) for f in fields(gaussians))
    )
    times, stages = [], []
    for _ in range(config.repeats + 3):
        start = time.perf_counter()
        drawn = _core.rasterize(rows, camera.core, **options)
        times.append(time.perf_counter() - start)
        stages.append(drawn.counts)
    exact = _core.rasterize(in_double, camera.core, **options).color
    median = statistics.median(times[3:])
    result = {
        "gaussians": len(gaussians),
        "size": config.size,
        "covered": round(float((drawn.alpha > 0.5).mean()), 3),
        "frame_ms": round(1e3 * median, 2),
        "frame_ms_fastest": round(1e3 * min(times), 2),
        "frames_per_second": round(1 / median, 1),
        **{
            f"{stage}_ms": round(
                1e3 * statistics.median(getattr(s, f"{stage}_seconds") for s in stages[3:]), 2
            )
            for stage in ("project", "bin", "rasterize")
        },
        "records": drawn.counts.records,
        "entries": drawn.counts.entries,
        "largest_error": float(np.abs(drawn.color - exact).max()),
        "mean_error": float(np.abs(drawn.color - exact).mean()),
    }
    print(result)
    record.write(config.output, result)


if __name__ == "__main__":
    main(tyro.cli(Config))
