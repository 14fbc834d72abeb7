"""The server's part of a browser tab. It executes the requests of a web page, and sends
the results to it."""

import contextlib
import copy
import functools
import io
import math
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt
from PIL import Image

from v3dg import _core, _system
from v3dg._urls import beside
from v3dg.bundle import Bundle
from v3dg.camera_file import write_cameras
from v3dg.cameras import Camera, VectorLike
from v3dg.editing import crop_box
from v3dg.gaussians import Gaussians
from v3dg.io import read_asset, subject_name, write_asset
from v3dg.pictures import to_8bit
from v3dg.scene.file import write_scene
from v3dg.video import write_video
from v3dg.viewer import answers, messages
from v3dg.viewer.edits import write_new_asset
from v3dg.viewer.exports import Exporter, bundle_names
from v3dg.viewer.frame import MOST_COUNTED, Frame, Pixels, SceneView
from v3dg.viewer.pacing import RenderLoop

# Aspect ratios of windows for which first views are computed.
_HOME_ASPECTS = (0.4, 0.5, 0.6, 0.75, 1.0, 4 / 3, 16 / 9, 2.4)
# JPEG qualities of drafts and of final pictures.
_DRAFT_QUALITY = 75
_FINAL_QUALITY = 94
# Pillow's codes for chroma subsampling: half the resolution, and full resolution.
_HALF_COLORS = 2
_WHOLE_COLORS = 0
_FPS = 30
# Minimum weight of a gaussian in a pixel that is clicked. A gaussian with less weight
# is hardly visible, so it is not picked.
_LEAST_WEIGHT = 0.05
_SECONDS_BETWEEN_PROGRESS = 0.2

_Send = Callable[[str | bytes], None]


class Tab:
    """The server's part of a web page that is connected to a `Site`, until `close`.

    Args:
        scene_view: The scene that is shown, until a file is dropped onto the web page.
        name: Name of the files that the web page saves.
        send: Sends text or binary data to the web page. It waits until the data is
            sent, except in the server's thread.
        moved: Called with the scene view after an instance was moved.
        edits_folder: Folder to which new assets are written. If it is None, or if the
            shown file was dropped onto the web page, the browser saves them.
    """

    def __init__(
        self,
        scene_view: SceneView,
        name: str,
        send: _Send,
        moved: Callable[[SceneView], None],
        up: VectorLike = (0.0, 0.0, 1.0),
        edits_folder: Path | None = None,
    ) -> None:
        self.scene_view = scene_view
        self._up = up
        self._name = name
        self._send = send
        self._moved = moved
        self._edits_folder = edits_folder
        self._exporter = Exporter(self._tell, lambda error: self.scene_view.explain(error))
        self._loop = RenderLoop(scene_view, self._show, self._fail)
        self._look: messages.Look | None = None
        self._picking = threading.Lock()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._dropped: IO[bytes] | None = None
        self._missing_bytes = 0

    def close(self, seconds: float) -> bool:
        """Stop drawing and saving. Wait at most `seconds` for each thread. Return
        whether all threads have ended."""
        has_ended = all([self._loop.close(seconds), self._exporter.close(seconds)])
        if has_ended and self._folder is not None:
            self._folder.cleanup()
        return has_ended

    def ask_again(self) -> None:
        """Draw again after the subject has changed."""
        if self._look is not None:
            self._loop.ask(self._look.request())

    def take(self, data: str | bytes) -> None:
        """Execute a message from the web page.

        Raises:
            ValueError: The message is invalid.
        """
        if isinstance(data, bytes):
            self._take_bytes(data)
            return
        message = messages.read_message(data)
        match message:
            case messages.Look():
                self._look = message
                self.ask_again()
            case messages.Pick():
                self._begin_picking(message)
            case messages.Move():
                self._move(message)
            case messages.Save():
                self._exporter.begin(functools.partial(self._save, message))
            case messages.Crop():
                self._exporter.begin(lambda _: self._crop(message))
            case messages.Stop():
                self._exporter.stop()
            case messages.Open():
                self._begin_file(message)

    def describe_scene(self) -> answers.Scene:
        """Return the description of the subject that the web page needs."""
        scene_view = self.scene_view
        bundles = scene_view.scene.bundles
        num_missing = np.arange(4)
        return answers.Scene(
            name=self._name,
            center=_vector(scene_view.center),
            radius=scene_view.radius,
            near=scene_view.near,
            homes=self._homes(),
            instances=len(scene_view.scene),
            writes_files=self._edits_folder is not None,
            has_files=self._folder is None and all(bundle.path for bundle in bundles),
            level_colors=_colors(_core.level_colors(scene_view.num_levels)),
            ramp=_colors(_core.ramp(np.linspace(0, 1, 7))),
            most_counted=MOST_COUNTED,
            modes=scene_view.modes,
            shows_cuts=scene_view.shows_cuts,
            missing_colors=_colors(_core.missing_colors(4.0**num_missing)),
        )

    def _homes(self) -> list[answers.Home]:
        """Return the first views for windows from narrow to wide."""
        homes = []
        for aspect in _HOME_ASPECTS:
            view, focus = self.scene_view.first_view(self._up, aspect)
            homes.append(answers.Home(view, _vector(focus)))
        return homes

    def _tell(self, answer: answers.Answer, data: bytes = b"") -> None:
        self._send(answers.encode(answer, data))

    def _show(self, frame: Frame, number: int, *, is_final: bool) -> None:
        quality = _DRAFT_QUALITY
        subsampling = _HALF_COLORS
        if is_final:
            quality = _FINAL_QUALITY
            subsampling = _WHOLE_COLORS
        picture = io.BytesIO()
        Image.fromarray(frame.pixels).save(
            picture, "jpeg", quality=quality, subsampling=subsampling
        )
        stats = frame.figures
        figures = answers.Figures(
            gaussians_selected=stats.gaussians_selected,
            gaussians_in_frustum=stats.gaussians_in_frustum,
            tolerance=stats.tolerance,
            select_ms=stats.select_ms,
            draw_ms=stats.draw_ms,
            levels=stats.levels,
            missing=stats.missing,
            memory_bytes=_system.resident_memory(),
        )
        answer = answers.Picture(
            final=is_final,
            number=number,
            size=frame.size,
            view=frame.view,
            shows=frame.shows,
            range=frame.value_range,
            distance=frame.distance,
            figures=figures,
        )
        self._tell(answer, picture.getvalue())

    def _fail(self, error: Exception) -> None:
        self._tell(answers.Failed(self.scene_view.explain(error)))

    def _move(self, message: messages.Move) -> None:
        self.scene_view.scene.move(
            [message.instance],
            positions=[message.position],
            quaternions=message.quaternion,
            scales=message.scale,
        )
        self._moved(self.scene_view)

    def _begin_picking(self, message: messages.Pick) -> None:
        """Answer in a separate thread. If an earlier request is still unanswered, this
        one is ignored."""
        if self._picking.acquire(blocking=False):
            threading.Thread(
                target=self._pick, args=(message,), name="v3dg pick", daemon=True
            ).start()

    def _pick(self, message: messages.Pick) -> None:
        try:
            self._tell(self._find(message))
        except Exception as error:
            with contextlib.suppress(Exception):  # the web page may be closed
                self._tell(answers.Notice(self.scene_view.explain(error)))
        finally:
            self._picking.release()

    def _find(self, message: messages.Pick) -> answers.Picked:
        """Return the instance that the web page has named, or the one at a point of its
        picture."""
        if message.instance is not None:
            return self._describe_instance(message.instance)
        if not self.scene_view.shows_cuts:
            return answers.Picked()
        request = message.look.request()
        width, height = request.size
        x = min(int(message.place[0] * width), width - 1)
        y = min(int(message.place[1] * height), height - 1)
        picked = self.scene_view.pick(request.view, request.size, x, y, request.settings)
        if picked is None or picked.weight < _LEAST_WEIGHT:
            return answers.Picked()
        answer = self._describe_instance(picked.instance)
        answer.point = _vector(picked.position)
        return answer

    def _describe_instance(self, number: int) -> answers.Picked:
        scene = self.scene_view.scene
        bundle = scene.bundles[scene.instance_bundle[self._checked_instance(number)]]
        boxes = bundle.clusters.box[: bundle.level_range(0).stop]
        w, x, y, z = scene.quaternions[number].tolist()
        pose = answers.Pose(
            position=_vector(scene.positions[number]),
            quaternion=(w, x, y, z),
            scale=float(scene.scales[number]),
        )
        return answers.Picked(
            instance=number,
            pose=pose,
            box=(_vector(boxes[:, 0].min(axis=0)), _vector(boxes[:, 1].max(axis=0))),
            bundle=beside(bundle.path or "").name,
        )

    def _save(self, message: messages.Save, stop: _core.Stop) -> None:
        match message.output:
            case "picture":
                self._save_picture(message, stop)
            case "film":
                self._save_film(message, stop)
            case "cameras":
                self._save_cameras(message)
            case "scene":
                self._save_scene(message)
            case "play":
                self._tell(answers.Play(_FPS, message.camera_path().film(_FPS)))

    def _save_picture(self, message: messages.Save, stop: _core.Stop) -> None:
        request = message.look.request()
        frame = self.scene_view.frame(
            request.view, request.size, request.settings, stop, patience=math.inf
        )
        self._exporter.save(f"{self._name}.png", Image.fromarray(frame.pixels).save)

    def _save_film(self, message: messages.Save, stop: _core.Stop) -> None:
        request = message.look.request()
        views = message.camera_path().film(_FPS)
        # H.264 requires an even width and height.
        width = max(request.size[0] // 2 * 2, 2)
        height = max(request.size[1] // 2 * 2, 2)
        steps = _core.BudgetSteps()

        def pictures() -> Iterator[Pixels]:
            last_progress = 0.0
            for number, view in enumerate(views):
                if time.monotonic() - last_progress > _SECONDS_BETWEEN_PROGRESS:
                    self._tell(answers.Progress(number / len(views)))
                    last_progress = time.monotonic()
                view = replace(view, aspect=width / height)
                frame = self.scene_view.frame(
                    view, (width, height), request.settings, stop, steps, patience=math.inf
                )
                yield frame.pixels

        self._exporter.save(
            f"{self._name}.mp4", lambda file: write_video(file, pictures(), fps=_FPS)
        )

    def _save_cameras(self, message: messages.Save) -> None:
        size = message.look.request().size
        cameras = message.camera_path().cameras(_FPS, *size, self.scene_view.near)
        self._exporter.save("transforms.json", lambda file: write_cameras(file, cameras))

    def _save_scene(self, message: messages.Save) -> None:
        """Save the current instances, the up axis, and the cameras of the path."""
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

    def _crop(self, message: messages.Crop) -> None:
        """Save a part of level 0 of a bundle as a new asset."""
        scene = self.scene_view.scene
        bundle = scene.bundles[scene.instance_bundle[self._checked_instance(message.instance)]]
        whole = bundle.level_gaussians(0)
        part = crop_box(whole, *message.box, keep=message.keep)
        name = message.name
        counts = f"{len(part):,} of {len(whole):,} gaussians"
        if not len(part):
            raise ValueError(f"box: nothing remains of {len(whole):,} gaussians; change the box")
        if self._edits_folder is None:
            self._exporter.save(name, lambda file: write_asset(file, part))
            self._tell(answers.Notice(f"{name} contains {counts}."))
            return
        write_new_asset(self._edits_folder, name, part)
        self._tell(
            answers.Notice(
                f"{name} was written beside the file that is shown; it contains {counts}."
            )
        )

    def _checked_instance(self, number: int) -> int:
        count = len(self.scene_view.scene)
        if number >= count:
            raise ValueError(f"instance: expected 0 to {count - 1}, got {number}")
        return number

    def _begin_file(self, message: messages.Open) -> None:
        """Create a file for the binary data that follows. Its folder is removed
        together with the tab."""
        self._folder = self._folder or tempfile.TemporaryDirectory(prefix="v3dg_")
        if self._dropped is not None:
            self._dropped.close()
        folder = tempfile.mkdtemp(dir=self._folder.name)
        self._dropped = open(Path(folder, message.name), "wb")  # noqa: SIM115  # it is closed after its last bytes
        self._missing_bytes = message.size

    def _take_bytes(self, data: bytes) -> None:
        file = self._dropped
        if file is None:
            raise ValueError("file: data arrived before its name; send `open` first")
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
        # Web pages must not get the names of folders on this machine.
        except (OSError, ValueError) as error:
            raise ValueError(str(error).replace(f"{path.parent}{os.sep}", "")) from None
        scene_view = SceneView(subject, device=self.scene_view.device)
        old_loop = self._loop
        self.scene_view = scene_view
        self._name = subject_name(path)
        self._edits_folder = None
        self._loop = RenderLoop(scene_view, self._show, self._fail)
        old_loop.close(0.0)
        self._tell(self.describe_scene())


def _vector(array: npt.NDArray[np.floating]) -> answers.Vector:
    x, y, z = array.tolist()
    return x, y, z


def _colors(colors: npt.NDArray[np.float32]) -> list[answers.Color]:
    return [(red, green, blue) for red, green, blue in to_8bit(colors).tolist()]
