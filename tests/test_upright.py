"""Which axis is up: what files say, and what is guessed from cameras and gaussians."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

import scenes_lod
import v3dg
from command_line import run
from v3dg.cameras import AXES
from v3dg.cli._views import choose_up
from v3dg.upright import direction_of, up_of


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def spread(rng, widths, count=400):
    """An asset whose gaussians are spread so widely along x, y and z."""
    asset = scenes_lod.blob(rng, count, size=0.01)
    means = (rng.normal(size=(count, 3)) * widths).astype(np.float32)
    return v3dg.Gaussians(means, asset.quats, asset.scales, asset.opacities, asset.sh)


def around(up, count=8):
    """Cameras on a ring that look a little down."""
    return {
        str(i): camera
        for i, camera in enumerate(
            v3dg.turntable((0, 0, 0), 5, count, 0.3, up=direction_of(up), width=8, height=8)
        )
    }


@pytest.mark.parametrize(
    ("widths", "axis", "how"),
    [
        ((3, 2, 0.5), "z", "plane"),
        ((3, 0.5, 2), "-y", "plane"),
        ((0.5, 3, 2), "-y", "most trained"),
        ((2, 2, 2), "-y", "most trained"),
    ],
)
def test_ground_planes_are_found(rng, widths, axis, how):
    asset = spread(rng, widths)
    assert up_of(asset)[0] == axis
    assert how in up_of(asset)[1]
    bundle = scenes_lod.lod_bundle(rng, asset, 16)
    assert up_of(bundle)[0] == axis


def test_far_outliers_hide_no_plane(rng):
    asset = spread(rng, (3, 2, 0.3))
    asset.means[:5] = 1e4 * rng.normal(size=(5, 3))
    asset.means[5:9] = np.nan
    assert up_of(asset)[0] == "z"


@pytest.mark.parametrize("axis", AXES)
def test_cameras_tell(rng, axis):
    assert up_of(spread(rng, (3, 2, 0.5)), around(axis)) == (axis, "guessed from 8 cameras")


def test_few_or_tumbling_cameras_do_not_tell(rng):
    asset = spread(rng, (3, 2, 0.5))
    assert up_of(asset, around("y", 2))[0] == "z"
    tumbling = {axis: next(iter(around(axis).values())) for axis in AXES}
    assert up_of(asset, tumbling)[0] == "z"


def test_kind_of_file_tells(rng):
    assert up_of(spread(rng, (3, 2, 0.5)), path="a.GLB")[0] == "y"
    assert up_of(v3dg.Scene()) == ("z", "as scenes have it")


def test_nothing_is_no_error(rng):
    assert up_of(spread(rng, (1, 1, 1)).subset(np.zeros(0, np.int64)))[0] == "-y"


def test_scene_file_keeps_what_is_up(tmp_path):
    scene = v3dg.Scene()
    v3dg.write_scene(tmp_path / "a.json", scene, [])
    assert v3dg.read_scene(tmp_path / "a.json")[0].up is None
    scene.up = "-x"
    v3dg.write_scene(tmp_path / "a.json", scene, [])
    read = v3dg.read_scene(tmp_path / "a.json")[0]
    assert up_of(read, around("y")) == ("-x", "as its file says")
    assert pickle.loads(pickle.dumps(read)).up == "-x"
    for wrong, message in (("w", r"'x' or .* or '-z', got 'w'"), (None, "a string, got null")):
        content = json.loads((tmp_path / "a.json").read_text()) | {"up": wrong}
        (tmp_path / "a.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match=rf"^a\.json: up: expected {message}$"):
            v3dg.read_scene(tmp_path / "a.json")


def test_bundle_keeps_what_is_up_and_commands_say_what_they_took(rng, tmp_path):
    v3dg.write_asset(tmp_path / "flat.ply", spread(rng, (3, 2, 0.5)))
    assert run("build", tmp_path / "flat.ply", "--up", "x", "--device", "cpu").returncode == 0
    assert up_of(v3dg.Bundle.open(tmp_path / "flat.v3dg")) == ("x", "as its file says")
    for name, line in (
        ("flat.ply", "flat.ply: z is up, guessed from the plane of its gaussians; --up says otherwise\n"),
        ("flat.v3dg", "flat.v3dg: x is up, as its file says; --up says otherwise\n"),
    ):
        how = ("--size", 32, 32, "--device", "cpu", "-o")
        done = run("render", tmp_path / name, *how, tmp_path / f"{name}.png")
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.endswith(line)
        given = run("render", tmp_path / name, *how, tmp_path / "given.png", "--up", line.split()[1])
        assert given.returncode == 0
        assert "is up" not in given.stdout
        assert (tmp_path / f"{name}.png").read_bytes() == (tmp_path / "given.png").read_bytes()
    done = run("export", tmp_path / "flat.v3dg", "-o", tmp_path / "web", "--quiet")
    assert done.returncode == 0, done.stderr
    assert "flat.v3dg: x is up, as its file says; --up says otherwise\n" in done.stdout


def test_what_is_told_is_not_guessed():
    """Of an asset of 100 million gaussians a guess looks at all clusters."""
    assert choose_up("x", None, None, Path("asset.ply")) == ("x", [])
