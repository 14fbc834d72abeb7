"""The composed worlds before and after a refinement of their levels: how few gaussians
reach the same FLIP.

    python -m benchmarks.studies.refined.worlds --steps 10000 --persons 3 \\
        --device cuda -o refined_worlds
    python -m benchmarks.studies.refined.worlds --report refined_worlds.json

Cuts at several tolerances, from near and far cameras, are compared with all gaussians
at 2 x 2 samples per pixel. For each camera and each FLIP of a cut of the unrefined
levels, the report has the number of gaussians with which refined levels reach this
FLIP, relative to the number of unrefined levels. It also has FLIP at the default
tolerance, relative to that of all gaussians at one sample per pixel.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import v3dg
from benchmarks import worlds
from benchmarks.evaluation import record
from benchmarks.studies.pairs.measure import errors
from v3dg._judges import Judges
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, to_8bit

Row = dict[str, Any]


@dataclass
class Config:
    names: tuple[Literal["forest", "temples", "crowd"], ...] = ("forest", "temples", "crowd")
    scale: Literal["small", "full"] = "full"
    persons: int = 16
    """Number of different persons in the crowd; each of them is refined."""
    cameras: tuple[int, ...] = (43, 47, 51, 55, 59)
    """Indices of the world's cameras. The defaults are distances 4, 8, 12, 16 and 20 of
    twenty, from near to far."""
    built: tuple[float, ...] = (3.0, 6.0, 9.4)
    """Tolerances for cuts of the unrefined levels; all gaussians are drawn as well."""
    refined: tuple[float, ...] = (3.0, 4.5, 6.0, 9.4, 13.0, 18.0)
    """Tolerances for cuts of the refined levels."""
    steps: int = 30_000
    """Steps of the refinement; 0 draws only unrefined levels."""
    build: v3dg.BuildConfig = field(default_factory=v3dg.BuildConfig)
    """Settings of the builds."""
    device: Literal["cpu", "cuda"] = "cpu"
    report: Path | None = None
    """File of recorded results to report; nothing is measured then."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None


def world_of(config: Config, name: str) -> worlds.World:
    how: Row = dict(worlds.SMALL[name]) if config.scale == "small" else {}
    if name == "crowd":
        how["persons"] = config.persons
    return worlds.WORLDS[name](**how, seed=0)


def make_asset(asset: worlds.Asset) -> v3dg.Gaussians:
    return asset.make()


def pictures(config: Config, about: Row) -> Iterator[tuple[Row, Picture, Picture]]:
    """Yield the description, reference and picture of each cut; write data about the
    builds to `about`."""
    how: Row = {"device": config.device, "progress": False}
    for name in config.names:
        world, start = world_of(config, name), time.perf_counter()
        with multiprocessing.get_context("spawn").Pool(
            min(len(world.assets), os.cpu_count() or 1)
        ) as pool:
            assets = dict(
                zip(world.assets, pool.map(make_asset, world.assets.values(), 1), strict=True)
            )
        built = {
            key: v3dg.build_bundle(asset, config=config.build, **how)
            for key, asset in assets.items()
        }
        scenes = {"built": (worlds.scene_of(world, built), (0.0, *config.built))}
        if config.steps > 0:
            refined = {
                key: v3dg.refine_bundle(b, steps=config.steps, **how) for key, b in built.items()
            }
            scenes["refined"] = worlds.scene_of(world, refined), config.refined
        seconds = round(time.perf_counter() - start, 1)
        about[name] = {"assets": len(assets), "instances": world.num_instances, "seconds": seconds}
        about[name]["gaussians"] = world.num_gaussians
        cameras = list(world.cameras().items())
        for label, camera in (cameras[number] for number in config.cameras):
            truth = draw_truth(scenes["built"][0], camera, config.device)
            for levels, (scene, tolerances) in scenes.items():
                for tolerance in tolerances:
                    image = v3dg.render(scene, camera, tolerance=tolerance, device=config.device)
                    row = {"world": name, "camera": label, "levels": levels, "tolerance": tolerance}
                    row["gaussians"] = image.stats.gaussians_in_frustum
                    yield row, truth, to_8bit(image.color)


def count_at(flip: float, rows: Sequence[Row]) -> float:
    """Return the smallest number of gaussians of these cuts whose FLIP is at most
    `flip`, interpolated in the logarithm of the number."""
    fewest = math.inf
    finest_first = sorted(rows, key=lambda row: -row["gaussians"])
    for row, coarser in zip(finest_first, [*finest_first[1:], None], strict=True):
        if row["flip"] > flip:
            continue
        fewest = row["gaussians"]
        if coarser is not None and coarser["flip"] > flip:
            part = (flip - row["flip"]) / (coarser["flip"] - row["flip"])
            fewest *= (coarser["gaussians"] / fewest) ** part
    return fewest


def share_at(tolerance: float, built: Sequence[Row], refined: Sequence[Row]) -> float | None:
    """Return the number of gaussians that refined levels need for the FLIP of an
    unrefined cut, divided by the number in that cut.

    The result is at most 1, and it is 1 if no refined cut reaches the FLIP. It is None
    if the coarsest unrefined cut has a lower FLIP than the cut at this tolerance.
    """
    flip = next(row["flip"] for row in built if row["tolerance"] == tolerance)
    coarsest = max(built, key=lambda row: row["tolerance"])
    if coarsest["flip"] < flip:
        return None
    return min(1.0, count_at(flip, refined) / count_at(flip, built))


def report(rows: Sequence[Row]) -> None:
    def of(world: str, camera: str, levels: str) -> list[Row]:
        wanted = (world, camera, levels)
        return [row for row in rows if (row["world"], row["camera"], row["levels"]) == wanted]

    for world in dict.fromkeys(row["world"] for row in rows):
        cameras = dict.fromkeys(row["camera"] for row in rows if row["world"] == world)
        sets = [(of(world, camera, "built"), of(world, camera, "refined")) for camera in cameras]
        print(world, *cameras)
        # Without refined levels there are no ratios to report.
        kinds = range(1 + any(cuts[1] for cuts in sets))
        for tolerance in sorted(
            {row["tolerance"] for row in sets[0][0]} - {0.0} if len(kinds) > 1 else ()
        ):
            shares = [share_at(tolerance, *cuts) for cuts in sets]
            known = [share for share in shares if share is not None]
            text = " ".join("  -  " if share is None else f"{share:.3f}" for share in shares)
            print(f"  {tolerance}: {text} mean {statistics.fmean(known):.3f}")
        for levels in kinds:
            at_default = [
                next(
                    row["flip"]
                    for row in found[levels]
                    if row["tolerance"] == v3dg.DEFAULT_TOLERANCE
                )
                / next(row["flip"] for row in found[0] if row["tolerance"] == 0)
                for found in sets
            ]
            print(
                "  FLIP by that of all,",
                ("built:", "refined:")[levels],
                *(f"{x:.3f}" for x in at_default),
            )


def main(config: Config) -> None:
    if config.report is not None:
        report(json.loads(config.report.read_text(encoding="utf-8"))["rows"])
        return
    about: Row = {}
    with contextlib.closing(Judges()) as judges:
        rows = [
            row | found for (row, _, _), found in judges.measured(pictures(config, about), errors)
        ]
    record.write(
        config.output, {"steps": config.steps, "worlds": about, "rows": rows}, config.device
    )
    report(rows)


if __name__ == "__main__":
    main(tyro.cli(Config))
