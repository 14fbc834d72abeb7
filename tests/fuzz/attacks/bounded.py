"""Sends SIGKILL at random moments of a build of several files that do not fit in
memory, otherwise like kills.py.

Afterwards the file is missing, unchanged or complete, and a continued build gives the
same bytes as one that was not interrupted. The program sets a small memory limit, and
hence small units, so that small files are built like those of a city.
"""

import sys

import numpy as np

import v3dg
from fuzz.attacks import kills
from random_bundle import random_gaussians

LIMIT_S = kills.LIMIT_S

PROGRAM = """
import v3dg
from v3dg.levels import build_file, leaves_on_disk, whole
whole.UNIT_LEAVES = 400
sizes = leaves_on_disk._Sizes(in_memory=0, in_block=1 << 16, in_node=700, in_bucket=300)
leaves_on_disk._Sizes.of = lambda *_: sizes
config = v3dg.BuildConfig(cluster_size=32, steps=200, first_steps=200, num_views=16)
files = ["asset.ply", "tile_1.ply", "tile_2.ply"]
try:
    build_file(files, "out.v3dg", config=config, device="cpu", progress=False, resume=True)
except ValueError as error:
    raise SystemExit(f"v3dg: error: {error}")
"""


def prepare(shared):
    for seed, name in enumerate(("asset.ply", "other.ply", "tile_1.ply", "tile_2.ply")):
        v3dg.write_asset(shared / name, random_gaussians(np.random.default_rng(seed), 1200, 1))


class Attack(kills.Attack):
    kinds, weights = (
        {"build in bounded memory": ([sys.executable, "-c", PROGRAM], "out.v3dg")},
        (1,),
    )
    files = ("tile_1.ply", "tile_2.ply")
