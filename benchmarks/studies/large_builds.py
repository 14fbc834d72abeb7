"""The cost of large builds: many copies of an asset as one asset, built by `v3dg build`
in separate processes.

For each number of gaussians and memory limit, the study measures the time with reading
and writing, and the peak memory of the host and of the GPU. The copies form a grid, and
their gaussians are displaced slightly, so that no two copies are equal.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record


@dataclass
class Config:
    asset: Path
    """Asset of SH degree 0, a .ply file."""
    millions: tuple[float, ...] = (1, 10, 100)
    """Numbers of gaussians of the builds, in millions."""
    memory: tuple[str, ...] = ("2GiB", "2GiB", "7GiB")
    """Limits of the host memory, one for each build."""
    quality: Literal["draft", "standard", "best"] = "draft"
    device: str = "cuda"
    output: str | None = None


def main(config: Config) -> None:
    base = v3dg.read_asset(config.asset)
    rows = []
    for millions, memory in zip(config.millions, config.memory, strict=True):
        with TemporaryDirectory() as folder:
            asset, bundle = Path(folder, "asset.ply"), Path(folder, "bundle.v3dg")
            count = write_copies(asset, base, int(1e6 * millions))
            row: dict[str, Any] = {"gaussians": count, "memory": memory}
            row["asset_bytes"] = asset.stat().st_size
            command = [
                sys.executable,
                "-m",
                "v3dg",
                "build",
                str(asset),
                "-o",
                str(bundle),
                "--quiet",
            ]
            command += ["--quality", config.quality]
            row |= watched([*command, "--memory", memory, "--device", config.device])
            row["bundle_bytes"] = bundle.stat().st_size
        row["us_a_gaussian"] = round(1e6 * row["seconds"] / count, 3)
        print(json.dumps(row), flush=True)
        rows.append(row)
    record.write(
        config.output, {"device": config.device, "quality": config.quality, "results": rows}
    )


def write_copies(path: Path, base: v3dg.Gaussians, at_least: int) -> int:
    """Write copies of an asset one after the other as a .ply file, until there are at
    least `at_least` gaussians; return the number of gaussians."""
    copies = -(-at_least // len(base))
    side = int(np.ceil(np.sqrt(copies)))
    rng = np.random.default_rng(5)
    one = path.with_name("one.ply")
    v3dg.write_asset(one, base)
    head, _, body = one.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(len(base), -1)
    size = np.ptp(base.means, axis=0).max()
    with path.open("wb") as file:
        old, new = (b"element vertex %d\n" % count for count in (len(base), copies * len(base)))
        file.write(head.replace(old, new) + b"end_header\n")
        for number in range(copies):
            copy = rows.copy()
            place = 1.2 * size * np.array([number % side, number // side, 0])
            copy[:, :3] += place + rng.normal(0, 1e-3 * size, (len(base), 3))
            file.write(copy.tobytes())
    one.unlink()
    return copies * len(base)


def watched(command: list[str]) -> dict[str, Any]:
    """Run a command; return its seconds, and the peak memory in GB of its process on
    the host and of the first GPU."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    most = {"host_gb": 0.0, "gpu_gb": 0.0}

    def watch() -> None:
        while process.poll() is None:
            with Path(f"/proc/{process.pid}/status").open() as file:
                kib = next((int(line.split()[1]) for line in file if line.startswith("VmHWM")), 0)
            most["host_gb"] = max(most["host_gb"], round(kib / 1e6, 3))
            most["gpu_gb"] = max(most["gpu_gb"], gpu_gigabytes())
            time.sleep(0.5)

    watcher = threading.Thread(target=watch)
    watcher.start()
    if process.wait() != 0:
        raise SystemExit(
            f"{' '.join(command)}: failed with exit code {process.returncode}; its messages are "
            "above"
        )
    seconds = time.perf_counter() - start
    watcher.join()
    return {"seconds": round(seconds, 2), **most}


def gpu_gigabytes() -> float:
    """Return the memory in GB that all processes together use on the first GPU; 0
    without a GPU."""
    query = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", "-i", "0"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, check=True, env=os.environ)
    except (OSError, subprocess.CalledProcessError):
        return 0.0
    return round(int(done.stdout.split()[0]) * 1.048576e-3, 3)


if __name__ == "__main__":
    main(tyro.cli(Config))
