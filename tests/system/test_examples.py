"""Runs the examples with small sizes.

Modules that they need in addition are optional.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import v3dg
from benchmarks.worlds.procedural import make_donut
from v3dg.camera_file import write_cameras
from v3dg.metrics import psnr
from v3dg.pictures import to_8bit, write_picture

EXAMPLES = Path(__file__).parents[2] / "examples"


def load_example(name):
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # dataclasses look up the module there
    specification.loader.exec_module(module)
    return module


@pytest.fixture
def film(tmp_path, device):
    """The decoded pictures of a tiny film of falling donuts."""
    av = pytest.importorskip("av")
    example = load_example("falling_donuts")
    path = tmp_path / "donuts.mp4"
    config = example.Config(
        path, donuts=6, gaussians=1000, icings=2, seconds=0.4, size=(96, 64), steps=0, device=device
    )
    example.main(config)
    assert list(path.parent.iterdir()) == [path], "nothing temporary stays"
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == example.FPS
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_donuts_are_seen_and_fall(film):
    assert film.shape == (12, 64, 96, 3)
    background = film[0, 0, 0].astype(int)
    rows = []
    for picture in film:
        seen = np.abs(picture.astype(int) - background).max(axis=-1) > 40
        assert seen.mean() > 0.01
        rows.append(np.argwhere(seen)[:, 0].mean())
    assert rows[-1] > rows[0] + 3, "further down in the picture"


def test_what_is_trained_looks_like_the_donut(tmp_path, device):
    example = load_example("train")
    path = tmp_path / "trained.ply"
    few = {"gaussians": 300, "pictures": 8, "size": (64, 48), "device": device}
    before = example.main(example.Config(path, steps=0, **few))
    assert example.main(example.Config(path, steps=40, **few)) > before + 6
    assert len(v3dg.read_asset(path)) == 300


@pytest.fixture(params=["model of COLMAP", "transforms.json"])
def capture(tmp_path, request):
    """A capture: pictures of a donut from all sides, with their cameras."""
    cameras = v3dg.turntable((0, 0, 0), 3.5, 10, elevation=0.6, width=64, height=48)
    named = {f"{number}.png": camera for number, camera in enumerate(cameras)}
    (tmp_path / "images").mkdir()
    donut = make_donut(5000)
    for name, camera in named.items():
        picture = v3dg.rasterize(donut, camera, filter_px2=0.3).color
        write_picture(tmp_path / "images" / name, to_8bit(picture))
    if request.param == "transforms.json":
        listed = {f"images/{name}": camera for name, camera in named.items()}
        v3dg.write_cameras(tmp_path / request.param, listed)
    else:
        pycolmap = pytest.importorskip("pycolmap")
        from test_camera_folders import write_model

        write_model(tmp_path / "sparse" / "0", named)
        model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
        for mean in donut.means[::25]:
            model.add_point3D(mean, pycolmap.Track(), np.array([180, 130, 90], np.uint8))
        model.write(str(tmp_path / "sparse" / "0"))
    return tmp_path


def test_what_is_trained_looks_like_photographs_that_were_held_out(capture, device):
    pytest.importorskip("gsplat")
    example = load_example("train_photographs")
    path = capture / "trained.ply"
    few = {"start": 500, "sh_degree": 1, "device": device}
    before = example.main(example.Config(capture, path, steps=0, **few))
    # The pictures are used in their original size, and smaller.
    assert example.main(example.Config(capture, path, steps=40, **few)) > before + 3
    assert example.main(example.Config(capture, path, steps=40, longest=32, **few)) > before + 3
    num_points = 200 if (capture / "sparse").is_dir() else 500
    assert len(v3dg.read_asset(path)) == num_points
    with Image.open(path.with_suffix(".jpg")) as sheet:
        assert sheet.width > 2 * 32


def test_photographs_of_another_size_than_their_cameras_are_refused(capture):
    pytest.importorskip("gsplat")
    example = load_example("train_photographs")
    write_picture(capture / "images" / "3.png", np.zeros((48, 32, 3), np.uint8))
    with pytest.raises(
        SystemExit, match=r"3\.png: expected 64 x 48 px, as its camera, got 32 x 48"
    ):
        example.main(example.Config(capture, capture / "trained.ply", device="cpu"))


def sheet(z, size):
    """Return gaussians side by side across the z axis that are opaque together."""
    x, y = np.meshgrid(np.linspace(-size, size, 12), np.linspace(-size, size, 12))
    count = x.size
    return v3dg.Gaussians(
        means=np.stack([x.ravel(), y.ravel(), np.full(count, z)], axis=1).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), size / 5, np.float32) * np.float32([1, 1, 0.01]),
        opacities=np.full(count, 0.99, np.float32),
        sh=np.ones((count, 1, 3), np.float32),
    )


@pytest.mark.parametrize("turns", [1, 2])
def test_what_no_camera_sees_is_dropped(tmp_path, turns):
    """A wall in front hides what is behind it. Another wall is behind the camera, and
    visible when the camera turns."""
    wall, hidden, behind = sheet(3, 6), sheet(9, 1), sheet(-3, 6)
    v3dg.write_asset(tmp_path / "scene.ply", v3dg.Gaussians.concatenate([hidden, wall, behind]))
    camera = v3dg.Camera.look_at(
        (0, 0, 0), (0, 0, 1), up=(0, -1, 0), fov_x=1.2, width=64, height=48
    )
    write_cameras(tmp_path / "cameras.json", {"eye": camera})
    example = load_example("drop_unseen")
    files = tmp_path / "scene.ply", tmp_path / "cameras.json", tmp_path / "seen.ply"
    share = example.main(example.Config(*files, turns=turns, width=128))
    seen = v3dg.read_asset(tmp_path / "seen.ply")
    assert len(seen) == round(share * 3 * len(wall))
    places = set(np.round(seen.means[:, 2]))
    assert places == ({3, -3} if turns == 2 else {3})
    whole = v3dg.read_asset(tmp_path / "scene.ply")
    np.testing.assert_array_equal(
        v3dg.rasterize(seen, camera).color, v3dg.rasterize(whole, camera).color
    )
    half = example.main(example.Config(*files, keep=0.5, turns=turns, width=128))
    assert half == pytest.approx(share / 2, abs=0.01)


def test_weights_are_those_of_the_picture(tmp_path):
    """The sum of all weights is the alpha of the picture."""
    example = load_example("drop_unseen")
    camera = v3dg.Camera.look_at(
        (0, 0, 0), (0, 0, 1), up=(0, -1, 0), fov_x=1.2, width=64, height=48
    )
    asset = sheet(3, 1)
    weights = example.weights_in(asset, camera, "cpu")
    assert weights.sum() == pytest.approx(v3dg.rasterize(asset, camera).alpha.sum(), rel=1e-5)


@pytest.fixture
def gsplat_example(tmp_path):
    """The example, and its settings for a field of small donuts."""
    example = load_example("with_gsplat")
    config = v3dg.BuildConfig(cluster_size=64, steps=0)
    v3dg.build_bundle(make_donut(2000), config=config, progress=False).write(
        tmp_path / "donut.v3dg"
    )
    return example, example.Config(
        tmp_path / "donut.v3dg", tmp_path / "picture.png", rows=4, size=(160, 120), tolerance=30
    )


def test_arguments_for_gsplat_describe_the_picture(gsplat_example):
    """The arguments are complete: our rasterizer, which interprets them like gsplat,
    draws the same picture."""
    example, config = gsplat_example
    scene, camera = example.make_scene(config)
    camera = v3dg.Camera(camera.viewmat, camera.K, camera.width, camera.height, near=0.02)
    selection = v3dg.select(scene, camera, tolerance=config.tolerance, device="cpu")
    assert selection.num_gaussians < example.num_gaussians(scene) / 4
    arguments = example.gsplat_arguments(selection, camera, "cpu")
    tensors = [value for value in arguments.values() if isinstance(value, torch.Tensor)]
    assert len(tensors) == 7
    assert all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in tensors)
    assert arguments["rasterize_mode"] == "antialiased"
    gaussians = v3dg.Gaussians(
        *(arguments[name] for name in ("means", "quats", "scales", "opacities", "colors"))
    )
    assert arguments["sh_degree"] == gaussians.sh_degree == 3
    drawn = v3dg.rasterize(
        gaussians,
        v3dg.Camera(
            arguments["viewmats"][0].double().numpy(),
            arguments["Ks"][0].double().numpy(),
            arguments["width"],
            arguments["height"],
            arguments["near_plane"],
        ),
        filter_px2=arguments["eps2d"],
        antialiased=True,
    )
    options = {"tolerance": config.tolerance, "min_transmittance": 0, "device": "cpu"}
    wanted = v3dg.render(scene, camera, **options)
    assert wanted.alpha.max() > 0.9
    # Coarser levels use the filter of the arguments. Other differences are rounding of
    # the translation, and pixels where gsplat stops blending while ours continues.
    go_on = wanted.alpha < 0.9999
    assert 0.5 < go_on.mean() < 1
    assert psnr(wanted.color[go_on][None], drawn.color.numpy()[go_on][None]) > 100


@pytest.mark.gpu
def test_gsplat_draws_what_v3dg_does(gsplat_example):
    pytest.importorskip("gsplat")
    example, config = gsplat_example
    assert example.main(config) > 50
    assert config.output.is_file()


def test_a_robot_stands_among_donuts(tmp_path):
    example = load_example("robot_among_splats")
    path = tmp_path / "robot.png"
    image = example.main(example.Config(path, gaussians=2000, size=(96, 64)))
    labels = {example.FLOOR_LABEL, example.ROBOT_LABEL, example.FOOD_LABEL, -1}
    assert set(np.unique(image.label)) == labels
    seen = {number for number in np.unique(image.instance) if 0 <= number < example.FIRST_PART}
    assert seen == {0, 1, 2, 3}, "every donut, also the one on the arm"
    assert np.median(image.alpha[image.label == example.ROBOT_LABEL]) == 1
    with Image.open(tmp_path / "robot_channels.png") as channels:
        assert channels.size == (192, 128)
