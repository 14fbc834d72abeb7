"""Exports scenes and bundles as 3D Tiles 1.1: each group of a bundle is a tile, refined
by replacement.

The content of a tile is the clusters that its group made. Its children are the groups
below or, for groups of level 1, the gaussians of the asset. An instance is a tile that
transforms the tileset of its bundle. Geometric errors are chosen so that a screen-space
error of 16 px, the usual limit of renderers, corresponds to v3dg's tolerance of 3 px².
"""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from v3dg._numbers import check
from v3dg._progress import Bar, Progress
from v3dg._version import __version__
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Floats
from v3dg.export import _common
from v3dg.export._folder import check_outside, replacing_export
from v3dg.formats import gltf
from v3dg.formats._packing import check_writable
from v3dg.formats._reading import AnyPath
from v3dg.gaussians import Gaussians
from v3dg.opening import File, opened
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.upright import up_of

TILESET = "tileset.json"
CESIUM = "cesium"
"""Folder beside the page for CesiumJS, which is not part of the export."""
TILES_NEED = "npm install cesium@1.145.0", f"cp -r node_modules/cesium/Build/Cesium {{}}/{CESIUM}"
"""Commands that put CesiumJS into a folder, in the version with which the page is
tested."""

_SCREEN_SPACE_ERROR = 16.0  # px; the default limit of CesiumJS
# Rotation from z up in tiles to y up in their glTF content.
_TO_Y_UP = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)
_CONTENT = "3DTILES_content_gltf"
_EXTENSIONS = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]


class _Volume(TypedDict):
    box: list[float]


class _Content(TypedDict):
    uri: str


class _OptionalFields(TypedDict, total=False):
    transform: list[float]
    content: _Content
    children: "list[_Tile]"


class _Tile(_OptionalFields):
    """A tile in a tileset."""

    boundingVolume: _Volume
    geometricError: float


@dataclass(frozen=True)
class Tiles:
    """A finished export as 3D Tiles.

    Attributes:
        bundles: Number of distinct bundles.
        instances: Number of instances.
        tiles: Number of tiles with gaussians, in all bundles together.
        bytes: Total size of the written files.
    """

    bundles: int
    instances: int
    tiles: int
    bytes: int


def write_tiles(
    subject: Scene | Bundle | File,
    folder: AnyPath,
    *,
    up: Axis | None = None,
    progress: Progress = False,
    overwrite: bool = False,
) -> Tiles:
    """Write a scene or a bundle as 3D Tiles. The files of an earlier export are
    replaced when all new files are complete.

    Tiles are `.glb` files with KHR_gaussian_splatting, compressed as SPZ. Importance,
    opacity and tint of instances are left out, the latter two with a warning. The
    origin of the world is the origin of the tiles, which is the Earth's centre; viewers
    can move it elsewhere.

    Args:
        subject: A scene or a bundle, or the path of its file.
        folder: The folder to write. It may be new, empty, or contain an earlier export.
            Missing parent folders are created. `v3dg-export.json` in it lists the
            written files, and only those are replaced or removed by a later export.
        up: The axis that points up in the world; None uses the axis of
            `v3dg.upright.up_of`.
        progress: See `v3dg.build_bundle`.
        overwrite: Whether to write to any folder and replace files with the same names
            there. All other files stay.

    Raises:
        ValueError: ``folder`` contains other files or an input; a file of the earlier
            export was changed; there is nothing to export; or SPZ cannot represent a
            value of a gaussian.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.

    Source: OGC, 3D Tiles 1.1; Khronos, KHR_gaussian_splatting and its compression by
    SPZ.
    """
    if isinstance(subject, str | os.PathLike):
        check_outside(Path(folder), [subject])
    content = opened(subject)
    scene = Scene.of(content)
    scene = _common.exported(scene, "3D Tiles")
    root = np.eye(4)
    root[:3, :3] = _common.rotation_to(up or up_of(content)[0], "z")
    check("scene", len(scene), "at least one instance to export, got none; add an instance")
    for bundle in scene.bundles:
        check("bundle", bundle.num_gaussians, "at least one gaussian to export, got none")
    names = _common.names_of(scene, reserved=[CESIUM])
    with replacing_export(Path(folder), scene, (TILESET, "index.html"), overwrite=overwrite) as new:
        trees = _write_bundles(scene, names, new.path, progress)
        world = _parent(_instances(scene, names, trees))
        world["transform"] = root.T.ravel().tolist()
        _write_tileset(new.path / TILESET, world, {"ball": _ball_of_leaves(scene, root)})
        _common.write_page(new.path, "tiles.html")
        num_bytes = _common.bytes_below(new.path)
        num_tiles = len(list(new.path.rglob("*.glb")))
    return Tiles(len(trees), len(scene), num_tiles, num_bytes)


def _write_bundles(scene: Scene, names: list[str], folder: Path, progress: Progress) -> list[_Tile]:
    """Write the tileset of each bundle to the folder with its name; return the root
    tiles."""
    trees: list[_Tile] = []
    with Bar(sum(bundle.num_gaussians for bundle in scene.bundles), "export", progress) as bar:
        for name, bundle in zip(names, scene.bundles, strict=True):
            (folder / name).mkdir()
            writer = _Writer(bundle, folder / name, bar.update)
            tree = _parent([writer.tile_of(group) for group in writer.tops])
            _write_tileset(folder / name / TILESET, tree)
            trees.append(tree)
    return trees


def _instances(scene: Scene, names: list[str], trees: list[_Tile]) -> list[_Tile]:
    """Return a tile for each instance, whose content is the tileset of the bundle."""
    return [
        {
            "transform": transform.T.ravel().tolist(),
            "boundingVolume": trees[bundle]["boundingVolume"],
            "geometricError": trees[bundle]["geometricError"],
            "content": {"uri": f"{names[bundle]}/{TILESET}"},
        }
        for bundle, transform in zip(
            scene.instance_bundle.tolist(), _transforms(scene), strict=True
        )
    ]


class _Writer:
    """Writes the content files of a bundle's tiles."""

    def __init__(self, bundle: Bundle, folder: Path, advance: Callable[[int], object]) -> None:
        self._bundle = bundle
        self._folder = folder
        self._advance = advance
        groups = bundle.groups
        clusters = bundle.clusters
        radius = groups.ball[:, 3].astype(np.float64)
        limit = _SCREEN_SPACE_ERROR / math.sqrt(DEFAULT_TOLERANCE)
        self._error = limit * radius * np.sqrt(math.pi * groups.weight.astype(np.float64))
        # For each group: the groups below it, the clusters that it made, and the
        # clusters that it replaces.
        self._children = _common.rows_by(groups.parent, len(groups))
        self._clusters = _common.rows_by(clusters.own_group, len(groups))
        self._replaced = _common.rows_by(clusters.parent_group, len(groups))
        self.tops = np.flatnonzero(groups.parent < 0).tolist() or [-1]

    def tile_of(self, group: int) -> _Tile:
        """Return the tile of a group with all tiles below it. -1 stands for all of a
        bundle without groups."""
        if group < 0:
            return self._tile("asset", np.arange(len(self._bundle.clusters)), 0.0, [])
        level = self._bundle.groups.level[group]
        children = [self.tile_of(child) for child in self._children[group].tolist()]
        if level == 1:
            children = [self._tile(f"0_{group}", self._replaced[group], 0.0, [])]
        return self._tile(
            f"{level}_{group}", self._clusters[group], float(self._error[group]), children
        )

    def _tile(
        self, name: str, clusters: NDArray[np.intp], error: float, children: list[_Tile]
    ) -> _Tile:
        boxes = self._bundle.clusters.box[clusters].astype(np.float64)
        bounds = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        volume = _box([bounds, *map(_bounds, children)])
        tile: _Tile = {"boundingVolume": volume, "geometricError": error}
        gaussians = Gaussians.concatenate(
            [self._bundle.cluster_gaussians(int(c)) for c in clusters]
        )
        self._advance(len(gaussians))
        if len(gaussians):
            content = gltf.encode(check_writable(gaussians).transform(_TO_Y_UP), compressed=True)
            (self._folder / f"{name}.glb").write_bytes(content)
            tile["content"] = {"uri": f"{name}.glb"}
        if children:
            tile["children"] = children
        return tile


def _parent(tiles: list[_Tile]) -> _Tile:
    """Return a tile without content that is always refined to several tiles, or the
    tile itself if there is only one."""
    if len(tiles) == 1 and "transform" not in tiles[0]:
        return tiles[0]
    volume = _box([_bounds(tile) for tile in tiles])
    size = float(np.linalg.norm(np.reshape(volume["box"][3:], (3, 3))))
    error = max(1e3 * size, *(tile["geometricError"] for tile in tiles))
    return {"boundingVolume": volume, "geometricError": error, "children": tiles}


def _box(bounds: list[Floats]) -> _Volume:
    """Return a bounding volume around boxes, each given by its minimum and maximum
    corner (2, 3)."""
    low = np.min([corners[0] for corners in bounds], axis=0)
    high = np.max([corners[1] for corners in bounds], axis=0)
    half = np.maximum((high - low) / 2, np.finfo(np.float32).tiny)
    return {"box": [*((low + high) / 2).tolist(), *np.diag(half).ravel().tolist()]}


def _bounds(tile: _Tile) -> Floats:
    """Return the minimum and the maximum corner of a tile's box after its transform."""
    matrix = np.reshape(tile.get("transform", np.eye(4).ravel()), (4, 4)).T
    return _moved(tile["boundingVolume"], matrix)


def _moved(volume: _Volume, matrix: Floats) -> Floats:
    """Return the minimum and the maximum corner of a volume after a transform."""
    box = np.array(volume["box"])
    centre = matrix[:3, :3] @ box[:3] + matrix[:3, 3]
    half = np.abs(matrix[:3, :3] @ box[3:].reshape(3, 3).T).sum(axis=1)
    return np.array([centre - half, centre + half])


def _transforms(scene: Scene) -> Floats:
    """Return the matrices (I, 4, 4) of the instances."""
    matrices = np.tile(np.eye(4), (len(scene), 1, 1))
    matrices[:, :3, :3] = scene.rotations * scene.scales[:, None, None]
    matrices[:, :3, 3] = scene.positions
    return matrices


def _ball_of_leaves(scene: Scene, root: Floats) -> list[float]:
    """Return the centre and the radius of a ball around the finest level of all
    instances. The page shows this ball first, because coarse gaussians, and therefore
    the tiles, extend far beyond it."""
    boxes: list[Floats] = []
    for bundle in scene.bundles:
        leaves = bundle.clusters.box[np.array(bundle.level_range(0))].astype(np.float64)
        boxes.append(np.array([leaves[:, 0].min(axis=0), leaves[:, 1].max(axis=0)]))
    bounds: list[Floats] = []
    for bundle, transform in zip(scene.instance_bundle.tolist(), _transforms(scene), strict=True):
        bounds.append(_moved(_box([boxes[bundle]]), root @ transform))
    low, high = _moved(_box(bounds), np.eye(4))
    return [*((low + high) / 2).tolist(), float(np.linalg.norm(high - low)) / 2]


def _write_tileset(
    path: Path, root: _Tile, extras: Mapping[str, list[float]] | None = None
) -> None:
    extensions = {"extensionsUsed": _EXTENSIONS, "extensionsRequired": _EXTENSIONS}
    document: dict[str, object] = {
        "asset": {"version": "1.1", "generator": f"v3dg {__version__}"},
        "extensionsUsed": [_CONTENT],
        "extensionsRequired": [_CONTENT],
        # The extensions of all tilesets, because CesiumJS reads only the list in the
        # first one.
        "extensions": {_CONTENT: extensions},
        "geometricError": root["geometricError"],
        "root": {"refine": "REPLACE", **root},
    }
    if extras is not None:
        document["extras"] = extras
    _common.write_document(path, document)
