"""Tests the steps of .ci/run, the jobs that use them, and the summary of durations."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CI = ROOT / ".ci"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))

pytestmark = pytest.mark.skipif(not CI.is_dir(), reason="a source distribution has no .ci")

JUNIT = """<testsuites><testsuite>
<testcase classname="tests.unit.core.test_select" name="test_a[1]" time="2.5"/>
<testcase classname="tests.system.test_pool" name="test_b" time="400"/>
<testcase classname="tests.unit.test_scene" name="test_c" time="0.25"/>
<testcase classname="tests.unit.core.test_select" name="test_d" time="1.5"/>
</testsuite></testsuites>"""


def steps():
    text = (CI / "steps.sh").read_text(encoding="utf-8")
    return set(re.findall(r"^(\w+)\(\) \{", text, re.MULTILINE)) - {
        "enter",
        "requirements_of",
        "run_tests",
    }


def test_all_steps_are_run_in_an_order():
    text = (CI / "run").read_text(encoding="utf-8")
    order = re.search(r"^readonly all=\((.*)\)$", text, re.MULTILINE)[1].split()
    assert sorted([*order, "fast_tests"]) == sorted(steps())


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_jobs_name_steps_that_there_are(workflow):
    named = re.findall(r"run: \.ci/run(.*)$", workflow.read_text(encoding="utf-8"), re.MULTILINE)
    assert {step for line in named for step in line.split()} <= steps()


def test_another_step_is_refused_before_anything_is_done():
    done = subprocess.run(
        ["bash", CI / "run", "lint", "polish"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("polish: expected a step: environment install")


def test_durations_are_summed_up(tmp_path):
    path = tmp_path / "tests.xml"
    path.write_text(JUNIT)
    command = [sys.executable, str(CI / "durations.py"), str(path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "4 tests took 404 s." in printed
    assert "The quickest 75% of them take 300 s together." in printed
    rows = re.findall(r"^\| (tests\S+) \| ([\d.]+) \|$", printed, re.MULTILINE)
    assert rows[:3] == [
        ("tests/system", "400.0"),
        ("tests/unit/core", "4.0"),
        ("tests/unit", "0.2"),
    ]
    assert rows[3:5] == [
        ("tests.system.test_pool::test_b", "400.0"),
        ("tests.unit.core.test_select::test_a[1]", "2.5"),
    ]


def version():
    text = (ROOT / "v3dg" / "_version.py").read_text(encoding="utf-8")
    return re.search(r'"(.*)"', text)[1]


def test_the_citation_and_the_recipe_have_the_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {version()}\n" in citation
    recipe = (ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8")
    assert f'\n  version: "{version()}"\n' in recipe


def test_the_recipe_asks_for_what_the_package_does():
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.search(r"^dependencies = \[\n(.*?)^\]", settings, re.MULTILINE | re.DOTALL)[1]
    wanted = sorted(re.findall(r'^    "(.*?)"', listed, re.MULTILINE))
    recipe = (ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8")
    run = re.search(r"^  run:\n    - python\n((?:    - .*\n)+)", recipe, re.MULTILINE)[1]
    assert sorted(re.findall(r"- (.*)", run.replace(" >=", ">="))) == wanted


def ci(program, *arguments):
    return subprocess.run(
        ["bash", CI / program, *arguments], capture_output=True, text=True, check=False
    )


def test_the_page_of_a_release_is_its_part_of_the_changelog():
    printed = ci("notes", version()).stdout
    assert printed in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert printed.strip()
    assert "## [" not in printed


def test_a_version_without_notes_is_refused():
    done = ci("notes", "9.9.9")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "CHANGELOG.md: expected a section for [9.9.9] with text, got none\n"


def test_wheels_are_not_begun_for_what_is_no_python():
    done = ci("wheels", "/bin/false")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "/bin/false: expected a Python interpreter with venv\n"


def test_wheels_are_tried_by_the_command_of_cibuildwheel():
    """`.ci/wheels` finds the line with sed, so the line has to keep its form."""
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert re.search(r'^test-command = "v3dg demo [^"]*"$', settings, re.MULTILINE)
