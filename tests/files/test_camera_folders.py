"""Cameras of COLMAP models, written by COLMAP's own library, and cameras of nerfstudio
runs."""

import json
import os
import struct

import numpy as np
import pytest

import v3dg
from command_line import fails
from command_line import run as run_command
from scenes_lod import random_camera
from v3dg import read_cameras
from v3dg.camera_file import CameraWarning

pycolmap = pytest.importorskip("pycolmap")


def write_model(folder, cameras, *, model="PINHOLE", extra=(), text=False):
    """Write a COLMAP model of images with the names of cameras."""
    reconstruction = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        params = [camera.fx, camera.fy, camera.cx, camera.cy, *extra]
        theirs = pycolmap.Camera(
            model=model, width=camera.width, height=camera.height, params=params, camera_id=number
        )
        reconstruction.add_camera_with_trivial_rig(theirs)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(camera.viewmat[:3])
        reconstruction.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(os.fspath(folder))


def assert_same(found, wanted, atol=1e-6):
    assert list(found) == list(wanted)
    for name, camera in wanted.items():
        np.testing.assert_allclose(found[name].viewmat, camera.viewmat, atol=atol)
        np.testing.assert_allclose(found[name].K, camera.K, rtol=1e-9)
        assert (found[name].width, found[name].height) == (camera.width, camera.height)


@pytest.fixture
def cameras():
    rng = np.random.default_rng(0)
    return {f"images/é{i}.jpg": random_camera(rng) for i in (3, 1, 2)}


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", [".", "sparse", "sparse/0", "0"])
def test_models_of_colmap_are_read(tmp_path, cameras, text, place):
    write_model(tmp_path / "scene" / place, cameras, text=text)
    assert_same(read_cameras(tmp_path / "scene"), cameras)
    for file in ("images", "cameras"):
        name = f"{file}.txt" if text else f"{file}.bin"
        assert_same(read_cameras(tmp_path / "scene" / place / name), cameras)


def test_distortion_is_read_or_left_out(tmp_path, cameras):
    write_model(tmp_path / "a", cameras, model="OPENCV", extra=(0.1, 0, 0, 0))
    assert {camera.model for camera in read_cameras(tmp_path / "a").values()} == {"OPENCV"}
    ignored = read_cameras(tmp_path / "a", distortion="ignore")
    assert_same(ignored, cameras)
    assert {camera.model for camera in ignored.values()} == {"PINHOLE"}
    write_model(tmp_path / "fish", cameras, model="OPENCV_FISHEYE", extra=(0, 0, 0, 0))
    with pytest.raises(ValueError, match="got OPENCV_FISHEYE; draw its distortion"):
        read_cameras(tmp_path / "fish", distortion="ignore")
    write_model(tmp_path / "none", cameras, model="OPENCV", extra=(0, 0, 0, 0))
    plain = read_cameras(tmp_path / "none")
    assert_same(plain, cameras)
    assert {camera.model for camera in plain.values()} == {"PINHOLE"}


def test_folders_without_cameras_are_refused(tmp_path, cameras):
    with pytest.raises(ValueError, match=r"expected a model of COLMAP .* a run of nerfstudio"):
        read_cameras(tmp_path)
    write_model(tmp_path / "a", cameras)
    path = tmp_path / "a" / "images.bin"
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(
        ValueError,
        match=r"images\.bin: expected at least [0-9]+ bytes for 3 entries, got a file of 40 bytes",
    ):
        read_cameras(tmp_path / "a")


def test_models_need_no_package(tmp_path, cameras, monkeypatch):
    write_model(tmp_path / "a", cameras)
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    assert_same(read_cameras(tmp_path / "a"), cameras)


NAMES = {
    "spaces": ["a b 1.jpg", "a b 2.jpg", " c.jpg"],
    "folders": ["left/1.jpg", "right/1.jpg", "1.jpg"],
    "other letters": ["größe.jpg", "写真.jpg", "é.jpg"],
}


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("kind", NAMES)
def test_no_name_makes_a_camera_vanish(tmp_path, kind, text):
    rng = np.random.default_rng(0)
    wanted = {name: random_camera(rng) for name in NAMES[kind]}
    write_model(tmp_path / "a", wanted, text=text)
    if text:  # the text format cannot store names that begin with spaces
        wanted = {name.lstrip(): camera for name, camera in wanted.items()}
    assert_same(read_cameras(tmp_path / "a"), wanted)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("name", ["same.jpg", ""])
def test_images_with_the_same_name_or_none_are_numbered(tmp_path, name, text):
    rng = np.random.default_rng(0)
    wanted = {"x1": random_camera(rng), "x2": random_camera(rng), "x3": random_camera(rng)}
    write_model(tmp_path / "a", wanted, text=text)
    path = tmp_path / "a" / ("images.txt" if text else "images.bin")
    content = path.read_bytes()
    for number in (1, 3):
        content = content.replace(f"x{number}".encode(), name.encode())
    path.write_bytes(content)
    assert_same(read_cameras(path), dict(zip("012", wanted.values(), strict=True)))


def test_texts_may_have_a_byte_order_mark_and_carriage_returns(tmp_path, cameras):
    write_model(tmp_path / "a", cameras, text=True)
    for name in ("images.txt", "cameras.txt"):
        path = tmp_path / "a" / name
        lines = path.read_bytes().splitlines()
        path.write_bytes(b"\xef\xbb\xbf" + b"\r\n".join(lines) + b"\r\n")
    assert_same(read_cameras(tmp_path / "a"), cameras)


def test_a_name_in_another_encoding_is_kept_by_its_bytes(tmp_path, cameras):
    write_model(tmp_path / "a", {"xx.jpg": next(iter(cameras.values()))})
    path = tmp_path / "a" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"xx.jpg", b"\xe9x.jpg"))
    assert list(read_cameras(tmp_path / "a")) == ["\\xe9x.jpg"]


@pytest.mark.parametrize("text", [False, True])
def test_rigs_place_their_cameras(tmp_path, text):
    """The model is from COLMAP 3.12: a rig of two cameras at two times."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    lenses = [
        pycolmap.Camera(
            model="PINHOLE", width=64, height=48, params=[50, 51, 32, 24], camera_id=number
        )
        for number in (1, 2)
    ]
    for lens in lenses:
        model.add_camera(lens)
    rig.add_ref_sensor(lenses[0].sensor_id)
    beside = [[1, 0, 0, 0.1], [0, 0, -1, 0.2], [0, 1, 0, 0.3]]
    rig.add_sensor(lenses[1].sensor_id, pycolmap.Rigid3d(np.array(beside)))
    model.add_rig(rig)
    for moment in (0, 1):
        frame = pycolmap.Frame(frame_id=moment + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(np.hstack([np.eye(3), [[moment], [2], [3]]]))
        numbers = (2 * moment + 1, 2 * moment + 2)
        for number, lens in zip(numbers, lenses, strict=True):
            frame.add_data_id(pycolmap.data_t(lens.sensor_id, number))
        model.add_frame(frame)
        for number, lens in zip(numbers, lenses, strict=True):
            image = pycolmap.Image(name=f"{number}", camera_id=lens.camera_id, image_id=number)
            image.frame_id = moment + 1
            model.add_image(image)
        model.register_frame(moment + 1)
    (tmp_path / "a").mkdir()
    (model.write_text if text else model.write_binary)(os.fspath(tmp_path / "a"))
    found = read_cameras(tmp_path / "a")
    assert list(found) == ["1", "2", "3", "4"]
    for image in model.images.values():
        wanted = image.cam_from_world().matrix()
        np.testing.assert_allclose(found[image.name].viewmat[:3], wanted, atol=1e-9)


OPENCV_MODELS = {
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
    "FISHEYE",
}


def assert_maps_as_colmap(camera, theirs):
    points = np.array([[0.1, 0.2, 1.0], [-0.4, 0.1, 1.3], [0.3, -0.5, 0.9], [0.0, 0.3, 2.0]])
    directions = camera.directions(theirs.img_from_cam(points))
    np.testing.assert_allclose(
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        points / np.linalg.norm(points, axis=1, keepdims=True),
        atol=1e-9,
    )


def test_all_models_of_colmap_are_known(tmp_path):
    """COLMAP's library provides the expected values: which models are pinholes, how
    many parameters they have, when they have no distortion, and where they project
    points."""
    for name, kind in pycolmap.CameraModelId.__members__.items():
        if name == "INVALID":
            continue
        theirs = pycolmap.Camera.create_from_model_name(1, name, 100, 640, 480)
        for shift in (0.0, 0.01):
            theirs.params = [
                value + shift * (label.strip() not in ("f", "fx", "fy", "cx", "cy", "w", "h"))
                for value, label in zip(theirs.params, theirs.params_info.split(","), strict=True)
            ]
            place = tmp_path / f"{name}{shift}"
            model = pycolmap.Reconstruction()
            model.add_camera_with_trivial_rig(theirs)
            image = pycolmap.Image(name="a", camera_id=1, image_id=1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
            place.mkdir()
            model.write_binary(os.fspath(place))
            is_pinhole = theirs.is_perspective_pinhole()
            # COLMAP considers every EUCM camera distorted, even if its parameters are
            # those of a pinhole.
            is_plain = theirs.is_undistorted() or (name == "EUCM" and not theirs.params[4])
            if is_pinhole:
                assert len(read_cameras(place, distortion="ignore")) == 1
            if (is_pinhole and is_plain) or name in OPENCV_MODELS:
                assert_maps_as_colmap(read_cameras(place)["a"], theirs)
                continue
            with pytest.raises(ValueError, match=f"one of OpenCV's models, got {name}; undis"):
                read_cameras(place)
        assert int(kind) < 18  # the number of known models


TEXTS = {
    "an image without its line of points": (
        "1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 b c d.jpg\n",
        "expected the points of an image, or an empty line, in line 2",
    ),
    "an image without a camera": (
        "1 1 0 0 0 0 0 0 7 a.jpg\n\n",
        "expected a camera of image 1 that cameras.txt contains, got camera 7",
    ),
    "an image twice": (
        "1 1 0 0 0 0 0 0 1 a.jpg\n\n1 1 0 0 0 0 0 0 1 b.jpg\n\n",
        "expected distinct image ids, got 1 twice",
    ),
    "too few numbers": ("1 1 0 0\n\n", "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME in"),
    "no rotation": ("1 0 0 0 0 0 0 0 1 a.jpg\n\n", "a.jpg: expected a camera, got viewmat: expe"),
    "no finite number": (
        "1 nan 0 0 0 0 0 0 1 a.jpg\n\n",
        "expected at least one image with finite numbers, got none: 1 of 1 images have",
    ),
    "no number": ("1 one 0 0 0 0 0 0 1 a.jpg\n\n", "expected IMAGE_ID QW QX QY QZ TX TY TZ CAM"),
}


@pytest.mark.parametrize("case", TEXTS)
def test_texts_that_lose_an_image_are_refused(tmp_path, case):
    text, message = TEXTS[case]
    (tmp_path / "cameras.txt").write_text("# one\n1 PINHOLE 64 48 50 50 32 24\r\n")
    (tmp_path / "images.txt").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_cameras(tmp_path)
    assert "images.txt: " in str(error.value)


@pytest.mark.parametrize(
    "text", ["nan", "-nan(ind)", "NaN(snan)", "1.#QNAN", "-1.#IND00", "1.#INF", "inf", "-Infinity"]
)
@pytest.mark.parametrize("place", ["lens", "pose"])
def test_only_images_without_finite_numbers_are_left_out(tmp_path, text, place):
    numbers = {"lens": "50", "pose": "0"} | {place: text}
    (tmp_path / "cameras.txt").write_text(
        f"1 PINHOLE 64 48 50 50 32 24\r\n2 PINHOLE 64 48 {numbers['lens']} 50 32 24\r\n"
    )
    (tmp_path / "images.txt").write_text(
        f"1 1 0 0 0 0 0 0 1 a b.jpg\n\n2 1 {numbers['pose']} 0 0 0 0 0 2 c d.jpg\n\n"
        "3 1 0 0 0 0 0 5 1 e.jpg\n\n"
    )
    message = r"images.txt: 1 of 3 images have cameras .* not finite and are skipped: c d\.jpg"
    with pytest.warns(CameraWarning, match=message):
        assert list(read_cameras(tmp_path)) == ["a b.jpg", "e.jpg"]


@pytest.mark.parametrize(
    ("file", "place"), [("cameras.bin", 32), ("images.bin", 12), ("images.bin", 44)]
)
def test_numbers_of_binary_models_may_not_be_finite(tmp_path, cameras, file, place):
    write_model(tmp_path / "a", cameras)
    path = tmp_path / "a" / file
    content = bytearray(path.read_bytes())
    content[place : place + 8] = struct.pack("<d", float("nan"))
    path.write_bytes(content)
    with pytest.warns(CameraWarning, match="skipped: images/é3.jpg"):
        assert list(read_cameras(tmp_path / "a")) == list(cameras)[1:]


def test_models_that_claim_too_much_are_refused(tmp_path, cameras):
    write_model(tmp_path / "a", cameras)
    for name in ("cameras.bin", "images.bin"):
        path = tmp_path / "a" / name
        good = path.read_bytes()
        for size in range(len(good)):
            path.write_bytes(good[:size])
            with pytest.raises(ValueError, match=f"{name}: expected "):
                read_cameras(tmp_path / "a")
        path.write_bytes((1 << 60).to_bytes(8, "little") + good[8:])
        with pytest.raises(
            ValueError, match=f"{name}: expected .* bytes for {1 << 60} entries, got"
        ):
            read_cameras(tmp_path / "a")
        path.write_bytes(good)


# nerfstudio 1.1 writes the settings of a run in this form: YAML with Python objects.
# Most of the settings are left out here.
CONFIG = """\
!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: {top}
experiment_name: poster
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  datamanager: !!python/object:nerfstudio.data.datamanagers.FullImageDatamanagerConfig
    data: &id003 !!python/object/apply:pathlib.PosixPath
    - data
    - poster
    dataparser: !!python/object:nerfstudio.data.dataparsers.NerfstudioDataParserConfig
      data: *id003
"""


@pytest.fixture
def trained(tmp_path, cameras, monkeypatch):
    """Return a nerfstudio run, and its cameras in the rotated, moved and scaled frame
    of the gaussians."""
    monkeypatch.chdir(tmp_path)
    cameras = {name.replace("é", ""): camera for name, camera in cameras.items()}
    (tmp_path / "data" / "poster").mkdir(parents=True)
    v3dg.write_cameras(tmp_path / "data" / "poster" / "transforms.json", cameras)
    run = tmp_path / "outputs" / "poster" / "splatfacto" / "2026-01-01"
    run.mkdir(parents=True)
    (run / "config.yml").write_text(CONFIG.format(top="null"))
    pose = random_camera(np.random.default_rng(7)).viewmat
    scale = 0.37
    (run / "dataparser_transforms.json").write_text(
        json.dumps({"transform": pose[:3].tolist(), "scale": scale})
    )
    wanted = {}
    for name, camera in cameras.items():
        to_world = pose @ np.linalg.inv(camera.viewmat)
        to_world[:3, 3] *= scale
        wanted[name] = v3dg.Camera(np.linalg.inv(to_world), camera.K, camera.width, camera.height)
    return run, wanted


def test_a_run_has_its_cameras_where_its_gaussians_are(trained, monkeypatch, tmp_path):
    run, wanted = trained
    assert_same(read_cameras(run), wanted)
    assert_same(read_cameras(run / "config.yml"), wanted)
    (tmp_path / "elsewhere").mkdir()
    # the dataset is found from the path of the run
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert_same(read_cameras(run), wanted)


def test_what_was_applied_to_the_data_is_not_applied_twice(trained, tmp_path):
    """The transform of the run already includes the transform of the dataset."""
    run, wanted = trained
    path = tmp_path / "data" / "poster" / "transforms.json"
    document = json.loads(path.read_text())
    applied = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    for frame in document["frames"]:
        frame["transform_matrix"] = (applied @ frame["transform_matrix"]).tolist()
    path.write_text(json.dumps(document | {"applied_transform": applied[:3].tolist()}))
    assert_same(read_cameras(run), wanted)


def test_a_run_without_its_data_is_refused(trained, tmp_path):
    run, _ = trained
    (tmp_path / "data" / "poster" / "transforms.json").unlink()
    with pytest.raises(
        ValueError, match=r"config\.yml: expected the data of the run at data/poster/tran"
    ):
        read_cameras(run)
    (run / "config.yml").write_text("data: null\n")
    with pytest.raises(ValueError, match="a path under data:, which is missing, got no file"):
        read_cameras(run)


def test_the_command_takes_a_folder(tmp_path, cameras):
    from benchmarks.worlds.procedural import make_donut

    v3dg.write_asset(tmp_path / "donut.ply", make_donut(1000))
    write_model(
        tmp_path / "sparse" / "0",
        {"a.jpg": v3dg.Camera.look_at((0, -2, 1), (0, 0, 0), width=40, height=30)},
    )
    done = run_command("render", "donut.ply", "--cameras", ".", "-o", "a.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").is_file()


def test_the_viewer_offers_the_cameras_of_a_folder(tmp_path, monkeypatch, cameras):
    from benchmarks.worlds.procedural import make_donut
    from v3dg import cli

    offered = {}

    class Site:
        def __init__(self, view, **options):
            offered.update(options["cameras"])
            raise KeyboardInterrupt

    monkeypatch.setattr("v3dg.viewer.server.Site", Site)
    v3dg.write_asset(tmp_path / "donut.ply", make_donut(1000))
    write_model(tmp_path / "capture", cameras)
    assert (
        cli.main(
            ["view", f"{tmp_path}/donut.ply", "--cameras", f"{tmp_path}/capture", "--device", "cpu"]
        )
        == 130
    )
    assert_same(offered, cameras)
    (tmp_path / "empty").mkdir()
    wrong = "view", "donut.ply", "--cameras", "empty"
    fails(1, "empty: expected a model of COLMAP", *wrong, cwd=tmp_path)


def test_a_folder_of_frames_is_read(tmp_path, trained):
    """The transform of a training is a file in the same folder, so the cameras are in
    the frame of that training."""
    run, wanted = trained
    folder = tmp_path / "data" / "poster"
    plain = read_cameras(folder / "transforms.json")
    assert_same(read_cameras(folder), plain)
    transform = (run / "dataparser_transforms.json").read_bytes()
    (folder / "dataparser_transforms.json").write_bytes(transform)
    assert_same(read_cameras(folder), wanted)
    assert_same(read_cameras(folder / "transforms.json"), plain)
    with pytest.raises(ValueError, match="expected cameras, got the transform of a run's train"):
        read_cameras(folder / "dataparser_transforms.json")
