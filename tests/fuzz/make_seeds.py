"""Write the files that the fuzzers start from: one small example of each kind.

    python tests/fuzz/make_seeds.py FOLDER

makes FOLDER/ply, FOLDER/bundle and so on. What fuzzing found beyond them is kept in tests/fuzz/corpus.
"""

import gzip
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "support"))

from fuzz.targets import META_IN_SOG, SOG, zipped
from random_bundle import random_bundle, random_gaussians
from test_ply import HOSTILE, Element, ply_bytes, random_columns
from v3dg.io import write_asset

LARGEST_SEED = 10_000  # bytes; a few of the broken files are made to be large


def ply_seeds():
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        for degree in (0, 1):
            columns = random_columns(2, degree)
            with_list = {"n": [np.arange(2, dtype="i4")] * 2, **columns}
            wide = {name: column.astype("f8") for name, column in columns.items()}
            face = Element("face", {"indices": [np.arange(3, dtype="u2")]})
            yield ply_bytes([Element("vertex", columns)], encoding)
            yield ply_bytes([Element("vertex", wide)], encoding, "\r\n")
            yield ply_bytes([face, Element("vertex", with_list), face], encoding)
    yield from (content for content, _ in HOSTILE.values() if len(content) <= LARGEST_SEED)


def bundle_seeds():
    path = Path("seed.v3dg")
    for seed, num_levels, degree in ((0, 0, 0), (1, 1, 1), (2, 2, 0), (3, 3, 0)):
        bundle = random_bundle(
            seed, num_levels=num_levels, sh_degree=degree, max_cluster=2, config={"seed": seed}
        )
        bundle.write(path)
        yield path.read_bytes()
    path.unlink()


def scene_seeds():
    pose = {"position": [1, 2, 3], "quaternion": [1, 0, 0, 0.5], "scale": 2}
    matrix = [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]
    size = {"width": 64, "height": 48}
    scene = {
        "format": "v3dg-scene",
        "version": 1,
        "bundles": {"a": "a.v3dg", "b": "sub/b.v3dg"},
        "instances": [{"bundle": "a", **pose}, {"bundle": "b", "position": [0, 0, 0]}],
        "cameras": [
            {"name": "eye", **size, "eye": [0, -8, 2], "target": [0, 0, 0], "up": [0, 0, 1], "fov_x": 1},
            {"name": "matrices", **size, "near": 0.1, "viewmat": matrix, "K": np.diag([50, 50, 1]).tolist()},
        ],
    }
    flat = {
        "name": "Sea",
        "asset": "a",
        "convention": "camera to world",
        "instances": [pose],
        "cameras": [{"name": "0", **size, "fov_x": 0.8, "fov_y": 0.6, "transform_matrix": matrix}],
    }
    camera = {"camera_name": "0", "camera_width": 64, "camera_height": 48, "transform_matrix": matrix}
    angles = {"camera_angle_x": 0.8, "camera_angle_y": 0.6}
    instance = {"positions": [1, 2, 3], "quaternions": [1, 0, 0, 0], "scale": 2}
    asset = {"asset_kind": "k", "asset_name": "a", "ply_suffix": "p/fused.ply", "instances": [instance]}
    layouts = {"layouts": [{"layout_name": "0", "assets": [asset], "cameras": [{**camera, **angles}] * 2}]}
    frames = [{"file_path": f"{i}.png", "transform_matrix": matrix} for i in range(2)]
    lens = {"camera_model": "OPENCV", "fl_x": 50, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48, "k1": 0}
    documents = (scene, flat, layouts, {**lens, "frames": frames}, {**angles, "frames": frames})
    yield from (json.dumps(document).encode() for document in documents)


def format_seeds():
    path = Path("seed")
    for kind, suffix in ((0, ".compressed.ply"), (2, ".spz")):
        for degree in (0, 1):
            file = path.with_suffix(suffix)
            write_asset(file, random_gaussians(np.random.default_rng(degree), 3, degree))
            content = file.read_bytes()
            file.unlink()
            yield bytes([kind]) + content
            if suffix == ".spz":
                yield bytes([3]) + gzip.decompress(content)
    yield bytes([1]) + bytes(range(64))
    yield bytes([META_IN_SOG - 1]) + zipped(SOG)
    yield bytes([META_IN_SOG]) + SOG["meta.json"]
    yield bytes([META_IN_SOG + 1]) + SOG["shN_centroids.webp"]


SEEDS = {"ply": ply_seeds, "bundle": bundle_seeds, "scene": scene_seeds, "formats": format_seeds}


def main():
    folder = Path(sys.argv[1])
    for name, seeds in SEEDS.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for i, content in enumerate(seeds()):
            (folder / name / f"seed_{i:02}").write_bytes(content)


if __name__ == "__main__":
    main()
