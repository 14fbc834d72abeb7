"""Tests that the source tree keeps its layout.

Failures name what is missing or not listed.
"""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import v3dg
from v3dg._extras import EXTRAS

ROOT = Path(__file__).parents[2]
CSRC = ROOT / "csrc"
# The folders that each folder of csrc/ may include besides itself. A folder includes
# only folders that are listed before it.
MAY_INCLUDE = {
    "base": set(),
    "math": {"base"},
    "camera": {"base", "math"},
    "io": {"base", "math"},
    "frame": {"base", "math", "camera"},
    "cluster": {"base", "math"},
    "simplify": {"base", "math", "cluster"},
    "gather": {"base", "math"},
    "quantize": {"base", "math"},
    "residency": {"base", "math", "io", "frame", "quantize"},
    "select": {"base", "math", "camera", "frame", "residency"},
    "project": {"base", "math", "camera", "frame", "quantize"},
    "tile_bin": {"base", "math", "frame"},
    "rasterize": {"base", "math", "frame"},
    "rays": {"base", "math", "frame", "quantize", "project"},
    "fit_group": {"base", "math", "camera", "frame", "project", "tile_bin", "rasterize"},
    "draw": {
        "base",
        "math",
        "camera",
        "frame",
        "quantize",
        "residency",
        "select",
        "project",
        "tile_bin",
        "rasterize",
        "rays",
    },
    "levels": {
        "base",
        "math",
        "camera",
        "frame",
        "residency",
        "select",
        "project",
        "tile_bin",
        "rasterize",
        "fit_group",
        "draw",
    },
    "c_interface": {
        "base",
        "math",
        "camera",
        "io",
        "cluster",
        "gather",
        "quantize",
        "residency",
        "select",
    },
    "bindings": {
        "base",
        "math",
        "camera",
        "io",
        "frame",
        "cluster",
        "simplify",
        "gather",
        "quantize",
        "residency",
        "select",
        "project",
        "fit_group",
        "draw",
        "levels",
    },
    "wasm": {
        "base",
        "math",
        "camera",
        "io",
        "frame",
        "cluster",
        "quantize",
        "residency",
        "select",
    },
}
NOT_OPERATIONS = {
    "base",
    "math",
    "camera",
    "io",
    "frame",
    "residency",
    "rays",
    "draw",
    "levels",
    "c_interface",
    "bindings",
    "wasm",
}
TESTED_WITH = {"tile_bin": "rasterize"}
KINDS = {"unit", "files", "system", "browser", "attack", "docs"}
# Operations whose CPU and CUDA parts still have separate contracts.
TWO_CONTRACTS = {"project", "select"}
MOST_LINES_WITHOUT_A_HEAD = 100
MOST_COLUMNS_OF_A_COMMENT = 88
# Folders whose comments are still as wide as code.
WIDE_COMMENTS = {"bindings", "levels"}
OPERATIONS = sorted(p.name for p in CSRC.iterdir() if p.is_dir() and p.name not in NOT_OPERATIONS)
SOURCES = sorted(str(p.relative_to(ROOT)) for p in CSRC.rglob("*") if p.suffix in {".cpp", ".cu"})
MODULES = sorted((ROOT / "v3dg").rglob("*.py"))
MEASURING = sorted(
    p for part in ("evaluation", "worlds") for p in (ROOT / "benchmarks" / part).rglob("*.py")
)


def module_name(path):
    """Return the name by which a module is imported; for a package, the name of its
    folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_cmake_lists_every_source_once():
    lists = (
        "CUT_SIMD_SOURCES",
        "SIMD_SOURCES",
        "CUT_SOURCES",
        "SOURCES",
        "C_SOURCES",
        "BINDINGS",
        "CUDA_BINDINGS",
        "CUDA_DECISION_SOURCES",
        "CUDA_SOURCES",
    )
    # its sources are listed in build.py
    sources = [source for source in SOURCES if not source.startswith("csrc/wasm/")]
    assert sorted(source for name in lists for source in cmake_list(f"V3DG_{name}")) == sources


@pytest.mark.parametrize("operation", OPERATIONS)
def test_operation_has_a_contract_and_both_halves(operation):
    names = {p.name for p in (CSRC / operation).iterdir() if p.stat().st_size}
    assert f"{operation}.h" in names
    assert any(name.endswith("_cpu.cpp") for name in names)
    assert any(name.endswith("_cuda.cu") for name in names)


@pytest.mark.parametrize("operation", sorted(set(OPERATIONS) - TWO_CONTRACTS))
def test_operation_has_one_contract(operation):
    assert not (CSRC / operation / f"{operation}_cuda.h").exists()


@pytest.mark.parametrize("folder", MAY_INCLUDE)
def test_long_sources_say_first_what_they_are(folder):
    untold = []
    for path in (CSRC / folder).iterdir():
        lines = path.read_text(encoding="utf-8").splitlines()
        first = next(line for line in lines if line not in {"", "#pragma once"})
        if len(lines) > MOST_LINES_WITHOUT_A_HEAD and not first.startswith("//"):
            untold.append(path.name)
    assert untold == []


@pytest.mark.parametrize("folder", sorted(set(MAY_INCLUDE) - WIDE_COMMENTS))
def test_comments_of_sources_are_narrower_than_code(folder):
    """clang-format breaks code and comments at the same width, whereas ruff has a limit
    for each."""
    wide = []
    for path in (CSRC / folder).iterdir():
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if line.lstrip().startswith("//") and len(line) > MOST_COLUMNS_OF_A_COMMENT:
                wide.append(f"{path.name}:{number}")
    assert wide == []


@pytest.mark.parametrize("operation", OPERATIONS)
def test_operation_has_a_test(operation):
    name = TESTED_WITH.get(operation, operation)
    assert (ROOT / "tests" / "unit" / "core" / f"test_{name}.py").is_file()


def test_every_test_has_its_kind():
    """Markers are set by the folder; conftest.py describes the kinds."""
    tests = (path.relative_to(ROOT / "tests") for path in (ROOT / "tests").rglob("test_*.py"))
    assert [str(path) for path in tests if path.parts[0] not in KINDS] == []


def test_headers_are_included_once():
    headers = [*CSRC.rglob("*.h"), *CSRC.rglob("*.cuh")]
    assert [str(p) for p in headers if "#pragma once" not in p.read_text(encoding="utf-8")] == []


def folders_included(folder):
    """Return the folders of csrc/ that the sources of a folder include, each with a
    source that does so."""
    for path in (CSRC / folder).iterdir():
        if path.suffix in {".h", ".cpp", ".cu", ".cuh"}:
            for name in re.findall(
                r'^#include "([^"/]+)/', path.read_text(encoding="utf-8"), re.MULTILINE
            ):
                yield name, path


def test_every_folder_of_csrc_has_its_floor():
    assert sorted(p.name for p in CSRC.iterdir() if p.is_dir()) == sorted(MAY_INCLUDE)
    floors = list(MAY_INCLUDE)
    assert not [f for f, below in MAY_INCLUDE.items() if below - set(floors[: floors.index(f)])]


@pytest.mark.parametrize("folder", MAY_INCLUDE)
def test_folder_includes_only_what_it_may(folder):
    allowed = MAY_INCLUDE[folder] | {folder}
    assert sorted(str(path) for name, path in folders_included(folder) if name not in allowed) == []


def test_precision_is_chosen_by_lists_of_files():
    """If a pattern on file names chose the precision, renaming a file would change how
    it rounds."""
    text = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    assert "FILTER" not in text
    assert set(cmake_list("V3DG_CUDA_QUICK_SOURCES")) < {
        *cmake_list("V3DG_CUDA_DECISION_SOURCES"),
        *cmake_list("V3DG_CUDA_SOURCES"),
    }


def cmake_list(name):
    """Return the sources in a list of CMakeLists.txt."""
    text = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    return re.search(rf"set\({name}\s([^)]*)\)", text)[1].split()


def test_host_sources_know_nothing_of_the_cuda_runtime():
    """Sources that are also compiled without CUDA use CUDA only through the contracts
    or behind V3DG_WITH_CUDA."""
    behind_the_flag = re.compile(
        r"^#if V3DG_WITH_CUDA$.*?^#(?:else|endif)", re.MULTILINE | re.DOTALL
    )
    todo = {
        CSRC.parent / s
        for n in (
            "V3DG_CUT_SIMD_SOURCES",
            "V3DG_SIMD_SOURCES",
            "V3DG_CUT_SOURCES",
            "V3DG_SOURCES",
            "V3DG_C_SOURCES",
            "V3DG_BINDINGS",
        )
        for s in cmake_list(n)
    }
    seen = set()
    while todo:
        path = todo.pop()
        seen.add(path)
        text = behind_the_flag.sub("", path.read_text(encoding="utf-8"))
        assert path.name == "host_device.h" or not re.search(r"__CUDACC__|cuda_runtime", text), path
        todo |= {CSRC / name for name in re.findall(r'^#include "(.+)"', text, re.MULTILINE)} - seen


def test_bindings_ask_for_the_backend_in_one_place():
    """All other code uses the interface of backends, whose head comment says how to add
    one."""
    sources = {
        path: path.read_text(encoding="utf-8")
        for path in (CSRC / "bindings").iterdir()
        if path.suffix in {".h", ".cpp"}
    }
    flags = [
        path.name
        for path, text in sources.items()
        for _ in re.findall(r"^#\s*(?:el)?if.*V3DG_WITH_CUDA", text, re.MULTILINE)
    ]
    assert flags == ["backend.cpp"]
    ladders = [
        path.name
        for path, text in sources.items()
        if re.search(r"is_host\(|if constexpr.*CUDA", text)
    ]
    assert ladders == []
    assert "To add a backend" in sources[CSRC / "bindings" / "backend.h"].partition("#include")[0]


def test_only_the_backend_of_cuda_sees_cuda():
    """Bindings that are compiled without CUDA include no header of the CUDA part."""
    halves = re.compile(
        r'#include "(?:base/(?:device|device_guard|stream)\.h|.*_cuda\w*\.h|.*\.cuh)"'
    )
    allowed = {*cmake_list("V3DG_CUDA_BINDINGS"), "csrc/bindings/cuda_frame.h"}
    users = [
        str(path.relative_to(ROOT))
        for path in (CSRC / "bindings").iterdir()
        if path.suffix in {".h", ".cpp"} and halves.search(path.read_text(encoding="utf-8"))
    ]
    assert sorted(users) == sorted(allowed)


def test_kernels_are_started_by_launch_alone():
    """Only `launch` may start kernels, because it checks that a kernel starts and sets
    the shared memory that it needs."""
    sources = [p for p in CSRC.rglob("*") if p.suffix in {".cu", ".cuh"} and p.name != "launch.cuh"]
    assert [str(p) for p in sources if "<<<" in p.read_text(encoding="utf-8")] == []


def test_bindings_give_pythons_lock_up_by_a_type_of_ours():
    """Bindings release Python's lock by our own type. With the type of pybind11, a
    thread that Python ends aborts the process (bindings/python_lock.h)."""
    pythons = re.compile(r"gil_scoped|PyEval_\w+Thread|PyGILState_Ensure|Py_BEGIN_ALLOW_THREADS")
    users = [
        p.name
        for p in CSRC.rglob("*")
        if p.is_file() and pythons.search(p.read_text(encoding="utf-8"))
    ]
    assert sorted(users) == ["python_lock.cpp", "python_lock.h"]


def imports_of(path, *, inside_functions):
    """Return the modules that a Python file imports, except for type checkers, and the
    names that it imports from them."""
    names, todo = set(), [ast.parse(path.read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            # a package whose modules are imported, and which is therefore not imported
            # itself
            names |= {node.module} - {"v3dg"}
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            todo += node.orelse
        elif inside_functions or not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            todo += ast.iter_child_nodes(node)
    return names


def imports_when_loaded(path):
    """Return the modules that a Python file imports when it is loaded."""
    return imports_of(path, inside_functions=False)


def room_of(name):
    """Return the module or package directly in v3dg/ that a module is or belongs to."""
    return f"{name}.__init__".split(".")[1]


def rooms_imported(path, rooms):
    """Return the modules and packages directly in v3dg/ that a file imports."""
    for name in imports_of(path, inside_functions=True):
        if name.split(".")[0] == "v3dg":
            room = room_of(name)
            # the package itself contains the public names
            yield room if room in rooms else "__init__"


def order_of_v3dg():
    """Return the modules of v3dg in the order of CONTRIBUTING.md: each follows those
    that it imports."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    return re.search(r"imports only what stands before it.*?```text\n(.*?)```", text, re.DOTALL)[
        1
    ].split()


def test_every_module_of_v3dg_has_its_place_in_the_order():
    assert sorted(order_of_v3dg()) == sorted(
        {room_of(module_name(path)) for path in MODULES} | {"_core"}
    )


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_module_imports_only_what_stands_before_it(path):
    order, room = order_of_v3dg(), room_of(module_name(path))
    below = {room, *order[: order.index(room)]}
    assert sorted(set(rooms_imported(path, order)) - below) == []


def test_modules_do_not_import_in_a_circle():
    modules = {
        module_name(path): path
        for path in (*MODULES, *MEASURING)
        if path.parent.name != "v3dg" or path.stem != "__init__"
    }
    below = {}
    for name, path in modules.items():
        # What a module imports from its own package is another module of that package.
        below[name] = {
            m
            for m in imports_when_loaded(path) & modules.keys()
            if not f"{name}.".startswith(f"{m}.")
        }
    while below:
        ready = {name for name, imported in below.items() if not imported & below.keys()}
        assert ready, f"import each other: {sorted(below)}"
        below = {name: imported for name, imported in below.items() if name not in ready}


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_the_library_needs_nothing_that_it_is_measured_with(path):
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module)
    assert not {name for name in names if name.split(".")[0] in {"benchmarks", "examples", "tests"}}


def test_what_is_installed_is_the_library_alone():
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert re.findall(r"^wheel\.packages = (.*)$", settings, re.MULTILINE) == ['["v3dg"]']


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_no_module_needs_torch_to_load(path):
    assert not [name for name in imports_when_loaded(path) if name.split(".")[0] == "torch"]


def test_loading_the_package_loads_no_torch(tmp_path):
    command = "import sys, v3dg; sys.exit('torch' in sys.modules)"
    environment = os.environ | {"PYTHONPATH": str(Path(v3dg.__file__).parent.parent)}
    subprocess.run([sys.executable, "-c", command], cwd=tmp_path, env=environment, check=True)


def test_extras_are_told_by_the_names_that_pip_has():
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = settings.partition("[project.optional-dependencies]")[2].partition("\ntest = [")[0]
    names = [requirement.partition(">=")[0] for requirement, _ in EXTRAS.values()]
    assert [name for name in names if f'"{name}>=' not in extras] == []


def test_every_result_is_named():
    """Every recorded result is named in a page of the docs or read by a program;
    otherwise nobody would read it."""
    pages = [ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")]
    programs = [*(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.md")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in (*pages, *programs))
    results = (ROOT / "benchmarks" / "results").glob("*.json")
    unnamed = [path.stem for path in results if not re.search(rf"\b{path.stem}\b", text)]
    assert sorted(unnamed) == []
