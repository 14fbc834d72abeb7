"""The host memory of a process that flies over a field of copies, with pools and
without.

The copies are those of `measure.py`. Each flight runs in a separate process, one after
another. The study measures the time of frames, the peak memory of the process (RSS),
and hashes of some settled pictures, which must be equal in all flights. `--degree` adds
SH coefficients to the copies.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.studies.residency import measure as residency

# Environment variable that contains the pool's size for a child process.
POOL = "V3DG_POOL_MEMORY"
MIB = 1 << 20


@dataclass
class Config:
    bundle: Path
    """A .v3dg file to copy."""
    folder: Path
    """Folder for the copies; existing copies are used again."""
    side: int = 18
    degree: int = 3
    pools: tuple[str, ...] = ("none", "512MB")
    rounds: int = 3
    size: tuple[int, int] = (640, 360)
    tolerance: float = 3.0
    frames: int = 240
    device: str = "cpu"
    output: str | None = None


def write_base(config: Config) -> Path:
    """Write the bundle with quantised codes, and with small SH coefficients up to
    `degree`."""
    path = config.folder / "base.v3dg"
    if not path.exists():
        bundle = v3dg.Bundle.open(config.bundle)
        gaussians = bundle.gaussians
        count = (config.degree + 1) ** 2
        sh = np.random.default_rng(0).normal(0, 0.03, (len(gaussians), count, 3)).astype(np.float32)
        known = min(count, gaussians.sh.shape[1])
        sh[:, :known] = gaussians.sh[:, :known]
        changed = dataclasses.replace(gaussians, sh=sh)
        v3dg.Bundle(bundle.clusters, bundle.groups, changed, bundle.config, "quantized").write(path)
    return path


def of_copies(config: Config) -> residency.Config:
    return residency.Config(
        bundle=config.folder / "base.v3dg",
        side=config.side,
        size=config.size,
        tolerance=config.tolerance,
        frames=config.frames,
        device=config.device,
    )


def memory_of_process() -> dict[str, float]:
    """Return memory of this process in MiB: resident, private and peak."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    names = {"rss_mib": "VmRSS", "anonymous_mib": "RssAnon", "most_mib": "VmHWM"}
    found = {name: re.search(rf"{field}:\s*(\d+)", text) for name, field in names.items()}
    return {name: int(match[1]) / 1024 for name, match in found.items() if match}


def fly(config: Config, pool: str) -> dict[str, Any]:
    result: dict[str, Any] = {"before": memory_of_process()}
    paths = [config.folder / f"copy_{number}.v3dg" for number in range(config.side**2)]
    field = residency.Field(of_copies(config), paths)
    bundles = field.scene.bundles
    result["gaussians"] = sum(bundle.num_gaussians for bundle in bundles)
    result["leaves"] = sum(int(b.clusters.offset[b.level_range(0).stop]) for b in bundles)
    result["opened"] = memory_of_process()
    memory = None if pool == "none" else pool
    renderer = v3dg.Renderer(field.scene, device=config.device, memory=memory)
    cameras = field.flight()
    renderer.settle(cameras[0], tolerance=config.tolerance)
    frames = []
    for camera in cameras:
        begin = time.perf_counter()
        image = renderer.render(camera, tolerance=config.tolerance)
        missing = image.stats.missing
        milliseconds = 1e3 * (time.perf_counter() - begin)
        frames.append(
            (milliseconds, missing, image.stats.gaussians_selected, image.stats.tolerance)
        )
    result["flown"] = memory_of_process()
    hashes = []
    for camera in cameras[:: max(1, len(cameras) // 8)]:
        renderer.settle(camera, tolerance=config.tolerance)
        picture = residency.pixels(renderer.render(camera, tolerance=config.tolerance))
        hashes.append(hashlib.sha256(picture.tobytes()).hexdigest()[:16])
    result["most_mib"] = memory_of_process()["most_mib"]
    milliseconds, missing, selected, tolerances = np.array(frames).T
    result |= {f"p{q}_ms": float(np.percentile(milliseconds, q)) for q in (50, 95, 99)}
    result |= {"worst_ms": float(milliseconds.max()), "mean_ms": float(milliseconds.mean())}
    result |= {"mean_missing": float(missing.mean()), "most_missing": int(missing.max())}
    result |= {"mean_selected": float(selected.mean()), "most_tolerance": float(tolerances.max())}
    return result | {"cpu_seconds": time.process_time(), "settled": hashes}


def main(config: Config) -> None:
    config.folder.mkdir(exist_ok=True)
    write_base(config)
    paths = residency.write_copies(of_copies(config), config.folder)
    rows = []
    for number in range(config.rounds):
        for pool in config.pools:
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.studies.residency.pool_memory", *sys.argv[1:]],
                env=os.environ | {POOL: pool},
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            )
            rows.append({"pool": pool, "round": number, **json.loads(done.stdout)})
            shown = {k: round(v, 1) if isinstance(v, float) else v for k, v in rows[-1].items()}
            print({k: v for k, v in shown.items() if k != "settled"}, flush=True)
    result = {
        "config": {k: str(v) for k, v in vars(config).items()},
        "file_bytes": sum(path.stat().st_size for path in paths),
        "are_settled_pictures_the_same": len({tuple(row["settled"]) for row in rows}) == 1,
        "rows": rows,
    }
    print("same settled pictures:", result["are_settled_pictures_the_same"])
    record.write(config.output, {"device": config.device, **result}, config.device)


if __name__ == "__main__":
    chosen = tyro.cli(Config)
    if POOL in os.environ:
        print(json.dumps(fly(chosen, os.environ[POOL])))
    else:
        main(chosen)
