"""Levels built by v3dg with the paper's settings, in comparison with levels built by
the paper's published code.

    python -m benchmarks.studies.paper_levels ASSET LAYOUT --truth PICTURE \\
        --published FOLDER... -o paper_levels_cpu

All instances of the layout are drawn from the same level, seen by a camera of the
layout. The picture is compared with the reference picture of that camera. Each FOLDER
holds the files `clusters.npz` and `gaussians.npz` that the published code writes. The
published code runs on a CPU if its import of `gsplat` is replaced by
`v3dg.compat.gsplat`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.markdown import Column, markdown
from v3dg.image import RenderedImage
from v3dg.levels import BuildConfig
from v3dg.metrics import flip
from v3dg.pictures import Picture, read_picture, to_8bit

_SH_CONSTANT = 0.28209479177387814  # the value of the SH function of degree 0


@dataclass
class Config:
    asset: tyro.conf.Positional[Path]
    """The paper's donut, an asset."""
    layout: tyro.conf.Positional[Path]
    """The paper's layout DonutSea."""
    truth: Path
    """Supersampled reference picture, a PNG."""
    published: tuple[Path, ...] = ()
    """Folders with bundles of the published code."""
    camera: int = 59
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File for the results, without suffix."""
    device: str = "auto"


def published_levels(folder: Path) -> Iterator[tuple[int, v3dg.Gaussians]]:
    """Yield the number and the gaussians of each level of a bundle of the published
    code."""
    clusters = np.load(folder / "clusters.npz")
    gaussians = np.load(folder / "gaussians.npz")
    start = clusters["start_indices"].ravel()
    count = clusters["counts"].ravel()
    level_of_cluster = clusters["lod_levels"].ravel()
    for level in np.unique(level_of_cluster):
        numbers = np.flatnonzero(level_of_cluster == level)
        rows = np.concatenate([np.arange(start[c], start[c] + count[c]) for c in numbers])
        sh = (gaussians["rgbs"][rows] - 0.5) / _SH_CONSTANT
        yield (
            int(level),
            v3dg.Gaussians(
                means=np.ascontiguousarray(gaussians["positions"][rows], np.float32),
                quats=np.ascontiguousarray(gaussians["quaternions"][rows], np.float32),
                scales=np.ascontiguousarray(gaussians["scales"][rows], np.float32),
                opacities=np.ascontiguousarray(gaussians["opacities"][rows].ravel(), np.float32),
                sh=np.ascontiguousarray(sh[:, None, :], np.float32),
            ),
        )


def everywhere(config: Config, level: v3dg.Gaussians) -> RenderedImage:
    """Draw the layout with these gaussians in every instance."""
    bundle = v3dg.build_bundle(level, config=BuildConfig.leaves_only(), progress=False)
    names = {config.asset.name: bundle}
    scene, cameras = v3dg.read_scene(config.layout, bundles=names)
    camera = list(cameras.values())[config.camera]
    return v3dg.render(scene, camera, tolerance=0.0, device=config.device)


def _values(picture: Picture) -> npt.NDArray[np.float32]:
    return np.divide(picture, 255, dtype=np.float32)


def main(config: Config) -> None:
    asset = v3dg.read_asset(config.asset)
    truth = read_picture(config.truth)
    bundle = v3dg.build_bundle(
        asset, config=BuildConfig.paper(), device=config.device, quality="draft"
    )
    levels = [("v3dg", n, bundle.level_gaussians(n)) for n in range(bundle.num_levels)]
    for number, folder in enumerate(config.published):
        levels += [(f"published {number}", n, level) for n, level in published_levels(folder)]
    rows = []
    for source, number, level in levels:
        if number == 0:
            continue
        image = everywhere(config, level)
        rows.append(
            {
                "source": source,
                "level": number,
                "gaussians": len(level),
                "in_frustum": image.stats.gaussians_in_frustum,
                "flip": flip(_values(truth), _values(to_8bit(image.color))),
            }
        )
    print(markdown(_COLUMNS, rows))
    record.write(config.output, {"camera": config.camera, "rows": rows}, config.device)


_COLUMNS = (
    Column("levels", "source"),
    Column("level", "level", "d"),
    Column("gaussians of the asset", "gaussians", ",d"),
    Column("in the frustum", "in_frustum", ",d"),
    Column("FLIP", "flip", ".4f"),
)


if __name__ == "__main__":
    main(tyro.cli(Config))
