"""Every number from a user is either used, or rejected with one line that names it,
without a cast, a crash or a warning."""

import inspect
import math
import re
import tempfile

import numpy as np
import pytest

import scenes
import v3dg
from random_bundle import random_bundle
from v3dg import _core
from v3dg.levels.fit import fit_config
from v3dg.levels.memory import in_bytes

CAMERA = v3dg.Camera.look_at((0.5, -9, 4), (3, 4, 5), width=24, height=16)
BUNDLE = random_bundle(1)
ASSET = scenes.gaussians([[0, 0, 2.0]])
EYE4, EYE3 = np.eye(4), np.diag([20.0, 20.0, 1.0])


def scene_of_two():
    scene = v3dg.Scene()
    scene.add(BUNDLE, positions=np.zeros((2, 3)))
    return scene


def options(**more):
    return {"tolerance": 1.0, "budget": 10**6, "min_level": 0, **more}


def selection():
    return v3dg.select(scene_of_two(), CAMERA, device="cpu")


def exported(write, **given):
    with tempfile.TemporaryDirectory() as folder:
        write(BUNDLE, folder, **given)


# Each function with valid arguments. Numbers and arrays of numbers are replaced by
# wrong ones.
def drawn_small(camera):
    """Return a picture for panoramas of any width, without drawing."""
    shape = (min(camera.height, 64), min(camera.width, 64))
    return v3dg.Image(np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32), None)


CALLS = {
    "refine_bundle": (
        lambda **numbers: v3dg.refine_bundle(BUNDLE, device="cpu", progress=False, **numbers),
        {"steps": 1, "seed": 0},
    ),
    "Camera": (v3dg.Camera, {"viewmat": EYE4, "K": EYE3, "width": 8, "height": 8, "near": 0.01}),
    "Camera.look_at": (
        v3dg.Camera.look_at,
        {
            "eye": (0, -5, 1),
            "target": (0, 0, 0),
            "up": (0, 0, 1),
            "fov_x": 0.9,
            "width": 8,
            "height": 8,
            "near": 1,
        },
    ),
    "Camera.from_blender": (
        v3dg.Camera.from_blender,
        {"transform_matrix": EYE4, "fov_x": 0.9, "width": 8, "height": 8, "fov_y": 0.9, "near": 1},
    ),
    "Camera.scaled": (CAMERA.scaled, {"factor": 2}),
    "turntable": (
        v3dg.turntable,
        {
            **{"center": (0, 0, 0), "radius": 2.0, "n": 2, "elevation": 0.1, "up": (0, 0, 1)},
            **{"fov_x": 0.9, "width": 8, "height": 8, "near": 0.1},
        },
    ),
    "first_camera": (
        lambda **given: v3dg.first_camera(BUNDLE, **given),
        {"width": 8, "height": 6, "up": (0, 0, 1)},
    ),
    "draw_panorama": (
        lambda **given: v3dg.draw_panorama(drawn_small, CAMERA, **given),
        {"up": (0.1, 0.9, 0.3), "width": 8},
    ),
    "EquirectangularCamera": (
        v3dg.EquirectangularCamera,
        {"viewmat": EYE4, "width": 8, "near": 0.01},
    ),
    "Lidar": (
        v3dg.Lidar,
        {
            **{"azimuth": (0, 1), "elevation": (0, 0.2), "near": 0.1, "far": 9.0, "gap": 0.5},
            **{"detection": 0.1, "spacing": 0.01},
        },
    ),
    "scan": (
        lambda **given: v3dg.scan(BUNDLE, v3dg.Lidar((0, 1), (0, 0.2)), **given),
        {"pose": EYE4, "tolerance": 1.0, "min_level": 0},
    ),
    "Scene.add": (
        lambda **given: v3dg.Scene().add(BUNDLE, **given),
        {
            "positions": (1, 2, 3),
            "quaternions": (1, 0, 0, 0),
            "scales": 1.0,
            "importance": 1.0,
            "opacity": 0.5,
            "tint": (0.5, 1, 1),
        },
    ),
    "Scene.add by a matrix": (
        lambda **given: v3dg.Scene().add(BUNDLE, **given),
        {"matrix": EYE4},
    ),
    "Scene.add_scene": (
        lambda **given: v3dg.Scene().add_scene(scene_of_two(), **given),
        {
            "position": (1, 2, 3),
            "quaternion": (1, 0, 0, 0),
            "scale": 1.0,
            "importance": 1.0,
            "opacity": 0.5,
            "tint": (0.5, 1, 1),
        },
    ),
    "Scene.move": (
        lambda **given: scene_of_two().move(**given),
        {"ids": [0], "positions": [(1, 2, 3)], "quaternions": (1, 0, 0, 0), "scales": 1.0},
    ),
    "Scene.set_opacity": (
        lambda **given: scene_of_two().set_opacity(**given),
        {"opacity": 0.5, "ids": [0]},
    ),
    "Scene.set_tint": (
        lambda **given: scene_of_two().set_tint(**given),
        {"tint": (0.5, 1, 1), "ids": [0]},
    ),
    "crop_box": (
        lambda **given: v3dg.crop_box(ASSET, **given),
        {"low": (-1, -1, -1), "high": (1, 1, 1)},
    ),
    "crop_sphere": (
        lambda **given: v3dg.crop_sphere(ASSET, **given),
        {"center": (0, 0, 0), "radius": 1.0},
    ),
    "drop_transparent": (
        lambda **given: v3dg.drop_transparent(ASSET, **given),
        {"min_opacity": 0.5},
    ),
    "to_degree": (lambda **given: v3dg.to_degree(ASSET, **given), {"degree": 1}),
    "Scene.remove": (lambda **given: scene_of_two().remove(**given), {"ids": [1]}),
    "Scene.set_importance": (
        lambda **given: scene_of_two().set_importance(**given),
        {"importance": 1.0, "ids": [0]},
    ),
    "select": (
        lambda **given: v3dg.select(BUNDLE, CAMERA, device="cpu", **given),
        options(fade=1.05),
    ),
    "render": (
        lambda **given: v3dg.render(BUNDLE, CAMERA, device="cpu", **given).stats,
        options(fade=1.05, background=(0, 0, 0), min_transmittance=0.001),
    ),
    "Renderer.render": (
        lambda **given: v3dg.Renderer(BUNDLE, device="cpu").render(CAMERA, **given).stats,
        options(fade=1.05, background=(0, 0, 0), min_transmittance=0.001),
    ),
    "Renderer.render_batch": (
        lambda **given: v3dg.Renderer(BUNDLE, device="cpu").render_batch([CAMERA], **given).stats,
        {
            "tolerance": 1.0,
            "min_level": 0,
            "fade": 1.05,
            "background": (0, 0, 0),
            "min_transmittance": 0.001,
        },
    ),
    "Camera.directions": (CAMERA.directions, {"positions": [[1, 2], [3, 4]]}),
    "Scene.set_environment": (
        lambda **given: v3dg.Scene.of(BUNDLE).set_environment(**given),
        {"environment": 2, "ids": [0]},
    ),
    "Scene.set_label": (
        lambda **given: v3dg.Scene.of(BUNDLE).set_label(**given),
        {"label": 2, "ids": [0]},
    ),
    "Renderer.settle": (
        lambda **given: v3dg.Renderer(BUNDLE, device="cpu", memory="64MB").settle(CAMERA, **given),
        options(fade=1.05, timeout=30.0),
    ),
    "render of an asset": (
        lambda **given: v3dg.render(ASSET, CAMERA, device="cpu", **given).stats,
        {"tolerance": 1.0, "background": (0, 0, 0)},
    ),
    "pick": (lambda **given: v3dg.pick(BUNDLE, CAMERA, **given), options(x=3, y=4)),
    "rasterize": (
        lambda **given: v3dg.rasterize(ASSET, CAMERA, **given),
        {"filter_px2": 0.3, "background": (0, 0, 0)},
    ),
    "Gaussians.transform": (
        lambda **given: ASSET.transform(**given),
        {"quaternion": (1, 0, 0, 0), "position": (1, 2, 3), "scale": 2.0},
    ),
    "write_site": (lambda **given: exported(v3dg.write_site, **given), {"chunk": 1 << 20}),
    "write_streamed_sog": (
        lambda **given: exported(v3dg.write_streamed_sog, **given),
        {"chunk": 1 << 20},
    ),
    "Selection.gaussians": (
        lambda **given: selection().gaussians(device="cpu", **given),
        {"origin": (0, 0, 0)},
    ),
}
VALUES = [
    *(2**31, 2**32, 2**63, 2**64, 2**128, 10**400, -(2**64), -(10**400)),
    *(1e39, 1e300, -1e300, 5e-324, math.inf, -math.inf, math.nan),
    *(
        1j,
        "many",
        b"\n",
        np.float64(1e300),
        np.array([1.0, 2.0]),
        np.ones((2, 2)) + 1j,
        None,
        object(),
    ),
]


def replaced(good, value):
    """Return the value itself, or an array that contains it."""
    if np.ndim(good) == 0:
        return value
    rows = np.array(good, object)
    rows.reshape(-1)[0] = value
    return rows.tolist()


@pytest.mark.parametrize(
    ("name", "argument"), [(name, a) for name, (_, given) in CALLS.items() for a in given]
)
def test_number_is_used_or_named(name, argument):
    call, arguments = CALLS[name]
    call(**arguments)
    for value in VALUES:
        given = {**arguments, argument: replaced(arguments[argument], value)}
        try:
            with np.errstate(all="warn", under="ignore"):
                call(**given)
        except (ValueError, IndexError) as error:
            text = str(error)
            problem = (
                None
                if re.search(rf"\b{argument}\b", text.split(": expected")[0])
                else "is not named"
            )
            problem = "has many lines" if "\n" in text else problem
        except Exception as error:
            problem, text = f"ends in {type(error).__name__}", str(error)
        else:
            continue
        if problem:
            raise AssertionError(f"{name}({argument}={given[argument]!r}) {problem}: {text}")


def test_text_is_no_number():
    with pytest.raises(
        ValueError, match="tolerance: expected a number of px² of at least 0, got '3'"
    ):
        v3dg.render(BUNDLE, CAMERA, tolerance="3")
    with pytest.raises(ValueError, match=r"budget: expected a whole number .*, got 1000\.0"):
        v3dg.render(BUNDLE, CAMERA, budget=1e3)


def test_every_public_function_with_numbers_is_tried():
    tried = {name.split(" ")[0] for name in CALLS}
    kinds = (v3dg.Camera, v3dg.Scene, v3dg.Selection, v3dg.Renderer)
    public = {name: getattr(v3dg, name) for name in v3dg.__all__}
    functions = {name: f for name, f in public.items() if inspect.isfunction(f)} | {
        f"{kind.__name__}.{name}": f
        for kind in kinds
        for name, f in inspect.getmembers(kind, callable)
        if not name.startswith("_")
    }
    number = re.compile(r"\b(int|float|VectorLike|MatrixLike|Any|ArrayLike|Sequence\[float\])\b")
    with_numbers = {
        name
        for name, f in functions.items()
        if any(
            number.search(str(p.annotation))
            and not re.search(r"PathLike|Mapping|Callable", str(p.annotation))
            for p in inspect.signature(f).parameters.values()
        )
    }
    others = {
        "build_bundle",
        "read_cameras",
        "Selection.check",
        "view",
    }  # a seed of any size; files have their own tests
    assert with_numbers - others - tried == set()


@pytest.mark.parametrize(
    "setting", [{"px2_per_gaussian": 1e20}, {"px2_per_gaussian": 1e300}, {"distance": 1e300}]
)
def test_views_that_no_picture_can_hold_are_refused(setting):
    (name,) = setting
    with pytest.raises(ValueError, match=f"^{name}: expected .* to .*, got "):
        v3dg.BuildConfig(**setting)


@pytest.mark.parametrize("setting", [{"px2_per_gaussian": 1e20}, {"distance": 1e300}])
def test_the_core_refuses_them_too(setting):
    """These settings were not checked before."""
    config = v3dg.BuildConfig(cluster_size=16, steps=1, num_views=2)
    for name, value in setting.items():
        object.__setattr__(config, name, value)
    asset = scenes.gaussians(np.random.default_rng(0).normal(size=(40, 3)))
    progress, arguments = _core.FitProgress(), np.array([[0, 40]])
    with pytest.raises(
        ValueError, match="px2_per_gaussian, distance, supersample: expected pictures of at most"
    ):
        _core.fit_level(
            fit_config(config, 0, 1),
            _core.FitTarget(asset.rows, 0.0, False),
            arguments,
            asset.rows,
            arguments,
            np.array([[0, 0, 0, 4]], np.float32),
            np.zeros(1, np.int64),
            progress,
        )


# ---- arguments of other kinds

ODD = (
    [64],
    (64,),
    {"a": 1},
    {64},
    b"64",
    np.array([64]),
    np.zeros(0),
    True,
    float("nan"),
    -1,
    0,
    10**5000,
    "x",
    object(),
)


@pytest.mark.parametrize("memory", ODD, ids=lambda value: f"{type(value).__name__}")
def test_memory_of_another_kind_is_refused_by_its_name(memory):
    bundle = random_bundle(1, num_levels=2)
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
    expected = r"^memory: expected a positive number of bytes, or text like '8GiB', got "
    with pytest.raises(ValueError, match=expected):
        v3dg.render(bundle, camera, memory=memory, device="cpu")
    with pytest.raises(ValueError, match=expected):
        v3dg.Renderer(bundle, memory=memory, device="cpu")
    with pytest.raises(ValueError, match=expected):
        in_bytes(memory)


@pytest.mark.parametrize("memory", ["64MiB", 1 << 26, float(1 << 26), np.int64(1 << 26)])
def test_memory_is_a_number_or_a_text(memory):
    assert in_bytes(memory) == 1 << 26


@pytest.mark.parametrize("color_by", [["level"], {}, np.array("level"), None, 3])
def test_a_colour_of_another_kind_is_refused_by_its_name(color_by):
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
    with pytest.raises(ValueError, match=r"^color_by: expected 'appearance' or "):
        v3dg.render(random_bundle(1, num_levels=2), camera, color_by=color_by, device="cpu")


def test_values_of_another_kind_are_refused_by_their_names(tmp_path):
    bundle = random_bundle(1, num_levels=2)
    asset = bundle.gaussians
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
    file = tmp_path / "a.json"
    calls = {
        "config": lambda odd: v3dg.build_bundle(asset, config=odd, device="cpu", progress=False),
        "seed": lambda odd: v3dg.build_bundle(asset, seed=odd, device="cpu", progress=False),
        "level": bundle.level_range,
        "cluster": bundle.cluster_gaussians,
        "cut": lambda odd: v3dg.render(bundle, camera, cut=odd, device="cpu"),
        "renderer": lambda odd: v3dg.pick(bundle, camera, 1, 1, renderer=odd),
        "scene": lambda odd: v3dg.write_scene(file, odd, []),
        "bundles": lambda odd: v3dg.read_scene(file, bundles=odd),
        "parts": lambda odd: v3dg.Gaussians.concatenate(odd),
        "camera": lambda odd: v3dg.render(bundle, odd, device="cpu"),
    }
    for name, call in calls.items():
        for odd in (1.5, np.float32(2), object()):
            with pytest.raises(TypeError, match=f"^{name}: expected "):
                call(odd)
    with pytest.raises(TypeError, match=r"^camera: expected "):
        v3dg.render(bundle, np.array(2), device="cpu")


def test_a_renderer_of_another_subject_cannot_pick():
    small, large = random_bundle(1, num_levels=2), random_bundle(2, num_levels=3)
    several = v3dg.Scene()
    several.add(small, positions=np.zeros((3, 3)))
    camera = v3dg.Camera.look_at((0, -9, 0), (0, 0, 0), width=8, height=6)
    for subject, drawn in ((small, large), (large, small), (small, several), (several, small)):
        renderer = v3dg.Renderer(drawn, memory="64MiB", device="cpu")
        with pytest.raises(
            ValueError,
            match=r"^renderer: expected a renderer of this subject, got one of another subject; ",
        ):
            v3dg.pick(subject, camera, 4, 3, renderer=renderer)
        v3dg.pick(drawn, camera, 4, 3, renderer=renderer)
        v3dg.pick(v3dg.Scene.of(drawn), camera, 4, 3, renderer=renderer)
