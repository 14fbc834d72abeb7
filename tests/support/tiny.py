"""Runs v3dg and benchmarks with tiny worlds and builds, so that the commands in the
documentation can be executed."""

import sys
from dataclasses import replace

import v3dg
from benchmarks import __main__ as benchmarks
from benchmarks import worlds
from v3dg import cli, demo, levels

WORLDS = {
    "donut_sea": {"instances": 12, "num_gaussians": 1000},
    "forest": {"instances": 8, "num_gaussians": 1700},
    "temples": {"instances": 2, "num_gaussians": 5000},
    "crowd": {"instances": 4, "num_gaussians": 2000, "persons": 1},
}
# Options that are added to commands whose default sizes would take long.
OPTIONS = {
    "demo": ["--gaussians", "1000", "--instances", "20", "--size", "64", "64"],
    "compare": ["--size", "64", "64"],
}


def shrink(set_attribute=setattr, set_item=dict.__setitem__):
    """Make worlds tiny for any requested size, and skip the fits of levels."""

    def tiny(make, arguments):
        return lambda **given: make(**arguments, seed=given.get("seed", 0))

    for name, arguments in WORLDS.items():
        make = tiny(worlds.WORLDS[name], arguments)
        set_attribute(worlds, name, make)
        set_item(worlds.WORLDS, name, make)

    def quickly(build_whole):
        def build_quickly(*what, config=None, **options):
            quick = replace(config or levels.BuildConfig(), steps=0)
            return build_whole(*what, config=quick, **{"progress": False, **options})

        return build_quickly

    bundle_quickly = quickly(levels.build_bundle)
    file_quickly = quickly(levels.build_file)
    for module in (v3dg, levels, demo):
        set_attribute(module, "build_bundle", bundle_quickly)
    for module in (levels, worlds):
        set_attribute(module, "build_file", file_quickly)


if __name__ == "__main__":
    shrink()
    program, *arguments = sys.argv[1:]
    if program == "benchmarks":
        sys.exit(benchmarks.PROGRAM.main(arguments))
    # the server runs until it is interrupted, so only its options are checked
    if arguments[0] == "view":
        cli.parse(arguments)
        sys.exit()
    views = ["--views", "2"]  # a scene has no turntable, so the option is left out
    if arguments[0] != "compare" or any(argument.endswith(".json") for argument in arguments):
        views = []
    sys.exit(cli.main([*arguments, *OPTIONS.get(arguments[0], []), *views]))
