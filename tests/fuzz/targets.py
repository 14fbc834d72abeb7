"""Readers, with the conditions that must hold for any input. They are used for inputs
that fuzzers kept and for zips of all inputs."""

import gzip
import io
import itertools
import json
import struct
import zipfile
from pathlib import Path

import numpy as np

from file_hash import blake2b, file_hash
from random_bundle import random_bundle, random_gaussians
from v3dg._json import is_one_line
from v3dg.bundle import Bundle
from v3dg.camera_file import read_cameras
from v3dg.formats import sog
from v3dg.io import open_asset, read_asset
from v3dg.scene.file import read_scene

BUNDLES = {"a": random_bundle(0), "a.v3dg": random_bundle(1), "sub/b.v3dg": random_bundle(2)}


def read_ply(content, folder):
    path = put(folder / "fuzz.ply", content)
    with only_errors_that_name(path):
        asset = read_asset(path)
        assert len(asset) == open_asset(path).num_gaussians <= len(content)


def read_bundle(content, folder):
    """The hashes detect nearly every change of a file, so it is also read with
    corrected hashes."""
    for data in (content, with_fitting_hashes(content)):
        path = put(folder / "fuzz.v3dg", data)
        with only_errors_that_name(path):
            bundle = Bundle.open(path)
            assert 4 * (11 + 3 * (bundle.sh_degree + 1) ** 2) * bundle.num_gaussians <= len(data)
            bundle.info()
            assert len(bundle.gaussians) == bundle.num_gaussians


def read_json(content, folder):
    path = put(folder / "fuzz.json", content)
    with only_errors_that_name(path.name):
        read_scene(path, bundles=BUNDLES)
    with only_errors_that_name(path.name):
        read_cameras(path, size=(64, 48))


def read_format(content, folder):
    """The first byte determines the format, and whether the rest is a whole file or the
    content of its compressed part."""
    suffix, packed = FORMATS[content[0] % len(FORMATS)] if content else FORMATS[0]
    path = put(folder / f"fuzz{suffix}", packed(content[1:]))
    with only_errors_that_name(path):
        asset = read_asset(path)
        assert len(asset) == open_asset(path).num_gaussians
        # the limit in docs/robustness.md
        assert len(asset) <= (1 << 18) + path.stat().st_size


def zip_bytes(entries, compression=zipfile.ZIP_STORED):
    """Return a zip of names and contents; a name may occur twice."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, content in entries:
            # zipfile would warn about a second entry of this name
            archive.NameToInfo.pop(name, None)
            archive.writestr(zipfile.ZipInfo(name), content, compression)
    return stream.getvalue()


def small_sog():
    """Return the files of a SOG whose tables have only four values, so that most
    changes affect something else."""
    files = sog.encode(random_gaussians(np.random.default_rng(0), 3, sh_degree=1))
    meta = json.loads(files["meta.json"])
    for name in ("scales", "sh0", "shN"):
        meta[name]["codebook"] = meta[name]["codebook"][:4]
    return files | {"meta.json": json.dumps(meta).encode()}


SOG = small_sog()
FORMATS = (
    (".ply", bytes),
    (".splat", bytes),
    (".spz", bytes),
    (".spz", lambda body: gzip.compress(body, mtime=0)),
    (".sog", bytes),
    (".sog", lambda meta: zip_bytes((SOG | {"meta.json": meta}).items())),
    (".sog", lambda picture: zip_bytes((SOG | {"shN_centroids.webp": picture}).items())),
    (".gltf", bytes),
)
READERS = {"ply": read_ply, "bundle": read_bundle, "scene": read_json, "formats": read_format}


def put(path, content):
    Path(path).write_bytes(content)
    return path


class only_errors_that_name:
    """Let the block end with the errors that a reader may raise: one line that begins
    with the name."""

    def __init__(self, name):
        self.name = name

    def __enter__(self):
        return self

    def __exit__(self, kind, error, _):
        if kind is None or not issubclass(kind, ValueError | FileNotFoundError):
            return False
        assert str(error).startswith(f"{self.name}: "), error
        assert is_one_line(str(error)), error
        return True


def parts_of(data):
    """Return the header and its end, and from there the ends of the pages and of the
    file's hash; None if the file is too short."""
    start = 8 + int.from_bytes(data[:8], "little")
    try:
        header = json.loads(data[8:start])
        ends = [header[name]["data_offsets"][1] for name in ("pages", "hash")]
        is_inside = {int} == set(map(type, ends)) and 0 <= ends[0] < ends[1] <= len(data) - start
        return (header, start, *ends) if is_inside else None
    except Exception:  # the file may have any kind of damage
        return None


def with_fitting_hashes(data):
    """Return the file with corrected hashes of its pages and of itself, as far as its
    header allows."""
    data = bytearray(data)
    try:
        header, start, pages_end, hash_end = parts_of(data)
        offsets, hashes = (
            slice(*(start + offset for offset in header[name]["data_offsets"]))
            for name in ("pages.offset", "pages.hash")
        )
        ends = [*struct.unpack(f"<{len(data[offsets]) // 8}q", data[offsets]), pages_end]
        pages = [data[start + first : start + last] for first, last in itertools.pairwise(ends)]
        fitting = b"".join(map(blake2b, pages))
        if len(fitting) == len(data[hashes]):
            data[hashes] = fitting
        covered = data[:start] + data[start + pages_end : start + hash_end - 16]
        version = int(header["__metadata__"]["version"])
        data[start + hash_end - 16 : start + hash_end] = file_hash(covered, version)
    except Exception:  # the header is damaged, so the pages cannot be found
        pass
    return bytes(data)
