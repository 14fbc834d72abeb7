"""The speed of LiDAR scans and panoramas of a crowd from moving poses, with one pose or
several per call, and their differences from those of the CPU.

The crowd is that of `bench_sensors`: copies of a generated asset on a floor, seen at
eye level. Rays go in all directions, so a scan has no frustum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import tyro
from numpy.typing import NDArray

import v3dg
from benchmarks.evaluation import record
from benchmarks.ops import bench_sensors
from v3dg.gaussians import Array

Row: TypeAlias = dict[str, float]

_NAMES = ("range", "intensity", "second_range", "second_intensity", "alpha")


@dataclass
class Config:
    device: str = "cuda"
    gaussians: int = 125_000
    """Number of gaussians of the asset."""
    objects: int = 700
    distinct: int = 16
    """Number of copies of the asset in memory; instances use them in turn."""
    rows: int = 64
    columns: int = 2048
    poses: tuple[int, ...] = (1, 4, 16, 64)
    """Numbers of poses in one call."""
    tolerances: tuple[float, ...] = (3.0,)
    panorama: int = 2048
    """Width of the panoramas in px."""
    compared: int = 2
    """Number of scans that are compared with those of the CPU."""
    repeats: int = 7
    output: str | None = None


def main(config: Config) -> None:
    sensors = bench_sensors.Config(
        device=config.device, gaussians=config.gaussians, distinct=config.distinct
    )
    scene = bench_sensors.floor_of(bench_sensors.make_bundles(sensors), config.objects)
    lidar = lidar_of(config)
    result: dict[str, object] = {
        "rays": config.rows * config.columns,
        "gaussians": config.gaussians * config.objects,
        "scans": [
            scans_of(scene, lidar, count, tolerance, config)
            for tolerance in config.tolerances
            for count in config.poses
        ],
        "panorama": panoramas_of(scene, config),
    }
    if config.device == "cuda" and config.compared > 0:
        result["beside_the_cpu"] = compared(scene, lidar, config)
    for name, rows in result.items():
        print(name, rows, flush=True)
    record.write(config.output, result, config.device)


def lidar_of(config: Config) -> v3dg.Lidar:
    return v3dg.Lidar(
        azimuth=np.linspace(0, 2 * np.pi, config.columns, endpoint=False),
        elevation=np.radians(np.linspace(15, -25, config.rows)),
        near=0.1,
        far=200.0,
    )


def poses_of(scene: v3dg.Scene, count: int) -> NDArray[np.float64]:
    """Return poses at eye level on a path between the objects."""
    reach = np.abs(scene.positions[:, :2]).max()
    way = np.linspace(-0.9, 0.9, count)
    angle = np.linspace(0, 6, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0] = np.cos(angle)
    poses[:, 0, 1] = -np.sin(angle)
    poses[:, 1, 0] = np.sin(angle)
    poses[:, 1, 1] = np.cos(angle)
    poses[:, 0, 3] = reach * way
    poses[:, 1, 3] = reach * np.sin(3 * way) * 0.8
    poses[:, 2, 3] = bench_sensors.EYE
    return poses


def scans_of(
    scene: v3dg.Scene, lidar: v3dg.Lidar, count: int, tolerance: float, config: Config
) -> Row:
    calls = max(1, 64 // count)
    if config.device == "cpu":
        calls = 1
    poses = poses_of(scene, calls * count)
    parts = [on(config.device, part) for part in poses.reshape(calls, count, 4, 4)]
    gaussians: list[int] = []

    def step() -> None:
        for part in parts:
            batch = v3dg.scan(scene, lidar, part, tolerance=tolerance, device=config.device)
            gaussians.extend(batch.gaussians)

    step()
    row = {
        "poses_of_a_call": count,
        "tolerance": tolerance,
        "selected": float(np.mean(gaussians)),
        "scans_per_second": bench_sensors.rate(step, calls * count, config, calls=1),
    }
    print(row, flush=True)
    return row


def panoramas_of(scene: v3dg.Scene, config: Config) -> Row:
    height = bench_sensors.EYE
    view = v3dg.Camera.look_at((0.3, 0.2, height), (1, 1, height), (0, 0, 1), width=64, height=64)
    camera = v3dg.EquirectangularCamera.level(view, (0, 0, 1), config.panorama)

    def step() -> None:
        v3dg.render(scene, camera, device=config.device)

    step()
    return {
        "width": config.panorama,
        "selected": float(v3dg.render(scene, camera, device=config.device).gaussians),
        "pictures_per_second": bench_sensors.rate(step, 1, config, calls=1),
    }


def compared(scene: v3dg.Scene, lidar: v3dg.Lidar, config: Config) -> Row:
    """Return the fractions of rays whose values differ from the CPU's by more than a
    thousandth."""
    poses = poses_of(scene, config.compared)
    on_device = v3dg.scan(scene, lidar, poses, device=config.device)
    on_cpu = v3dg.scan(scene, lidar, poses, device="cpu")
    row: Row = {"hit": float(np.isfinite(on_cpu.range).mean())}
    for name in _NAMES:
        ours = getattr(on_device, name).cpu().numpy()
        is_close = np.isclose(ours, getattr(on_cpu, name), rtol=1e-3, atol=1e-3)
        row[f"{name}_differs"] = float(1 - is_close.mean())
    return row


def on(device: str, array: NDArray[np.float64]) -> Array:
    if device == "cpu":
        return array
    import torch

    return torch.tensor(array, device=device)


if __name__ == "__main__":
    main(tyro.cli(Config))
