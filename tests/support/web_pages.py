"""Web pages for tests that draw given cuts with the renderer for browsers."""

import base64
import contextlib
import hashlib
import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import chromium
from v3dg import export
from v3dg.bundle.format import HASH_BYTES, hash_of_pieces

WEB = Path(export.__file__).parent / "web"
# Marks for tests that draw in Chromium.
NEEDS = [
    pytest.mark.skipif(chromium.PROGRAM is None, reason="chromium is not installed"),
    pytest.mark.skipif(
        importlib.util.find_spec("playwright") is None, reason="playwright is not installed"
    ),
    pytest.mark.skipif(
        not (WEB / "core.wasm").is_file(),
        reason="the core for web pages is not compiled: python csrc/wasm/build.py",
    ),
]
# These arguments make Chromium use WebGPU in software.
ARGUMENTS = [
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    # Without these, Chromium cannot show what WebGPU draws on a canvas.
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
]

PAGE = """<!doctype html>
<meta charset="utf-8" />
<title>renderer</title>
<canvas id="canvas"></canvas>
<script type="module" src="draw.js"></script>
"""
SCRIPT = """
import { BundleFile } from "./web/bundle_file.js";
import { Core } from "./web/core.js";
import { layOut } from "./web/layout.js";
import { Renderer } from "./web/renderer.js";
import { Source } from "./web/source.js";

const code = await (await fetch("web/core.wasm")).arrayBuffer();
const core = await Core.load(code);
const canvas = document.getElementById("canvas");
const renderer = await Renderer.create(canvas, 2 ** 27);
let end = 0;

async function load(name) {
  const source = new Source(new URL(name, location.href).href);
  const bundle = await BundleFile.open(source, () => Core.load(code));
  const places = new Float64Array(bundle.numPages);
  const pages = await bundle.readPages(0, bundle.numPages);
  pages.forEach((bytes, page) => {
    bundle.verify(core, page, bytes);
    places[page] = end;
    renderer.writePage(end, bytes);
    end += bytes.length;
  });
  return { bundle, places };
}

window.drawCut = async ({ bundles, instances, cut, camera, background }) => {
  end = 0;
  const loaded = [];
  for (const name of bundles) loaded.push(await load(name));
  const placed = {
    bundle: Int32Array.from(instances.bundle),
    positions: Float64Array.from(instances.positions),
    quaternions: Float64Array.from(instances.quaternions),
    scales: Float64Array.from(instances.scales),
    factors: instances.factors === null ? null : Float32Array.from(instances.factors),
  };
  const selection = {
    instance: Int32Array.from(cut.instance),
    cluster: Int32Array.from(cut.cluster),
    weight: cut.weight === null ? null : Float32Array.from(cut.weight),
  };
  const files = loaded.map(({ bundle }) => bundle);
  const places = loaded.map((one) => one.places);
  renderer.setCut(layOut(selection, files, places, placed));
  const begin = performance.now();
  const picture = await renderer.pictureOf(camera, placed, background);
  const seconds = (performance.now() - begin) / 1000;
  let text = "";
  const bytes = new Uint8Array(picture.buffer);
  for (let k = 0; k < bytes.length; k += 32768) {
    text += String.fromCharCode(...bytes.subarray(k, k + 32768));
  }
  return { picture: btoa(text), seconds, count: renderer.cut.count };
};
window.isReady = true;
"""


@contextlib.contextmanager
def chromium_with_webgpu():
    """Start Chromium with WebGPU in software."""
    from playwright.sync_api import sync_playwright

    arguments = [*chromium.ARGUMENTS, *ARGUMENTS]
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium.PROGRAM, args=arguments)
        yield browser
        browser.close()


def header_of(data):
    """Return the header in the bytes of a bundle's file, and its end."""
    start = 8 + int.from_bytes(data[:8], "little")
    return json.loads(data[8:start]), start


def renew_hash(data):
    """Set the hash of a bundle's header and tables, in the bytes of its file."""
    header, start = header_of(data)
    tables = start + header["pages"]["data_offsets"][1]
    message = bytes(data[:start]) + bytes(data[tables:-HASH_BYTES])
    data[-HASH_BYTES:] = hash_of_pieces(message)


def spoil_page(data, page):
    """Make the ranges of a page infinite, with correct hashes, in the bytes of a
    bundle's file."""
    header, start = header_of(data)

    def table(name, dtype):
        first, end = (start + place for place in header[name]["data_offsets"])
        return np.frombuffer(memoryview(data)[first:end], dtype)

    starts = [*table("pages.offset", np.int64), header["pages"]["shape"][0]]
    page %= len(starts) - 1
    first, end = starts[page : page + 2]
    words = np.frombuffer(memoryview(data)[start + first : start + end], np.uint32)
    words[-12:] = 0x7F800000
    digest = hashlib.blake2b(words.tobytes(), digest_size=HASH_BYTES).digest()
    table("pages.hash", np.uint8)[HASH_BYTES * page :][:HASH_BYTES] = list(digest)
    renew_hash(data)


def write_page(folder):
    """Write the web page that drawing() opens to a folder."""
    shutil.copytree(WEB, folder / "web")
    (folder / "index.html").write_text(PAGE)
    (folder / "draw.js").write_text(SCRIPT)


def pinhole_of(camera):
    """Return a camera for the modules of the page."""
    return {
        "viewmat": np.asarray(camera.viewmat, np.float64).ravel().tolist(),
        "k": np.asarray(camera.K, np.float64).ravel().tolist(),
        "near": camera.near,
        "width": camera.width,
        "height": camera.height,
    }


def drawing(page, scene, names, cut, camera, background=(0.0, 0.0, 0.0)):
    """Return the picture of a cut, (H, W, 3), and the report of the page. `names` are
    the files of the scene's bundles, which are in the folder of the page."""
    weights = cut.given_weights
    factors = scene.factors
    report = page.evaluate(
        "(spec) => window.drawCut(spec)",
        {
            "bundles": names,
            "instances": {
                "bundle": scene.instance_bundle.tolist(),
                "positions": np.asarray(scene.positions).ravel().tolist(),
                "quaternions": np.asarray(scene.quaternions).ravel().tolist(),
                "scales": np.asarray(scene.scales).tolist(),
                "factors": None if factors is None else factors.ravel().tolist(),
            },
            "cut": {
                "instance": cut.instance_ids.tolist(),
                "cluster": cut.cluster_ids.tolist(),
                "weight": None if weights is None else weights.tolist(),
            },
            "camera": pinhole_of(camera),
            "background": list(background),
        },
    )
    data = np.frombuffer(base64.b64decode(report.pop("picture")), np.float32)
    return data.reshape(camera.height, camera.width, 4)[..., :3], report
