"""The resources that a build of a given size needs, computed from its plan. Nothing is
built, and no time is measured.

Sizes are in bytes. `disk` is the peak use of the disk. `read` and `written` are totals,
without data that a resumed build reads again. `host` excludes the interpreter and its
libraries, which take about 0.1 GB.
"""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from v3dg import BuildConfig, _core
from v3dg.bundle.codec import Codec
from v3dg.bundle.file import BundlePlan
from v3dg.gaussians import gaussian_bytes
from v3dg.levels.leaves_on_disk import _Sizes, _Tile, scratch_bytes
from v3dg.levels.memory import in_bytes, unit_bytes
from v3dg.levels.plan import LevelPlan, Plan
from v3dg.levels.whole import UNIT_LEAVES


@dataclass
class Config:
    millions: tuple[float, ...] = (1, 10, 100, 1000)
    """Numbers of gaussians of the builds, in millions."""
    sh_degree: tuple[int, ...] = (0, 3)
    memory: str = "8GiB"
    """Limit of the host memory of each build."""


def main(options: Config) -> None:
    for millions in options.millions:
        for degree in options.sh_degree:
            print(json.dumps(needs(int(1e6 * millions), degree, options.memory)), flush=True)


def needs(num_gaussians: int, sh_degree: int, memory: str) -> dict[str, Any]:
    """Return the numbers of gaussians, clusters and so on of a build, and the bytes
    that it needs, as JSON values."""
    config = BuildConfig()
    plan = Plan.of(num_gaussians, config)
    units = plan.units(UNIT_LEAVES)
    file = BundlePlan(plan.layout, Codec(sh_degree), {})
    gaussian, num_low = gaussian_bytes(sh_degree), len(units[0].levels)
    records = [record_bytes(level.num_clusters, level.num_groups) for level in plan.levels]
    num_pages = plan.first_page[-1]
    journal = (
        sum(records) + 16 * num_pages + 24 * (len(units) * num_low + len(plan.levels) - num_low)
    )
    kept = range(config.target_of(num_low) if num_low < len(plan.levels) else num_low - 1, num_low)
    top = sum(plan.levels[number].num_gaussians for number in kept) * gaussian
    pages = int(np.diff(file.run(0, num_pages).places).sum())
    input_bytes, a_unit = num_gaussians * gaussian, unit_bytes(num_gaussians, sh_degree)
    sizes = _Sizes.of(in_bytes(memory), a_unit, sh_degree, [_Tile("", num_gaussians, sh_degree, 0)])
    # Whether the gaussians are sorted on disk.
    is_sorted = num_gaussians > sizes.in_memory
    passes = _core.num_halvings(num_gaussians, sizes.in_node)
    return {
        "gaussians": num_gaussians,
        "sh_degree": sh_degree,
        "levels": len(plan.levels),
        "clusters": sum(level.num_clusters for level in plan.levels),
        "pages": num_pages,
        "units": len(units),
        "levels_of_a_unit": num_low,
        "input": input_bytes,
        "bundle": file.num_bytes,
        "tables": file.num_bytes - pages,
        "journal": journal,
        "scratch": scratch_bytes(num_gaussians, sh_degree) if is_sorted else 0,
        "disk": file.num_bytes + journal + (input_bytes if is_sorted else 0),
        "sorting_passes": passes if is_sorted else 0,
        "written": file.num_bytes
        + journal
        + is_sorted * num_gaussians * (gaussian + 20 + 16 * passes),
        "read": input_bytes
        + top
        + is_sorted * (2 * input_bytes + num_gaussians * (24 + 64 * passes)),
        "a_unit": a_unit,
        "a_task": len(pickle.dumps(units[0])),
        "a_result": (sum(records[:num_low]) + 16 * plan.first_page[num_low]) // len(units),
        "plan": 2 * sum(array.nbytes for level in plan.levels for array in arrays_of(level)),
        "top": top,
    }


def arrays_of(level: LevelPlan) -> list[Any]:
    return [level.offset, level.group_offset, level.leaf_offset, level.weight]


def record_bytes(num_clusters: int, num_groups: int) -> int:
    """Return the bytes that a build records for a level: the box of each cluster, and
    two balls and the error of each group."""
    return 24 * num_clusters + 40 * num_groups


if __name__ == "__main__":
    main(tyro.cli(Config))
