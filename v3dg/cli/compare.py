"""`v3dg compare`."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

from v3dg import _device, pictures
from v3dg._judges import Judges, mean_of
from v3dg._numbers import check
from v3dg._progress import counted
from v3dg._urls import beside, shown
from v3dg.bundle import Bundle
from v3dg.cli import _common
from v3dg.cli._views import ViewOptions, Views, choose_cameras, picture_paths
from v3dg.metrics import FLIP_MISSING, MIN_TRANSMITTANCE, draw_truth, error_image, errors_of
from v3dg.opening import open_with_cameras
from v3dg.pictures import Picture, to_8bit
from v3dg.render import render

# Views from which on starting processes to measure them is quicker than doing without.
_ENOUGH_TO_SHARE = 6

# Smaller pictures are enlarged to about this many px where they are shown side by side.
_LEAST_WIDTH = 300


@dataclass
class Compare(_common.Cut, _common.OnDevice):
    """Draw two subjects from the same cameras, or take two pictures, and measure how far apart they look.

    By PSNR and SSIM, and by FLIP where the extra `flip` is installed.
    """

    reference: tyro.conf.Positional[Path]
    """An asset, a bundle (.v3dg) or a scene (.json), to be drawn with all gaussians; or a picture (.png)."""
    test: tyro.conf.Positional[Path]
    """What to compare with it: any of those, drawn with a tolerance, or a picture of the same size."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("compare.png")
    """Picture to write, .png or .jpg: reference, test and, where FLIP is installed, a map of it."""
    pictures: Literal["worst", "all"] = "worst"
    """Show the view that differs most, or write a picture of every view."""
    supersample: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Draw the reference this many times larger and average it; with 2, aliasing is not taken for detail."""
    view: Views = field(default_factory=ViewOptions)


class _Pair(NamedTuple):
    """Two pictures of one view."""

    name: str
    reference: Picture
    test: Picture
    gaussians: int | None = None  # of the test that were selected


def run(options: Compare) -> None:
    output = pictures.check_picture_path(options.output)
    subjects = (options.reference, options.test)
    _common.check_output(output, *subjects)
    are_pictures = [beside(path).suffix.lower() in pictures.SUFFIXES for path in subjects]
    is_pair = any(are_pictures) == all(are_pictures)
    _common.check_usage("PATH", is_pair, "two pictures, or two subjects to draw, got one of each")
    names, pairs, finest = _read_pictures(options) if all(are_pictures) else _draw(options)
    paths = picture_paths(output, names) if options.pictures == "all" else [output] * len(names)
    rows: list[dict[str, Any]] = []
    worst: tuple[_Pair, dict[str, Any]] | None = None
    with contextlib.closing(Judges()) as judges:
        is_long = len(names) >= _ENOUGH_TO_SHARE
        judged = judges.measured(pairs, _errors) if is_long else ((pair, _errors(pair)) for pair in pairs)
        for pair, errors in counted(judged, len(names), "compare", not options.quiet):
            row = {"camera": pair.name, **errors, "gaussians_selected": pair.gaussians}
            if options.pictures == "all":
                row["picture"] = str(paths[len(rows)])
                _write(options, pair, row)
            if worst is None or _difference(row) > _difference(worst[1]):
                worst = (pair, row)
            rows.append(row)
    assert worst is not None
    if options.pictures == "worst":
        worst[1]["picture"] = str(output)
        _write(options, *worst)
    mean = mean_of(rows, "flip", "psnr", "ssim", "gaussians_selected")
    result: dict[str, Any] = {"reference": shown(options.reference), "test": shown(options.test)}
    result |= {"mean": mean, "worst": worst[1]["camera"], "views": rows}
    columns = (
        "view = {camera}; FLIP = {flip:.4f}; PSNR = {psnr:.2f}; SSIM = {ssim:.4f}; "
        "gaussians = {gaussians_selected:,.0f}"
    )
    titles = "reference and test" if mean["flip"] is None else "reference, test and FLIP"
    lines = [
        *_common.table_lines(columns, rows if len(rows) == 1 else [*rows, {"camera": "mean", **mean}]),
        "",
        f"{worst[1]['picture']}: {titles} of view {worst[1]['camera']}, which differs most",
    ]
    if mean["flip"] is None:
        lines.append(FLIP_MISSING)
    if finest is not None and all(row["gaussians_selected"] == finest for row in rows):
        lines.append("every view needs the finest level; a smaller `--size` shows the test as from far away")
    _common.print_result(options.json, result, lines)


def _read_pictures(options: Compare) -> tuple[list[str], Iterator[_Pair], None]:
    reference, test = map(pictures.read_picture, (options.reference, options.test))
    (height, width, _), (test_height, test_width, _) = reference.shape, test.shape
    expected = f"{width} x {height} px like {options.reference}, got {test_width} x {test_height}"
    check(options.test, reference.shape == test.shape, expected)
    name = beside(options.test).stem
    return [name], iter([_Pair(name, reference, test)]), None


def _draw(options: Compare) -> tuple[list[str], Iterator[_Pair], int | None]:
    """The names of the views, pictures of one after the other, gaussians of the test's finest level."""
    options.view.check(options.reference, options.test)
    _common.check_range("--supersample", options.supersample, 1, 16)
    device = _device.resolve(options.device)
    reference, reference_cameras = open_with_cameras(options.reference)
    test, test_cameras = open_with_cameras(options.test)
    own, path = reference_cameras, options.reference
    if own is None and test_cameras is not None:
        own, path = test_cameras, options.test
    cameras = choose_cameras(options.view, path, reference, own, views=8)
    for name, camera in cameras.items():
        pictures.check_size(f"camera {name}", camera.width, camera.height, pictures.MOST_PIXELS_COMPARED)
        sides = (side * options.supersample for side in (camera.width, camera.height))
        pictures.check_size(f"camera {name}, supersampled", *sides)

    finest = _common.level_size(test, 0) if isinstance(test, Bundle) and test.num_levels else None
    how: Any = {"tolerance": options.tolerance, "budget": options.budget, "device": device}
    how["min_transmittance"] = MIN_TRANSMITTANCE  # the truth's, so that only the gaussians differ

    def pairs() -> Iterator[_Pair]:
        for name, camera in cameras.items():
            truth = draw_truth(reference, camera, device, options.supersample)
            image = render(test, camera, **how)
            yield _Pair(name, truth, to_8bit(image.color), image.stats.gaussians_selected)

    return list(cameras), pairs(), finest


def _errors(pair: _Pair) -> dict[str, float | None]:
    return errors_of(pair.reference, pair.test)


def _difference(row: dict[str, Any]) -> float:
    """What orders views: FLIP, or PSNR where that is not there."""
    if row["flip"] is not None:
        return float(row["flip"])
    return -math.inf if row["psnr"] is None else -float(row["psnr"])


def _write(options: Compare, pair: _Pair, row: dict[str, Any]) -> None:
    named = ((options.reference, pair.reference), (options.test, pair.test))
    titled = [(_common.printable(beside(path).name), picture) for path, picture in named]
    if row["flip"] is not None:
        floats = (picture / np.float32(255) for _, picture in titled)
        titled.append((f"FLIP {row['flip']:.4f}", to_8bit(error_image(*floats))))
    zoom = max(1, _LEAST_WIDTH // pair.test.shape[1])
    cells = [(text, picture.repeat(zoom, axis=0).repeat(zoom, axis=1)) for text, picture in titled]
    pictures.write_picture(row["picture"], pictures.contact_sheet([cells]))
