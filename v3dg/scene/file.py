"""Scene files: JSON that says which bundles there are, where they stand and from where to look."""

import copy
import os
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from v3dg._json import Node, read_json, write_json
from v3dg._numbers import LEAST_FLOAT, MOST_FLOAT, check, check_type
from v3dg._urls import is_url
from v3dg.bundle import Bundle
from v3dg.cameras import DEFAULT_FOV_X, Camera, check_cameras
from v3dg.io import SUFFIXES
from v3dg.scene import Scene

FORMAT = "v3dg-scene"
VERSION = 1


# Bundle, position, quaternion, scale and importance, as `Scene.add` takes them.
_Instance: TypeAlias = tuple[Bundle, list[float], list[float], float, float]


def is_scene(path: Path) -> bool:
    """Whether a file is a scene by its name: JSON, but not the `meta.json` of an asset in SOG."""
    return path.suffix == ".json" and not path.name.endswith(SUFFIXES)


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
    if bundles is not None:
        check_type("bundles", bundles, Mapping, "bundles by their paths")
    root = read_json(path)
    known = dict(bundles or {})
    if root.has("layouts"):
        return _read_layouts(root, path.parent, known)
    if root.has("asset") and not root.has("format"):
        return _read_flat_layout(root, path.parent, known)
    return _read_scene(root, path.parent, known)


def write_scene(
    path: str | os.PathLike[str],
    scene: Scene,
    bundle_paths: list[str] | None = None,
    cameras: Mapping[str, Camera] | None = None,
) -> None:
    """Write a scene and named cameras as JSON (docs/scene.md); reading it back gives the same numbers.

    Args:
        bundle_paths: One path for each of ``scene.bundles``, relative to the file's folder; where they were
            opened from if None.

    Raises:
        ValueError: There is another number of paths, or a bundle has none: write it, and open that. Or the
            name is not of a scene.
    """
    check(path, is_scene(Path(path)), "a file name ending in .json, not meta.json; v3dg.open goes by it")
    check_type("scene", scene, Scene, "a Scene")
    check_cameras(cameras := cameras or {})
    if bundle_paths is None:
        found = "one in memory or at a URL; write it and open that"
        for number, bundle in enumerate(scene.bundles):
            is_here = bundle.path and not is_url(bundle.path)
            check(f"scene.bundles[{number}]", is_here, f"one that was opened from a file, got {found}")
        folder = os.path.dirname(os.path.abspath(path))
        bundle_paths = [os.path.relpath(bundle.path or "", folder) for bundle in scene.bundles]
    if isinstance(bundle_paths, str) or not isinstance(bundle_paths, Sequence):
        raise TypeError(f"bundle_paths: expected a list of paths, got {type(bundle_paths).__name__}")
    count, given = len(scene.bundles), len(bundle_paths)
    check("bundle_paths", given == count, f"{count} paths, got {given}")
    scene = copy.copy(scene)  # which stays as it is
    names = [f"bundle_{b}" for b in range(len(bundle_paths))]
    columns = {"position": scene.positions, "quaternion": scene.quaternions, "scale": scene.scales}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    instances = [
        {"bundle": names[bundle], **dict(zip(columns, row, strict=True))}
        for bundle, row in zip(scene.instance_bundle.tolist(), rows, strict=True)
    ]
    for number in np.flatnonzero(scene.importance != 1).tolist():
        instances[number]["importance"] = scene.importance[number].item()
    document = {
        "format": FORMAT,
        "version": VERSION,
        **({} if scene.up is None else {"up": scene.up}),
        "bundles": dict(zip(names, bundle_paths, strict=True)),
        "instances": instances,
        "cameras": [
            {"name": name, "width": camera.width, "height": camera.height, "near": camera.near}
            | {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
            for name, camera in cameras.items()
        ],
    }
    write_json(path, document)


def _read_scene(root: Node, folder: Path, known: dict[str, Bundle]) -> tuple[Scene, dict[str, Camera]]:
    top = root.fields(("format", "version", "bundles", "instances"), ("cameras", "up"))
    if top["format"].value != FORMAT:
        raise top["format"].error(f'"{FORMAT}"')
    if top["version"].value != VERSION or isinstance(top["version"].value, bool):
        raise top["version"].error(f"{VERSION}, which is what this build reads")
    nodes = top["bundles"].some_fields(())
    _open_bundles({node.text(): (node, [node.text()]) for node in nodes.values()}, folder, known)
    bundles = {name: known[node.text()] for name, node in nodes.items()}
    instances = []
    for node in top["instances"].items():
        fields = node.fields(("bundle", "position"), ("quaternion", "scale", "importance"))
        if fields["bundle"].text() not in bundles:
            raise fields["bundle"].error("a name from bundles")
        instances.append(_instance(bundles[fields["bundle"].text()], fields))
    cameras: dict[str, Camera] = {}
    for node in top["cameras"].items() if "cameras" in top else []:
        optional = ("near", "viewmat", "K", "eye", "target", "up", "fov_x")
        fields = node.fields(("name", "width", "height"), optional)
        name = fields["name"].text()
        if name in cameras:
            raise fields["name"].error("a name that no other camera has")
        cameras[name] = _read_camera(node, fields)
    scene = _scene_of(instances)
    if "up" in top:
        up = top["up"].text()
        root.attempt(lambda: setattr(scene, "up", up))
    return scene, cameras


def _instance(bundle: Bundle, fields: Mapping[str, Node]) -> _Instance:
    return (
        bundle,
        fields["position"].vector(3),
        _quaternion(fields["quaternion"]) if "quaternion" in fields else [1.0, 0.0, 0.0, 0.0],
        fields["scale"].positive() if "scale" in fields else 1.0,
        _importance(fields["importance"]) if "importance" in fields else 1.0,
    )


def _quaternion(node: Node) -> list[float]:
    quaternion = node.vector(4)
    if not any(quaternion):
        raise node.error("a quaternion that is not zero")
    return quaternion


def _importance(node: Node) -> float:
    importance = node.positive()
    if not LEAST_FLOAT <= importance <= MOST_FLOAT:  # in which scenes keep it
        raise node.error("a positive number that a float32 can hold")
    return importance


def _scene_of(instances: list[_Instance]) -> Scene:
    """Instance ids are the places in the file."""
    scene = Scene()
    if instances:
        scene.add(*zip(*instances, strict=True))
    return scene


def _read_camera(node: Node, fields: dict[str, Node]) -> Camera:
    width, height = fields["width"].size(), fields["height"].size()
    near = fields["near"].positive() if "near" in fields else 0.01
    has_matrices = "viewmat" in fields and "K" in fields
    has_points = "eye" in fields and "target" in fields
    if has_matrices == has_points or (has_matrices and ("up" in fields or "fov_x" in fields)):
        raise node.error("either viewmat and K, or eye and target (with up and fov_x)")
    if has_matrices:
        viewmat, K = np.array(fields["viewmat"].matrix(4, 4)), np.array(fields["K"].matrix(3, 3))
        return node.attempt(lambda: Camera(viewmat, K, width, height, near))
    eye, target = fields["eye"].vector(3), fields["target"].vector(3)
    up = fields["up"].vector(3) if "up" in fields else (0.0, 0.0, 1.0)
    fov_x = fields["fov_x"].field_of_view() if "fov_x" in fields else DEFAULT_FOV_X
    return node.attempt(lambda: Camera.look_at(eye, target, up, fov_x, width=width, height=height, near=near))


def _read_layouts(root: Node, folder: Path, known: dict[str, Bundle]) -> tuple[Scene, dict[str, Camera]]:
    """The layouts of the paper's published code; what only its authors' programs use is passed over."""
    layouts = list(root.field("layouts").items())
    if len(layouts) != 1:
        advice = "each layout is a scene, so make a file of each"
        raise root.field("layouts").problem(f"expected one layout, got {len(layouts)}; {advice}")
    top = layouts[0].some_fields(("assets", "cameras"))
    placed, wanted = [], dict[str, tuple[Node, list[str]]]()
    for node in top["assets"].items():
        fields = node.some_fields(("asset_kind", "asset_name", "ply_suffix", "instances"))
        kind, name, suffix = (fields[key].text() for key in ("asset_kind", "asset_name", "ply_suffix"))
        # Where `v3dg build` puts it, in a copy of the published code's folders.
        built = os.path.join("..", "_3dgs-assets", kind, name, os.path.splitext(suffix)[0] + ".v3dg")
        wanted.setdefault(name, (fields["asset_name"], [f"{name}.v3dg", built]))
        placed.append((name, fields["instances"]))
    _open_bundles(wanted, folder, known)
    instances = []
    for name, nodes in placed:
        for instance in nodes.items():
            required = "positions", "quaternions", "scale"
            pose = instance.some_fields(required)
            fields = {key.removesuffix("s"): pose[key] for key in required}
            instances.append(_instance(known[name], fields))
    keys = ("camera_name", "camera_width", "camera_height", "camera_angle_x", "camera_angle_y")
    return _scene_of(instances), _read_blender_cameras(top["cameras"].items(), keys)


def _read_flat_layout(root: Node, folder: Path, known: dict[str, Bundle]) -> tuple[Scene, dict[str, Camera]]:
    """A published layout of one asset with its names shortened."""
    top = root.fields(("asset", "instances", "cameras"), ("name", "convention"))
    asset = top["asset"].text()
    _open_bundles({asset: (top["asset"], [os.path.splitext(asset)[0] + ".v3dg"])}, folder, known)
    required = "position", "quaternion", "scale"
    instances = [_instance(known[asset], node.fields(required)) for node in top["instances"].items()]
    keys = ("name", "width", "height", "fov_x", "fov_y")
    return _scene_of(instances), _read_blender_cameras(top["cameras"].items(), keys)


def _read_blender_cameras(nodes: Iterable[Node], keys: tuple[str, ...]) -> dict[str, Camera]:
    """Cameras in Blender's convention, by name; where names repeat, the place in the file comes first."""
    names, cameras = [], []
    for node in nodes:
        fields = node.some_fields((*keys, "transform_matrix"))
        name, width, height, fov_x, fov_y = (fields[key] for key in keys)
        names.append(name.text())
        matrix, angle = fields["transform_matrix"].matrix(4, 4), fov_x.field_of_view()
        make = partial(Camera.from_blender, matrix, angle, width.size(), height.size(), fov_y.field_of_view())
        cameras.append(node.attempt(make))
    if len(set(names)) < len(names):
        names = [f"{i:03}_{name}" for i, name in enumerate(names)]
    return dict(zip(names, cameras, strict=True))


def _open_bundles(wanted: dict[str, tuple[Node, list[str]]], folder: Path, known: dict[str, Bundle]) -> None:
    """Make bundles known: each the one in the first of its places, relative to the folder, that there is."""
    found = {}
    for key, (node, places) in wanted.items():
        if key in known:
            continue
        found[key] = next((folder / place for place in places if (folder / place).is_file()), folder)
        if found[key] is folder:
            tried = " or ".join(str(folder / place) for place in places)
            problem = node.problem(f"expected a bundle at {tried}, found none; build it with `v3dg build`")
            raise FileNotFoundError(str(problem))
    known.update(zip(found, Bundle.open_all(found.values()), strict=True))
