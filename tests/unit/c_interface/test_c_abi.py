"""Compares the binary interface of the C library with the committed one: its symbols,
structs and constants.

After an intended change, raise V3DG_ABI_VERSION, unless functions were only added. Then
write the new list by running this file with `PYTHONPATH=tests/support python`.
"""

import ctypes
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

import c_library

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
HEADER = ROOT / "include" / "v3dg.h"
pytestmark = pytest.mark.slow  # slow, because the library is compiled first


def compiler():
    found = shutil.which(os.environ.get("CC", "cc"))
    if found is None:
        pytest.skip("needs a C compiler")
    return found


def exported():
    """Return the kind and the name of each exported symbol of the library."""
    path = c_library.built() / "lib" / "libv3dg.so"
    command = ["nm", "-D", "--defined-only", str(path)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [line.split()[1:] for line in lines]


def symbols():
    """Return the functions that the library exports, with their version."""
    return sorted(name for kind, name in exported() if kind == "T")


def layout():
    """Return the lines that print_abi.c prints."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "print_abi"
        source = HERE / "print_abi.c"
        strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
        command = [compiler(), *strict, "-I", HEADER.parent, source, "-o", program]
        subprocess.run(command, check=True)
        return subprocess.run([program], check=True, capture_output=True, text=True).stdout


def abi():
    return "".join(f"{symbol}\n" for symbol in symbols()) + layout()


def test_symbols_and_structs_are_the_committed_ones():
    assert abi() == (HERE / "abi.txt").read_text(encoding="utf-8")


def test_nothing_else_is_exported():
    assert [name for kind, name in exported() if kind != "T"] == ["V3DG_0"]


def test_every_function_of_the_header_is_exported():
    text = re.sub(r"/\*.*?\*/", "", HEADER.read_text(encoding="utf-8"), flags=re.DOTALL)
    declared = re.findall(r"^V3DG_API [^(]*?(\w+)\(", text, re.MULTILINE)
    assert sorted(declared) == [symbol.partition("@")[0] for symbol in symbols()]


def test_library_and_header_have_one_version():
    version = int(re.search(r"#define V3DG_ABI_VERSION (\d+)", HEADER.read_text())[1])
    assert c_library.library().v3dg_abi_version() == version
    assert (c_library.built() / "lib" / f"libv3dg.so.{version}").exists()


def test_structs_of_the_tests_are_those_of_the_header():
    lines = layout().splitlines()
    for name, struct in c_library.STRUCTS.items():
        assert f"{name} {ctypes.sizeof(struct)}" in lines
        for field, *_ in struct._fields_:
            place = getattr(struct, field)
            assert f"{name}.{field} {place.offset} {place.size}" in lines


def test_the_header_is_c_plus_plus_too(tmp_path):
    source = tmp_path / "header.cpp"
    body = "v3dg_rule rule = V3DG_DEFAULT_RULE; v3dg_instance instance = V3DG_DEFAULT_INSTANCE;"
    uses = "return rule.min_level + instance.environment;"
    source.write_text(f"#include <v3dg.h>\nint main() {{ {body} {uses} }}\n")
    found = shutil.which(os.environ.get("CXX", "c++"))
    options = ["-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only"]
    subprocess.run([found, *options, "-I", HEADER.parent, source], check=True)


if __name__ == "__main__":
    print(abi(), end="")
