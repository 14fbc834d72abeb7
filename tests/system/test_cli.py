import errno
import json
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

import v3dg
from benchmarks.worlds.procedural import make_asset
from command_line import COMMAND, ENVIRONMENT, fails, run
from v3dg import cli


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an asset, a bundle, and a scene of three instances and two
    cameras."""
    folder = tmp_path_factory.mktemp("cli")
    v3dg.write_asset(folder / "tuft.ply", make_asset(1000))
    done = run("build", "tuft.ply", "--quiet", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "build.json").write_text(done.stdout)
    scene = {
        "format": "v3dg-scene",
        "version": 1,
        "bundles": {"tuft": "tuft.v3dg"},
        "instances": [{"bundle": "tuft", "position": [2 * i, 0, 0]} for i in range(3)],
        "cameras": [
            {"name": "near", "width": 48, "height": 32, "eye": [0, -4, 2], "target": [1, 0, 0.4]},
            {
                "name": "far away",
                "width": 32,
                "height": 32,
                "eye": [0, -40, 9],
                "target": [2, 0, 0],
            },
        ],
    }
    (folder / "scene.json").write_text(json.dumps(scene))
    (folder / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    return folder


@pytest.mark.skipif(v3dg._core.num_cuda_devices() > 0, reason="there is a CUDA device")
@pytest.mark.parametrize(
    "command", [("build", "tuft.ply", "-o", "other.v3dg"), ("render", "tuft.v3dg")]
)
def test_missing_cuda_is_an_error(folder, command):
    fails(1, "or use 'cpu'", *command, "--device", "cuda", cwd=folder)


def test_version():
    done = run("--version")
    assert done.returncode == 0
    assert done.stdout.split() == ["v3dg", v3dg.__version__]


@pytest.mark.parametrize(
    "command",
    [
        "build",
        "refine",
        "info",
        "render",
        "compare",
        "convert",
        "export",
        "demo",
        "doctor",
        "completion",
    ],
)
def test_help(command):
    done = run(command, "--help")
    assert done.returncode == 0
    assert f"usage: v3dg {command}" in done.stdout
    assert "(default: None)" not in done.stdout
    assert "--json" in done.stdout
    assert "--quiet" in done.stdout
    assert command in run("--help").stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_a_script_that_knows_commands_and_options(shell):
    done = run("completion", shell)
    assert done.returncode == 0, done.stderr
    assert "compare" in done.stdout
    assert "tolerance" in done.stdout
    # the help text is not printed, because it would fill the terminal
    assert "Screen area" not in done.stdout
    assert "'None'" not in done.stdout
    # Names of files are completed if nothing else matches.
    files = {
        "bash": "complete -o default -F",
        "zsh": '-z "$completions"',
        "fish": "complete --command",
    }
    assert files[shell] in done.stdout
    told = json.loads(run("completion", shell, "--json", "--quiet").stdout)
    assert told["shell"] == shell
    assert len(told["script"]) == len(done.stdout) - 1


def test_what_is_missing_is_named(tmp_path):
    fails(
        2,
        "PATH: expected file to describe, got nothing; run v3dg info --help",
        "info",
        cwd=tmp_path,
    )


def test_a_name_that_is_nearly_there_is_proposed(tmp_path):
    (tmp_path / "donut.v3dg").touch()
    fails(
        1,
        "donut.v3d: expected a file, got a path that does not exist; perhaps you meant donut.v3dg",
        "info",
        "donut.v3d",
        cwd=tmp_path,
    )
    fails(1, "got a path that does not exist; check the path", "info", "tree.v3dg", cwd=tmp_path)


def test_a_link_that_leads_nowhere_is_named(tmp_path):
    (tmp_path / "a.ply").symlink_to("b.ply")
    fails(1, "a.ply: expected a file, got a link to b.ply, which", "info", "a.ply", cwd=tmp_path)


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_what_the_script_says():
    typed = f"""
        eval "$({shlex.join(COMMAND)} completion bash)"
        COMP_WORDS=(v3dg ren) COMP_CWORD=1; _tyro_v3dg; echo "${{COMPREPLY[@]}}"
        COMP_WORDS=(v3dg render --tol) COMP_CWORD=2; _tyro_v3dg; echo "${{COMPREPLY[@]}}"
        COMP_WORDS=(v3dg render --up "") COMP_CWORD=3; _tyro_v3dg; echo "${{COMPREPLY[@]}}"
        COMP_WORDS=(v3dg render don) COMP_CWORD=2; _tyro_v3dg; echo "${{#COMPREPLY[@]}}"
        complete -p v3dg
    """
    done = subprocess.run(["bash", "-c", typed], capture_output=True, text=True, env=ENVIRONMENT)
    assert done.stderr == ""
    *completed, registered = done.stdout.splitlines()
    assert completed == ["render", "--tolerance", "x y z -x -y -z", "0"]
    # Without this option, bash would no longer complete names of files.
    assert registered == "complete -o default -F _tyro_v3dg v3dg"


@pytest.mark.witness
@pytest.mark.skipif(shutil.which("fish") is None, reason="there is no fish")
def test_fish_completes_what_the_script_says(tmp_path):
    (tmp_path / "rendered.ply").touch()
    completed = "complete -C 'v3dg ren'; complete -C 'v3dg build r'"
    typed = f"{shlex.join(COMMAND)} completion fish | source; {completed}"
    done = subprocess.run(
        ["fish", "-c", typed], capture_output=True, text=True, cwd=tmp_path, env=ENVIRONMENT
    )
    assert done.stderr == ""
    found = [line.split("\t")[0] for line in done.stdout.splitlines()]
    assert "render" in found
    assert "rendered.ply" in found


def test_module_runs_too():
    command = [sys.executable, "-m", "v3dg", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT)
    assert done.stdout.split() == ["v3dg", v3dg.__version__]


def test_help_loads_nothing_heavy():
    code = (
        "import sys, v3dg.cli; "
        "print([m for m in ('torch', 'PIL', 'flip_evaluator', 'matplotlib', 'scipy') if m in "
        "sys.modules])"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=ENVIRONMENT)
    assert done.stdout.strip() == "[]"


def test_build_reports_what_it_wrote(folder):
    result = json.loads((folder / "build.json").read_text())
    bundle = v3dg.Bundle.open(folder / "tuft.v3dg")
    assert result["output"] == "tuft.v3dg"
    assert result["asset_gaussians"] == 1000
    assert result["levels"] == bundle.num_levels > 1
    assert result["gaussians"] == bundle.num_gaussians
    assert result["bytes"] == (folder / "tuft.v3dg").stat().st_size
    assert not (folder / "tuft.v3dg.partial").exists()


def test_same_seed_and_any_number_of_threads_give_the_same_file(folder, tmp_path):
    done = run("build", folder / "tuft.ply", "-o", tmp_path / "one.v3dg", "--threads", 1, "--quiet")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "one.v3dg").read_bytes() == (folder / "tuft.v3dg").read_bytes()
    assert os.listdir(tmp_path) == ["one.v3dg"]


def test_info_of_a_bundle(folder):
    text = run("info", folder / "tuft.v3dg")
    assert text.returncode == 0, text.stderr
    assert "colour error" in text.stdout
    result = json.loads(run("info", folder / "tuft.v3dg", "--json").stdout)
    assert result["kind"] == "bundle"
    assert result["levels"][0]["gaussians"] == 1000


def test_info_counts_rotations_of_length_zero(folder, tmp_path):
    asset = v3dg.read_asset(folder / "tuft.ply")
    asset.quats[:3] = 0
    v3dg.write_asset(tmp_path / "flat.ply", asset)
    done = run("info", tmp_path / "flat.ply")
    assert (
        "3 with a rotation of length zero, drawn without rotation; convert --drop-bad"
        in done.stdout
    )
    assert json.loads(run("info", tmp_path / "flat.ply", "--json").stdout)["without_rotation"] == 3
    assert "rotation" not in run("info", folder / "tuft.ply").stdout


def test_info_of_an_asset(folder):
    assert "1,000 gaussians, SH degree 1" in run("info", folder / "tuft.ply").stdout
    result = json.loads(run("info", folder / "tuft.ply", "--json").stdout)
    assert (result["kind"], result["gaussians"], result["sh_degree"]) == ("asset", 1000, 1)


@pytest.fixture(scope="module")
def dirty(folder):
    """The asset with a broken, a transparent and a far gaussian."""
    asset = make_asset(1000)
    asset.sh[3, 0, 1] = np.nan
    asset.opacities[5] = 0.001
    asset.means[7] = 0, 0, 1e4
    v3dg.write_asset(folder / "dirty.ply", asset)
    return folder / "dirty.ply"


def test_info_says_what_is_wrong_with_an_asset(dirty):
    text = run("info", dirty).stdout
    assert (
        "2 cannot be drawn: 1 with a colour that is not finite, 1 with an opacity below 1/255"
        in text
    )
    assert "1 outliers" in text
    result = json.loads(run("info", dirty, "--json").stdout)
    assert result["not_drawable"] == {"sh_not_finite": 1, "transparent": 1}
    assert (result["gaussians"], result["drawable"], result["outliers"]) == (1000, 998, 1)
    assert result["box"][1][2] == 1e4
    assert result["box_without_outliers"][1][2] < 2


def test_build_leaves_out_what_cannot_be_drawn_and_says_so(dirty, tmp_path):
    done = run("build", dirty, "-o", "out.v3dg", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (
        "left out: 1 with a colour that is not finite, 1 with an opacity below 1/255" in done.stdout
    )
    assert v3dg.Bundle.open(tmp_path / "out.v3dg").config["asset_gaussians"] == 1000
    message = f"{dirty}: asset: expected only gaussians that can be drawn, but 2 of 1,000"
    (tmp_path / "out.v3dg").unlink()
    fails(1, message, "build", dirty, "-o", "out.v3dg", "--strict", cwd=tmp_path)


def test_build_refuses_an_asset_with_nothing_left(folder, tmp_path):
    asset = make_asset(1000)
    asset.opacities[:] = 0
    v3dg.write_asset(tmp_path / "hidden.ply", asset)
    fails(1, "got none: 1,000 of 1,000 gaussians", "build", "hidden.ply", cwd=tmp_path)


def test_a_full_disk_is_named_with_what_resumes(folder, tmp_path):
    """There is room for the first levels, but not for the journal of all levels."""
    limit = (folder / "tuft.v3dg").stat().st_size + 600
    done = subprocess.run(
        [*COMMAND, "build", folder / "tuft.ply", "-o", "out.v3dg", "--quiet"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=ENVIRONMENT,
        preexec_fn=lambda: resource.setrlimit(
            resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY)
        ),
    )
    assert done.returncode == 1
    message = "out.v3dg.partial: File too large; `--resume` continues from out.v3dg.partial"
    assert done.stderr == f"v3dg: error: {message}\n"
    assert os.listdir(tmp_path) == ["out.v3dg.partial"]
    done = run("build", folder / "tuft.ply", "-o", "out.v3dg", "--resume", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out.v3dg").read_bytes() == (folder / "tuft.v3dg").read_bytes()
    assert os.listdir(tmp_path) == ["out.v3dg"]


def test_info_of_a_scene(folder):
    assert "far away" in run("info", folder / "scene.json").stdout
    result = json.loads(run("info", folder / "scene.json", "--json").stdout)
    assert (result["instances"], result["gaussians_at_full_detail"]) == (3, 3000)


def test_info_does_not_list_hundreds_of_cameras(folder, tmp_path):
    scene, cameras = v3dg.read_scene(folder / "scene.json")
    camera = next(iter(cameras.values()))
    scene.save(tmp_path / "many.json", {f"camera {i}": camera for i in range(300)})
    told = run("info", tmp_path / "many.json").stdout.splitlines()
    assert len([line for line in told if line.startswith("camera ")]) == 1 + 20
    assert told[-1] == "and 280 more; --json lists all"
    assert len(json.loads(run("info", tmp_path / "many.json", "--json").stdout)["cameras"]) == 300


@pytest.mark.parametrize("subject", ["tuft.ply", "tuft.v3dg"])
def test_render_turntable(folder, tmp_path, subject):
    done = run(
        *("render", folder / subject, "-o", tmp_path / "out.png", "--views", 2, "--size", 64, 48),
        *("--background", 1, 1, 1, "--up", "z", "--json"),
    )
    assert done.returncode == 0, done.stderr
    pictures = json.loads(done.stdout)["pictures"]
    assert sorted(os.listdir(tmp_path)) == ["out_0.png", "out_1.png"]
    for picture in pictures:
        with Image.open(picture["picture"]) as image:
            pixels = np.asarray(image)
        assert pixels.shape == (48, 64, 3)
        assert (pixels[0, 0] == 255).all(), "the background shows in the corner"
        assert (pixels[20:28, 28:36] != 255).any(), "and the subject in the middle"
        assert picture["gaussians_in_frustum"] > 0


def test_turntable_of_several_views_fades_and_a_still_does_not(folder, tmp_path):
    def picture(*options):
        command = ("render", folder / "tuft.v3dg", "-o", tmp_path / "out.png", "--size", 64, 48)
        done = run(*command, "--tolerance", 3, *options, "--json")
        assert done.returncode == 0, done.stderr
        first = json.loads(done.stdout)["pictures"][0]
        with Image.open(first["picture"]) as image:
            return np.asarray(image).tobytes(), first["gaussians_selected"]

    for same in (
        [("--views", 2), ("--views", 2, "--fade", 1.02)],
        [("--views", 1), ("--views", 1, "--fade", 1)],
    ):
        first, *others = (picture(*options) for options in same)
        assert others == [first] * len(others)
    assert picture("--views", 2, "--fade", 4)[1] > picture("--views", 2, "--fade", 1)[1]


def test_render_scene(folder, tmp_path):
    done = run("render", folder / "scene.json", "-o", tmp_path / "out.png", "--tolerance", 0)
    assert done.returncode == 0, done.stderr
    assert "select ms" in done.stdout
    assert sorted(os.listdir(tmp_path)) == ["out_far_away.png", "out_near.png"]
    done = run("render", folder / "scene.json", "-o", tmp_path / "one.jpg", "--camera", 0)
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "one.jpg") as picture:
        assert picture.size == (48, 32)


def test_render_from_a_pool(folder, tmp_path):
    pictures = []
    for options in ((), ("--memory", "64MB")):
        path = tmp_path / f"{len(options)}.png"
        done = run(
            "render", folder / "tuft.v3dg", "-o", path, "--size", 64, 48, "--views", 1, *options
        )
        assert done.returncode == 0, done.stderr
        pictures.append(path.read_bytes())
    assert pictures[0] == pictures[1]


def test_render_of_a_film_takes_a_budget_in_steps(folder, tmp_path):
    """A film uses only the part of the memory that is free as its budget; a still
    picture uses all of it."""
    scene, cameras = v3dg.read_scene(folder / "scene.json")
    camera = cameras["near"]
    for fade, budget in ((1.0, 640), (1.02, 640 - 20)):
        options = ("--camera", "near", "--budget", 640, "--fade", fade, "--json")
        done = run("render", folder / "scene.json", "-o", tmp_path / "out.png", *options)
        assert done.returncode == 0, done.stderr
        (picture,) = json.loads(done.stdout)["pictures"]
        assert (
            picture["tolerance"] == v3dg.select(scene, camera, budget=budget, fade=fade).tolerance
        )


def test_render_within_a_budget(folder, tmp_path):
    out = tmp_path / "small.png"
    options = ("--camera", "near", "--budget", 400, "--color-by", "level", "--json")
    done = run("render", folder / "scene.json", "-o", out, *options)
    assert done.returncode == 0, done.stderr
    (picture,) = json.loads(done.stdout)["pictures"]
    assert 0 < picture["gaussians_selected"] <= 400
    assert picture["tolerance"] > 0
    levels = ("--camera", "near", "--tolerance", 0, "--min-level", 1, "--json")
    done = run("render", folder / "scene.json", "-o", out, *levels)
    assert 0 < json.loads(done.stdout)["pictures"][0]["gaussians_selected"] < 3 * 1000
    fails(
        1,
        "budget: expected at least",
        *(
            "render",
            folder / "scene.json",
            "--camera",
            "near",
            "--budget",
            1,
            "-o",
            tmp_path / "no.png",
        ),
        cwd=tmp_path,
    )


def test_render_from_a_camera_file(folder, tmp_path):
    matrix = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0.5], [0, 0, 0, 1]]
    frames = [{"file_path": f"train/r_{i}", "transform_matrix": matrix} for i in range(2)]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": 0.7, "k1": 0.1, "frames": frames}))
    for subject in ("tuft.ply", "tuft.v3dg", "scene.json"):
        command = ["render", folder / subject, "--cameras", path, "--size", 40, 30]
        done = run(*command, "--distortion", "ignore", "-o", tmp_path / "out.png", "--json")
        assert done.returncode == 0, done.stderr
        for i, picture in enumerate(json.loads(done.stdout)["pictures"]):
            assert picture["picture"] == str(tmp_path / f"out_train_r_{i}.png")
            assert picture["gaussians_in_frustum"] > 0
            with Image.open(picture["picture"]) as image:
                assert image.size == (40, 30)
        os.unlink(tmp_path / "out_train_r_0.png")
        os.unlink(tmp_path / "out_train_r_1.png")
    pictures = []
    for choice in ((), ("--distortion", "draw"), ("--distortion", "ignore")):
        one = ("--camera", "train/r_1", "-o", tmp_path / "one.png")
        done = run(*command, *choice, *one)
        assert done.returncode == 0, done.stderr
        pictures.append((tmp_path / "one.png").read_bytes())
    assert pictures[0] == pictures[1] != pictures[2]


def test_wrong_usage(folder):
    fails(2, "bild", "bild", cwd=folder)
    fails(2, "v3dg build --help", "build", cwd=folder)
    fails(2, "--config", "build", "tuft.ply", "--config", "best", cwd=folder)
    fails(2, "--seed", "build", "tuft.ply", "--seed", "many", cwd=folder)
    fails(2, "--cluster-sise", "build", "tuft.ply", "--cluster-sise", "3", cwd=folder)
    for number in (0, 2**32):
        fails(
            2,
            "--threads: expected 1 to 1,024",
            "build",
            "tuft.ply",
            "--threads",
            number,
            cwd=folder,
        )
    fails(2, "--camera", "render", "tuft.ply", "--camera", "near", cwd=folder)
    fails(2, "COMMAND: expected build, refine, info,", "tuft.ply", cwd=folder)
    fails(
        2,
        "--up: expected one of x, y, z, -x, -y, -z, got",
        "build",
        "tuft.ply",
        "--up",
        "q",
        cwd=folder,
    )
    fails(
        2,
        "--size: expected 2 whole numbers, got '100';",
        "render",
        "tuft.v3dg",
        "--size",
        100,
        cwd=folder,
    )
    fails(2, "--output: expected 1 value, got fewer;", "render", "tuft.v3dg", "-o", cwd=folder)
    fails(
        2,
        "--budget: expected whole numbers, got '1e6'",
        "render",
        "tuft.v3dg",
        "--budget=1e6",
        cwd=folder,
    )
    fails(
        2,
        "--elevation: expected numbers, got 'x'",
        "render",
        "tuft.v3dg",
        "--elevation=x",
        cwd=folder,
    )
    fails(
        2, "--views: expected 1 to 10,000, got 0", "render", "tuft.v3dg", "--views", 0, cwd=folder
    )
    fails(2, "-89.99 to 89.99, got 90", "render", "tuft.v3dg", "--elevation", 90, cwd=folder)
    fails(2, "leave it out", "export", "tuft.v3dg", "--to", "tiles", "-o", "a.usda", cwd=folder)
    fails(2, "--seed: expected 0 to", "demo", "--seed", "-1", cwd=folder)


@pytest.mark.parametrize("option", [("--views", 1), ("--elevation", 20), ("--up", "z")])
@pytest.mark.parametrize("command", ["render scene.json", "compare tuft.ply scene.json"])
def test_options_of_a_turntable_are_refused_beside_cameras(folder, option, command):
    """Options with their default values are refused, too: what counts is whether the
    user gave the option."""
    message = (
        f"{option[0]}: expected a subject without cameras, got the cameras of scene.json; "
        "leave it out"
    )
    fails(2, message, *command.split(), *option, cwd=folder)


def test_options_of_a_turntable_are_refused_beside_a_camera_file(folder, tmp_path):
    v3dg.write_cameras(tmp_path / "t.json", {"front": v3dg.turntable((0, 0, 0), 4, 1)[0]})
    command = ("render", "tuft.v3dg", "--cameras", tmp_path / "t.json", "--views", 2)
    fails(2, f"got the cameras of {tmp_path / 't.json'}; leave it out", *command, cwd=folder)


def test_a_file_that_is_read_is_not_written_over(folder, tmp_path):
    """Other names of the same file are also refused, because everything in the file
    besides the gaussians would be lost."""
    (tmp_path / "a.ply").write_bytes((folder / "tuft.ply").read_bytes())
    (tmp_path / "a.v3dg").write_bytes((folder / "tuft.v3dg").read_bytes())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    (tmp_path / "b.ply").symlink_to("a.ply")
    (tmp_path / "b.v3dg").hardlink_to(tmp_path / "a.ply")
    for command in (
        ("convert", "a.ply", "./a.ply"),
        ("convert", "a.ply", "b.ply"),
        ("convert", "a.v3dg", "a.v3dg", "--codec", "quantized"),
        ("build", "a.ply", "-o", "b.v3dg"),
        ("export", "a.v3dg", "-o", "a.v3dg"),
    ):
        fails(2, "an output that is not the input", *command, cwd=tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


def test_an_empty_argument_is_not_the_working_folder(folder):
    """For an unset variable, a shell passes an empty argument. If it meant the working
    folder, `build` would build all assets there."""
    before = sorted(os.listdir(folder))
    fails(
        2,
        "argument 2 is empty; is a shell variable unset",
        "build",
        "",
        "-o",
        "all.v3dg",
        cwd=folder,
    )
    assert sorted(os.listdir(folder)) == before


def test_an_asset_with_wrong_values_is_drawn_without_them(folder, tmp_path):
    asset = v3dg.read_asset(folder / "tuft.ply")
    asset.means[::7] = np.nan
    v3dg.write_asset(tmp_path / "nan.ply", asset)
    done = run("render", "nan.ply", "--size", 32, 32, "--up", "z", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["pictures"][0]["gaussians_in_frustum"] > 100
    text = "gaussians have invalid values: "
    fails(1, text, "convert", "nan.ply", "nan.spz", cwd=tmp_path)


def test_failures(folder):
    fails(1, "nothing.ply", "build", "nothing.ply", cwd=folder)
    fails(1, "broken.ply", "build", "broken.ply", cwd=folder)
    fails(1, "broken.ply", "info", "broken.ply", cwd=folder)
    fails(
        1, "expected a file name ending in .v3dg", "build", "tuft.ply", "-o", "tuft.zip", cwd=folder
    )
    fails(1, "tuft.ply: Not a directory", "build", "tuft.ply", "-o", "tuft.ply/a.v3dg", cwd=folder)
    fails(
        1,
        "got a folder; tuft.v3dg would be a file in it",
        "build",
        "tuft.ply",
        "-o",
        "./",
        cwd=folder,
    )
    fails(1, "got a folder", "info", ".", cwd=folder)
    fails(
        1,
        "MiB, got 0.0 MiB",
        "build",
        "tuft.ply",
        "--memory",
        "1KB",
        "-o",
        "small.v3dg",
        cwd=folder,
    )
    fails(1, "tuft.ply: Not a directory", "render", "tuft.ply", "-o", "tuft.ply/a.png", cwd=folder)
    fails(2, "a local file as output", "convert", "tuft.ply", "https://x/a.ply", cwd=folder)
    fails(1, ".png", "render", "tuft.ply", "-o", "tuft.gif", cwd=folder)
    fails(1, "tolerance", "render", "tuft.v3dg", "--tolerance", "-1", cwd=folder)
    fails(1, "near, far away", "render", "scene.json", "--camera", "left", cwd=folder)
    fails(2, "--gaussians: expected 1,000 to", "demo", "--gaussians", "3", cwd=folder)


def test_interrupt_leaves_no_bundle_and_says_so(tmp_path):
    v3dg.write_asset(tmp_path / "big.ply", make_asset(60_000))
    command = [*COMMAND, "build", "big.ply", "--quiet"]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        # If the tests are started in the background, they ignore interrupts, and
        # children inherit this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    time.sleep(2.5)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.startswith("v3dg: error: interrupted")
    assert not (tmp_path / "big.v3dg").exists()


def test_closed_pipe_is_quiet(folder):
    command = f"{sys.executable} -m v3dg info tuft.v3dg --json | head -c 1"
    done = subprocess.run(
        command, shell=True, capture_output=True, text=True, cwd=folder, env=ENVIRONMENT
    )
    assert done.stderr == ""


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-", "> /dev/full"])
@pytest.mark.parametrize(
    "command", ["--help", "info tuft.v3dg", "info nowhere.ply", "convert tuft.ply {}/a.ply"]
)
def test_closed_and_full_streams_end_with_one_line_and_take_no_file(
    folder, tmp_path, closed, command
):
    command = f"{sys.executable} -m v3dg {command.format(tmp_path)} {closed}"
    done = subprocess.run(
        command, shell=True, capture_output=True, text=True, cwd=folder, env=ENVIRONMENT
    )
    assert done.returncode in (0, 1)
    assert done.stderr.count("\n") <= 1
    assert done.stderr.startswith("v3dg: error: " if done.stderr else "")
    for path in tmp_path.iterdir():  # outputs are written to a folder of their own
        np.testing.assert_array_equal(
            v3dg.read_asset(path).means, v3dg.read_asset(folder / "tuft.ply").means
        )


def test_text_of_files_reaches_no_terminal_as_it_is(folder, tmp_path):
    """Names of files, and texts in a bundle, may contain control characters."""
    evil = "\x1b]0;owned\x07\x1b[2J\r\n\u202e\x9b\udcff"
    for name in ("{}.ply", "{}.v3dg"):
        shutil.copy(folder / name.format("tuft"), tmp_path / name.format(evil))
    bundle = v3dg.Bundle.open(folder / "tuft.v3dg")
    config = {**bundle.config, evil: evil, "nested": {evil: [evil]}}
    v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, config).write(
        tmp_path / "told.v3dg"
    )
    for command in (
        ("info", f"{evil}.ply"),
        ("info", f"{evil}.v3dg"),
        ("info", "told.v3dg"),
        ("info", f"{evil}.json"),
        ("build", f"{evil}.ply", "--quiet"),
        ("build", f"{evil}.ply", f"{evil}.ply", "told.v3dg", "-o", "folder", "--quiet"),
        ("render", f"{evil}.v3dg", "--size", 32, 32),
        ("compare", f"{evil}.ply", f"{evil}.v3dg", "--size", 32, 32, "--views", 1, "--quiet"),
        ("convert", f"{evil}.ply", f"{evil}.spz"),
        ("export", f"{evil}.v3dg", "--quiet"),
        ("render", f"{evil}.v3dg", "--up", evil),
    ):
        done = run(*command, cwd=tmp_path)
        shown = done.stdout + done.stderr
        assert shown.endswith("\n"), command
        assert all(c.isprintable() for c in shown.replace("\n", "")), (command, shown)


def test_main_returns_the_exit_code(capsys):
    assert cli.main(["--version"]) == 0
    assert cli.main(["info", "nowhere.v3dg"]) == 1
    assert "nowhere.v3dg" in capsys.readouterr().err


def test_a_place_where_no_bundle_can_go_is_refused_before_anything_is_built(folder, tmp_path):
    (tmp_path / "tuft.v3dg").mkdir()
    done = run("build", folder / "tuft.ply", "-o", "tuft.v3dg", "--quiet", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr == "v3dg: error: tuft.v3dg: Is a directory\n"
    assert os.listdir(tmp_path) == ["tuft.v3dg"]


def test_levels_are_kept_when_the_bundle_cannot_be_saved(folder, tmp_path, monkeypatch, capsys):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    command = ["build", str(folder / "tuft.ply"), "-o", str(tmp_path / "tuft.v3dg"), "--quiet"]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert cli.main(command) == 1
    levels = tmp_path / "tuft.v3dg.partial"
    message = f"{levels}: No space left on device; `--resume` continues from {levels}\n"
    assert capsys.readouterr().err.endswith(message)
    assert list(tmp_path.iterdir()) == [levels]
    assert cli.main([*command, "--resume"]) == 0
    assert os.listdir(tmp_path) == ["tuft.v3dg"]
