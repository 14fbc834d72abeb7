"""Scenes and bundles as 3D Tiles 1.1: a group of a bundle is a tile, refined by replacement.

A tile's content is what its group makes; its children are the groups below and, at the bottom, the gaussians
of the asset. An instance is a tile that transforms the tileset of its bundle. Geometric errors are those at
which a renderer's screen-space error of 16 px, the usual limit, is v3dg's tolerance of 3 px².
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

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
from v3dg.formats._reading import Path as AnyPath
from v3dg.gaussians import Gaussians
from v3dg.opening import File, opened
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.upright import up_of

TILESET = "tileset.json"
CESIUM = "cesium"
"""Folder beside the page with CesiumJS, which is not part of the export."""
TILES_NEED = "npm install cesium@1.145.0", f"cp -r node_modules/cesium/Build/Cesium {{}}/{CESIUM}"
"""Commands that bring CesiumJS, in the version that the page is tested with, to a folder."""

_Tile: TypeAlias = dict[str, Any]
_SCREEN_SPACE_ERROR = 16.0  # px, CesiumJS's limit where none is given
# The content's y is up, the tiles' z.
_TO_Y_UP = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)
_CONTENT = "3DTILES_content_gltf"
_EXTENSIONS = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]


@dataclass(frozen=True)
class Tiles:
    """What was written.

    Attributes:
        bundles: Bundles, each of them once.
        instances: Instances of them.
        tiles: With gaussians, of all bundles.
        bytes: Of all files.
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
    """Write a scene or a bundle as 3D Tiles, replacing the files of an earlier export once all is written.

    Tiles are `.glb` files with KHR_gaussian_splatting, compressed as SPZ. The importance of instances is left
    out. The world's origin is at that of the tiles, the Earth's centre; viewers can put it elsewhere.

    Args:
        subject: Or the file of it.
        folder: Where to; new, empty, or with an earlier export. Folders above it are made. `v3dg-export.json`
            in it says what was written, and nothing else is replaced or removed.
        up: What is up in the world; as `v3dg.upright.up_of` takes it if None.
        progress: As in `v3dg.build_bundle`.
        overwrite: Write to any folder, and replace files of the same names there; all others stay.

    Raises:
        ValueError: There is something else at ``folder``, or a file that is read is in it; a file of the
            earlier export was changed; there is nothing to export; or a gaussian has values that SPZ cannot
            hold.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.

    Source: OGC, 3D Tiles 1.1; Khronos, KHR_gaussian_splatting and its compression by SPZ.
    """
    if isinstance(subject, str | os.PathLike):
        check_outside(Path(folder), [subject])
    found, root = opened(subject), np.eye(4)
    scene = Scene.of(found)
    root[:3, :3] = _common.rotation_to(up or up_of(found)[0], "z")
    check("scene", len(scene), "instances to export, got none")
    for bundle in scene.bundles:
        check("bundle", bundle.num_gaussians, "gaussians to export, got none")
    names, trees = _common.names_of(scene, taken=[CESIUM]), []
    with replacing_export(Path(folder), scene, (TILESET, "index.html"), overwrite=overwrite) as new:
        place = new.path
        with Bar(sum(bundle.num_gaussians for bundle in scene.bundles), "export", progress) as bar:
            for name, bundle in zip(names, scene.bundles, strict=True):
                (place / name).mkdir()
                writer = _Writer(bundle, place / name, bar.update)
                trees.append(_above([writer.tile_of(g) for g in writer.tops]))
                _write_tileset(place / name / TILESET, trees[-1])
        instances = [
            {
                "transform": transform.T.ravel().tolist(),
                "boundingVolume": trees[b]["boundingVolume"],
                "geometricError": trees[b]["geometricError"],
                "content": {"uri": f"{names[b]}/{TILESET}"},
            }
            for b, transform in zip(scene.instance_bundle.tolist(), _transforms(scene), strict=True)
        ]
        _write_tileset(place / TILESET, {"transform": root.T.ravel().tolist(), **_above(instances)})
        _common.write_page(place, "tiles.html")
        size, tiles = _common.bytes_below(place), sum(1 for _ in place.rglob("*.glb"))
    return Tiles(len(trees), len(scene), tiles, size)


class _Writer:
    """Writes the contents of a bundle's tiles."""

    def __init__(self, bundle: Bundle, folder: Path, advance: Callable[[int], Any]) -> None:
        self._bundle, self._folder, self._advance = bundle, folder, advance
        groups, clusters = bundle.groups, bundle.clusters
        ball, weight = groups.ball.astype(np.float64), groups.weight.astype(np.float64)
        limit = _SCREEN_SPACE_ERROR / math.sqrt(DEFAULT_TOLERANCE)
        self._error = limit * ball[:, 3] * np.sqrt(math.pi * weight)
        # Of each group: the groups below, the clusters that it made, and those that it replaces.
        columns = groups.parent, clusters.own_group, clusters.parent_group
        self._below, self._made, self._replaced = (_common.rows_by(links, len(groups)) for links in columns)
        self.tops = np.flatnonzero(groups.parent < 0).tolist() or [-1]

    def tile_of(self, g: int) -> _Tile:
        """The tile of a group with all below; of -1, that of a bundle without groups."""
        if g < 0:
            return self._tile("asset", np.arange(len(self._bundle.clusters)), 0.0, [])
        below = [self.tile_of(child) for child in self._below[g].tolist()]
        if self._bundle.groups.level[g] == 1:
            below = [self._tile(f"0_{g}", self._replaced[g], 0.0, [])]
        return self._tile(f"{self._bundle.groups.level[g]}_{g}", self._made[g], float(self._error[g]), below)

    def _tile(self, name: str, clusters: NDArray[Any], error: float, children: list[_Tile]) -> _Tile:
        boxes = self._bundle.clusters.box[clusters].astype(np.float64)
        bounds = [np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])]
        volume = _box(bounds + [_bounds(child) for child in children])
        tile: _Tile = {"boundingVolume": volume, "geometricError": error}
        gaussians = Gaussians.concatenate([self._bundle.cluster_gaussians(int(c)) for c in clusters])
        self._advance(len(gaussians))
        if len(gaussians):
            content = gltf.encode(check_writable(gaussians).transform(_TO_Y_UP), compressed=True)
            (self._folder / f"{name}.glb").write_bytes(content)
            tile["content"] = {"uri": f"{name}.glb"}
        return tile | ({"children": children} if children else {})


def _above(tiles: list[_Tile]) -> _Tile:
    """One tile, or a tile without content that is always refined to all of several."""
    if len(tiles) == 1 and "transform" not in tiles[0]:
        return tiles[0]
    volume = _box([_bounds(tile) for tile in tiles])
    size = float(np.linalg.norm(np.reshape(volume["box"][3:], (3, 3))))
    error = max(1e3 * size, *(tile["geometricError"] for tile in tiles))
    return {"boundingVolume": volume, "geometricError": error, "children": tiles}


def _box(bounds: list[Floats]) -> dict[str, list[float]]:
    """A bounding volume around boxes, each of a lower and an upper corner (2, 3)."""
    low, high = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    half = np.maximum((high - low) / 2, np.finfo(np.float32).tiny)
    return {"box": [*((low + high) / 2).tolist(), *np.diag(half).ravel().tolist()]}


def _bounds(tile: _Tile) -> Floats:
    """Lower and upper corner of a tile's box, after its transform."""
    box = np.array(tile["boundingVolume"]["box"])
    matrix = np.reshape(tile.get("transform", np.eye(4).ravel()), (4, 4)).T
    centre = matrix[:3, :3] @ box[:3] + matrix[:3, 3]
    half = np.abs(matrix[:3, :3] @ box[3:].reshape(3, 3).T).sum(axis=1)
    return np.array([centre - half, centre + half])


def _transforms(scene: Scene) -> Floats:
    """(I, 4, 4) matrices of the instances."""
    matrices = np.tile(np.eye(4), (len(scene), 1, 1))
    matrices[:, :3, :3] = scene.rotations * scene.scales[:, None, None]
    matrices[:, :3, 3] = scene.positions
    return matrices


def _write_tileset(path: Path, root: _Tile) -> None:
    extensions = {"extensionsUsed": _EXTENSIONS, "extensionsRequired": _EXTENSIONS}
    document = {
        "asset": {"version": "1.1", "generator": f"v3dg {__version__}"},
        "extensionsUsed": [_CONTENT],
        "extensionsRequired": [_CONTENT],
        "extensions": {_CONTENT: extensions},  # of tiles in other tilesets, too: CesiumJS looks at the first
        "geometricError": root["geometricError"],
        "root": {"refine": "REPLACE", **root},
    }
    _common.write_document(path, document)
