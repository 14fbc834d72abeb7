"""`v3dg build`."""

import logging
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from v3dg import _extras
from v3dg._numbers import check
from v3dg._urls import beside
from v3dg.build import BuildConfig, build_file, levels_path
from v3dg.build.scheduler import SchedulerError
from v3dg.cameras import Axis
from v3dg.cleaning import AssetWarning, describe
from v3dg.cli import _common
from v3dg.cli._views import ask_up, is_at_terminal
from v3dg.gaussians import Gaussians
from v3dg.io import SUFFIXES, open_asset, run_files
from v3dg.upright import ASSUMED, up_of

_PATIENCE_S = 20  # for a scheduler's answer
_MOST_REASON = 200  # characters of an error of dask's
_SAMPLES, _SAMPLE = 64, 256  # of an asset, and gaussians of each, that tell what is up
_SEVERAL = tyro.conf.arg(metavar="PATH...", help_behavior_hint="(at least one)")


@dataclass
class Build(_common.OnDevice):
    """Build a bundle from a trained asset, or from each of many; one that fails does not stop the others."""

    assets: Annotated[tuple[Path, ...], tyro.conf.Positional, _SEVERAL]
    """Files of trained gaussians, or folders of such files. With an --output that ends in .v3dg they make
    one asset together."""
    output: Annotated[Path | None, _common.option("PATH", "-o")] = None
    """Bundle to write, or the folder for those of many assets; if not given, beside each asset."""
    config: Literal["default", "paper"] = "default"
    """Settings to start from: ours, or those of the V3DG paper."""
    cluster_size: Annotated[int | None, _common.option("N")] = None
    """Most gaussians in a cluster; the config's own if not given."""
    codec: Literal["float32", "quantized"] = "float32"
    """How gaussians are kept: every bit, or rounded to 16 to 40 bytes (docs/format.md has the error)."""
    up: Annotated[Axis | None, _common.option("{x,y,z,-x,-y,-z}")] = None
    """What is up in the asset, which the bundle then says; asked for at a terminal where nothing tells it."""
    seed: int = 0
    """The same seed gives the same file, byte for byte, on the same kind of device and any threads."""
    strict: _common.Flag = False
    """Refuse an asset with wrong values, instead of leaving out the gaussians that have them."""
    resume: _common.Flag = False
    """Continue after the last finished level; keep bundles of these gaussians and settings."""
    memory: Annotated[str | None, _common.option("SIZE")] = None
    """Memory of the host for the build, as 8GiB; half of what is free if not given. An asset that does not
    fit is brought into order on the disk of the output."""
    scheduler: Annotated[str | None, _common.option("ADDRESS")] = None
    """Build on the workers of a dask scheduler, as tcp://host:8786, which reach the output's folder, too;
    needs the extra `cluster`."""


def run(options: Build) -> None:
    expected = "one or more assets, or a folder of them, got nothing; run v3dg build --help"
    _common.check_usage("PATH", options.assets, expected)
    is_one = options.output is not None and options.output.suffix == ".v3dg"
    assets = _assets_of(options.assets)
    with _executor_at(options.scheduler) as executor:
        if is_one or list(assets) == list(options.assets[:1]):
            output = options.output or _output_of(options.assets[0], None)
            files = list(dict.fromkeys(file for files in assets.values() for file in files))
            options.up = options.up or (None if options.resume else _asked_up(files[0]))
            result = _build(options, files, output, executor)
            _common.print_result(options.json, result, _lines(result))
        else:
            _run_many(options, assets, executor)


def _asked_up(path: Path) -> Axis | None:
    """What is up in an asset, of who sits at a terminal, where neither its kind nor its gaussians tell."""
    if not is_at_terminal():
        return None
    _common.require_file(path, *SUFFIXES)
    asset = open_asset(path)
    starts = range(0, asset.num_gaussians, max(asset.num_gaussians // _SAMPLES, _SAMPLE))
    parts = [asset.read(start, min(start + _SAMPLE, asset.num_gaussians)) for start in starts]
    axis, how = up_of(Gaussians.concatenate(parts), path=path) if parts else ("-y", "")
    return ask_up(path, axis) if how == ASSUMED else None


@contextmanager
def _executor_at(address: str | None) -> Iterator[Executor | None]:
    """The workers of a dask scheduler."""
    if address is None:
        yield None
        return
    distributed = _extras.load("distributed")
    for name in ("distributed", "distributed.client"):  # errors are told once, by the command
        logging.getLogger(name).setLevel(logging.CRITICAL)
    _greet(address)
    expected = f"{address}: expected a dask scheduler"
    try:
        client = distributed.Client(address, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split()) or "no answer"
        raise RuntimeError(f"{expected} that answers, got none ({reason})") from None
    except Exception as error:  # of any kind, as of one that speaks of other things, or another version
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:_MOST_REASON]
        raise RuntimeError(f"{expected}, got something else ({reason})") from None
    with client:
        yield client.get_executor()


def _greet(address: str) -> None:
    """Say hello to a scheduler; RuntimeError unless something of dask's answers in time.

    A client would wait for ever for one that listens and says nothing.
    """
    import asyncio

    distributed = _extras.load("distributed")
    comm = _extras.load("distributed.comm")
    expected = f"{address}: expected a dask scheduler"

    async def connect() -> None:
        security = distributed.Security().get_connection_args("client")
        (await asyncio.wait_for(comm.connect(address, **security), _PATIENCE_S)).abort()

    try:
        comm.get_address_host_port(address)
    except ValueError as error:
        raise RuntimeError(f"{expected}, as tcp://host:8786, got no address ({error})") from None
    try:
        asyncio.run(connect())
    except (OSError, asyncio.TimeoutError) as error:
        reason = " ".join(str(error).split()) or "no answer"
        raise RuntimeError(f"{expected} that answers, got none ({reason})") from None
    except TypeError as error:  # TLS without certificates
        raise RuntimeError(f"{expected} that can be asked, got none ({error}); set dask's security") from None
    except Exception:  # what dask makes of another protocol, whose first eight bytes it takes for a size
        advice = "give the address that `dask scheduler` prints"
        raise RuntimeError(f"{expected}, got a server that speaks another protocol; {advice}") from None


def _run_many(options: Build, assets: dict[Path, list[Path]], executor: Executor | None) -> None:
    outputs = _outputs(list(assets), options.output)
    start = time.perf_counter()
    results: list[dict[str, Any]] = []
    for asset, output in outputs.items():
        if not options.quiet:
            _common.tell(f"[{len(results) + 1}/{len(outputs)}] {asset}")
        try:
            results.append(_build(options, assets[asset], output, executor))
        except SchedulerError as error:  # which the others would wait for, too
            done = f"{len(results)} of {len(outputs)} assets done"
            raise SchedulerError(f"{error}; {done}") from None
        except _common.FAILURES as error:
            results.append({"asset": str(asset), "status": "failed", "error": _common.failure_text(error)})
            if not options.quiet:
                _common.tell(f"failed: {results[-1]['error']}")
        except KeyboardInterrupt:
            done = f"{len(results)} of {len(outputs)} assets done"
            raise KeyboardInterrupt(f"interrupted with {done}; `--resume` continues") from None
    counts = Counter(result["status"] for result in results)
    summary = {name: counts[name] for name in ("built", "kept", "failed")}
    seconds = time.perf_counter() - start
    columns = (
        "asset = {asset}; bundle = {status}; levels = {levels}; gaussians = {gaussians:,}; "
        "left out = {left_out:,}; size = {size}; time = {seconds:.1f} s"
    )
    shown = [{**result} for result in results]
    for row in shown:
        if "bytes" in row:
            row |= {"left_out": sum(row["dropped"].values()), "size": _common.bytes_text(row["bytes"])}
    last = ", ".join(f"{count} {name}" for name, count in summary.items()) + f", {seconds:.1f} s"
    result = {**summary, "seconds": seconds, "assets": results}
    _common.print_result(options.json, result, [*_common.table_lines(columns, shown), "", last])
    if failed := [result for result in results if result["status"] == "failed"]:
        others = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise RuntimeError(f"{len(failed)} of {len(results)} assets failed: {failed[0]['error']}{others}")


def _assets_of(paths: Sequence[Path]) -> dict[Path, list[Path]]:
    """The files of each asset, by what it is named after: a file, one of a folder, or the folder of a run."""
    assets: dict[Path, list[Path]] = {}
    for path in paths:
        if not path.is_dir():
            assets[path] = [path]
        elif files := run_files(path):
            assets[path] = files
        else:
            found = sorted(p for p in path.iterdir() if p.name.lower().endswith(SUFFIXES) and p.is_file())
            expected = f"a folder with assets ({', '.join(SUFFIXES)}), or a run of a trainer"
            check(path, found, f"{expected}, got one without")
            assets |= {file: [file] for file in found}
    return assets


def _output_of(name: Path, folder: Path | None) -> Path:
    """Where the bundle of an asset goes that is named after that."""
    name = name.resolve() if name.is_dir() else beside(name)
    return (folder or name.parent) / f"{name.name if name.is_dir() else name.stem}.v3dg"


def _outputs(assets: Sequence[Path], folder: Path | None) -> dict[Path, Path]:
    """Where the bundle of each asset goes, by asset."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    asset_of: dict[Path, Path] = {}
    for asset in assets:
        output = _output_of(asset, folder)
        other = asset_of.setdefault(output, asset)
        check(output, other == asset, f"one asset for it, got {other} and {asset}; rename one")
    return {asset: output for output, asset in asset_of.items()}


def _build(options: Build, paths: Sequence[Path], output: Path, executor: Executor | None) -> dict[str, Any]:
    """Build and write one bundle; what was done, as JSON values."""
    for path in paths:
        _common.require_file(path, *SUFFIXES)
    advice = f", got a folder; {output / paths[0].stem}.v3dg is one" if output.is_dir() else ""
    check(output, output.suffix == ".v3dg", f"a file name ending in .v3dg{advice}")
    _common.check_output(output, *paths)
    start = time.perf_counter()
    config = BuildConfig.paper() if options.config == "paper" else BuildConfig()
    if options.cluster_size is not None:
        config = replace(config, cluster_size=options.cluster_size)
    levels, names = levels_path(output), ("seed", "codec", "up", "device", "resume", "memory")
    how: dict[str, Any] = {name: getattr(options, name) for name in names}
    how |= {"progress": not options.quiet, "unusable": "refuse" if options.strict else "drop"}

    def to_resume() -> str:
        return f"; `--resume` continues from {levels}" if levels.exists() else ""

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AssetWarning)  # the result says it
            bundle, is_built = build_file(paths, output, config=config, executor=executor, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted{to_resume()}") from None
    except SchedulerError as error:
        raise SchedulerError(f"{error}{to_resume()}") from None
    except OSError as error:  # a full disk, say
        raise OSError(error.errno, f"{error.strerror}{to_resume()}", error.filename) from None
    asset = str(paths[0]) if len(paths) == 1 else [str(path) for path in paths]
    status = "built" if is_built else "kept"
    result: dict[str, Any] = {"asset": asset, "output": str(output), "status": status}
    result |= {name: bundle.config[name] for name in ("asset_gaussians", "dropped")}
    result |= {"gaussians": bundle.num_gaussians, "clusters": len(bundle.clusters)}
    result |= {"levels": bundle.num_levels, "bytes": output.stat().st_size}
    return result | {"seconds": time.perf_counter() - start}


def _lines(result: dict[str, Any]) -> list[str]:
    how = "kept as it was" if result["status"] == "kept" else f"{result['seconds']:.1f} s"
    line = (
        f"{result['output']}: {result['levels']} levels, {result['clusters']:,} clusters, "
        f"{result['gaussians']:,} gaussians ({result['asset_gaussians']:,} in the asset), "
        f"{_common.bytes_text(result['bytes'])}, {how}"
    )
    return [line, *(["left out: " + describe(result["dropped"])] if result["dropped"] else [])]
