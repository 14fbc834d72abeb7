"""Forward and backward of random gaussians on CUDA, beside gsplat's where that is installed.

The error of our gradients is measured against float64 on the CPU, with fewer gaussians in a
smaller picture.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import record
import torch
import tyro

import v3dg
from v3dg.cameras import Camera

NAMES = ("means", "quats", "scales", "opacities", "sh")


@dataclass
class Config:
    gaussians: int = 1_000_000
    width: int = 1920
    height: int = 1080
    sh_degree: int = 3
    size_px: float = 1.5
    """Median of the largest standard deviation; the spread is as in trained scenes, log-normal by 0.8."""
    filter_px2: float = 0.3
    antialiased: bool = False
    repeats: int = 30
    seed: int = 0
    output: str | None = None


def camera_of(config: Config) -> Camera:
    K = [[config.width, 0, config.width / 2], [0, config.width, config.height / 2], [0, 0, 1]]
    return Camera(np.eye(4), K, config.width, config.height)


def random_gaussians(config: Config) -> v3dg.Gaussians:
    """All over the picture and a tenth beyond, flat and long ones, opacities heaped at both ends."""
    rng = np.random.default_rng(config.seed)
    n = config.gaussians
    depth = rng.uniform(2, 8, n)
    place = rng.uniform(-0.1, 1.1, (n, 2)) * [config.width, config.height] - [
        config.width / 2,
        config.height / 2,
    ]
    largest = config.size_px * np.exp(0.8 * rng.normal(size=n)) * depth / config.width
    shape = np.exp(-rng.uniform(0, 2.5, (n, 3)))
    shape[:, 0] = 1
    decay = 1.0 / (1 + np.arange((config.sh_degree + 1) ** 2))
    arrays = (
        np.column_stack([place * depth[:, None] / config.width, depth]),
        rng.normal(size=(n, 4)),
        largest[:, None] * shape,
        1 / (1 + np.exp(-2 * rng.normal(size=n))),
        rng.uniform(-0.3, 0.3, (n, len(decay), 3)) * decay[:, None],
    )
    return v3dg.Gaussians(*(np.ascontiguousarray(a, np.float32) for a in arrays))


def leaves(gaussians: v3dg.Gaussians, device: str, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    return [
        torch.tensor(getattr(gaussians, n), dtype=dtype, device=device, requires_grad=True) for n in NAMES
    ]


def ours(config: Config, camera: Camera, inputs: Sequence[torch.Tensor]) -> torch.Tensor:
    raster = v3dg.rasterize(
        v3dg.Gaussians(*inputs), camera, filter_px2=config.filter_px2, antialiased=config.antialiased
    )
    return raster.color


def gsplats(config: Config, camera: Camera, inputs: Sequence[torch.Tensor], packed: bool) -> torch.Tensor:
    from gsplat import rasterization

    view, K = (
        torch.tensor(np.asarray(m), dtype=torch.float32, device="cuda")[None]
        for m in (camera.viewmat, camera.K)
    )
    colors, _, _ = rasterization(
        *inputs,
        view,
        K,
        camera.width,
        camera.height,
        sh_degree=config.sh_degree,
        eps2d=config.filter_px2,
        near_plane=camera.near,
        packed=packed,
        rasterize_mode="antialiased" if config.antialiased else "classic",
    )
    return colors[0]


def gradients(
    draw: Callable[[], torch.Tensor], inputs: Sequence[torch.Tensor], weights: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    return torch.autograd.grad(draw(), inputs, weights)


def milliseconds(run: Callable[[], Any], repeats: int) -> float:
    """Median time on the device, from when it could begin to when it is done."""
    times = []
    for _ in range(repeats + 5):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        begin.record()
        run()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    return statistics.median(times[5:])


def relative(got: Sequence[torch.Tensor], expected: Sequence[torch.Tensor]) -> dict[str, float]:
    """Relative L2 distance of each input's gradient."""
    pairs = zip(NAMES, got, expected, strict=True)
    return {
        n: float((g.double().cpu() - e.double().cpu()).norm() / e.double().cpu().norm()) for n, g, e in pairs
    }


def error_to_double(config: Config) -> dict[str, float]:
    small = replace(config, gaussians=min(config.gaussians, 20_000), width=320, height=180)
    camera, gaussians = camera_of(small), random_gaussians(small)
    weights = torch.randn((small.height, small.width, 3), generator=torch.Generator().manual_seed(1))
    both = []
    for device, dtype in (("cuda", torch.float32), ("cpu", torch.float64)):
        inputs = leaves(gaussians, device, dtype)
        weighted = weights.to(device, dtype)
        both.append(gradients(lambda i=inputs: ours(small, camera, i), inputs, weighted))
    return relative(*both)


def main(config: Config) -> None:
    camera, inputs = camera_of(config), leaves(random_gaussians(config), "cuda")
    weights = torch.randn((config.height, config.width, 3), device="cuda")
    draws: dict[str, Callable[[], torch.Tensor]] = {"v3dg": lambda: ours(config, camera, inputs)}
    try:
        import gsplat  # noqa: F401

        draws["gsplat"] = lambda: gsplats(config, camera, inputs, False)
        draws["gsplat packed"] = lambda: gsplats(config, camera, inputs, True)
    except ImportError:
        print("gsplat is not installed")
    result: dict[str, Any] = {
        "device": torch.cuda.get_device_name(),
        "error_to_double": error_to_double(config),
    }
    for name, draw in draws.items():
        result[name] = {
            "forward_ms": milliseconds(draw, config.repeats),
            "forward_backward_ms": milliseconds(lambda d=draw: gradients(d, inputs, weights), config.repeats),
        }
    if "gsplat" in draws:
        fastest = min(result[n]["forward_backward_ms"] for n in draws if n != "v3dg")
        result["ratio"] = result["v3dg"]["forward_backward_ms"] / fastest
        pictures = [draws[n]() for n in ("v3dg", "gsplat")]
        result["picture_difference"] = float((pictures[0] - pictures[1]).abs().mean())
        result["gradient_difference"] = relative(
            *(gradients(draws[n], inputs, weights) for n in ("v3dg", "gsplat"))
        )
    print(result)
    record.write(config.output, result)


if __name__ == "__main__":
    main(tyro.cli(Config))
