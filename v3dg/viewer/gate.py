"""Who may talk to the viewer's server: what a request has to say of where it comes from.

Any web page can have its visitor's browser connect to this machine. The browser then says whose page it is
(Origin) and which name it looked up (Host), and no page can change that.
"""

import errno
import hmac
import ipaddress
import secrets
import socket
from urllib.parse import urlsplit

from websockets.http11 import Request

_MOST_PORTS = 1000


class Gate:
    """Decides about requests to the server at one address of this machine.

    Args:
        host: Address to listen at; ``"0.0.0.0"`` for all that this machine has.
        port: Where to listen; the next free one where it is taken.

    Attributes:
        socket: Which listens there.
        port: The one that was free.
        url: What a browser is to open. Where other machines can connect, a secret that lets in who has it
            follows the port.
        is_secret: Whether it does.

    Raises:
        ValueError: ``host`` is not an address of this machine, or no port is free.
    """

    def __init__(self, host: str, port: int) -> None:
        self.socket = _listening_socket(host, port)
        self.port = int(self.socket.getsockname()[1])
        address = ipaddress.ip_address(self.socket.getsockname()[0].partition("%")[0])
        self._names = {"localhost", host.lower(), str(address)}
        # Those of a machine that listens everywhere are not known: there the token alone decides.
        self._has_any_name = address.is_unspecified
        self._token = "" if address.is_loopback else secrets.token_urlsafe(16)
        self.is_secret = bool(self._token)
        name = socket.gethostname() if address.is_unspecified else host
        name = f"[{name}]" if ":" in name else name
        self.url = f"http://{name}:{self.port}" + (f"/{self._token}/" if self._token else "")

    def refusal(self, request: Request) -> str | None:
        """Why a request gets no answer; the token is taken off the path of one that does."""
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._knows(hosts[0]):
            return "The viewer does not go by this name.\n"
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return "Other web pages may not use the viewer.\n"
        request.path = request.path.partition("?")[0]
        if self._token:
            token, slash, path = request.path.removeprefix("/").partition("/")
            if not slash or not hmac.compare_digest(token.encode(errors="replace"), self._token.encode()):
                return "Open the whole address that the viewer printed, to the slash at its end.\n"
            request.path = f"/{path}"
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
