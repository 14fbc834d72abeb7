"""Replays the inputs that coverage-guided fuzzers found and kept."""

import os
import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest

from fuzz import run
from fuzz.targets import READERS

CORPUS = Path(__file__).parents[1] / "fuzz" / "corpus"


@pytest.mark.filterwarnings("ignore::v3dg.cleaning.AssetWarning")
@pytest.mark.parametrize("name", READERS)
def test_kept_inputs_are_read_or_refused(tmp_path, name):
    with zipfile.ZipFile(CORPUS / f"{name}.zip") as archive:
        entries = archive.namelist()
        assert len(entries) > 50
        for entry in entries:
            READERS[name](archive.read(entry), tmp_path)


def has_fuzzer(folder):
    """Return whether there is a clang++ with libFuzzer."""
    compiler = shutil.which(os.environ.get("CLANG", "clang++"))
    if compiler is None:
        return False
    source = folder / "empty.cpp"
    target = 'extern "C" int LLVMFuzzerTestOneInput(const unsigned char*, unsigned long)'
    source.write_text(f"{target} {{ return 0; }}\n", encoding="utf-8")
    command = [compiler, "-fsanitize=fuzzer", str(source), "-o", str(folder / "empty")]
    return subprocess.run(command, capture_output=True).returncode == 0


def test_program_that_fuzzes_the_ply_reader_can_be_built(tmp_path):
    if not has_fuzzer(tmp_path):
        pytest.skip("there is no clang++ with its fuzzer, which the program is built with")
    assert Path(run.compiled(tmp_path)).is_file()
