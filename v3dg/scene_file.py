"""Scene files: JSON that says which bundles there are, where they stand and from where to look."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from v3dg.bundle import Bundle
from v3dg.cameras import DEFAULT_FOV_X, Camera
from v3dg.scene import Scene

FORMAT = "v3dg-scene"
VERSION = 1


def read_scene(
    path: str | os.PathLike[str], *, bundles: Mapping[str, Bundle] | None = None
) -> tuple[Scene, dict[str, Camera]]:
    """Read a scene and its cameras, in file order, from a JSON file (docs/scene.md).

    The layout files of the V3DG paper's published code are read too.

    Args:
        bundles: Bundles by the path that the file gives for them (for a published layout, the name of the
            asset); the others are opened, relative to the file's folder.

    Raises:
        ValueError: The file is not such a file; the message names the place in it.
        FileNotFoundError: The file, or a bundle that it names, does not exist.
    """
    path = Path(path)
    try:
        root = _Node(
            json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant), path.name, ""
        )
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path.name}: expected JSON, got a file that does not parse: {error}") from error
    known = dict(bundles or {})
    if isinstance(root.value, dict) and "asset" in root.value and "format" not in root.value:
        return _read_published(root, path.parent, known)
    return _read_scene(root, path.parent, known)


def write_scene(
    path: str | os.PathLike[str],
    scene: Scene,
    bundle_paths: list[str],
    cameras: Mapping[str, Camera] | None = None,
) -> None:
    """Write a scene and named cameras as JSON (docs/scene.md); reading it back gives the same numbers.

    Args:
        bundle_paths: One path for each of ``scene.bundles``, relative to the file's folder.
    """
    if len(bundle_paths) != len(scene.bundles):
        raise ValueError(f"bundle_paths: expected {len(scene.bundles)} paths, got {len(bundle_paths)}")
    names = [f"bundle_{b}" for b in range(len(bundle_paths))]
    document = {
        "format": FORMAT,
        "version": VERSION,
        "bundles": dict(zip(names, bundle_paths, strict=True)),
        "instances": [
            {
                "bundle": names[scene.instance_bundle[i]],
                "position": scene.positions[i].tolist(),
                "quaternion": scene.quaternions[i].tolist(),
                "scale": float(scene.scales[i]),
            }
            for i in range(len(scene))
        ],
        "cameras": [
            {
                "name": name,
                "width": camera.width,
                "height": camera.height,
                "near": camera.near,
                "viewmat": camera.viewmat.tolist(),
                "K": camera.K.tolist(),
            }
            for name, camera in (cameras or {}).items()
        ],
    }
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


class _Node:
    """A JSON value that knows where in the file it stands."""

    def __init__(self, value: Any, file: str, path: str) -> None:
        self.value, self.file, self.path = value, file, path

    def error(self, expected: str) -> ValueError:
        got = json.dumps(self.value)
        got = got if len(got) <= 60 else got[:57] + "..."
        return ValueError(f"{self.file}: {self.path or 'top level'}: expected {expected}, got {got}")

    def fields(self, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, _Node]:
        """An object's fields, none of them unknown."""
        if not isinstance(self.value, dict):
            raise self.error("an object")
        for key in required:
            if key not in self.value:
                place = self.path or "top level"
                raise ValueError(f"{self.file}: {place}: expected the field {key}, got an object without it")
        for key in self.value:
            if key not in required and key not in optional:
                allowed = ", ".join((*required, *optional))
                raise ValueError(
                    f"{self.file}: {self._at(key)}: expected one of {allowed}, got an unknown field"
                )
        return {key: _Node(value, self.file, self._at(key)) for key, value in self.value.items()}

    def _at(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key

    def items(self) -> list[_Node]:
        if not isinstance(self.value, list):
            raise self.error("an array")
        return [_Node(value, self.file, f"{self.path}[{i}]") for i, value in enumerate(self.value)]

    def text(self) -> str:
        if not isinstance(self.value, str) or not self.value:
            raise self.error("a string")
        return self.value

    def number(self) -> float:
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.error("a number")
        try:
            number = float(self.value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.error("a finite number")
        return number

    def positive(self) -> float:
        number = self.number()
        if number <= 0:
            raise self.error("a positive number")
        return number

    def size(self) -> int:
        if isinstance(self.value, bool) or not isinstance(self.value, int) or not 0 < self.value <= 1 << 20:
            raise self.error("a positive whole number")
        return self.value

    def vector(self, length: int) -> list[float]:
        if not isinstance(self.value, list) or len(self.value) != length:
            raise self.error(f"{length} numbers")
        return [item.number() for item in self.items()]

    def matrix(self, size: int) -> list[list[float]]:
        if not isinstance(self.value, list) or len(self.value) != size:
            raise self.error(f"{size} rows of {size} numbers")
        return [row.vector(size) for row in self.items()]


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")


def _read_scene(root: _Node, folder: Path, known: dict[str, Bundle]) -> tuple[Scene, dict[str, Camera]]:
    top = root.fields(("format", "version", "bundles", "instances"), ("cameras",))
    if top["format"].value != FORMAT:
        raise top["format"].error(f'"{FORMAT}"')
    if top["version"].value != VERSION:
        raise top["version"].error(f"{VERSION}, which is what this build reads")
    if not isinstance(top["bundles"].value, dict):
        raise top["bundles"].error("an object of paths by name")
    bundles = {}
    for name, path in top["bundles"].value.items():
        node = _Node(path, root.file, f"bundles.{name}")
        bundles[name] = _open_bundle(node, node.text(), folder, known)

    names, poses = [], []
    for instance in top["instances"].items():
        fields = instance.fields(("bundle", "position"), ("quaternion", "scale"))
        if fields["bundle"].text() not in bundles:
            raise fields["bundle"].error("a name from bundles")
        names.append(fields["bundle"].text())
        poses.append(_read_pose(fields))
    scene = Scene()
    _add_runs(scene, names, poses, bundles)

    cameras: dict[str, Camera] = {}
    if "cameras" in top:
        for node in top["cameras"].items():
            fields = node.fields(
                ("name", "width", "height"), ("near", "viewmat", "K", "eye", "target", "up", "fov_x")
            )
            name = fields["name"].text()
            if name in cameras:
                raise fields["name"].error("a name that no other camera has")
            cameras[name] = _read_camera(node, fields)
    return scene, cameras


def _read_pose(fields: dict[str, _Node]) -> tuple[list[float], list[float], float]:
    quaternion = fields["quaternion"].vector(4) if "quaternion" in fields else [1.0, 0.0, 0.0, 0.0]
    if not any(quaternion):
        raise fields["quaternion"].error("a quaternion that is not zero")
    scale = fields["scale"].positive() if "scale" in fields else 1.0
    return fields["position"].vector(3), quaternion, scale


def _add_runs(
    scene: Scene,
    names: list[str],
    poses: list[tuple[list[float], list[float], float]],
    bundles: dict[str, Bundle],
) -> None:
    """Adds neighbours of the same bundle together, so that instance ids are the places in the file."""
    first = 0
    for last in range(1, len(names) + 1):
        if last < len(names) and names[last] == names[first]:
            continue
        position, quaternion, scale = zip(*poses[first:last], strict=True)
        scene.add(bundles[names[first]], positions=position, quaternions=quaternion, scales=scale)
        first = last


def _read_camera(node: _Node, fields: dict[str, _Node]) -> Camera:
    width, height = fields["width"].size(), fields["height"].size()
    near = fields["near"].positive() if "near" in fields else 0.01
    has_matrices = "viewmat" in fields and "K" in fields
    has_points = "eye" in fields and "target" in fields
    if has_matrices == has_points or (has_matrices and ("up" in fields or "fov_x" in fields)):
        raise node.error("either viewmat and K, or eye and target (with up and fov_x)")
    try:
        if has_matrices:
            viewmat, K = np.array(fields["viewmat"].matrix(4)), np.array(fields["K"].matrix(3))
            return Camera(viewmat, K, width, height, near)
        return Camera.look_at(
            fields["eye"].vector(3),
            fields["target"].vector(3),
            fields["up"].vector(3) if "up" in fields else (0.0, 0.0, 1.0),
            fields["fov_x"].positive() if "fov_x" in fields else DEFAULT_FOV_X,
            width=width,
            height=height,
            near=near,
        )
    except ValueError as error:
        raise _placed(error, node) from error


def _read_published(root: _Node, folder: Path, known: dict[str, Bundle]) -> tuple[Scene, dict[str, Camera]]:
    top = root.fields(("asset", "instances", "cameras"), ("name", "convention"))
    asset = top["asset"].text()
    path = asset if asset in known else str(Path(asset).with_suffix(".v3dg"))
    bundle = _open_bundle(top["asset"], path, folder, known)
    poses = [
        _read_pose(node.fields(("position", "quaternion", "scale"))) for node in top["instances"].items()
    ]
    scene = Scene()
    _add_runs(scene, [asset] * len(poses), poses, {asset: bundle})
    cameras: dict[str, Camera] = {}
    for node in top["cameras"].items():
        fields = node.fields(("name", "width", "height", "fov_x", "transform_matrix"), ("fov_y",))
        name = fields["name"].text()
        if name in cameras:
            raise fields["name"].error("a name that no other camera has")
        try:
            cameras[name] = Camera.from_blender(
                np.array(fields["transform_matrix"].matrix(4)),
                fields["fov_x"].positive(),
                fields["width"].size(),
                fields["height"].size(),
                fields["fov_y"].positive() if "fov_y" in fields else None,
            )
        except ValueError as error:
            raise _placed(error, node) from error
    return scene, cameras


def _placed(error: ValueError, node: _Node) -> ValueError:
    """The error with its place in the file, unless it already names one."""
    text = str(error)
    return ValueError(text if text.startswith(f"{node.file}: ") else f"{node.file}: {node.path}.{text}")


def _open_bundle(node: _Node, path: str, folder: Path, known: dict[str, Bundle]) -> Bundle:
    if path in known:
        return known[path]
    place = folder / path
    if not place.is_file():
        raise FileNotFoundError(
            f"{node.file}: {node.path}: expected a bundle at {place}, found none; build it with `v3dg build`"
        )
    known[path] = Bundle.open(place)
    return known[path]
