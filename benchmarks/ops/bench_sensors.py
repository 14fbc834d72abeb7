"""Many small cameras among objects: pictures a second of a batch, and of the cameras
one after another.

The scenes are copies of one made asset on a floor, seen at eye level: a few objects, a
crowd, and environments with a camera each, whose instances move in every step. On the
CPU only the first is measured. A captured room with a robot of triangles is seen by
fewer cameras, with every channel.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.ops._robot import draw_robot
from benchmarks.worlds.procedural import make_asset, make_room
from v3dg.gaussians import Array
from v3dg.render import Channel

Row: TypeAlias = dict[str, float]

PITCH = 3.0  # distance of neighbouring objects in units
EYE = 0.9  # height of the cameras in units

# The channels of the room: colour and these.
SENSED: tuple[Channel, ...] = ("depth", "normal", "instance", "label")


@dataclass
class Config:
    device: str = "cuda"
    gaussians: int = 125_000
    """Gaussians of the asset."""
    objects: int = 16
    crowd: int = 700
    distinct: int = 16
    """Copies of the asset in memory; instances take them in turn."""
    cameras: int = 256
    sizes: tuple[int, ...] = (64, 128, 256)
    environments: int = 1024
    instances: int = 8
    """Instances of each environment."""
    room: int = 5_500_000
    """Gaussians of the room; 0 leaves it out."""
    room_bundle: Path | None = None
    """File of the built room; it is written if it does not exist."""
    room_cameras: int = 64
    room_size: int = 128
    only_room: bool = False
    repeats: int = 7
    output: str | None = None


def main(config: Config) -> None:
    result: dict[str, object] = {"cameras": config.cameras, "gaussians": config.gaussians}
    if not config.only_room:
        bundles = make_bundles(config)
        result["objects"] = sizes_of(floor_of(bundles, config.objects), config)
        if config.device == "cuda":
            result["crowd"] = sizes_of(floor_of(bundles, config.crowd), config)
            result["environments"] = environments_of(bundles[0], config)
    if config.room > 0:
        result["room"] = room_of(config)
    for name, rows in result.items():
        print(name, rows, flush=True)
    record.write(config.output, result, config.device)


def make_bundles(config: Config) -> list[v3dg.Bundle]:
    asset = make_asset(config.gaussians)
    bundle = v3dg.build_bundle(asset, progress=False, device=config.device)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "asset.v3dg"
        bundle.write(path)
        copies = [v3dg.Bundle.open(path) for _ in range(config.distinct)]
        for copy in copies:
            copy.gaussians  # noqa: B018 - which reads them
        return copies


def floor_of(bundles: list[v3dg.Bundle], count: int) -> v3dg.Scene:
    """Objects on a grid."""
    scene = v3dg.Scene()
    side = int(np.ceil(np.sqrt(count)))
    place = np.arange(count)
    middle = PITCH / 2 * (side - 1)
    rows = [PITCH * (place % side) - middle, PITCH * (place // side) - middle, np.zeros(count)]
    positions = np.stack(rows, axis=1)
    turn = np.random.default_rng(0).uniform(0, np.pi, count)
    quaternions = np.stack([np.cos(turn), 0 * turn, 0 * turn, np.sin(turn)], axis=1)
    in_turn = [bundles[number % len(bundles)] for number in range(count)]
    scene.add(in_turn, positions, quaternions)
    return scene


def cameras_of(scene: v3dg.Scene, count: int, size: int) -> list[v3dg.Camera]:
    """Cameras at eye level between the objects, which look along the floor."""
    rng = np.random.default_rng(1)
    reach = np.abs(scene.positions[:, :2]).max() + PITCH / 2
    cameras = []
    for _ in range(count):
        eye = np.append(rng.uniform(-reach, reach, 2), EYE)
        angle = rng.uniform(0, 2 * np.pi)
        target = eye + np.array([np.cos(angle), np.sin(angle), -0.15])
        cameras.append(v3dg.Camera.look_at(eye, target, fov_x=1.2, width=size, height=size))
    return cameras


def sizes_of(scene: v3dg.Scene, config: Config) -> list[Row]:
    rows = [row_of(scene, size, config) for size in config.sizes]
    for row in rows:
        print(row, flush=True)
    return rows


def row_of(scene: v3dg.Scene, size: int, config: Config) -> Row:
    cameras = cameras_of(scene, config.cameras, size)
    renderer = v3dg.Renderer(scene, device=config.device, memory=None)
    batch = batch_on(cameras, config.device)
    single = batch_on(cameras[:1], config.device)
    stats = renderer.render_batch(batch).stats
    planes = renderer.render_batch(single).planes
    return {
        "size": size,
        "gaussians": float(stats.gaussians_in_frustum.mean()),
        "parts": stats.num_parts,
        "batch": rate(lambda: renderer.render_batch(batch), config.cameras, config),
        "loop": rate(
            lambda: [renderer.render(camera) for camera in cameras], config.cameras, config
        ),
        "single_in_a_batch": rate(lambda: renderer.render_batch(single), 1, config),
        "single_in_planes": rate(lambda: renderer.render_batch(single, out=planes), 1, config),
        "single": rate(lambda: renderer.render(cameras[0]), 1, config),
        "select_ms": stats.select_ms,
        "draw_ms": renderer.render_batch(batch).stats.draw_ms,
    }


def environments_of(bundle: v3dg.Bundle, config: Config) -> Row:
    import torch

    scene = v3dg.Scene()
    count = config.environments * config.instances
    rng = np.random.default_rng(2)
    start = rng.uniform(-2.5, 2.5, (count, 3)) * [1, 1, 0]
    environment = np.repeat(np.arange(config.environments), config.instances)
    scene.add(bundle, torch.tensor(start, device="cuda"), environment=environment)
    camera = v3dg.Camera.look_at((0, -5, 1.0), (0, 0, 0.4), fov_x=1.0, width=128, height=128)
    batch = v3dg.CameraBatch(
        torch.tensor(np.stack([camera.viewmat] * config.environments), device="cuda"),
        torch.tensor(camera.K, device="cuda"),
        128,
        128,
        environments=torch.arange(config.environments, device="cuda"),
    )
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    positions = torch.tensor(start, device="cuda")
    planes = v3dg.BatchPlanes(torch.empty(config.environments, 128, 128, 4, device="cuda"))

    def step() -> None:
        positions.add_(torch.randn_like(positions), alpha=0.001)
        scene.move(positions=positions)
        renderer.render_batch(batch, out=planes)

    for _ in range(3):
        step()
    gaussians = renderer.render_batch(batch).stats.gaussians_in_frustum.mean()
    return {"gaussians": float(gaussians), "batch": rate(step, config.environments, config)}


def room_of(config: Config) -> Row:
    """A robot of triangles in a captured room: pictures a second without and with
    channels and the robot's z-buffer, into planes of the caller, and replayed as a
    graph on a GPU."""
    scene = v3dg.Scene()
    scene.add(room_bundle(config), label=3)
    cameras = cameras_in_room(config.room_cameras, config.room_size)
    batch = batch_on(cameras, config.device)
    mesh = draw_robot(cameras, config.device)
    renderer = v3dg.Renderer(scene, device=config.device, memory=None)
    planes = planes_of(config)
    gaussians = renderer.render_batch(batch).stats.gaussians_in_frustum.mean()
    row: Row = {"gaussians": float(gaussians)}
    row["robot"] = float((mesh.depth > 0).sum()) / (config.room_cameras * config.room_size**2)

    def draw_all() -> v3dg.RenderedBatch:
        return renderer.render_batch(batch, channels=SENSED, mesh=mesh, out=planes)

    draws: dict[str, Callable[[], object]] = {
        "color": lambda: renderer.render_batch(batch, out=v3dg.BatchPlanes(planes.color)),
        "depth": lambda: renderer.render_batch(batch, depth=True),
        "mesh": lambda: renderer.render_batch(batch, mesh=mesh),
        "ids": lambda: renderer.render_batch(batch, channels=("instance",)),
        "normal": lambda: renderer.render_batch(batch, channels=("normal",)),
        "sensed": lambda: renderer.render_batch(batch, channels=SENSED),
        "all": draw_all,
    }
    for name, draw in draws.items():
        row[name] = rate(draw, config.room_cameras, config)
        print("room", name, row[name], flush=True)
    if config.device == "cuda":
        row["graph"] = graph_rate(draw_all, config)
    return row


def room_bundle(config: Config) -> v3dg.Bundle:
    """Open the built room, or make and build it."""
    path = config.room_bundle
    if path is not None and path.exists():
        return v3dg.Bundle.open(path)
    start = time.perf_counter()
    room = make_room(config.room)
    made = time.perf_counter()
    # A draft, because refining millions of gaussians takes longer than the measurement.
    bundle = v3dg.build_bundle(room, progress=False, device=config.device, quality="draft")
    built = time.perf_counter()
    print(f"room made in {made - start:.1f} s, built in {built - made:.1f} s", flush=True)
    if path is not None:
        bundle.write(path)
    return bundle


def graph_rate(draw: Callable[[], v3dg.RenderedBatch], config: Config) -> float:
    """Pictures a second of a captured graph."""
    import torch

    for _ in range(3):
        draw().wait()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = draw()
    measured = rate(graph.replay, config.room_cameras, config)
    captured.wait()
    return measured


def planes_of(config: Config) -> v3dg.BatchPlanes:
    """Planes of the caller for every channel of the room."""
    shape = (config.room_cameras, config.room_size, config.room_size)
    return v3dg.BatchPlanes(
        empty((*shape, 3), config.device),
        empty(shape, config.device),
        empty(shape, config.device),
        normal=empty((*shape, 3), config.device),
        instance=empty(shape, config.device, "int32"),
        label=empty(shape, config.device, "int32"),
    )


def empty(shape: tuple[int, ...], device: str, dtype: str = "float32") -> Array:
    if device == "cpu":
        return np.zeros(shape, dtype)
    import torch

    return torch.zeros(shape, dtype=getattr(torch, dtype), device=device)


def cameras_in_room(count: int, size: int) -> list[v3dg.Camera]:
    """Cameras at the height of robots' heads, which look around the room or at the
    robot in its middle."""
    rng = np.random.default_rng(3)
    cameras = []
    for number in range(count):
        angle = rng.uniform(0, 2 * np.pi)
        eye = np.array([1.9 * np.cos(angle), 1.5 * np.sin(angle), rng.uniform(0.9, 1.6)])
        target = np.array([*rng.uniform(-0.4, 0.4, 2), 0.8])
        if number % 2 == 1:
            target = eye + rng.normal(size=3) * [1, 1, 0.3]
        view = v3dg.Camera.look_at(eye, target, fov_x=1.2, width=size, height=size, near=0.01)
        cameras.append(view)
    return cameras


def batch_on(cameras: list[v3dg.Camera], device: str) -> v3dg.CameraBatch:
    """The cameras of one size as a batch, on the device."""
    batch = v3dg.CameraBatch.of(cameras)
    if device == "cpu":
        return batch
    import torch

    viewmats = torch.tensor(batch.viewmats, device=device)
    K = torch.tensor(batch.K, device=device)
    return v3dg.CameraBatch(viewmats, K, batch.width, batch.height)


class Timing(Protocol):
    """The options of a measurement that say how often calls are timed, and where."""

    device: str
    repeats: int


def rate(draw: Callable[[], object], count: int, config: Timing, calls: int = 5) -> float:
    """Results a second, from an idle device to an idle device, of several calls in a
    row (on the CPU, one); the median of repeats."""
    if config.device != "cuda":
        calls = 1
    times = []
    for _ in range(config.repeats):
        synchronize(config.device)
        start = time.perf_counter()
        for _ in range(calls):
            draw()
        synchronize(config.device)
        times.append((time.perf_counter() - start) / calls)
    return round(count / statistics.median(times), 1)


def synchronize(device: str) -> None:
    if device == "cuda":
        import torch

        torch.cuda.synchronize()


if __name__ == "__main__":
    main(tyro.cli(Config))
