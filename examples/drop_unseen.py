"""Drops the gaussians of a captured scene that cannot be seen from where people are,
before its levels are built.

The example needs torch:

    pip install '.[torch]'
    python examples/drop_unseen.py scene.ply transforms.json scene_seen.ply --keep 0.8
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
    """Rank gaussians by how visible they are for the cameras, and write the most
    visible ones."""

    asset: tyro.conf.Positional[Path]
    """Asset to read, in any format that v3dg reads."""
    cameras: tyro.conf.Positional[Path]
    """Cameras where people are, in any format that v3dg.read_cameras reads, such as the
    cameras of the capture."""
    output: tyro.conf.Positional[Path]
    """Asset to write, in any format that v3dg writes."""
    keep: float = 1.0
    """Fraction of the visible gaussians to keep."""
    turns: int = 1
    """Number of directions in which each camera looks, evenly spaced around its
    vertical axis."""
    width: int = 512
    """Width of the pictures in px."""
    device: str = "cpu"


def main(config: Config) -> float:
    """Write the gaussians to keep; return their fraction of the asset."""
    if not (0 < config.keep <= 1 and config.turns >= 1 and config.width >= 1):
        raise SystemExit(
            "--keep, --turns, --width: expected a --keep above 0 and at most 1, and --turns and "
            "--width of at least 1"
        )
    asset = v3dg.read_asset(config.asset)
    weights = np.zeros(len(asset))
    for camera in views(config):
        weights += weights_in(asset, camera, config.device)
    order = np.argsort(weights, kind="stable")
    num_seen = int((weights > 0).sum())
    kept = asset.subset(np.sort(order[len(asset) - math.ceil(config.keep * num_seen) :]))
    v3dg.write_asset(config.output, kept)
    print(f"{config.output}: {len(kept):,} of {len(asset):,} gaussians; cameras see {num_seen:,}")
    return len(kept) / len(asset)


def views(config: Config) -> Iterator[v3dg.Camera]:
    """Yield the cameras, rotated in all directions, with pictures of the requested
    width."""
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
    """Return (N,) the blend weight of each gaussian, summed over the pixels.

    The weight is the derivative of the sum of all pixels by the gaussian's colour. This
    is the gradient of its SH coefficient of degree 0, divided by the constant spherical
    harmonic.
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
