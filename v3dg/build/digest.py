"""The digest of an asset: docs/format.md has the definition."""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from v3dg.bundle.format import page_hash
from v3dg.gaussians import Gaussians

PIECE = 1 << 16
"""Gaussians that are read, examined and hashed at a time; the digest of an asset depends on it."""


def digest_of(asset: Gaussians) -> str:
    """What tells an asset from others, wherever it was read from."""
    pieces = pieces_of(asset.numpy())
    with new_pool() as pool:
        # A few are less work than starting threads, which Python does not do safely where memory runs out.
        return digest_of_hashes(pool.map(hash_of, pieces) if len(pieces) > 3 else map(hash_of, pieces))


def pieces_of(gaussians: Gaussians) -> list[Gaussians]:
    """Pieces of them, sharing their memory."""
    return [gaussians.subset(slice(start, start + PIECE)) for start in range(0, len(gaussians), PIECE)]


def hash_of(piece: Gaussians) -> bytes:
    return page_hash(vars(piece).values())


def digest_of_hashes(hashes: Iterable[bytes]) -> str:
    """Of those of the pieces, so that all cores share the work."""
    return page_hash([np.frombuffer(b"".join(hashes), np.uint8)]).hex()


def new_pool() -> ThreadPoolExecutor:
    """Threads to hash and copy with."""
    return ThreadPoolExecutor(min(os.cpu_count() or 1, 16))
