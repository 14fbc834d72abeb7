"""The core without Python: the C++ example draws a scene, and CMake configures the
library without the programs that use it."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
# .ci/run and the presets of CMake create these build folders.
BUILDS = [path for name in ("ci/cpp", "dev", "cpu") if (path := ROOT / "build" / name).is_dir()]


def test_core_draws_a_scene_without_python(tmp_path):
    if not BUILDS:
        pytest.skip("needs a build by a preset: cmake --preset cpu")
    subprocess.run(
        ["cmake", "--build", BUILDS[0], "--target", "draw_scene"], check=True, capture_output=True
    )
    picture = tmp_path / "scene.ppm"
    done = subprocess.run(
        [BUILDS[0] / "draw_scene", picture], check=True, capture_output=True, text=True
    )
    assert done.stdout == "4000 gaussians selected, 4000 in the frustum\n"
    pixels = np.frombuffer(picture.read_bytes()[-320 * 240 * 3 :], np.uint8).reshape(240, 320, 3)
    background = np.array([26, 26, 38])
    shown = (pixels != background).any(axis=2)
    # The picture shows two balls; the right one is smaller.
    left = shown[:, :160].sum()
    right = shown[:, 160:].sum()
    assert 0.1 < right / shown.size < left / shown.size < 0.4


def test_the_library_is_configured_without_what_it_is_measured_with(tmp_path):
    """Source packages of Linux distributions contain neither benchmarks/ nor
    examples/."""
    pybind11 = pytest.importorskip("pybind11")
    if shutil.which("cmake") is None or shutil.which("ninja") is None:
        pytest.skip("needs cmake and ninja")
    for name in ("CMakeLists.txt", "csrc"):
        (tmp_path / name).symlink_to(ROOT / name)
    arguments = ["-G", "Ninja", "-DV3DG_CUDA=OFF", f"-Dpybind11_DIR={pybind11.get_cmake_dir()}"]
    done = subprocess.run(
        ["cmake", "-S", tmp_path, "-B", tmp_path / "build", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
