"""What a bundle file is made of: its tables, its header, its hashes. docs/format.md says why."""

import hashlib
import json
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._numbers import check, check_type

if TYPE_CHECKING:
    from v3dg.bundle.codec import Codec
    from v3dg.bundle.pages import PageLayout

FORMAT = "v3dg"
VERSION = 3  # the newest, which is written
HASH_BYTES = 16
MAX_HEADER_BYTES = 1 << 20  # the header holds 20 entries and the config; more is damage or an attack

DTYPES = {"I64": "<i8", "F32": "<f4", "I32": "<i4", "U8": "|u1"}
SCHEMA: tuple[tuple[str, str, str, tuple[int, ...]], ...] = (
    # name, safetensors dtype, rows (C clusters, C+1, G groups, P pages), rest of the shape. In file order:
    # wide types first, so that every table is aligned to its own type.
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


_ONLY_OF_FLOATS = ("pages.bytes", "pages.num_clusters")  # of codes they follow from the others


def schema_of(codec: "Codec") -> list[tuple[str, str, str, tuple[int, ...]]]:
    """The tables of a file with pages of this codec."""
    return [table for table in SCHEMA if codec.name == "float32" or table[0] not in _ONLY_OF_FLOATS]


def page_tables(layout: "PageLayout", codec: "Codec") -> dict[str, NDArray[Any]]:
    """The tables of the pages except the hashes; all follow from what is in each page."""
    tables = {
        "pages.offset": offset_of(layout.page_bytes(codec))[:-1],
        "pages.bytes": np.diff(layout.first_gaussian) * codec.gaussian_bytes,
        "pages.first_cluster": layout.first_cluster[:-1].astype(np.int32),
        "pages.num_clusters": np.diff(layout.first_cluster).astype(np.int32),
    }
    return {name: tables[name] for name, *_ in schema_of(codec) if name in tables}


def offset_of(sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N + 1,) where each of N parts that lie one after another begins, and the end of the last."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)])


def page_hash(pieces: Iterable[NDArray[Any]]) -> bytes:
    """BLAKE2b-128 of the bytes of the pieces, one after another."""
    digest = hashlib.blake2b(digest_size=HASH_BYTES)
    for piece in pieces:
        digest.update(piece.reshape(-1).view(np.uint8).data)
    return digest.digest()


def hash_of_pieces(message: bytes) -> bytes:
    """BLAKE2b-128 of the digests of the message's pieces, which are hashed side by side."""
    data, size = np.frombuffer(message, np.uint8), _core.HASH_PIECE_BYTES
    digests = _core.blake2b(np.split(data, range(size, len(data), size)))
    return hashlib.blake2b(b"".join(digests), digest_size=HASH_BYTES).digest()


def entries_of(
    codec: "Codec", num_clusters: int, num_groups: int, num_pages: int, pages_bytes: int
) -> dict[str, Any]:
    """Every tensor of the file, in file order, as the header describes it."""
    rows = {"C": num_clusters, "C+1": num_clusters + 1, "G": num_groups, "P": num_pages}
    tables = ((name, dtype, [rows[count], *rest]) for name, dtype, count, rest in schema_of(codec))
    entries: dict[str, Any] = {}
    end = 0
    for name, dtype, shape in (("pages", "U8", [pages_bytes]), *tables, ("hash", "U8", [HASH_BYTES])):
        start, end = end, end + math.prod(shape) * np.dtype(DTYPES[dtype]).itemsize
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
    return entries


def header_of(entries: dict[str, Any], codec: "Codec", config: dict[str, Any]) -> bytes:
    """The length and the JSON, filled up with spaces so that the data starts aligned."""
    metadata = {"format": FORMAT, "version": str(VERSION), "sh_degree": str(codec.sh_degree)}
    metadata |= {"codec": codec.name, "config": config_to_json(config)}
    text = json.dumps({"__metadata__": metadata, **entries}, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % codec.alignment)
    found = f"{len(metadata['config'])}; shorten it"
    check("config", len(text) <= MAX_HEADER_BYTES, f"at most {MAX_HEADER_BYTES} bytes of JSON, got {found}")
    return len(text).to_bytes(8, "little") + text


def config_to_json(config: dict[str, Any]) -> str:
    """The text that a bundle keeps of its config; TypeError or ValueError where JSON cannot hold it."""
    check_type("config", config, dict, "a dict")
    try:
        return json.dumps(config, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"config: expected values that JSON can hold, got {error}") from None
