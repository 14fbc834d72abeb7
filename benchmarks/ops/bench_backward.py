"""Time and gradients of a forward and backward pass on CUDA, in comparison with gsplat
in one run.

The comparison uses the ratio of the times and the distance between the gradients. With
fewer gaussians in a smaller picture, the gradients of v3dg and of gsplat are also
compared with float64 gradients from the CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import torch
import tyro

import v3dg
from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.assets import like_trained
from benchmarks.evaluation.measure import time_ms
from v3dg.cameras import Camera

Draw: TypeAlias = Callable[[v3dg.Gaussians], tuple[Any, Any]]
ROWS = ("means", "quats", "scales", "opacities", "sh")


@dataclass
class Config:
    counts: tuple[int, ...] = (1_000_000,)
    sh_degree: int = 3
    filter_px2: float = 0.3
    """Variance of the filter in px²; 0.3 is the value that training uses."""
    width: int = 1920
    height: int = 1080
    repeats: int = 11
    gsplat: bool = True
    output: str | None = None


def main(config: Config) -> None:
    rows = [compare(config, count) for count in config.counts]
    small = replace(config, width=320, height=180, repeats=1)
    result = {
        "width": config.width,
        "height": config.height,
        "filter_px2": config.filter_px2,
        "scenes": rows,
        "to_float64": errors_to_float64(small, 20_000),
    }
    print(result["to_float64"])
    record.write(config.output, result, gpu.DEVICE)


def compare(config: Config, count: int) -> dict[str, Any]:
    camera, gaussians, weights = inputs(config, count)
    forward_ms, total_ms, gradients = measure(
        ours(config, camera), gaussians, weights, config.repeats
    )
    _, _, again = measure(ours(config, camera), gaussians, weights, 1)
    row: dict[str, Any] = {
        "gaussians": count,
        "sh_degree": config.sh_degree,
        "forward_ms": round(forward_ms, 3),
        "forward_backward_ms": round(total_ms, 3),
        "same_bits_twice": all(torch.equal(gradients[name], again[name]) for name in ROWS),
    }
    if config.gsplat:
        peers = [
            measure(gsplats(config, camera, packed), gaussians, weights, config.repeats)
            for packed in (True, False)
        ]
        peer_forward_ms, peer_ms, expected = min(peers, key=lambda peer: peer[1])
        row["gsplat_forward_ms"] = round(peer_forward_ms, 3)
        row["gsplat_forward_backward_ms"] = round(peer_ms, 3)
        row["ratio_forward"] = round(forward_ms / peer_forward_ms, 4)
        row["ratio"] = round(total_ms / peer_ms, 4)
        row["relative_l2_to_gsplat"] = relative_l2(gradients, expected)
    print(row, flush=True)
    return row


def errors_to_float64(config: Config, count: int) -> dict[str, dict[str, float]]:
    """Return the relative L2 distance to float64 of the gradients of each input array,
    for v3dg and for gsplat."""
    camera, gaussians, weights = inputs(config, count)
    exact = gradients_of(
        ours(config, camera),
        v3dg.Gaussians(**{name: getattr(gaussians, name).double().cpu() for name in ROWS}),
        tuple(weight.double().cpu() for weight in weights),
    )
    draws = {"ours": ours(config, camera)}
    if config.gsplat:
        draws["gsplat"] = gsplats(config, camera, False)
    return {
        name: relative_l2(gradients_of(draw, gaussians, weights), exact)
        for name, draw in draws.items()
    }


def inputs(config: Config, count: int) -> tuple[Camera, v3dg.Gaussians, tuple[Any, ...]]:
    """Return a camera, gaussians, and random weights of colour and alpha. The loss is
    the weighted sum."""
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=config.width, height=config.height)
    gaussians = like_trained(count, camera, gpu.DEVICE, sh_degree=config.sh_degree)
    generator = torch.Generator(gpu.DEVICE).manual_seed(1)
    shape = (config.height, config.width)
    color = torch.randn(*shape, 3, generator=generator, device=gpu.DEVICE)
    return camera, gaussians, (color, torch.randn(*shape, generator=generator, device=gpu.DEVICE))


def ours(config: Config, camera: Camera) -> Draw:
    def draw(gaussians: v3dg.Gaussians) -> tuple[Any, Any]:
        raster = v3dg.rasterize(gaussians, camera, filter_px2=config.filter_px2)
        return raster.color, raster.alpha

    return draw


def gsplats(config: Config, camera: Camera, packed: bool) -> Draw:
    return lambda gaussians: gpu.gsplat_picture(
        gaussians, camera, packed=packed, eps2d=config.filter_px2
    )


def measure(
    draw: Draw, gaussians: v3dg.Gaussians, weights: tuple[Any, ...], repeats: int
) -> tuple[float, float, dict[str, Any]]:
    """Measure one way to draw.

    Returns:
        Milliseconds of the forward pass, milliseconds of forward and backward, and the
        gradients of the input arrays.
    """
    leaves = with_gradients(gaussians)
    forward_ms = time_ms(lambda: draw(leaves), gpu.DEVICE, repeats).median
    total_ms = time_ms(lambda: gradients_of(draw, leaves, weights), gpu.DEVICE, repeats).median
    return forward_ms, total_ms, gradients_of(draw, leaves, weights)


def with_gradients(gaussians: v3dg.Gaussians) -> v3dg.Gaussians:
    return v3dg.Gaussians(
        **{name: getattr(gaussians, name).detach().clone().requires_grad_() for name in ROWS}
    )


def gradients_of(draw: Draw, gaussians: v3dg.Gaussians, weights: tuple[Any, ...]) -> dict[str, Any]:
    leaves = gaussians if gaussians.means.requires_grad else with_gradients(gaussians)
    rows = [getattr(leaves, name) for name in ROWS]
    return dict(zip(ROWS, torch.autograd.grad(draw(leaves), rows, weights), strict=True))


def relative_l2(values: dict[str, Any], truths: dict[str, Any]) -> dict[str, float]:
    errors = {}
    for name in ROWS:
        value, truth = values[name].double().cpu(), truths[name].double().cpu()
        errors[name] = float(f"{float((value - truth).norm() / truth.norm()):.2e}")
    return errors


if __name__ == "__main__":
    main(tyro.cli(Config))
