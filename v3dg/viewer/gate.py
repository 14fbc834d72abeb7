"""Decides who may connect to the viewer's server, by the headers of a request.

Any web page can make a visitor's browser connect to this machine. The browser sends the
name of the server (Host), the site of the web page (Origin, which is absent for
pictures, scripts and links), and the relation between the two (Sec-Fetch-Site, which
browsers omit for unencrypted connections to other machines). A web page cannot change
any of these headers.
"""

import errno
import hmac
import ipaddress
import re
import secrets
import socket

from websockets.http11 import Request

_MOST_PORTS = 1000
# A name or an address, optionally with a port, in the form that browsers send: in lower
# case and without a user name.
_HOST = re.compile(
    r"(?:\[(?P<address>[0-9a-f:.]+(?:%[a-z0-9._~-]+)?)\]|(?P<name>[a-z0-9._-]+))(?::[0-9]{0,5})?"
)
# Values of Sec-Fetch-Site for requests of the viewer's own web page, and for addresses
# that the user typed or opened from a bookmark.
_OWN_SITES = ("same-origin", "none")
# Paths of the web page. Links on other sites may open them.
_PAGE_PATHS = ("/", "/index.html")


class Gate:
    """Listens at one address of this machine, and decides which requests are answered.

    Args:
        host: Address on which to listen. ``"0.0.0.0"`` means all addresses of this
            machine.
        port: Port on which to listen. If it is in use, the next free port is used.

    Attributes:
        socket: The socket that listens.
        port: The port on which the socket listens.
        url: The address for a browser. If other machines can connect, it contains a
            secret, and requests without the secret are refused.
        is_secret: Whether the address contains a secret.

    Raises:
        ValueError: ``host`` is not an address of this machine, or no port is free.
    """

    def __init__(self, host: str, port: int) -> None:
        self.socket = _listening_socket(host, port)
        self.port = int(self.socket.getsockname()[1])
        address = ipaddress.ip_address(self.socket.getsockname()[0].partition("%")[0])
        self._names = {"localhost", host.lower(), str(address)}
        # A machine that listens on all addresses does not know all of its names, so
        # only the token decides.
        self._has_any_name = address.is_unspecified
        self._token = ""
        if not address.is_loopback:
            self._token = secrets.token_urlsafe(16)
        self.is_secret = bool(self._token)
        name = host
        if address.is_unspecified:
            name = socket.gethostname()
        if ":" in name:
            name = f"[{name}]"
        self.url = f"http://{name}:{self.port}"
        if self._token:
            self.url += f"/{self._token}/"

    def refusal(self, request: Request) -> str | None:
        """Return the reason why a request is refused, or None if it is accepted. The
        token is removed from the path of an accepted request."""
        headers = request.headers
        texts = (request.path, *(value for _, value in headers.raw_items()))
        if not all(text.isascii() for text in texts):
            return "The viewer only answers requests in ASCII.\n"
        hosts = [host.lower() for host in headers.get_all("Host")]
        if len(hosts) != 1 or not self._knows(hosts[0]):
            return "The viewer does not have this name; open the address that it printed.\n"
        own_origins = (f"http://{hosts[0]}", f"https://{hosts[0]}")
        if any(origin.lower() not in own_origins for origin in headers.get_all("Origin")):
            return "Other web pages may not connect to the viewer.\n"
        request.path = request.path.partition("?")[0]
        if self._token:
            token, slash, path = request.path.removeprefix("/").partition("/")
            if not slash or not hmac.compare_digest(token.encode(), self._token.encode()):
                return (
                    "Open the complete address that the viewer printed, including the slash at "
                    "its end.\n"
                )
            request.path = f"/{path}"
        is_own = all(site in _OWN_SITES for site in headers.get_all("Sec-Fetch-Site"))
        if not is_own and not _opens_the_page(request):
            return "Other web pages may not show the viewer's files.\n"
        return None

    def _knows(self, host: str) -> bool:
        """Return whether a Host header is a loopback address, or the host on which the
        viewer listens.

        Any other name could belong to a malicious site that makes it point to this
        machine.
        """
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = match["address"] or match["name"]
        if self._has_any_name or name in self._names:
            return True
        try:
            return "%" not in name and ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False


def _opens_the_page(request: Request) -> bool:
    """Return whether a request opens the web page in a tab, from a link on another
    site. Requests from frames have another Sec-Fetch-Dest."""
    headers = request.headers
    is_navigation = headers.get_all("Sec-Fetch-Mode") == ["navigate"]
    is_tab = headers.get_all("Sec-Fetch-Dest") == ["document"]
    return is_navigation and is_tab and request.path in _PAGE_PATHS and "Upgrade" not in headers


def _listening_socket(host: str, port: int) -> socket.socket:
    ports = range(port, min(port + _MOST_PORTS, 1 << 16))
    for candidate in ports:
        try:
            family = socket.getaddrinfo(host, candidate)[0][0]
            return socket.create_server((host, candidate), family=family)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise ValueError(
                    f"host: expected an address of this machine, got {host}; use 127.0.0.1 or "
                    "0.0.0.0"
                ) from error
    raise ValueError(
        f"port: expected a free port from {ports[0]} to {ports[-1]}, got none; choose another port"
    )
