"""Forward and backward on CUDA beside gsplat's, in one run: time, ratio, distance of the gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gpu
import record
import torch
import tyro
from assets import like_trained

import v3dg
from v3dg.cameras import Camera

ROWS = ("means", "quats", "scales", "opacities", "sh")


@dataclass
class Config:
    counts: tuple[int, ...] = (1_000_000,)
    sh_degree: int = 3
    filter_px2: float = 0.3
    """As training uses it."""
    width: int = 1920
    height: int = 1080
    repeats: int = 11
    gsplat: bool = True
    output: str | None = None


def main(config: Config) -> None:
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=config.width, height=config.height)
    rows = []
    for count in config.counts:
        gaussians = like_trained(count, camera, gpu.DEVICE, sh_degree=config.sh_degree)
        weights = loss_weights(config.height, config.width)

        def ours(g: v3dg.Gaussians) -> tuple[Any, Any]:
            raster = v3dg.rasterize(g, camera, filter_px2=config.filter_px2)
            return raster.color, raster.alpha

        forward_ms, total_ms, gradients = measure(ours, gaussians, weights, config.repeats)
        _, _, again = measure(ours, gaussians, weights, 1)
        row: dict[str, Any] = {
            "gaussians": count,
            "sh_degree": config.sh_degree,
            "forward_ms": round(forward_ms, 3),
            "forward_backward_ms": round(total_ms, 3),
            "same_bits_twice": all(
                torch.equal(a, b) for a, b in zip(gradients.values(), again.values(), strict=True)
            ),
        }
        if config.gsplat:
            row.update(beside_gsplat(row, gradients, gaussians, camera, weights, config))
        print(row, flush=True)
        rows.append(row)
    record.write(
        config.output,
        {
            **gpu.machine(),
            "width": config.width,
            "height": config.height,
            "filter_px2": config.filter_px2,
            "scenes": rows,
        },
    )


def loss_weights(height: int, width: int) -> tuple[Any, Any]:
    """Random weights of colour and alpha, whose weighted sum is the loss."""
    generator = torch.Generator(gpu.DEVICE).manual_seed(1)
    return (
        torch.randn(height, width, 3, generator=generator, device=gpu.DEVICE),
        torch.randn(height, width, generator=generator, device=gpu.DEVICE),
    )


def measure(
    draw: Callable[[v3dg.Gaussians], tuple[Any, Any]],
    gaussians: v3dg.Gaussians,
    weights: tuple[Any, Any],
    repeats: int,
) -> tuple[float, float, dict[str, Any]]:
    """Milliseconds forward, and forward and backward, and the gradients of the rows."""
    leaves = {name: getattr(gaussians, name).detach().clone().requires_grad_() for name in ROWS}
    with_gradient = v3dg.Gaussians(**leaves)

    def forward() -> Any:
        color, alpha = draw(with_gradient)
        return color, alpha

    def both() -> None:
        for leaf in leaves.values():
            leaf.grad = None
        # The gradient of the weighted sum, without the sum.
        torch.autograd.backward(forward(), weights)

    forward_ms, total_ms = gpu.median_ms(forward, repeats), gpu.median_ms(both, repeats)
    return forward_ms, total_ms, {name: leaf.grad for name, leaf in leaves.items()}


def beside_gsplat(
    ours: dict[str, Any],
    gradients: dict[str, Any],
    gaussians: v3dg.Gaussians,
    camera: Camera,
    weights: tuple[Any, Any],
    config: Config,
) -> dict[str, Any]:
    results = {}
    for packed in (True, False):
        results[packed] = measure(
            lambda g, packed=packed: gpu.gsplat_picture(g, camera, packed=packed, eps2d=config.filter_px2),
            gaussians,
            weights,
            config.repeats,
        )
    forward_ms, total_ms, peer = min(results.values(), key=lambda result: result[1])
    return {
        "gsplat_forward_ms": round(forward_ms, 3),
        "gsplat_forward_backward_ms": round(total_ms, 3),
        "ratio_forward": round(ours["forward_ms"] / forward_ms, 4),
        "ratio": round(ours["forward_backward_ms"] / total_ms, 4),
        **{
            f"relative_l2_{name}": float(f"{(gradients[name] - peer[name]).norm() / peer[name].norm():.2e}")
            for name in ROWS
        },
    }


if __name__ == "__main__":
    main(tyro.cli(Config))
