"""Recognises the format of a file by its first bytes, for any file name."""

import contextlib
import os
import zipfile
import zlib
from typing import NamedTuple

from v3dg import _files
from v3dg.formats import ksplat, splat
from v3dg.formats._reading import AnyPath, listed

_START_BYTES = ksplat.HEADER_BYTES
_UNPACKED_BYTES = 64  # bytes of a gzip that are decompressed to recognise its content
_MAX_ZIP_NAMES = 4096  # number of names in a zip that are examined

# The suffix of the reader for a format, by the first bytes of a file.
_BY_START = {
    b"ply\n": ".ply",
    b"ply\r": ".ply",
    b"NGSP": ".spz",
    b"glTF": ".glb",
    b"#usda ": ".usda",
    b"PXR-USDC": ".usdc",
}
# First bytes, in lower case, of files that no reader supports, and descriptions of
# these files. A `.splat` may begin with any bytes, so each entry is long enough not to
# occur by chance.
_NOT_READ = {
    b"version https://git-lfs": "a Git LFS pointer instead of the file; run git lfs pull",
    b"<!doctype html": "a web page; download the file itself",
    b"<html": "a web page; download the file itself",
    b"<?xml": "an XML text",
    b"\x89png": "a picture",
    b"\xff\xd8\xff\xe0": "a picture",
    b"\xff\xd8\xff\xe1": "a picture",
    b"\x80\x02\x8a\nl\xfc\x9cf": (
        "a checkpoint of torch before 1.6; save it again with a newer torch"
    ),
    b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive; unpack it",
    b"rar!\x1a\x07": "a RAR archive; unpack it",
}


class Content(NamedTuple):
    """The kind of a file.

    Attributes:
        suffix: The suffix that selects the reader, or an empty text if there is none.
        text: A phrase for messages. It says what the file is and, if no reader supports
            it, what to do.
    """

    suffix: str
    text: str


def content_of(path: AnyPath) -> Content | None:
    """Return the kind of a file's content. Return None if the first bytes do not show
    it or cannot be read.

    A few kilobytes are read. For a zip, the list of names is read, too.
    """
    # The exceptions of zipfile and zlib for damaged content are not documented. After
    # any of them, the reader for the file's name reports the error.
    with contextlib.suppress(Exception):
        with open(_files.open_regular(path), "rb") as file:
            num_bytes = os.fstat(file.fileno()).st_size
            start = file.read(_START_BYTES)
            if start.startswith(b"PK\3\4"):
                return _zip_content(zipfile.ZipFile(file).namelist()[:_MAX_ZIP_NAMES])
        if start.startswith(b"\x1f\x8b"):
            return _gzip_content(start)
        content = _plain_content(start)
        if content is None and splat.is_start_of_one(start, num_bytes):
            return Content(".splat", "a .splat")
        return content
    return None


def _plain_content(start: bytes) -> Content | None:
    for magic, suffix in _BY_START.items():
        if start.startswith(magic):
            return Content(suffix, f"a {suffix}")
    if ksplat.is_start_of_one(start):
        return Content(".ksplat", "a .ksplat")
    lowered = start.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for magic, text in _NOT_READ.items():
        if lowered.startswith(magic):
            return Content("", text)
    header_bytes = int.from_bytes(start[:8], "little")
    if start[8:10] == b'{"' and header_bytes < 1 << 32:
        return Content("", "a file of safetensors, such as a bundle (.v3dg)")
    return None


def _gzip_content(start: bytes) -> Content | None:
    unpacked = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, _UNPACKED_BYTES)
    if unpacked.startswith(b"NGSP"):
        return Content(".spz", "a .spz")
    inner = _plain_content(unpacked)
    if inner is None or not inner.suffix:
        return None
    return Content("", f"a gzip of {inner.text}; unpack it")


def _zip_content(names: list[str]) -> Content:
    parts = [name for name in names if not name.startswith("__MACOSX/")]
    ends = {name.rsplit("/", 1)[-1] for name in parts}
    if "data.pkl" in ends:
        return Content(".pt", "a checkpoint of torch")
    if "meta.json" in ends or "lod-meta.json" in ends:
        return Content(".sog", "a .sog")
    if parts and parts[0].endswith((".usda", ".usdc", ".usd")):
        return Content(".usdz", "a .usdz")
    return Content("", f"a zip of {listed(parts) or 'nothing'}; unpack it")
