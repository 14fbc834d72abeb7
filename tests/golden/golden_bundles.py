"""Two small bundles, one in each version of the format; run it to write them, once and never again."""

from pathlib import Path

from random_bundle import random_bundle


def path_of(version):
    return Path(__file__).parent / f"bundle_{version}.v3dg"


def bundles():
    for codec in ("float32", "quantized"):
        yield random_bundle(11, sh_degree=3, max_cluster=3, max_fan=2, config={"by": "golden"}, codec=codec)


if __name__ == "__main__":
    for version, bundle in enumerate(bundles(), start=1):
        bundle.write(path_of(version))
