"""The leaves of an asset in one or many files, which need not fit in memory.

An asset that does not fit in memory is read twice, in blocks. The first pass writes its
means to scratch files. There they are split (`external_split`) down to *buckets*, nodes
that are small enough to be sorted when they are read. The second pass writes every
gaussian to its bucket. docs/results.md lists the amounts of data that are read and
written.
"""

import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg._device import CPU, Device
from v3dg._numbers import check
from v3dg._progress import Bar, Progress
from v3dg._urls import shown
from v3dg.bundle.codec import Codec
from v3dg.cameras import Axis
from v3dg.formats._reading import AssetFile
from v3dg.gaussians import Gaussians, common, gaussian_bytes, put
from v3dg.io import open_asset
from v3dg.levels import external_split
from v3dg.levels.config import BuildConfig
from v3dg.levels.digest import PIECE, digest_of_hashes, hash_of, new_pool, pieces_of
from v3dg.levels.leaves import Leaves, MemoryLeaves, Tally, Unusable
from v3dg.levels.memory import in_mib
from v3dg.levels.plan import halved
from v3dg.levels.scratch import RowFile, scratch_folder

MOST_GAUSSIANS = 1 << 32
"""An asset must have fewer gaussians than this."""

# a quarter of a build unit, so that few gaussians are read in vain
_MOST_IN_BUCKET = 1 << 18
# Larger blocks would not be faster, because their rows are read in random order.
_MOST_IN_BLOCK_BYTES = 1 << 28
_SENT_AT_ONCE = 1 << 12  # number of gaussians that a thread writes to a bucket at once
_OVERHEAD_BYTES = 24 << 20
_CHANGED = (
    "a file that does not change during the build, got different content when it was read again; "
    "build again"
)
_NAMES = ("points", "spare", "order", "rows")

_Blocks = Iterator[tuple[int, Gaussians]]


@dataclass(eq=False)
class DiskLeaves(Leaves):
    """Leaves in a scratch folder, valid while the folder exists. They can be pickled,
    and read by several threads at once."""

    path: Path
    bucket_offset: npt.NDArray[np.int64]
    bucket_depth: int  # depth of the median split inside each bucket

    def read(self, first: int, last: int) -> Gaussians:
        result = Codec(self.sh_degree).empty(last - first)
        first_bucket = int(np.searchsorted(self.bucket_offset, first, "right")) - 1
        last_bucket = int(np.searchsorted(self.bucket_offset, last, "left"))
        with RowFile(self.path, gaussian_bytes(self.sh_degree) // 4, np.float32) as file:
            for bucket in range(first_bucket, last_bucket):
                begin = int(self.bucket_offset[bucket])
                end = int(self.bucket_offset[bucket + 1])
                low = max(first, begin)
                high = min(last, end)
                if self.bucket_depth == 0:
                    _put_rows(file.read(low, high), result, low - first)
                    continue
                rows = file.read(begin, end)
                means = np.ascontiguousarray(rows[:, :3])
                order, _ = _core.median_split(means, np.array([0, end - begin]), self.bucket_depth)
                _put_rows(rows[order[low - begin : high - begin]], result, low - first)
        return result


@contextmanager
def leaves_on_disk(
    paths: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    memory: int,
    config: BuildConfig,
    unusable: Unusable = "drop",
    reserved: Callable[[int, int], int] = lambda num_gaussians, sh_degree: 0,
    device: Device = CPU,
    progress: Progress = False,
    most_in_memory: int = MOST_GAUSSIANS,
) -> Iterator[Leaves]:
    """Return the leaves of the asset that the gaussians of all files form together,
    using at most `memory` bytes.

    The leaves are in the order of the median split of the whole asset, which does not
    depend on the memory. `reserved` returns the memory that other work needs, given the
    number of gaussians and the SH degree. An asset of more than `most_in_memory`
    gaussians is sorted on disk even if it fits in memory. The scratch folder is only
    created if it is needed, and is removed at the end.
    """
    files = map(open_asset, paths)  # lazy, so that few files are open at the same time
    tiles = list(map(_Tile.of, files))
    count = sum(tile.num_gaussians for tile in tiles)
    check("asset", count < MOST_GAUSSIANS, f"fewer than 2^32 gaussians, got {count:,}; divide it")
    degree = max(tile.sh_degree for tile in tiles)
    sizes = _Sizes.of(memory, reserved(count, degree), degree, tiles)
    folder = Path(folder)
    fits = count <= min(sizes.in_memory, most_in_memory)
    scratch: AbstractContextManager[None] = nullcontext()
    # Remove a folder that a killed build has left, even if it is not needed.
    if not fits or os.path.lexists(folder):
        scratch = scratch_folder(folder, _NAMES)
    if fits:
        progress = False
    with scratch, Bar(2 * count, "reading", progress) as bar:
        if fits:
            antialiased = _antialiased(tiles)
            buffer = Codec(degree).empty(count).trained(antialiased=antialiased)
            for _ in _blocks(tiles, buffer, bar):
                pass
            bar.close()
            leaves: Leaves = MemoryLeaves(buffer, config, unusable, device, tiles[0].up)
            del buffer
        else:
            _check_disk(folder, scratch_bytes(count, degree))
            leaves = _sort_on_disk(tiles, folder, sizes, config, unusable, bar)
            bar.close()
        yield leaves


def _check_disk(folder: Path, num_bytes: int) -> None:
    """Raise OSError if the disk of a folder has less than `num_bytes` free."""
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        raise OSError(
            f"{folder}: expected {in_mib(num_bytes)} free for scratch files, got {in_mib(free)}; "
            "free some space, write to another disk, or allow more memory"
        )


class _Tile(NamedTuple):
    """One of the asset's files, and its header."""

    path: str | os.PathLike[str]
    num_gaussians: int
    sh_degree: int
    whole_bytes: int
    up: Axis | None
    antialiased: bool | None

    @staticmethod
    def of(file: AssetFile) -> "_Tile":
        return _Tile(
            file.path,
            file.num_gaussians,
            file.sh_degree,
            file.whole_bytes,
            file.declared.up,
            file.declared.antialiased,
        )

    def open(self) -> AssetFile:
        file = open_asset(self.path)
        is_same = (file.num_gaussians, file.sh_degree) == (self.num_gaussians, self.sh_degree)
        check(shown(self.path), is_same, _CHANGED)
        return file


def _antialiased(tiles: Sequence[_Tile]) -> bool | None:
    """Return whether the gaussians of all files were trained with antialiasing. Return
    None if that is unknown or differs between files."""
    return common([tile.antialiased for tile in tiles])


class _Sizes(NamedTuple):
    """Maximum numbers of gaussians: in memory at once, in a block, in a node that is
    split, and in a bucket."""

    in_memory: int
    in_block: int
    in_node: int
    in_bucket: int

    @staticmethod
    def of(memory: int, reserved: int, degree: int, tiles: Sequence[_Tile]) -> "_Sizes":
        """Return the sizes for `memory` bytes. Raise ValueError if the memory is too
        small."""
        gaussian = gaussian_bytes(degree)
        # While a piece of a block is decoded, it also needs memory in double precision.
        overhead = _OVERHEAD_BYTES + 8 * PIECE * gaussian
        largest = max(tiles, key=lambda tile: tile.whole_bytes)
        required = reserved + overhead + largest.whole_bytes + PIECE * gaussian
        expected = f"at least {in_mib(required)}"
        if largest.whole_bytes:
            expected += f" for {shown(largest.path)}, which must be read whole, unlike a .ply file"
        check(
            "memory",
            memory >= required,
            f"{expected}, got {memory / (1 << 20):,.1f} MiB; allow more memory",
        )
        memory -= reserved
        for_block = memory - overhead - largest.whole_bytes
        for_split = memory - _OVERHEAD_BYTES
        return _Sizes(
            in_memory=for_block // (gaussian + external_split.FITTING_BYTES),
            in_block=min(for_block, _MOST_IN_BLOCK_BYTES) // gaussian // PIECE * PIECE,
            in_node=for_split // external_split.FITTING_BYTES,
            in_bucket=min(_MOST_IN_BUCKET, for_split // _bytes_in_bucket(degree)),
        )

    def blocks(self, tiles: Sequence[_Tile], bar: Bar) -> "_Blocks":
        """Yield the asset in blocks of at most `in_block` gaussians."""
        degree = max(tile.sh_degree for tile in tiles)
        return _blocks(tiles, Codec(degree).empty(self.in_block), bar)


def _bytes_in_bucket(degree: int) -> int:
    """Return the memory per gaussian while a bucket is sorted: two copies of the
    gaussian, and the split."""
    return 2 * gaussian_bytes(degree) + external_split.FITTING_BYTES


def scratch_bytes(count: int, degree: int) -> int:
    """Return an upper bound of the size of the scratch files for `count` gaussians, in
    bytes."""
    return count * (4 + max(gaussian_bytes(degree), 2 * 16))


def _blocks(tiles: Sequence[_Tile], buffer: Gaussians, bar: Bar) -> _Blocks:
    """Fill the buffer with one block of the asset after another. Yield each block with
    the index of its first gaussian."""
    first = 0
    filled = 0
    for tile in tiles:
        file = tile.open()
        row = 0
        while row < tile.num_gaussians:
            last = min(row + PIECE, tile.num_gaussians, row + len(buffer) - filled)
            put(file.read(row, last), buffer, filled)
            bar.update(last - row)
            filled += last - row
            row = last
            if filled == len(buffer):
                yield first, buffer
                first += filled
                filled = 0
        del file  # free a file that is read before the next one is opened
    if filled:
        yield first, buffer.subset(slice(0, filled))


def _put_rows(rows: npt.NDArray[np.float32], out: Gaussians, start: int) -> None:
    """Copy gaussians from rows of a file to `out`, beginning at gaussian `start`."""
    column = 0
    for array in vars(out).values():
        width = math.prod(array.shape[1:])
        array[start : start + len(rows)] = rows[:, column : column + width].reshape(
            -1, *array.shape[1:]
        )
        column += width


def _sort_on_disk(
    tiles: Sequence[_Tile],
    folder: Path,
    sizes: _Sizes,
    config: BuildConfig,
    unusable: Unusable,
    bar: Bar,
) -> DiskLeaves:
    degree = max(tile.sh_degree for tile in tiles)
    points, spare, order, rows = (folder / name for name in _NAMES)
    tally = Tally()
    with _new_words(order, 1) as order_file:
        with _new_words(points, 4) as point_file, _new_words(spare, 4) as spare_file:
            digest = _write_points(sizes.blocks(tiles, bar), point_file, tally)
            tally.check(unusable)
            count = tally.num_drawable
            depth = _core.num_halvings(count, config.cluster_size)
            bucket_depth = min(depth, _core.num_halvings(count, sizes.in_bucket))
            files = (point_file, spare_file)
            external_split.split(files, count, bucket_depth, sizes.in_node, order_file)
        _remove(points, spare)
        offset = halved(np.array([count]), bucket_depth)
        ends = _ends_in_buckets(order_file, offset, sizes.in_block, tally.num_gaussians)
        with RowFile(rows, gaussian_bytes(degree) // 4, np.float32, must_be_new=True) as row_file:
            second_digest = _write_rows(sizes.blocks(tiles, bar), order_file, ends, row_file)
    order.unlink()
    check(_name_of(tiles), second_digest == digest, _CHANGED)
    return DiskLeaves(
        num_gaussians=count,
        asset_gaussians=tally.num_gaussians,
        sh_degree=degree,
        dropped=tally.counts,
        digest=digest,
        resident_bytes=int(np.diff(offset).max()) * _bytes_in_bucket(degree),
        up=tiles[0].up,
        antialiased=_antialiased(tiles),
        path=rows.absolute(),
        bucket_offset=offset,
        bucket_depth=depth - bucket_depth,
    )


def _remove(*paths: Path) -> None:
    for path in paths:
        path.unlink()


def _new_words(path: Path, width: int) -> external_split.WordFile:
    """Return a new file of rows of 32-bit integers."""
    return RowFile(path, width, np.uint32, must_be_new=True)


def _name_of(tiles: Sequence[_Tile]) -> str:
    """Return the name of the asset for messages."""
    if len(tiles) == 1:
        return shown(tiles[0].path)
    return f"one of {len(tiles)} files"


def _write_points(blocks: _Blocks, points: external_split.WordFile, tally: Tally) -> str:
    """Run the first pass: write the means of the drawable gaussians and their rows in
    the asset. Return the digest."""
    hashes: list[bytes] = []
    with new_pool() as pool:
        for first, block in blocks:
            pieces = pieces_of(block)
            hashes += pool.map(hash_of, pieces)
            for number, piece in enumerate(pieces):
                end = tally.num_drawable
                row = np.flatnonzero(tally.add(piece))
                points.write(
                    end, external_split.points_of(piece.means[row], first + number * PIECE + row)
                )
    return digest_of_hashes(hashes)


def _write_rows(
    blocks: _Blocks,
    order: external_split.WordFile,
    ends: npt.NDArray[np.int64],
    rows: RowFile[np.float32],
) -> str:
    """Run the second pass: write every gaussian to its bucket, in the order of the
    asset. Return the digest."""
    hashes: list[bytes] = []
    with new_pool() as pool:
        for number, (first, block) in enumerate(blocks):
            hashes += pool.map(hash_of, pieces_of(block))
            arrays = [array.reshape(len(block), -1) for array in vars(block).values()]

            def send(
                begin: int,
                end: int,
                first: int = first,
                arrays: list[npt.NDArray[np.float32]] = arrays,
            ) -> None:
                for start in range(begin, end, _SENT_AT_ONCE):
                    index = (
                        order.read(start, min(start + _SENT_AT_ONCE, end)).astype(np.int64) - first
                    )
                    # take() releases the GIL, which indexing with brackets does not.
                    rows.write(
                        start,
                        np.concatenate([array.take(index, axis=0) for array in arrays], axis=1),
                    )

            deque(pool.map(send, ends[:, number].tolist(), ends[:, number + 1].tolist()), maxlen=0)
    return digest_of_hashes(hashes)


def _ends_in_buckets(
    order: external_split.WordFile,
    offset: npt.NDArray[np.int64],
    block: int,
    asset_gaussians: int,
) -> npt.NDArray[np.int64]:
    """Return positions in `order`, (B, blocks + 1) for B buckets.

    A row has the start of its bucket and then, for each block of `block` gaussians of
    the asset, the end of those that come from this block. Within a bucket, `order` must
    be ascending, so that the gaussians of a block are contiguous.
    """
    counts = np.zeros((len(offset) - 1, 1 - (-asset_gaussians // block)), np.int64)
    for bucket, (begin, end) in enumerate(
        zip(offset[:-1].tolist(), offset[1:].tolist(), strict=True)
    ):
        for index in order.blocks(begin, end, _MOST_IN_BUCKET):
            counts[bucket, 1:] += np.bincount(
                index // np.uint32(block), minlength=counts.shape[1] - 1
            )
    return offset[:-1, None] + np.cumsum(counts, axis=1)
