"""Tests the files that the hooks of the site write: llms.txt and the tutorial."""

import importlib.util
import re
from pathlib import Path

import pytest

pytest.importorskip("material")
from mkdocs.config import load_config
from mkdocs.structure.files import get_files
from mkdocs.structure.nav import get_navigation

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def hooks():
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def llms(hooks):
    """Return the text of llms.txt for the current site."""
    config = load_config(str(ROOT / "mkdocs.yml"))
    files = config.plugins.run_event("files", get_files(config), config=config)
    nav = get_navigation(files, config)
    for page in nav.pages:
        page.read_source(config)
    return hooks.llms_text(nav, config)


def test_llms_txt_has_a_line_for_each_page_of_the_navigation(llms):
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = set(re.findall(r"[\w/]+\.md\b", settings.partition("\nnav:\n")[2])) - {"index.md"}
    assert set(re.findall(r"^- \[[^]]+\]\((.*?)\): \S", llms, re.MULTILINE)) == pages
    assert llms.startswith("# v3dg\n\n> Level of detail for 3D Gaussian Splatting\n\n## Start\n")


@pytest.mark.parametrize(
    ("page", "sentence"),
    [
        ("# A\n\nOne *thing*. Another.\n", "One *thing*."),
        (
            "# A\n\n```sh\nrun\n```\n\n| a |\n\nSee [this](b.md): it\nis long. More.\n",
            "See this: it is long.",
        ),
        ("# A\n", ""),
    ],
)
def test_the_first_sentence_is_that_of_prose(hooks, page, sentence):
    assert hooks.first_sentence(page) == sentence


def test_the_tutorial_is_the_notebook(hooks):
    cells = [
        {"cell_type": "markdown", "source": ["# T\n", "Text."]},
        {"cell_type": "code", "source": ["a = 1\n", "a"]},
    ]
    page = hooks.notebook_text({"cells": cells})
    assert page.startswith("# T\nText.\n\nThis page is [a notebook](notebooks/tutorial.ipynb)")
    assert page.endswith("\n\n```python\na = 1\na\n```\n")
