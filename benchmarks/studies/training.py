"""Measures whether training with v3dg gives the same result as training with gsplat,
and how long a step takes.

Gaussians are trained from random positions on pictures of an asset with gsplat's
strategies. Pictures are drawn by v3dg or by gsplat, and the results are compared on
held-out pictures. The study needs a GPU and a compiled gsplat 1.5.3.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gsplat
import numpy as np
import torch
from torch.nn.functional import conv2d

import v3dg
from benchmarks.evaluation.measure import time_ms
from benchmarks.evaluation.record import write
from benchmarks.studies.peers.scenes import random as random_scene
from v3dg.compat.gsplat import rasterization

_DRAWN_BY: dict[str, Callable[..., Any]] = {"v3dg": rasterization, "gsplat": gsplat.rasterization}
_REPEATS = 31  # number of timed calls of a step
_SIDE = 512  # width and height of a training picture in px
_STEP = {
    "means": 1.6e-4,
    "quats": 1e-3,
    "scales": 5e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("asset", type=Path)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument(
        "--gaussians", type=int, default=1_000_000, help="number of gaussians for the timed steps"
    )
    parser.add_argument("--json", type=Path, help="JSON file for the results")
    options = parser.parse_args(arguments)

    result: dict[str, Any] = {"steps": [], "training": []}
    for num_cameras in (1, 4):
        result["steps"] += times(options.gaussians, num_cameras)
        print(*result["steps"][-2:], sep="\n", flush=True)
    views = Views(v3dg.read_asset(options.asset))
    for strategy in ("default", "absgrad", "mcmc"):
        for seed in range(options.seeds):
            for name in _DRAWN_BY:
                row = {"strategy": strategy, "seed": seed, "drawn_by": name}
                result["training"].append(
                    row | train(views, strategy, seed, options.steps, _DRAWN_BY[name])
                )
                print(result["training"][-1], flush=True)
    write(options.json, result, "cuda")
    return 0


def times(count: int, num_cameras: int) -> list[dict[str, Any]]:
    """Return milliseconds of a picture, and of a picture with its gradients, for random
    gaussians of SH degree 3."""
    scene = random_scene(count, 3, "cuda")
    camera, gaussians = next(iter(scene.cameras.values())), scene.gaussians
    shifted = [v3dg.StereoCamera.of(camera, 0.01 * (k + 1)).left for k in range(num_cameras)]
    to = {"dtype": torch.float32, "device": "cuda"}
    drawn_with = {
        "viewmats": torch.tensor(np.stack([c.viewmat for c in shifted]), **to),
        "Ks": torch.tensor(np.stack([c.K for c in shifted]), **to),
        "width": camera.width,
        "height": camera.height,
        "sh_degree": 3,
        "packed": False,
    }
    arrays = [a.clone().requires_grad_() for a in vars(gaussians.torch("cuda")).values()]
    target = torch.rand(num_cameras, camera.height, camera.width, 3, device="cuda")
    rows = []
    for name, draw in _DRAWN_BY.items():

        def picture(draw: Callable[..., Any] = draw) -> Any:
            return draw(*arrays, **drawn_with)[0]

        def gradients(picture: Callable[[], Any] = picture) -> None:
            for array in arrays:
                array.grad = None
            ((picture() - target) ** 2).mean().backward()

        with torch.no_grad():
            forward = time_ms(picture, "cuda", _REPEATS).median
        row = {
            "gaussians": count,
            "cameras": num_cameras,
            "drawn_by": name,
            "forward_ms": round(forward, 3),
        }
        rows.append(row | {"both_ms": round(time_ms(gradients, "cuda", _REPEATS).median, 3)})
    return rows


class Views:
    """Pictures of an asset from 80 sides; every eighth picture is held out."""

    def __init__(self, asset: v3dg.Gaussians) -> None:
        self.low, self.high = (np.percentile(asset.means, q, axis=0) for q in (0.5, 99.5))
        self.size = float((self.high - self.low).max())
        cameras = [
            camera
            for elevation in (-0.3, 0.3, 0.7, 1.1)
            for camera in v3dg.turntable(
                (self.low + self.high) / 2,
                1.6 * self.size,
                20,
                elevation=elevation,
                width=_SIDE,
                height=_SIDE,
            )
        ]
        on_device = asset.torch("cuda")
        pictures = [v3dg.rasterize(on_device, camera, filter_px2=0.3).color for camera in cameras]
        self.pictures = torch.stack(pictures).clamp(0, 1)
        self.viewmats, self.Ks = (
            torch.tensor(np.stack(part), dtype=torch.float32, device="cuda")
            for part in zip(*((camera.viewmat, camera.K) for camera in cameras), strict=True)
        )
        numbers = torch.arange(len(cameras))
        self.held_out, self.trained = numbers[numbers % 8 == 0], numbers[numbers % 8 != 0]

    def start(self, count: int) -> dict[str, torch.nn.Parameter]:
        """Return grey gaussians at random positions in the bounding box of the
        asset."""
        low, high = (
            torch.tensor(a, dtype=torch.float32, device="cuda") for a in (self.low, self.high)
        )
        start = {
            "means": low + torch.rand(count, 3, device="cuda") * (high - low),
            "quats": torch.randn(count, 4, device="cuda"),
            "scales": torch.full((count, 3), float(np.log(self.size / 100)), device="cuda"),
            "opacities": torch.full((count,), -1.0, device="cuda"),
            "sh0": torch.zeros(count, 1, 3, device="cuda"),
            "shN": torch.zeros(count, 15, 3, device="cuda"),
        }
        return {name: torch.nn.Parameter(values) for name, values in start.items()}


def strategy_of(name: str, steps: int, size: float) -> tuple[Any, dict[str, Any]]:
    often = {"refine_start_iter": 200, "refine_every": 100}
    if name == "mcmc":
        strategy = gsplat.MCMCStrategy(cap_max=60_000, refine_stop_iter=int(0.9 * steps), **often)
        return strategy, strategy.initialize_state()
    if name == "absgrad":
        often |= {"absgrad": True, "grow_grad2d": 8e-4}
    strategy = gsplat.DefaultStrategy(refine_stop_iter=int(0.75 * steps), reset_every=3000, **often)
    return strategy, strategy.initialize_state(scene_scale=size / 2)


def train(
    views: Views, name: str, seed: int, steps: int, draw: Callable[..., Any]
) -> dict[str, Any]:
    """Train gaussians; return the PSNR on the held-out pictures, the number of
    gaussians, and the seconds."""
    torch.manual_seed(seed)
    order = torch.Generator().manual_seed(seed)
    params = views.start(20_000)
    steps_of = _STEP | {"means": _STEP["means"] * views.size}
    optimizers = {k: torch.optim.Adam([p], lr=steps_of[k], eps=1e-15) for k, p in params.items()}
    strategy, state = strategy_of(name, steps, views.size)
    strategy.check_sanity(params, optimizers)

    def picture(number: Any, degree: int, **more: Any) -> Any:
        return draw(
            means=params["means"],
            quats=params["quats"],
            scales=params["scales"].exp(),
            opacities=params["opacities"].sigmoid(),
            colors=torch.cat([params["sh0"], params["shN"]], 1),
            viewmats=views.viewmats[number],
            Ks=views.Ks[number],
            width=_SIDE,
            height=_SIDE,
            sh_degree=degree,
            packed=False,
            **more,
        )

    torch.cuda.synchronize()
    start = time.perf_counter()
    for step in range(steps):
        number = views.trained[torch.randint(len(views.trained), (1,), generator=order)]
        degree = min(3, step // (steps // 5))
        color, _, info = picture(number, degree, **({"absgrad": True} if name == "absgrad" else {}))
        if name != "mcmc":
            strategy.step_pre_backward(params, optimizers, state, step, info)
        target = views.pictures[number]
        loss = 0.8 * (color - target).abs().mean() + 0.2 * (1 - structure(color, target))
        if name == "mcmc":
            loss = loss + 0.01 * (
                params["opacities"].sigmoid().mean() + params["scales"].exp().mean()
            )
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        after = {"lr": steps_of["means"]} if name == "mcmc" else {"packed": False}
        strategy.step_post_backward(params, optimizers, state, step, info, **after)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - start
    with torch.no_grad():
        errors = [
            ((picture(number[None], 3)[0].clamp(0, 1) - views.pictures[number]) ** 2).mean()
            for number in views.held_out
        ]
    decibels = float(-10 * torch.stack(errors).log10().mean())
    return {
        "psnr": round(decibels, 3),
        "gaussians": len(params["means"]),
        "seconds": round(seconds, 2),
    }


def structure(first: Any, second: Any) -> Any:
    """Return the SSIM of (1, H, W, 3) pictures, with a window of 11 x 11 px."""
    bell = torch.exp(-((torch.arange(11, device="cuda") - 5.0) ** 2) / (2 * 1.5**2))
    bell = bell / bell.sum()
    window = (bell[:, None] * bell).expand(3, 1, 11, 11)

    def mean(values: Any) -> Any:
        return conv2d(values, window, groups=3, padding=5)

    x, y = first.movedim(-1, 1), second.movedim(-1, 1)
    mx, my = mean(x), mean(y)
    variances = mean(x * x) - mx**2 + mean(y * y) - my**2
    covariance = mean(x * y) - mx * my
    return (
        (2 * mx * my + 1e-4)
        * (2 * covariance + 9e-4)
        / ((mx**2 + my**2 + 1e-4) * (variances + 9e-4))
    ).mean()


if __name__ == "__main__":
    sys.exit(main())
