"""Selects the gaussians for a view with v3dg, and draws them with gsplat. Any
rasterizer can draw the gaussians of a selection.

The example needs a GPU:

    pip install '.[torch]' gsplat==1.5.3
    python examples/with_gsplat.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import v3dg
from v3dg.donut import make_donut
from v3dg.metrics import psnr
from v3dg.pictures import write_picture


@dataclass
class Config:
    """Draw a field of donuts, or of copies of a bundle, with gsplat."""

    bundle: Path | None = None
    """Bundle to draw; by default a generated donut."""
    output: Path = Path("with_gsplat.png")
    """Picture to write."""
    rows: int = 20
    """Number of instances per side of the square field."""
    size: tuple[int, int] = (1280, 720)
    """Width and height of the picture in px."""
    tolerance: float = v3dg.DEFAULT_TOLERANCE
    """Maximum screen area in px² for each gaussian of a coarser cluster."""


def main(config: Config) -> float:
    """Write the picture; return its PSNR in dB against v3dg's picture."""
    import gsplat

    scene, camera = make_scene(config)
    selection = v3dg.select(scene, camera, tolerance=config.tolerance, device="cuda")
    color, _, _ = gsplat.rasterization(**gsplat_arguments(selection, camera, "cuda"))
    picture = color[0].clamp(0, 1).cpu().numpy()
    write_picture(config.output, picture)
    ours = v3dg.render(scene, camera, tolerance=config.tolerance, device="cuda")
    likeness = psnr(np.clip(ours.color.cpu().numpy(), 0, 1), picture)
    print(
        f"{config.output}: {selection.num_gaussians:,} of {num_gaussians(scene):,} gaussians; "
        f"{likeness:.1f} dB to v3dg's own picture"
    )
    return likeness


def gsplat_arguments(selection: v3dg.Selection, camera: v3dg.Camera, device: str) -> dict[str, Any]:
    """Return the arguments with which `gsplat.rasterization` draws a selection.

    Positions are relative to the camera, which is then at the origin. So float32 is
    precise enough even far from the origin of the world.
    """
    import torch

    chosen = selection.gaussians(origin=camera.position, device=device).torch(device)
    viewmat = torch.eye(4, device=device)
    viewmat[:3, :3] = torch.from_numpy(camera.viewmat[:3, :3])
    return {
        "means": chosen.means,
        "quats": chosen.quats,
        "scales": chosen.scales,
        "opacities": chosen.opacities,
        "colors": chosen.sh,
        "sh_degree": chosen.sh_degree,
        "viewmats": viewmat[None],
        "Ks": torch.from_numpy(camera.K).to(device, torch.float32)[None],
        "width": camera.width,
        "height": camera.height,
        "near_plane": camera.near,
        "eps2d": filter_of(selection.scene),
        "rasterize_mode": "antialiased",
    }


def filter_of(scene: v3dg.Scene) -> float:
    """Return the filter variance in px² of level 1 of the first bundle. It is used for
    all gaussians, because gsplat has only one filter for a picture."""
    clusters = scene.bundles[0].clusters
    return float(clusters.filter_px2[clusters.level == 1].max(initial=0.0))


def make_scene(config: Config) -> tuple[v3dg.Scene, v3dg.Camera]:
    """Return a scene with a square of instances, and a camera above one of its
    sides."""
    if config.bundle is None:
        bundle = v3dg.build_bundle(make_donut(), device="auto")
    else:
        bundle = v3dg.Bundle.open(config.bundle)
    means = bundle.level_gaussians(0).means
    step = 1.1 * float(np.ptp(means, axis=0).max())
    x, y = np.meshgrid(np.arange(config.rows), np.arange(config.rows))
    positions = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1) * step
    scene = v3dg.Scene()
    scene.add(bundle, positions=positions)
    middle = step * (config.rows - 1) / 2
    eye = (middle, -3 * step, 3 * step)
    camera = v3dg.Camera.look_at(
        eye, (middle, middle / 2, 0), fov_x=1.0, width=config.size[0], height=config.size[1]
    )
    return scene, camera


def num_gaussians(scene: v3dg.Scene) -> int:
    """Return the number of gaussians of all instances at full detail."""
    sizes = np.array([bundle.info()["levels"][0]["gaussians"] for bundle in scene.bundles])
    return int(sizes[scene.instance_bundle].sum())


if __name__ == "__main__":
    main(tyro.cli(Config))
