"""The C library can be installed and found by CMake. The examples use it, and so does
the first program on its page of the documentation."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import c_library
from scenes_lod import blob, lod_bundle
from v3dg import Camera, Scene, select, write_scene

pytestmark = pytest.mark.slow  # slow, because the library is compiled first
ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "c_interface.md"
LOOK = Camera.look_at((0, -3, 0.5), (0, 0, 0), (0, 0, 1), 0.8, width=1280, height=720, near=0.01)


def run(*command, **options):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    """Return the folder into which the library is installed."""
    folder = tmp_path_factory.mktemp("prefix")
    build = c_library.built()
    with c_library.building():
        run("cmake", "--install", build, "--prefix", folder)
    return folder


@pytest.fixture(scope="module")
def programs(prefix, tmp_path_factory):
    """Return the folder of the examples. They are built from installed files only."""
    folder = tmp_path_factory.mktemp("programs")
    source = folder / "source"
    shutil.copytree(ROOT / "examples" / "c", source)
    build = folder / "build"
    run("cmake", "-S", source, "-B", build, "-G", "Ninja", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", build)
    return build


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    path = tmp_path_factory.mktemp("bundle") / "blob.v3dg"
    rng = np.random.default_rng(0)
    made = lod_bundle(rng, blob(rng, 4000, size=0.5), 64)
    made.write(path)
    return path


def test_what_is_installed(prefix):
    names = {str(path.relative_to(prefix)) for path in prefix.rglob("*") if not path.is_dir()}
    assert {Path(name).name for name in names} == {
        "v3dg.h",
        "libv3dg.so",
        "libv3dg.so.0",
        "libv3dg.so.0.1.0",
        "v3dgConfig.cmake",
        "v3dgConfigVersion.cmake",
        "v3dgTargets.cmake",
        "v3dgTargets-release.cmake",
    }
    assert "include/v3dg.h" in names


def test_count_tells_the_cut_of_python(programs, bundle):
    text = run(programs / "v3dg_count", bundle, 20, 2000)
    selection = select(bundle, LOOK, tolerance=20, budget=2000, device="cpu")
    first = f"1 instances of 1 bundles: {len(selection)} clusters, {selection.num_gaussians}"
    assert text.startswith(first)
    levels = re.findall(r"^level (\d+): (\d+) clusters, (\d+) gaussians$", text, re.MULTILINE)
    table = selection.per_pair(lambda clusters: clusters.level)
    expected = dict(zip(*np.unique(table, return_counts=True), strict=True))
    assert len(expected) > 1
    assert {int(level): int(count) for level, count, _ in levels} == expected
    assert sum(int(count) for _, _, count in levels) == selection.num_gaussians


def test_engine_arrays_load_pages_and_hold_the_cut(programs, bundle, tmp_path):
    camera = Camera.look_at((0, -2, 0), (0, 0, 0), width=640, height=480)
    scene = Scene()
    scene.add(bundle, [(-0.6, 0, 0), (0.6, 0, 0)], scales=[0.5, 1.0])
    write_scene(tmp_path / "two.json", scene, [str(bundle)], {"front": camera})
    output = tmp_path / "cut.ply"
    text = run(programs / "v3dg_engine_arrays", tmp_path / "two.json", output)
    counts = [
        int(count) for count in re.findall(r"^frame \d+: (\d+) gaussians", text, re.MULTILINE)
    ]
    selection = select(scene, camera, tolerance=3.0, budget=200_000, fade=1.02, device="cpu")
    assert len(counts) > 2
    assert counts[0] < counts[-1] == selection.num_gaussians
    lines = output.read_text().splitlines()
    points = np.array([line.split() for line in lines[lines.index("end_header") + 1 :]], float)
    expected = selection.gaussians(device="cpu")
    np.testing.assert_allclose(points[:, :3], expected.means, rtol=1e-5, atol=1e-6)
    colors = np.clip(0.28209479 * expected.sh[:, 0] + 0.5, 0, 1)
    np.testing.assert_allclose(points[:, 3:], 255 * colors, atol=0.51)


def test_wrong_files_end_the_programs_with_a_sentence(programs, tmp_path):
    for program in ("v3dg_count", "v3dg_engine_arrays"):
        arguments = [programs / program, tmp_path / "none.v3dg", tmp_path / "out.ply"]
        done = subprocess.run(arguments, capture_output=True, text=True)
        assert done.returncode == 1
        assert done.stderr == f"{tmp_path / 'none.v3dg'}: No such file or directory\n"


def test_the_page_opens_with_thirty_lines_that_select(prefix, bundle, tmp_path):
    code = re.search(r"```c\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    body = code[code.index("int main") :]
    assert len(body.splitlines()) <= 30
    source = tmp_path / "cut.c"
    source.write_text(code, encoding="utf-8")
    compiler = shutil.which(os.environ.get("CC", "cc"))
    folders = ["-I", prefix / "include", "-L", prefix / "lib", f"-Wl,-rpath,{prefix / 'lib'}"]
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror"]
    run(compiler, *strict, source, *folders, "-lv3dg", "-o", tmp_path / "cut")
    text = run(tmp_path / "cut", bundle)
    selection = select(bundle, LOOK, budget=100_000, fade=1.02, device="cpu")
    assert len(text.splitlines()) == len(selection) > 0


def test_the_library_needs_no_python(prefix):
    """The library only depends on libraries that any C++ program with OpenMP needs."""
    text = run("readelf", "-d", prefix / "lib" / "libv3dg.so")
    needed = set(re.findall(r"NEEDED.*\[(.*?)\.so", text))
    assert needed <= {
        "libstdc++",
        "libgomp",
        "libomp",
        "libm",
        "libgcc_s",
        "libc",
        "ld-linux-x86-64",
    }


def test_without_the_json_library_configuring_says_what_to_install(tmp_path):
    done = subprocess.run(
        [
            *("cmake", "-S", ROOT, "-B", tmp_path, "-G", "Ninja"),
            *("-DV3DG_PYTHON=OFF", "-DV3DG_C_LIBRARY=ON"),
            "-DV3DG_JSON_INCLUDE_DIR=V3DG_JSON_INCLUDE_DIR-NOTFOUND",
            "-DCMAKE_FIND_ROOT_PATH=/nowhere",
            "-DCMAKE_FIND_ROOT_PATH_MODE_INCLUDE=ONLY",
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert "V3DG_JSON_INCLUDE_DIR: expected the folder that contains" in done.stderr
