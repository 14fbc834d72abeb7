"""Every value in the JSON of every kind of file is replaced by values of other types.
Each changed file is read, or its reader refuses it with a ValueError of one line that
begins with the file's name.
"""

import copy
import dataclasses
import json
import struct
import zipfile

import numpy as np
import pytest

import v3dg
from fuzz.attacks.good_files import good_files, streamed
from gltf_files import file_of_every_part
from random_bundle import random_gaussians
from v3dg._json import is_one_line

# placeholder for a value that JSON writes with 5,000 digits
LONG = "a number of 5,000 digits"
ODD = [[], [26], [[]], [None], {}, {"a": 1}, None, True, False, "", "a", "0", "\x1b[31m", LONG]
ODD += [
    0,
    1,
    -1,
    2,
    0.5,
    -0.0,
    1e300,
    -1e300,
    1e-320,
    26,
    5121,
    1 << 31,
    1 << 63,
    -(1 << 63),
    10**400,
]
ERRORS = (ValueError, FileNotFoundError)


def places(value):
    """Yield every value in a document, as its container and its key."""
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        # The numbers of a long table are alike, so only some are exchanged.
        keys = list(range(len(value))) if len(value) < 20 else [0, 1, len(value) - 1]
    else:
        keys = []
    for key in keys:
        yield value, key
        yield from places(value[key])


def variants(document):
    """Yield documents in which one value is exchanged or missing, with a description of
    the change."""
    yield from ((odd, f"top level: {odd!r:.60}") for odd in ODD)
    document = copy.deepcopy(document)
    for holder, key in list(places(document)):
        value = holder[key]
        for odd in ODD:
            if odd is not value:
                holder[key] = odd
                yield document, f"{key}: {value!r:.60} became {odd!r:.60}"
        holder[key] = value
        if isinstance(holder, dict):
            del holder[key]
            yield document, f"{key}: left out"
            holder[key] = value


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file: its document, how a changed document is written, and how the file
    is read."""

    document: object
    write: object
    read: object
    path: object


def glb_kind(folder, compressed):
    from v3dg.formats import gltf

    path = folder / "a.glb"
    content = gltf.encode(random_gaussians(np.random.default_rng(0), 5, 1), compressed=compressed)
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])

    def write(text):
        text = text.encode() + b" " * (-len(text) % 4)
        rest = content[20 + size :]
        header = struct.pack(
            "<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A
        )
        path.write_bytes(header + text + rest)

    return Kind(document, write, read_both, path)


def gltf_kind(folder):
    file = file_of_every_part()
    path = folder / "a.gltf"
    (folder / "a.bin").write_bytes(file.blob)
    file.write(path, "a.bin")
    return Kind(json.loads(path.read_text()), path.write_text, read_both, path)


def sog_kind(folder):
    from v3dg.formats import sog

    path = folder / "a.sog"
    files = sog.encode(random_gaussians(np.random.default_rng(0), 5, 1))
    document = json.loads(files.pop("meta.json"))

    def write(text):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("meta.json", text)
            for name, picture in files.items():
                archive.writestr(name, picture)

    return Kind(document, write, read_both, path)


def json_kind(folder, good, read):
    for name, content in good.files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    path = folder / good.name
    return Kind(json.loads(good.content), path.write_text, read, path)


def read_cameras(path):
    v3dg.read_cameras(path, size=(64, 48), applied_transform="undo")


def read_both(path):
    """Read the parts of a file that commands look at first, and then the gaussians."""
    from v3dg.io import open_asset

    notes = open_asset(path).declared.notes
    assert all(len(note) < 200 and is_one_line(note) for note in notes), notes
    return v3dg.read_asset(path)


KINDS = [
    "gltf",
    "glb",
    "glb of spz",
    "sog",
    "sog_folder",
    "streamed",
    "scene 0",
    "scene 1",
    "scene 2",
]
KINDS += ["cameras 0", "cameras 1", "cameras 2"]


@pytest.fixture(params=KINDS)
def kind(request, tmp_path):
    if request.param == "gltf":
        return gltf_kind(tmp_path)
    if request.param.startswith("glb"):
        return glb_kind(tmp_path, "spz" in request.param)
    if request.param == "sog":
        return sog_kind(tmp_path)
    (tmp_path / "made").mkdir()
    name, _, number = request.param.partition(" ")
    good = (
        streamed(1) if name == "streamed" else good_files(tmp_path / "made")[name][int(number or 0)]
    )
    read = {"scene": v3dg.read_scene, "cameras": read_cameras}.get(name, read_both)
    return json_kind(tmp_path, good, read)


# read_both also reads data that cause warnings
@pytest.mark.filterwarnings("ignore::v3dg.cleaning.AssetWarning")
def test_every_value_of_another_kind_is_named(kind):
    faults = []
    for document, change in variants(kind.document):
        kind.write(json.dumps(document).replace(json.dumps(LONG), "-" + "9" * 5000))
        try:
            kind.read(kind.path)
        except ERRORS as error:
            text = str(error)
            if not (kind.path.name in text or kind.path.parent.name in text) or not is_one_line(
                text
            ):
                faults.append(f"{change}: {text:.200}")
        except Exception as error:
            faults.append(f"{change}: {type(error).__name__}: {error!s:.200}")
    assert not faults, "\n".join([f"{len(faults)} faults", *faults[:20]])
