"""Assets to measure with: many copies of a small one, and random gaussians that look trained."""

from __future__ import annotations

import math

import numpy as np

import v3dg
from v3dg.scene import rotation_from_quaternion


def many_copies(asset: v3dg.Gaussians, num_copies: int, *, seed: int = 0) -> v3dg.Gaussians:
    """Copies of an asset as one: turned at random, half to twice as large, side by side on a square.

    What of the colour depends on the view is not turned with them.
    """
    rng = np.random.default_rng(seed)
    side = math.isqrt(num_copies - 1) + 1
    pitch = float(np.linalg.norm(np.ptp(asset.means, axis=0)))
    copies = []
    for i in range(num_copies):
        place = pitch * np.array([i % side + rng.uniform(-0.3, 0.3), i // side + rng.uniform(-0.3, 0.3), 0])
        turn = rng.normal(size=4)
        turn /= np.linalg.norm(turn)
        scale = np.float32(2 ** rng.uniform(-1, 1))
        rotation = np.float32(scale * rotation_from_quaternion(turn))
        w, x, y, z = turn
        product = np.float32([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
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


def like_trained(
    count: int, camera: v3dg.Camera, device: str, *, sh_degree: int = 0, seed: int = 0
) -> v3dg.Gaussians:
    """Random gaussians before a camera with the sizes, shapes and opacities that training leaves, as tensors.

    The distributions are fitted to a trained asset: logs of sizes are normal with deviation 1, logs of the
    ratios of neighbouring axes are gamma of shape 3 (median ratios 3 and 4), logits of opacities are normal.
    Training spends gaussians where they show, so sizes on screen do not depend on depth: the longest axis has
    a median of 2 px (the middle one 0.7 px), and one in a thousand passes 40 px. Depths are log-uniform over
    a factor of 20, places uniform on the image and a little beyond it.
    """
    import torch

    generator = torch.Generator(device).manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, device=device)

    depth = 2 * 20 ** uniform(count, 1)
    tangent = torch.tensor([camera.width / camera.fx, camera.height / camera.fy], device=device) / 2
    view = torch.cat([1.1 * tangent * (2 * uniform(count, 2) - 1) * depth, depth], 1)
    rotation = torch.as_tensor(camera.viewmat[:3, :3], dtype=torch.float32, device=device)
    eye = torch.as_tensor(camera.position, dtype=torch.float32, device=device)

    longest = 2 * torch.exp(normal(count, 1)) * depth / camera.fx
    ratios = torch.exp(-torch.tensor([0.4, 0.5], device=device) * -uniform(count, 3, 2).log().sum(1))
    middle = longest * ratios[:, :1]
    sh = torch.cat([uniform(count, 1, 3) * 3.4 - 1.7, 0.2 * normal(count, (sh_degree + 1) ** 2 - 1, 3)], 1)
    return v3dg.Gaussians(
        means=view @ rotation + eye,
        quats=normal(count, 4),
        scales=torch.cat([longest, middle, middle * ratios[:, 1:]], 1),
        opacities=torch.sigmoid(0.6 + 2.3 * normal(count)),
        sh=sh,
    )
