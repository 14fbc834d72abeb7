"""The hash of a bundle's header and tables, as defined in docs/format.md."""

import hashlib

PIECE = 16384


def blake2b(message):
    return hashlib.blake2b(message, digest_size=16).digest()


def file_hash(message, version=3):
    if version < 3:
        return blake2b(message)
    return blake2b(
        b"".join(blake2b(message[at : at + PIECE]) for at in range(0, len(message), PIECE))
    )
