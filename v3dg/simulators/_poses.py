"""Poses of simulators as torch tensors: rotations as quaternions x y z w."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def rotations_of(quaternions: torch.Tensor) -> torch.Tensor:
    """Return (N, 3, 3) rotations of unit quaternions (N, 4) x y z w."""
    import torch

    x, y, z, w = quaternions.unbind(dim=-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def product_of(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return quaternions (N, 4) x y z w that rotate by `second` first, and then by
    `first`."""
    import torch

    fx, fy, fz, fw = first.unbind(dim=-1)
    sx, sy, sz, sw = second.unbind(dim=-1)
    x = fw * sx + fx * sw + fy * sz - fz * sy
    y = fw * sy - fx * sz + fy * sw + fz * sx
    z = fw * sz + fx * sy - fy * sx + fz * sw
    w = fw * sw - fx * sx - fy * sy - fz * sz
    return torch.stack([x, y, z, w], dim=-1)


def write_viewmats(viewmats: torch.Tensor, positions: torch.Tensor, axes: torch.Tensor) -> None:
    """Write (N, 4, 4) matrices from world to camera.

    Args:
        viewmats: Their last rows must already be 0 0 0 1.
        positions: (N, 3) eyes in the world.
        axes: (N, 3, 3), whose rows are the directions to the right, down and forward in
            the world.
    """
    viewmats[:, :3, :3] = axes
    viewmats[:, :3, 3] = -(axes @ positions[:, :, None])[:, :, 0]
