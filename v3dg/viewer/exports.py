"""The files that a tab saves, as bytes, and the thread that they are made in."""

from __future__ import annotations

import io
import os
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from v3dg.camera_file import write_cameras
from v3dg.cameras import Camera
from v3dg.scene import Scene
from v3dg.scene_file import write_scene
from v3dg.video import write_video
from v3dg.viewer.frame import Pixels

if TYPE_CHECKING:
    import viser


def picture_bytes(pixels: Pixels) -> bytes:
    """Return a .png file."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def film_bytes(pictures: Iterable[Pixels], fps: int) -> bytes:
    """Return an .mp4 file; errors are those of `write_video`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "film.mp4")
        write_video(path, pictures, fps=fps)
        return path.read_bytes()


def cameras_bytes(cameras: Mapping[str, Camera]) -> bytes:
    """Return a `transforms.json`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "transforms.json")
        write_cameras(path, cameras)
        return path.read_bytes()


def scene_bytes(scene: Scene, cameras: Mapping[str, Camera]) -> bytes:
    """Return a scene file, which names the files of the scene's bundles; all must have one."""
    bundles = [os.path.abspath(bundle.path or "") for bundle in scene.bundles]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "scene.json")
        write_scene(path, scene, bundles, cameras)
        return path.read_bytes()


class Exporter:
    """Does for a tab what takes long: one thing at a time, in a thread, until it is done or stopped.

    Attributes:
        stopped: Set when the work under way is to end; the work looks.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._thread: threading.Thread | None = None
        self.stopped = threading.Event()

    def begin(self, work: Callable[[], None]) -> None:
        """Start work whose errors become notices, unless there is some under way."""
        if self._thread is not None and self._thread.is_alive():
            self._client.add_notification("Still at work", "Stop it first, or wait.", auto_close_seconds=4)
            return
        self.stopped.clear()

        def run() -> None:
            try:
                work()
            except Exception as error:
                text = " ".join(str(error).split())
                self._client.add_notification("Not done", text, color="red", auto_close_seconds=10)

        self._thread = threading.Thread(target=run, name="v3dg export", daemon=True)
        self._thread.start()

    def download(self, name: str, content: bytes) -> None:
        """Have the browser save a file."""
        self._client.send_file_download(name, content, save_immediately=True)

    def close(self) -> None:
        """Stop the work under way, and wait for it to end."""
        self.stopped.set()
        if self._thread is not None:
            self._thread.join()
