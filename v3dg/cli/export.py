"""`v3dg export`."""

import shlex
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from v3dg import export
from v3dg._urls import beside, shown
from v3dg.cameras import Axis
from v3dg.cli import _common
from v3dg.cli._views import choose_up
from v3dg.formats.usd import SUFFIXES as USD_SUFFIXES
from v3dg.gaussians import Gaussians
from v3dg.opening import open_with_cameras


@dataclass
class Export(_common.Common):
    """Write a scene or a bundle as a page for the web, as 3D Tiles, or as OpenUSD
    (docs/formats.md).

    A folder may be new, empty, or have an earlier export in it. Only files that
    v3dg-export.json there lists, and that are as they were written, are replaced or
    removed. What is read may not be in it."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg), or a world of OpenUSD."""
    output: Annotated[Path | None, _common.option("FOLDER", "-o")] = None
    """Folder to write, made with those above it; the subject's name with _web if not
    given. With a name that ends in .usd, .usda or .usdc, the file to write."""
    to: Literal["sog", "tiles"] = "sog"
    """Streamed SOG, for PlayCanvas and SuperSplat, or 3D Tiles, for CesiumJS."""
    chunk: int = export.DEFAULT_CHUNK
    """Most gaussians of an asset in a chunk of streamed SOG, for which the viewer
    chooses a level."""
    up: Annotated[Axis | None, _common.option("{x,y,z,-x,-y,-z}")] = None
    """Which way is up; what the file says or what is guessed from it or its cameras if
    not given."""
    overwrite: _common.Flag = False
    """Write to any folder, and replace files there that have the same names. No other
    file is removed, and no folder or link is replaced."""


def run(options: Export) -> None:
    _common.require_subject(options.subject)
    _common.check_usage("--chunk", options.chunk >= 1, f"at least 1, got {options.chunk}")
    folder = options.output or _web_folder(options.subject)
    _common.check_output(folder, options.subject)
    export.check_outside(folder, [options.subject])
    start = time.perf_counter()
    subject, cameras = open_with_cameras(options.subject)
    if isinstance(subject, Gaussians):
        name = shown(options.subject)
        expected = f"expected a scene or a bundle, got an asset; make one of it: v3dg build {name}"
        raise ValueError(f"{name}: {expected}")
    up, notes = choose_up(options.up, subject, cameras, options.subject)
    if folder.suffix.lower() in USD_SUFFIXES:
        _common.check_usage(
            "--to", options.to == "sog", f"none for {folder}, got {options.to}; leave it out"
        )
        size = export.write_usd(subject, folder, up=up)
        written = {"output": str(folder), "bytes": size, "seconds": time.perf_counter() - start}
        line = f"{folder}: {_common.bytes_text(size)}, {written['seconds']:.1f} s"
        _common.print_result(options.json, written, [line, *notes])
        return
    common: dict[str, Any] = {
        "up": up,
        "progress": not options.quiet,
        "overwrite": options.overwrite,
    }
    there = shlex.quote(str(folder))
    done: export.Site | export.Tiles
    if options.to == "tiles":
        done = export.write_tiles(subject, folder, **common)
        text, needs = (
            f"{done.tiles:,} tiles",
            () if (folder / export.CESIUM).exists() else export.TILES_NEED,
        )
    else:
        done = export.write_site(subject, folder, cameras, chunk=options.chunk, **common)
        text = f"{done.gaussians:,} gaussians, {done.coarsest:,} at the coarsest"
        needs = () if done.has_engine else export.SITE_NEEDS
    result = {"output": str(folder), **asdict(done), "seconds": time.perf_counter() - start}
    seconds = f"{result['seconds']:.1f} s"
    instances = f"{done.instances:,} instance{'s' * (done.instances != 1)}"
    lines = [f"{folder}: {instances}, {text}, {_common.bytes_text(done.bytes)}, {seconds}", *notes]
    if needs:
        lines += [
            "it needs its engine beside it, once:",
            *(f"  {line.format(there)}" for line in needs),
        ]
    lines += [f"to look at it: python -m http.server --bind 127.0.0.1 --directory {there}"]
    _common.print_result(options.json, result, [*lines, "  then open http://127.0.0.1:8000/"])


def _web_folder(subject: Path) -> Path:
    """Where a page goes if nothing else is said."""
    local = beside(subject)
    return local.with_name(f"{local.stem}_web")
