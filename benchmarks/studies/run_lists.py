"""Estimates how long the lists of tiles would be if they held runs of records.

    python -m benchmarks.studies.run_lists \\
        --layout donutsea.json --bundle donut.v3dg --tolerance 9.4 -o run_lists

On CUDA, each record adds an entry of 8 bytes to the list of every tile that it may
reach. A warp writes up to 32 records of neighbouring gaussians at once, which form a
run. If lists held pairs of a run and a tile, a block would process the runs of its tile
by their nearest depth, and find their entries itself.

For each camera, the study projects the cut and counts records, entries and pairs. It
also follows the lists from front to back. It counts the pairs that a tile processes
until its pixels have stopped, the entries of these pairs, and the entries that wait at
once because a later run may be nearer. A tile counts as stopped when its mean optical
depth exceeds `--depth`, which is an estimate. The optical depth is computed from the
opacities of the tile's gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg import _core
from v3dg._json import JsonObject
from v3dg.cameras import Camera
from v3dg.select import Selection

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

# The same as in csrc/frame.
_TILE_WIDTH = 32  # px
_TILE_HEIGHT = 16  # px
_FEW_TILES = 4  # a record that covers more tiles is large
_ITEM = 256  # number of gaussians of an item
_RUN = 32  # number of records of a run
_MIN_ALPHA = 1 / 255
_AT_ONCE = 1_000_000  # number of gaussians that are projected together
# The blend stage sorts at most this many entries at once.
_PIECE = 768


@dataclass
class Config:
    layout: Path
    bundle: Path
    """Bundle of the layout's asset."""
    cameras: tuple[int, ...] = (42, 46, 50, 59)
    tolerance: float = 9.4
    depth: float = 14.0
    """Mean optical depth of a tile at which all its pixels count as stopped."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None


@dataclass
class Records:
    """(N,) records in the order of a frame: boxes of tiles, depths, runs and optical
    depths. The optical depth is what a record adds to all its tiles, multiplied by the
    number of pixels of a tile."""

    left: Ints
    right: Ints
    top: Ints
    bottom: Ints
    depth: Floats
    run: Ints
    cover: Floats

    def __len__(self) -> int:
        return len(self.depth)

    @property
    def num_tiles(self) -> Ints:
        return (self.right - self.left + 1) * (self.bottom - self.top + 1)


@dataclass
class Entries:
    """(E,) entries, sorted by tile and depth."""

    tile: Ints
    depth: Floats
    run: Ints
    cover: Floats


def parts_of(cut: Selection) -> Iterator[Selection]:
    """Yield the cut in parts of whole instances."""
    sizes = np.diff(cut._first())
    part = np.cumsum(sizes) // _AT_ONCE
    is_first = np.r_[True, np.diff(cut.instance_ids) != 0]
    part = np.maximum.accumulate(np.where(is_first, part, 0))
    for number in np.unique(part):
        rows = np.flatnonzero(part == number)
        yield Selection(
            cut.scene,
            cut.instance_ids[rows].copy(),
            cut.cluster_ids[rows].copy(),
            int(sizes[rows].sum()),
            cut.tolerance,
            0.0,
            cut.revision,
        )


def items_of(part: Selection) -> Ints:
    """Return the item of each gaussian. Neighbouring clusters of an instance are cut
    into items together."""
    sizes = np.diff(part._first())
    starts = np.ones(len(part), bool)
    starts[1:] = (np.diff(part.instance_ids) != 0) | (np.diff(part.cluster_ids) != 1)
    joined = np.cumsum(starts) - 1
    return pieces_of(np.repeat(joined, sizes), _ITEM)


def pieces_of(keys: Ints, size: int) -> Ints:
    """Return the index of each element's piece. Consecutive elements with equal keys
    are divided into pieces of at most `size`."""
    first = np.flatnonzero(np.r_[True, np.diff(keys) != 0])
    length = np.diff(np.r_[first, len(keys)])
    within = np.arange(len(keys)) - np.repeat(first, length)
    return np.cumsum(within % size == 0) - 1


def project(part: Selection, camera: Camera) -> Records:
    gaussians = part.gaussians(device="cpu")
    filters = part.filters_px2
    centers = np.zeros((len(filters), 2), np.float32)
    conics = np.zeros((len(filters), 3), np.float32)
    depths = np.zeros(len(filters), np.float32)
    opacities = np.zeros(len(filters), np.float32)
    for filter_px2 in np.unique(filters):
        rows = np.flatnonzero(filters == filter_px2)
        seen = _core.ellipses(
            gaussians.subset(rows).rows,
            camera.core,
            filter_px2=float(filter_px2),
            antialiased=False,
            far_depth=np.inf,
            min_radius_px=0.0,
        )
        centers[rows] = np.asarray(seen.centers)
        conics[rows] = np.asarray(seen.conics)
        depths[rows] = np.asarray(seen.depths)
        opacities[rows] = np.asarray(seen.opacities)
    return records_of(camera, centers, conics, depths, opacities, items_of(part))


def records_of(
    camera: Camera, centers: Floats, conics: Floats, depths: Floats, opacities: Floats, item: Ints
) -> Records:
    """Return the records of the gaussians whose boxes contain a pixel centre."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = 2 * np.log(np.maximum(opacities / _MIN_ALPHA, 1))
        determinant = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
        half = np.sqrt(reach[:, None] * conics[:, [2, 0]] / determinant[:, None])
        area = 2 * np.pi * opacities / np.sqrt(determinant)
    low = np.ceil(np.maximum(centers - half - 0.5, 0))
    high = np.floor(np.minimum(centers + half - 0.5, [camera.width - 1, camera.height - 1]))
    rows = np.flatnonzero((opacities > _MIN_ALPHA) & (low <= high).all(axis=1))
    low = low[rows].astype(np.int64)
    high = high[rows].astype(np.int64)
    return Records(
        left=low[:, 0] // _TILE_WIDTH,
        right=high[:, 0] // _TILE_WIDTH,
        top=low[:, 1] // _TILE_HEIGHT,
        bottom=high[:, 1] // _TILE_HEIGHT,
        depth=depths[rows],
        run=pieces_of(item[rows], _RUN),
        cover=area[rows].astype(np.float32),
    )


def concatenated(parts: list[Records]) -> Records:
    first_run = np.cumsum([0, *(int(part.run.max(initial=-1)) + 1 for part in parts)])
    for part, first in zip(parts, first_run, strict=False):
        part.run = part.run + first
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Records(*(np.concatenate(column) for column in columns))


def entries_of(records: Records, columns: int) -> Entries:
    counts = records.num_tiles
    row = np.repeat(np.arange(len(records)), counts)
    k = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    across = (records.right - records.left + 1)[row]
    tile = (records.top[row] + k // across) * columns + records.left[row] + k % across
    depth = records.depth[row]
    order = np.lexsort((depth, tile))
    row = row[order]
    cover = records.cover[row] / counts[row]
    return Entries(tile[order], depth[order], records.run[row], cover.astype(np.float32))


def count(config: Config, records: Records, columns: int) -> JsonObject:
    entries = entries_of(records, columns)
    num_runs = int(records.run.max()) + 1
    nearest = np.full(num_runs, np.inf, np.float32)
    np.minimum.at(nearest, records.run, records.depth)
    pair, entries_in_pair = np.unique(entries.tile * num_runs + entries.run, return_counts=True)
    of_run = np.bincount(pair % num_runs, minlength=num_runs)
    tiles_of_records = np.bincount(records.run, records.num_tiles, num_runs)
    is_suited = tiles_of_records >= 2 * of_run
    is_large = records.num_tiles > _FEW_TILES
    writes = int(of_run[is_suited].sum() + tiles_of_records[~is_suited].sum())
    result: JsonObject = {
        "records": len(records),
        "large_records": round(float(is_large.mean()), 4),
        "entries": len(entries.tile),
        "entries_of_large_records": int(records.num_tiles[is_large].sum()),
        "runs": num_runs,
        "pairs": len(pair),
        "pairs_of_entries": round(len(pair) / len(entries.tile), 4),
        "writes_with_unsuited_runs": writes,
        "writes_of_entries": round(writes / len(entries.tile), 4),
        "entries_in_a_pair": round(float(entries_in_pair.mean()), 2),
        "tiles_of_a_run": round(float(of_run.mean()), 2),
    }
    return result | follow(config, entries, nearest)


def follow(config: Config, entries: Entries, nearest: Floats) -> JsonObject:
    """Follow each tile's list from front to back until its pixels have stopped."""
    first = np.flatnonzero(np.r_[True, np.diff(entries.tile) != 0])
    ends = np.r_[first[1:], len(entries.tile)]
    taken_entries = taken_pairs = listed_records = 0
    waiting: list[int] = []
    longest_lists = [0]
    full = config.depth * _TILE_WIDTH * _TILE_HEIGHT
    for begin, end in zip(first, ends, strict=True):
        near = nearest[entries.run[begin:end]]
        depth = entries.depth[begin:end]
        stop = int(np.searchsorted(np.cumsum(entries.cover[begin:end]), full)) + 1
        stop = min(stop, end - begin)
        pairs = np.unique(entries.run[begin:end][near <= depth[stop - 1]])
        longest_lists.append(len(np.unique(entries.run[begin:end])))
        taken_entries += int(stop)
        taken_pairs += len(pairs)
        listed_records += int((near <= depth[stop - 1]).sum())
        # After each piece, the entries of runs that begin before this depth are
        # waiting.
        for k in range(_PIECE // 2, stop, _PIECE // 2):
            waiting.append(int((near[k:] <= depth[k]).sum()))
    return {
        "entries_until_stopped": taken_entries,
        "pairs_until_stopped": taken_pairs,
        "entries_of_these_pairs": listed_records,
        "entries_that_wait": [int(n) for n in np.percentile(waiting or [0], [50, 90, 95, 99, 100])],
        "longest_list_of_pairs": int(max(longest_lists)),
    }


def main(config: Config) -> None:
    scene, cameras = read_layout(config.layout, v3dg.Bundle.open(config.bundle))
    rows: list[JsonObject] = []
    for number in config.cameras:
        camera = list(cameras.values())[number]
        cut = v3dg.select(scene, camera, tolerance=config.tolerance, device="cpu")
        records = concatenated([project(part, camera) for part in parts_of(cut)])
        columns = -(-camera.width // _TILE_WIDTH)
        row: JsonObject = {"camera": number, "tolerance": config.tolerance}
        row["gaussians"] = cut.num_gaussians
        rows.append(row | count(config, records, columns))
        print(rows[-1], flush=True)
        record.write(config.output, {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Config))
