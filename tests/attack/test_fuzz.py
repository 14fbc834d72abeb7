"""Replays what fuzzers that are guided by coverage found and kept."""

import zipfile
from pathlib import Path

import pytest

from fuzz.targets import READERS

CORPUS = Path(__file__).parents[1] / "fuzz" / "corpus"


@pytest.mark.parametrize("name", READERS)
def test_kept_inputs_are_read_or_refused(tmp_path, name):
    with zipfile.ZipFile(CORPUS / f"{name}.zip") as archive:
        entries = archive.namelist()
        assert len(entries) > 50
        for entry in entries:
            READERS[name](archive.read(entry), tmp_path)
