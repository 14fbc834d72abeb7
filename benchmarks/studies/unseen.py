"""The error of a scene after gaussians that are hardly visible are dropped, and the
effect of a refit.

    python -m benchmarks.studies.unseen ASSETS --only Paljassaare -o unseen_cpu

ASSETS is a folder as for `benchmarks.studies.pairs`. Its scenes are measured from their
own cameras. Other cameras, near these and with other directions, determine which
gaussians are least visible. These gaussians are dropped, as by
`examples/drop_unseen.py`. The remaining gaussians may be refitted to pictures of all
gaussians from the same other cameras with 3 x 3 samples per pixel, or be drawn with
levels. Errors are against all gaussians at 4 x 4 samples per pixel. The table has the
fraction of the gaussians in the frustum, and FLIP relative to that of all gaussians at
one sample per pixel.
"""

from __future__ import annotations

import json
import math
import random
import runpy
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.studies.pairs.subject import Subject, scaled
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import to_8bit

Row = dict[str, Any]

# Range of the tangent of the field of view, relative to the scene's cameras.
_NARROWEST, _WIDEST = 0.9, 1.25
_PITCH = 0.4  # radians; the maximum pitch
_EXAMPLE = Path(__file__).parents[2] / "examples" / "drop_unseen.py"
# Adam's initial step sizes in a refit: means in units of the median scale, scales as
# logarithms, opacities as logits.
_SIZES = {
    "means": 3e-3,
    "quats": 1.5e-4,
    "scales": 6e-4,
    "opacities": 2e-3,
    "sh0": 4.5e-4,
    "rest": 6e-5,
}
_LAST_STEP = 0.01  # final step size, relative to the initial one
_SAMPLES = 3


@dataclass
class Config:
    assets: tyro.conf.Positional[Path]
    """Folder with assets.json."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File for the results, without suffix."""
    only: tuple[str, ...] = ()
    """Names of the scenes to measure; by default all."""
    parts: tuple[float, ...] = (1.0, 0.9, 0.8, 0.7, 0.6)
    """Fractions of the visible gaussians to keep."""
    refit: tuple[float, ...] = ()
    """Fractions, from `parts`, for which the gaussians are also refitted."""
    tolerances: tuple[float, ...] = ()
    """Tolerances at which the kept gaussians are also drawn with levels."""
    steps: int = 4000
    """Number of steps of a refit, with one picture each."""
    width: int = 384
    """Width in px of the pictures for the weights and for the refit."""
    widths: tuple[int, ...] = (384,)
    """Widths in px of the compared pictures."""
    views: int = 4
    """Number of cameras from which errors are measured."""
    others: int = 48
    """Number of cameras from which the visibility of gaussians is measured."""
    distance: float = 0.3
    """Approximate distance in world units between another camera and a camera of the
    scene."""
    turn: float = math.pi
    """Maximum rotation of another camera in radians."""
    seed: int = 0
    device: Literal["cpu", "cuda"] = "cpu"


def others_of(config: Config, cameras: Sequence[v3dg.Camera]) -> list[v3dg.Camera]:
    """Return cameras near the given ones, rotated by evenly distributed angles."""
    rng = np.random.default_rng(config.seed)
    poses = [np.linalg.inv(camera.viewmat.astype(np.float64)) for camera in cameras]
    up = -np.mean([pose[:3, 1] for pose in poses], axis=0)
    up /= np.linalg.norm(up)
    turns = math.ceil(config.others / len(cameras))
    made = []
    for number in range(config.others):
        camera, pose = cameras[number % len(cameras)], poses[number % len(cameras)]
        share = (number // len(cameras) + rng.uniform()) / turns
        angle, pitch = (2 * share - 1) * config.turn, rng.uniform(-_PITCH, _PITCH)
        ahead = pose[:3, 2]
        across, along = np.cross(up, ahead), up * (up @ ahead)
        ahead = (ahead - along) * math.cos(angle) + across * math.sin(angle) + along
        ahead = ahead + math.tan(pitch) * up
        eye = pose[:3, 3] + config.distance * rng.normal(size=3)
        fov_x = 2 * math.atan(rng.uniform(_NARROWEST, _WIDEST) * camera.width / camera.fx / 2)
        size: Row = {"near": camera.near, "width": config.width, "height": config.width * 9 // 16}
        made.append(v3dg.Camera.look_at(eye, eye + ahead, up=tuple(up), fov_x=fov_x, **size))
    return made


def refitted(
    kept: v3dg.Gaussians, asset: v3dg.Gaussians, cameras: Sequence[v3dg.Camera], config: Config
) -> v3dg.Gaussians:
    """Return the kept gaussians after a fit by Adam to pictures of the asset, one
    picture per step."""
    import torch

    device, steps = config.device, config.steps
    whole = asset.torch(device)
    truths = [torch.tensor(draw_truth(whole, camera, device, _SAMPLES)) for camera in cameras]
    start = kept.torch(device)
    values: dict[str, Any] = {"means": start.means, "quats": start.quats}
    values |= {"scales": start.scales.clamp(1e-12).log(), "opacities": start.opacities.logit(1e-4)}
    values |= {"sh0": start.sh[:, :1], "rest": start.sh[:, 1:]}
    values = {name: value.clone().requires_grad_() for name, value in values.items()}
    sizes = _SIZES | {"means": _SIZES["means"] * float(start.scales.amax(dim=1).median())}
    groups = [{"params": [values[name]], "lr": size} for name, size in sizes.items()]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    smaller = torch.optim.lr_scheduler.ExponentialLR(adam, _LAST_STEP ** (1 / steps))

    def gaussians() -> v3dg.Gaussians:
        shape = values["scales"].exp(), values["opacities"].sigmoid()
        quats = torch.nn.functional.normalize(values["quats"])
        sh = torch.cat([values["sh0"], values["rest"]], dim=1)
        return v3dg.Gaussians(values["means"], quats, *shape, sh)

    order = random.Random(config.seed)
    left: list[int] = []
    for _ in range(steps):
        left = left or order.sample(range(len(cameras)), len(cameras))
        number = left.pop()
        wanted = truths[number].to(device).float() / 255
        adam.zero_grad()
        (v3dg.rasterize(gaussians(), cameras[number]).color - wanted).abs().mean().backward()
        adam.step()
        smaller.step()
    with torch.no_grad():
        return gaussians().numpy()


def measure(config: Config, subject: Subject) -> list[Row]:
    """Return means over the views for each width and fraction."""
    asset = subject.asset.numpy()
    others = others_of(config, subject.cameras)
    weights_in = runpy.run_path(str(_EXAMPLE))["weights_in"]
    weights = np.sum([weights_in(asset, camera, config.device) for camera in others], axis=0)
    seen = np.flatnonzero(weights > 0)
    seen = seen[np.argsort(weights[seen], kind="stable")]
    shown = [
        (width, scaled(view, width / view.width))
        for width in config.widths
        for view in subject.cameras
    ]
    whole_asset = asset.torch(config.device)
    truths = [draw_truth(whole_asset, camera, config.device, 4) for _, camera in shown]
    rows: list[Row] = []
    whole: list[Row] = []

    def add(
        kept: v3dg.Gaussians | v3dg.Bundle, part: float, steps: int, tolerance: float = 0.0
    ) -> None:
        found = []
        options: Row = {"tolerance": tolerance} if isinstance(kept, v3dg.Bundle) else {}
        renderer = v3dg.Renderer(kept, device=config.device)
        for (width, camera), truth in zip(shown, truths, strict=True):
            image = renderer.render(camera, **options)
            count = image.stats.gaussians_in_frustum
            found.append({"width": width, "count": count, **errors_of(truth, to_8bit(image.color))})
        if part == 0:
            whole.extend(found)
            return
        pairs = list(zip(found, whole, strict=True))
        for width in config.widths:
            here = [(mine, all_) for mine, all_ in pairs if mine["width"] == width]
            row = {
                "asset": subject.name,
                "width": width,
                "seen": len(seen) / len(asset),
                "part": part,
            }
            row |= {"steps": steps, "tolerance": tolerance}
            row["all"] = statistics.fmean(all_["flip"] for _, all_ in here)
            row["share"] = statistics.fmean(mine["count"] / all_["count"] for mine, all_ in here)
            ratios = [mine["flip"] / all_["flip"] for mine, all_ in here]
            row |= {"flip": statistics.geometric_mean(ratios), "worst": max(ratios)}
            row["psnr"] = statistics.fmean(mine["psnr"] - all_["psnr"] for mine, all_ in here)
            rows.append(row)

    add(asset, 0, 0)
    for part in sorted({*config.parts, *config.refit}, reverse=True):
        kept = asset.subset(np.sort(seen[round(len(seen) * (1 - part)) :]))
        add(kept, part, 0)
        if part in config.refit:
            add(refitted(kept, asset, others, config), part, config.steps)
        if config.tolerances:
            bundle = v3dg.build_bundle(kept, device=config.device, progress=False)
            for tolerance in config.tolerances:
                add(bundle, part, 0, tolerance)
    return rows


_COLUMNS = (
    Column("scene", "asset"),
    Column("width", "width", "d"),
    Column("FLIP of all", "all", ".4f"),
    Column("seen", "seen", ".0%"),
    Column("kept of these", "part", ".0%"),
    Column("steps of refit", "steps", "d"),
    Column("tolerance", "tolerance", "g"),
    Column("in the frustum, of all", "share", ".3f"),
    Column("FLIP, kept / all", "flip", ".3f"),
    Column("worst", "worst", ".3f"),
    Column("PSNR, kept less all, dB", "psnr", "+.2f"),
)


def main(config: Config) -> None:
    about = json.loads((config.assets / "assets.json").read_text(encoding="utf-8"))
    rows: list[Row] = []
    for name in config.only or tuple(name for name in about if "cameras" in about[name]):
        start = time.perf_counter()
        rows += measure(config, Subject(config.assets, name, about[name], config.views))
        names = ("width", "others", "distance", "turn", "steps")
        settings = {setting: getattr(config, setting) for setting in names}
        record.write(config.output, {"settings": settings, "rows": rows}, config.device)
        print(f"{name} done, {time.perf_counter() - start:.0f} s", flush=True)
    print(markdown(_COLUMNS, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
