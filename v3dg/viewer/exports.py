"""Long work of a tab, such as saving files, and the thread that does it."""

import contextlib
import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from v3dg import _core
from v3dg.scene import Scene
from v3dg.viewer.answers import Answer, Done, File, Notice


def bundle_names(scene: Scene) -> list[str]:
    """Return the paths of a scene's bundles relative to the innermost folder that
    contains all of them. All bundles must be in files."""
    paths = [os.path.abspath(bundle.path or "") for bundle in scene.bundles]
    folder = os.path.commonpath([os.path.dirname(path) for path in paths] or ["/"])
    return [os.path.relpath(path, folder) for path in paths]


class Tell(Protocol):
    """Sends a message to the web page, optionally with binary data."""

    def __call__(self, answer: Answer, data: bytes = b"") -> None: ...


class Exporter:
    """Runs one piece of work at a time in a separate thread, until it is finished or
    stopped.

    Args:
        tell: Sends a message to the page. It may be called from any thread.
        explain: Converts an error to a line of text for the page.
    """

    def __init__(self, tell: Tell, explain: Callable[[Exception], str]) -> None:
        self._tell = tell
        self._explain = explain
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread: threading.Thread | None = None
        self._stop = _core.Stop()

    def begin(self, work: Callable[[_core.Stop], None]) -> None:
        """Start work. If other work is still in progress, send a notice instead.

        The work must end soon after its argument is set to stop. Errors of the work are
        sent as notices.
        """
        with self._lock:
            if self._is_closed:
                return
            if self._thread is None or not self._thread.is_alive():
                self._stop = _core.Stop()
                self._thread = threading.Thread(
                    target=self._run, args=(work,), name="v3dg export", daemon=True
                )
                self._thread.start()
                return
        busy = Notice("Other work is still in progress: stop it first, or wait.")
        self._run(lambda _: self._tell(busy))

    def _run(self, work: Callable[[_core.Stop], None]) -> None:
        answer: Answer = Done()
        try:
            work(self._stop)
        except Exception as error:
            answer = Notice(f"Not done: {self._explain(error)}")
        with contextlib.suppress(Exception):  # the web page may be closed
            self._tell(answer)

    def save(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file to a temporary folder, and send it to the browser, which saves
        it."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, name)
            write(path)
            self._tell(File(name), path.read_bytes())

    def stop(self) -> None:
        """Request the end of the current work."""
        self._stop.request()

    def close(self, seconds: float) -> bool:
        """Stop permanently. Wait at most `seconds` for the thread, and return whether
        it has ended."""
        with self._lock:
            self._is_closed = True
        self.stop()
        if self._thread is not None:
            self._thread.join(seconds)
        return self._thread is None or not self._thread.is_alive()
