"""Large assets, made of copies of a small one."""

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
