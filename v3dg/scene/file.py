"""Reads and writes scene files: JSON with the bundles of a scene, the poses of its
instances, and cameras."""

import copy
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import numpy as np

from v3dg._json import Node, read_json, write_json
from v3dg._numbers import LEAST_FLOAT, MOST_FLOAT, check, check_type, refuse
from v3dg._urls import beside, is_url
from v3dg.bundle import Bundle
from v3dg.cameras import DEFAULT_FOV_X, LENS_MODELS, Axis, Camera, LensModel, check_cameras
from v3dg.io import SUFFIXES
from v3dg.rotations import normalised, product, similarity_of
from v3dg.scene import Scene
from v3dg.scene.columns import MOST_ENVIRONMENT, MOST_LABEL, SHARED, UNLABELLED
from v3dg.scene.scene import turn_of

FORMAT = "v3dg-scene"
VERSION = 1

_Subject = TypeVar("_Subject", Bundle, Scene)


# Limits for nested scenes. In a chain of files, each may place the next one many times.
_MOST_DEPTH = 16
_MOST_INSTANCES = 1 << 24


class _Instance(NamedTuple):
    """A bundle or a nested scene with its pose and factors, as for `Scene.add`.

    `node` is the place in the file, for messages. To save memory, it is None for
    bundles.
    """

    subject: Bundle | Scene
    position: list[float]
    quaternion: list[float]
    scale: float
    importance: float
    opacity: float
    tint: list[float]
    environment: int
    label: int
    node: Node | None


def is_scene(path: Path) -> bool:
    """Return whether a file has the name of a scene. This is any .json except
    `meta.json`, which belongs to an asset in SOG."""
    name = beside(path).name
    return name.endswith(".json") and not name.endswith(SUFFIXES)


def read_scene(
    path: str | os.PathLike[str], *, bundles: Mapping[str, Bundle] | None = None
) -> tuple[Scene, dict[str, Camera]]:
    """Read a scene and its cameras from a JSON file (docs/scene.md). The cameras are in
    the order of the file.

    The layout files of the published code of the V3DG paper can be read, too.

    Args:
        bundles: Bundles that are already open, by their path in the file (in a
            published layout, by the name of the asset). Paths of all other bundles are
            relative to the folder of the scene file.

    Raises:
        ValueError: The content is invalid; the message names the place in the file.
        FileNotFoundError: The file, or a bundle to which it refers, does not exist.
    """
    path = Path(path)
    if bundles is not None:
        check_type("bundles", bundles, Mapping, "a mapping from paths to bundles")
    return _Files().read(path, dict(bundles or {}))


class _Files:
    """The files of a scene and of its nested scenes. Each file is read once."""

    def __init__(self) -> None:
        self._scenes: dict[str, Scene] = {}
        self._bundles: dict[str, Bundle] = {}
        self._chain: list[str] = []

    def read(self, path: Path, opened: dict[str, Bundle]) -> tuple[Scene, dict[str, Camera]]:
        """Return a scene and its cameras. Bundles in `opened` are not opened again."""
        root = read_json(path)
        self._chain.append(os.path.realpath(path))
        if root.has("layouts"):
            result = _read_layouts(root, path.parent, opened)
        elif root.has("asset") and not root.has("format"):
            result = _read_flat_layout(root, path.parent, opened)
        else:
            result = _read_scene(root, path.parent, opened, self)
        self._chain.pop()
        return result

    def nested(self, node: Node, folder: Path) -> Scene:
        """Return the nested scene in a file to which another file refers."""
        path = folder / node.text()
        real_path = os.path.realpath(path)
        if real_path in self._chain:
            names = [*map(os.path.basename, self._chain), path.name]
            raise node.located_error(
                f"expected scenes that do not contain themselves, got {' > '.join(names)}"
            )
        if len(self._chain) >= _MOST_DEPTH:
            raise node.located_error(f"expected at most {_MOST_DEPTH} nested scenes, got more")
        if not path.is_file():
            raise FileNotFoundError(
                str(node.located_error(f"expected a scene at {path}, got none"))
            )
        if not is_scene(path):
            raise node.error("the name of a scene's file, which ends in .json")
        if real_path not in self._scenes:
            self._scenes[real_path] = self.read(path, {})[0]
        return self._scenes[real_path]

    def open_bundles(
        self, nodes: Mapping[str, Node], folder: Path, opened: dict[str, Bundle]
    ) -> dict[str, Bundle]:
        """Return bundles by name. Those that are already open are not opened again."""
        real_paths = {
            node.text(): os.path.realpath(folder / node.text()) for node in nodes.values()
        }
        for text, real_path in real_paths.items():
            if real_path in self._bundles:
                opened.setdefault(text, self._bundles[real_path])
        _open_bundles(
            {node.text(): (node, [node.text()]) for node in nodes.values()}, folder, opened
        )
        for text, real_path in real_paths.items():
            self._bundles.setdefault(real_path, opened[text])
        return {name: opened[node.text()] for name, node in nodes.items()}


def write_scene(
    path: str | os.PathLike[str],
    scene: Scene,
    bundle_paths: list[str] | None = None,
    cameras: Mapping[str, Camera] | None = None,
) -> None:
    """Write a scene and named cameras as JSON (docs/scene.md). `read_scene` returns the
    same numbers.

    Args:
        bundle_paths: A path for each of ``scene.bundles``, relative to the folder of
            the new file. None uses the files from which they were opened.

    Raises:
        ValueError: The number of paths is wrong; a bundle was not opened from a file
            and has no path; or the file name is not that of a scene.
    """
    check(
        path,
        is_scene(Path(path)),
        "a file name ending in .json (but not meta.json), by which v3dg.open recognises scenes",
    )
    check_type("scene", scene, Scene, "a Scene")
    cameras = cameras or {}
    check_cameras(cameras)
    if bundle_paths is None:
        bundle_paths = _paths_of_bundles(scene, os.path.dirname(os.path.abspath(path)))
    if isinstance(bundle_paths, str) or not isinstance(bundle_paths, Sequence):
        raise TypeError(
            f"bundle_paths: expected a list of paths, got {type(bundle_paths).__name__}"
        )
    count = len(scene.bundles)
    check("bundle_paths", len(bundle_paths) == count, f"{count} paths, got {len(bundle_paths)}")
    scene = copy.copy(scene)  # other threads may change the original meanwhile
    names = [f"bundle_{number}" for number in range(count)]
    document: dict[str, object] = {"format": FORMAT, "version": VERSION}
    if scene.up is not None:
        document["up"] = scene.up
    document["bundles"] = dict(zip(names, bundle_paths, strict=True))
    document["instances"] = _instances_as_json(scene, names)
    document["cameras"] = [_camera_as_json(name, camera) for name, camera in cameras.items()]
    write_json(path, document)


def _camera_as_json(name: str, camera: Camera) -> dict[str, object]:
    lens: dict[str, object] = {}
    if camera.is_distorted:
        lens = {"model": camera.model, "distortion": list(camera.distortion)}
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        **lens,
    }


def _paths_of_bundles(scene: Scene, folder: str) -> list[str]:
    """Return the files from which the bundles were opened, relative to a folder. Raise
    ValueError for a bundle without a local file."""
    paths = []
    for number, bundle in enumerate(scene.bundles):
        if not bundle.path or is_url(bundle.path):
            problem = "got one in memory or at a URL; write it to a file and open that file"
            refuse(f"scene.bundles[{number}]", f"a bundle from a file, {problem}")
        paths.append(os.path.relpath(bundle.path, folder))
    return paths


def _instances_as_json(scene: Scene, names: list[str]) -> list[dict[str, object]]:
    """Return the instances of a scene as JSON values. `names` has the names of its
    bundles."""
    bundles = scene.instance_bundle.tolist()
    positions = scene.positions.tolist()
    quaternions = scene.quaternions.tolist()
    scales = scene.scales.tolist()
    instances: list[dict[str, object]] = [
        {"bundle": names[bundle], "position": position, "quaternion": quaternion, "scale": scale}
        for bundle, position, quaternion, scale in zip(
            bundles, positions, quaternions, scales, strict=True
        )
    ]
    for number in np.flatnonzero(scene.importance != 1).tolist():
        instances[number]["importance"] = scene.importance[number].item()
    for number in np.flatnonzero(scene.opacity != 1).tolist():
        instances[number]["opacity"] = scene.opacity[number].item()
    for number in np.flatnonzero((scene.tint != 1).any(axis=1)).tolist():
        instances[number]["tint"] = scene.tint[number].tolist()
    for number in np.flatnonzero(scene.environments != SHARED).tolist():
        instances[number]["environment"] = scene.environments[number].item()
    for number in np.flatnonzero(scene.labels != UNLABELLED).tolist():
        instances[number]["label"] = scene.labels[number].item()
    return instances


def _read_scene(
    root: Node, folder: Path, opened: dict[str, Bundle], files: _Files
) -> tuple[Scene, dict[str, Camera]]:
    required = ["format", "version", "instances"]
    if not root.has("scenes"):
        required.insert(2, "bundles")
    top = root.fields(tuple(required), ("cameras", "up", "bundles", "scenes"))
    if top["format"].value != FORMAT:
        raise top["format"].error(f'"{FORMAT}"')
    if top["version"].value != VERSION or isinstance(top["version"].value, bool):
        raise top["version"].error(f"version {VERSION}, the only one that can be read")
    scene = Scene()
    if "up" in top:
        up = top["up"].text()
        root.attempt(lambda: setattr(scene, "up", up))
    subjects = _subjects_of(top, folder, opened, files)
    _add_all(scene, (_instance_of(node, subjects, scene) for node in top["instances"].items()))
    cameras: dict[str, Camera] = {}
    if "cameras" in top:
        cameras = _read_cameras(top["cameras"])
    return scene, cameras


class _Subjects(NamedTuple):
    """The bundles and the nested scenes of a file, by name."""

    bundles: dict[str, Bundle]
    scenes: dict[str, Scene]


def _subjects_of(
    top: Mapping[str, Node], folder: Path, opened: dict[str, Bundle], files: _Files
) -> _Subjects:
    bundle_nodes: dict[str, Node] = {}
    scene_nodes: dict[str, Node] = {}
    if "bundles" in top:
        bundle_nodes = top["bundles"].some_fields(())
    if "scenes" in top:
        scene_nodes = top["scenes"].some_fields(())
    return _Subjects(
        bundles=files.open_bundles(bundle_nodes, folder, opened),
        scenes={name: files.nested(node, folder) for name, node in scene_nodes.items()},
    )


_POSE = ("position", "quaternion", "scale")
_FACTORS = ("importance", "opacity", "tint", "environment", "label")


def _instance_of(node: Node, subjects: _Subjects, scene: Scene) -> _Instance:
    """Return an instance in a scene file. If it has the field `up`, this sets the up
    axis of the scene."""
    fields = node.fields((), ("bundle", "scene", *_POSE, "matrix", "up", *_FACTORS))
    if ("bundle" in fields) == ("scene" in fields):
        raise node.error("exactly one of the fields bundle and scene")
    if "matrix" not in fields:
        node.field("position")
    elif any(name in fields for name in _POSE):
        raise node.located_error(
            "expected either matrix, or position, quaternion and scale, got both"
        )
    subject: Bundle | Scene
    if "bundle" in fields:
        subject = _named(fields["bundle"], subjects.bundles, "bundles")
    else:
        subject = _named(fields["scene"], subjects.scenes, "scenes")
    instance = _instance(node, subject, fields)
    if "up" not in fields:
        return instance
    up = fields["up"].text()
    turn = node.attempt(lambda: turn_of(subject, cast(Axis, up)))
    if scene.up not in (None, up):
        raise fields["up"].error(f"{scene.up}, the up axis of the other instances")
    scene.up = cast(Axis, up)
    quaternion = product(normalised(np.array(instance.quaternion)), turn)
    return instance._replace(quaternion=quaternion.tolist())


def _named(node: Node, subjects: Mapping[str, _Subject], kind: str) -> _Subject:
    name = node.text()
    if name not in subjects:
        raise node.error(f"a name in {kind}")
    return subjects[name]


def _add_all(scene: Scene, instances: Iterable[_Instance]) -> None:
    """Add instances to a scene, in the order of the file. Instances of bundles that
    follow each other in the file are added with one call."""
    for is_nested, run in itertools.groupby(instances, lambda i: isinstance(i.subject, Scene)):
        if not is_nested:
            _add_bundles(scene, list(run))
            continue
        for instance in run:
            inner = cast(Scene, instance.subject)
            assert instance.node is not None
            if len(scene) + len(inner) > _MOST_INSTANCES:
                expected = (
                    f"at most {_MOST_INSTANCES:,} instances, including those of nested scenes"
                )
                raise instance.node.located_error(f"expected {expected}, got more")
            scene.add_scene(
                inner,
                instance.position,
                instance.quaternion,
                instance.scale,
                instance.importance,
                opacity=instance.opacity,
                tint=instance.tint,
                environment=instance.environment,
                label=instance.label,
            )


def _add_bundles(scene: Scene, instances: Sequence[_Instance]) -> None:
    if not instances:
        return
    scene.add(
        [cast(Bundle, instance.subject) for instance in instances],
        [instance.position for instance in instances],
        [instance.quaternion for instance in instances],
        [instance.scale for instance in instances],
        [instance.importance for instance in instances],
        opacity=[instance.opacity for instance in instances],
        tint=[instance.tint for instance in instances],
        environment=[instance.environment for instance in instances],
        label=[instance.label for instance in instances],
    )


def _read_cameras(nodes: Node) -> dict[str, Camera]:
    cameras: dict[str, Camera] = {}
    for node in nodes.items():
        placed = ("eye", "target", "up", "fov_x")
        optional = ("near", "viewmat", "K", "distortion", "model", *placed)
        fields = node.fields(("name", "width", "height"), optional)
        name = fields["name"].text()
        if name in cameras:
            raise fields["name"].error("a name that no other camera has")
        cameras[name] = _read_camera(node, fields)
    return cameras


def _instance(node: Node, subject: Bundle | Scene, fields: Mapping[str, Node]) -> _Instance:
    position = [0.0, 0.0, 0.0]
    quaternion = [1.0, 0.0, 0.0, 0.0]
    scale = 1.0
    importance = 1.0
    opacity = 1.0
    tint = [1.0, 1.0, 1.0]
    if "matrix" in fields:
        position, quaternion, scale = _pose_of(fields["matrix"])
    if "position" in fields:
        position = fields["position"].vector(3)
    if "quaternion" in fields:
        quaternion = _quaternion(fields["quaternion"])
    if "scale" in fields:
        scale = fields["scale"].positive()
    if "importance" in fields:
        importance = _importance(fields["importance"])
    if "opacity" in fields:
        opacity = _opacity(fields["opacity"])
    if "tint" in fields:
        tint = _tint(fields["tint"])
    environment = _whole(fields, "environment", SHARED, MOST_ENVIRONMENT)
    label = _whole(fields, "label", UNLABELLED, MOST_LABEL)
    place: Node | None = None
    if isinstance(subject, Scene):
        place = node
    return _Instance(
        subject, position, quaternion, scale, importance, opacity, tint, environment, label, place
    )


def _pose_of(node: Node) -> tuple[list[float], list[float], float]:
    rows = node.matrix(4, 4)
    try:
        pose = similarity_of(rows)
    except ValueError as error:
        raise node.located_error(str(error).removeprefix("matrix: ")) from error
    return pose.positions[0].tolist(), pose.quaternions[0].tolist(), float(pose.scales[0])


def _opacity(node: Node) -> float:
    opacity = node.number()
    if not 0 <= opacity <= 1:
        raise node.error("a number from 0 to 1")
    return opacity


def _whole(fields: Mapping[str, Node], name: str, low: int, high: int) -> int:
    """Return an integer from `low`, which is the default, to `high`."""
    if name not in fields:
        return low
    node = fields[name]
    number = node.number()
    if number != int(number) or not low <= number <= high:
        raise node.error(f"a whole number from {low} to {high}")
    return int(number)


def _tint(node: Node) -> list[float]:
    tint = node.vector(3)
    if min(tint) < 0 or max(tint) > MOST_FLOAT:
        raise node.error("3 numbers of at least 0 that a float32 can hold")
    return tint


def _quaternion(node: Node) -> list[float]:
    quaternion = node.vector(4)
    if not any(quaternion):
        raise node.error("a nonzero quaternion")
    return quaternion


def _importance(node: Node) -> float:
    importance = node.positive()
    if not LEAST_FLOAT <= importance <= MOST_FLOAT:  # the scene stores it as float32
        raise node.error("a positive number that a float32 can hold")
    return importance


def _scene_of(instances: list[_Instance]) -> Scene:
    """Return a scene of these instances, in the order of the file."""
    scene = Scene()
    _add_all(scene, instances)
    return scene


def _read_lens(fields: dict[str, Node]) -> tuple[list[float], LensModel]:
    """Return the distortion and the model of a camera."""
    distortion: list[float] = []
    if "distortion" in fields:
        distortion = [value.number() for value in fields["distortion"].items()]
    if "model" not in fields:
        return distortion, "PINHOLE"
    name = fields["model"].text()
    for model in LENS_MODELS:
        if name == model:
            return distortion, model
    raise fields["model"].error(" or ".join(LENS_MODELS))


def _read_camera(node: Node, fields: dict[str, Node]) -> Camera:
    width = fields["width"].size()
    height = fields["height"].size()
    near = 0.01
    if "near" in fields:
        near = fields["near"].positive()
    has_matrices = "viewmat" in fields and "K" in fields
    has_points = "eye" in fields and "target" in fields
    if has_matrices == has_points or (has_matrices and ("up" in fields or "fov_x" in fields)):
        raise node.error("either viewmat and K, or eye and target (optionally with up and fov_x)")
    if has_points and ("distortion" in fields or "model" in fields):
        raise node.error("viewmat and K with a model and distortion")
    if has_matrices:
        viewmat = np.array(fields["viewmat"].matrix(4, 4))
        K = np.array(fields["K"].matrix(3, 3))
        distortion, model = _read_lens(fields)
        return node.attempt(lambda: Camera(viewmat, K, width, height, near, distortion, model))
    eye = fields["eye"].vector(3)
    target = fields["target"].vector(3)
    up = [0.0, 0.0, 1.0]
    if "up" in fields:
        up = fields["up"].vector(3)
    fov_x = DEFAULT_FOV_X
    if "fov_x" in fields:
        fov_x = fields["fov_x"].field_of_view()
    return node.attempt(
        lambda: Camera.look_at(eye, target, up, fov_x, width=width, height=height, near=near)
    )


def _read_layouts(
    root: Node, folder: Path, opened: dict[str, Bundle]
) -> tuple[Scene, dict[str, Camera]]:
    """Read a layout file of the paper's published code. Fields that only affect its own
    programs are ignored."""
    layouts = list(root.field("layouts").items())
    if len(layouts) != 1:
        advice = "each layout is a scene, so split the file"
        raise root.field("layouts").located_error(
            f"expected one layout, got {len(layouts)}; {advice}"
        )
    top = layouts[0].some_fields(("assets", "cameras"))
    instances_of_assets: list[tuple[str, Node]] = []
    candidates: dict[str, tuple[Node, list[str]]] = {}
    for node in top["assets"].items():
        fields = node.some_fields(("asset_kind", "asset_name", "ply_suffix", "instances"))
        kind = fields["asset_kind"].text()
        name = fields["asset_name"].text()
        suffix = fields["ply_suffix"].text()
        # The output of `v3dg build` in the folders of the published code.
        built = os.path.join(
            "..", "_3dgs-assets", kind, name, os.path.splitext(suffix)[0] + ".v3dg"
        )
        candidates.setdefault(name, (fields["asset_name"], [f"{name}.v3dg", built]))
        instances_of_assets.append((name, fields["instances"]))
    _open_bundles(candidates, folder, opened)
    instances = []
    for name, nodes in instances_of_assets:
        for instance in nodes.items():
            pose = instance.some_fields(("positions", "quaternions", "scale"))
            fields = {
                "position": pose["positions"],
                "quaternion": pose["quaternions"],
                "scale": pose["scale"],
            }
            instances.append(_instance(instance, opened[name], fields))
    keys = ("camera_name", "camera_width", "camera_height", "camera_angle_x", "camera_angle_y")
    return _scene_of(instances), _read_blender_cameras(top["cameras"].items(), keys)


def _read_flat_layout(
    root: Node, folder: Path, opened: dict[str, Bundle]
) -> tuple[Scene, dict[str, Camera]]:
    """Read a published layout of one asset, whose fields have shorter names."""
    top = root.fields(("asset", "instances", "cameras"), ("name", "convention"))
    asset = top["asset"].text()
    _open_bundles({asset: (top["asset"], [os.path.splitext(asset)[0] + ".v3dg"])}, folder, opened)
    required = ("position", "quaternion", "scale")
    instances = [
        _instance(node, opened[asset], node.fields(required)) for node in top["instances"].items()
    ]
    keys = ("name", "width", "height", "fov_x", "fov_y")
    return _scene_of(instances), _read_blender_cameras(top["cameras"].items(), keys)


def _read_blender_cameras(nodes: Iterable[Node], keys: tuple[str, ...]) -> dict[str, Camera]:
    """Return cameras in Blender's convention, by name. If a name occurs twice, the
    camera's number is put in front of all names."""
    names = []
    cameras = []
    for node in nodes:
        fields = node.some_fields((*keys, "transform_matrix"))
        name, width, height, fov_x, fov_y = (fields[key] for key in keys)
        names.append(name.text())
        make = partial(
            Camera.from_blender,
            fields["transform_matrix"].matrix(4, 4),
            fov_x.field_of_view(),
            width.size(),
            height.size(),
            fov_y.field_of_view(),
        )
        cameras.append(node.attempt(make))
    if len(set(names)) < len(names):
        names = [f"{i:03}_{name}" for i, name in enumerate(names)]
    return dict(zip(names, cameras, strict=True))


def _open_bundles(
    candidates: dict[str, tuple[Node, list[str]]], folder: Path, opened: dict[str, Bundle]
) -> None:
    """Add bundles to ``opened``. `candidates` has, for each key, possible paths
    relative to the folder. The first one that exists is opened."""
    files: dict[str, Path] = {}
    for key, (node, names) in candidates.items():
        if key in opened:
            continue
        paths = [folder / name for name in names]
        file = next((path for path in paths if path.is_file()), None)
        if file is None:
            tried = " or ".join(map(str, paths))
            problem = node.located_error(
                f"expected a bundle at {tried}, got no file; build it with `v3dg build`"
            )
            raise FileNotFoundError(str(problem))
        files[key] = file
    opened.update(zip(files, Bundle.open_all(files.values()), strict=True))
