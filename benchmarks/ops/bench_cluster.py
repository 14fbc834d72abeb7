"""The speed of operations on gaussians: splitting an asset into clusters, computing the
bounds of clusters, halving gaussians for a coarser level, and gathering clusters from
instances."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from v3dg import _core


@dataclass
class Config:
    num_gaussians: int = 1_000_000
    cluster_size: int = 256
    group_size: int = 397
    """Number of gaussians in a group; the gaussians of a group are halved together."""
    sh_degree: int = 0
    instances: int = 4
    device: Literal["cpu", "cuda"] = "cpu"
    repeats: int = 5
    seed: int = 0
    output: str | None = None


def random_gaussians(num: int, degree: int, seed: int) -> v3dg.Gaussians:
    """Return random gaussians on a bumpy sphere, similar to a scanned object."""
    rng = np.random.default_rng(seed)
    means = rng.standard_normal((num, 3), np.float32)
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    means *= 1 + 0.05 * np.sin(9 * means[:, ::-1])
    return v3dg.Gaussians(
        means=means,
        quats=rng.standard_normal((num, 4), np.float32),
        scales=np.exp(rng.standard_normal((num, 3), np.float32) - 6),
        opacities=rng.random(num, np.float32),
        sh=rng.standard_normal((num, (degree + 1) ** 2, 3), np.float32),
    )


def placements(leaf_offset: np.ndarray, config: Config) -> dict[str, Any]:
    """Return all clusters of an asset in several instances with random poses."""
    rng = np.random.default_rng(config.seed)
    count, sizes = config.instances, np.tile(np.diff(leaf_offset), config.instances)
    quaternions = rng.standard_normal((count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return {
        "instances": _core.Instances(
            bundle=np.zeros(count, np.int32),
            positions=rng.standard_normal((count, 3)),
            quaternions=quaternions,
            scales=np.ones(count),
            importance=np.ones(count, np.float32),
        ),
        "instance": np.repeat(np.arange(count, dtype=np.int32), len(leaf_offset) - 1),
        "first_row": np.tile(leaf_offset[:-1], count),
        "offset": np.concatenate([[0], np.cumsum(sizes)]),
    }


def operations(
    gaussians: v3dg.Gaussians, config: Config
) -> dict[str, tuple[int, Callable[[], tuple[Any, ...]]]]:
    """Return the operations by name.

    Returns:
        For each operation: the number of input gaussians, and a function that runs the
            operation and returns arrays.
    """
    num = len(gaussians)
    ends, depth = np.array([0, num]), _core.num_halvings(num, config.cluster_size)
    order, leaf_offset = _core.median_split(gaussians.means, ends, depth)
    gaussians = gaussians.subset(order)
    offset = np.append(np.arange(0, num, config.group_size), num)
    halved = np.concatenate([[0], np.cumsum((np.diff(offset) + 1) // 2)])
    one = gaussians.subset(slice(0, min(num, config.group_size)))
    if config.device == "cpu":
        spheres = np.concatenate(
            [gaussians.means, gaussians.scales.max(axis=1, keepdims=True)], axis=1
        )
    else:
        import torch

        spheres = torch.cat([gaussians.means, gaussians.scales.amax(dim=1, keepdim=True)], dim=1)
    tables = placements(leaf_offset, config)
    rows, one_rows = gaussians.rows, one.rows
    one_offset, one_halved = np.array([0, len(one)]), np.array([0, (len(one) + 1) // 2])
    return {
        "median_split": (num, lambda: _core.median_split(gaussians.means, ends, depth)),
        "split_segments": (num, lambda: _core.median_split(gaussians.means, offset, 3)),
        "bound_clusters": (num, lambda: (_core.bound_spheres(spheres, leaf_offset),)),
        "bound_all": (num, lambda: (_core.bound_spheres(spheres, ends),)),
        "prune": (num, lambda: (_core.prune(rows, offset, halved),)),
        "merge": (num, lambda: _core.merge(rows, offset, halved)),
        "merge_one_group": (len(one), lambda: _core.merge(one_rows, one_offset, one_halved)),
        "gather": (
            config.instances * num,
            lambda: _core.gather(bundles=[rows], device=rows.device, **tables),
        ),
    }


def to_host(array: Any) -> Any:
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()


def check_against_cpu(config: Config) -> None:
    """Check that the device gives the same bits as the CPU.

    Raises:
        SystemExit: The results of an operation differ.
    """
    small = random_gaussians(min(config.num_gaussians, 100_000), config.sh_degree, config.seed)
    on_cpu = operations(small, Config(**{**vars(config), "device": "cpu"}))
    on_device = operations(small.torch(config.device), config)
    for name, (_, run) in on_device.items():
        for got, expected in zip(run(), on_cpu[name][1](), strict=True):
            if not np.array_equal(to_host(got), to_host(expected)):
                raise SystemExit(
                    f"{name}: expected the same bits on both devices, got different ones"
                )


def milliseconds(config: Config, run: Callable[[], object]) -> list[float]:
    def wait() -> None:
        if config.device == "cuda":
            import torch

            torch.cuda.synchronize()

    times = []
    for _ in range(config.repeats + 1):
        wait()
        start = time.perf_counter()
        run()
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    return times[1:]  # the first run is a warm-up


def main(config: Config) -> None:
    if config.device == "cuda":
        check_against_cpu(config)
    gaussians = random_gaussians(config.num_gaussians, config.sh_degree, config.seed)
    if config.device == "cuda":
        gaussians = gaussians.torch("cuda")
    result: dict[str, Any] = {"config": vars(config), "milliseconds": {}}
    for name, (num, run) in operations(gaussians, config).items():
        times = milliseconds(config, run)
        median = statistics.median(times)
        result["milliseconds"][name] = {"median": median, "least": min(times), "most": max(times)}
        print(f"{name:16} {median:10.2f} ms  {num / median / 1e3:10.1f} million gaussians a second")
    record.write(config.output, result, config.device)


if __name__ == "__main__":
    main(tyro.cli(Config))
