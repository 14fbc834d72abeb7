"""The tests of the Blender add-on. blender_session.py has the checks, which run inside
Blender.

Blender as a Python module is large and needs a certain version of Python. If this
Python has no module bpy, the tests use the one that V3DG_BLENDER_PYTHON names:

    python3.13 -m venv blender
    blender/bin/pip install bpy pillow tqdm tyro zstandard
    V3DG_BLENDER_PYTHON=blender/bin/python pytest tests/system/test_blender.py

That Python imports the installed v3dg, or else the one beside these sources.
"""

import ast
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SESSION = Path(__file__).parents[1] / "support" / "blender_session.py"
PYTHON = os.environ.get("V3DG_BLENDER_PYTHON")
HAS_BPY = importlib.util.find_spec("bpy") is not None

pytestmark = [
    pytest.mark.witness,
    pytest.mark.skipif(
        PYTHON is None and not HAS_BPY,
        reason="there is no bpy, and V3DG_BLENDER_PYTHON names no Python that has it",
    ),
]


def names_of_checks():
    tree = ast.parse(SESSION.read_text(encoding="utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    return [function.name for function in functions if function.decorator_list]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return the error of each check, or "", by its name. Blender is started once."""
    folder = tmp_path_factory.mktemp("blender")
    done = subprocess.run(
        [PYTHON or sys.executable, str(SESSION)],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=600,
    )
    path = folder / "results.json"
    assert path.exists(), done.stderr
    return json.loads(path.read_text())


@pytest.mark.parametrize("name", names_of_checks())
def test_in_blender(results, name):
    assert results[name] == ""
