"""A client that plays the web page's side of the viewer's connection: it moves a
camera, changes settings, and receives pictures."""

import io
import json
import time
from dataclasses import asdict

from PIL import Image
from websockets.sync.client import connect


class Tab:
    """A browser tab, as the server sees it.

    Attributes:
        hello, scene: The first messages of the server.
        figures: Statistics of the last picture, and everything else that came with it.
        failures: Why pictures could not be drawn.
        notices: Notices that popped up.
        answers: Other messages by type; the last one of each.
        files: Contents of the downloaded files, by name.
    """

    def __init__(self, port, path="/", **options):
        url = f"ws://127.0.0.1:{port}{path}connection"
        self._connection = connect(url, compression=None, max_size=None, **options)
        self.hello, self.scene = (json.loads(self._connection.recv(timeout=60)) for _ in range(2))
        self.figures, self.failures, self.notices, self.answers, self.files = {}, [], [], {}, {}
        self.settings, self._look, self._number = {}, None, 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._connection.close()

    def look(self, view, size):
        """Send a camera and a window size."""
        self._look = {"type": "look", "view": asdict(view), "size": size}
        return self.change()

    def change(self, **settings):
        """Change settings of the picture; return the message that was sent."""
        self.settings |= settings
        self._number += 1
        self._look |= {"settings": self.settings, "number": self._number}
        self.send(self._look)
        return self._look

    def pick(self, **where):
        message = {"type": "pick", "look": self._look, **where}
        self.send(message)
        return message

    def move(self, instance, position, quaternion=(1, 0, 0, 0), scale=1.0):
        pose = {"position": position, "quaternion": quaternion, "scale": scale}
        message = {"type": "move", "instance": instance, **pose}
        self.send(message)
        return message

    def save(self, what, path=(), up="z"):
        """Request a file of views with the seconds to each."""
        stops = [(seconds, asdict(view)) for seconds, view in path]
        message = {"type": "save", "what": what, "look": self._look, "up": up, "path": stops}
        self.send(message)
        return message

    def drop(self, name, content, piece=1 << 16):
        """Drop a file onto the page."""
        self.send({"type": "open", "name": name, "size": len(content)})
        for first in range(0, len(content), piece):
            self.send(content[first : first + piece])

    def pictures(self, until):
        """Receive messages until a time; return (time, picture) of each 8-bit
        picture."""
        found = []
        while (left := until - time.perf_counter()) > 0:
            try:
                data = self._connection.recv(timeout=left)
            except TimeoutError:
                break
            picture = self._take(data)
            if picture is not None:
                found.append((time.perf_counter(), picture))
        return found

    def _take(self, data):
        """Store the content of a message; return its picture if it has one."""
        content = b""
        if isinstance(data, bytes):
            size = int.from_bytes(data[:4], "little")
            data, content = data[4 : 4 + size], data[4 + size :]
        message = json.loads(data)
        kind = message["type"]
        if kind == "picture":
            self.figures = message | message["figures"]
            return Image.open(io.BytesIO(content))
        if kind == "file":
            self.files[message["name"]] = content
        elif kind == "failed":
            self.failures.append(message["text"])
        elif kind == "notice":
            self.notices.append(message["text"])
        elif kind == "scene":
            self.scene = message
        else:
            self.answers[kind] = message
        return None

    @property
    def is_answered(self):
        """Return whether the last picture is the final one for the last request."""
        return (
            bool(self.figures) and self.figures["final"] and self.figures["number"] == self._number
        )

    def send(self, message):
        """Send a value as JSON, or a text or bytes unchanged."""
        raw = isinstance(message, (str, bytes))
        self._connection.send(message if raw else json.dumps(message))
