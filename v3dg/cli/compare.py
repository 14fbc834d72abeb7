"""`v3dg compare`."""

import contextlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import tyro

from v3dg import _device, _files, pictures
from v3dg._json import JsonObject
from v3dg._judges import Judges, mean_of
from v3dg._numbers import check
from v3dg._progress import counted
from v3dg._urls import beside, shown
from v3dg.bundle import Bundle
from v3dg.cli import _common
from v3dg.cli._views import ViewOptions, Views, choose_cameras, picture_paths
from v3dg.io import subject_name
from v3dg.metrics import FLIP_MISSING, MIN_TRANSMITTANCE, draw_truth, error_image, errors_of
from v3dg.pictures import Picture, to_8bit
from v3dg.render import render

# From this number of views on, measuring in other processes is faster, in spite of the
# time to start them.
_ENOUGH_TO_SHARE = 6

# Smaller pictures are enlarged to about this width, in px, when they are shown side by
# side.
_LEAST_WIDTH = 300

_COLUMNS = (
    _common.Column("view", "{camera}"),
    _common.Column("FLIP", "{flip:.4f}"),
    _common.Column("PSNR", "{psnr:.2f}"),
    _common.Column("SSIM", "{ssim:.4f}"),
    _common.Column("gaussians", "{gaussians_selected:,.0f}"),
)


@dataclass
class Compare(_common.Cut, _common.OnDevice):
    """Measure the difference between pictures of two subjects, which are drawn for the
    same cameras, or between two existing pictures.

    PSNR and SSIM are measured, and FLIP if the extra `flip` is installed.
    """

    reference: tyro.conf.Positional[Path]
    """An asset, a bundle (.v3dg) or a scene (.json), which is drawn with all its
    gaussians, or a picture (.png, .jpg)."""
    test: tyro.conf.Positional[Path]
    """The subject that is compared with the reference. It is drawn with a tolerance. If
    the reference is a picture, this must be a picture of the same size."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("compare.png")
    """Picture to write, .png or .jpg. It shows the reference, the test and, if FLIP is
    installed, the map of FLIP."""
    pictures: Literal["worst", "all"] = "worst"
    """Write a picture of the view with the largest difference, or of every view."""
    supersample: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Draw the reference this many times larger, and average its pixels. With 2,
    aliasing does not count as detail."""
    view: Views = field(default_factory=ViewOptions)


class _Pair(NamedTuple):
    """Two pictures of the same view."""

    name: str
    reference: Picture
    test: Picture
    gaussians: int | None = None  # number of gaussians in the cut of the test


@dataclass(frozen=True)
class _Pairs:
    """The pairs of pictures to compare, which are drawn one after another."""

    names: list[str]
    pairs: Iterator[_Pair]
    finest: int | None  # number of gaussians in level 0 of the test, if it is a bundle


def run(options: Compare) -> None:
    subjects = (options.reference, options.test)
    _common.check_output(options.output, *subjects)
    output = pictures.check_picture_path(options.output)
    _files.make_folder(output)
    are_pictures = [beside(path).suffix.lower() in pictures.SUFFIXES for path in subjects]
    is_pair = any(are_pictures) == all(are_pictures)
    _common.check_usage("PATH", is_pair, "two pictures or two subjects to draw, got one of each")
    if all(are_pictures):
        pairs = _read_pictures(options)
    else:
        pairs = _draw(options)
    rows, worst = _measure(options, pairs, output)
    mean = mean_of(rows, "flip", "psnr", "ssim", "gaussians_selected")
    result = {
        "reference": shown(options.reference),
        "test": shown(options.test),
        "mean": mean,
        "worst": worst["camera"],
        "views": rows,
    }
    table_rows = list(rows)
    if len(rows) > 1:
        table_rows.append({"camera": "mean", **mean})
    titles = "reference, test and FLIP"
    if mean["flip"] is None:
        titles = "reference and test"
    lines = [
        *_common.table_lines(_COLUMNS, table_rows),
        "",
        f"{worst['picture']}: {titles} of view {worst['camera']}, which has the largest difference",
    ]
    if mean["flip"] is None:
        lines.append(FLIP_MISSING)
    if pairs.finest is not None and all(row["gaussians_selected"] == pairs.finest for row in rows):
        lines.append(
            "every view needs the finest level; with a smaller `--size`, the test is shown as "
            "from farther away"
        )
    _common.print_result(result, lines, as_json=options.json)


def _measure(options: Compare, pairs: _Pairs, output: Path) -> tuple[list[JsonObject], JsonObject]:
    """Measure all pairs, and write their pictures. Return the rows of the result, and
    the row with the largest difference."""
    paths = [output] * len(pairs.names)
    if options.pictures == "all":
        paths = picture_paths(output, pairs.names)
    rows: list[JsonObject] = []
    worst: tuple[_Pair, JsonObject] | None = None
    with contextlib.closing(Judges()) as judges:
        measured: Iterable[tuple[_Pair, dict[str, float | None]]]
        if len(pairs.names) >= _ENOUGH_TO_SHARE:
            measured = judges.measured(pairs.pairs, _errors)
        else:
            measured = ((pair, _errors(pair)) for pair in pairs.pairs)
        for pair, errors in counted(measured, len(pairs.names), "compare", not options.quiet):
            row: JsonObject = {"camera": pair.name, **errors, "gaussians_selected": pair.gaussians}
            if options.pictures == "all":
                row["picture"] = str(paths[len(rows)])
                _write(options, pair, row)
            if worst is None or _difference(row) > _difference(worst[1]):
                worst = (pair, row)
            rows.append(row)
    assert worst is not None
    worst_pair, worst_row = worst
    if options.pictures == "worst":
        worst_row["picture"] = str(output)
        _write(options, worst_pair, worst_row)
    return rows, worst_row


def _read_pictures(options: Compare) -> _Pairs:
    reference = pictures.read_picture(options.reference)
    test = pictures.read_picture(options.test)
    height, width, _ = reference.shape
    test_height, test_width, _ = test.shape
    expected = (
        f"{width} x {height} px like {options.reference}, got {test_width} x {test_height}; "
        "resize one of them"
    )
    check(options.test, reference.shape == test.shape, expected)
    name = subject_name(options.test)
    return _Pairs([name], iter([_Pair(name, reference, test)]), finest=None)


def _draw(options: Compare) -> _Pairs:
    """Return the pairs of pictures for all cameras, to be drawn one after another."""
    options.view.check(options.reference, options.test)
    _common.check_range("--supersample", options.supersample, 1, 16)
    device = _device.resolve(options.device)
    reference, reference_cameras = _common.open_subject(options.reference, show=not options.quiet)
    test, test_cameras = _common.open_subject(options.test, show=not options.quiet)
    if reference_cameras is None and test_cameras is not None:
        cameras = choose_cameras(options.view, options.test, reference, test_cameras, views=8)
    else:
        cameras = choose_cameras(
            options.view, options.reference, reference, reference_cameras, views=8
        )
    for name, camera in cameras.items():
        pictures.check_size(
            f"camera {name}", camera.width, camera.height, pictures.MOST_PIXELS_COMPARED
        )
        pictures.check_size(
            f"camera {name}, supersampled",
            camera.width * options.supersample,
            camera.height * options.supersample,
        )

    finest = None
    if isinstance(test, Bundle) and test.num_levels:
        finest = _common.level_size(test, 0)

    def pairs() -> Iterator[_Pair]:
        for name, camera in cameras.items():
            truth = draw_truth(reference, camera, device, options.supersample)
            image = render(
                test,
                camera,
                tolerance=options.tolerance,
                budget=options.budget,
                device=device,
                # the same value as for the reference, so that only the gaussians differ
                min_transmittance=MIN_TRANSMITTANCE,
            )
            yield _Pair(name, truth, to_8bit(image.color), image.stats.gaussians_selected)

    return _Pairs(list(cameras), pairs(), finest)


def _errors(pair: _Pair) -> dict[str, float | None]:
    return errors_of(pair.reference, pair.test)


def _difference(row: JsonObject) -> float:
    """Return the key by which views are sorted. It is FLIP or, if FLIP is missing, the
    negative PSNR."""
    if row["flip"] is not None:
        return float(row["flip"])
    if row["psnr"] is not None:
        return -float(row["psnr"])
    return -math.inf


def _write(options: Compare, pair: _Pair, row: JsonObject) -> None:
    named = ((options.reference, pair.reference), (options.test, pair.test))
    titled = [(_common.printable(beside(path).name), picture) for path, picture in named]
    if row["flip"] is not None:
        floats = (picture / np.float32(255) for _, picture in titled)
        titled.append((f"FLIP {row['flip']:.4f}", to_8bit(error_image(*floats))))
    zoom = max(1, _LEAST_WIDTH // pair.test.shape[1])
    cells = [(text, picture.repeat(zoom, axis=0).repeat(zoom, axis=1)) for text, picture in titled]
    pictures.write_picture(row["picture"], pictures.contact_sheet([cells]))
