"""Reads files from web servers, which may be hostile: the number of downloaded bytes,
the waiting time and the memory are limited to what a request needs.

aiohttp sends the requests on the event loop of fsspec, without compression. This module
follows redirects itself and checks each host before contacting it. Addresses are
checked again when a connection is made, because the name may have changed its address.
"""

import asyncio
import atexit
import base64
import contextlib
import os
import re
import socket
from collections.abc import AsyncIterator, Coroutine, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypedDict, TypeVar

from v3dg import _extras
from v3dg._urls.addresses import Reach, is_address, reach_of
from v3dg._urls.failures import DownloadError, status_error
from v3dg._urls.others import Write, changed, too_long

if TYPE_CHECKING:
    import ssl

    from aiohttp import ClientResponse, ClientSession, Fingerprint
    from aiohttp.abc import AbstractResolver, ResolveResult
    from yarl import URL

T = TypeVar("T")

PATIENCE_S = 30.0
"""Time limit in seconds until an answer begins, including redirects, and for each
`STEP_BYTES` of the answer."""

STEP_BYTES = 128 << 10

_MOST_REDIRECTS = 10
_REDIRECTS = (301, 302, 303, 307, 308)
_TAGS = ("ETag", "Last-Modified", "Content-MD5", "Digest")
_RANGE = re.compile(r"bytes (?:(\d{1,18})-(\d{1,18})|\*)/(?:(\d{1,18})|\*)")
_IDENTITY = {"Accept-Encoding": "identity"}


class _SessionOptions(TypedDict, total=False):
    """The options of aiohttp's sessions that users may set in fsspec."""

    headers: Mapping[str, str]
    trust_env: bool


class _RequestOptions(TypedDict, total=False):
    """The options of aiohttp's requests that users may set in fsspec."""

    headers: Mapping[str, str]
    ssl: "ssl.SSLContext | bool | Fingerprint"
    proxy: "str | URL | None"


class HttpFileSystem(Protocol):
    """The part of fsspec's web file system that this module uses; fsspec has no
    types."""

    client_kwargs: _SessionOptions
    kwargs: _RequestOptions

    def encode_url(self, url: str, /) -> "URL": ...


class _SessionKey(NamedTuple):
    """Requests with equal keys share a session."""

    process: int
    loop: int
    least_reach: Reach
    trust_env: bool


class _FileInfo(NamedTuple):
    """The size of a file (None if unknown) and its tag, from the headers of an
    answer."""

    num_bytes: int | None
    tag: str


class _ContentRange(NamedTuple):
    """The offset of the first byte of a part, the offset after its last byte, and the
    size of the file, from the headers of an answer."""

    first: int | None
    last: int | None
    num_bytes: int | None


_sessions: dict[_SessionKey, "ClientSession"] = {}


async def resolve(host: str, port: int) -> list[str]:
    """Return the addresses of a host. Tests replace this function."""
    loop = asyncio.get_running_loop()
    entries = await loop.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_ADDRCONFIG
    )
    return list(dict.fromkeys(str(entry[4][0]) for entry in entries))


class WebSource:
    """A file on a web server. Methods may be called from any thread.

    Attributes:
        num_bytes: Size of the file in bytes; None if the server does not send it.
        tag: Text that changes when the content changes; empty if the server sends none.
    """

    def __init__(self, file_system: HttpFileSystem, address: str) -> None:
        self._aiohttp: ModuleType = _extras.load("aiohttp")
        try:
            url = file_system.encode_url(address)
        except ValueError:  # the message may contain a part of a password
            raise _wrong_url() from None
        if not url.host:
            raise _wrong_url()
        self._url = url.with_user(None).with_fragment(None)
        # Users may set headers in fsspec. Only the host of the original URL receives
        # them.
        session = file_system.client_kwargs
        request = file_system.kwargs
        self._headers = {**session.get("headers", {}), **request.get("headers", {})}
        if url.user is not None:
            text = f"{url.user}:{url.password or ''}".encode()
            self._headers["Authorization"] = f"Basic {base64.b64encode(text).decode()}"
        self._ssl = request.get("ssl", True)
        self._proxy = request.get("proxy")
        self._trust_env = bool(session.get("trust_env", False))
        # Reach of the first host; None until it is known.
        self._reach: Reach | None = None
        self._gives_parts = False
        info = _run(self._info())
        self.num_bytes = info.num_bytes
        self.tag = info.tag

    def read_parts(self, parts: Sequence[tuple[int, int]], write: Write) -> bool:
        """Write the bytes of all parts (offset of the first byte, offset after the
        last). Return whether the server sent the whole file instead."""
        return _run(self._read_parts(parts, write))

    def read_all(self, max_bytes: int, write: Write) -> int:
        """Write the whole file, of at most `max_bytes`, and return its size."""
        return _run(self._read_all(max_bytes, write))

    async def _info(self) -> _FileInfo:
        async with self._answer("HEAD") as answer:
            if answer.status == 200 and answer.content_length is not None:
                return _FileInfo(answer.content_length, _tag_of(answer))
        # Some servers do not support HEAD, and some signatures are valid only for GET.
        async with self._answer("GET", "bytes=0-0") as answer:
            if answer.status == 200:
                return _FileInfo(answer.content_length, _tag_of(answer))
            if answer.status not in (206, 416):
                raise status_error(answer.status)
            num_bytes = _range_of(answer).num_bytes
            if answer.status == 416 and num_bytes != 0:
                raise status_error(answer.status)
            return _FileInfo(num_bytes, _tag_of(answer))

    async def _read_parts(self, parts: Sequence[tuple[int, int]], write: Write) -> bool:
        tasks = [
            asyncio.ensure_future(self._read_part(first, last, write)) for first, last in parts
        ]
        try:
            return any(await asyncio.gather(*tasks))
        finally:
            for task in tasks:  # the first failure cancels the other requests
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _read_part(self, first: int, last: int, write: Write) -> bool:
        async with self._answer("GET", f"bytes={first}-{last - 1}") as answer:
            if answer.status == 200 and not self._gives_parts and self.num_bytes is not None:
                await _read(answer, 0, self.num_bytes, write)
                return True
            if answer.status == 416:
                raise changed(first, last, 0)
            if answer.status == 200:
                raise DownloadError(
                    ConnectionError,
                    (
                        "the server sent parts of the file before but no longer does; try again "
                        "later"
                    ),
                )
            if answer.status != 206:
                raise status_error(answer.status)
            self._check_range(_range_of(answer), first, last)
            self._gives_parts = True
            await _read(answer, first, last, write)
            return False

    def _check_range(self, content: _ContentRange, first: int, last: int) -> None:
        """Raise an error if the size of the file has changed, or if the part is not the
        requested one."""
        if content.num_bytes is not None and content.num_bytes != self.num_bytes:
            problem = f"one of {content.num_bytes} bytes; the file has changed, open it again"
            raise DownloadError(
                ValueError, f"expected a file of {self.num_bytes} bytes, got {problem}"
            )
        if (content.first, content.last) != (first, last):
            problem = f"those from {content.first} to {content.last}; check the server"
            raise DownloadError(
                ConnectionError, f"expected the bytes from {first} to {last}, got {problem}"
            )

    async def _read_all(self, max_bytes: int, write: Write) -> int:
        async with self._answer("GET") as answer:
            if answer.status != 200:
                raise status_error(answer.status)
            if self.num_bytes is None:
                return await _read_to_end(answer, 0, max_bytes, write)
            await _read(answer, 0, self.num_bytes, write)
            return self.num_bytes

    @contextlib.asynccontextmanager
    async def _answer(self, method: str, part: str = "") -> "AsyncIterator[ClientResponse]":
        """Yield the first answer that is not a redirect, once its headers have arrived.
        The caller may read the body."""
        headers: dict[str, str] = {}
        if part:
            headers["Range"] = part
        answer = await asyncio.wait_for(self._follow(method, headers), PATIENCE_S)
        try:
            encoding = answer.headers.get("Content-Encoding", "identity").strip().lower()
            if encoding not in ("", "identity") and answer.status < 300:
                raise DownloadError(
                    ConnectionError,
                    ("expected an uncompressed answer, got a compressed one; check the server"),
                )
            yield answer
        finally:
            answer.close()  # also ends endless bodies

    async def _follow(self, method: str, headers: Mapping[str, str]) -> "ClientResponse":
        url = self._url
        reach = self._reach
        for _ in range(_MOST_REDIRECTS + 1):
            reach = await _checked(url, reach)
            if self._reach is None:
                self._reach = reach
            configured: Mapping[str, str] = {}
            if url.origin() == self._url.origin():
                configured = self._headers
            session = self._session(reach)
            answer = await session.request(
                method,
                url,
                headers={**configured, **headers, **_IDENTITY},
                allow_redirects=False,
                ssl=self._ssl,
                proxy=self._proxy,
            )
            if answer.status not in _REDIRECTS:
                return answer
            answer.close()
            url = _next_url(url, answer.headers.get("Location", ""))
        raise DownloadError(
            ConnectionError,
            f"expected at most {_MOST_REDIRECTS} redirects, got more; check the address",
        )

    def _session(self, reach: Reach) -> "ClientSession":
        """Return a session with persistent connections, which only connects to hosts of
        at least this reach."""
        loop = asyncio.get_running_loop()
        key = _SessionKey(os.getpid(), id(loop), reach, self._trust_env)
        if key not in _sessions:
            timeout = self._aiohttp.ClientTimeout(
                total=None, sock_connect=PATIENCE_S, sock_read=PATIENCE_S
            )
            session = self._aiohttp.ClientSession(
                connector=self._aiohttp.TCPConnector(resolver=_resolver(reach)),
                auto_decompress=False,
                cookie_jar=self._aiohttp.DummyCookieJar(),
                timeout=timeout,
                trust_env=self._trust_env,
            )
            _sessions[key] = session
            atexit.register(_close, os.getpid(), loop, session)
        return _sessions[key]


def _run(work: Coroutine[None, None, T]) -> T:
    """Run a coroutine on the event loop of fsspec. An interrupt of this thread cancels
    it."""
    future = asyncio.run_coroutine_threadsafe(work, _extras.load("fsspec.asyn").get_loop())
    try:
        return future.result()
    except BaseException:
        future.cancel()
        raise


def _close(process: int, loop: asyncio.AbstractEventLoop, session: "ClientSession") -> None:
    if process == os.getpid() and loop.is_running():
        with contextlib.suppress(Exception):
            asyncio.run_coroutine_threadsafe(session.close(), loop).result(1)


def _resolver(least_reach: Reach) -> "AbstractResolver":
    """Return a resolver for aiohttp that omits addresses of a smaller reach."""
    from aiohttp.abc import AbstractResolver

    class Resolver(AbstractResolver):
        async def resolve(
            self, host: str, port: int = 0, family: int = socket.AF_INET
        ) -> "list[ResolveResult]":
            addresses = [
                address for address in await resolve(host, port) if reach_of(address) >= least_reach
            ]
            if not addresses:
                raise _refused()
            return [_entry(host, port, address) for address in addresses]

        async def close(self) -> None:
            pass

    return Resolver()


def _entry(host: str, port: int, address: str) -> "ResolveResult":
    family = socket.AF_INET
    if ":" in address:
        family = socket.AF_INET6
    return {
        "hostname": host,
        "host": address,
        "port": port,
        "family": family,
        "proto": 0,
        "flags": socket.AI_NUMERICHOST | socket.AI_NUMERICSERV,
    }


async def _checked(url: "URL", least_reach: Reach | None) -> Reach:
    """Return the reach of a host, the largest reach of its addresses; raise an error if
    it is below `least_reach`."""
    host = url.host
    port = url.port
    assert host is not None
    assert port is not None  # URLs with http or https always have a port
    addresses = [host]
    if not is_address(host):
        addresses = await resolve(host, port)
    reach = max(map(reach_of, addresses))
    if least_reach is not None and reach < least_reach:
        raise _refused()
    return reach


def _wrong_url() -> DownloadError:
    advice = "check the URL, and write special characters of a password as %XX"
    return DownloadError(ValueError, f"expected a URL with a host; {advice}")


def _refused() -> DownloadError:
    advice = "if the redirect is intended, use the private address directly"
    return DownloadError(
        PermissionError, f"refused a redirect from a public server to a private address; {advice}"
    )


def _next_url(url: "URL", location: str) -> "URL":
    """Return the URL to which a redirect leads, without a user and a password."""
    try:
        target = url.join(type(url)(location)).with_user(None).with_fragment(None)
        is_web = bool(location) and target.scheme in ("http", "https") and bool(target.host)
    except ValueError:
        is_web = False
    if not is_web:
        raise DownloadError(
            ConnectionError,
            "the server redirects to something other than a web address; check the address",
        )
    return target


def _tag_of(answer: "ClientResponse") -> str:
    values = [f"{name}={answer.headers[name]}" for name in _TAGS if answer.headers.get(name)]
    if not values:
        return ""
    return " ".join([*values, f"size={answer.content_length}"])


def _range_of(answer: "ClientResponse") -> _ContentRange:
    match = _RANGE.fullmatch(answer.headers.get("Content-Range", "").strip())
    if not match:
        raise DownloadError(
            ConnectionError,
            "the server sent a part of the file without its range; check the server",
        )
    last = _number(match[2])
    if last is not None:
        last += 1
    return _ContentRange(_number(match[1]), last, _number(match[3]))


def _number(text: str | None) -> int | None:
    if text is None:
        return None
    return int(text)


async def _read(answer: "ClientResponse", first: int, last: int, write: Write) -> None:
    """Write a body, which must have exactly the bytes from offset `first` to before
    `last`."""
    length = answer.content_length
    if length is not None and length != last - first:
        raise changed(first, last, length)
    num_bytes = await _read_to_end(answer, first, last - first, write)
    if num_bytes != last - first:
        raise changed(first, last, num_bytes)


async def _read_to_end(answer: "ClientResponse", first: int, max_bytes: int, write: Write) -> int:
    """Write a body of at most `max_bytes` and return its size. Each `STEP_BYTES` must
    arrive within `PATIENCE_S`."""
    num_bytes = 0

    async def step() -> bool:
        nonlocal num_bytes
        end = num_bytes + STEP_BYTES
        while num_bytes < end:
            data = await answer.content.readany()
            if not data:
                return False
            if num_bytes + len(data) > max_bytes:
                raise too_long(max_bytes)
            write(data, first + num_bytes)
            num_bytes += len(data)
        return True

    while await asyncio.wait_for(step(), PATIENCE_S):
        pass
    return num_bytes
