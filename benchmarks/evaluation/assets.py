"""Assets for measurements: copies of a small asset as one, and random gaussians with
the statistics of trained ones."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

import v3dg
from benchmarks.worlds.procedural import make_asset
from v3dg import _core
from v3dg.rotations import rotation_from_quaternion


def read_layout(path: str | Path, bundle: v3dg.Bundle) -> tuple[v3dg.Scene, dict[str, v3dg.Camera]]:
    """Read a published layout of one asset.

    Args:
        path: The layout, a JSON file.
        bundle: The bundle of the asset.

    Returns:
        The scene, and the layout's cameras by name.
    """
    name = json.loads(Path(path).read_text(encoding="utf-8"))["asset"]
    return v3dg.read_scene(path, bundles={name: bundle})


def layout_bundle(bundle: Path | None, asset: Path | None, device: str) -> v3dg.Bundle:
    """Return the bundle of a layout: the file `bundle` if there is one, else a draft of
    the asset, which is made where it is None."""
    if bundle is not None:
        return v3dg.Bundle.open(bundle)
    gaussians = make_asset() if asset is None else v3dg.read_asset(asset)
    return v3dg.build_bundle(gaussians, progress=False, device=device, quality="draft")


def many_copies(asset: v3dg.Gaussians, num_copies: int, *, seed: int = 0) -> v3dg.Gaussians:
    """Return copies of an asset as one asset, side by side on a square, rotated at
    random, and scaled by 1/2 to 2.

    The view-dependent part of the colour is not rotated with the copies.
    """
    rng = np.random.default_rng(seed)
    side = math.isqrt(num_copies - 1) + 1
    pitch = float(np.linalg.norm(np.ptp(asset.means, axis=0)))
    copies = []
    for i in range(num_copies):
        place = pitch * np.array(
            [i % side + rng.uniform(-0.3, 0.3), i // side + rng.uniform(-0.3, 0.3), 0]
        )
        turn = rng.normal(size=4)
        turn /= np.linalg.norm(turn)
        scale = np.float32(2 ** rng.uniform(-1, 1))
        rotation = np.float32(scale * rotation_from_quaternion(turn))
        w, x, y, z = turn
        product = np.array(
            [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], np.float32
        )
        copies.append(
            v3dg.Gaussians(
                means=asset.means @ rotation.T + np.float32(place),
                quats=asset.quats @ product.T,
                scales=asset.scales * scale,
                opacities=asset.opacities,
                sh=asset.sh,
            )
        )
    return v3dg.Gaussians.concatenate(copies)


class _Random:
    """Random float32 numbers from a seed, made by NumPy on the CPU and by torch on
    other devices."""

    def __init__(self, device: str, seed: int) -> None:
        self._device = device
        if device == "cpu":
            self.library: Any = np
            self._rng: Any = np.random.default_rng(seed)
        else:
            import torch

            self.library = torch
            self._rng = torch.Generator(device).manual_seed(seed)

    def uniform(self, *shape: int) -> Any:
        if self.library is np:
            return self._rng.random(shape, np.float32)
        return self.library.rand(*shape, generator=self._rng, device=self._device)

    def normal(self, *shape: int) -> Any:
        if self.library is np:
            return self._rng.standard_normal(shape, np.float32)
        return self.library.randn(*shape, generator=self._rng, device=self._device)

    def array(self, values: Any) -> Any:
        if self.library is np:
            return np.asarray(values, np.float32)
        return self.library.as_tensor(values, dtype=self.library.float32, device=self._device)


def like_trained(
    count: int, camera: v3dg.Camera, device: str, *, sh_degree: int = 0, seed: int = 0
) -> v3dg.Gaussians:
    """Return random gaussians in front of a camera, with the sizes, shapes and
    opacities of a trained asset.

    The distributions were fitted to a trained asset: logarithms of sizes are normal
    with deviation 1; logarithms of the ratios of neighbouring axes have a gamma
    distribution of shape 3 (median ratios 3 and 4); logits of opacities are normal.
    Training distributes gaussians by visibility, so sizes on screen do not depend on
    depth: the longest axis has a median of 2 px (the middle axis 0.7 px), and it
    exceeds 40 px for one gaussian in a thousand. Depths are log-uniform over a factor
    of 20. Positions are uniform on the image and slightly beyond its borders. Arrays
    are NumPy arrays on the CPU, and tensors on other devices.
    """
    random = _Random(device, seed)
    uniform, normal, array = random.uniform, random.normal, random.array
    join, exp = random.library.concatenate, random.library.exp

    depth = 2 * 20 ** uniform(count, 1)
    tangent = array([camera.width / camera.fx, camera.height / camera.fy]) / 2
    view = join([1.1 * tangent * (2 * uniform(count, 2) - 1) * depth, depth], 1)
    means = view @ array(camera.viewmat[:3, :3]) + array(camera.position)

    longest = 2 * exp(normal(count, 1)) * depth / camera.fx
    # A uniform number may be 0, but 1 minus the number is never 0, so its logarithm is
    # finite.
    ratios = exp(array([0.4, 0.5]) * random.library.log(1 - uniform(count, 3, 2)).sum(1))
    middle = longest * ratios[:, :1]
    sh = join(
        [uniform(count, 1, 3) * 3.4 - 1.7, 0.2 * normal(count, (sh_degree + 1) ** 2 - 1, 3)], 1
    )
    return v3dg.Gaussians(
        means=means,
        quats=normal(count, 4),
        scales=join([longest, middle, middle * ratios[:, 1:]], 1),
        opacities=1 / (1 + exp(-(0.6 + 2.3 * normal(count)))),
        sh=sh,
    )


def hair_lines(count: int, *, seed: int = 0) -> v3dg.Gaussians:
    """Return bent wires in a ball of radius 1. They are 1/3,000 of the radius thick,
    thin enough to fall between pixels."""
    rng = np.random.default_rng(seed)
    wires = max(4, count // 100)
    wire = np.arange(count) % wires
    along = (np.arange(count) // wires + 0.5) * wires / count * 2 - 1

    def unit(v: Any) -> Any:
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    direction, side = unit(rng.normal(size=(wires, 3))), rng.normal(size=(wires, 3))
    side = unit(side - direction * (side * direction).sum(1, keepdims=True))
    bend, offset = rng.uniform(-0.5, 0.5, wires), rng.normal(scale=0.3, size=(wires, 3))
    s, b = along[:, None], bend[wire, None]
    means = 0.7 * (direction[wire] * s + side[wire] * b * s * s) + offset[wire]
    tangent = unit(direction[wire] + 2 * b * s * side[wire])
    scales = np.array([0.7 * wires / count, 1 / 3000, 1 / 3000]) * np.ones((count, 1))
    color = np.where(rng.random((wires, 1)) < 0.5, [0.9, 0.85, 0.7], [0.85, 0.25, 0.15])[wire]
    return _gaussians(means, _quats_from_x(tangent), scales, np.full(count, 0.95), color)


def sky_dome(count: int, *, seed: int = 0) -> v3dg.Gaussians:
    """Return huge soft gaussians on a hemisphere of radius 1: a blue sky, haze at the
    horizon, and clouds."""
    rng = np.random.default_rng(seed)
    z = (np.arange(count) + 0.5) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    outwards = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    spacing = math.sqrt(2 * math.pi / count)
    waves = np.sin(outwards @ rng.normal(scale=9, size=(3, 6)) + rng.uniform(0, 6.28, 6)).mean(
        1, keepdims=True
    )
    cloud = np.clip(3 * waves, 0, 1)
    blue = (
        np.array([0.75, 0.82, 0.9]) * (1 - z[:, None]) + np.array([0.15, 0.35, 0.75]) * z[:, None]
    )
    scales = spacing * np.array([0.05, 1.2, 1.2]) * np.exp(rng.normal(scale=0.2, size=(count, 3)))
    opacities = rng.uniform(0.3, 0.8, count)
    return _gaussians(
        outwards, _quats_from_x(outwards), scales, opacities, blue * (1 - cloud) + cloud
    )


def _quats_from_x(x: Any) -> Any:
    """Return quaternions of rotations from the x axis to unit vectors.

    Each is half a turn about the bisector of the x axis and the vector.
    """
    middle = x + np.array([1.0, 0.0, 0.0])
    middle[np.linalg.norm(middle, axis=1) < 1e-6] = [0.0, 1.0, 0.0]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return np.concatenate([np.zeros((len(x), 1)), middle], 1)


def _gaussians(means: Any, quats: Any, scales: Any, opacities: Any, color: Any) -> v3dg.Gaussians:
    sh = (color[:, None] - 0.5) / _core.sh_base0
    return v3dg.Gaussians(
        *(np.asarray(a, np.float32) for a in (means, quats, scales, opacities, sh))
    )
