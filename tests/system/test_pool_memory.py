"""The host memory of a process during a flight with a pool."""

import json
import subprocess
import sys

import numpy as np

from random_bundle import random_gaussians
from scenes_lod import lod_bundle

MIB = 1 << 20
POOL, COPIES = 16 * MIB, 12
SCRIPT = """
import json, re, sys
import numpy as np
import v3dg

def anonymous():
    with open("/proc/self/status") as file:
        return int(re.search(r"RssAnon:\\s*(\\d+)", file.read())[1]) << 10

memory = None if sys.argv[1] == "none" else int(sys.argv[1])
scene = v3dg.Scene()
bundles = v3dg.Bundle.open_all(sys.argv[2:])
scene.add(bundles, [(4.0 * k, 0, 0) for k in range(len(bundles))])
def camera(x):
    return v3dg.Camera.look_at((x, -7, 2), (x, 0, 0), (0, 0, 1), width=96, height=64)
# What threads and libraries take, once.
v3dg.render(scene, camera(-1000.0), memory="1MB", device="cpu")
before, most = anonymous(), 0
renderer = v3dg.Renderer(scene, memory=memory, device="cpu")
for x in [*range(0, 4 * len(bundles), 2), *range(4 * len(bundles), 0, -3)]:
    renderer.settle(camera(x), tolerance=0.5)
    image = renderer.render(camera(x), tolerance=0.5)
    most = max(most, anonymous())
print(json.dumps({"held": most - before, "pages": int(image.stats.missing)}))
"""


def held(memory, paths):
    command = [sys.executable, "-c", SCRIPT, str(memory), *map(str, paths)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)["held"]


def test_a_flight_holds_no_more_than_the_pool_and_tables(tmp_path):
    rng = np.random.default_rng(0)
    bundle = lod_bundle(rng, random_gaussians(rng, 20_000, sh_degree=3), 128)
    paths = [tmp_path / f"{k}.v3dg" for k in range(COPIES)]
    for path in paths:
        bundle.write(path)
    all_of_it = COPIES * bundle.page_bytes
    assert all_of_it > 5 * POOL
    frames = 12 * MIB  # room for pictures, cuts, and memory that the allocator keeps
    assert held("none", paths) > all_of_it
    assert held(POOL, paths) < POOL + frames
