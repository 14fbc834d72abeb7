"""Changes of files: of their bytes, and of the content of a compressed stream or a
zip."""

import gzip
import re
import struct
import zlib

from fuzz.attacks.good_files import zip_entries
from fuzz.mutations import changed_json
from fuzz.targets import parts_of, with_fitting_hashes, zip_bytes

INTEGERS = (
    0,
    1,
    2,
    3,
    0x7F,
    0x80,
    0xFF,
    0x100,
    0x7FFF,
    0xFFFF,
    1 << 16,
    1 << 20,
    (1 << 24) - 1,
    1 << 30,
)
INTEGERS += (
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    1 << 32,
    1 << 40,
    (1 << 63) - 1,
    1 << 63,
    (1 << 64) - 1,
)
FLOATS = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-38,
    1e-45,
    3e38,
    1e300,
    float("inf"),
    float("-inf"),
    float("nan"),
)
WORDS = (
    b"0",
    b"-1",
    b"4294967296",
    b"99999999999999999999",
    b"1e400",
    b"nan",
    b"-inf",
    b"",
    b"x" * 5000,
    b"\0",
    b"\xff",
)


def truncated(data, rng, _):
    return data[: rng.randrange(len(data) + 1)]


def grown(data, rng, _):
    count = rng.choice((1, 7, 4096, 100_000))
    return data + rng.choice(
        (bytes(count), rng.randbytes(count), (data * (1 + count // max(1, len(data))))[:count])
    )


def flipped(data, rng, _):
    out = bytearray(data)
    # Most decisions of a reader depend on the header, so many changes are there.
    reach = rng.choice((len(out), min(len(out), 64), min(len(out), 512)))
    for _ in range(rng.choice((1, 1, 2, 8, 64)) if out else 0):
        out[rng.randrange(reach)] ^= 1 << rng.randrange(8)
    return bytes(out)


def overwritten(data, rng, _):
    out = bytearray(data)
    start = rng.randrange(len(out) + 1)
    count = rng.choice((1, 4, 16, 256, len(out)))
    fill = rng.choice((b"\0", b"\xff", b"\x80", None))
    run = rng.randbytes(count) if fill is None else fill * count
    out[start : start + count] = run[: len(out) - start]
    return bytes(out)


def numbers_changed(data, rng, _):
    """Integers and floats at the usual places are replaced by extremes or
    multiplied."""
    out = bytearray(data)
    reach = rng.choice((len(out), min(len(out), 64), min(len(out), 512)))
    for _ in range(rng.choice((1, 1, 2, 4))):
        size = rng.choice((1, 2, 4, 4, 8))
        if reach < size:
            continue
        place = rng.randrange(reach - size + 1)
        place -= place % rng.choice((1, size))
        order = rng.choice(("little", "big"))
        old = int.from_bytes(out[place : place + size], order)
        new = rng.choice((*INTEGERS, old * 2, old * 1000, old + 1, old - 1, -old, old << 16)) % (
            1 << 8 * size
        )
        if size >= 4 and rng.random() < 0.2:
            number = rng.choice(FLOATS)
            is_wide = size == 8 or abs(number) > 3.4e38
            out[place : place + size] = struct.pack("<d" if is_wide else "<f", number)[:size]
        else:
            out[place : place + size] = new.to_bytes(size, order)
    return bytes(out)


def pieces_moved(data, rng, _):
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    piece = data[a:b]
    return rng.choice(
        (data[:a] + data[b:], data[:b] + piece + data[b:], data[:a] + piece[::-1] + data[b:], piece)
    )


def spliced(data, rng, other):
    cut, other_cut = rng.randrange(len(data) + 1), rng.randrange(len(other) + 1)
    if rng.random() < 0.5:  # the header of one file and the body of another
        cut = rng.choice((4, 8, 16, 64, 512)) % (len(data) + 1)
        other_cut = min(cut, len(other))
    return data[:cut] + other[other_cut:]


BYTES = (truncated, grown, flipped, overwritten, numbers_changed, pieces_moved, spliced)


def bytes_changed(data, rng, other):
    return rng.choice(BYTES)(data, rng, other)


def words_changed(data, rng, _):
    """Numbers and lines of a text are changed, such as those of the header of a .ply
    file."""
    lines = data.split(b"\n")
    end = next(
        (i for i, line in enumerate(lines) if line.startswith(b"end_header")), len(lines) - 1
    )
    for _ in range(rng.choice((1, 1, 2, 3))):
        i = rng.randrange(end + 1) if rng.random() < 0.8 else rng.randrange(len(lines))
        action = rng.randrange(6)
        if action == 0:
            lines[i] = b""
        elif action == 1:
            lines.insert(i, lines[rng.randrange(end + 1)])
        elif action == 2:
            lines[i], lines[rng.randrange(end + 1)] = lines[rng.randrange(end + 1)], lines[i]
        elif action == 3:
            lines[i] = re.sub(rb"\d+", lambda _: rng.choice(WORDS), lines[i], count=1)
        else:
            words = lines[i].split(b" ")
            words[rng.randrange(len(words))] = rng.choice(
                (*WORDS, b"uchar", b"double", b"list", b"int", b"element")
            )
            lines[i] = b" ".join(words)
    return b"\n".join(lines)


def document_changed(data, rng, _):
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = changed_json(data, rng)
    return data


def stream_changed(data, rng, other):
    """The content of a gzip stream is changed and compressed again."""
    try:
        body = gzip.decompress(data)
    except (OSError, EOFError, zlib.error):
        return bytes_changed(data, rng, other)
    return gzip.compress(bytes_changed(body, rng, other), rng.choice((0, 1, 9)), mtime=0)


def zip_changed(data, rng, other):
    """The entries of a zip are changed, or what its tables say about them."""
    entries = [(entry.filename, content) for entry, content in zip_entries(data)]
    i = rng.randrange(len(entries))
    name, content = entries[i]
    action = rng.randrange(9)
    if action <= 3:
        change = document_changed if name.endswith(".json") else bytes_changed
        entries[i] = (name, change(content, rng, other))
    elif action == 4:
        del entries[i]
    elif action == 5:
        entries.append((name, rng.choice(entries)[1]))
    elif action == 6:
        entries[i] = (
            rng.choice(
                (
                    *(n for n, _ in entries),
                    "",
                    "../x",
                    "/etc/passwd",
                    "a\\b",
                    "x" * 60_000,
                    "\u202e",
                )
            ),
            content,
        )
    elif action == 7:
        entries[i] = (name, rng.choice(entries)[1])
    else:
        return tables_changed(data, rng)
    return zip_bytes(entries, rng.choice((0, 0, 8)))


def tables_changed(data, rng):
    """Sizes, CRCs, methods and offsets are changed in the headers of a zip's entries
    and in its directory."""
    out = bytearray(data)
    # A signature, and the offsets and sizes of the fields after it.
    fields = {
        b"PK\1\2": (
            (6, 2),
            (8, 2),
            (10, 2),
            (16, 4),
            (20, 4),
            (24, 4),
            (28, 2),
            (30, 2),
            (32, 2),
            (42, 4),
        ),
        b"PK\3\4": ((4, 2), (6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2)),
        b"PK\5\6": ((4, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2)),
    }
    for _ in range(rng.choice((1, 1, 2, 3))):
        signature = rng.choice(list(fields))
        places = [m.start() for m in re.finditer(re.escape(signature), data)]
        field, size = rng.choice(fields[signature])
        place = rng.choice(places) + field
        old = int.from_bytes(out[place : place + size], "little")
        new = rng.choice((*INTEGERS, old + 1, old - 1, old * 2, 8, 12, 14, 99)) % (1 << 8 * size)
        out[place : place + size] = new.to_bytes(size, "little")[: len(out) - place]
    return bytes(out)


def bundle_changed(data, rng, other):
    """The header is changed as a document, or numbers in the tables are changed; the
    hashes are correct."""
    parts = parts_of(data)
    _, start, pages_end, hash_end = parts
    if rng.random() < 0.5:
        text = document_changed(data[8:start], rng, other)
        text += b" " * (-(8 + len(text)) % 4096)
        data = len(text).to_bytes(8, "little") + text + data[start:]
    else:
        out = bytearray(data)
        first, last = start + pages_end, start + hash_end - 20
        for _ in range(rng.randrange(1, 4)):
            kind, values = rng.choice(
                (("<i", (0, 1, 2, 3, -1, 4096, 1 << 30, -(1 << 31))), ("<f", FLOATS))
            )
            values = [v for v in values if kind == "<i" or not 3.4e38 < abs(v) < float("inf")]
            struct.pack_into(kind, out, rng.randrange(first, last) // 4 * 4, rng.choice(values))
        data = bytes(out)
    return with_fitting_hashes(data)


# Further changes of each kind of file, besides changes of its bytes.
OWN = {
    "ply": words_changed,
    "compressed": words_changed,
    "spz": stream_changed,
    "sog": zip_changed,
    "checkpoint": lambda data, rng, other: (zip_changed if data[:2] == b"PK" else bytes_changed)(
        data, rng, other
    ),
    "bundle": bundle_changed,
    "sog_folder": document_changed,
    "streamed": document_changed,
    "scene": document_changed,
    "cameras": document_changed,
}
