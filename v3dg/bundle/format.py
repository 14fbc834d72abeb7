"""Defines the parts of a bundle file: tables, header and hashes. docs/format.md gives
the reasons."""

import hashlib
import json
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._json import JsonObject
from v3dg._numbers import check, check_type

if TYPE_CHECKING:
    from v3dg.bundle.codec import Codec
    from v3dg.bundle.pages import PageLayout

FORMAT = "v3dg"
VERSION = 3  # the newest version, in which files are written
HASH_BYTES = 16
# A header has 20 entries and the config. A longer one is damaged or malicious.
MAX_HEADER_BYTES = 1 << 20

DTYPES = {"I64": "<i8", "F32": "<f4", "I32": "<i4", "U8": "|u1"}
SCHEMA: tuple[tuple[str, str, str, tuple[int, ...]], ...] = (
    # Each row has a name, a safetensors dtype, the number of rows (C clusters, C+1, G
    # groups, P pages), and the remaining shape. The order is that of the file. Wide
    # types come first, so that each table is aligned to its own type.
    ("clusters.offset", "I64", "C+1", ()),
    ("pages.offset", "I64", "P", ()),
    ("pages.bytes", "I64", "P", ()),
    ("clusters.level", "I32", "C", ()),
    ("clusters.own_group", "I32", "C", ()),
    ("clusters.parent_group", "I32", "C", ()),
    ("clusters.box", "F32", "C", (2, 3)),
    ("clusters.filter_px2", "F32", "C", ()),
    ("groups.ball", "F32", "G", (4,)),
    ("groups.weight", "F32", "G", ()),
    ("groups.parent", "I32", "G", ()),
    ("groups.level", "I32", "G", ()),
    ("groups.error", "F32", "G", (2,)),
    ("pages.first_cluster", "I32", "P", ()),
    ("pages.num_clusters", "I32", "P", ()),
    ("clusters.antialiased", "U8", "C", ()),
    ("pages.hash", "U8", "P", (HASH_BYTES,)),
)


# Tables that only float32 files have. For quantised files, they follow from the other
# tables.
_ONLY_OF_FLOATS = ("pages.bytes", "pages.num_clusters")


class Entry(TypedDict):
    """The entry of a tensor in the header, as defined by safetensors."""

    dtype: str
    shape: list[int]
    data_offsets: list[int]


def schema_of(codec: "Codec") -> list[tuple[str, str, str, tuple[int, ...]]]:
    """Return the tables of a file whose pages have this codec."""
    return [table for table in SCHEMA if codec.name == "float32" or table[0] not in _ONLY_OF_FLOATS]


def page_tables(layout: "PageLayout", codec: "Codec") -> dict[str, NDArray[np.generic]]:
    """Return all tables of the pages except the hashes. They follow from the page
    layout and the codec."""
    tables: dict[str, NDArray[np.generic]] = {
        "pages.offset": offset_of(layout.page_bytes(codec))[:-1],
        "pages.bytes": np.diff(layout.first_gaussian) * codec.gaussian_bytes,
        "pages.first_cluster": layout.first_cluster[:-1].astype(np.int32),
        "pages.num_clusters": np.diff(layout.first_cluster).astype(np.int32),
    }
    return {name: tables[name] for name, *_ in schema_of(codec) if name in tables}


def offset_of(sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (N + 1,) the start of each of N consecutive parts of these sizes, then the
    end of the last part."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)])


def page_hash(pieces: Iterable[NDArray[np.generic]]) -> bytes:
    """Return the BLAKE2b-128 hash of the concatenated bytes of arrays."""
    digest = hashlib.blake2b(digest_size=HASH_BYTES)
    for piece in pieces:
        digest.update(piece.reshape(-1).view(np.uint8).data)
    return digest.digest()


def hash_of_pieces(message: bytes) -> bytes:
    """Return the BLAKE2b-128 hash of a message. The message is divided into pieces,
    which are hashed in parallel. The result is the hash of their hashes."""
    data = np.frombuffer(message, np.uint8)
    size = _core.HASH_PIECE_BYTES
    digests = _core.blake2b(np.split(data, range(size, len(data), size)))
    return hashlib.blake2b(b"".join(digests), digest_size=HASH_BYTES).digest()


def entries_of(
    codec: "Codec", num_clusters: int, num_groups: int, num_pages: int, pages_bytes: int
) -> dict[str, Entry]:
    """Return the entries of the header: dtype, shape and position of each tensor, in
    the order of the file."""
    num_rows = {"C": num_clusters, "C+1": num_clusters + 1, "G": num_groups, "P": num_pages}
    tensors = [("pages", "U8", [pages_bytes])]
    for name, dtype, rows, row_shape in schema_of(codec):
        tensors.append((name, dtype, [num_rows[rows], *row_shape]))
    tensors.append(("hash", "U8", [HASH_BYTES]))
    entries: dict[str, Entry] = {}
    start = 0
    for name, dtype, shape in tensors:
        end = start + math.prod(shape) * np.dtype(DTYPES[dtype]).itemsize
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
        start = end
    return entries


def header_of(entries: dict[str, Entry], codec: "Codec", config: JsonObject) -> bytes:
    """Return the header: its length and its JSON, padded with spaces so that the data
    is aligned.

    Raises:
        ValueError: The config is so long that the header exceeds `MAX_HEADER_BYTES`.
    """
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "sh_degree": str(codec.sh_degree),
        "codec": codec.name,
        "config": config_to_json(config),
    }
    text = json.dumps(
        {"__metadata__": metadata, **entries}, sort_keys=True, separators=(",", ":")
    ).encode()
    text += b" " * (-(8 + len(text)) % codec.alignment)
    expected = f"at most {MAX_HEADER_BYTES} bytes of JSON in the header, which includes it"
    check("config", len(text) <= MAX_HEADER_BYTES, f"{expected}, got {len(text)}; shorten it")
    return len(text).to_bytes(8, "little") + text


def config_to_json(config: JsonObject) -> str:
    """Return the config as JSON. Raise TypeError unless it is a dict, and ValueError if
    JSON cannot represent a value."""
    check_type("config", config, dict, "a dict")
    try:
        return json.dumps(config, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"config: expected values that JSON can represent, got {error}") from None
