"""A page's side of the viewer's connection: moves a camera, changes settings, takes
pictures."""

import io
import json
import time
from dataclasses import asdict

from PIL import Image
from websockets.sync.client import connect


class Tab:
    """What a browser tab is to the server.

    Attributes:
        hello, scene: What the server says first.
        figures: Of the last picture, and all else that came with it.
        failures: Why pictures could not be drawn.
        notices: Notices that popped up.
        answers: Other messages, by their types; the last of each.
        files: Contents of the files that were downloaded, by name.
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
        """Say that the camera is there now, in a window of that size."""
        self._look = {"type": "look", "view": asdict(view), "size": size}
        return self.change()

    def change(self, **settings):
        """Change settings of what is shown; returns what was said."""
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
        """Ask for a file of views with the seconds to each."""
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
        """Take what comes until then; (time, picture) of each picture, 8 bit."""
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
        """Keep what a message says; return the picture in it if there is one."""
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
        """Whether the last picture is the final one of what was asked for last."""
        return (
            bool(self.figures) and self.figures["final"] and self.figures["number"] == self._number
        )

    def send(self, message):
        """Send what becomes JSON, or else a text or bytes as they are."""
        raw = isinstance(message, (str, bytes))
        self._connection.send(message if raw else json.dumps(message))
