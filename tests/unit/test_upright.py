"""Which axis is up: the declaration of a file, and guesses from cameras and
gaussians."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pickle
import pty
import subprocess
import termios
from pathlib import Path

import numpy as np
import pytest

import scenes_lod
import v3dg
from command_line import COMMAND, ENVIRONMENT, run
from v3dg.cameras import AXES
from v3dg.cli._views import choose_up
from v3dg.formats._declared import Declared
from v3dg.upright import direction_of, up_of

UNFITTED = v3dg.BuildConfig(steps=0)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def spread(rng, widths, count=400):
    """Return an asset whose gaussians have these widths along x, y and z."""
    asset = scenes_lod.blob(rng, count, size=0.01)
    means = (rng.normal(size=(count, 3)) * widths).astype(np.float32)
    return v3dg.Gaussians(means, asset.quats, asset.scales, asset.opacities, asset.sh)


def around(up, count=8):
    """Return cameras on a ring that look slightly down."""
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


def test_what_a_file_declares_tells(rng, tmp_path):
    v3dg.write_asset(tmp_path / "a.GLB", spread(rng, (3, 2, 0.5)))
    asset = v3dg.read_asset(tmp_path / "a.GLB")
    assert up_of(asset) == ("-y", "as in glTF")
    assert up_of(asset.subset(slice(0, 300))) == ("z", "guessed from the plane of its gaussians")
    assert up_of(asset, declared=Declared(up="x", up_reason="so")) == ("x", "so")
    assert up_of(v3dg.Scene()) == ("z", "as in most scenes")
    assert up_of(v3dg.build_bundle(asset, config=UNFITTED, progress=False))[0] == "-y"


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
        (
            "flat.ply",
            "flat.ply: z is up, guessed from the plane of its gaussians; change it with --up\n",
        ),
        ("flat.v3dg", "flat.v3dg: x is up, as its file says; change it with --up\n"),
    ):
        how = ("--size", 32, 32, "--device", "cpu", "-o")
        done = run("render", tmp_path / name, *how, tmp_path / f"{name}.png")
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.endswith(line)
        given = run(
            "render", tmp_path / name, *how, tmp_path / "given.png", "--up", line.split()[1]
        )
        assert given.returncode == 0
        assert "is up" not in given.stdout
        assert (tmp_path / f"{name}.png").read_bytes() == (tmp_path / "given.png").read_bytes()
    done = run("export", tmp_path / "flat.v3dg", "-o", tmp_path / "web", "--quiet")
    assert done.returncode == 0, done.stderr
    assert "flat.v3dg: x is up, as its file says; change it with --up\n" in done.stdout


def at_a_terminal(*arguments, answers, cwd):
    """Return what a command prints on stderr and stdout if a user types these lines,
    and its exit code."""
    ours, theirs = pty.openpty()
    command = [*COMMAND, *map(str, arguments)]
    process = subprocess.Popen(
        command,
        stdin=theirs,
        stderr=theirs,
        stdout=subprocess.PIPE,
        cwd=cwd,
        env=ENVIRONMENT,
        preexec_fn=own_terminal,
    )
    os.write(ours, answers.encode())
    said = process.communicate(timeout=120)[0].decode()
    os.close(theirs)
    asked = b""
    with contextlib.suppress(OSError):  # the end
        while part := os.read(ours, 1 << 16):
            asked += part
    os.close(ours)
    return asked.decode(), said, process.returncode


def own_terminal():
    os.setsid()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


ASKED = "round.ply: which axis points up, x, y, z, -x, -y, -z? [-y] "


@pytest.mark.parametrize(
    ("answers", "up", "times"),
    [("\n", "-y", 1), ("z\n", "z", 1), ("up\n x \n", "x", 2), ("\x04", "-y", 1)],
)
def test_a_build_asks_at_a_terminal_what_nothing_tells(rng, tmp_path, answers, up, times):
    v3dg.write_asset(tmp_path / "round.ply", spread(rng, (1, 1, 1)))
    how = ("--device", "cpu", "--quiet")
    asked, _, code = at_a_terminal("build", "round.ply", *how, answers=answers, cwd=tmp_path)
    assert (code, asked.count(ASKED)) == (0, times), asked
    assert up_of(v3dg.Bundle.open(tmp_path / "round.v3dg")) == (up, "as its file says")
    for more in (("--up", "y"), ("--resume",)):
        asked, _, code = at_a_terminal(
            "build", "round.ply", *how, *more, answers="\n", cwd=tmp_path
        )
        assert (code, asked.count("which way")) == (0, 0)
    for name, scales in (
        ("flat", (3, 2, 0.5)),
        ("round", (1, 1, 1)),
    ):  # a declaration, and no terminal
        v3dg.write_asset(tmp_path / f"{name}.ply", spread(rng, scales))
        run_here = at_a_terminal if name == "flat" else run
        given = {"answers": "\n"} if name == "flat" else {}
        done = run_here("build", f"{name}.ply", *how, **given, cwd=tmp_path)
        assert "which way" not in str(done)
        assert "up" not in v3dg.Bundle.open(tmp_path / f"{name}.v3dg").config


def test_commands_that_use_what_is_up_ask_at_a_terminal_once(rng, tmp_path):
    v3dg.write_asset(tmp_path / "round.ply", spread(rng, (1, 1, 1)))
    how = ("--size", 32, 32, "--device", "cpu", "--output")
    asked, said, code = at_a_terminal(
        "render", "round.ply", *how, "a.png", answers="x\n", cwd=tmp_path
    )
    assert (code, asked.count(ASKED)) == (0, 1), asked
    assert said.endswith("round.ply: x is up, as you answered; change it with --up\n")
    assert run("render", "round.ply", *how, "b.png", "--up", "x", cwd=tmp_path).returncode == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    done = run("render", "round.ply", *how, "b.png", cwd=tmp_path)
    assert done.stdout.endswith(
        "round.ply: -y is up, as in most trained assets; change it with --up\n"
    )


def test_what_is_told_is_not_guessed():
    """A guess would read all clusters of an asset of 100 million gaussians."""
    assert choose_up("x", None, None, Path("asset.ply")) == ("x", [])
