"""Files of web servers, which may be hostile: no more is asked for, waited for or kept than a request needs.

Requests are made with aiohttp on the event loop of fsspec, without compression. Redirects are followed here,
and each host is checked before it is asked. Addresses are checked once more when a connection is made,
because a name may resolve to another address by then.
"""

import asyncio
import atexit
import base64
import contextlib
import os
import re
import socket
from collections.abc import AsyncIterator, Coroutine, Mapping, Sequence
from typing import Any, TypeVar

from v3dg import _extras
from v3dg._urls.addresses import Reach, is_address, reach_of
from v3dg._urls.failures import Problem, status_problem
from v3dg._urls.others import Write, changed, too_long

T = TypeVar("T")

PATIENCE_S = 30.0
"""Seconds until an answer begins, with all redirects, and for each `STEP_BYTES` of it."""

STEP_BYTES = 128 << 10

_MOST_REDIRECTS = 10
_REDIRECTS = (301, 302, 303, 307, 308)
_TAGS = ("ETag", "Last-Modified", "Content-MD5", "Digest")
_RANGE = re.compile(r"bytes (?:(\d{1,18})-(\d{1,18})|\*)/(?:(\d{1,18})|\*)")
_IDENTITY = {"Accept-Encoding": "identity"}

_sessions: dict[tuple[int, int, Reach, bool], Any] = {}


async def resolve(host: str, port: int) -> list[str]:
    """Addresses of a host; tests put others in place of this function."""
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_ADDRCONFIG)
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


class WebSource:
    """One file of a web server; methods may be called on any thread.

    Attributes:
        num_bytes: Size; None where the server does not say it.
        tag: Differs when the content does; empty where the server sends nothing of the kind.
    """

    def __init__(self, there: Any, place: str) -> None:
        self._aiohttp = _extras.load("aiohttp")
        try:
            url: Any = there.encode_url(place)
        except ValueError:  # whose text may have a part of a password
            raise _wrong_url() from None
        if not url.host:
            raise _wrong_url()
        self._url: Any = url.with_user(None).with_fragment(None)
        # What users configure for fsspec; only the first host may see the headers.
        session: Mapping[str, Any] = there.client_kwargs
        request: Mapping[str, Any] = there.kwargs
        self._headers = {**session.get("headers", {}), **request.get("headers", {})}
        if url.user is not None:
            text = f"{url.user}:{url.password or ''}".encode()
            self._headers["Authorization"] = f"Basic {base64.b64encode(text).decode()}"
        self._ssl = request.get("ssl", True)
        self._proxy = request.get("proxy")
        self._trust_env = bool(session.get("trust_env", False))
        self._reach: Reach | None = None  # of the first host, once it is known
        self._gives_parts = False
        self.num_bytes: int | None
        self.tag: str
        self.num_bytes, self.tag = _run(self._info())

    def read_parts(self, parts: Sequence[tuple[int, int]], write: Write) -> bool:
        """Write the bytes from each first to each last; whether all of the file came instead."""
        return _run(self._read_parts(parts, write))

    def read_all(self, most: int, write: Write) -> int:
        """Write the whole file, of at most so many bytes; its size."""
        return _run(self._read_all(most, write))

    async def _info(self) -> tuple[int | None, str]:
        async with self._asked("HEAD") as answer:
            if answer.status == 200 and answer.content_length is not None:
                return answer.content_length, _tag_of(answer)
        # Some servers know no HEAD, and some signatures are for GET alone.
        async with self._asked("GET", "bytes=0-0") as answer:
            if answer.status == 200:
                return answer.content_length, _tag_of(answer)
            if answer.status not in (206, 416):
                raise status_problem(answer.status)
            total = _range_of(answer)[2]
            if answer.status == 416 and total != 0:
                raise status_problem(answer.status)
            return total, _tag_of(answer)

    async def _read_parts(self, parts: Sequence[tuple[int, int]], write: Write) -> bool:
        tasks = [asyncio.ensure_future(self._read_part(first, last, write)) for first, last in parts]
        try:
            return any(await asyncio.gather(*tasks))
        finally:
            for task in tasks:  # one that fails ends the others
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _read_part(self, first: int, last: int, write: Write) -> bool:
        async with self._asked("GET", f"bytes={first}-{last - 1}") as answer:
            if answer.status == 200 and not self._gives_parts and self.num_bytes is not None:
                await _read(answer, 0, self.num_bytes, write)
                return True
            if answer.status == 416:
                raise changed(first, last, 0)
            if answer.status == 200:
                raise Problem(ConnectionError, "the server gave parts of the file before and now does not")
            if answer.status != 206:
                raise status_problem(answer.status)
            found_first, found_last, total = _range_of(answer)
            if total is not None and total != self.num_bytes:
                got = f"one of {total}; it has changed, open it again"
                raise Problem(ValueError, f"expected a file of {self.num_bytes} bytes, got {got}")
            if (found_first, found_last) != (first, last):
                got = f"an answer with those from {found_first} to {found_last}"
                raise Problem(ConnectionError, f"expected the bytes from {first} to {last}, got {got}")
            self._gives_parts = True
            await _read(answer, first, last, write)
            return False

    async def _read_all(self, most: int, write: Write) -> int:
        async with self._asked("GET") as answer:
            if answer.status != 200:
                raise status_problem(answer.status)
            if self.num_bytes is None:
                return await _read_to_end(answer, 0, most, write)
            await _read(answer, 0, self.num_bytes, write)
            return self.num_bytes

    @contextlib.asynccontextmanager
    async def _asked(self, method: str, part: str = "") -> AsyncIterator[Any]:
        """The beginning of an answer that is no redirect; the caller reads its body, or leaves it."""
        headers = {"Range": part} if part else {}
        answer = await asyncio.wait_for(self._follow(method, headers), PATIENCE_S)
        try:
            encoding = answer.headers.get("Content-Encoding", "identity").strip().lower()
            if encoding not in ("", "identity") and answer.status < 300:
                raise Problem(ConnectionError, "expected the file as it is, got a compressed answer")
            yield answer
        finally:
            answer.close()  # also where it would go on, as the text of an error without end

    async def _follow(self, method: str, headers: Mapping[str, str]) -> Any:
        url = self._url
        reach = self._reach
        for _ in range(_MOST_REDIRECTS + 1):
            reach = await _checked(url, reach)
            if self._reach is None:
                self._reach = reach
            own = self._headers if url.origin() == self._url.origin() else {}
            session = self._session(reach)
            answer = await session.request(
                method,
                url,
                headers={**own, **headers, **_IDENTITY},
                allow_redirects=False,
                ssl=self._ssl,
                proxy=self._proxy,
            )
            if answer.status not in _REDIRECTS:
                return answer
            answer.close()
            url = _next_url(url, answer.headers.get("Location", ""))
        raise Problem(
            ConnectionError, f"expected at most {_MOST_REDIRECTS} redirects, got more; check the address"
        )

    def _session(self, reach: Reach) -> Any:
        """Session, with connections that are kept, to hosts that are reached from so far at least."""
        loop = asyncio.get_running_loop()
        key = (os.getpid(), id(loop), reach, self._trust_env)
        if key not in _sessions:
            timeout = self._aiohttp.ClientTimeout(total=None, sock_connect=PATIENCE_S, sock_read=PATIENCE_S)
            session = self._aiohttp.ClientSession(
                connector=self._aiohttp.TCPConnector(resolver=_resolver(self._aiohttp, reach)),
                auto_decompress=False,
                cookie_jar=self._aiohttp.DummyCookieJar(),
                timeout=timeout,
                trust_env=self._trust_env,
            )
            _sessions[key] = session
            atexit.register(_close, os.getpid(), loop, session)
        return _sessions[key]


def _run(work: Coroutine[Any, Any, T]) -> T:
    """Do it on the event loop of fsspec; an interrupt of this thread ends it there, too."""
    future = asyncio.run_coroutine_threadsafe(work, _extras.load("fsspec.asyn").get_loop())
    try:
        return future.result()
    except BaseException:
        future.cancel()
        raise


def _close(process: int, loop: asyncio.AbstractEventLoop, session: Any) -> None:
    if process == os.getpid() and loop.is_running():
        with contextlib.suppress(Exception):
            asyncio.run_coroutine_threadsafe(session.close(), loop).result(1)


def _resolver(aiohttp: Any, least: Reach) -> Any:
    """A resolver for aiohttp that knows no address of a shorter reach."""

    class Resolver(aiohttp.abc.AbstractResolver):  # type: ignore[misc]
        async def resolve(
            self, host: str, port: int = 0, family: int = socket.AF_INET
        ) -> list[dict[str, Any]]:
            addresses = [address for address in await resolve(host, port) if reach_of(address) >= least]
            if not addresses:
                raise _refused()
            return [_entry(host, port, address) for address in addresses]

        async def close(self) -> None:
            pass

    return Resolver()


def _entry(host: str, port: int, address: str) -> dict[str, Any]:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    flags = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
    return {"hostname": host, "host": address, "port": port, "family": family, "proto": 0, "flags": flags}


async def _checked(url: Any, least: Reach | None) -> Reach:
    """Reach of a host, which is that of its farthest address; refused where it is shorter than `least`."""
    host = url.host
    addresses = [host] if is_address(host) else await resolve(host, url.port)
    reach = max(map(reach_of, addresses))
    if least is not None and reach < least:
        raise _refused()
    return reach


def _wrong_url() -> Problem:
    advice = "check it, and write special characters of a password as %XX"
    return Problem(ValueError, f"expected a URL with a host; {advice}")


def _refused() -> Problem:
    advice = "if it is meant, use its own address"
    return Problem(PermissionError, f"refused to go on from a public server to a private address; {advice}")


def _next_url(url: Any, location: str) -> Any:
    """Where a redirect leads; another user or password in it is left out."""
    try:
        found = url.join(type(url)(location)).with_user(None).with_fragment(None)
        is_web = bool(location) and found.scheme in ("http", "https") and bool(found.host)
    except ValueError:
        is_web = False
    if not is_web:
        raise Problem(
            ConnectionError, "the server sent us on to what is no address of the web; check the address"
        )
    return found


def _tag_of(answer: Any) -> str:
    values = [f"{name}={answer.headers[name]}" for name in _TAGS if answer.headers.get(name)]
    return " ".join([*values, f"size={answer.content_length}"]) if values else ""


def _range_of(answer: Any) -> tuple[int | None, int | None, int | None]:
    """First byte, the one behind the last, and the size of the file, as an answer with a part says."""
    match = _RANGE.fullmatch(answer.headers.get("Content-Range", "").strip())
    if not match:
        raise Problem(ConnectionError, "the server sent a part of the file and does not say which")
    first, last, total = (None if text is None else int(text) for text in match.groups())
    return first, None if last is None else last + 1, total


async def _read(answer: Any, first: int, last: int, write: Write) -> None:
    """Write a body that must have exactly the bytes from a first to a last."""
    length = answer.content_length
    if length is not None and length != last - first:
        raise changed(first, last, length)
    num_bytes = await _read_to_end(answer, first, last - first, write)
    if num_bytes != last - first:
        raise changed(first, last, num_bytes)


async def _read_to_end(answer: Any, first: int, most: int, write: Write) -> int:
    """Write a body of at most so many bytes, a step at a time, each of which must come in time; its size."""
    done = 0

    async def step() -> bool:
        nonlocal done
        end = done + STEP_BYTES
        while done < end:
            data: bytes = await answer.content.readany()
            if not data:
                return False
            if done + len(data) > most:
                raise too_long(most)
            write(data, first + done)
            done += len(data)
        return True

    while await asyncio.wait_for(step(), PATIENCE_S):
        pass
    return done
