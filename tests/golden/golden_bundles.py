"""Small bundles of each version of the format. Running this file writes those of the
newest version; this is done only once per version."""

from pathlib import Path

from random_bundle import random_bundle


def path_of(version, codec):
    name = f"bundle_{version}.v3dg" if version < 3 else f"bundle_{version}_{codec}.v3dg"
    return Path(__file__).parent / name


def bundle_of(codec):
    return random_bundle(
        11, sh_degree=3, max_cluster=3, max_fan=2, config={"by": "golden"}, codec=codec
    )


if __name__ == "__main__":
    for codec in ("float32", "quantized"):
        bundle_of(codec).write(path_of(3, codec))
