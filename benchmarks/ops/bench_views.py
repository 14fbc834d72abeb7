"""Pictures of gaussians without levels for several cameras, and their gradients. One
call of `compat.gsplat.rasterization` for all cameras is compared with one call per
camera and, if gsplat is installed, with gsplat.

Before the times are measured, pictures and gradients are checked: they must have the
same bits as those of the cameras one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
import tyro

import v3dg
from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.measure import time_ms
from benchmarks.worlds.procedural import make_asset
from v3dg.compat.gsplat import rasterization

Row: TypeAlias = dict[str, object]
Draw: TypeAlias = Callable[..., tuple[torch.Tensor, torch.Tensor, dict[str, object]]]


@dataclass
class Config:
    device: str = "cuda"
    gaussians: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    cameras: tuple[int, ...] = (64, 64, 16, 4)
    sizes: tuple[int, ...] = (64, 128, 256, 1024)
    """Widths and heights of the pictures in px, for each number of cameras."""
    repeats: int = 9
    output: str | None = None


def main(config: Config) -> None:
    rows: list[Row] = []
    result: dict[str, object] = {"sh_degree": 1, "rows": rows}
    for count in config.gaussians:
        asset = make_asset(count).torch(config.device)
        for cameras, size in zip(config.cameras, config.sizes, strict=True):
            rows.append(Calls(asset, cameras, size, config).row())
            print(rows[-1], flush=True)
            record.write(config.output, result, config.device)


class Calls:
    """The ways to draw the same cameras around an asset."""

    def __init__(self, asset: v3dg.Gaussians, count: int, size: int, config: Config) -> None:
        self.config = config
        self.size = size
        cameras = v3dg.turntable((0, 0, 0.2), 3.5, count, width=size, height=size)
        numbers = [np.stack([getattr(c, name) for c in cameras]) for name in ("viewmat", "K")]
        self.viewmats, self.Ks = (
            torch.tensor(number, dtype=torch.float32, device=config.device) for number in numbers
        )
        self.viewmats.requires_grad_()
        self.tensors = [tensor.clone().requires_grad_() for tensor in vars(asset).values()]
        self.weights = torch.rand(count, size, size, 3, device=config.device)

    def row(self) -> Row:
        row: Row = {
            "gaussians": len(self.tensors[0]),
            "cameras": len(self.viewmats),
            "size": self.size,
            "same_bits": self.has_same_bits(),
        }
        ways: dict[str, Callable[[], list[torch.Tensor]]] = {
            "together": self.together,
            "one_by_one": self.one_by_one,
        }
        if self.config.device == "cuda" and gpu.has_gsplat():
            ways["gsplat"] = self.gsplat
        for name, draw in ways.items():
            row[f"{name}_forward_ms"] = self.forward_ms(draw)
            row[f"{name}_ms"] = self.step_ms(draw)
            self.viewmats.requires_grad_(False)
            row[f"{name}_without_poses_ms"] = self.step_ms(draw)
            self.viewmats.requires_grad_(True)
        return row

    def together(self) -> list[torch.Tensor]:
        return [self.draw(rasterization, slice(None))]

    def one_by_one(self) -> list[torch.Tensor]:
        return [self.draw(rasterization, slice(c, c + 1)) for c in range(len(self.viewmats))]

    def gsplat(self) -> list[torch.Tensor]:
        import gsplat

        return [self.draw(gsplat.rasterization, slice(None))]

    def draw(self, draw: Draw, part: slice) -> torch.Tensor:
        pictures, _, _ = draw(
            *self.tensors,
            self.viewmats[part],
            self.Ks[part],
            self.size,
            self.size,
            sh_degree=1,
            packed=False,
        )
        return pictures

    def step(self, draw: Callable[[], list[torch.Tensor]]) -> Sequence[torch.Tensor | None]:
        """Draw the pictures; return the gradients."""
        pictures = draw()
        weights = torch.split(self.weights, len(pictures[0]))
        losses = [(p * w).sum() for p, w in zip(pictures, weights, strict=True)]
        leaves = [tensor for tensor in (self.viewmats, *self.tensors) if tensor.requires_grad]
        return torch.autograd.grad(torch.stack(losses).sum(), leaves)

    def forward_ms(self, draw: Callable[[], list[torch.Tensor]]) -> float:
        with torch.no_grad():
            return self.time(draw)

    def step_ms(self, draw: Callable[[], list[torch.Tensor]]) -> float:
        return self.time(lambda: self.step(draw))

    def time(self, call: Callable[[], object]) -> float:
        return round(time_ms(call, self.config.device, self.config.repeats).median, 3)

    def has_same_bits(self) -> bool:
        """Return whether pictures and gradients equal those of each camera alone, whose
        gradients are added up in the order of the cameras."""
        (pictures,) = self.together()
        gradients = torch.autograd.grad(
            (pictures * self.weights).sum(), [self.viewmats, *self.tensors]
        )
        sums: list[torch.Tensor] = []
        is_same = True
        for c in range(len(self.viewmats)):
            picture = self.draw(rasterization, slice(c, c + 1))
            loss = (picture * self.weights[c : c + 1]).sum()
            of_pose, *of_tensors = torch.autograd.grad(loss, [self.viewmats, *self.tensors])
            is_same = is_same and torch.equal(picture[0], pictures[c])
            is_same = is_same and torch.equal(of_pose[c], gradients[0][c])
            if not sums:
                sums = of_tensors
            else:
                sums = [a.add_(b) for a, b in zip(sums, of_tensors, strict=True)]
        return is_same and all(torch.equal(a, b) for a, b in zip(gradients[1:], sums, strict=True))


if __name__ == "__main__":
    main(tyro.cli(Config))
