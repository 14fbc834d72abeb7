"""The web page: viser's controls around our pictures; each browser tab has its own camera and settings."""

from __future__ import annotations

import contextlib
import html
import io
import logging
import math
import os
import socket
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg.camera_file import write_cameras
from v3dg.cameras import Camera, VectorLike
from v3dg.false_color import LEVEL_COLORS
from v3dg.scene_file import write_scene
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.video import write_film
from v3dg.viewer.frame import MOST_COUNTED, Frame, Settings, Shows, Stage, ramp
from v3dg.viewer.pacing import Painter, Request
from v3dg.viewer.path import CameraPath
from v3dg.viewer.view import View, look_at

if TYPE_CHECKING:
    import viser

_FOV_Y = math.radians(45)
_SHOWS: dict[str, Shows] = {
    "Colour": "appearance",
    "Level": "level",
    "Cluster": "cluster",
    "Depth": "depth",
    "Alpha": "alpha",
    "Gaussians per pixel": "count",
    "Difference to all gaussians": "difference",
}
_WANTS_LEVELS = ("level", "difference")
_NO_CAMERA = ""
_FILM_SIZES = {"1280 x 720": (1280, 720), "1920 x 1080": (1920, 1080), "as the window": None}
_FPS = 30
# Pictures that pass by, and those that stay.
_DRAFT_QUALITY, _FINAL_QUALITY = 75, 94
_SECONDS_BETWEEN_FIGURES = 0.2


class Site:
    """The viewer as a web server, from when it is made until `close`.

    Args:
        stage: What to show.
        name: Title of the page.
        cameras: Named cameras to jump to.
        host: Address to listen at; ``"0.0.0.0"`` lets anyone in who reaches this machine.
        port: Where to listen; the next free one where it is taken.
        tolerance, budget: What a page begins with.
        up: (3,) direction in the world.

    Attributes:
        port: The one that was free.

    Raises:
        ImportError: The extra is not installed.
        ValueError: ``host`` is not an address of this machine.
    """

    def __init__(
        self,
        stage: Stage,
        *,
        name: str = "v3dg",
        cameras: Mapping[str, Camera] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        tolerance: float = DEFAULT_TOLERANCE,
        budget: int | None = None,
        up: VectorLike = (0.0, 0.0, 1.0),
    ) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                "the viewer wants viser, which is not installed; pip install 'v3dg[viewer]'"
            ) from error
        try:  # or viser would try a thousand ports of an address that is not ours, and then wait for ever
            family, kind, *_ = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind) as probe:
                probe.bind((host, 0))
        except OSError as error:
            raise ValueError(
                f"host: expected an address of this machine, got {host} ({error.strerror})"
            ) from error
        # A tab may be closed while a picture is on its way to it.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self._pages: dict[int, _Page] = {}
        self._lock = threading.Lock()
        logging.getLogger("websockets.server").addFilter(_is_news)
        with _quiet():
            self._server = viser.ViserServer(host=host, port=port, label=name, verbose=False)
        self.port = self._server.get_port()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()  # beside the picture, not over it
        self._server.scene.set_up_direction(_three(up))
        start = start_view(stage, up)
        first = self._server.initial_camera
        first.position, first.look_at = start.position, _three(stage.center)
        first.up, first.fov = _three(up), _FOV_Y

        def connect(client: viser.ClientHandle) -> None:
            page = _Page(
                client, stage, name, cameras or {}, Settings(tolerance=tolerance, budget=budget), start
            )
            with self._lock:
                self._pages[client.client_id] = page

        def disconnect(client: viser.ClientHandle) -> None:
            with self._lock:
                page = self._pages.pop(client.client_id, None)
            if page is not None:
                page.close()

        self._server.on_client_connect(connect)
        self._server.on_client_disconnect(disconnect)

    def close(self) -> None:
        """End all pages and the server; returns when their threads have ended."""
        with self._lock:
            pages = list(self._pages.values())
            self._pages.clear()
        for page in pages:
            page.close()
        with _quiet():
            self._server.stop()


def start_view(stage: Stage, up: VectorLike, aspect: float = 16 / 9) -> View:
    """Return the view that a page begins with: all of the scene, from a little above."""
    axis = np.asarray(up, np.float64)
    axis = axis / np.linalg.norm(axis)
    # Of the world's axes the one that comes after the upright one, so that no two are parallel.
    aside = np.roll(np.eye(3)[int(np.abs(axis).argmax())], 1)
    aside = aside - (aside @ axis) * axis
    direction = math.cos(0.45) * aside / np.linalg.norm(aside) + math.sin(0.45) * axis
    distance = 0.95 * stage.radius / math.sin(_FOV_Y / 2)
    return look_at(stage.center + distance * direction, stage.center, axis, _FOV_Y, aspect)


class _Page:
    """One browser tab."""

    def __init__(
        self,
        client: viser.ClientHandle,
        stage: Stage,
        name: str,
        cameras: Mapping[str, Camera],
        settings: Settings,
        start: View,
    ) -> None:
        self._client, self._stage, self._name, self._home = client, stage, name, start
        self._frozen: View | None = None
        self._path, self._recording, self._path_lock = CameraPath(), False, threading.Lock()
        self._work: threading.Thread | None = None
        self._stop_work = threading.Event()
        self._last_figures = 0.0
        self._add_controls(cameras, settings)
        self._painter = Painter(stage, self._show, self._explain)

        async def moved(_: viser.CameraHandle) -> None:  # on the event loop, so in the order of the moves
            if self._recording:
                with self._path_lock:
                    self._path.record(self._view(), time.monotonic())
            self._ask()

        client.camera.on_update(moved)
        self._ask()

    def close(self) -> None:
        self._stop_work.set()
        if self._work is not None:
            self._work.join()
        self._painter.close()

    # What is looked at.

    def _view(self) -> View:
        camera = self._client.camera
        w, x, y, z = (float(v) for v in camera.wxyz)
        px, py, pz = (float(v) for v in camera.position)
        return View((w, x, y, z), (px, py, pz), float(camera.fov), float(camera.aspect))

    def _size(self) -> tuple[int, int]:
        camera = self._client.camera
        scale = self._resolution.value / 100
        return max(1, round(scale * camera.image_width)), max(1, round(scale * camera.image_height))

    def _settings(self) -> Settings:
        return Settings(
            shows=_SHOWS[self._shows.value],
            tolerance=float(self._tolerance.value),
            budget=round(1e6 * self._budget.value) if self._limits.value else None,
            min_level=int(self._min_level.value),
            gain=float(self._gain.value),
            split=float(self._split.value),
            frozen=self._frozen,
        )

    def _ask(self) -> None:
        self._painter.ask(Request(self._view(), self._size(), self._settings()))

    def _look(self, view: View) -> None:
        """Take the browser's camera there, to turn about what is in the middle, as far away as the scene."""
        camera, eye = self._client.camera, np.asarray(view.position)
        forward = view.camera(1, 1, self._stage.near).viewmat[2, :3]
        distance = max(float((self._stage.center - eye) @ forward), 0.05 * self._stage.radius)
        with self._client.atomic():
            camera.position = eye
            camera.look_at = eye + distance * forward
            camera.wxyz = np.asarray(view.wxyz)  # whose roll the point alone leaves open
            camera.fov = view.fov_y

    def _look_from(self, camera: Camera | None) -> None:
        if camera is not None:
            self._look(View.of_camera(camera))

    # What is shown.

    def _show(self, frame: Frame, is_final: bool) -> None:
        quality = _FINAL_QUALITY if is_final else _DRAFT_QUALITY
        self._client.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=quality)
        self._client.flush()  # which viser would wait for a sixtieth of a second with
        now = time.monotonic()
        if is_final or now - self._last_figures > _SECONDS_BETWEEN_FIGURES:
            self._last_figures = now
            self._figures.content = figures_html(frame)

    def _explain(self, error: Exception) -> None:
        self._figures.content = _box(f"<b>Not drawn.</b> {html.escape(' '.join(str(error).split()))}")

    # The controls.

    def _add_controls(self, cameras: Mapping[str, Camera], settings: Settings) -> None:
        gui: Any = self._client.gui  # whose types let no value be set
        has_levels = self._stage.num_levels > 1
        self._figures = gui.add_html(_box("drawing ..."))
        names = [name for name, shows in _SHOWS.items() if has_levels or shows not in _WANTS_LEVELS]
        self._shows = gui.add_dropdown("Show", names)
        self._shows.on_update(lambda _: self._choose_shows())
        self._gain = gui.add_slider("Amplify", 1, 50, 1, round(settings.gain), visible=False)
        self._gain.on_update(lambda _: self._ask())
        self._add_cut_controls(settings, has_levels)
        self._resolution = gui.add_slider(
            "Resolution %", 10, 100, 5, 100, hint="Of the window, at rest; while moving it follows the speed."
        )
        self._resolution.on_update(lambda _: self._ask())
        gui.add_button("Save picture").on_click(lambda _: self._begin(self._save_picture))
        with gui.add_folder("Camera", expand_by_default=False):
            gui.add_button("Show all").on_click(lambda _: self._look(self._home))
            if cameras:
                names = gui.add_dropdown("Of the file", (_NO_CAMERA, *cameras))
                names.on_update(lambda _: self._look_from(cameras.get(names.value)))
            gui.add_markdown("Drag to turn, right button to move, wheel to go near, W A S D Q E to fly.")
        with gui.add_folder("Path", expand_by_default=False):
            self._add_path_controls()

    def _add_cut_controls(self, settings: Settings, visible: bool) -> None:
        """Those that choose among levels."""
        gui: Any = self._client.gui
        tolerance = float(settings.tolerance)  # a slider's values are of the type of its first
        self._tolerance = gui.add_slider(
            "Tolerance px²",
            0.0,
            max(32.0, tolerance),
            0.25,
            tolerance,
            visible=visible,
            hint="Screen area that one gaussian of a coarser cluster may stand for; 0 draws all.",
        )
        self._limits = gui.add_checkbox(
            "Limit gaussians",
            settings.budget is not None,
            visible=visible,
            hint="The tolerance is raised until no more than so many are selected.",
        )
        millions = 2.0 if settings.budget is None else settings.budget / 1e6
        self._budget = gui.add_slider(
            "Millions",
            min(0.01, millions),
            max(20.0, millions),
            0.01,
            millions,
            visible=visible and settings.budget is not None,
        )
        last_level = max(self._stage.num_levels - 1, 1)
        self._min_level = gui.add_slider("Finest level", 0, last_level, 1, 0, visible=visible)
        hint = "All gaussians on the left, the cut on the right."
        self._split = gui.add_slider("Split", 0.0, 1.0, 0.01, 0.0, visible=visible, hint=hint)
        for slider in (self._tolerance, self._budget, self._min_level, self._split):
            slider.on_update(lambda _: self._ask())
        self._limits.on_update(lambda _: self._choose_limits())
        hint = "Keep what this camera needs, and fly around it."
        self._freeze = gui.add_checkbox("Freeze the cut", False, visible=visible, hint=hint)
        self._freeze.on_update(lambda _: self._choose_freeze())

    def _add_path_controls(self) -> None:
        gui: Any = self._client.gui
        self._path_text = gui.add_markdown("")
        self._pause = gui.add_slider("Seconds a view", 0.5, 10.0, 0.5, 2.0)
        gui.add_button("Add this view").on_click(lambda _: self._add_to_path())
        self._record = gui.add_checkbox("Record", False, hint="Keep every view while you fly.")
        self._record.on_update(lambda _: self._choose_record())
        gui.add_button("Clear").on_click(lambda _: self._clear_path())
        gui.add_button("Play").on_click(lambda _: self._begin(self._play))
        self._film_size = gui.add_dropdown("Size", tuple(_FILM_SIZES))
        gui.add_button("Save film (.mp4)").on_click(lambda _: self._begin(self._save_film))
        gui.add_button("Save cameras (transforms.json)").on_click(lambda _: self._begin(self._save_cameras))
        if all(bundle.path is not None for bundle in self._stage.scene.bundles):
            gui.add_button("Save scene (.json)").on_click(lambda _: self._begin(self._save_scene))
        self._progress = gui.add_progress_bar(0.0, visible=False)
        gui.add_button("Stop").on_click(lambda _: self._stop_work.set())
        self._tell_path()

    def _choose_shows(self) -> None:
        self._gain.visible = _SHOWS[self._shows.value] == "difference"
        self._ask()

    def _choose_limits(self) -> None:
        self._budget.visible = self._limits.value
        if self._limits.value:
            self._tolerance.value = 0.0
        elif self._tolerance.value == 0.0:
            self._tolerance.value = DEFAULT_TOLERANCE
        self._ask()

    def _choose_freeze(self) -> None:
        self._frozen = self._view() if self._freeze.value else None
        if self._frozen is None:
            self._client.scene.remove_by_name("/frozen")
        else:
            self._client.scene.add_camera_frustum(
                "/frozen",
                self._frozen.fov_y,
                self._frozen.aspect,
                scale=0.05 * self._stage.radius,
                thickness=2.0,
                thickness_units="screen",
                color=(255, 190, 60),
                wxyz=self._frozen.wxyz,
                position=self._frozen.position,
            )
        self._ask()

    # The path.

    def _tell_path(self) -> None:
        with self._path_lock:
            count, seconds = len(self._path), self._path.seconds
        self._path_text.content = f"{count} views, {seconds:.1f} s" if count else "no views yet"

    def _add_to_path(self) -> None:
        with self._path_lock:
            self._path.add(self._view(), float(self._pause.value))
        self._tell_path()

    def _choose_record(self) -> None:
        self._recording = self._record.value
        with self._path_lock:
            now = time.monotonic()
            if self._recording:
                self._path = CameraPath([now], [self._view()])
            elif len(self._path) and self._path.views[-1] != self._view():
                self._path.add(self._view(), now - self._path.times[-1])  # to end where the camera rests
        self._tell_path()

    def _clear_path(self) -> None:
        with self._path_lock:
            self._path = CameraPath()
        self._tell_path()

    def _copy_of_path(self) -> CameraPath:
        with self._path_lock:
            if not len(self._path):
                raise ValueError("path: expected at least one view; add this one, or record while you fly")
            return CameraPath(list(self._path.times), list(self._path.views))

    # What takes long: one at a time, in a thread, until it is done or stopped.

    def _begin(self, work: Callable[[], None]) -> None:
        if self._work is not None and self._work.is_alive():
            self._client.add_notification("Still at work", "Stop it first, or wait.", auto_close_seconds=4)
            return
        self._stop_work.clear()

        def run() -> None:
            try:
                work()
            except Exception as error:
                text = " ".join(str(error).split())
                self._client.add_notification("Not done", text, color="red", auto_close_seconds=10)
            finally:
                self._progress.visible = False

        self._work = threading.Thread(target=run, name="v3dg export", daemon=True)
        self._work.start()

    def _play(self) -> None:
        path = self._copy_of_path()
        start = time.monotonic()
        while not self._stop_work.wait(1 / _FPS):
            seconds = time.monotonic() - start
            self._look(path.at(seconds))
            if seconds >= path.seconds:
                return

    def _save_picture(self) -> None:
        from PIL import Image

        frame = self._stage.frame(self._view(), self._size(), self._settings())
        file = io.BytesIO()
        Image.fromarray(frame.pixels).save(file, "PNG")
        self._download(f"{self._name}.png", file.getvalue())

    def _save_film(self) -> None:
        views = self._copy_of_path().views_at(_FPS)
        width, height = _FILM_SIZES[self._film_size.value] or self._size()
        width, height = width // 2 * 2, height // 2 * 2  # as H.264 wants it
        settings = self._settings()
        self._progress.value, self._progress.visible = 0.0, True

        def pictures() -> Iterator[Any]:
            for place, view in enumerate(views):
                if self._stop_work.is_set():
                    raise ValueError("the film was stopped")
                yield self._stage.frame(
                    replace(view, aspect=width / height), (width, height), settings
                ).pixels
                self._progress.value = 100 * (place + 1) / len(views)

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "film.mp4")
            write_film(path, pictures(), fps=_FPS)
            self._download(f"{self._name}.mp4", path.read_bytes())

    def _cameras(self) -> dict[str, Camera]:
        width, height = self._size()
        return self._copy_of_path().cameras(_FPS, width, height, self._stage.near)

    def _save_cameras(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "transforms.json")
            write_cameras(path, self._cameras())
            self._download(path.name, path.read_bytes())

    def _save_scene(self) -> None:
        bundles = [os.path.abspath(bundle.path or "") for bundle in self._stage.scene.bundles]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "scene.json")
            write_scene(path, self._stage.scene, bundles, self._cameras())
            self._download(f"{self._name}.json", path.read_bytes())

    def _download(self, name: str, content: bytes) -> None:
        self._client.send_file_download(name, content, save_immediately=True)


def figures_html(frame: Frame) -> str:
    """Return a frame's figures, what its colours mean, and its gaussians by level, as HTML."""
    figures = frame.figures
    width, height = frame.size
    rows = [
        ("selected", f"{figures.gaussians_selected:,}"),
        ("in view", f"{figures.gaussians_in_view:,}"),
        ("tolerance", f"{figures.tolerance:.3g} px²"),
        ("select", f"{figures.select_ms:.1f} ms"),
        ("draw", f"{figures.draw_ms:.1f} ms"),
        ("picture", f"{width} x {height}"),
        ("memory", f"{figures.memory_bytes / (1 << 20):,.0f} MiB"),
    ]
    cells = "".join(
        f'<tr><td style="opacity:.65">{name}</td><td style="text-align:right">{value}</td></tr>'
        for name, value in rows
    )
    table = f'<table style="width:100%;border-spacing:0">{cells}</table>'
    return _box(table + _legend(frame) + _levels(frame))


def _legend(frame: Frame) -> str:
    if frame.value_range is None:
        return ""
    if frame.shows == "count":
        marks = ["1", "4", "16", "64", f"{MOST_COUNTED}+"]
    else:
        low, high = frame.value_range
        marks = [f"{low:.3g}", f"{high:.3g}"]
        if frame.shows == "depth":
            marks = [f"far {marks[0]}", f"near {marks[1]}"]
    grey = np.linspace(0, 1, 7)
    colors = np.repeat(grey[:, None], 3, axis=1) if frame.shows == "alpha" else ramp(grey)
    stops = ",".join(_css(color) for color in colors)
    labels = "".join(f"<span>{mark}</span>" for mark in marks)
    return (
        f'<div style="height:8px;margin-top:6px;background:linear-gradient(90deg,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{labels}</div>'
    )


def _levels(frame: Frame) -> str:
    """Bars of the selected gaussians by level, in the colours of the levels."""
    levels = frame.figures.levels
    if len(levels) < 2:
        return ""
    most = max(int(levels.max()), 1)
    bars = "".join(
        f'<div title="level {level}: {count:,}" style="flex:1;height:{max(100 * count / most, 1):.0f}%;'
        f'background:{_css(LEVEL_COLORS[level % len(LEVEL_COLORS)])}"></div>'
        for level, count in enumerate(levels)
    )
    return (
        '<div style="display:flex;align-items:flex-end;gap:2px;height:44px;margin-top:8px">'
        f"{bars}</div>"
        '<div style="display:flex;justify-content:space-between;opacity:.65">'
        f"<span>level 0</span><span>selected by level</span><span>{len(levels) - 1}</span></div>"
    )


def _box(content: str) -> str:
    return (
        f'<div style="font-size:.8em;padding:0 .9em .4em;font-variant-numeric:tabular-nums">{content}</div>'
    )


def _css(color: Any) -> str:
    red, green, blue = (round(255 * float(c)) for c in color)
    return f"rgb({red},{green},{blue})"


def _three(vector: VectorLike) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z


def _is_news(record: logging.LogRecord) -> bool:
    """Not that somebody connected and said nothing, as browsers and forwarded ports do ahead of time."""
    return record.getMessage() != "opening handshake failed"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what viser prints when it starts and stops: the command says where the page is."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
