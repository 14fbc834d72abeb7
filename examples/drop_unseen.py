"""Drop the gaussians of a captured scene that nobody sees from where people are, before
its levels are built.

pip install '.[torch]' && python examples/drop_unseen.py scene.ply transforms.json
scene_seen.ply --keep 0.8
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro

import v3dg


@dataclass
class Config:
    """Rank gaussians by how much cameras see of them, and write those that are seen
    most."""

    asset: tyro.conf.Positional[Path]
    """File to read, of any format that v3dg reads."""
    cameras: tyro.conf.Positional[Path]
    """Where people are: what v3dg.read_cameras reads, such as the cameras of the
    capture."""
    output: tyro.conf.Positional[Path]
    """File to write, of any format that v3dg writes."""
    keep: float = 1.0
    """Share that is kept of the gaussians that are seen at all."""
    turns: int = 1
    """Directions that are looked into from each camera, spread evenly around its
    upright axis."""
    width: int = 512
    """px of the pictures."""
    device: str = "cpu"


def main(config: Config) -> float:
    """Write what is kept, and return its share of the asset."""
    if not (0 < config.keep <= 1 and config.turns >= 1 and config.width >= 1):
        raise SystemExit("expected --keep above 0 and at most 1, --turns and --width at least 1")
    asset = v3dg.read_asset(config.asset)
    weights = np.zeros(len(asset))
    for camera in views(config):
        weights += weights_in(asset, camera, config.device)
    order = np.argsort(weights, kind="stable")
    num_seen = int((weights > 0).sum())
    kept = asset.subset(np.sort(order[len(asset) - math.ceil(config.keep * num_seen) :]))
    v3dg.write_asset(config.output, kept)
    print(
        f"{config.output}: {len(kept):,} of {len(asset):,} gaussians, of which {num_seen:,} are "
        "seen"
    )
    return len(kept) / len(asset)


def views(config: Config) -> Iterator[v3dg.Camera]:
    """The cameras, turned, with pictures of the wanted width."""
    for camera in v3dg.read_cameras(config.cameras).values():
        scale = config.width / camera.width
        K = camera.K * np.array([[scale], [scale], [1.0]])
        height = max(1, round(scale * camera.height))
        for turn in range(config.turns):
            angle = 2 * math.pi * turn / config.turns
            cos, sin = math.cos(angle), math.sin(angle)
            turned = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1]])
            yield v3dg.Camera(turned @ camera.viewmat, K, config.width, height, camera.near)


def weights_in(asset: v3dg.Gaussians, camera: v3dg.Camera, device: str) -> npt.NDArray[np.float64]:
    """(N,) blend weight of each gaussian, summed over the pixels.

    It is the gradient of the picture's sum by the gaussian's colour, hence by its SH
    coefficient over the constant that coefficients of degree 0 are multiplied with.
    """
    import torch

    gaussians = asset.torch(device)
    sh = torch.zeros((len(asset), 1, 3), device=device, requires_grad=True)
    v3dg.rasterize(replace(gaussians, sh=sh), camera).color.sum().backward()
    weights: npt.NDArray[np.float64] = sh.grad[:, 0, 0].double().cpu().numpy() * math.sqrt(
        4 * math.pi
    )
    return weights


if __name__ == "__main__":
    main(tyro.cli(Config))
