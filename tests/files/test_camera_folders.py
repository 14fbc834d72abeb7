"""Cameras of COLMAP's models, written by COLMAP's own library, and of nerfstudio's
runs."""

import json
import os

import numpy as np
import pytest

import v3dg
from command_line import fails
from command_line import run as run_command
from scenes_lod import random_camera
from v3dg import read_cameras

pycolmap = pytest.importorskip("pycolmap")


def write_model(folder, cameras, *, model="PINHOLE", extra=(), text=False):
    """A model of COLMAP, of images that have the names of cameras."""
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
    file = "images.txt" if text else "images.bin"
    assert_same(read_cameras(tmp_path / "scene" / place / file), cameras)


def test_distortion_is_refused_or_left_out(tmp_path, cameras):
    write_model(tmp_path / "a", cameras, model="OPENCV", extra=(0.1, 0, 0, 0))
    with pytest.raises(
        ValueError, match="a pinhole without lens distortion, got OPENCV; undistort the pict"
    ):
        read_cameras(tmp_path / "a")
    assert_same(read_cameras(tmp_path / "a", distortion="ignore"), cameras)
    write_model(tmp_path / "fish", cameras, model="OPENCV_FISHEYE", extra=(0, 0, 0, 0))
    with pytest.raises(ValueError, match="got OPENCV_FISHEYE"):
        read_cameras(tmp_path / "fish", distortion="ignore")
    write_model(tmp_path / "none", cameras, model="OPENCV", extra=(0, 0, 0, 0))
    assert_same(read_cameras(tmp_path / "none"), cameras)


def test_folders_without_cameras_are_refused(tmp_path, cameras):
    with pytest.raises(ValueError, match=r"expected a model of COLMAP .* or a run of nerfstudio"):
        read_cameras(tmp_path)
    write_model(tmp_path / "a", cameras)
    path = tmp_path / "a" / "images.bin"
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(ValueError, match="a: expected a model of COLMAP, got"):
        read_cameras(tmp_path / "a")


def test_without_pycolmap_the_error_says_how_to_get_it(tmp_path, cameras, monkeypatch):
    write_model(tmp_path / "a", cameras)
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    with pytest.raises(
        ImportError, match=r"cameras of COLMAP: expected .*pip install 'pycolmap>=4.0'"
    ):
        read_cameras(tmp_path / "a")


# As nerfstudio 1.1 writes it: a run's settings as YAML with Python's objects, of which
# many more follow.
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
    """A run of nerfstudio, and its cameras in the frame of the gaussians: turned, moved
    and scaled."""
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
    monkeypatch.chdir(tmp_path / "elsewhere")  # the data is found from the run, too
    assert_same(read_cameras(run), wanted)


def test_what_was_applied_to_the_data_is_not_applied_twice(trained, tmp_path):
    """The run's transform has it in it."""
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
        ValueError, match=r"config\.yml: expected the run's data at data/poster/tran"
    ):
        read_cameras(run)
    (run / "config.yml").write_text("data: null\n")
    with pytest.raises(ValueError, match="a path under data:, which it has not, got none"):
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
