"""`v3dg render`."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg import _device, _extras, _files
from v3dg._json import JsonObject
from v3dg._progress import counted
from v3dg._urls import shown
from v3dg.cameras import Axis, Camera
from v3dg.cleaning import examine
from v3dg.cli._common import (
    Color,
    Column,
    Cut,
    OnAnyDevice,
    Pooled,
    check_output,
    check_range,
    check_usage,
    color_of,
    finite,
    open_subject,
    option,
    print_result,
    table_lines,
)
from v3dg.cli._views import ViewOptions, Views, choose_cameras, choose_up, picture_paths
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.image import Image, RenderedImage
from v3dg.io import subject_name
from v3dg.panorama import draw_panorama
from v3dg.pictures import check_picture_path, check_size
from v3dg.render import Renderer, render
from v3dg.render.rays import RayImage
from v3dg.scene import Subject
from v3dg.select import DEFAULT_FADE, CutOptions
from v3dg.spherical import EquirectangularCamera
from v3dg.upright import direction_of
from v3dg.video import write_video

_PANORAMA_SIZE = (1600, 800)
_MOST_SECONDS = 600.0  # the same limit as for camera paths of the viewer


@dataclass
class Render(Cut, Pooled, OnAnyDevice):
    """Draw a scene, a bundle or an asset. The cameras are those of its file, those of
    --cameras, one at a given position, or else first views that show the whole
    subject."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg) or an asset (.ply, .spz, ...)."""
    output: Annotated[Path | None, option("PATH", "-o")] = None
    """Picture (.png or .jpg) or film (.mp4) to write. The names of several pictures
    also contain a number or the name of the camera. By default, the picture is named
    after the subject."""
    min_level: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Draw no level finer than this, except for bundles with fewer levels."""
    fade: Annotated[float | None, option("FACTOR")] = None
    """Blend two levels within this factor of the tolerance, and draw level 0 with a
    low-pass filter, so that a film neither pops nor flickers. The default is 1.02 for
    films and for several views around the subject, otherwise 1, which means no
    blending."""
    color_by: ColorBy = "appearance"
    """The property that colours represent."""
    background: Annotated[
        tuple[float, float, float] | str, tyro.conf.arg(metavar="R G B|COLOR|none")
    ] = (0.0, 0.0, 0.0)
    """Background: red, green and blue from 0 to 1, a colour such as white or #87ceeb,
    or none for a transparent .png (straight alpha)."""
    projection: Literal["pinhole", "equirectangular"] = "pinhole"
    """Draw the view of the camera, or all directions around it, for which the width in
    --size must be twice the height. Gaussians are then evaluated on the ray of
    each pixel, which needs all of them in memory. With --budget, with another
    --color-by or with a pool, the picture is combined from 26 pinholes, which is less
    exact."""
    fps: Annotated[int, tyro.conf.arg(metavar="N")] = 30
    """Pictures per second of a film."""
    seconds: Annotated[float | None, option("S")] = None
    """Duration of a film in seconds, along a smooth curve through the cameras at
    constant speed. By default, a film has one picture for each camera."""
    view: Views = field(default_factory=ViewOptions)

    @property
    def is_film(self) -> bool:
        return self.output is not None and self.output.suffix.lower() == ".mp4"

    @property
    def is_panorama(self) -> bool:
        return self.projection == "equirectangular"

    @property
    def panorama_size(self) -> tuple[int, int]:
        """The width and height of pictures of all directions."""
        return self.view.size or _PANORAMA_SIZE


@dataclass(frozen=True)
class _Style:
    """Properties that are common to all pictures of a command.

    Attributes:
        background: The colour behind the gaussians; None for transparent pictures.
        up: The axis that points up, for panoramas.
    """

    background: Color | None
    fade: float | None
    up: Axis


def run(options: Render) -> None:
    options.view.check(options.subject)
    background = color_of(options.background)
    output = _checked_output(options, background)
    device = _device.resolve_for_drawing(options.device)
    subject, own_cameras = open_subject(options.subject, show=not options.quiet)
    notes: list[str] = []
    needs_up = options.view.needs_up(own_cameras)
    up = options.view.up
    if needs_up or options.is_panorama:
        up, notes = choose_up(up, subject, own_cameras, options.subject)
    if needs_up:
        options.view.up = up
    cameras = choose_cameras(options.view, options.subject, subject, own_cameras)
    _check_sizes(options, cameras)
    if options.seconds is not None:
        cameras = _flight(cameras, options.seconds, options.fps)
    notes += _lines_of_faults(options.subject, subject)
    fade = options.fade
    is_sequence = options.is_film or (needs_up and len(cameras) > 1)
    if fade is None and is_sequence:
        fade = DEFAULT_FADE
    style = _Style(background, fade, up or "z")
    # With a fade, pictures count as a sequence, in which the tolerance of a budget
    # changes in steps.
    renderer = Renderer(subject, color_by=options.color_by, device=device, memory=options.pool())
    pictures: list[JsonObject] = []
    drawn = _drawn(options, renderer, cameras, style, pictures)
    if options.is_film:
        write_video(output, (image.color for image in drawn), fps=options.fps)
    else:
        _write_pictures(
            picture_paths(output, cameras), drawn, pictures, is_transparent=background is None
        )
    if options.is_panorama and not _casts_rays(options, renderer):
        notes.append("panorama: combined from 26 pinholes; rays are more exact (see --projection)")
    _print(options, pictures, notes, output)


def _casts_rays(options: Render, renderer: Renderer) -> bool:
    """Return whether panoramas are drawn with rays, which have neither budgets nor
    false colours, need all gaussians in memory, and are not drawn by WebGPU."""
    is_plain = options.budget is None and options.color_by == "appearance"
    is_plain = is_plain and options.device != "webgpu"
    return options.is_panorama and is_plain and renderer.memory is None


def _print(options: Render, pictures: list[JsonObject], notes: list[str], output: Path) -> None:
    columns = [
        Column("picture", "{picture}"),
        Column("size", "{width} x {height}"),
        Column("selected", "{gaussians_selected:,}"),
    ]
    if "draw_ms" in pictures[0]:
        columns += [
            Column("in frustum", "{gaussians_in_frustum:,}"),
            Column("select ms", "{select_ms:.1f}"),
            Column("draw ms", "{draw_ms:.1f}"),
        ]
    result: JsonObject = {"subject": shown(options.subject), "pictures": pictures}
    lines = table_lines(columns, pictures)
    if options.is_film:
        result["film"] = str(output)
        seconds = len(pictures) / options.fps
        size = "{width} x {height}".format_map(pictures[0])
        lines = [f"{output}: {len(pictures)} pictures of {size}, {seconds:.1f} s"]
    print_result(result, [*lines, *notes], as_json=options.json)


def _checked_output(options: Render, background: Color | None) -> Path:
    """Return the path of the output. Before anything is read, raise an error if it
    cannot be written, or if options do not apply to it."""
    output = options.output or Path(f"{subject_name(options.subject)}.png")
    check_output(output, options.subject)
    check_usage("--fps", 1 <= options.fps <= 1000, f"a number from 1 to 1000, got {options.fps}")
    if options.seconds is not None:
        check_usage(
            "--seconds", options.is_film, f"a film (.mp4) as output, got {output}; leave it out"
        )
        check_range("--seconds", options.seconds, 0.1, _MOST_SECONDS)
    if options.is_panorama:
        width, height = options.panorama_size
        fits = width == 2 * height and width >= 8
        advice = "for example, use --size 2048 1024"
        check_usage(
            "--size", fits, f"a width of twice the height, got {width} x {height}; {advice}"
        )
    if options.is_film:
        check_usage("--background", background, "a colour for a film, got none; choose one")
        _extras.load("av")
        _files.make_folder(output)
        _files.status_of_replaced(output)
    else:
        output = check_picture_path(output)
        is_png = output.suffix.lower() == ".png"
        check_usage(
            "--background",
            background or is_png,
            f"a .png for a transparent background, got {output}; choose a colour or a .png",
        )
        _files.make_folder(output)
    return output


def _check_sizes(options: Render, cameras: Mapping[str, Camera]) -> None:
    """Raise an error for pictures that cannot form a film."""
    if options.is_panorama:
        check_size("--size", *options.panorama_size)
    if not options.is_film:
        return
    sizes = {(camera.width, camera.height) for camera in cameras.values()}
    if options.is_panorama:
        sizes = {options.panorama_size}
    width, height = min(sizes)
    fits = len(sizes) == 1 and width % 2 == 0 and height % 2 == 0
    texts = ", ".join(f"{width} x {height}" for width, height in sorted(sizes)[:3])
    expected = f"pictures with equal and even sizes for a film, got {texts}"
    check_usage(str(options.output), fits, expected)


def _flight(cameras: Mapping[str, Camera], seconds: float, fps: int) -> dict[str, Camera]:
    """Return the cameras of a film along a smooth curve through these cameras, which
    all have the same size."""
    from v3dg.viewer.path import CameraPath
    from v3dg.viewer.view import View

    names = ", ".join(cameras)
    check_usage("--seconds", len(cameras) > 1, f"at least two cameras, got only {names}")
    path = CameraPath.through([View.of_camera(camera) for camera in cameras.values()], seconds)
    first = next(iter(cameras.values()))
    near = min(camera.near for camera in cameras.values())
    return path.cameras(fps, first.width, first.height, near)


def _lines_of_faults(path: Path, subject: Subject) -> list[str]:
    """Return a line about the number of gaussians with invalid values, which are not
    drawn; no line if there are none."""
    if not isinstance(subject, Gaussians):
        return []
    findings = examine(subject)
    if not findings.num_wrong:
        return []
    return [f"{shown(path)}: {findings.text}; `v3dg info` describes them"]


def _drawn(
    options: Render,
    renderer: Renderer,
    cameras: Mapping[str, Camera],
    style: _Style,
    pictures: list[JsonObject],
) -> Iterator[Image]:
    """Yield the picture of each camera, and append its description to `pictures`."""
    show = len(cameras) > 1 and not options.quiet
    cut = CutOptions(
        tolerance=options.tolerance,
        budget=options.budget,
        min_level=options.min_level,
        fade=style.fade,
    )
    background = style.background or (0.0, 0.0, 0.0)
    faces: list[RenderedImage] = []

    def draw(camera: Camera) -> RenderedImage:
        renderer.settle(camera, **cut)
        image = renderer.render(camera, **cut, background=background)
        faces.append(image)
        return image

    casts_rays = _casts_rays(options, renderer)
    direction = direction_of(style.up)
    panorama_width = options.panorama_size[0]
    for name, camera in counted(cameras.items(), len(cameras), "render", show):
        faces.clear()
        image: Image
        if casts_rays:
            sphere = EquirectangularCamera.level(camera, direction, panorama_width)
            image = render(
                renderer.subject, sphere, **cut, background=background, device=options.device
            )
        elif options.is_panorama:
            image = draw_panorama(draw, camera, direction, panorama_width)
        else:
            image = draw(camera)
        height, width = image.alpha.shape
        picture: JsonObject = {"camera": name, "width": width, "height": height}
        pictures.append({**picture, **_costs(image, faces)})
        yield image


def _costs(image: Image, faces: list[RenderedImage]) -> JsonObject:
    """Return the costs of a picture. For a panorama of pinholes, they are the sums over
    its sides."""
    if isinstance(image, RayImage):
        return {"gaussians_selected": image.gaussians}
    stats = [face.stats for face in faces]
    costs: JsonObject = stats[0]._asdict()
    for name in ("gaussians_selected", "gaussians_in_frustum", "select_ms", "draw_ms"):
        costs[name] = sum(getattr(face, name) for face in stats)
    costs["tolerance"] = finite(max(face.tolerance for face in stats))
    return costs


def _write_pictures(
    paths: list[Path], images: Iterator[Image], pictures: list[JsonObject], *, is_transparent: bool
) -> None:
    for path, image in zip(paths, images, strict=True):
        image.save(path, transparent=is_transparent)
        pictures[-1]["picture"] = str(path)
