"""`v3dg export`."""

import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg import export
from v3dg._urls import beside, shown
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera
from v3dg.cli import _common
from v3dg.cli._views import choose_up
from v3dg.formats.usd import SUFFIXES as USD_SUFFIXES
from v3dg.gaussians import Gaussians
from v3dg.io import subject_name
from v3dg.scene import Scene


@dataclass
class Export(_common.Common):
    """Write a scene or a bundle as a page for the web, as 3D Tiles, or as OpenUSD
    (docs/formats.md, docs/web_page.md).

    The folder may be new or empty, or contain an earlier export. Only unchanged files
    that its v3dg-export.json lists are replaced or removed. The inputs must not be in
    this folder.
    """

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg), or an OpenUSD file with instances."""
    output: Annotated[Path | None, _common.option("FOLDER", "-o")] = None
    """Folder to write. It is created if needed. By default, its name is that of the
    subject followed by _web. A name that ends in .usd, .usda or .usdc is a file."""
    to: Literal["sog", "tiles", "v3dg"] = "sog"
    """Streamed SOG for PlayCanvas and SuperSplat, 3D Tiles for CesiumJS, or bundles for
    the web page of v3dg, which needs a browser with WebGPU."""
    chunk: int = export.DEFAULT_CHUNK
    """Maximum number of gaussians of an asset in a chunk of streamed SOG. Viewers
    choose a level for each chunk."""
    up: Annotated[Axis | None, _common.option("{x,y,z,-x,-y,-z}")] = None
    """The axis that points up. By default, it is the one in the file, or a guess from
    the gaussians or the cameras."""
    overwrite: _common.Flag = False
    """Write to any folder, and replace files with the same names. No other file is
    removed, and no folder or link is replaced."""


def run(options: Export) -> None:
    _common.require_subject(options.subject)
    _common.check_usage("--chunk", options.chunk >= 1, f"at least 1, got {options.chunk}")
    folder = options.output or _web_folder(options.subject)
    _common.check_output(folder, options.subject)
    export.check_outside(folder, [options.subject])
    is_usd = folder.suffix.lower() in USD_SUFFIXES
    _common.check_usage(
        "--to",
        options.to == "sog" or not is_usd,
        f"no value for {folder}, whose suffix determines the format, got {options.to}; leave it "
        "out",
    )
    start = time.perf_counter()
    subject, cameras = _common.open_subject(options.subject, show=not options.quiet)
    if isinstance(subject, Gaussians):
        name = shown(options.subject)
        advice = f"build a bundle from it with v3dg build {name}"
        raise ValueError(f"{name}: expected a scene or a bundle, got an asset; {advice}")
    up, notes = choose_up(options.up, subject, cameras, options.subject)
    if is_usd:
        size = export.write_usd(subject, folder, up=up)
        seconds = time.perf_counter() - start
        usd_result = {"output": str(folder), "bytes": size, "seconds": seconds}
        line = f"{folder}: {_common.bytes_text(size)}, {seconds:.1f} s"
        _common.print_result(usd_result, [line, *notes], as_json=options.json)
        return
    if options.to == "tiles":
        written = _write_tiles(options, subject, folder, up)
    elif options.to == "v3dg":
        written = _write_web_page(options, subject, folder, up, cameras)
    else:
        written = _write_site(options, subject, folder, up, cameras)
    seconds = time.perf_counter() - start
    result = {"output": str(folder), **asdict(written.export), "seconds": seconds}
    lines = [*_lines(folder, written, seconds), *notes, *_advice(folder, written)]
    _common.print_result(result, lines, as_json=options.json)


@dataclass(frozen=True)
class _Written:
    """A finished export to a folder."""

    export: export.Site | export.Tiles | export.WebPage
    text: str  # a description of the content
    needs: Sequence[str]  # commands that install a missing engine in the folder


def _write_tiles(options: Export, subject: Scene | Bundle, folder: Path, up: Axis) -> _Written:
    tiles = export.write_tiles(
        subject, folder, up=up, progress=not options.quiet, overwrite=options.overwrite
    )
    needs: Sequence[str] = ()
    if not (folder / export.CESIUM).exists():
        needs = export.TILES_NEED
    return _Written(tiles, f"{tiles.tiles:,} tiles", needs)


def _write_web_page(
    options: Export,
    subject: Scene | Bundle,
    folder: Path,
    up: Axis,
    cameras: Mapping[str, Camera] | None,
) -> _Written:
    page = export.write_web_page(
        subject,
        folder,
        cameras,
        up=up,
        progress=not options.quiet,
        overwrite=options.overwrite,
    )
    return _Written(page, f"{page.gaussians:,} gaussians", ())


def _write_site(
    options: Export,
    subject: Scene | Bundle,
    folder: Path,
    up: Axis,
    cameras: Mapping[str, Camera] | None,
) -> _Written:
    site = export.write_site(
        subject,
        folder,
        cameras,
        chunk=options.chunk,
        up=up,
        progress=not options.quiet,
        overwrite=options.overwrite,
    )
    needs: Sequence[str] = ()
    if not site.has_engine:
        needs = export.SITE_NEEDS
    text = f"{site.gaussians:,} gaussians, {site.coarsest:,} at the coarsest"
    return _Written(site, text, needs)


def _lines(folder: Path, written: _Written, seconds: float) -> list[str]:
    num_instances = written.export.instances
    instances = f"{num_instances:,} instance{'s' * (num_instances != 1)}"
    size = _common.bytes_text(written.export.bytes)
    return [f"{folder}: {instances}, {written.text}, {size}, {seconds:.1f} s"]


def _advice(folder: Path, written: _Written) -> list[str]:
    """Return lines about opening an export in a browser."""
    quoted = shlex.quote(str(folder))
    lines = []
    if written.needs:
        lines.append("the page needs its engine in the same folder; these commands install it:")
        lines += [f"  {line.format(quoted)}" for line in written.needs]
    lines.append(f"to view it, run: python -m http.server --bind 127.0.0.1 --directory {quoted}")
    lines.append("  then open http://127.0.0.1:8000/")
    return lines


def _web_folder(subject: Path) -> Path:
    """Return the default folder of an export."""
    return beside(subject).with_name(f"{subject_name(subject)}_web")
