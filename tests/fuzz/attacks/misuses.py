"""Calls the public functions with wrong, unusual or extreme arguments, and writes to
arrays that they return.

A call has to return a result, or raise a ValueError, TypeError, RuntimeError or OSError
with one line that names the faulty argument. If the message is Python's own about a
value of another type, the finding is only "low".
"""

import inspect
import os
import re
import warnings

import numpy as np
import torch

import v3dg
from fuzz.attacks.memory_use import limit_growth
from fuzz.attacks.pool import Outcome
from random_bundle import random_bundle, random_gaussians

LIMIT_S = 30
ERRORS = {
    "ValueError",
    "TypeError",
    "RuntimeError",
    "IndexError",
    "ImportError",
    "MemoryError",
    "OSError",
}
ERRORS |= {"FileNotFoundError", "IsADirectoryError", "NotADirectoryError", "PermissionError"}
# Messages of Python and NumPy for values of another kind. No better messages are
# promised for those.
PYTHONS = {"AttributeError", "UnicodeEncodeError", "UFuncTypeError"}
NOT_OURS = re.compile(
    "Unable to cast|incompatible function|incompatible constructor|std::|vector::|C\\+\\+"
)

NUMBERS = (
    0,
    1,
    2,
    3,
    -1,
    7,
    0.5,
    -0.0,
    1e-320,
    1e20,
    1e39,
    1e300,
    -1e300,
    float("nan"),
    float("inf"),
    float("-inf"),
)
NUMBERS += (
    1 << 16,
    16383,
    (1 << 31) - 1,
    1 << 31,
    1 << 32,
    1 << 63,
    1 << 64,
    10**400,
    -(1 << 31),
    -(10**400),
)
NUMBERS += (
    True,
    np.float32(2),
    np.int8(-3),
    np.uint64(2**63),
    np.float16(1),
    np.array(2),
    np.array([2]),
    torch.tensor(2.0),
)
OTHERS = (
    None,
    "",
    "a",
    "cpu",
    "cuda",
    "cuda:7",
    "meta",
    "\0",
    "a\nb",
    "\ud800",
    b"a",
    1j,
    [],
    (),
    {},
    set(),
    [[]],
    [1, 2, 3],
)
OTHERS += (
    [1, "2", None],
    {"a": 1},
    object(),
    object,
    len,
    lambda: 1,
    range(3),
    iter([1]),
    slice(2),
    ...,
)
OTHERS += (
    np.zeros(0),
    np.zeros((0, 3)),
    np.array("a"),
    np.array([None]),
    np.datetime64("2026-01-01"),
)


def prepare(shared):
    bundle = random_bundle(1, num_levels=3, sh_degree=1)
    bundle.write(shared / "a.v3dg")
    scene = v3dg.Scene.of(bundle)
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
    v3dg.write_scene(shared / "scene.json", scene, ["a.v3dg"], {"a": camera})
    v3dg.write_cameras(shared / "cameras.json", {"a": camera})
    v3dg.write_asset(shared / "a.ply", random_gaussians(np.random.default_rng(0), 30, 1))


class Attack:
    def __init__(self, shared):
        self._shared = shared
        torch.set_num_threads(1)
        limit_growth(3 << 30)

    def plan(self, rng, work):
        calls = _calls(self._shared, work)
        if rng.random() < 0.12:
            return self._writing(rng)
        name = rng.choice(list(calls))
        function, good = calls[name]
        wrong = _wrong_arguments(rng, good)
        arguments = {**good, **wrong}
        if rng.random() < 0.04 and name != "Bundle of tables":
            arguments.pop(rng.choice(list(arguments)), None)
        if rng.random() < 0.02:
            arguments["frobnicate"] = 1
        texts = {key: _text(value) for key, value in wrong.items()}
        (work / "call.txt").write_text(
            f"{name}: {texts}", encoding="utf-8", errors="backslashreplace"
        )

        def do():
            names = {*wrong, "frobnicate", *(set(good) - set(arguments))}
            return _outcome_of_call(function, arguments, names, f"with {texts}")

        return name, do

    def _writing(self, rng):
        """Returned arrays are read-only, or writing to them has no effect on the
        package."""
        bundle = v3dg.Bundle.open(self._shared / "a.v3dg")
        camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
        scene = v3dg.Scene.of(bundle)
        holders = {
            "clusters": bundle.clusters,
            "groups": bundle.groups,
            "gaussians": bundle.gaussians,
            "camera": camera,
            "scene": scene,
        }
        holders["selection"] = v3dg.select(scene, camera, tolerance=1.0, device="cpu")
        holder = rng.choice(list(holders))
        arrays = [
            n
            for n in dir(holders[holder])
            if not n.startswith("_") and isinstance(getattr(holders[holder], n), np.ndarray)
        ]
        field = rng.choice(arrays)
        value, share = rng.choice((0, 1, -1, 1 << 30, -(1 << 31), 1e38, float("nan"))), rng.random()

        def write():
            array = getattr(holders[holder], field)
            place = int(share * array.size)
            with np.errstate(all="ignore"):
                array.reshape(-1)[place : place + 3] = np.array(value).astype(array.dtype)
            for _ in range(2):
                v3dg.render(scene, camera, tolerance=1.0, device="cpu")
            v3dg.render(bundle, camera, budget=100, device="cpu")
            holders["selection"].gaussians(device="cpu")
            if holder == "selection":
                v3dg.render(scene, camera, cut=holders["selection"], device="cpu")

        def do():
            if not getattr(holders[holder], field).size:
                return Outcome("nothing to write to")
            told = f"with {value} written to {field}"
            return _outcome_of_call(write, {}, {"read-only", holder, field, "cut"}, told)

        return f"writing to {holder}.{field}", do


def _calls(shared, work):
    """Yield each public function with valid arguments, of which some are then
    changed."""
    rng = np.random.default_rng(0)
    asset, bundle = random_gaussians(rng, 30, 1), random_bundle(1, num_levels=3, sh_degree=1)
    scene = v3dg.Scene()
    poses = {
        "positions": rng.normal(size=(4, 3)),
        "quaternions": rng.normal(size=(4, 4)),
        "scales": np.ones(4),
    }
    scene.add(bundle, **poses)
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
    cut = v3dg.select(scene, camera, tolerance=1.0, device="cpu")
    arrays = {
        name: getattr(asset, name) for name in ("means", "quats", "scales", "opacities", "sh")
    }
    choice = {"tolerance": 1.0, "budget": 1000, "min_level": 0}
    drawing = {**choice, "fade": 1.05, "background": (0.0, 0.5, 1.0)}
    view = {"width": 8, "height": 6, "near": 0.01}
    looking = {"eye": (0, -9, 0), "target": (0, 0, 0), "up": (0, 0, 1), "fov_x": 0.8, **view}
    clusters = {f: getattr(bundle.clusters, f) for f in bundle.clusters.__dataclass_fields__}
    groups = {f: getattr(bundle.groups, f) for f in bundle.groups.__dataclass_fields__}
    fields = {f.name: f.default for f in v3dg.BuildConfig.__dataclass_fields__.values()}
    quick = {
        **fields,
        "steps": 1,
        "num_views": 2,
        "image_size": 8,
        "cluster_size": 8,
        "supersample": 1,
    }

    def built(**values):
        config = v3dg.BuildConfig(**values)
        if config.steps < 10:  # more steps would only take time
            v3dg.build_bundle(asset, config=config, device="cpu", progress=False)

    def rendered_from(**values):
        v3dg.render(scene, v3dg.Camera(**values), device="cpu")

    def looked_from(**values):
        v3dg.render(scene, v3dg.Camera.look_at(**values), device="cpu")

    def blended(**values):
        v3dg.rasterize(v3dg.Gaussians(**values), camera)

    def changed(name, draws=True):
        def change(**values):
            getattr(scene, name)(**values)
            if draws:
                v3dg.render(scene, camera, tolerance=1.0, device="cpu")

        return change

    def drawn_again(**values):
        renderer = v3dg.Renderer(scene, device="cpu")
        renderer.render(**values)

    def drawn_as_batch(**values):
        v3dg.Renderer(scene, device="cpu").render_batch(v3dg.CameraBatch(**values))

    def drawn_at_once(**values):
        v3dg.Renderer(scene, device="cpu").render_batch(**values)

    def drawn_all_around(**values):
        v3dg.render(scene, v3dg.EquirectangularCamera(**values), tolerance=50.0)

    def scanned_by(**values):
        v3dg.scan(scene, v3dg.Lidar(**values), np.eye(4), tolerance=50.0)

    lidar = v3dg.Lidar(np.linspace(0, 6, 9), np.linspace(-1, 1, 4))

    def drawn_among(**values):
        channels = ("depth", "normal", "label", "weight")
        mesh = v3dg.MeshLayer(**values)
        v3dg.render(scene, camera, mesh=mesh, channels=channels, device="cpu")
        v3dg.render(scene, [camera, camera], mesh=[mesh, mesh], device="cpu")
        stereo = v3dg.StereoCamera.of(camera, 0.1)
        v3dg.render(scene, stereo, mesh=[mesh, mesh], device="cpu")

    def drawn_into(**values):
        planes = v3dg.BatchPlanes(**values)
        v3dg.Renderer(scene, device="cpu").render_batch([camera, camera], out=planes)

    def tables(**values):
        kind = {"clusters": v3dg.Clusters, "groups": v3dg.Groups}
        mine = {
            name: kind[name](**{f: values[f"{name}.{f}"] for f in made})
            for name, made in (("clusters", clusters), ("groups", groups))
        }
        v3dg.render(
            v3dg.Bundle(**mine, gaussians=bundle.gaussians), camera, tolerance=1.0, device="cpu"
        )

    all_tables = {
        **{f"clusters.{f}": a for f, a in clusters.items()},
        **{f"groups.{f}": a for f, a in groups.items()},
    }
    camera_file, scene_file = shared / "cameras.json", shared / "scene.json"
    return {
        "BuildConfig": (built, quick),
        "build_bundle": (
            v3dg.build_bundle,
            {
                "asset": asset,
                "config": v3dg.BuildConfig(**quick),
                "seed": 0,
                "progress": False,
                "device": "cpu",
            },
        ),
        "Bundle": (
            v3dg.Bundle,
            {
                "clusters": bundle.clusters,
                "groups": bundle.groups,
                "gaussians": bundle.gaussians,
                "config": {"a": 1},
            },
        ),
        "Bundle of tables": (tables, all_tables),
        "Bundle.open": (v3dg.Bundle.open, {"path": shared / "a.v3dg"}),
        "Bundle.write": (bundle.write, {"path": work / "out.v3dg"}),
        "Bundle.level_gaussians": (bundle.level_gaussians, {"level": 0}),
        "Bundle.level_range": (bundle.level_range, {"level": 0}),
        "Bundle.cluster_gaussians": (
            bundle.cluster_gaussians,
            _first_named(bundle.cluster_gaussians, 0),
        ),
        "Camera": (rendered_from, {"viewmat": camera.viewmat, "K": camera.K, **view}),
        "Camera.look_at": (looked_from, looking),
        "Camera.from_blender": (
            v3dg.Camera.from_blender,
            {"transform_matrix": np.eye(4), "fov_x": 0.8, "fov_y": 0.7, **view},
        ),
        "Camera.scaled": (camera.scaled, {"factor": 2}),
        "turntable": (
            v3dg.turntable,
            {
                "center": (0, 0, 0),
                "radius": 9.0,
                "n": 3,
                "elevation": 0.3,
                "up": (0, 0, 1),
                "fov_x": 0.8,
                **view,
            },
        ),
        "EquirectangularCamera": (
            drawn_all_around,
            {"viewmat": np.eye(4), "width": 16, "near": 0.01},
        ),
        "Lidar": (
            scanned_by,
            {
                "azimuth": lidar.azimuth,
                "elevation": lidar.elevation,
                "near": 0.1,
                "far": 90.0,
                "gap": 0.5,
                "detection": 0.1,
                "spacing": 0.02,
            },
        ),
        "scan": (
            v3dg.scan,
            {
                "subject": scene,
                "lidar": lidar,
                "pose": np.stack([np.eye(4)] * 2),
                "tolerance": 50.0,
                "min_level": 0,
                "device": "cpu",
            },
        ),
        "CameraBatch": (
            drawn_as_batch,
            {
                "viewmats": np.stack([camera.viewmat] * 3),
                "K": np.stack([camera.K] * 3),
                "environments": np.array([-1, -1, -1]),
                **view,
            },
        ),
        "Renderer.render_batch": (
            drawn_at_once,
            {
                "cameras": [camera, camera],
                "tolerance": 1.0,
                "min_level": 0,
                "fade": 1.05,
                "background": (0.0, 0.5, 1.0),
                "depth": True,
                "channels": ("median_depth", "clipped"),
                "mesh": v3dg.MeshLayer(np.zeros((2, 6, 8, 3)), np.ones((2, 6, 8))),
                "out": v3dg.BatchPlanes(
                    np.zeros((2, 6, 8, 4), np.float32), None, np.zeros((2, 6, 8), np.float32)
                ),
            },
        ),
        "Scene.set_environment": (
            changed("set_environment"),
            {"environment": np.array([0, 3]), "ids": [0, 2]},
        ),
        "Scene.set_label": (changed("set_label"), {"label": np.array([0, 3]), "ids": [0, 2]}),
        "BatchPlanes": (
            drawn_into,
            {
                "color": np.zeros((2, 6, 8, 3), np.float32),
                "alpha": np.zeros((2, 6, 8), np.float32),
                "depth": np.zeros((2, 6, 8), np.float32),
                "median_depth": np.zeros((2, 6, 8), np.float32),
                "normal": np.zeros((2, 6, 8, 3), np.float32),
                "instance": np.zeros((2, 6, 8), np.int32),
                "label": np.zeros((2, 6, 8), np.int32),
                "weight": np.zeros((2, 6, 8), np.float32),
            },
        ),
        "MeshLayer": (
            drawn_among,
            {
                "color": np.full((6, 8, 3), 0.5),
                "depth": np.full((6, 8), 8.0),
                "coverage": np.full((6, 8), 0.5),
                "normal": np.full((6, 8, 3), 0.5),
                "instance": np.full((6, 8), 7),
                "label": np.full((6, 8), 3),
                "light": "linear",
            },
        ),
        "Clusters": (v3dg.Clusters, clusters),
        "Groups": (v3dg.Groups, groups),
        "Gaussians": (blended, arrays),
        "Gaussians.subset": (asset.subset, {"index": np.arange(3)}),
        "Gaussians.concatenate": (v3dg.Gaussians.concatenate, {"parts": [asset, asset]}),
        "Gaussians.torch": (asset.torch, _first_named(asset.torch, "cpu")),
        "pick": (v3dg.pick, {"subject": scene, "camera": camera, "x": 4, "y": 3, **choice}),
        "rasterize": (
            v3dg.rasterize,
            {
                "gaussians": asset,
                "camera": camera,
                "filter_px2": 0.1,
                "antialiased": False,
                "background": (0.0, 0.5, 1.0),
            },
        ),
        "render": (
            v3dg.render,
            {"subject": scene, "camera": camera, "color_by": "level", "device": "cpu", **drawing},
        ),
        "render an asset": (
            v3dg.render,
            {
                "subject": asset,
                "camera": camera,
                "background": (0.0, 0.0, 0.0),
                "channels": ("instance", "clipped"),
                "device": "cpu",
            },
        ),
        "render a cut": (
            v3dg.render,
            {"subject": scene, "camera": camera, "cut": cut, "device": "cpu"},
        ),
        "Renderer": (v3dg.Renderer, {"subject": scene, "color_by": "cluster", "device": "cpu"}),
        "Renderer.render": (drawn_again, {"camera": camera, **drawing}),
        "select": (
            v3dg.select,
            {
                "subject": scene,
                "camera": camera,
                **choice,
                "footprint": "paper",
                "cull": True,
                "device": "cpu",
            },
        ),
        "Selection.gaussians": (cut.gaussians, {"origin": (0.0, 0.0, 0.0), "device": "cpu"}),
        "Scene.of": (v3dg.Scene.of, {"subject": bundle}),
        "Scene.add": (changed("add"), {"bundle": bundle, **poses, "importance": np.ones(4)}),
        "Scene.move": (changed("move"), {"ids": [0, 1, 2, 3], **poses}),
        "Scene.move all": (changed("move"), dict(poses)),
        "Scene.remove": (changed("remove"), {"ids": [0, 2]}),
        "Scene.set_importance": (
            changed("set_importance"),
            {"importance": [1.0, 2.0], "ids": [0, 3]},
        ),
        "read_asset": (v3dg.read_asset, {"path": shared / "a.ply"}),
        "read_cameras": (
            v3dg.read_cameras,
            {
                "path": camera_file,
                "size": (8, 6),
                "distortion": "ignore",
                "applied_transform": "undo",
            },
        ),
        "read_scene": (v3dg.read_scene, {"path": scene_file, "bundles": {"a.v3dg": bundle}}),
        "write_asset": (
            v3dg.write_asset,
            {"path": work / "out.ply", "gaussians": asset, "encoding": "ascii"},
        ),
        "write_asset, packed": (v3dg.write_asset, {"path": work / "out.sog", "gaussians": asset}),
        "write_cameras": (
            v3dg.write_cameras,
            {"path": work / "out.json", "cameras": {"a": camera}},
        ),
        "write_scene": (
            v3dg.write_scene,
            {
                "path": work / "out.json",
                "scene": scene,
                "bundle_paths": ["a.v3dg"],
                "cameras": {"a": camera},
            },
        ),
    }


def _first_named(function, value):
    return {next(iter(inspect.signature(function).parameters)): value}


def _wrong_arguments(rng, good):
    return {
        name: _wrong(rng, good[name])
        for name in rng.sample(list(good), min(len(good), rng.choice((1, 1, 1, 2))))
    }


def _wrong(rng, value):
    action = rng.random()
    if action < 0.45:
        changed = _changed(rng, value)
        if changed is not None:
            return changed
    return rng.choice(NUMBERS) if action < 0.75 else rng.choice(OTHERS)


def _changed(rng, value):
    """Return a value that is nearly valid."""
    if isinstance(value, os.PathLike):
        name = os.fspath(value)
        return rng.choice(
            (
                name + "x",
                name + "/",
                name.encode(),
                os.path.dirname(name),
                name + "\0",
                "",
                "\ud800",
                name * 9,
                "/dev/null",
            )
        )
    if isinstance(value, dict):
        return rng.choice(
            (
                {},
                {**value, 3: None},
                dict.fromkeys(value),
                list(value.items()),
                {k + "\n": v for k, v in value.items()},
            )
        )
    if isinstance(value, list | tuple) and value and not isinstance(value[0], v3dg.Gaussians):
        place = rng.randrange(len(value))
        odd = rng.choice((*NUMBERS, *OTHERS))
        items = [*value[:place], odd, *value[place + 1 :]]
        return rng.choice(
            (
                items,
                items[:place],
                [*value, *value],
                [value],
                np.array(value),
                torch.tensor(value) if _is_numbers(value) else items,
            )
        )
    if not isinstance(value, np.ndarray):
        return None
    array = value.copy()
    if array.size and rng.random() < 0.5:
        extreme = rng.choice((0, -1, 1e-45, 3e38, 1 << 30, -(1 << 31), float("nan"), float("inf")))
        with np.errstate(all="ignore"):
            array.reshape(-1)[rng.randrange(array.size)] = np.array(extreme).astype(array.dtype)
        return array
    ways = (
        lambda: array[:-1],
        lambda: array[None],
        lambda: array[..., None],
        lambda: np.asfortranarray(array),
        lambda: np.repeat(array, 2, axis=0)[::2],
        lambda: array[::-1],
        lambda: array.astype(">f8"),
        lambda: array.astype(np.float16),
        lambda: array.astype(np.float64),
        lambda: array.astype(np.int8),
        lambda: array.astype(complex) * 1j,
        lambda: array.astype(object),
        lambda: array.astype(str),
        lambda: array.astype(bool),
        lambda: array.tolist(),
        lambda: array.byteswap().view(array.dtype.newbyteorder()),
        lambda: np.broadcast_to(array.reshape(-1)[:1], array.shape),
        lambda: _read_only(array),
        lambda: np.empty((1 << 40, *array.shape[1:]), np.uint8) if array.ndim > 1 else array[:0],
        lambda: np.lib.stride_tricks.as_strided(
            array, (1 << 40, *array.shape[1:]), (0, *array.strides[1:])
        ),
        lambda: torch.from_numpy(array),
        lambda: torch.from_numpy(array).double().requires_grad_(),
        lambda: torch.from_numpy(array).to("meta"),
        lambda: torch.from_numpy(array).to_sparse(),
        lambda: torch.from_numpy(np.ascontiguousarray(array.T)).T,
        lambda: torch.from_numpy(array).half(),
        lambda: torch.from_numpy(array).expand(2, *array.shape),
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return rng.choice(ways)()
    except (MemoryError, ValueError, RuntimeError, TypeError):
        return array[:0]


def _is_numbers(value):
    return all(isinstance(item, int | float) for item in value)


def _read_only(array):
    array.flags.writeable = False
    return array


def _text(value):
    if isinstance(value, np.ndarray):
        return f"array {value.dtype} {value.shape}"
    if isinstance(value, torch.Tensor):
        return f"tensor {value.dtype} {tuple(value.shape)} {value.layout}"
    if isinstance(value, int) and abs(value) > 1 << 70:
        return "a number of many digits"
    return repr(value)[:80]


def _outcome_of_call(function, arguments, wrong, told):
    """Return the outcome of a call. `told` is the description of its arguments."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            function(**arguments)
        except Exception as error:
            name, text = type(error).__name__, str(error)
            fault = f"{name}: {text[:150]!a}, {told}"[:500]
            # Arguments that are arrays may take several lines of a message.
            is_one_line = "\n" not in text.replace("a\nb", "") or ": expected " in text
            is_ours = name in ERRORS and not NOT_OURS.search(text) and is_one_line
            if not is_ours and name not in PYTHONS:
                return Outcome("fault", fault)
            is_told = name in ERRORS and (isinstance(error, MemoryError) or _names(text, wrong))
            return (
                Outcome(name)
                if is_told
                else Outcome(f"{name} that names nothing", fault, is_low=True)
            )
    return Outcome("result")


def _names(text, wrong):
    """Return whether a text identifies the argument, by its name or in the form of our
    messages."""
    return bool(re.match(r"[\w.\[\], ()'/-]+: ", text)) or any(
        re.sub(r".*\.", "", name) in text for name in wrong
    )
