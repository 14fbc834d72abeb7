"""A browser tab: what its page asks for, the loop that draws it, and what the page is
told."""

import contextlib
import copy
import functools
import io
import math
import os
import resource
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO

import msgspec
import numpy as np
from PIL import Image

from v3dg import _core
from v3dg._urls import beside
from v3dg.bundle import Bundle
from v3dg.camera_file import write_cameras
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.io import read_asset
from v3dg.pictures import to_8bit
from v3dg.scene.file import write_scene
from v3dg.video import write_video
from v3dg.viewer import messages
from v3dg.viewer.exports import Exporter, bundle_names
from v3dg.viewer.frame import MOST_COUNTED, Frame, Pixels, SceneView
from v3dg.viewer.pacing import RenderLoop

# Quality of JPEG, of drafts and of final pictures.
_DRAFT_QUALITY = 75
_FINAL_QUALITY = 94
# Pillow's numbers for JPEG whose colours have half the resolution, and the whole one.
_HALF_COLORS = 2
_WHOLE_COLORS = 0
_FPS = 30
# Of a pixel, for a click to mean the gaussian: what is fainter is hardly seen.
_LEAST_WEIGHT = 0.05


_Send = Callable[[str | bytes], None]


class Tab:
    """What a page that is connected to a `Site` sees and does, until `close`.

    Args:
        scene_view: What it shows, until a file is dropped onto it.
        name: Of the files that it saves.
        send: Sends text or bytes to the page; waits until they are away, but not in the
            server's thread.
        moved: Called with a scene view of which an instance has another pose.
    """

    def __init__(
        self, scene_view: SceneView, name: str, send: _Send, moved: Callable[[SceneView], None]
    ) -> None:
        self.scene_view = scene_view
        self._name = name
        self._send = send
        self._moved = moved
        self._exporter = Exporter(self._tell, lambda error: self.scene_view.explain(error))
        self._loop = RenderLoop(scene_view, self._show, self._fail)
        self._look: messages.Look | None = None
        self._picking = threading.Lock()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._dropped: IO[bytes] | None = None
        self._missing_bytes = 0

    def close(self, seconds: float) -> bool:
        """Stop drawing and saving; returns whether the threads have ended, waiting so
        long for each."""
        has_ended = all([self._loop.close(seconds), self._exporter.close(seconds)])
        if has_ended and self._folder is not None:
            self._folder.cleanup()
        return has_ended

    def ask_again(self) -> None:
        """Draw once more what is shown, which has changed."""
        if self._look is not None:
            self._loop.ask(self._look.request())

    def take(self, data: str | bytes) -> None:
        """Do what a message says; ValueError and its like where it is none of
        `messages`."""
        if isinstance(data, bytes):
            self._take_bytes(data)
            return
        message = messages.read_message(data)
        if isinstance(message, messages.Look):
            self._look = message
            self.ask_again()
        elif isinstance(message, messages.Pick):
            if self._picking.acquire(blocking=False):  # one at a time
                threading.Thread(
                    target=self._pick, args=(message,), name="v3dg pick", daemon=True
                ).start()
        elif isinstance(message, messages.Move):
            self.scene_view.scene.move(
                [message.instance],
                positions=[message.position],
                quaternions=message.quaternion,
                scales=message.scale,
            )
            self._moved(self.scene_view)
        elif isinstance(message, messages.Save):
            self._exporter.begin(
                functools.partial(getattr(self, f"_save_{message.output}"), message)
            )
        elif isinstance(message, messages.Stop):
            self._exporter.stop()
        else:
            self._begin_file(message)

    def describe_scene(self) -> dict[str, object]:
        """Return what the page has to know of what it shows."""
        scene_view = self.scene_view
        bundles = scene_view.scene.bundles
        return {
            "type": "scene",
            "name": self._name,
            "center": scene_view.center.tolist(),
            "radius": scene_view.radius,
            "near": scene_view.near,
            "instances": len(scene_view.scene),
            "has_files": self._folder is None and all(bundle.path for bundle in bundles),
            "level_colors": to_8bit(_core.level_colors(scene_view.num_levels)).tolist(),
            "ramp": to_8bit(_core.ramp(np.linspace(0, 1, 7))).tolist(),
            "most_counted": MOST_COUNTED,
            "modes": scene_view.modes,
            "shows_cuts": scene_view.shows_cuts,
            "missing_colors": to_8bit(_core.missing_colors(4.0 ** np.arange(4))).tolist(),
        }

    def _tell(self, message: Mapping[str, object], data: bytes = b"") -> None:
        """Send a message; with bytes, as the length of the message, the message, and
        the bytes."""
        text = msgspec.json.encode(message)
        if data:
            self._send(len(text).to_bytes(4, "little") + text + data)
        else:
            self._send(text.decode())

    def _show(self, frame: Frame, is_final: bool, number: int) -> None:
        quality = _DRAFT_QUALITY
        subsampling = _HALF_COLORS
        if is_final:
            quality = _FINAL_QUALITY
            subsampling = _WHOLE_COLORS
        picture = io.BytesIO()
        Image.fromarray(frame.pixels).save(
            picture, "jpeg", quality=quality, subsampling=subsampling
        )
        message = {
            "type": "picture",
            "final": is_final,
            "number": number,
            "size": frame.size,
            "view": asdict(frame.view),
            "shows": frame.shows,
            "range": frame.value_range,
            "distance": frame.distance,
            "figures": {**frame.figures._asdict(), "memory_bytes": _resident_bytes()},
        }
        self._tell(message, picture.getvalue())

    def _fail(self, error: Exception) -> None:
        self._tell({"type": "failed", "text": self.scene_view.explain(error)})

    def _pick(self, message: messages.Pick) -> None:
        """Tell what is at a place of the picture."""
        try:
            request = message.look.request()
            answer: dict[str, object] = {"type": "picked"}
            if message.instance is not None:
                answer.update(self._describe_instance(message.instance))
            elif self.scene_view.shows_cuts:
                width, height = request.size
                x = min(int(message.place[0] * width), width - 1)
                y = min(int(message.place[1] * height), height - 1)
                picked = self.scene_view.pick(request.view, request.size, x, y, request.settings)
                if picked is not None and picked.weight >= _LEAST_WEIGHT:
                    answer.update(self._describe_instance(picked.instance))
                    answer["point"] = picked.position.tolist()
            self._tell(answer)
        except Exception as error:
            with contextlib.suppress(Exception):  # the page may be closed
                self._tell({"type": "notice", "text": self.scene_view.explain(error)})
        finally:
            self._picking.release()

    def _describe_instance(self, number: int) -> dict[str, object]:
        scene = self.scene_view.scene
        if number >= len(scene):
            raise ValueError(f"instance: expected 0 to {len(scene) - 1}, got {number}")
        bundle = scene.bundles[scene.instance_bundle[number]]
        boxes = bundle.clusters.box[: bundle.level_range(0).stop]
        return {
            "instance": number,
            "pose": {
                "position": scene.positions[number].tolist(),
                "quaternion": scene.quaternions[number].tolist(),
                "scale": float(scene.scales[number]),
            },
            "box": [boxes[:, 0].min(axis=0).tolist(), boxes[:, 1].max(axis=0).tolist()],
            "bundle": beside(bundle.path or "").name,
        }

    def _save_picture(self, message: messages.Save, stop: _core.Stop) -> None:
        request = message.look.request()
        frame = self.scene_view.frame(
            request.view, request.size, request.settings, stop, patience=math.inf
        )
        self._exporter.save(f"{self._name}.png", Image.fromarray(frame.pixels).save)

    def _save_play(self, message: messages.Save, _: _core.Stop) -> None:
        views = [asdict(view) for view in message.camera_path().film(_FPS)]
        self._tell({"type": "play", "fps": _FPS, "views": views})

    def _save_film(self, message: messages.Save, stop: _core.Stop) -> None:
        request = message.look.request()
        views = message.camera_path().film(_FPS)
        # H.264 needs an even width and height.
        width = max(request.size[0] // 2 * 2, 2)
        height = max(request.size[1] // 2 * 2, 2)
        steps = _core.BudgetSteps()

        def pictures() -> Iterator[Pixels]:
            last_progress = 0.0
            for number, view in enumerate(views):
                if time.monotonic() - last_progress > 0.2:
                    self._tell({"type": "progress", "share": number / len(views)})
                    last_progress = time.monotonic()
                view = replace(view, aspect=width / height)
                frame = self.scene_view.frame(
                    view, (width, height), request.settings, stop, steps, patience=math.inf
                )
                yield frame.pixels

        self._exporter.save(
            f"{self._name}.mp4", lambda file: write_video(file, pictures(), fps=_FPS)
        )

    def _save_cameras(self, message: messages.Save, _: _core.Stop) -> None:
        size = message.look.request().size
        cameras = message.camera_path().cameras(_FPS, *size, self.scene_view.near)
        self._exporter.save("transforms.json", lambda file: write_cameras(file, cameras))

    def _save_scene(self, message: messages.Save, _: _core.Stop) -> None:
        """Save the instances as they are now, the axis that is up, and the cameras of a
        path, if any."""
        width, height = message.look.request().size
        path = message.camera_path()
        cameras: dict[str, Camera] = {}
        if len(path):
            cameras = path.cameras(_FPS, width, height, self.scene_view.near)
        scene = copy.copy(self.scene_view.scene)
        scene.up = message.up
        names = bundle_names(scene)
        self._exporter.save(
            f"{self._name}.json", lambda file: write_scene(file, scene, names, cameras)
        )

    def _begin_file(self, message: messages.Open) -> None:
        """Keep the bytes that come now, until they are all there, in a folder that goes
        with the tab."""
        self._folder = self._folder or tempfile.TemporaryDirectory(prefix="v3dg_")
        if self._dropped is not None:
            self._dropped.close()
        folder = tempfile.mkdtemp(dir=self._folder.name)
        self._dropped = open(Path(folder, message.name), "wb")  # noqa: SIM115  # until all of it is there
        self._missing_bytes = message.size

    def _take_bytes(self, data: bytes) -> None:
        file = self._dropped
        if file is None:
            raise ValueError("expected a file's name before its bytes")
        file.write(data[: self._missing_bytes])
        self._missing_bytes -= min(len(data), self._missing_bytes)
        if self._missing_bytes == 0:
            self._dropped = None
            file.close()
            self._exporter.begin(lambda _: self._open(Path(file.name)))

    def _open(self, path: Path) -> None:
        try:
            subject: Bundle | Gaussians
            if path.suffix == ".v3dg":
                subject = Bundle.open(path)
            else:
                subject = read_asset(path)
        except (OSError, ValueError) as error:  # the page gets to see no folder of this machine
            raise ValueError(str(error).replace(f"{path.parent}{os.sep}", "")) from None
        scene_view = SceneView(subject, device=self.scene_view.device)
        old_loop = self._loop
        self.scene_view = scene_view
        self._name = path.stem
        self._loop = RenderLoop(scene_view, self._show, self._fail)
        old_loop.close(0.0)
        self._tell(self.describe_scene())


def _resident_bytes(statm_path: str = "/proc/self/statm") -> int:
    """Memory that this process holds; without /proc, the most that it has held."""
    try:
        with open(statm_path, encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
