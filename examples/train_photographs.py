"""Trains gaussians on photographs with gsplat's DefaultStrategy. v3dg draws the
pictures and computes the gradients.

The input is a folder in the layout of COLMAP's `image_undistorter`, with photographs in
`images/` and a model in `sparse/` or `sparse/0`; or a folder with a `transforms.json`
whose photographs have no distortion. Every eighth photograph is held out, and the
result is measured on these photographs. Learning rates and schedule are those of
gsplat's `simple_trainer.py`, except that gaussians are added only in the first half of
the steps. docs/photographs.md describes the next steps.

The example needs torch and gsplat; pycolmap, if the folder has a model of COLMAP; and a
GPU for more than a few hundred steps:

    pip install '.[torch,colmap]' gsplat==1.5.3
    python examples/train_photographs.py capture/
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from PIL import Image
from torch.nn import functional

import v3dg
from v3dg.compat.gsplat import rasterization
from v3dg.pictures import contact_sheet, to_8bit, write_picture

C0 = 0.28209479177387814  # the constant spherical harmonic
HELD_OUT = 8  # one of this many photographs is held out
STRUCTURE = 0.2  # weight of 1 - SSIM in the loss
DEGREE_EVERY = 1000  # number of steps after which the next SH degree is drawn, too


@dataclass
class Config:
    """Train gaussians on photographs."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder with photographs and cameras."""
    output: Path = Path("trained.ply")
    """Asset to write. A .jpg beside it shows held-out photographs and the asset's
    pictures of the same views."""
    steps: int = 7000
    """Number of steps, each with one photograph."""
    longest: int = 1200
    """Maximum length in px of the longer side of a photograph; larger photographs are
    scaled down."""
    start: int = 50_000
    """Initial number of gaussians, if there are no points of COLMAP."""
    sh_degree: int = 3
    """SH degree of the colours, 0 to 3."""
    device: str = "cuda"
    """Device for the training: cuda or cpu."""
    seed: int = 0
    """Seed of the order of photographs and of the strategy's random numbers."""


@dataclass
class Photograph:
    name: str
    camera: v3dg.Camera
    pixels: torch.Tensor
    """(H, W, 3) uint8, on the CPU."""


def main(config: Config) -> float:
    """Write the asset; return its mean PSNR in dB on the held-out photographs."""
    torch.manual_seed(config.seed)
    photographs = read_photographs(config)
    held_out = photographs[::HELD_OUT]
    trained_on = [photograph for k, photograph in enumerate(photographs) if k % HELD_OUT]
    if not trained_on:
        raise SystemExit(
            f"{config.capture}: expected at least two photographs, got {len(photographs)}"
        )
    print(f"{len(trained_on)} photographs to train on, {len(held_out)} held out", flush=True)
    parameters = start(config, [photograph.camera for photograph in photographs])
    began = time.perf_counter()
    train(parameters, trained_on, config)
    seconds = time.perf_counter() - began
    v3dg.write_asset(config.output, as_asset(parameters))

    rows, decibels = [], []
    with torch.no_grad():
        for photograph in held_out:
            drawn = draw(parameters, photograph.camera, config.sh_degree)[0][0].clamp(0, 1)
            decibels.append(
                -10 * math.log10(functional.mse_loss(drawn, target_of(photograph, config.device)))
            )
            text = f"{photograph.name}: {decibels[-1]:.2f} dB"
            rows.append([(text, photograph.pixels.numpy()), ("trained", to_8bit(drawn))])
            print(text)
    write_picture(config.output.with_suffix(".jpg"), contact_sheet(rows[:4]))
    mean = float(np.mean(decibels))
    num = len(parameters["means"])
    print(
        f"{config.output}: {num:,} gaussians, {seconds:.0f} s, {mean:.2f} dB on held-out "
        "photographs"
    )
    return mean


def read_photographs(config: Config) -> list[Photograph]:
    """Return the photographs in the order of their names, scaled down to the maximum
    size, with cameras of the scaled size."""
    listed = config.capture / "transforms.json"
    cameras = v3dg.read_cameras(listed if listed.is_file() else config.capture)
    folder = config.capture if listed.is_file() else config.capture / "images"
    photographs = []
    for name, camera in sorted(cameras.items()):
        with Image.open(folder / name) as file:
            image = file.convert("RGB")
        if image.size != (camera.width, camera.height):
            wanted = f"{camera.width} x {camera.height} px, as its camera"
            raise SystemExit(
                f"{folder / name}: expected {wanted}, got {image.width} x {image.height}"
            )
        shrink = min(1.0, config.longest / max(image.size))
        size = (round(image.width * shrink), round(image.height * shrink))
        pixels = np.array(image.resize(size, Image.Resampling.LANCZOS) if shrink < 1 else image)
        K = camera.K * [[size[0] / camera.width], [size[1] / camera.height], [1]]
        fitting = v3dg.Camera(camera.viewmat, K, *size, near=camera.near)
        photographs.append(Photograph(name, fitting, torch.from_numpy(pixels)))
    return photographs


def start(config: Config, cameras: list[v3dg.Camera]) -> dict[str, torch.nn.Parameter]:
    """Return a gaussian at each of COLMAP's points; without points, at random positions
    around the point where the cameras look."""
    points, colors = points_of(config, cameras)
    num = len(points)
    rest = (config.sh_degree + 1) ** 2 - 1
    values = {
        "means": points,
        "scales": nearest(points).log()[:, None].expand(-1, 3),
        "quats": functional.normalize(torch.randn(num, 4), dim=1),
        "opacities": torch.full((num,), math.log(0.1 / 0.9)),
        "sh0": ((colors - 0.5) / C0)[:, None],
        "shN": torch.zeros(num, rest, 3),
    }
    return {
        name: torch.nn.Parameter(value.contiguous().to(config.device))
        for name, value in values.items()
    }


def points_of(config: Config, cameras: list[v3dg.Camera]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (N, 3) points, and their colours (N, 3) in [0,1]."""
    models = [
        config.capture / part for part in ("sparse/0", "sparse") if (config.capture / part).is_dir()
    ]
    if models:
        import pycolmap

        found = list(pycolmap.Reconstruction(str(models[0])).points3D.values())
        points, colors = (
            np.array([getattr(point, what) for point in found]) for what in ("xyz", "color")
        )
    else:
        middle, size = looked_at(cameras)
        generator = np.random.default_rng(config.seed)
        points = middle + generator.uniform(-size, size, (config.start, 3))
        colors = np.full(points.shape, 127.5)
    return torch.tensor(points, dtype=torch.float32), torch.tensor(
        colors / 255, dtype=torch.float32
    )


def looked_at(cameras: list[v3dg.Camera]) -> tuple[np.ndarray, float]:
    """Return the point nearest to the lines of sight of all cameras, and the distance
    of the farthest camera from this point."""
    positions = np.array([camera.position for camera in cameras])
    across = [
        np.eye(3) - np.outer(camera.viewmat[2, :3], camera.viewmat[2, :3]) for camera in cameras
    ]
    middle = np.linalg.lstsq(
        sum(across), sum(a @ p for a, p in zip(across, positions, strict=True))
    )[0]
    return middle, float(np.linalg.norm(positions - middle, axis=1).max())


def nearest(points: torch.Tensor) -> torch.Tensor:
    """Return (N,) the distance of each point from its neighbours: the root mean square
    of the distances to the three nearest points."""
    distances = [
        torch.cdist(part, points).topk(min(4, len(points)), largest=False).values
        for part in points.split(1024)
    ]
    return torch.cat(distances)[:, 1:].square().mean(1).sqrt().clamp(min=1e-7)


def train(
    parameters: dict[str, torch.nn.Parameter], photographs: list[Photograph], config: Config
) -> None:
    """Train the parameters on the photographs, in place. The number of gaussians
    changes, too."""
    from gsplat import DefaultStrategy

    positions = np.array([photograph.camera.position for photograph in photographs])
    size = 1.1 * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    rates = {
        "means": 1.6e-4 * size,
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 1.25e-4,
    }
    optimizers = {
        name: torch.optim.Adam([values], lr=rates[name], eps=1e-15)
        for name, values in parameters.items()
    }
    decay = torch.optim.lr_scheduler.ExponentialLR(
        optimizers["means"], 0.01 ** (1 / max(1, config.steps))
    )
    # Gaussians are added in the first half of the steps, and settle in the second half.
    strategy = DefaultStrategy(refine_stop_iter=config.steps // 2)
    strategy.check_sanity(parameters, optimizers)
    state = strategy.initialize_state(scene_scale=size)
    order = torch.Generator().manual_seed(config.seed)
    for step in range(config.steps):
        photograph = photographs[int(torch.randint(len(photographs), (1,), generator=order))]
        drawn, _, info = draw(
            parameters, photograph.camera, min(config.sh_degree, step // DEGREE_EVERY)
        )
        strategy.step_pre_backward(parameters, optimizers, state, step, info)
        target = target_of(photograph, config.device)[None]
        loss = (1 - STRUCTURE) * (drawn - target).abs().mean() + STRUCTURE * (
            1 - structure(drawn, target)
        )
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(parameters, optimizers, state, step, info, packed=False)
        if (step + 1) % 500 == 0 or step + 1 == config.steps:
            print(
                f"step {step + 1}: loss {loss.item():.4f}, {len(parameters['means']):,} gaussians",
                flush=True,
            )


def draw(parameters: dict[str, torch.nn.Parameter], camera: v3dg.Camera, sh_degree: int) -> Any:
    device = parameters["means"].device
    return rasterization(
        means=parameters["means"],
        quats=parameters["quats"],
        scales=parameters["scales"].exp(),
        opacities=parameters["opacities"].sigmoid(),
        colors=torch.cat([parameters["sh0"], parameters["shN"]], 1),
        viewmats=torch.tensor(camera.viewmat, dtype=torch.float32, device=device)[None],
        Ks=torch.tensor(camera.K, dtype=torch.float32, device=device)[None],
        width=camera.width,
        height=camera.height,
        near_plane=camera.near,
        sh_degree=sh_degree,
        packed=False,
    )


def target_of(photograph: Photograph, device: str) -> torch.Tensor:
    return photograph.pixels.to(device).float() / 255


def structure(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the SSIM of (1, H, W, 3) pictures, with a window of 11 x 11 px."""
    bell = torch.exp(-((torch.arange(11, device=first.device) - 5.0) ** 2) / (2 * 1.5**2))
    bell = (bell / bell.sum()).expand(3, 1, 11)

    def mean(values: torch.Tensor) -> torch.Tensor:
        rows = functional.conv2d(values, bell[:, :, None], groups=3, padding=(0, 5))
        return functional.conv2d(rows, bell[:, :, :, None], groups=3, padding=(5, 0))

    x, y = first.movedim(-1, 1), second.movedim(-1, 1)
    mx, my = mean(x), mean(y)
    variances = mean(x * x) - mx**2 + mean(y * y) - my**2
    covariance = mean(x * y) - mx * my
    ratio = (
        (2 * mx * my + 1e-4)
        * (2 * covariance + 9e-4)
        / ((mx**2 + my**2 + 1e-4) * (variances + 9e-4))
    )
    return ratio.mean()


def as_asset(parameters: dict[str, torch.nn.Parameter]) -> v3dg.Gaussians:
    values = {name: value.detach().cpu() for name, value in parameters.items()}
    return v3dg.Gaussians(
        values["means"],
        values["quats"],
        values["scales"].exp(),
        values["opacities"].sigmoid(),
        torch.cat([values["sh0"], values["shN"]], 1),
    ).numpy()


if __name__ == "__main__":
    main(tyro.cli(Config))
