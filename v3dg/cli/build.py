"""`v3dg build`."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg.cli._common import bytes_text, print_result, require_file


@dataclass
class Build:
    """Build a bundle from a trained asset."""

    asset: tyro.conf.Positional[Path]
    """Trained gaussians, a .ply file."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None
    """Bundle to write; the asset's name with .v3dg if not given."""
    config: Literal["default", "paper"] = "default"
    """Settings to start from: ours, or those of the V3DG paper."""
    cluster_size: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Most gaussians in a cluster; the config's own if not given."""
    seed: int = 0
    """The same seed gives the same file, byte for byte, on the same kind of device."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto is a CUDA device where there is one and torch can use it."""
    strict: bool = False
    """Refuse an asset with wrong values, instead of leaving out the gaussians that have them."""
    resume: bool = False
    """Continue an interrupted build from its last finished level."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """CPU threads; all if not given. The result does not depend on it."""
    json: bool = False
    """Print the result as JSON."""
    quiet: bool = False
    """Show no progress."""


def run(options: Build) -> None:
    require_file(options.asset, ".ply")
    from dataclasses import replace

    from v3dg import _device
    from v3dg.build import BuildConfig, build_bundle, discard_levels
    from v3dg.cleaning import AssetWarning, describe
    from v3dg.io import load

    output = options.output or options.asset.with_suffix(".v3dg")
    if output.suffix != ".v3dg":
        raise ValueError(f"{output}: expected a file name ending in .v3dg")
    if not output.parent.is_dir():
        raise ValueError(f"{output}: expected an existing folder, got {output.parent}; create it first")
    config = BuildConfig.paper() if options.config == "paper" else BuildConfig()
    if options.cluster_size is not None:
        config = replace(config, cluster_size=options.cluster_size)
    partial = output.with_name(output.name + ".partial")
    if not options.resume:
        discard_levels(partial)
    device = _device.resolve(options.device)
    start = time.perf_counter()
    asset = load(options.asset)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AssetWarning)  # the result says it
            bundle = build_bundle(
                asset,
                config=config,
                seed=options.seed,
                progress=not options.quiet,
                device=device,
                resume_path=partial,
                unusable="refuse" if options.strict else "drop",
            )
        bundle.save(output)
    except ValueError as error:
        place = f"{options.asset}: " if str(error).startswith("asset: ") else ""
        raise ValueError(f"{place}{error}") from None
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted{_to_resume(partial)}") from None
    except OSError as error:  # a full disk, say
        raise OSError(error.errno, f"{error.strerror}{_to_resume(partial)}", error.filename) from None
    partial.unlink(missing_ok=True)
    dropped = bundle.config["dropped"]
    result = {
        "output": str(output),
        "asset_gaussians": len(asset),
        "dropped": dropped,
        "gaussians": bundle.num_gaussians,
        "clusters": len(bundle.clusters),
        "levels": bundle.num_levels,
        "bytes": output.stat().st_size,
        "seconds": time.perf_counter() - start,
    }
    text = (
        f"{output}: {bundle.num_levels} levels, {len(bundle.clusters):,} clusters, "
        f"{bundle.num_gaussians:,} gaussians ({len(asset):,} in the asset), "
        f"{bytes_text(output.stat().st_size)}, {result['seconds']:.1f} s"
    )
    if dropped:
        text += "\nleft out: " + describe(dropped)
    print_result(options.json, result, lambda: text)


def _to_resume(partial: Path) -> str:
    return f"; `--resume` continues from {partial}" if partial.exists() else ""
