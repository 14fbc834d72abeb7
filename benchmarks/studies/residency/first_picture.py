"""The time from opening files to the first, coarsest picture with a page pool.

Data of 10 GB are made from one bundle in two forms: a set of copies; and one file with
the clusters of as many copies, whose tables are as large as those of a real bundle of
that size. All copies are at the same position. Separate processes open the files and
draw, with the system's file cache dropped before (`cold`) or not. If another checkout
is given, its processes alternate with those of this one.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from v3dg.bundle.codec import codec_of
from v3dg.bundle.file import BundlePlan, write_pages
from v3dg.bundle.pages import PageLayout

# Environment variable that contains the paths for a child process.
PATHS = "V3DG_FIRST_PICTURE"


@dataclass
class Config:
    bundle: Path
    """A .v3dg file to copy."""
    folder: Path
    """Folder for the copies; existing copies are used again."""
    copies: int = 103
    rounds: int = 3
    memory: str = "1GB"
    device: str = "cpu"
    size: tuple[int, int] = (640, 360)
    against: Path | None = None
    """Another checkout with a compiled module to measure as well."""
    output: str | None = None


def write_set(config: Config) -> list[Path]:
    paths = [config.folder / f"copy_{number}.v3dg" for number in range(config.copies)]
    for path in paths:
        if not path.exists():
            shutil.copyfile(config.bundle, path)
    return paths


def write_joined(config: Config) -> Path:
    """Write one bundle with the clusters of all copies, sorted by level, and by copy
    within each level."""
    path = config.folder / f"joined_{config.copies}.v3dg"
    if path.exists():
        return path
    one, count = v3dg.Bundle.open(config.bundle), config.copies
    c, g = one.clusters, one.groups
    clusters = [one.level_range(level) for level in range(one.num_levels)]
    groups = [np.flatnonzero(g.level == level) for level in range(one.num_levels)]
    old_cluster = np.concatenate([np.tile(np.arange(r.start, r.stop), count) for r in clusters])
    copy = np.concatenate([np.repeat(np.arange(count), len(r)) for r in clusters])
    old_group = np.concatenate([np.tile(ids, count) for ids in groups])
    group_copy = np.concatenate([np.repeat(np.arange(count), len(ids)) for ids in groups])
    new_group = np.full((count, len(g) + 1), -1, np.int32)
    new_group[group_copy, old_group] = np.arange(len(old_group))
    sizes = np.diff(c.offset)[old_cluster]
    columns = {
        name: getattr(c, name)[old_cluster]
        for name in ("level", "box", "filter_px2", "antialiased")
    }
    made = v3dg.Clusters(
        offset=np.concatenate([[0], np.cumsum(sizes)]),
        own_group=new_group[copy, c.own_group[old_cluster]],
        parent_group=new_group[copy, c.parent_group[old_cluster]],
        **columns,
    )
    of_groups = {name: getattr(g, name)[old_group] for name in ("ball", "weight", "level", "error")}
    made_groups = v3dg.Groups(parent=new_group[group_copy, g.parent[old_group]], **of_groups)

    codec = codec_of(one.codec, one.sh_degree)
    plan = BundlePlan(PageLayout.of(made), codec, one.config)
    file = one._file
    assert file is not None
    places, hashes = file.places, file.tables["pages.hash"]
    parent_level = g.level  # level of the parents of page g; the last page has none
    with open(path, "wb", buffering=0) as out, open(config.bundle, "rb") as source:
        at, made_hashes = len(plan.header), []
        for level in range(1, one.num_levels):
            pages = np.flatnonzero(parent_level == level)
            source.seek(places[pages[0]])
            data = source.read(int(places[pages[-1] + 1] - places[pages[0]]))
            for _ in range(count):
                os.pwrite(out.fileno(), data, at)
                at += len(data)
            made_hashes.append(np.tile(hashes[pages], (count, 1)))
        roots = v3dg.Gaussians.concatenate([one.read_page(one.num_pages - 1)] * count)
        run = plan.run(plan.layout.num_pages - 1, plan.layout.num_pages)
        made_hashes.append(write_pages(out.name, out.fileno(), run, codec, roots))
        plan.write_tables(out.fileno(), made, made_groups, np.concatenate(made_hashes))
        plan.write_header(out.fileno())
    return path


def drop_cached(paths: list[Path]) -> None:
    """Ask the operating system to drop the files from its cache, where it supports
    that."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)
    with suppress(OSError):
        Path("/proc/sys/vm/drop_caches").write_text("3")


def open_and_draw(config: Config, paths: list[Path]) -> dict[str, Any]:
    """Return the milliseconds of each step. Importing the module is not measured."""
    if config.device != "cpu":
        import torch

        torch.zeros(1, device=config.device)
    laps, begin = {}, time.perf_counter()

    def lap(name: str) -> None:
        laps[name] = 1e3 * (time.perf_counter() - begin) - sum(laps.values())

    open_all = getattr(v3dg.Bundle, "open_all", lambda paths: list(map(v3dg.Bundle.open, paths)))
    bundles = open_all(paths)
    lap("open")
    scene, count = v3dg.Scene(), len(bundles)
    number = np.arange(count)
    positions = np.stack([number % 13 * 2.0, number // 13 * 2.0, 0.0 * number], 1)
    scene.add(bundles, positions)
    renderer = v3dg.Renderer(scene, memory=config.memory, device=config.device)
    lap("renderer")
    width, height = config.size
    middle = positions.mean(axis=0)
    eye = middle + np.array([0.0, -14.0, 4.0])
    camera = v3dg.Camera.look_at(eye, middle, (0, 0, 1), width=width, height=height)
    image = renderer.render(camera)
    assert image.stats.gaussians_selected > 0
    lap("picture")
    return laps | {"all": sum(laps.values()), "cpu_seconds": time.process_time()}


def main(config: Config) -> None:
    config.folder.mkdir(exist_ok=True)
    sets = {"set": write_set(config), "joined": [write_joined(config)]}
    here = Path(__file__).parents[3]
    checkouts = {"this": here} | ({} if config.against is None else {"other": config.against})
    rows = []
    for _ in range(config.rounds):
        for name, temperature, checkout in product(sets, ("warm", "cold"), checkouts):
            paths = sets[name]
            if temperature == "cold":
                drop_cached(paths)
            environment = {
                "PYTHONPATH": str(checkouts[checkout]),
                PATHS: json.dumps(list(map(str, paths))),
            }
            done = subprocess.run(
                [sys.executable, __file__, *sys.argv[1:]],
                env=os.environ | environment,
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            )
            rows.append(
                {
                    "files": name,
                    "cache": temperature,
                    "checkout": checkout,
                    **json.loads(done.stdout),
                }
            )
            print(
                {k: round(v, 1) if isinstance(v, float) else v for k, v in rows[-1].items()},
                flush=True,
            )
    sizes = {name: sum(path.stat().st_size for path in paths) for name, paths in sets.items()}
    result = {"config": {k: str(v) for k, v in vars(config).items()}, "bytes": sizes, "rows": rows}
    record.write(config.output, {"device": config.device, **result}, config.device)


if __name__ == "__main__":
    chosen = tyro.cli(Config)
    if PATHS in os.environ:
        print(
            json.dumps(
                open_and_draw(chosen, [Path(path) for path in json.loads(os.environ[PATHS])])
            )
        )
    else:
        main(chosen)
