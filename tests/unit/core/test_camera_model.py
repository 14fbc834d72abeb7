"""The interface of camera models. A second model is projected with the same code as the
pinhole."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
CSRC = ROOT / "csrc"
# Folders that may name pinhole cameras: some draw pictures with cameras that they
# choose themselves, the bindings and the C library create the cameras of users, and
# projection has separate kernels for pinholes.
USERS_OF_PINHOLES = {"camera", "fit_group", "levels", "bindings", "c_interface", "project"}
# Sources that translate the fields of users' cameras.
MAKERS_OF_CAMERAS = {
    "bindings/bind_types.cpp",
    "c_interface/cameras.cpp",
    "c_interface/scene_file.cpp",
}


def compiler() -> str | None:
    return shutil.which(os.environ.get("CXX", "c++"))


def assert_program_finds_nothing(name: str, folder: Path) -> None:
    """Compile a program of tests/cpp; assert that it succeeds and prints nothing."""
    program = folder / name
    source = ROOT / "tests" / "cpp" / f"{name}.cpp"
    command = [compiler(), "-std=c++20", "-O1", "-I", CSRC, source, "-o", program]
    compiled = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compiled.returncode == 0, compiled.stderr
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.skipif(compiler() is None, reason="needs a C++ compiler")
def test_second_camera_model_goes_through_projection(tmp_path: Path) -> None:
    """The model satisfies the concept, and its ellipses and gradients agree with its
    formula."""
    assert_program_finds_nothing("second_camera", tmp_path)


@pytest.mark.skipif(compiler() is None, reason="needs a C++ compiler")
def test_distorted_models_agree_with_finite_differences_and_cull_nothing_drawn(
    tmp_path: Path,
) -> None:
    assert_program_finds_nothing("distorted_cameras", tmp_path)


@pytest.mark.skipif(compiler() is None, reason="needs a C++ compiler")
def test_boxes_of_directions_hold_every_point_of_a_gaussian(tmp_path: Path) -> None:
    assert_program_finds_nothing("ray_boxes", tmp_path)


def test_pinholes_are_named_by_those_who_make_them_alone() -> None:
    """All other code names Intrinsics, so that another model only needs a file and an
    entry in camera/camera.h."""
    sources = [p for p in CSRC.rglob("*") if p.suffix in {".h", ".cuh", ".cpp", ".cu"}]
    users = {p.parent.name for p in sources if "Pinhole<" in p.read_text(encoding="utf-8")}
    assert users == USERS_OF_PINHOLES


def test_fields_of_a_pinhole_are_known_to_its_folder_alone() -> None:
    """Other folders only create a pinhole as a whole.

    They can scale and crop any camera.
    """
    field = re.compile(r"\bcamera\.(fx|fy|cx|cy)\b|[;{] *(camera|window)\.(width|height) =")
    sources = [p for p in CSRC.rglob("*") if p.suffix in {".h", ".cuh", ".cpp", ".cu"}]
    users = {
        str(path.relative_to(CSRC))
        for path in sources
        if path.parent.name != "camera" and field.search(path.read_text(encoding="utf-8"))
    }
    assert users == MAKERS_OF_CAMERAS
