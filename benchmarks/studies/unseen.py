"""What a scene loses when gaussians that are hardly seen are dropped, and what a refit brings back.

    python -m benchmarks.studies.unseen ASSETS --only Paljassaare -o unseen_cpu

ASSETS is a folder as `benchmarks.studies.pairs` describes it; its scenes are measured from their own
cameras. How much is seen of a gaussian is its blend weight, summed over the pixels of other cameras, which
stand beside those and look elsewhere: the gradient of a picture's sum by the gaussian's colour. Those with
the least are dropped. What is left may be refitted to pictures of all gaussians, 3 x 3 samples a pixel, from
the same other cameras. Errors are to all gaussians at 4 x 4 samples a pixel. The table has the share of the
gaussians in the frustum, and FLIP by that of all gaussians at one sample.
"""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.studies.pairs_subject import Subject, scaled
from v3dg import _core
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import to_8bit

Row = dict[str, Any]

_NARROWEST, _WIDEST = 0.9, 1.25  # of the pictures' tangent, in that of the scene's own cameras
_PITCH = 0.4  # radians, at most
# Adam's step sizes; positions in median scales.
_STEPS = {"means": 0.02, "quats": 0.001, "scales": 0.004, "opacities": 0.015, "sh0": 0.003, "rest": 0.0004}
_FINAL_STEP = 0.1


@dataclass
class Config:
    assets: tyro.conf.Positional[Path]
    """Folder with assets.json."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File of the results, without its suffix."""
    only: tuple[str, ...] = ()
    """Names of scenes; all by default."""
    parts: tuple[float, ...] = (1.0, 0.9, 0.8, 0.7, 0.6)
    """Of the gaussians that are seen at all: what is kept."""
    refit: tuple[float, ...] = ()
    """Those of them that are refitted."""
    steps: int = 240
    """Of a refit, a picture each."""
    rate: float = 0.1
    """Factor of its step sizes."""
    width: int = 384
    """px of the pictures that weights are measured in and that is fitted to."""
    widths: tuple[int, ...] = (384,)
    """px of the pictures that are compared."""
    views: int = 4
    """From which errors are measured."""
    others: int = 48
    """Cameras that weights are measured from."""
    distance: float = 0.3
    """World units from a camera of the scene to another, about."""
    turn: float = math.pi
    """Radians by which another camera is turned at most."""
    seed: int = 0


def others_of(config: Config, cameras: Sequence[v3dg.Camera]) -> list[v3dg.Camera]:
    """Cameras beside the given ones, turned by angles that are spread evenly."""
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


def weights_in(asset: v3dg.Gaussians, camera: v3dg.Camera) -> Any:
    """(N,) blend weight of each gaussian, summed over the pixels."""
    plain = np.full((len(asset), 1, 3), 0.5, np.float32)
    rows = v3dg.Gaussians(asset.means, asset.quats, asset.scales, asset.opacities, plain).rows
    options: dict[str, Any] = {"filter_px2": 0.0, "antialiased": False, "background": (0.0, 0.0, 0.0)}
    options |= {"with_depth": False, "keep_tape": True, "plain_colors": True}
    *_, tape = _core.rasterize(rows, camera.core, **options)
    by_color = np.zeros((camera.height, camera.width, 3), np.float32)
    by_color[..., 0] = 1
    return np.asarray(_core.rasterize_backward(tape, by_color, None, None)[4])[:, 0, 0]


def refitted(config: Config, kept: v3dg.Gaussians, asset: v3dg.Gaussians, cameras: Any) -> v3dg.Gaussians:
    """What is kept, fitted to pictures of all gaussians."""
    import torch

    truths = [draw_truth(asset, camera, "cpu", 3) for camera in cameras]
    start = {"means": kept.means, "quats": kept.quats, "scales": np.log(kept.scales.clip(1e-12))}
    odds = kept.opacities.clip(1e-4, 1 - 1e-4)
    start |= {"opacities": np.log(odds / (1 - odds)), "sh0": kept.sh[:, :1], "rest": kept.sh[:, 1:]}
    values = {name: torch.tensor(array).requires_grad_() for name, array in start.items()}
    size = float(np.median(kept.scales.max(axis=1)))
    groups = [
        {"params": [value], "lr": config.rate * _STEPS[name] * (size if name == "means" else 1)}
        for name, value in values.items()
    ]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    schedule = torch.optim.lr_scheduler.ExponentialLR(adam, _FINAL_STEP ** (1 / config.steps))

    def gaussians() -> v3dg.Gaussians:
        quats = torch.nn.functional.normalize(values["quats"])
        sh = torch.cat([values["sh0"], values["rest"]], dim=1)
        shape = values["scales"].exp(), values["opacities"].sigmoid()
        return v3dg.Gaussians(values["means"], quats, *shape, sh)

    order = np.random.default_rng(config.seed)
    for step in range(config.steps):
        if step % len(cameras) == 0:
            turn = order.permutation(len(cameras))
        number = int(turn[step % len(cameras)])
        truth = torch.tensor(truths[number].astype(np.float32) / 255)
        loss = (v3dg.rasterize(gaussians(), cameras[number]).color - truth).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        schedule.step()
    with torch.no_grad():
        return gaussians().numpy()


def measure(config: Config, subject: Subject) -> list[Row]:
    """Means over the views, for each width and what is kept."""
    asset = subject.asset.numpy()
    others = others_of(config, subject.cameras)
    weights = np.sum([weights_in(asset, camera) for camera in others], axis=0, dtype=np.float64)
    seen = np.flatnonzero(weights > 0)
    order = seen[np.argsort(weights[seen], kind="stable")]
    shown = [(width, scaled(view, width / view.width)) for width in config.widths for view in subject.cameras]
    truths = [draw_truth(asset, camera, "cpu", 4) for _, camera in shown]
    rows: list[Row] = []
    whole: list[Row] = []

    def add(kept: v3dg.Gaussians, part: float, steps: int) -> None:
        found = []
        for (width, camera), truth in zip(shown, truths, strict=True):
            image = v3dg.render(kept, camera, device="cpu")
            count = image.stats.gaussians_in_frustum
            found.append({"width": width, "count": count, **errors_of(truth, to_8bit(image.color))})
        if part == 0:
            whole.extend(found)
            return
        pairs = list(zip(found, whole, strict=True))
        for width in config.widths:
            here = [(mine, all_) for mine, all_ in pairs if mine["width"] == width]
            row = {"asset": subject.name, "width": width, "seen": len(seen) / len(asset), "part": part}
            row |= {"steps": steps, "all": statistics.fmean(all_["flip"] for _, all_ in here)}
            row["share"] = statistics.fmean(mine["count"] / all_["count"] for mine, all_ in here)
            ratios = [mine["flip"] / all_["flip"] for mine, all_ in here]
            row |= {"flip": statistics.geometric_mean(ratios), "worst": max(ratios)}
            row["psnr"] = statistics.fmean(mine["psnr"] - all_["psnr"] for mine, all_ in here)
            rows.append(row)

    add(asset, 0, 0)
    for part in sorted({*config.parts, *config.refit}, reverse=True):
        kept = asset.subset(np.sort(order[round(len(seen) * (1 - part)) :]))
        add(kept, part, 0)
        if part in config.refit:
            add(refitted(config, kept, asset, others), part, config.steps)
    return rows


_COLUMNS = (
    Column("scene", "asset"),
    Column("width", "width", "d"),
    Column("FLIP of all", "all", ".4f"),
    Column("seen", "seen", ".0%"),
    Column("kept of these", "part", ".0%"),
    Column("steps of refit", "steps", "d"),
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
        settings = {"width": config.width, "others": config.others, "distance": config.distance}
        record.write(config.output, {"settings": settings | {"turn": config.turn}, "rows": rows}, "cpu")
        print(f"{name} done, {time.perf_counter() - start:.0f} s", flush=True)
    print(markdown(_COLUMNS, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
