"""Every block of code in the README and in docs/ runs, with small files instead of
large ones. A comment before a block tells what it needs: <!-- test: gpu -->, <!-- test:
needs MODULE -->, or <!-- test: skip, REASON -->.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest

import tiny
import v3dg
from v3dg.donut import make_donut

ROOT = Path(__file__).parents[2]
PAGES = [
    "README.md",
    *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")),
]
BLOCK = re.compile(
    r"^(?:<!-- test: (?P<how>.*?) -->\n)?```(?P<kind>\w+)\n(?P<code>.*?)^```$", re.M | re.S
)


@dataclass
class Block:
    page: str
    line: int  # line number, in the file, of the block's first line of code
    kind: str
    code: str
    how: list[str]  # words of the comment before the block

    @property
    def place(self):
        return f"{self.page}:{self.line}"


def blocks_of(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        line = text[: match.start("code")].count("\n") + 1
        how = re.split(r"[, ]+", match["how"]) if match["how"] else []
        yield Block(page, line, match["kind"], match["code"], how)


def is_gpu(page):
    return any("gpu" in block.how for block in blocks_of(page))


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """Files that the docs assume to exist: assets, bundles and folders of them, a
    scene, and cameras."""
    folder = tmp_path_factory.mktemp("docs")
    asset = make_donut(1000, seed=0)
    for name in ("donut.ply", "donut.spz"):
        v3dg.write_asset(folder / name, asset)
    config = v3dg.BuildConfig(steps=10, cluster_size=64)
    bundle = v3dg.build_bundle(asset, config=config, progress=False, device="cpu")
    bundle.write(folder / "donut.v3dg")
    for name in ("plants", "assets", "trees", "tiles", "parts"):
        (folder / name).mkdir()
    bundle.write(folder / "plants" / "tree.v3dg")
    block = v3dg.Scene()
    block.add(bundle)
    v3dg.write_scene(folder / "parts" / "block.json", block, ["../donut.v3dg"])
    for i in range(8):
        tree = asset.subset(slice(100 * i, 100 * i + 100))
        v3dg.write_asset(folder / "trees" / f"tree{i}.ply", tree)
        v3dg.write_asset(folder / "assets" / f"asset{i}.ply", tree)
        v3dg.write_asset(folder / "tiles" / f"tile{i}.ply", tree)
    scene = v3dg.Scene()
    scene.add(bundle, positions=[[0, 0, 0], [1, 0, 0]])
    around = v3dg.turntable((0, 0, 0), 3, 6, width=64, height=48)
    cameras = {f"side {i}": camera for i, camera in enumerate(around)}
    v3dg.write_scene(folder / "scene.json", scene, ["donut.v3dg"], cameras)
    write_capture(folder, asset)
    # The folders of the published code of V3DG.
    theirs = folder / "_3dgs-assets" / "donut" / "donut" / "point_cloud" / "iteration_30000"
    theirs.mkdir(parents=True)
    v3dg.write_asset(theirs / "fused.ply", asset)
    (folder / "_layout-descriptions").mkdir()
    (folder / "_layout-descriptions" / "DonutSea.json").write_text(json.dumps(published_layout()))
    commands = folder / "bin"
    commands.mkdir()
    python, small = shlex.quote(sys.executable), shlex.join([sys.executable, str(tiny.__file__)])
    if_ours = '[ "$1 $2" = "-m benchmarks" ]'
    for name, line in (
        ("v3dg", f'exec {small} v3dg "$@"'),
        (
            "python",
            f'if {if_ours}; then shift 2; exec {small} benchmarks "$@"; fi\nexec {python} "$@"',
        ),
    ):
        (commands / name).write_text(f"#!/bin/sh\n{line}\n")
        (commands / name).chmod(0o755)
    return folder


def write_capture(folder, asset):
    """Write a trained asset, and the cameras of its photographs in the files of
    COLMAP."""
    v3dg.write_asset(folder / "fox.ply", asset)
    if find_spec("pycolmap") is not None:
        from test_camera_folders import write_model

        around = v3dg.turntable((0, 0, 0), 3, 6, width=64, height=48)
        write_model(
            folder / "fox" / "sparse", {f"{i}.jpg": camera for i, camera in enumerate(around)}
        )


def published_layout():
    """Write a layout in the form of the published code of V3DG, with 60 cameras."""
    instance = {"scale": 1.0, "quaternions": [1, 0, 0, 0], "positions": [0, 0, 0]}
    camera = {
        "camera_name": "camera_19",
        "camera_width": 64,
        "camera_height": 48,
        "camera_angle_x": 0.7,
        "camera_angle_y": 0.5,
        "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]],
    }
    asset = {
        "asset_kind": "donut",
        "asset_name": "donut",
        "ply_suffix": "point_cloud/iteration_30000/fused.ply",
        "instances": [instance],
    }
    return {"layouts": [{"assets": [asset], "cameras": [camera] * 60}]}


def run_page(page, folder, monkeypatch, *, with_gpu):
    monkeypatch.chdir(folder)
    tiny.shrink(monkeypatch.setattr, monkeypatch.setitem)
    names = {"__name__": "__main__"}
    for block in blocks_of(page):
        if "skip" in block.how or ("gpu" in block.how and not with_gpu):
            continue
        if "needs" in block.how and find_spec(block.how[block.how.index("needs") + 1]) is None:
            continue
        if block.kind == "python":
            code = compile("\n" * (block.line - 1) + block.code, str(ROOT / page), "exec")
            exec(code, names)
        elif block.kind == "sh":
            run_shell(block, folder)
        elif block.kind == "json":
            path = folder / "block.json"
            path.write_text(block.code)
            v3dg.read_scene(path)
        else:
            pytest.fail(f"{block.place}: expected python, sh or json, or a comment that says skip")


def run_shell(block, folder):
    paths = [str(folder / "bin"), os.environ["PATH"]]
    environment = os.environ | {
        "PATH": os.pathsep.join(paths),
        "HOME": str(folder),
        "PYTHONPATH": os.pathsep.join([os.path.dirname(os.path.dirname(v3dg.__file__)), *sys.path]),
    }
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.code],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, f"{block.place}\n{done.stdout}\n{done.stderr}"


@pytest.fixture
def folder(files, tmp_path):
    return shutil.copytree(files, tmp_path / "work")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize("page", [page for page in PAGES if list(blocks_of(page))])
def test_code_of_page_runs(page, folder, monkeypatch):
    run_page(page, folder, monkeypatch, with_gpu=False)


@pytest.mark.gpu
@pytest.mark.parametrize("page", [page for page in PAGES if is_gpu(page)])
def test_code_of_page_runs_on_a_gpu(page, folder, monkeypatch):
    run_page(page, folder, monkeypatch, with_gpu=True)


@pytest.mark.parametrize("page", PAGES)
def test_blocks_are_all_found(page):
    """A fence that is indented, or that follows a comment of another form, would not be
    run."""
    text = (ROOT / page).read_text(encoding="utf-8")
    assert len(re.findall(r"^\s*```\w", text, re.M)) == len(list(blocks_of(page)))
    assert text.count("<!-- test:") == sum(bool(block.how) for block in blocks_of(page))


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    made_for_the_site = {"contributing.md", "style.md", "changelog.md", "tutorial.md"}
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" not in target and target not in made_for_the_site:
            assert (ROOT / page).parent.joinpath(target).exists(), f"{page}: {target}"


def test_every_experiment_is_in_the_index():
    """Experiments are not in the navigation, so the index must link each of them."""
    folder = ROOT / "docs" / "notes" / "experiments"
    index = (folder / "index.md").read_text(encoding="utf-8")
    pages = {path.name for path in folder.glob("*.md")} - {"index.md"}
    assert pages == set(re.findall(r"\]\((\d{4}-[^)#]+\.md)\)", index))


def test_notebook_runs_and_keeps_no_output(tmp_path, monkeypatch):
    notebook = json.loads(
        (ROOT / "docs" / "notebooks" / "tutorial.ipynb").read_text(encoding="utf-8")
    )
    monkeypatch.chdir(tmp_path)
    tiny.shrink(monkeypatch.setattr, monkeypatch.setitem)
    smaller = {
        "make_donut(20_000)": "make_donut(1000)",
        "count = 1000": "count = 10",
        "width=800, height=450": "width=80, height=46",
    }
    names = {}
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            code = "".join(cell["source"])
            if code.startswith("%pip install"):
                continue
            for large in [large for large in smaller if large in code]:
                code = code.replace(large, smaller.pop(large))
            exec(compile(code, f"cell {number}", "exec"), names)
    assert not smaller
    assert v3dg.read_scene("donuts.json")[1].keys() == {"front"}
