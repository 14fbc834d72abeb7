"""One asset drawn by v3dg and by splat-transform, a renderer that shares no code with
v3dg.

The study needs Node 22 or newer, `npm install @playcanvas/splat-transform@3.7.0`, and a
Vulkan device. Without a GPU, the software device of Chromium (SwiftShader) suffices:
`VK_ICD_FILENAMES` is the path of its vk_swiftshader_icd.json, and `XDG_RUNTIME_DIR` is
a directory.

Both renderers add the 0.3 px² of the original 3DGS code, but splat-transform clamps
alpha at 0.99 and ends each gaussian at three standard deviations, where its falloff
reaches 0. So a third picture is drawn, by the float64 reference of the tests with
splat-transform's falloff. It must equal splat-transform's picture up to the rounding to
8 bits (58.9 dB). Then projection, colour, order and blending are the same, and the
remaining difference of v3dg's picture is due to the falloff.
"""

from __future__ import annotations

import json
import math
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image

import v3dg
from v3dg.metrics import flip, psnr, ssim

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from reference import sh as reference_sh
from reference.project import project

FILTER_PX2 = 0.3
THEIR_MAX_ALPHA = 0.99
THEIR_REACH_SIGMAS = 3.0


@dataclass
class Config:
    asset: Annotated[Path, tyro.conf.Positional]
    """Asset to draw, a .ply file."""
    splat_transform: str
    """Command that starts splat-transform, such as "node
    node_modules/.bin/splat-transform"."""
    size: int = 400
    fov: float = 50.0
    """Horizontal and vertical field of view in degrees."""
    views: int = 4
    distance: float = 2.0
    """Distance from the centre of the asset, in radii of the ball that contains nearly
    all of its gaussians."""
    background: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))
    keep: Path | None = None
    """Folder for the pictures; by default they are not kept."""
    json: bool = False


def witness(config: Config, camera: v3dg.Camera, target: np.ndarray, path: Path) -> np.ndarray:
    """Return the picture (H,W,3) that splat-transform draws from the same position."""

    def point(p: np.ndarray) -> str:
        # splat-transform rotates the file's axes by half a turn about z.
        return f"{-p[0]:.9g},{-p[1]:.9g},{p[2]:.9g}"

    command = [
        *shlex.split(config.splat_transform),
        *("--quiet", "--overwrite", str(config.asset)),
        *(
            f"--camera-pos={point(camera.position)}",
            f"--camera-target={point(target)}",
            "--camera-up=0,0,1",
        ),
        *(f"--camera-fov={config.fov}", f"--camera-near={camera.near}"),
        *(
            f"--resolution={config.size}x{config.size}",
            "--background=" + ",".join(map(str, config.background)),
        ),
        str(path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not path.exists():
        sys.exit(
            f"splat-transform: failed with exit code {done.returncode}: "
            f"{(done.stderr or done.stdout).strip()}"
        )
    return np.asarray(Image.open(path).convert("RGB"), np.float32) / 255


def with_their_falloff(
    asset: v3dg.Gaussians, camera: v3dg.Camera, background: tuple[float, ...]
) -> np.ndarray:
    """Return the reference picture (H,W,3) of the tests, with splat-transform's
    falloff."""
    projection = project(asset, camera, filter_px2=FILTER_PX2)
    colors = reference_sh.color(asset.sh, asset.means - camera.position)
    largest = np.linalg.eigvalsh(
        np.where(projection.is_drawable[:, None, None], projection.covariance_px2, 0)
    )
    reach = np.ceil(THEIR_REACH_SIGMAS * np.sqrt(largest[:, 1]))
    size = np.array([camera.width, camera.height])
    first = np.clip(np.floor(projection.mean_px - reach[:, None]), 0, size).astype(int)
    last = np.clip(np.ceil(projection.mean_px + reach[:, None]) + 1, 0, size).astype(int)
    floor = math.exp(-0.5 * THEIR_REACH_SIGMAS**2)
    color = np.zeros((camera.height, camera.width, 3))
    transmittance = np.ones((camera.height, camera.width))
    for i in np.argsort(projection.depth, kind="stable"):
        (x0, y0), (x1, y1) = first[i], last[i]
        if not projection.is_drawable[i] or x0 >= x1 or y0 >= y1:
            continue
        conic = np.linalg.inv(projection.covariance_px2[i])
        dx = np.arange(x0, x1) + 0.5 - projection.mean_px[i, 0]
        dy = (np.arange(y0, y1) + 0.5 - projection.mean_px[i, 1])[:, None]
        falloff = np.exp(
            -0.5 * (conic[0, 0] * dx * dx + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy)
        )
        alpha = np.minimum(THEIR_MAX_ALPHA, asset.opacities[i] * np.maximum(0, falloff - floor))
        left = transmittance[y0:y1, x0:x1]
        alpha[(alpha < 1 / 255) | (left < 1e-4)] = 0
        color[y0:y1, x0:x1] += (left * alpha)[..., None] * colors[i]
        transmittance[y0:y1, x0:x1] = left * (1 - alpha)
    return np.clip(color + transmittance[..., None] * np.array(background), 0, 1).astype(np.float32)


def main(config: Config) -> None:
    asset = v3dg.read_asset(config.asset)
    center = np.median(asset.means, axis=0).astype(np.float64)
    radius = float(np.quantile(np.linalg.norm(asset.means - center, axis=1), 0.99))
    cameras = v3dg.turntable(
        center,
        radius * config.distance,
        config.views,
        fov_x=math.radians(config.fov),
        width=config.size,
        height=config.size,
    )
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = config.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for i, camera in enumerate(cameras):
            raster = v3dg.rasterize(
                asset, camera, filter_px2=FILTER_PX2, background=config.background
            )
            ours = np.clip(raster.color, 0, 1)
            theirs = witness(config, camera, center, folder / f"theirs_{i}.webp")
            if config.keep:
                Image.fromarray(np.round(ours * 255).astype(np.uint8)).save(
                    folder / f"ours_{i}.png"
                )
            same_falloff = with_their_falloff(asset, camera, config.background)
            rows.append(
                {
                    "view": i,
                    "covered": float((raster.alpha > 0.01).mean()),
                    "psnr_db": psnr(theirs, ours),
                    "ssim": ssim(theirs, ours),
                    "flip": flip(theirs, ours),
                    "same_falloff_psnr_db": psnr(theirs, same_falloff),
                    "same_falloff_largest_difference": float(
                        np.abs(theirs - same_falloff).max() * 255
                    ),
                }
            )
    if config.json:
        print(json.dumps({"asset": config.asset.name, "gaussians": len(asset), "views": rows}))
        return
    print(f"{config.asset.name}: {len(asset)} gaussians, {config.size} px, filter {FILTER_PX2} px²")
    print("view  covered  PSNR dB    SSIM    FLIP  | their falloff: PSNR dB  largest difference")
    for r in rows:
        print(
            f"{r['view']:4d}  {r['covered']:7.1%}  {r['psnr_db']:7.2f}  {r['ssim']:.4f}  "
            f"{r['flip']:.4f}  | {r['same_falloff_psnr_db']:22.2f}  "
            f"{r['same_falloff_largest_difference']:14.2f}/255"
        )


if __name__ == "__main__":
    main(tyro.cli(Config))
