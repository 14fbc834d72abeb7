"""`v3dg export`."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from v3dg import _files
from v3dg.bundle import Bundle
from v3dg.cli._common import Common, Flag, UsageError, bytes_text, option, print_result, require_file
from v3dg.export import DEFAULT_CHUNK, INDEX, Axis, write_streamed_sog


@dataclass
class Export(Common):
    """Write a bundle as streamed SOG, for the web viewers of PlayCanvas and SuperSplat (docs/formats.md)."""

    bundle: tyro.conf.Positional[Path]
    """A bundle (.v3dg)."""
    output: Annotated[Path | None, option("FOLDER", "-o")] = None
    """Folder to write, whose lod-meta.json viewers open; the bundle's name with _web if not given."""
    chunk: int = DEFAULT_CHUNK
    """Most gaussians of the asset in a chunk, for which the viewer chooses a level."""
    up: Axis = "-y"
    """Direction that is up in the asset; viewers assume -y, as in most trained assets."""
    quiet: Flag = False
    """Show no progress."""


def run(options: Export) -> None:
    require_file(options.bundle, ".v3dg")
    if options.chunk < 1:
        raise UsageError(f"--chunk: expected at least 1, got {options.chunk}")
    folder = options.output or options.bundle.with_name(f"{options.bundle.stem}_web")
    _files.check_folder(folder)
    start = time.perf_counter()
    done = write_streamed_sog(
        Bundle.open(options.bundle), folder, chunk=options.chunk, up=options.up, progress=not options.quiet
    )
    result = {
        "output": str(folder / INDEX),
        "levels": len(done.counts),
        **asdict(done),
        "seconds": time.perf_counter() - start,
    }
    text = (
        f"{folder / INDEX}: {len(done.counts)} levels, {done.chunks:,} chunks, "
        f"{sum(done.counts):,} gaussians, {bytes_text(done.bytes)}, {result['seconds']:.1f} s"
    )
    print_result(options.json, result, [text])
