"""Computes the digest of an asset, which docs/format.md defines."""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from v3dg.bundle.format import page_hash
from v3dg.gaussians import Gaussians

PIECE = 1 << 16
"""Number of gaussians that are read, examined and hashed at a time. The digest of an
asset depends on this number."""


def digest_of(asset: Gaussians) -> str:
    """Return the digest of an asset. It does not depend on the format of its file."""
    pieces = pieces_of(asset.numpy())
    # Hashing a few pieces takes less time than starting threads, which can also fail
    # when memory is short.
    if len(pieces) <= 3:
        return digest_of_hashes(map(hash_of, pieces))
    with new_pool() as pool:
        return digest_of_hashes(pool.map(hash_of, pieces))


def pieces_of(gaussians: Gaussians) -> list[Gaussians]:
    """Divide gaussians into pieces, which share their memory."""
    return [
        gaussians.subset(slice(start, start + PIECE)) for start in range(0, len(gaussians), PIECE)
    ]


def hash_of(piece: Gaussians) -> bytes:
    return page_hash(vars(piece).values())


def digest_of_hashes(hashes: Iterable[bytes]) -> str:
    """Combine the hashes of all pieces, in order, to the digest of the asset. The
    hashes can be computed in parallel."""
    return page_hash([np.frombuffer(b"".join(hashes), np.uint8)]).hex()


def new_pool() -> ThreadPoolExecutor:
    """Return threads for hashing and copying."""
    return ThreadPoolExecutor(min(os.cpu_count() or 1, 16))
