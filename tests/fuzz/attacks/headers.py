"""Requests to the viewer with wrong or unusual headers about where they come from.

A response has to be the web page, a connection, or a refusal that blames the client,
but never a server error. It tells browsers not to show it to other sites. A request is
only accepted if it names this machine and no other site. If a request is not HTTP, the
connection is closed without a response.
"""

import ipaddress
import os
import re
import socket

import numpy as np

import scenes_lod
from fuzz.attacks.pool import Outcome
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site

LIMIT_S = 60
_REQUESTS = 40  # number of requests in a try
_SECONDS = 20
_ANSWERS = (101, 200, 400, 403, 404, 426)
_LET_IN = (101, 200, 404)

_HOSTS = (
    "127.0.0.1:{port}",
    "localhost:{port}",
    "LOCALHOST",
    "[::1]:{port}",
    "127.8.7.6:9999",
    "[::1]",
)
_OTHER_HOSTS = (
    "evil.example",
    "[",
    "[]",
    "]",
    "[::1",
    "::1]",
    "[[::1]]",
    "127.0.0.1@evil.example",
    "",
)
_OTHER_HOSTS += (
    "evil.example@127.0.0.1",
    "127.0.0.1:evil",
    "[v1.a]",
    "[fe80::1%25eth0]",
    "2130706433",
    ":",
)
_OTHER_HOSTS += (
    "localhost.",
    "0x7f.1",
    "127.1",
    "[::ffff:127.0.0.1]",
    "192.0.2.1",
    "//127.0.0.1",
    "\\\\a",
)
_ORIGINS = ("http://{host}", "https://{host}", "HTTP://{host}")
_OTHER_ORIGINS = (
    "null",
    "",
    "http://",
    "http://[",
    "http://evil.example",
    "http://evil@{host}",
    "{host}",
)
_OTHER_ORIGINS += (
    "http://{host}.evil.example",
    "http://{host}/",
    "file://",
    "blob:http://{host}",
    "http://]",
)
_SITES = (
    "same-origin",
    "none",
    "same-site",
    "cross-site",
    "Same-Origin",
    "same-origin, none",
    "",
    "?1",
)
_MODES = ("navigate", "no-cors", "cors", "websocket", "same-origin", "nested-navigate", "")
_DESTINATIONS = (
    "document",
    "image",
    "script",
    "iframe",
    "frame",
    "embed",
    "object",
    "empty",
    "worker",
    "",
)
_PATHS = (
    "/",
    "/index.html",
    "/main.js",
    "/connection",
    "/photograph/0",
    "/thumbnail/0",
    "/?a=[",
    "//",
    "*",
)
_UPGRADE = (
    ("Upgrade", "websocket"),
    ("Connection", "Upgrade"),
    ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Key", "A" * 22 + "=="),
)
_BYTES = b"[]()%:@/\\?#. ,;=\"'\t\0\x01\x7f\x80\xc3\xa9\xff09azAZ-_~"
_HOST = re.compile(
    rb"(?:(localhost|127(?:\.[0-9]{1,3}){3})|\[([0-9a-f:.]+)\])(?::[0-9]{0,5})?", re.IGNORECASE
)


def prepare(shared):
    pass


class Attack:
    def __init__(self, shared):
        rng = np.random.default_rng(0)
        bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 300, size=0.5), 64)
        self._site = Site(SceneView(bundle, device="cpu"), port=0)

    def plan(self, rng, work):
        requests = [_request(rng, self._site.port) for _ in range(_REQUESTS)]
        is_silent_until = os.fstat(2).st_size

        def do():
            for path, headers in requests:
                answer = self._answer(path, headers)
                fault = _fault_of(answer, path, headers)
                if fault is None and os.fstat(2).st_size != is_silent_until:
                    fault = "expected nothing on stderr, got something"
                if fault:
                    told = f"{path!r} with {headers!r}"
                    return Outcome("fault", f"{fault}: {told}"[:600])
            return Outcome("answered")

        return "requests", do

    def _answer(self, path, headers):
        """Return everything that the server sends before it closes the connection or
        begins to describe the scene."""
        lines = [b"GET " + path + b" HTTP/1.1", *(name + b": " + value for name, value in headers)]
        with socket.create_connection(
            ("127.0.0.1", self._site.port), timeout=_SECONDS
        ) as connection:
            connection.sendall(b"\r\n".join(lines) + b"\r\n\r\n")
            said = b""
            while b"\r\n\r\n" not in said:
                part = connection.recv(1 << 16)
                if not part:
                    break
                said += part
        return said


def _request(rng, port):
    """Return a path and headers like those that a browser sends, with some of them
    exchanged, damaged, missing or repeated."""
    host = rng.choice(_HOSTS if rng.random() < 0.7 else _OTHER_HOSTS).format(port=port)
    headers = [("Host", host)]
    if rng.random() < 0.5:
        origin = rng.choice(_ORIGINS if rng.random() < 0.7 else _OTHER_ORIGINS)
        headers.append(("Origin", origin.format(host=host)))
    choices = {"Sec-Fetch-Site": _SITES, "Sec-Fetch-Mode": _MODES, "Sec-Fetch-Dest": _DESTINATIONS}
    for name, values in choices.items():
        if rng.random() < 0.6:
            headers.append((name, rng.choice(values[: rng.choice((1, 2, len(values)))])))
    if rng.random() < 0.3:
        headers += _UPGRADE
    raw = [(name.encode(), value.encode()) for name, value in headers]
    for _ in range(rng.choice((0, 1, 1, 2))):
        place = rng.randrange(len(raw))
        name, value = raw[place]
        action = rng.randrange(6)
        if action == 0:
            del raw[place]
            raw = raw or [(b"X", b"")]
        elif action == 1:
            raw.insert(rng.randrange(len(raw)), (name, rng.choice(raw)[1]))
        else:
            raw[place] = (name, _damaged(rng, value))
    path = rng.choice(_PATHS).encode()
    return (_damaged(rng, path).replace(b" ", b"") if rng.random() < 0.1 else path), raw


def _damaged(rng, value):
    """Return the text with a few bytes added, removed or changed, but no line ends,
    which would begin another header."""
    damaged = bytearray(value)
    for _ in range(rng.choice((1, 1, 2, 5))):
        place = rng.randrange(len(damaged) + 1)
        added = bytes(rng.choice(_BYTES) for _ in range(rng.choice((0, 1, 1, 3))))
        damaged[place : place + rng.choice((0, 0, 1, 4))] = added
    if rng.random() < 0.05:
        damaged *= rng.choice((2, 60, 4000))
    return bytes(damaged)


def _fault_of(answer, path, headers):
    """Return the fault of a response, or None."""
    if not answer:
        return None
    head = answer.partition(b"\r\n\r\n")[0].lower()
    status = int(answer[9:12])
    if status not in _ANSWERS:
        return f"expected one of {_ANSWERS}, got {status}"
    if head.count(b"\r\ncross-origin-resource-policy: same-origin") != 1:
        return f"expected an answer that other pages cannot show, got {status} without its policy"
    if status not in _LET_IN:
        return None
    fields = {}
    for name, value in headers:
        fields.setdefault(name.lower(), []).append(value.strip(b" \t"))
    (host,) = fields[b"host"] if len(fields.get(b"host", ())) == 1 else (b"",)
    if not _is_loopback(host):
        return f"expected a refusal of the host, got {status}"
    origins = (b"http://" + host.lower(), b"https://" + host.lower())
    if any(origin.lower() not in origins for origin in fields.get(b"origin", ())):
        return f"expected a refusal of the origin, got {status}"
    is_own = all(site in (b"same-origin", b"none") for site in fields.get(b"sec-fetch-site", ()))
    is_tab = fields.get(b"sec-fetch-mode") == [b"navigate"] and fields.get(b"sec-fetch-dest") == [
        b"document"
    ]
    is_page = path.partition(b"?")[0] in (b"/", b"/index.html") and status == 200
    if not is_own and not (is_tab and is_page):
        return f"expected a refusal of another site, got {status}"
    return None


def _is_loopback(host):
    match = _HOST.fullmatch(host)
    if match is None:
        return False
    name, address = match.groups()
    return bool(name) or ipaddress.ip_address(address.decode()).is_loopback
