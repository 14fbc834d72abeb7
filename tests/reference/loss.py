"""The loss of local splatting on torch tensors of any precision, and 1 - SSIM, which is
a part of it."""

from __future__ import annotations

import torch


def window() -> torch.Tensor:
    """Return an (11, 11) gaussian with sigma 1.5 that sums to 1."""
    x = torch.arange(-5, 6, dtype=torch.float64)
    line = torch.exp(-(x**2) / (2 * 1.5**2))
    return torch.outer(line, line) / line.sum() ** 2


def dssim(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the mean of 1 - SSIM over one channel (H, W), with zeros beyond the border
    (Wang et al. 2004)."""

    def blur(image: torch.Tensor) -> torch.Tensor:
        kernel = window().to(image.dtype)[None, None]
        return torch.nn.functional.conv2d(image[None, None], kernel, padding=5)[0, 0]

    mean_x, mean_y = blur(picture), blur(target)
    var_x, var_y = blur(picture**2) - mean_x**2, blur(target**2) - mean_y**2
    covariance = blur(picture * target) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    ssim = ssim / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    return (1 - ssim).mean()


def loss(color, alpha, target_color, target_alpha, weights) -> torch.Tensor:
    """Return the weighted sum of these parts: L1 on premultiplied colour (H, W, 3), its
    1 - SSIM, L1 on alpha (H, W), and L1 on the means of cells of 4 x 4 px. The weight
    of the last part is relative to the two L1 parts. `weights` are in this order."""
    l1, ssim, on_alpha, on_cells = weights
    differences = torch.cat([color - target_color, (alpha - target_alpha)[..., None]], dim=-1)
    cells = torch.nn.functional.avg_pool2d(differences.permute(2, 0, 1), 4)
    nothing = torch.zeros_like(cells)
    of_cells = torch.nn.functional.smooth_l1_loss(cells, nothing, reduction="none", beta=1e-4)
    by_channel = differences.abs().mean((0, 1)) + on_cells * of_cells.mean((1, 2))
    total = l1 * by_channel[:3].mean() + on_alpha * by_channel[3]
    if ssim:
        total = total + ssim * sum(dssim(color[..., c], target_color[..., c]) for c in range(3)) / 3
    return total
