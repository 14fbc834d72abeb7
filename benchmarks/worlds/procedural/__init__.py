"""Generated 3DGS assets, which are made from a seed and need no download.

Gaussians are distributed as in trained assets: flat ones cover surfaces, needles follow
thin parts, sizes and opacities vary widely, and the colours of glossy and translucent
parts depend on the view.
"""

from benchmarks.worlds.procedural.donut import make_donut
from benchmarks.worlds.procedural.person import make_person
from benchmarks.worlds.procedural.room import make_room
from benchmarks.worlds.procedural.temple import make_temple
from benchmarks.worlds.procedural.toadstools import make_asset, place_field
from benchmarks.worlds.procedural.tree import TREE_KINDS, make_tree

__all__ = [
    "TREE_KINDS",
    "make_asset",
    "make_donut",
    "make_person",
    "make_room",
    "make_temple",
    "make_tree",
    "place_field",
]
