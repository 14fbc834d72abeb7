"""Exports a bundle as streamed SOG, the level-of-detail format of PlayCanvas and
SuperSplat.

The asset is divided into chunks, which are subtrees of the bundle, and viewers choose a
level for each chunk. Any choice is a cut without gaps. Up to the level at which a chunk
is a single group, the levels are those of the bundle. Above it, each chunk is halved
separately. No level of a chunk is empty, because PlayCanvas's engine may keep drawing a
finer level instead of an empty one. Chunks of the same level are stored next to each
other in folders of SOG, and `lod-meta.json` lists the rows of each chunk in these
folders.
"""

import functools
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from v3dg import _core
from v3dg._numbers import check, check_type, whole
from v3dg._progress import Bar, Progress
from v3dg._version import __version__
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Floats
from v3dg.cleaning import ball_of_most
from v3dg.export import _common
from v3dg.export._folder import replacing_export
from v3dg.export.chunk_errors import ChunkErrors
from v3dg.export.chunk_levels import LevelFilter, halved_levels, num_halvings
from v3dg.formats import sog
from v3dg.formats._packing import check_writable
from v3dg.gaussians import Gaussians
from v3dg.opening import File, opened
from v3dg.rotations import rotation_from_quaternion, turn_upright
from v3dg.scene import Scene
from v3dg.upright import up_of

INDEX = "lod-meta.json"
SETTINGS = "settings.json"
DEFAULT_CHUNK = 16384
# Chunks are added to a folder until it has this number of gaussians. A folder is then
# about one megabyte to download.
_FOLDER_GAUSSIANS = 1 << 17
_FOV_DEGREES = 50.0  # vertical field of view of the first camera


class _Lod(TypedDict):
    """The rows of a chunk at a level: `count` rows, beginning at row `offset`, in the
    SOG folder with index `file`."""

    file: int
    offset: int
    count: int


class _Leaf(TypedDict):
    """The levels of a chunk, whose numbers are strings, and the error of each level
    compared with the finest one."""

    lods: dict[str, _Lod]
    errors: list[float]


class _Bound(TypedDict):
    min: list[float]
    max: list[float]


class _BoundedLeaf(TypedDict):
    bound: _Bound
    lods: dict[str, _Lod]
    errors: list[float]


class _Branch(TypedDict):
    bound: _Bound
    children: "list[_TreeNode]"


_TreeNode: TypeAlias = _BoundedLeaf | _Branch


class _Folders(NamedTuple):
    """The written folders of SOG."""

    names: list[str]
    leaves: list[_Leaf]  # indexed by chunk
    counts: list[int]  # number of gaussians in each level


@dataclass(frozen=True)
class Export:
    """A finished export as streamed SOG.

    Attributes:
        counts: Number of gaussians in each level, finest first.
        chunks: Number of chunks. Viewers choose a level for each of them.
        files: Number of folders of SOG.
        bytes: Total size of the written files.
    """

    counts: list[int]
    chunks: int
    files: int
    bytes: int


def write_streamed_sog(
    bundle: Bundle | File,
    folder: str | os.PathLike[str],
    *,
    chunk: int = DEFAULT_CHUNK,
    up: Axis | None = None,
    progress: Progress = False,
    overwrite: bool = False,
) -> Export:
    """Write a bundle as streamed SOG. The files of an earlier export are replaced when
    all new files are complete.

    `settings.json` contains the first view for SuperSplat's viewer. The export needs
    memory for one folder of SOG, and 128 KiB of pictures per chunk.

    Args:
        bundle: A bundle, or the path of its file.
        folder: The folder to write. It may be new or empty, or contain an earlier
            export. Missing parent folders are created. `v3dg-export.json` in it lists
            the written files, and only these are replaced or removed by a later export.
        chunk: Maximum number of the asset's gaussians in a chunk. Smaller chunks adapt
            better to the view, but viewers draw at least one gaussian of each chunk.
        up: The axis of the asset that points up. It is rotated to the up axis of
            viewers, -y. Most trained assets need no rotation. None uses the axis of
            `v3dg.upright.up_of`.
        progress: See `v3dg.build_bundle`.
        overwrite: Whether to write to any folder, and to replace files with the same
            names in it. All other files are kept.

    Raises:
        ValueError: ``folder`` contains other files or the bundle's file; a file of the
            earlier export was changed; ``chunk`` is too small for the bundle's groups;
            or SOG cannot represent a value of a gaussian.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.

    Source: PlayCanvas, the streamed SOG format, version 1.
    """
    content = opened(bundle)
    plan = Plan.of(content, chunk)
    turn = turn_upright(up or up_of(content)[0])
    certain = (INDEX, SETTINGS)
    with (
        replacing_export(Path(folder), Scene.of(content), certain, overwrite=overwrite) as new,
        Bar(plan.num_gaussians, "export", progress) as bar,
    ):
        return write_levels(plan, new.path, turn, bar.update)


def write_levels(
    plan: "Plan", place: Path, turn: Floats, advance: Callable[[int], object]
) -> Export:
    """Write the levels of a bundle to a folder, rotated by a quaternion (4,)."""
    folders = _write_folders(place, plan, turn, advance)
    counts = folders.counts
    index = {
        "version": 1,
        "asset": {"generator": f"v3dg {__version__}"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(counts),
        "lodErrors": True,
        "filenames": [f"{name}/meta.json" for name in folders.names],
        "tree": plan.tree(folders.leaves, turn),
    }
    _common.write_document(place / INDEX, index)
    # A level with few gaussians would not show the extent of the asset.
    framed = next((level for level in range(plan.top, 0, -1) if counts[level] >= 1000), 0)
    gaussians = plan.bundle.level_gaussians(framed).transform(turn)
    _common.write_document(place / SETTINGS, _viewer_settings(gaussians))
    return Export(counts, plan.num_chunks, len(folders.names), _common.bytes_below(place))


def _write_folders(
    place: Path, plan: "Plan", turn: Floats, advance: Callable[[int], object]
) -> _Folders:
    """Write the gaussians of all levels to folders of SOG."""
    names: list[str] = []
    errors = ChunkErrors()
    leaves: list[_Leaf] = [
        {"lods": {}, "errors": errors.of_chunk[number]} for number in range(plan.num_chunks)
    ]
    counts = [0] * plan.num_levels
    for level, all_parts in enumerate(plan.levels()):
        num_earlier = len(names)
        parts: list[Gaussians] = []
        size = 0
        for number, part in enumerate(all_parts):
            chunk = check_writable(part).transform(turn)
            errors.add(number, chunk)
            leaves[number]["lods"][str(level)] = {
                "file": len(names),
                "offset": size,
                "count": len(chunk),
            }
            parts.append(chunk.subset(_core.morton_order(chunk.means)))
            size += len(chunk)
            if size >= _FOLDER_GAUSSIANS or number == plan.num_chunks - 1:
                name = f"{level}_{len(names) - num_earlier}"
                _write_sog(place / name, Gaussians.concatenate(parts))
                names.append(name)
                counts[level] += size
                advance(size)
                parts = []
                size = 0
    return _Folders(names, leaves, counts)


def _write_sog(folder: Path, gaussians: Gaussians) -> None:
    """Create a folder with gaussians as SOG."""
    folder.mkdir()
    for name, content in sog.encode(gaussians).items():
        (folder / name).write_bytes(content)


def _viewer_settings(gaussians: Gaussians) -> dict[str, object]:
    """Return settings for SuperSplat's viewer: a camera that shows most of the asset,
    and no effects."""
    # In SuperSplat's world, y points up. It assumes that y points down in the asset,
    # and rotates it by half a turn about z.
    centre, radius = ball_of_most(gaussians.means.astype(np.float64) * (-1.0, -1.0, 1.0))
    distance = 1.2 * radius / math.sin(math.radians(_FOV_DEGREES) / 2)
    position = centre + distance * np.array([0.4, 0.4, 0.8]) / np.linalg.norm([0.4, 0.4, 0.8])
    pose = {"position": position.tolist(), "target": centre.tolist(), "fov": _FOV_DEGREES}
    settings = json.loads(files("v3dg.export").joinpath(SETTINGS).read_text(encoding="utf-8"))
    return {**settings, "cameras": [{"initial": pose}]}


@dataclass(frozen=True)
class Plan:
    """The division of a bundle into chunks. They are the groups of its level `top`, or
    the whole bundle if it has only one level.

    Attributes:
        chunk_of_cluster: (C,) index of the cluster's chunk, or -1 for clusters of
            levels above `top`.
        chunk_of_group: (G,) index of the chunk that a group of level `top` forms, or -1
            for groups of other levels.
    """

    bundle: Bundle
    top: int
    num_chunks: int
    chunk_of_cluster: NDArray[np.int64]
    chunk_of_group: NDArray[np.int64]
    _clusters: dict[int, list[NDArray[np.int64]]] = field(default_factory=dict)

    @classmethod
    def of(cls, bundle: Bundle, chunk: int) -> "Plan":
        check_type("bundle", bundle, Bundle, "a Bundle")
        check("bundle", bundle.num_gaussians, "at least one gaussian to export, got none")
        chunk = whole(chunk, "chunk", "at least 1 gaussian", 1, 1 << 62)
        clusters = bundle.clusters
        groups = bundle.groups
        if bundle.num_levels == 1:
            return cls(bundle, 0, 1, np.zeros(len(clusters), np.int64), np.zeros(0, np.int64))
        leaves = bundle.level_range(0)
        sizes = np.diff(clusters.offset[: leaves.stop + 1])
        top = 0
        ancestor = np.arange(len(groups))
        for level in range(1, bundle.num_levels):
            candidate = np.where(groups.level[ancestor] < level, groups.parent[ancestor], ancestor)
            largest = int(np.bincount(candidate[clusters.parent_group[: leaves.stop]], sizes).max())
            if largest > chunk:
                break
            top = level
            ancestor = candidate
        expected = f"at least {largest} gaussians, the size of the largest group"
        check("chunk", top > 0, f"{expected}, got {chunk}")
        number = np.full(len(groups), -1, np.int64)
        tops = np.flatnonzero(groups.level == top)
        number[tops] = np.arange(len(tops))
        # A cluster belongs to the chunk of the group that replaces it. A cluster of
        # level `top` belongs to the group that made it.
        group = np.where(clusters.level < top, clusters.parent_group, clusters.own_group)
        chunk_of_cluster = np.where(clusters.level <= top, number[ancestor[group]], -1)
        return cls(bundle, top, len(tops), chunk_of_cluster, number)

    @property
    def num_levels(self) -> int:
        return self.top + 1 + num_halvings(int(self._sizes[self.top].max()))

    @property
    def num_gaussians(self) -> int:
        """The number of gaussians in all levels together."""
        total = int(self._sizes.sum())
        sizes = self._sizes[self.top]
        for _ in range(self.top + 1, self.num_levels):
            sizes = (sizes + 1) // 2
            total += int(sizes.sum())
        return total

    @functools.cached_property
    def _source(self) -> NDArray[np.int64]:
        """(top + 1, K) the level of the bundle from which a level of a chunk is taken.
        It is the same level. If the chunk has no gaussians there, it is the nearest
        finer one, or else the nearest coarser one."""
        level = np.arange(self.top + 1)[:, None]
        present = np.where(self._bundle_sizes > 0, level, -1)
        finer = np.maximum.accumulate(present, axis=0)
        coarser = np.where(self._bundle_sizes > 0, level, self.top + 1)
        coarser = np.minimum.accumulate(coarser[::-1], axis=0)[::-1]
        return np.where(finer >= 0, finer, np.minimum(coarser, self.top))

    @functools.cached_property
    def _bundle_sizes(self) -> NDArray[np.int64]:
        """(top + 1, K) number of gaussians of each chunk in the levels of the
        bundle."""
        sizes = np.zeros((self.top + 1, self.num_chunks), np.int64)
        num_gaussians = np.diff(self.bundle.clusters.offset)
        used = self.chunk_of_cluster >= 0
        place = (self.bundle.clusters.level[used], self.chunk_of_cluster[used])
        np.add.at(sizes, place, num_gaussians[used])
        return sizes

    @property
    def _sizes(self) -> NDArray[np.int64]:
        """(top + 1, K) number of written gaussians of each chunk."""
        return np.take_along_axis(self._bundle_sizes, self._source, axis=0)

    def levels(self) -> Iterator[Iterable[Gaussians]]:
        """Yield, for each level, the gaussians of its chunks."""
        for level in range(self.top + 1):
            yield self._parts(level)
        yield from self._halved_levels()

    def _parts(self, level: int) -> Iterator[Gaussians]:
        """Yield the gaussians of the chunks at a level up to `top`."""
        for number, source in enumerate(self._source[level].tolist()):
            clusters = self._clusters_of_level(source)[number]
            yield Gaussians.concatenate([self.bundle.cluster_gaussians(int(c)) for c in clusters])

    def _halved_levels(self) -> Iterator[list[Gaussians]]:
        """Yield the levels above `top`. Chunks without gaussians stay empty."""
        chunks = list(self._parts(self.top))
        used = [number for number, chunk in enumerate(chunks) if len(chunk)]
        clusters = self.bundle.clusters
        first = self.bundle.level_range(self.top).start
        drawn = LevelFilter(0.0, is_compensated=False)
        if self.top > 0:
            is_compensated = bool(clusters.antialiased[first])
            drawn = LevelFilter(float(clusters.filter_px2[first]), is_compensated)
        for level in halved_levels([chunks[number] for number in used], drawn):
            parts = [chunks[0].subset(slice(0, 0))] * len(chunks)
            for number, part in zip(used, level, strict=True):
                parts[number] = part
            yield parts

    def _clusters_of_level(self, level: int) -> list[NDArray[np.int64]]:
        """Return the indices of the clusters of a level of the bundle, by chunk."""
        if level not in self._clusters:
            self._clusters[level] = self.by_chunk(np.array(self.bundle.level_range(level)))
        return self._clusters[level]

    def by_chunk(self, clusters: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return the indices of clusters, grouped by chunk."""
        chunks = _common.rows_by(self.chunk_of_cluster[clusters], self.num_chunks)
        return [clusters[rows] for rows in chunks]

    def tree(self, leaves: list[_Leaf], turn: Floats) -> _TreeNode:
        """Return the spatial index: a tree of the groups above the chunks, with
        axis-aligned bounding boxes."""
        parent = self.bundle.groups.parent
        nodes = self._leaf_nodes(leaves, turn)
        node_of_group = {
            group: nodes[chunk]
            for group, chunk in enumerate(self.chunk_of_group.tolist())
            if chunk in nodes
        }
        if not node_of_group:
            node_of_group = {-1: nodes[0]}
        while node_of_group.keys() != {-1}:
            children: dict[int, list[_TreeNode]] = {}
            for group, node in node_of_group.items():
                children.setdefault(int(parent[group]), []).append(node)
            node_of_group = {group: _joined(siblings) for group, siblings in children.items()}
        return node_of_group[-1]

    def _leaf_nodes(self, leaves: list[_Leaf], turn: Floats) -> dict[int, _TreeNode]:
        """Return the leaves of all chunks that have gaussians, with their bounds, by
        the index of the chunk."""
        clusters = self.bundle.clusters
        used = np.flatnonzero((self.chunk_of_cluster >= 0) & (np.diff(clusters.offset) > 0))
        corners = clusters.box.astype(np.float64) @ rotation_from_quaternion(turn).T
        nodes: dict[int, _TreeNode] = {}
        for number, ids in enumerate(self.by_chunk(used)):
            if len(ids):
                bound = _bound(corners[ids].reshape(-1, 3))
                leaf = leaves[number]
                nodes[number] = {"bound": bound, "lods": leaf["lods"], "errors": leaf["errors"]}
        return nodes


def _joined(nodes: list[_TreeNode]) -> _TreeNode:
    """Return a node that bounds several nodes, or the node itself if there is only
    one."""
    if len(nodes) == 1:
        return nodes[0]
    corners: list[list[float]] = []
    for node in nodes:
        corners += [node["bound"]["min"], node["bound"]["max"]]
    return {"bound": _bound(corners), "children": nodes}


def _bound(points: ArrayLike) -> _Bound:
    """Return the minimum and the maximum coordinates of points."""
    return {"min": np.min(points, axis=0).tolist(), "max": np.max(points, axis=0).tolist()}
