"""Web servers that send wrong data, do not stop sending, stop too early, or redirect,
and commands that read files from them.

Whatever a server does, a command has to end soon, with a correct result or one line
that says what is wrong. It must not read more from the server than it requested, use
little memory, leave nothing in the folder for temporary files, and print no password
and no signature. The number of a try selects the server from `BEHAVIOURS`, in order.
"""

import contextlib
import gzip
import json
import os
import re
import signal
import socket
import struct
import sys
import threading
import time

import numpy as np

import v3dg
from fuzz.attacks.program import fault_of, outcome, run
from random_bundle import random_gaussians
from v3dg.bundle import format as file_format
from v3dg.bundle.codec import Codec

LIMIT_S = 100
SOON_S = 60
PATIENCE_S = 3  # in seconds; shorter than in the package, so that a round takes minutes
MOST_UNKNOWN_BYTES = 16 << 20  # smaller than in the package
# bytes that may be sent in addition to the file: data in buffers of sockets, for
# several requests
MOST_SENT = 12 << 20
MOST_MEGABYTES = 500
MOST_ADDRESSES = 6 << 30
# If endless data arrives instead of the rest of a file, only the timeout ends it. The
# data is not stored.
OUTSIDE_OF_BODIES = ("100 without end", "chunk's extension without end", "trailers without end")
SECRETS = ("hunter2", "s1gnature", "Zm9v")
TB = 1 << 40

PROGRAM = f"""
import sys
from v3dg._urls import http, opened
http.PATIENCE_S = {PATIENCE_S}
opened._MOST_UNKNOWN_BYTES = {MOST_UNKNOWN_BYTES}
from v3dg.cli import main
sys.exit(main())
"""


class Connection:
    """A connection of a client, and the requests on it."""

    def __init__(self, server, stream):
        self.server = server
        self.stream = stream
        self._buffer = b""

    def request(self):
        """Return the method, path and headers of the next request; None at the end."""
        while b"\r\n\r\n" not in self._buffer:
            data = self.stream.recv(65536)
            if not data:
                return None
            self._buffer += data
        head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        self.method, self.path, _ = first.split(" ", 2)
        self.headers = {
            name.lower(): value.strip() for name, _, value in (x.partition(":") for x in lines)
        }
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("range", ""))
        self.part = (int(match[1]), int(match[2]) + 1) if match else None
        self.server.requests.append((self.path, self.headers))
        return self

    def send(self, data):
        self.stream.sendall(data)
        self.server.sent += len(data)

    def head(self, status, **headers):
        lines = [
            f"HTTP/1.1 {status}",
            *(f"{name.replace('_', '-')}: {value}" for name, value in headers.items()),
        ]
        self.send("\r\n".join([*lines, "", ""]).encode("latin-1"))

    def answer(self, status, body=b"", **headers):
        self.head(status, Content_Length=len(body), **headers)
        if self.method != "HEAD":
            self.send(body)

    def good(self, **headers):
        """Respond like a correct server."""
        body = self.server.body
        if self.part and self.part[0] < len(body):
            first, last = self.part[0], min(self.part[1], len(body))
            place = f"bytes {first}-{last - 1}/{len(body)}"
            self.answer("206 Partial Content", body[first:last], Content_Range=place, **headers)
        else:
            self.answer("200 OK", body, **headers)

    def endless(self, piece=bytes(65536)):
        while not self.server.is_closed:
            self.send(piece)

    def drip(self, data, pause=0.5):
        for place in range(len(data)):
            if self.server.is_closed:
                return
            self.send(data[place : place + 1])
            time.sleep(pause)

    def reset(self):
        self.stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        raise ConnectionAbortedError

    def range_head(self, **headers):
        first, last = self.part
        place = f"bytes {first}-{last - 1}/{len(self.server.body)}"
        self.head("206 Partial Content", **{"Content_Range": place, **headers})


class Server:
    def __init__(self, body, behaviour):
        self.body, self._behaviour = body, behaviour
        self.sent, self.requests, self.is_closed = 0, [], False
        self._socket = socket.create_server(("127.0.0.1", 0), backlog=64)
        self.port = self._socket.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while not self.is_closed:
            with contextlib.suppress(OSError):
                stream, _ = self._socket.accept()
                threading.Thread(target=self._serve, args=(stream,), daemon=True).start()

    def _serve(self, stream):
        with stream, contextlib.suppress(OSError, ValueError):
            connection = Connection(self, stream)
            while not self.is_closed and connection.request():
                self._behaviour(connection)

    def close(self):
        self.is_closed = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


# ---- Behaviours of servers. `at_get` responds to HEAD correctly, and behaves otherwise
# in all other requests.
def at_get(behaviour):
    return lambda c: c.good() if c.method == "HEAD" else behaviour(c)


def always(status, **headers):
    return lambda c: c.answer(status, b"no", **headers)


def raw(data, then=None):
    def behaviour(c):
        c.send(data)
        if then:
            then(c)
        c.stream.close()

    return behaviour


def claims(length):
    def behaviour(c):
        c.head("200 OK" if not c.part else "206 Partial Content", Content_Length=length)
        if c.method != "HEAD":
            c.endless()

    return behaviour


def claims_honest_parts(length):
    """The server claims another size of the file, but sends the requested parts."""

    def behaviour(c):
        if not c.part:
            c.head("200 OK", Content_Length=length)
            return
        first, last = c.part
        body = c.server.body[first:last].ljust(last - first, b"\0")
        c.answer("206 Partial Content", body, Content_Range=f"bytes {first}-{last - 1}/{length}")

    return behaviour


def then_close(behaviour):
    def closing(c):
        behaviour(c)
        c.stream.close()

    return closing


def range_with(endless=False, shift=0, **headers):
    def behaviour(c):
        if c.part is None:
            c.good()
            return
        first, last = c.part
        c.range_head(**headers)
        c.send(c.server.body[first + shift : last + shift])
        if endless:
            c.endless()
        c.stream.close()

    return at_get(behaviour)


def endless_error(status):
    def behaviour(c):
        c.head(status)
        if c.method != "HEAD":
            c.endless(b"no " * 20000)
        c.stream.close()

    return behaviour


def bomb(encoding):
    packed = gzip.compress(bytes(64 << 20))

    def behaviour(c):
        c.range_head(Content_Encoding=encoding, Content_Length=len(packed))
        c.send(packed)

    return at_get(behaviour)


def redirect_to(place, status="302 Found"):
    return lambda c: c.answer(status, b"", Location=place(c) if callable(place) else place)


def chain(length):
    def behaviour(c):
        number = int((re.search(r"hop=(\d+)", c.path) or [0, "0"])[1])
        if number >= length:
            c.good()
        else:
            c.answer("307 Temporary Redirect", b"", Location=f"/x.v3dg?hop={number + 1}")

    return behaviour


def to_localhost(c):
    if c.headers["host"].startswith("localhost"):
        c.good()
    else:
        c.answer(
            "302 Found", b"", Location=f"http://localhost:{c.server.port}{c.path.partition('?')[0]}"
        )


def chunked(*chunks, end=b"0\r\n\r\n", endless=None):
    def behaviour(c):
        c.range_head(Transfer_Encoding="chunked") if c.part else c.head(
            "200 OK", Transfer_Encoding="chunked"
        )
        for chunk in chunks:
            c.send(chunk)
        if endless:
            c.endless(endless)
        c.send(end)
        c.stream.close()

    return at_get(behaviour)


def of_unknown_size(body=None, endless=False):
    """The server supports neither HEAD requests nor ranges, and sends no size."""

    def behaviour(c):
        if c.method == "HEAD":
            c.answer("405 Method Not Allowed")
            return
        c.head("200 OK", Connection="close")
        c.send(c.server.body if body is None else body)
        if endless:
            c.endless()
        c.stream.close()

    return behaviour


def drips(c):
    c.range_head(Content_Length=c.part[1] - c.part[0]) if c.part else c.head(
        "200 OK", Content_Length=len(c.server.body)
    )
    c.drip(c.server.body)


def half(c, then):
    body = c.server.body
    c.range_head(Content_Length=c.part[1] - c.part[0]) if c.part else c.head(
        "200 OK", Content_Length=len(body)
    )
    first, last = c.part or (0, len(body))
    c.send(body[first : (first + last) // 2])
    then(c)


def waits(c):
    while not c.server.is_closed:
        time.sleep(0.05)


def changing(c):
    """Every request gets other bytes of the same size."""
    turned = bytes(255 - value for value in c.server.body[4096:])
    body, c.server.body = c.server.body, c.server.body[:4096] + turned
    c.good()
    c.server.body = c.server.body if len(c.server.requests) % 2 else body


def without_parts(c):
    c.part = None
    c.good()


def parts_then_none(c):
    if c.part and c.part[0] > 0:
        c.part = None
    c.good()


def forged(num_clusters, pages_bytes):
    """The server sends the header of a bundle with tables of any size."""
    entries = file_format.entries_of(Codec(0), num_clusters, 1, 1, pages_bytes)
    header = file_format.header_of(entries, Codec(0), {})
    size = len(header) + entries["hash"]["data_offsets"][1]

    def behaviour(c):
        if not c.part:
            c.head("200 OK", Content_Length=size)
            return
        first, last = c.part
        body = header[first:last].ljust(last - first, b"\0")
        c.answer("206 Partial Content", body, Content_Range=f"bytes {first}-{last - 1}/{size}")

    return behaviour


def damaged(place, data):
    def behaviour(c):
        body = c.server.body
        c.server.body = body[:place] + data + body[place + len(data) :]
        c.good()

    return behaviour


def tagged(c):
    c.good(ETag=f'"{len(c.server.requests)}"')


ENDLESS_HEADER = b"HTTP/1.1 200 OK\r\n"
RIGHT, WRONG, EITHER = "right", "wrong", "either"

# The behaviours of servers. Each has the kind of file that is requested, the expected
# end, and the function.
BEHAVIOURS = {
    "honest": ("v3dg", RIGHT, lambda c: c.good()),
    "honest asset": ("ply", RIGHT, lambda c: c.good()),
    "no parts": ("v3dg", RIGHT, without_parts),
    "unknown size": ("ply", RIGHT, of_unknown_size()),
    "unknown size of a bundle": ("v3dg", RIGHT, of_unknown_size()),
    "unknown size without end": ("ply", WRONG, of_unknown_size(endless=True)),
    "unknown size, nothing": ("ply", WRONG, of_unknown_size(b"")),
    "claims 4 TB": ("v3dg", WRONG, claims(4 * TB)),
    "claims 4 TB of an asset": ("ply", WRONG, claims(4 * TB)),
    "claims 4 TB, honest parts": ("v3dg", WRONG, claims_honest_parts(4 * TB)),
    "claims 2^62": ("v3dg", WRONG, claims_honest_parts(1 << 62)),
    "claims 10^30": ("v3dg", WRONG, claims(10**30)),
    "claims less than nothing": ("v3dg", WRONG, claims(-5)),
    "claims no number": ("v3dg", WRONG, claims("many")),
    "claims two sizes": (
        "v3dg",
        WRONG,
        raw(b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\nContent-Length: 9\r\n\r\n"),
    ),
    "claims nothing": ("v3dg", WRONG, claims_honest_parts(0)),
    "claims 7": ("v3dg", WRONG, claims_honest_parts(7)),
    "claims 100 000": ("v3dg", WRONG, claims_honest_parts(100_000)),
    "asset longer than said": ("ply", WRONG, at_get(claims(TB))),
    "asset without end": ("ply", WRONG, at_get(of_unknown_size(endless=True))),
    "asset shorter than said": (
        "ply",
        WRONG,
        at_get(lambda c: c.answer("200 OK", c.server.body[:900])),
    ),
    "asset ends early": ("ply", WRONG, at_get(lambda c: half(c, lambda c: c.stream.close()))),
    "forged tables of 1 GB": ("v3dg", WRONG, forged(20_000_000, 0)),
    "forged tables of 4 TB": ("v3dg", WRONG, forged(50_000_000_000, 2 * TB)),
    "forged tables of 2 TB": ("v3dg", WRONG, forged(10_000_000_000, TB)),
    "forged pages of 4 TB": ("v3dg", WRONG, forged(1, 4 * TB)),
    "header of 2^60": ("v3dg", WRONG, damaged(0, struct.pack("<Q", 1 << 60))),
    "header of a megabyte": ("v3dg", WRONG, damaged(0, struct.pack("<Q", 1 << 20))),
    "damaged page": ("v3dg render", WRONG, damaged(8200, b"\xff" * 64)),
    "part without end": ("v3dg", WRONG, range_with(endless=True)),
    "part longer than asked": ("v3dg", WRONG, range_with(endless=True, Content_Length=TB)),
    "part of another place": ("v3dg", WRONG, range_with(Content_Range="bytes 5-1028/90000")),
    "part without a place": ("v3dg", WRONG, range_with(Content_Range="")),
    "part of a strange place": ("v3dg", WRONG, range_with(Content_Range="bytes 9-1/x")),
    "part of 10^30": ("v3dg", WRONG, range_with(Content_Range=f"bytes 0-{10**30}/{10**30}")),
    "part of another size": ("v3dg", WRONG, range_with(Content_Range="bytes 0-1023/4398046511104")),
    "parts in MIME": (
        "v3dg",
        WRONG,
        range_with(Content_Range="", Content_Type="multipart/byteranges; boundary=x"),
    ),
    "shifted parts": ("v3dg", WRONG, range_with(shift=3)),
    "416": ("v3dg", WRONG, at_get(always("416 Range Not Satisfiable"))),
    "parts, then none": ("v3dg", WRONG, parts_then_none),
    "whole without end": ("v3dg", WRONG, at_get(of_unknown_size(endless=True))),
    "changing content": ("v3dg", WRONG, changing),
    "changing tags": ("v3dg", RIGHT, tagged),
    "gzip bomb": ("v3dg", WRONG, bomb("gzip")),
    "deflate bomb": ("v3dg", WRONG, bomb("deflate")),
    "br": ("v3dg", WRONG, bomb("br")),
    "gzip twice": ("v3dg", WRONG, bomb("gzip, gzip")),
    "identity": ("v3dg", RIGHT, lambda c: c.good(Content_Encoding="identity")),
    "gzip at once": ("ply", WRONG, lambda c: c.good(Content_Encoding="gzip")),
    **{
        f"status {status}": ("v3dg", WRONG, always(f"{status} \x1b[31mhunter2"))
        for status in (204, 206, 304, 400, 401, 403, 404, 410, 418, 429, 500, 503, 504, 999)
    },
    "404 without end": ("v3dg", WRONG, endless_error("404 Not Found")),
    "500 without end": ("v3dg", WRONG, endless_error("500 Internal Server Error")),
    "100 without end": (
        "v3dg",
        WRONG,
        raw(b"", lambda c: c.endless(b"HTTP/1.1 100 Continue\r\n\r\n" * 99)),
    ),
    "reset": ("v3dg", WRONG, lambda c: c.reset()),
    "reset of the body": ("v3dg", WRONG, at_get(lambda c: half(c, Connection.reset))),
    "closed": ("v3dg", WRONG, raw(b"")),
    "closed in the head": ("v3dg", WRONG, raw(b"HTTP/1.1 200 OK\r\nContent-Le")),
    "never answers": ("v3dg", WRONG, waits),
    "never answers to GET": ("ply", WRONG, at_get(waits)),
    "stops in the middle": ("ply", WRONG, at_get(lambda c: half(c, waits))),
    "drips the head": ("v3dg", WRONG, lambda c: c.drip(b"HTTP/1.1 200 OK\r\nX: " + b"x" * 9999)),
    "drips a part": ("v3dg", WRONG, at_get(drips)),
    "drips an asset": ("ply", WRONG, at_get(drips)),
    "redirects to itself": ("v3dg", WRONG, redirect_to(lambda c: c.path)),
    "redirects 5 times": ("v3dg", RIGHT, chain(5)),
    "redirects 30 times": ("v3dg", WRONG, chain(30)),
    "redirects slowly": ("v3dg", WRONG, lambda c: (time.sleep(1), redirect_to("/y.v3dg")(c))),
    "redirects to another host": ("v3dg", RIGHT, to_localhost),
    "redirects to a file": ("v3dg", WRONG, redirect_to("file:///etc/passwd")),
    "redirects to ftp": ("v3dg", WRONG, redirect_to("ftp://127.0.0.1/x.v3dg")),
    "redirects to nowhere": ("v3dg", WRONG, redirect_to("")),
    "redirects to nonsense": ("v3dg", WRONG, redirect_to("http://[::/\x00?sig=s1gnature")),
    "redirects with a password": (
        "v3dg",
        WRONG,
        redirect_to("http://me:hunter2@127.0.0.1:1/x.v3dg?sig=s1gnature"),
    ),
    "redirects far": ("v3dg", WRONG, redirect_to("/" + "x" * 500_000)),
    "header without end": ("v3dg", WRONG, raw(ENDLESS_HEADER, lambda c: c.endless(b"x" * 65536))),
    "headers without end": (
        "v3dg",
        WRONG,
        raw(ENDLESS_HEADER, lambda c: c.endless(b"X: y\r\n" * 9999)),
    ),
    "cookies": ("v3dg", RIGHT, lambda c: c.good(Set_Cookie="sig=s1gnature; Domain=127.0.0.1")),
    "NUL in the head": (
        "v3dg",
        WRONG,
        raw(b"HTTP/1.1 200 OK\r\nX\0: \0\r\nContent-Length: 5\r\n\r\n"),
    ),
    "no HTTP": ("v3dg", WRONG, raw(bytes(range(256)) * 40)),
    "no HTTP without end": ("v3dg", WRONG, raw(b"", lambda c: c.endless(b"SSH-2.0-x"))),
    "HTTP/0.9": ("v3dg", WRONG, raw(b"<html>hunter2</html>")),
    "chunk of 2^64": ("v3dg", WRONG, chunked(b"ffffffffffffffff\r\n", endless=bytes(65536))),
    "chunk without a size": ("v3dg", WRONG, chunked(b"zz\r\nabc\r\n")),
    "chunk's extension without end": ("v3dg", WRONG, chunked(b"5;", endless=b"x=y;" * 9999)),
    "chunks without end": ("v3dg", WRONG, chunked(endless=b"10\r\n" + bytes(16) + b"\r\n")),
    "trailers without end": (
        "v3dg",
        WRONG,
        chunked(b"5\r\nabcde\r\n0\r\n", endless=b"X: y\r\n" * 9999),
    ),
    "no last chunk": ("v3dg", WRONG, chunked(b"5\r\nabcde\r\n", end=b"")),
    "killed": ("ply kill", EITHER, at_get(lambda c: half(c, waits))),
    "interrupted": ("ply interrupt", EITHER, at_get(lambda c: half(c, waits))),
}


def prepare(shared):
    asset = random_gaussians(np.random.default_rng(0), 2000, 1)
    v3dg.write_asset(shared / "x.ply", asset)
    config = v3dg.BuildConfig(steps=0, cluster_size=64)
    v3dg.build_bundle(asset, config=config, device="cpu", progress=False).write(shared / "x.v3dg")


class Attack:
    number = 0

    def __init__(self, shared):
        self._bodies = {end: (shared / f"x.{end}").read_bytes() for end in ("ply", "v3dg")}

    def plan(self, rng, work):
        name = list(BEHAVIOURS)[self.number % len(BEHAVIOURS)]
        subject, _, behaviour = BEHAVIOURS[name]
        kind, *how = subject.split()
        as_json = rng.random() < 0.5
        (work / "tmp").mkdir()

        def do():
            server = Server(self._bodies[kind], behaviour)
            try:
                url = f"http://me:hunter2@127.0.0.1:{server.port}/x.{kind}?sig=s1gnature&token=Zm9v"
                ended = run(
                    _command(how, url, as_json),
                    work,
                    limit_s=SOON_S,
                    meddle=_meddle(how),
                    program=[sys.executable, "-c", PROGRAM],
                    environment=os.environ | {"TMPDIR": str(work / "tmp")},
                    most=MOST_ADDRESSES,
                )
            finally:
                server.close()
            fault = None if "kill" in how else fault_of(ended, codes=(0, 1, 130))
            return outcome(ended, fault or _fault(ended, name, server, work, as_json))

        return name, do


def _command(how, url, as_json):
    if "render" in how:
        command = [
            "render",
            url,
            "--size",
            "16",
            "16",
            "--device",
            "cpu",
            "--tolerance",
            "0",
            "--quiet",
        ]
    else:
        command = ["info", url]
    return [*command, *(["--json"] if as_json else [])]


def _meddle(how):
    number = {"kill": signal.SIGKILL, "interrupt": signal.SIGINT}.get(how[0] if how else "")
    if number is None:
        return None

    def meddle(process, _):
        time.sleep(2.5)
        process.send_signal(number)

    return meddle


def _fault(ended, name, server, work, as_json):
    end = BEHAVIOURS[name][1]
    if secrets := [secret for secret in SECRETS if secret in ended.out + ended.err]:
        return f"printed {secrets}: {(ended.out + ended.err)[-200:]!a}"
    if left := os.listdir(work / "tmp"):
        return f"left {left}"
    if ended.megabytes > MOST_MEGABYTES:
        return f"held {ended.megabytes:.0f} MB"
    most = 2 * len(server.body) + MOST_SENT + (MOST_UNKNOWN_BYTES if ended.code else 0)
    if server.sent > most and name not in OUTSIDE_OF_BODIES:
        return f"took {server.sent} bytes"
    if leaked := [path for path, headers in server.requests if _is_leak(headers)]:
        return f"sent the password on: {leaked[0][:60]}"
    if end == RIGHT and ended.code != 0:
        return f"code {ended.code}: {ended.err[-200:]!a}"
    if end == WRONG and ended.code == 0:
        return f"believed it: {ended.out[:200]!a}"
    if "/proc/" in ended.err:
        return f"named another file: {ended.err[-200:]!a}"
    if ended.code == 0 and as_json and not json.loads(ended.out):
        return "no result"
    return None


def _is_leak(headers):
    return "authorization" in headers and headers.get("host", "").startswith("localhost")
