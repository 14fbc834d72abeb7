"""Who may talk to the viewer's server, and in which words; viser by itself asks nobody.

Any web page can have its visitor's browser connect to this machine. The browser then says whose page it is
(Origin) and which name it looked up (Host), and no page can change that.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import http
import ipaddress
import logging
import math
import secrets
import socket
import threading
from collections.abc import Iterator
from typing import Annotated, Any
from urllib.parse import urlsplit

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

# What goes wrong in a connection is its client's fault: for those who set up logging, not for the terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())
_starting = threading.Lock()
_MOST_PORTS = 1000
_OPTIONS = {
    "logger": _LOG,
    "max_size": 1 << 14,  # bytes of a message
    "close_timeout": 0.5,  # a client that does not answer does not hold up the end
}
# The page is shown in no other page and talks to no other server, though its address may ask it to.
_PAGE_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'; connect-src 'self' data: blob:",
    "Referrer-Policy": "no-referrer",
}

# Bounds keep out what is not a number, too.
_Number = Annotated[float, msgspec.Meta(ge=-1e15, le=1e15)]
_Pixels = Annotated[float, msgspec.Meta(ge=1, le=1 << 20)]
_Vector = tuple[_Number, _Number, _Number]


class _Camera(msgspec.Struct, tag="ViewerCameraMessage"):
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: Annotated[float, msgspec.Meta(ge=1e-4, le=3.14)]
    near: float
    far: float
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector
    up_direction: _Vector

    def __post_init__(self) -> None:
        if abs(math.hypot(*self.wxyz) - 1) > 1e-3:
            raise ValueError("wxyz: expected a rotation")


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: bool | _Number | Annotated[str, msgspec.Meta(max_length=1000)]


class _Control(msgspec.Struct, tag="GuiUpdateMessage"):
    uuid: str
    updates: _Value


_MESSAGE = msgspec.msgpack.Decoder(_Camera | _Control)


class _Connection(ServerConnection):
    """Hears only of moved cameras and changed controls; viser would do more, such as publish the server."""

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            message = await super().recv(decode)
            with contextlib.suppress(Exception):  # whatever is wrong with it
                _MESSAGE.decode(message)  # type: ignore[arg-type]
                return message


class Gate:
    """Decides about requests to the server at one address of this machine.

    Args:
        host: Address to listen at; ``"0.0.0.0"`` for all that this machine has.
        port: Where to listen; the next free one where it is taken.

    Attributes:
        port: The one that was free.
        url: What a browser is to open. Where other machines can connect, a secret that lets in who has it
            follows the port.

    Raises:
        ValueError: ``host`` is not an address of this machine, or no port is free.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = _listening_socket(host, port)
        self.port = int(self._socket.getsockname()[1])
        address = ipaddress.ip_address(self._socket.getsockname()[0].partition("%")[0])
        self._names = {"localhost", host.lower(), str(address)}
        # Those of a machine that listens everywhere are not known: there the token alone decides.
        self._has_any_name = address.is_unspecified
        self._token = "" if address.is_loopback else secrets.token_urlsafe(16)
        name = socket.gethostname() if address.is_unspecified else host
        name = f"[{name}]" if ":" in name else name
        self.url = f"http://{name}:{self.port}" + (f"/{self._token}" if self._token else "")

    def refusal(self, request: Request) -> str | None:
        """Why a request gets no answer; the token is taken off the path of one that does."""
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._knows(hosts[0]):
            return "The viewer does not go by this name.\n"
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return "Other web pages may not use the viewer.\n"
        if self._token:
            token, _, path = request.path.partition("?")[0].removeprefix("/").partition("/")
            if not hmac.compare_digest(token.encode(errors="replace"), self._token.encode()):
                return "Open the whole address that the viewer printed.\n"
            request.path = f"/{path}"
        version = f"viser-v{viser.__version__}"
        if "Upgrade" in headers and headers.get_all("Sec-WebSocket-Protocol") != [version]:
            return "Load the page anew: it is not of this viewer.\n"
        return None

    def _knows(self, host: str) -> bool:
        """Whether a Host is loopback or was asked for: other names can be led here by those who own them."""
        name = urlsplit(f"//{host}").hostname or ""
        if self._has_any_name or name in self._names:
            return True
        try:
            return ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False

    @contextlib.contextmanager
    def guarding(self) -> Iterator[None]:
        """Stand before the server that viser starts meanwhile, and have it listen here.

        Raises:
            RuntimeError: No server came by.
        """
        module: Any = websockets.asyncio.server
        serve, is_guarded = module.serve, False

        def serve_guarded(handler: Any, *_: Any, process_request: Any, **options: Any) -> Any:
            nonlocal is_guarded
            is_guarded = True

            def process(connection: ServerConnection, request: Request) -> Response | None:
                refusal = self.refusal(request)
                if refusal is not None:
                    return connection.respond(http.HTTPStatus.FORBIDDEN, refusal)
                response: Response | None = process_request(connection, request)
                if response is not None:
                    response.headers.update(_PAGE_HEADERS)
                return response

            asyncio.get_running_loop().set_exception_handler(
                lambda _, context: _LOG.error(context["message"], exc_info=context.get("exception"))
            )
            ours = {"process_request": process, "create_connection": _Connection, "sock": self._socket}
            return serve(handler, **(options | _OPTIONS | ours))

        with _starting:
            module.serve = serve_guarded
            try:
                yield
            finally:
                module.serve = serve
        if not is_guarded:
            self._socket.close()
            raise RuntimeError(f"viser {viser.__version__}: expected 1.1, whose server can be guarded")


def _listening_socket(host: str, port: int) -> socket.socket:
    ports = range(port, min(port + _MOST_PORTS, 1 << 16))
    for candidate in ports:
        try:
            family = socket.getaddrinfo(host, candidate)[0][0]
            return socket.create_server((host, candidate), family=family)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise ValueError(f"host: expected an address of this machine, got {host}") from error
    raise ValueError(f"port: expected a free one among {ports[0]} to {ports[-1]}, got none")
