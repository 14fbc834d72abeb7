"""A browser's side of the viewer's connection: moves a camera and controls, takes pictures."""

import io
import time

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from websockets.sync.client import connect


class Tab:
    """What a browser tab is to the server.

    Attributes:
        uuids: Of the controls, by their labels.
        text: The HTML of the panel's figures.
        updates: What the server changed of its controls.
        positions: Where the server took the camera.
        notices: Notices that popped up.
        files: Contents of the files that were downloaded, by name.
    """

    def __init__(self, port, path="", **options):
        self._connection = connect(
            f"ws://127.0.0.1:{port}{path}",
            subprotocols=[f"viser-v{viser.__version__}"],
            compression=None,
            max_size=None,
            **options,
        )
        self.uuids, self._props, self._figures = {}, {}, None
        self._names, self._parts = {}, {}
        self.text, self.updates, self.notices, self.files = "", [], [], {}
        self.positions = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._connection.close()

    def look(self, view, size):
        """Say that the camera is there now, in a window of that size."""
        forward = view.camera(1, 1, 0.01).viewmat[2, :3]
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": list(view.wxyz),
            "position": list(view.position),
            "fov": view.fov_y,
            "near": 0.01,
            "far": 1000.0,
            "image_height": size[1],
            "image_width": size[0],
            "look_at": (np.array(view.position) + forward).tolist(),
            "up_direction": [0.0, 0.0, 1.0],
        }
        self.send(message)
        return message

    def set(self, label, value):
        """Give the control with that label a value; True presses a button."""
        message = {"type": "GuiUpdateMessage", "uuid": self.uuids[label], "updates": {"value": value}}
        self.send(message)
        return message

    def visible(self, label):
        """Whether the control with that label is shown at first."""
        return self._props[label]["visible"]

    def options(self, label):
        return self._props[label]["options"]

    def pictures(self, until):
        """Take what comes until then; (time, picture) of each picture, 8 bit."""
        found = []
        while (left := until - time.perf_counter()) > 0:
            try:
                data = self._connection.recv(timeout=left)
            except TimeoutError:
                break
            found += [
                (time.perf_counter(), picture) for picture in map(self._take, messages(data)) if picture
            ]
        return found

    def _take(self, message):
        """Keep what a message says; return the picture in it if there is one."""
        kind = message["type"]
        if kind == "BackgroundImageMessage" and message["rgb_data"]:
            return Image.open(io.BytesIO(message["rgb_data"]))
        if kind == "GuiHtmlMessage":
            self._figures, self.text = message["uuid"], message["props"]["content"]
        elif kind.startswith("Gui") and "label" in message.get("props", {}):
            self.uuids[message["props"]["label"]] = message["uuid"]
            self._props[message["props"]["label"]] = message["props"]
        elif kind == "GuiUpdateMessage":
            self.updates.append(str(message["updates"]))
            if message["uuid"] == self._figures:
                self.text = message["updates"].get("content", self.text)
        elif kind == "SetCameraPositionMessage":
            self.positions.append(message["position"])
        elif kind == "NotificationShowMessage":
            self.notices.append(message["props"]["body"])
        elif kind == "FileTransferStartDownload":
            self._names[message["transfer_uuid"]] = (message["filename"], message["part_count"])
        elif kind == "FileTransferPart":
            transfer = message["transfer_uuid"]
            parts = self._parts.setdefault(transfer, {})
            parts[message["part_index"]] = message["content"]
            name, count = self._names[transfer]
            if len(parts) == count:
                self.files[name] = b"".join(parts[i] for i in range(count))
        return None

    def send(self, message):
        """Send what becomes MessagePack, or else a text or bytes as they are."""
        raw = isinstance(message, (str, bytes))
        self._connection.send(message if raw else msgspec.msgpack.encode(message))


def messages(data):
    """Those of one frame of the connection: sizes, then compressed MessagePack."""
    size = int.from_bytes(data[8:16], "little")
    envelope = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
    return envelope["messages"]
