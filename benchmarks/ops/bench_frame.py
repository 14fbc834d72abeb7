"""Frames of v3dg on CUDA in comparison with gsplat in one run: times, their ratio, and
the difference of the pictures.

The scenes are a layout of instances at full detail (gsplat gets all gaussians in world
space), random gaussians with the sizes of trained ones, and one asset that fills the
picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from bench_rasterize import camera_that_fills

import v3dg
from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.assets import like_trained, read_layout
from benchmarks.evaluation.measure import time_ms
from benchmarks.worlds.procedural import make_asset
from v3dg.cameras import Camera
from v3dg.levels import BuildConfig, build_bundle
from v3dg.render import Renderer


@dataclass
class Config:
    asset: Path | None = None
    """Trained asset, a .ply file; by default the generated asset."""
    layout: Path | None = None
    """Layout of instances of that asset; by default no layout is measured."""
    cameras: tuple[int, ...] = (45, 50, 55, 59)
    """Indices of cameras of the layout."""
    counts: tuple[int, ...] = (1_000_000, 4_000_000, 20_000_000)
    """Numbers of random gaussians."""
    width: int = 1920
    height: int = 1080
    repeats: int = 11
    gsplat: bool = True
    """Whether gsplat is measured, in its packed and unpacked modes; the faster one
    counts."""
    output: str | None = None


def main(config: Config) -> None:
    rows: list[dict[str, Any]] = []

    def measure(
        name: str, subject: Any, gaussians: v3dg.Gaussians, camera: Camera, options: dict[str, Any]
    ) -> None:
        renderer = Renderer(subject, device=gpu.DEVICE)

        def ours() -> Any:
            frame = renderer.render(camera, **options)
            frame.stats  # noqa: B018  waits for the picture
            return frame

        row: dict[str, Any] = {"scene": name, "gaussians": len(gaussians)}
        row["gaussians_in_frustum"] = ours().stats.gaussians_in_frustum
        row["frame_ms"] = round(time_ms(ours, gpu.DEVICE, config.repeats).median, 3)
        if config.gsplat:
            row.update(
                beside_gsplat(row["frame_ms"], ours().color, gaussians, camera, config.repeats)
            )
        print(row, flush=True)
        rows.append(row)

    asset = make_asset() if config.asset is None else v3dg.read_asset(config.asset)
    if config.layout is not None:
        # The bundle has only one level, because no other level is drawn.
        bundle = build_bundle(
            asset, config=BuildConfig(min_clusters=1 << 30), progress=False, device="cpu"
        )
        scene, cameras = read_layout(config.layout, bundle)
        placed = gpu.placed_gaussians(scene)
        for index in config.cameras:
            name, camera = list(cameras.items())[index]
            measure(f"{config.layout.stem} {name}", scene, placed, camera, {"tolerance": 0.0})
        del placed
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=config.width, height=config.height)
    for count in config.counts:
        gaussians = like_trained(count, camera, gpu.DEVICE)
        measure(f"random {count / 1e6:g} M", gaussians, gaussians, camera, {})
    gaussians = asset.torch(gpu.DEVICE)
    close = camera_that_fills(asset, config.width, config.height)
    measure("close-up", gaussians, gaussians, close, {})

    print_table(rows)
    record.write(
        config.output,
        {"width": config.width, "height": config.height, "frames": rows},
        gpu.DEVICE,
    )


@torch.no_grad()
def beside_gsplat(
    ours_ms: float, color: Any, gaussians: v3dg.Gaussians, camera: Camera, repeats: int
) -> dict[str, Any]:
    def peer(packed: bool) -> Callable[[], Any]:
        return lambda: gpu.gsplat_picture(gaussians, camera, packed=packed)

    packed_ms, unpacked_ms = (
        time_ms(peer(packed), gpu.DEVICE, repeats).median for packed in (True, False)
    )
    error = gpu.picture_error(color, peer(True)()[0])
    torch.cuda.empty_cache()
    return {
        "gsplat_packed_ms": round(packed_ms, 3),
        "gsplat_unpacked_ms": round(unpacked_ms, 3),
        "ratio": round(ours_ms / min(packed_ms, unpacked_ms), 4),
        **error,
    }


def print_table(rows: list[dict[str, Any]]) -> None:
    columns = {
        "scene": "scene",
        "gaussians_in_frustum": "in frustum",
        "frame_ms": "ours ms",
        "gsplat_packed_ms": "gsplat packed",
        "gsplat_unpacked_ms": "unpacked",
        "ratio": "ratio",
        "largest_error": "largest error",
        "psnr": "PSNR",
        "share_over_1_255": "> 1/255",
    }
    print("".join(f"{title:>{32 if key == 'scene' else 14}}" for key, title in columns.items()))
    for row in rows:
        print("".join(f"{row.get(key, ''):>{32 if key == 'scene' else 14}}" for key in columns))


if __name__ == "__main__":
    main(tyro.cli(Config))
