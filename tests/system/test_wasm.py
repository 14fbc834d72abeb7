"""The core in WebAssembly chooses the same cuts as `v3dg.select`, and decodes pages to
the same bits. It runs in Node.js and in a worker of Chromium. V3DG_WASM_VIEWS sets the
number of views."""

import gzip
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import chromium
import v3dg
import web_pages
from random_bundle import random_bundle, random_gaussians
from v3dg import _core
from v3dg.bundle.codec import codec_of
from web_server import serving

ROOT = Path(__file__).parents[2]
WASM = ROOT / "csrc" / "wasm"
CORE = ROOT / "v3dg" / "export" / "web" / "core.js"
SUPPORT = ROOT / "tests" / "support"
NUM_VIEWS = int(os.environ.get("V3DG_WASM_VIEWS", "1000"))
VIEWS_OF_A_SCENE = 50
TYPES = {
    "int64": "BigInt64Array",
    "float32": "Float32Array",
    "float64": "Float64Array",
    "int32": "Int32Array",
    "uint32": "Uint32Array",
    "uint8": "Uint8Array",
}

pytestmark = [
    pytest.mark.skipif(not WASM.is_dir(), reason="an installed package has no sources"),
    pytest.mark.skipif(shutil.which("node") is None, reason="needs node"),
    pytest.mark.skipif(
        importlib.util.find_spec("ziglang") is None, reason="needs zig: pip install ziglang"
    ),
]


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    """Return the path of the compiled module."""
    path = tmp_path_factory.mktemp("wasm") / "v3dg.wasm"
    subprocess.run([sys.executable, WASM / "build.py", path], check=True)
    return path


class Arrays:
    """A file that contains arrays for Node.js."""

    def __init__(self):
        self._parts = []
        self._end = 0

    def add(self, array):
        array = np.ascontiguousarray(array)
        data = array.tobytes() + bytes(-array.nbytes % 8)
        place = [TYPES[array.dtype.name], self._end, array.size]
        self._parts.append(data)
        self._end += len(data)
        return place

    def write(self, path):
        path.write_bytes(b"".join(self._parts))


def tables_of(bundle, arrays, *, by_pages):
    """Write a bundle's tables to the file and return their places.

    With `by_pages`, include a page table.
    """
    clusters = bundle.clusters
    groups = bundle.groups
    tables = {
        "ball": groups.ball,
        "weight": groups.weight,
        "level": groups.level,
        "ownGroup": clusters.own_group,
        "parentGroup": clusters.parent_group,
        "box": clusters.box,
        "offset": clusters.offset,
        "filter": clusters.filter_px2,
        "antialiased": clusters.antialiased,
    }
    places = {name: arrays.add(array) for name, array in tables.items()}
    pages = {"shift": np.int64, "begins": np.int32, "needs": np.uint32}
    for name, dtype in pages.items():
        places[name] = None
        if by_pages and name != "begins":
            places[name] = arrays.add(np.zeros(len(groups.weight) + 1, dtype))
    return places


def random_scene(rng, bundles):
    scene = v3dg.Scene()
    used = rng.choice(len(bundles), int(rng.integers(1, 4)), replace=False).tolist()
    for index in used:
        count = int(rng.choice([1, 3, 40]))
        quaternions = rng.normal(size=(count, 4))
        has_factors = rng.random() < 0.3
        scene.add(
            bundles[index],
            rng.normal(size=(count, 3)) * 4,
            quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
            np.exp(rng.normal(size=count)),
            rng.choice([1.0, 1.0, 0.25, 4.0], count),
            opacity=rng.uniform(0, 1, count) if has_factors else 1.0,
        )
    return scene, used


def random_camera(rng):
    width = int(rng.integers(16, 2000))
    height = int(rng.integers(16, 2000))
    eye = rng.normal(size=3) * np.exp(rng.uniform(-1, 3))
    return v3dg.Camera.look_at(
        eye,
        rng.normal(size=3),
        up=(0, 0, 1),
        fov_x=rng.uniform(0.2, 2.2),
        width=width,
        height=height,
        near=float(np.exp(rng.uniform(-6, 0))),
    )


def random_rule(rng):
    """Return the arguments of `select` for a random rule."""
    rule = {
        "tolerance": float(rng.choice([0, np.inf, np.exp(rng.uniform(-6, 9)), 4.0])),
        "min_level": int(rng.choice([0, 0, 0, 1, 2])),
        "cull": bool(rng.random() < 0.8),
    }
    if rng.random() < 0.4:
        rule["budget"] = int(rng.integers(0, 400))
    if rng.random() < 0.4:
        rule["fade"] = float(rng.choice([1.0, 1.1, 1.5, 2.0, 10.0]))
    elif rng.random() < 0.2:
        rule["footprint"] = "paper"
    return rule


def view_of(camera, rule):
    """Return a camera as a view of core.js."""
    view = {
        **web_pages.pinhole_of(camera),
        "tolerance": None if rule["tolerance"] == np.inf else rule["tolerance"],
        "minLevel": rule["min_level"],
        "culls": rule["cull"],
        "isPaper": "footprint" in rule,
    }
    for name in ("budget", "fade"):
        if name in rule:
            view[name] = rule[name]
    return view


def expected_bytes(scene, camera, rule):
    """Return the bytes that Node.js should write for the cut of a view."""
    try:
        cut = v3dg.select(scene, camera, device="cpu", **rule)
    except ValueError as error:
        least = int(str(error).split("at least ")[1].split(",")[0])
        return np.array([0, least, 0], np.uint32).tobytes()
    parts = [
        np.array([1, len(cut)], np.uint32),
        np.array([cut.tolerance], np.float32),
        cut.instance_ids,
        cut.cluster_ids,
    ]
    if cut.given_weights is not None:
        parts.append(cut.given_weights)
    return b"".join(part.tobytes() for part in parts)


def trial_scenes(rng, bundles, arrays):
    """Yield scenes for Node.js, each with the expected bytes for its views."""
    for _ in range(-(-NUM_VIEWS // VIEWS_OF_A_SCENE)):
        scene, used = random_scene(rng, bundles)
        factors = scene.factors
        instances = {
            "bundle": arrays.add(scene.instance_bundle),
            "positions": arrays.add(np.asarray(scene.positions, np.float64)),
            "quaternions": arrays.add(np.asarray(scene.quaternions, np.float64)),
            "scales": arrays.add(np.asarray(scene.scales, np.float64)),
            "importance": arrays.add(scene.importance),
            "factors": None if factors is None else arrays.add(factors),
        }
        views = []
        expected = []
        for _ in range(VIEWS_OF_A_SCENE):
            camera = random_camera(rng)
            rule = random_rule(rng)
            views.append(view_of(camera, rule))
            expected.append(expected_bytes(scene, camera, rule))
        yield {"used": used, "instances": instances, "views": views}, expected


def run_node(module, folder, arrays, trials):
    """Write cuts.bin and rows.bin to the folder; return the report."""
    arrays.write(folder / "arrays.bin")
    (folder / "trials.json").write_text(json.dumps(trials))
    programs = [SUPPORT / "wasm_node.mjs", CORE, SUPPORT / "wasm_trials.mjs"]
    done = subprocess.run(
        ["node", *programs, module, folder], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


WORKER = """
import * as module from "./core.js";
import { runTrials } from "./wasm_trials.mjs";
const bytes = async (name) => (await fetch(name)).arrayBuffer();
try {
  const trials = await (await fetch("trials.json")).json();
  const code = await bytes("v3dg.wasm");
  const { cuts, rows, report } = await runTrials(module, code, trials, await bytes("arrays.bin"));
  await fetch("cuts.bin", { method: "PUT", body: cuts });
  await fetch("rows.bin", { method: "PUT", body: rows });
  postMessage(report);
} catch (error) {
  postMessage({ error: String(error) });
}
"""
RUN_WORKER = """() => new Promise((resolve) => {
  const worker = new Worker("worker.js", { type: "module" });
  worker.onmessage = ({ data }) => resolve(data);
  worker.onerror = ({ message }) => resolve({ error: message });
})"""


def run_chromium(browser, module, folder, arrays, trials):
    """Do the same as `run_node`, in a worker of a web page."""
    arrays.write(folder / "arrays.bin")
    (folder / "trials.json").write_text(json.dumps(trials))
    (folder / "worker.js").write_text(WORKER)
    (folder / "index.html").write_text("<!doctype html><title>trials</title>")
    shutil.copy(module, folder / "v3dg.wasm")
    for path in (CORE, SUPPORT / "wasm_trials.mjs"):
        shutil.copy(path, folder)
    with serving(folder, accepts=("cuts.bin", "rows.bin")) as server:
        page = browser.new_page()
        page.goto(server.url)
        report = page.evaluate(RUN_WORKER)
        page.close()
    assert "error" not in report, report["error"]
    return report


def random_trials():
    """Return arrays and trials of selection, and the expected bytes of each cut."""
    rng = np.random.default_rng(0)
    bundles = [random_bundle(seed, num_levels=1 + seed % 5) for seed in range(24)]
    arrays = Arrays()
    tables = [
        tables_of(bundle, arrays, by_pages=seed % 2 == 1) for seed, bundle in enumerate(bundles)
    ]
    scenes = []
    expected = []
    for scene, cuts in trial_scenes(rng, bundles, arrays):
        scenes.append(scene)
        expected += cuts
    return arrays, {"bundles": tables, "scenes": scenes, "pages": []}, expected


def check_cuts(folder, report, expected):
    assert report["numCuts"] == len(expected) >= NUM_VIEWS
    got = (folder / "cuts.bin").read_bytes()
    end = 0
    for number, cut in enumerate(expected):
        assert got[end : end + len(cut)] == cut, f"view {number}"
        end += len(cut)
    assert end == len(got)
    sizes = {len(cut) for cut in expected}
    assert len(sizes) > 100  # the trials differ


def test_decisions_have_the_bits_of_select(module, tmp_path, record_property):
    arrays, trials, expected = random_trials()
    report = run_node(module, tmp_path, arrays, trials)
    record_property("seconds", report["seconds"])
    check_cuts(tmp_path, report, expected)


@pytest.mark.skipif(chromium.PROGRAM is None, reason="chromium is not installed")
@pytest.mark.skipif(
    importlib.util.find_spec("playwright") is None, reason="playwright is not installed"
)
def test_decisions_in_a_worker_of_a_page_have_the_bits_of_select(
    module, browser, tmp_path, record_property
):
    arrays, trials, expected = random_trials()
    report = run_chromium(browser, module, tmp_path, arrays, trials)
    record_property("seconds", report["seconds"])
    check_cuts(tmp_path, report, expected)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_pages_are_decoded_to_the_same_bits(module, tmp_path, degree):
    gaussians = random_gaussians(np.random.default_rng(degree), 300, degree)
    offset = np.array([0, 0, 50, 51, 178, 300], np.int64)
    codec = codec_of("quantized", degree)
    words = _core.encode_page(gaussians.rows, offset).view(np.uint32)
    damaged = words.copy()
    damaged[-12:] = 0x7F800000  # makes the ranges infinite
    arrays = Arrays()
    page = {"offset": arrays.add(offset), "bytes": arrays.add(words.view(np.uint8))}
    trials = {
        "bundles": [],
        "scenes": [],
        "pages": [{**page, "degree": degree}],
        "damaged": {**page, "bytes": arrays.add(damaged.view(np.uint8)), "degree": degree},
    }
    report = run_node(module, tmp_path, arrays, trials)
    got = (tmp_path / "rows.bin").read_bytes()
    assert got[:16] == _core.blake2b([words.view(np.uint8)])[0]
    decoded = vars(codec.rounded(gaussians, offset))
    names = ("means", "quats", "scales", "opacities", "sh")
    assert got[16:] == b"".join(decoded[name].tobytes() for name in names)
    assert report["refused"].endswith("of a page has invalid ranges")


def test_the_module_is_small(module):
    assert len(gzip.compress(module.read_bytes(), 9)) < 300_000
