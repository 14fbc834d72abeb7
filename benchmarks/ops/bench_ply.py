"""The speed and the memory use of reading and writing .ply files."""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record


@dataclass
class Config:
    num_gaussians: int = 1_000_000
    sh_degree: int = 0
    repeats: int = 5
    seed: int = 0
    json: bool = False


def random_gaussians(num: int, degree: int, seed: int) -> v3dg.Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.standard_normal((num, 4), np.float32)
    return v3dg.Gaussians(
        means=rng.standard_normal((num, 3), np.float32),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.standard_normal((num, 3), np.float32) - 5),
        opacities=rng.random(num, np.float32),
        sh=rng.standard_normal((num, (degree + 1) ** 2, 3), np.float32),
    )


def peak_growth(run: Callable[[], object]) -> int:
    """Return the peak growth of the process's memory in bytes while `run` runs (Linux
    only)."""

    def status(key: str) -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(key))

    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    start = status("VmRSS")
    run()
    return status("VmHWM") - start


def seconds(repeats: int, run: Callable[[], object]) -> list[float]:
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return times[1:]  # the first run is a warm-up


def main(config: Config) -> None:
    gaussians = random_gaussians(config.num_gaussians, config.sh_degree, config.seed)
    report: dict[str, object] = {
        **record.provenance(),
        "num_gaussians": config.num_gaussians,
        "sh_degree": config.sh_degree,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.ply"
        save_bytes = peak_growth(lambda: v3dg.write_asset(path, gaussians))
        load_bytes = peak_growth(lambda: v3dg.read_asset(path))
        file_bytes = path.stat().st_size
        report["file_megabytes"] = file_megabytes = file_bytes / 1e6
        report["save_peak_over_file"] = save_bytes / file_bytes
        report["load_peak_over_file"] = load_bytes / file_bytes
        back = v3dg.read_asset(path)
        report["largest_relative_scale_error"] = float(
            np.max(np.abs(back.scales / gaussians.scales - 1))
        )
        report["largest_opacity_error"] = float(
            np.max(np.abs(back.opacities - gaussians.opacities))
        )
        if not np.array_equal(back.sh, gaussians.sh) or not np.array_equal(
            back.means, gaussians.means
        ):
            raise SystemExit("ply: expected the gaussians that were written, got different ones")
        del back
        for name, run in (
            ("write", lambda: v3dg.write_asset(path, gaussians)),
            ("read", lambda: v3dg.read_asset(path)),
        ):
            times = seconds(config.repeats, run)
            report[f"{name}_ms"] = [
                round(1e3 * t, 2) for t in (min(times), statistics.median(times), max(times))
            ]
            report[f"{name}_megabytes_a_second"] = file_megabytes / statistics.median(times)
    if config.json:
        print(json.dumps(report))
    else:
        for key, value in report.items():
            print(f"{key:30} {value:.4g}" if isinstance(value, float) else f"{key:30} {value}")


if __name__ == "__main__":
    main(tyro.cli(Config))
