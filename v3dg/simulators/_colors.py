"""Colours of pictures as torch tensors of bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from v3dg.render import RenderedBatch


def bytes_of(values: torch.Tensor) -> torch.Tensor:
    """Convert values from 0 to 1 to uint8 with rounding.

    Values outside this range are clipped.
    """
    import torch

    return (values.clamp(0, 1) * 255 + 0.5).to(torch.uint8)


def rgba_of(pictures: RenderedBatch) -> torch.Tensor:
    """Return red, green, blue and coverage (N, H, W, 4) as uint8."""
    import torch

    color = torch.as_tensor(pictures.color)[..., :3]
    alpha = torch.as_tensor(pictures.alpha)[..., None]
    return bytes_of(torch.cat([color, alpha], dim=-1))
