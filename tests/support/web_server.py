"""A static web server for tests of pages, with byte ranges."""

import contextlib
import functools
import http.server
import re
import threading
from pathlib import Path


class Server(http.server.ThreadingHTTPServer):
    """Serves a folder. The attributes may change between requests.

    Attributes:
        requests: The path and the Range header of each request; None without one.
        has_ranges: Whether ranges are supported; otherwise whole files are sent.
        is_lost: Whether connections are closed without an answer.
        accepts: Names of files that a page may write.
    """

    daemon_threads = True

    def __init__(self, folder, accepts=()):
        self.requests = []
        self.has_ranges = True
        self.is_lost = False
        self.accepts = accepts
        handler = functools.partial(_Handler, directory=str(folder))
        super().__init__(("127.0.0.1", 0), handler)

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def handle_error(self, request, client_address):
        """Print nothing: browsers close connections at any time."""


class _Handler(http.server.SimpleHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_GET(self):
        wanted = self.headers.get("Range")
        self.server.requests.append((self.path, wanted))
        if self.server.is_lost:
            self.close_connection = True
            return
        path = Path(self.translate_path(self.path))
        if wanted is None or not self.server.has_ranges or not path.is_file():
            super().do_GET()
            return
        first, last = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", wanted).groups())
        data = path.read_bytes()
        part = data[first : last + 1]
        if not part:
            self.send_error(416)
            return
        self.send_response(206)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Content-Length", str(len(part)))
        end = first + len(part) - 1
        self.send_header("Content-Range", f"bytes {first}-{end}/{len(data)}")
        self.end_headers()
        self.wfile.write(part)

    def do_PUT(self):
        name = self.path.lstrip("/")
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if name not in self.server.accepts:
            self.send_error(403)
            return
        Path(self.translate_path(self.path)).write_bytes(body)
        self.send_response(204)
        self.end_headers()


@contextlib.contextmanager
def serving(folder, accepts=()):
    """Serve a folder at 127.0.0.1."""
    with Server(folder, accepts) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
