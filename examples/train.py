"""Trains gaussians on pictures with the arguments of gsplat's `rasterization`, on a CPU
or a GPU. v3dg draws the pictures and computes the gradients.

The pictures of this example show a generated donut; in practice they are photographs.
The result is written as an asset, for which `v3dg build` can build levels.

The example needs torch:

    pip install '.[torch]'
    python examples/train.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import v3dg
from v3dg.compat.gsplat import rasterization
from v3dg.donut import make_donut
from v3dg.metrics import psnr

SH_DEGREE = 1
RATES = {"means": 4e-3, "quats": 1e-2, "scales": 2e-2, "opacities": 5e-2, "sh": 2e-2}


@dataclass
class Config:
    """Train gaussians on pictures of a donut."""

    output: Path = Path("trained.ply")
    """Asset to write."""
    gaussians: int = 2000
    """Number of gaussians to train."""
    steps: int = 300
    """Number of steps, each with two pictures."""
    pictures: int = 24
    """Number of pictures to train on."""
    size: tuple[int, int] = (160, 120)
    """Width and height of the pictures in px."""
    device: str = "cpu"
    """Device for the training: cpu or cuda."""


def main(config: Config) -> float:
    """Write the asset; return the PSNR in dB of its picture from a camera that was not
    used in training."""
    cameras = v3dg.turntable(
        (0, 0, 0),
        3.5,
        config.pictures + 1,
        elevation=0.6,
        width=config.size[0],
        height=config.size[1],
    )
    donut = make_donut(20_000)
    targets = [v3dg.rasterize(donut, camera, filter_px2=0.3).color for camera in cameras]
    asset = train(cameras[1:], targets[1:], config)
    v3dg.write_asset(config.output, asset)
    picture = v3dg.rasterize(asset, cameras[0], filter_px2=0.3).color
    likeness = psnr(np.clip(targets[0], 0, 1), np.clip(picture, 0, 1))
    print(
        f"{config.output}: {len(asset):,} gaussians, {likeness:.1f} dB on a picture that was not "
        "used in training"
    )
    return likeness


def train(cameras: list[v3dg.Camera], pictures: list[Any], config: Config) -> v3dg.Gaussians:
    """Train gaussians on pictures, one for each camera, and return them."""
    generator = np.random.default_rng(0)
    parameters = start(config.gaussians, generator, config.device)
    groups = [{"params": [parameters[name]], "lr": rate} for name, rate in RATES.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    targets = torch.from_numpy(np.stack(pictures)).to(config.device)
    viewmats, Ks = (
        torch.tensor(np.stack(matrices), dtype=torch.float32, device=config.device)
        for matrices in ([c.viewmat for c in cameras], [c.K for c in cameras])
    )
    for _ in range(config.steps):
        chosen = torch.from_numpy(generator.choice(len(cameras), 2, replace=False))
        drawn, _, _ = rasterization(
            *activated(parameters).values(),
            viewmats=viewmats[chosen],
            Ks=Ks[chosen],
            width=config.size[0],
            height=config.size[1],
            sh_degree=SH_DEGREE,
        )
        loss = (drawn - targets[chosen]).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    return v3dg.Gaussians(*(tensor.detach() for tensor in activated(parameters).values())).numpy()


def start(num: int, generator: np.random.Generator, device: str) -> dict[str, torch.Tensor]:
    """Return grey gaussians at random positions, in the form that training changes:
    logarithms of scales and logits of opacities."""
    values = {
        "means": generator.uniform(-1, 1, (num, 3)) * [1.1, 1.1, 0.5],
        "quats": generator.normal(size=(num, 4)),
        "scales": np.full((num, 3), np.log(0.06)),
        "opacities": np.full(num, -1.5),
        "sh": np.zeros((num, (SH_DEGREE + 1) ** 2, 3)),
    }
    return {
        name: torch.tensor(value, dtype=torch.float32, device=device, requires_grad=True)
        for name, value in values.items()
    }


def activated(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the parameters as they are drawn, with scales and opacities instead of
    logarithms and logits."""
    scales, opacities = parameters["scales"].exp(), parameters["opacities"].sigmoid()
    return {**parameters, "scales": scales, "opacities": opacities}


if __name__ == "__main__":
    main(tyro.cli(Config))
