"""`v3dg compare`."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from v3dg.cli._common import (
    Flag,
    Threads,
    UsageError,
    level_size,
    option,
    print_result,
    require_subject,
    table_lines,
)
from v3dg.cli._views import ViewOptions, Views, choose_cameras, load_subject, picture_path
from v3dg.pictures import SUFFIXES as PICTURE_SUFFIXES

if TYPE_CHECKING:
    from v3dg.pictures import Picture

# Views from which on starting processes to measure them is quicker than doing without.
_ENOUGH_TO_SHARE = 6

# Smaller pictures are enlarged to about this many px where they are shown side by side.
_LEAST_WIDTH = 300


@dataclass
class Compare:
    """Draw two subjects from the same cameras, or take two pictures, and measure how far apart they look.

    By PSNR and SSIM, and by FLIP where the extra `flip` is installed.
    """

    reference: tyro.conf.Positional[Path]
    """An asset, a bundle (.v3dg) or a scene (.json), to be drawn with all gaussians; or a picture (.png)."""
    test: tyro.conf.Positional[Path]
    """What to compare with it: any of those, or a picture of the same size."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("compare.png")
    """Picture to write, .png or .jpg: reference, test and, where FLIP is installed, a map of it."""
    pictures: Literal["worst", "all"] = "worst"
    """Show the view that differs most, or write a picture of every view."""
    tolerance: Annotated[float | None, option("PX2")] = None
    """Screen area in px² that one gaussian of the test's coarser clusters may stand for; 3 if not given."""
    budget: Annotated[int | None, option("N")] = None
    """Most gaussians of the test to draw in one picture."""
    supersample: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Draw the reference this many times larger and average it; with 2, aliasing is not taken for detail."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to draw; auto is a CUDA device where there is one and torch can use it."""
    threads: Threads = None
    """CPU threads; all if not given."""
    json: Flag = False
    """Print the numbers as JSON."""
    quiet: Flag = False
    """Show no progress."""
    view: Views = field(default_factory=lambda: ViewOptions(views=8))


@dataclass(frozen=True)
class _Pair:
    """Two pictures of one view."""

    name: str
    reference: Picture
    test: Picture
    gaussians: int | None = None  # of the test that were selected
    is_finest: bool = False  # whether those are all of a bundle's finest level


def run(options: Compare) -> None:
    from tqdm import tqdm

    from v3dg._judges import Judges, mean_of
    from v3dg.metrics import FLIP_MISSING
    from v3dg.pictures import check_picture_path

    output = check_picture_path(options.output)
    are_pictures = [p.suffix.lower() in PICTURE_SUFFIXES for p in (options.reference, options.test)]
    if any(are_pictures) and not all(are_pictures):
        raise UsageError("PATH: expected two pictures, or two subjects to draw, got one of each")
    count, pairs = _read_pictures(options) if all(are_pictures) else _draw(options)
    rows, worst, is_finest = [], None, True
    with contextlib.closing(Judges()) as judges:
        judged = (
            judges.measured(pairs, _errors)
            if count >= _ENOUGH_TO_SHARE
            else ((pair, _errors(pair)) for pair in pairs)
        )
        for pair, errors in tqdm(judged, total=count, unit="view", leave=False, disable=options.quiet):
            row = {"camera": pair.name, **errors, "gaussians_selected": pair.gaussians}
            if options.pictures == "all":
                path = picture_path(output, pair.name, count)
                _write(options, path, pair, row["flip"])
                row["picture"] = str(path)
            if worst is None or _difference(row) > _difference(worst[1]):
                worst = (pair, row)
            rows.append(row)
            is_finest = is_finest and pair.is_finest
    assert worst is not None
    if options.pictures == "worst":
        _write(options, output, worst[0], worst[1]["flip"])
        worst[1]["picture"] = str(output)
    mean = mean_of(rows, "flip", "psnr", "ssim", "gaussians_selected")
    result = {
        "reference": str(options.reference),
        "test": str(options.test),
        "mean": mean,
        "worst": worst[1]["camera"],
        "views": rows,
    }
    table = [_cells(row) for row in rows]
    if count > 1:
        table.append(_cells({"camera": "mean", **mean}))
    shown = "reference and test" if mean["flip"] is None else "reference, test and FLIP"
    lines = [
        *table_lines(("view", "FLIP", "PSNR", "SSIM", "gaussians"), table),
        "",
        f"{worst[1]['picture']}: {shown} of view {worst[1]['camera']}, which differs most",
    ]
    if mean["flip"] is None:
        lines.append(FLIP_MISSING)
    if is_finest:
        lines.append("every view needs the finest level; `--size 100 100` shows the test as from far away")
    print_result(options.json, result, lambda: "\n".join(lines))


def _read_pictures(options: Compare) -> tuple[int, Iterator[_Pair]]:
    import numpy as np
    from PIL import Image

    def read(path: Path) -> Picture:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))

    reference, test = read(options.reference), read(options.test)
    if reference.shape != test.shape:
        (height, width, _), (test_height, test_width, _) = reference.shape, test.shape
        raise ValueError(
            f"{options.test}: expected {width} x {height} px like {options.reference}, "
            f"got {test_width} x {test_height}"
        )
    return 1, iter([_Pair(options.test.stem, reference, test)])


def _draw(options: Compare) -> tuple[int, Iterator[_Pair]]:
    """How many views there are, and pictures of one after the other."""
    for path in (options.reference, options.test):
        require_subject(path)
    options.view.check(options.reference, options.test)
    if options.supersample < 1:
        raise UsageError(f"--supersample: expected at least 1, got {options.supersample}")
    from v3dg import _device
    from v3dg.bundle import Bundle
    from v3dg.metrics import draw_truth
    from v3dg.pictures import to_8bit
    from v3dg.render import render

    device = _device.resolve(options.device)
    reference, reference_cameras = load_subject(options.reference)
    test, test_cameras = load_subject(options.test)
    own, path = reference_cameras, options.reference
    if own is None and test_cameras is not None:
        own, path = test_cameras, options.test
    cameras = choose_cameras(options.view, path, reference, own)

    finest = level_size(test, 0) if isinstance(test, Bundle) and test.num_levels else None

    def pairs() -> Iterator[_Pair]:
        for name, camera in cameras.items():
            truth = draw_truth(reference, camera, device, options.supersample)
            image = render(test, camera, tolerance=options.tolerance, budget=options.budget, device=device)
            count = image.stats.gaussians_selected
            yield _Pair(name, truth, to_8bit(image.color), count, count == finest)

    return len(cameras), pairs()


def _errors(pair: _Pair) -> dict[str, float | None]:
    """FLIP (None without its extra), PSNR (None for equal pictures) and SSIM of what a screen shows."""
    from v3dg import metrics

    shown = _shown(pair)
    psnr = metrics.psnr(*shown)
    return {
        "flip": metrics.flip(*shown) if metrics.has_flip() else None,
        "psnr": psnr if math.isfinite(psnr) else None,
        "ssim": metrics.ssim(*shown),
    }


def _difference(row: dict[str, Any]) -> float:
    """What orders views: FLIP, or PSNR where that is not there."""
    if row["flip"] is not None:
        return float(row["flip"])
    return -math.inf if row["psnr"] is None else -float(row["psnr"])


def _shown(pair: _Pair) -> list[Any]:
    import numpy as np

    return [picture.astype(np.float32) / np.float32(255) for picture in (pair.reference, pair.test)]


def _write(options: Compare, path: Path, pair: _Pair, flip: float | None) -> None:
    from v3dg import metrics
    from v3dg.pictures import contact_sheet, to_8bit, write_picture

    pictures = [(options.reference.name, pair.reference), (options.test.name, pair.test)]
    if flip is not None:
        pictures.append((f"FLIP {flip:.4f}", to_8bit(metrics.error_image(*_shown(pair)))))
    zoom = max(1, _LEAST_WIDTH // pair.test.shape[1])
    row = [(text, picture.repeat(zoom, axis=0).repeat(zoom, axis=1)) for text, picture in pictures]
    write_picture(path, contact_sheet([row]))


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    def text(name: str, form: str) -> str:
        return "-" if row[name] is None else format(row[name], form)

    return (
        row["camera"],
        text("flip", ".4f"),
        text("psnr", ".2f"),
        text("ssim", ".4f"),
        text("gaussians_selected", ",.0f"),
    )
