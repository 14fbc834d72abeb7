"""`v3dg build`."""

import logging
import shlex
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence, Sized
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg import _device, _extras
from v3dg._json import JsonObject
from v3dg._numbers import check
from v3dg._urls import beside, cleaned, shown
from v3dg.bundle import Bundle
from v3dg.cameras import Axis
from v3dg.cleaning import AssetWarning, coarse_note, describe
from v3dg.cli import _common
from v3dg.cli._views import ask_up, is_at_terminal
from v3dg.gaussians import Gaussians
from v3dg.io import SUFFIXES, asset_file, open_asset, run_files, subject_name
from v3dg.levels import BuildConfig, DraftWarning, build_file, levels_path
from v3dg.levels.memory import free_bytes
from v3dg.levels.quality import Quality, estimated_seconds, pictures_of
from v3dg.levels.refine_sizes import refine_bytes
from v3dg.levels.scheduler import SchedulerError
from v3dg.levels.viewpoints import SeenFrom, text_of
from v3dg.upright import ASSUMED, up_of

_PATIENCE_S = 20  # time limit for answers of a scheduler
_MOST_REASON = 200  # maximum number of characters of a dask error that are shown
# The up axis is guessed from this number of samples. The second number is the gaussians
# in each sample.
_NUM_SAMPLES = 64
_SAMPLE_SIZE = 256
_SEVERAL = tyro.conf.arg(metavar="PATH...", help_behavior_hint="(at least one)")


@dataclass
class Build(_common.OnDevice):
    """Build a bundle from a trained asset, or from each of several assets. If one of
    several fails, the others are still built."""

    assets: Annotated[tuple[Path, ...], tyro.conf.Positional, _SEVERAL]
    """Files of trained gaussians, or folders with such files. If --output ends in
    .v3dg, all files together form one asset."""
    output: Annotated[Path | None, _common.option("PATH", "-o")] = None
    """Bundle to write, or folder for the bundles of several assets. By default, each
    bundle is written next to its asset."""
    config: Literal["default", "paper"] = "default"
    """Settings of the build: the defaults, or those of the V3DG paper."""
    cluster_size: Annotated[int | None, _common.option("N")] = None
    """Maximum number of gaussians in a cluster. The default is that of --config."""
    codec: Literal["float32", "quantized"] = "float32"
    """Encoding of gaussians: lossless, or rounded to 16 to 40 bytes (docs/format.md
    lists the errors)."""
    quality: Annotated[Quality | None, _common.option("{draft,standard,best}")] = None
    """How similar the levels are to the asset. `draft` keeps the levels as they are
    built. `standard` also refines them together. On an H100, this takes 2 s more for
    45,000 gaussians, 5 s for 500,000 and 12 s for 2 million, and grows in proportion;
    on a CPU, it takes minutes. `best` uses five times as many pictures. The default is
    `standard` on a GPU, and `draft` otherwise."""
    seen_from: Annotated[SeenFrom, _common.option("{auto,outside,inside,both}")] = "auto"
    """Where pictures of a refinement are taken from. By default, this depends on the
    free space that the asset surrounds. With photographs, `v3dg refine --cameras` is
    better."""
    up: Annotated[Axis | None, _common.option("{x,y,z,-x,-y,-z}")] = None
    """The axis of the asset that points up, which the bundle stores. If it is unknown,
    a user at a terminal is asked."""
    antialiased: Annotated[Literal["yes", "no"] | None, _common.option("{yes,no}")] = None
    """Whether the asset was trained with antialiasing. The default is the declaration
    in its file, or no if there is none."""
    seed: int = 0
    """Seed of random numbers. The same seed gives the same file, byte for byte, on the
    same kind of device and for any number of threads."""
    strict: _common.Flag = False
    """Fail if the asset has invalid values. By default, gaussians with invalid values
    are left out."""
    resume: _common.Flag = False
    """Continue after the last finished level, and keep finished bundles that were built
    from the same gaussians with the same settings."""
    overwrite: _common.Flag = False
    """Replace existing bundles of several assets. The bundle of a single asset is
    always replaced."""
    memory: Annotated[str | None, _common.option("SIZE")] = None
    """Host memory for the build, such as 8GiB. The default is half of the free memory.
    An asset that does not fit is sorted on the disk of the output."""
    scheduler: Annotated[str | None, _common.option("ADDRESS")] = None
    """Build on the workers of the dask scheduler at this address, such as
    tcp://host:8786. The workers need access to the folder of the output. Needs the
    extra `cluster`."""


def run(options: Build) -> None:
    expected = "at least one asset or a folder of assets, got nothing; run v3dg build --help"
    _common.check_usage("PATH", options.assets, expected)
    is_one = options.output is not None and options.output.suffix == ".v3dg"
    assets = _assets_of(options.assets)
    with _executor_at(options.scheduler) as executor:
        if is_one or list(assets) == list(options.assets[:1]):
            output = options.output or _output_of(options.assets[0], None)
            files = list(dict.fromkeys(file for files in assets.values() for file in files))
            if options.up is None and not options.resume:
                options.up = _asked_up(files[0])
            result = _build(options, files, output, executor)
            _common.print_result(result, _lines(result), as_json=options.json)
        else:
            _run_many(options, assets, executor)


def _asked_up(path: Path) -> Axis | None:
    """Ask a user at a terminal for the up axis of an asset. Return None if there is no
    terminal, or if the format or the gaussians determine the axis."""
    if not is_at_terminal():
        return None
    _common.require_file(path, *SUFFIXES)
    asset = open_asset(path)
    if asset.num_gaussians == 0:
        return None
    samples = []
    stride = max(asset.num_gaussians // _NUM_SAMPLES, _SAMPLE_SIZE)
    for start in range(0, asset.num_gaussians, stride):
        samples.append(asset.read(start, min(start + _SAMPLE_SIZE, asset.num_gaussians)))
    axis, reason = up_of(Gaussians.concatenate(samples), declared=asset.declared)
    if reason == ASSUMED:
        return ask_up(path, axis)
    return None


@contextmanager
def _executor_at(address: str | None) -> Iterator[Executor | None]:
    """Yield an executor with the workers of a dask scheduler. Without an address,
    yield None."""
    if address is None:
        yield None
        return
    distributed = _extras.load("distributed")
    # dask must not log errors, because the command reports them itself.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    _greet(address)
    expected = f"{address}: expected a dask scheduler"
    try:
        client = distributed.Client(address, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split()) or "no answer"
        raise RuntimeError(
            f"{expected} that answers, got none ({reason}); check the address"
        ) from None
    except Exception as error:
        # Servers of another kind or version may cause errors of any type.
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:_MOST_REASON]
        raise RuntimeError(
            f"{expected}, got another server ({reason}); check the address"
        ) from None
    with client:
        yield client.get_executor()


def _greet(address: str) -> None:
    """Send a greeting to a scheduler. Raise RuntimeError unless it answers in time in
    dask's protocol.

    A dask client would wait forever for a server that accepts connections but never
    answers.
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
        text = f"{expected} such as tcp://host:8786, got an invalid address ({error})"
        raise RuntimeError(text) from None
    try:
        asyncio.run(connect())
    except (OSError, asyncio.TimeoutError) as error:
        reason = " ".join(str(error).split()) or "no answer"
        raise RuntimeError(
            f"{expected} that answers, got none ({reason}); check the address"
        ) from None
    # The scheduler uses TLS, but no certificates are configured.
    except TypeError as error:
        raise RuntimeError(
            f"{expected} without TLS, got one that needs it ({error}); configure dask's security"
        ) from None
    except Exception:
        # For another protocol, dask raises this error, because it reads the first eight
        # bytes as a size.
        advice = "pass the address that `dask scheduler` prints"
        raise RuntimeError(
            f"{expected}, got a server that speaks another protocol; {advice}"
        ) from None


def _run_many(options: Build, assets: dict[Path, list[Path]], executor: Executor | None) -> None:
    outputs = _outputs(list(assets), options.output)
    if not options.overwrite and not options.resume:
        _check_new(list(outputs.values()))
    start = time.perf_counter()
    results: list[JsonObject] = []
    for asset, output in outputs.items():
        if not options.quiet:
            _common.tell(f"[{len(results) + 1}/{len(outputs)}] {shown(asset)}")
        try:
            results.append(_build(options, assets[asset], output, executor))
        except SchedulerError as error:  # all other assets would fail in the same way
            raise SchedulerError(f"{error}; {_progress_text(results, outputs)}") from None
        except _common.FAILURES as error:
            failure = cleaned(_common.failure_text(error))
            results.append({"asset": shown(asset), "status": "failed", "error": failure})
            if not options.quiet:
                _common.tell(f"failed: {results[-1]['error']}")
        except KeyboardInterrupt:
            text = f"interrupted with {_progress_text(results, outputs)}; `--resume` continues"
            raise KeyboardInterrupt(text) from None
    _print_many(options, results, time.perf_counter() - start)
    failed = [result for result in results if result["status"] == "failed"]
    if failed:
        text = f"{len(failed)} of {len(results)} assets failed: {failed[0]['error']}"
        if len(failed) > 1:
            text += f" (and {len(failed) - 1} more)"
        raise RuntimeError(text)


def _progress_text(results: Sized, outputs: Sized) -> str:
    return f"{len(results)} of {len(outputs)} assets done"


def _print_many(options: Build, results: list[JsonObject], seconds: float) -> None:
    columns = [
        _common.Column("asset", "{asset}"),
        _common.Column("bundle", "{status}"),
        _common.Column("levels", "{levels}"),
        _common.Column("gaussians", "{gaussians:,}"),
        _common.Column("left out", "{left_out:,}"),
        _common.Column("size", "{size}"),
        _common.Column("time", "{seconds:.1f} s"),
    ]
    rows = []
    for result in results:
        row = dict(result)
        if "bytes" in result:
            row["left_out"] = sum(result["dropped"].values())
            row["size"] = _common.bytes_text(result["bytes"])
        rows.append(row)
    counts = Counter(result["status"] for result in results)
    summary = {name: counts[name] for name in ("built", "kept", "failed")}
    last_line = (
        ", ".join(f"{count} {name}" for name, count in summary.items()) + f", {seconds:.1f} s"
    )
    lines = [*_common.table_lines(columns, rows), "", last_line]
    result = {**summary, "seconds": seconds, "assets": results}
    _common.print_result(result, lines, as_json=options.json)


def _assets_of(paths: Sequence[Path]) -> dict[Path, list[Path]]:
    """Return the files of each asset, by the path that identifies the asset. The path
    is a file, or a folder that is one asset or contains a trainer's run."""
    assets: dict[Path, list[Path]] = {}
    for path in paths:
        if not path.is_dir() or asset_file(path) != path:
            assets[path] = [path]
        elif files := run_files(path):
            assets[path] = files
        else:
            files = sorted(
                p for p in path.iterdir() if p.name.lower().endswith(SUFFIXES) and p.is_file()
            )
            expected = f"a folder with assets ({', '.join(SUFFIXES)}), or with a run of a trainer"
            check(path, files, f"{expected}, got one with neither")
            for file in files:
                assets[file] = [file]
    return assets


def _output_of(asset: Path, folder: Path | None) -> Path:
    """Return the path of the bundle for an asset, named after the asset."""
    if asset.is_dir():
        place = asset.resolve()
        stem = place.name
    else:
        place = beside(asset)
        stem = subject_name(asset)
    return (folder or place.parent) / f"{stem}.v3dg"


def _outputs(assets: Sequence[Path], folder: Path | None) -> dict[Path, Path]:
    """Return the path of the bundle for each asset."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    asset_from_output: dict[Path, Path] = {}
    for asset in assets:
        output = _output_of(asset, folder)
        first = asset_from_output.setdefault(output, asset)
        check(
            output,
            first == asset,
            f"one asset for this bundle, got {shown(first)} and {shown(asset)}; rename one of them",
        )
    return {asset: output for output, asset in asset_from_output.items()}


def _check_new(outputs: Sequence[Path]) -> None:
    """Raise UsageError if bundles would be replaced whose names the user has not
    given."""
    existing = [output for output in outputs if output.exists()]
    if existing:
        ending = ""
        if len(existing) > 1:
            ending = f", and {len(existing) - 1} more"
        advice = "--resume keeps finished bundles, --overwrite replaces them"
        raise _common.UsageError(f"{existing[0]}: already exists{ending}; {advice}")


def _build(
    options: Build, paths: Sequence[Path], output: Path, executor: Executor | None
) -> JsonObject:
    """Build and write one bundle. Return its description as a JSON object."""
    _check_files(paths, output)
    start = time.perf_counter()
    with _resume_advised(output):
        bundle, is_built = _build_file(options, paths, output, executor)
    seconds = time.perf_counter() - start
    notes = _notes(options, paths)
    coarse = coarse_note(_sample_of(bundle))
    if coarse is not None:
        notes.append(f"{output}: {coarse}")
    for note in notes:
        _common.tell(note)
    asset: str | list[str] = [shown(path) for path in paths]
    if len(paths) == 1:
        asset = shown(paths[0])
    status = "kept"
    if is_built:
        status = "built"
    return {
        "asset": asset,
        "output": str(output),
        "status": status,
        "asset_gaussians": bundle.config["asset_gaussians"],
        "dropped": bundle.config["dropped"],
        "gaussians": bundle.num_gaussians,
        "clusters": len(bundle.clusters),
        "levels": bundle.num_levels,
        "sh_degree": bundle.sh_degree,
        "quality": _quality_of(options, bundle),
        "refined": bundle.config.get("refined"),
        "estimated_seconds": _estimated_seconds(options, bundle, is_built=is_built),
        "bytes": output.stat().st_size,
        "seconds": seconds,
        "notes": notes,
    }


def _check_files(paths: Sequence[Path], output: Path) -> None:
    """Raise an error unless the assets can be read and the bundle can be written."""
    for path in paths:
        _common.require_file(path, *SUFFIXES)
    advice = ""
    if output.is_dir():
        advice = f", got a folder; {output / subject_name(paths[0])}.v3dg would be a file in it"
    check(output, output.suffix == ".v3dg", f"a file name ending in .v3dg{advice}")
    _common.check_output(output, *paths)


def _sample_of(bundle: Bundle) -> Gaussians:
    """Return the gaussians of some clusters of level 0. If the bundle has no clusters,
    return all of its gaussians."""
    if not bundle.num_levels:
        return bundle.gaussians
    clusters = bundle.level_range(0)
    stride = max(1, len(clusters) // _NUM_SAMPLES)
    return Gaussians.concatenate([bundle.cluster_gaussians(c) for c in clusters[::stride]])


def _notes(options: Build, paths: Sequence[Path]) -> list[str]:
    """Return lines about the declarations in the files of an asset."""
    config = _config_of(options)
    lines = []
    for path in paths:
        declared = open_asset(path).declared
        if declared.up is not None:
            lines.append(f"{shown(path)}: {declared.up} is up, {declared.up_reason}")
        contradiction = config.contradiction(antialiased=declared.antialiased)
        if contradiction:
            lines.append(f"{shown(path)}: {contradiction}")
        elif declared.antialiased:
            lines.append(f"{shown(path)}: trained with antialiasing")
        lines += [f"{shown(path)}: {note}" for note in declared.notes]
    return lines


def _build_file(
    options: Build, paths: Sequence[Path], output: Path, executor: Executor | None
) -> tuple[Bundle, bool]:
    unusable: Literal["drop", "refuse"] = "drop"
    if options.strict:
        unusable = "refuse"
    quality = options.quality
    if quality is None and options.config == "paper":
        quality = "draft"
    with warnings.catch_warnings(record=True) as caught:
        # The result reports these warnings.
        warnings.simplefilter("ignore", AssetWarning)
        warnings.simplefilter("always", DraftWarning)
        bundle, is_built = build_file(
            paths,
            output,
            config=_config_of(options),
            seed=options.seed,
            progress=not options.quiet,
            device=options.device,
            resume=options.resume,
            unusable=unusable,
            memory=options.memory,
            executor=executor,
            codec=options.codec,
            quality=quality,
            seen_from=options.seen_from,
            up=options.up,
        )
    for warning in caught:
        if issubclass(warning.category, DraftWarning):
            _common.tell(str(warning.message))
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    return bundle, is_built


def _config_of(options: Build) -> BuildConfig:
    config = BuildConfig()
    if options.config == "paper":
        config = BuildConfig.paper()
    if options.cluster_size is not None:
        config = replace(config, cluster_size=options.cluster_size)
    if options.antialiased is not None:
        config = replace(config, asset_antialiased=options.antialiased == "yes")
    return config


@contextmanager
def _resume_advised(output: Path) -> Iterator[None]:
    """Add advice about continuing the build to its errors and interrupts."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted{_resume_advice(output)}") from None
    except SchedulerError as error:
        raise SchedulerError(f"{error}{_resume_advice(output)}") from None
    except OSError as error:  # for example, the disk is full
        if error.errno is None:  # an error about a URL already has a complete text
            raise type(error)(f"{error}{_resume_advice(output)}") from None
        text = f"{error.strerror}{_resume_advice(output)}"
        raise OSError(error.errno, text, error.filename) from None


def _resume_advice(output: Path) -> str:
    """Return the end of the message about an unfinished build, which names the file to
    continue from. If there is no such file, it is empty."""
    levels = levels_path(output)
    if levels.exists():
        return f"; `--resume` continues from {levels}"
    return ""


def _quality_of(options: Build, bundle: Bundle) -> Quality:
    """Return the quality that a bundle was built with."""
    if "refined" not in bundle.config:
        return "draft"
    return options.quality or "standard"


def _estimated_seconds(options: Build, bundle: Bundle, *, is_built: bool) -> float | None:
    """Return the approximate time for refining a new draft on this CPU. Return None for
    other bundles, on a GPU, and if there is too little memory to measure it."""
    is_draft = is_built and bundle.num_levels > 1 and "refined" not in bundle.config
    device = _device.resolve(options.device)
    if not is_draft or device.is_cuda or options.quiet or options.quality == "draft":
        return None
    if refine_bytes(bundle.config["asset_gaussians"], bundle.sh_degree) > free_bytes():
        return None
    return estimated_seconds(bundle, device)


def _refine_advice(result: JsonObject) -> str:
    """Return a line with the command that refines a draft, and the time that it
    takes."""
    output = Path(result["output"])
    refined = output.with_name(f"{output.stem}_refined.v3dg")
    num_leaves = result["asset_gaussians"] - sum(result["dropped"].values())
    pictures = str(pictures_of("standard", num_leaves, result["sh_degree"]))
    command = shlex.join(["v3dg", "refine", str(output), str(refined), "--steps", pictures])
    return (
        f"draft: `{command}` makes its levels more similar to the asset; it takes about "
        f"{_duration_text(result['estimated_seconds'])} on this CPU, or seconds on a GPU"
    )


def _duration_text(seconds: float) -> str:
    """Return a rough time as text."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    if seconds < 5400:
        return f"{round(seconds / 60)} minutes"
    return f"{round(seconds / 3600)} hours"


def _refined_text(refined: JsonObject) -> str:
    """Return how a bundle was refined."""
    text = f"refined by {refined['steps']:,} pictures"
    viewpoints = text_of(refined)
    if viewpoints:
        text += f", {viewpoints}"
    return text


def _lines(result: JsonObject) -> list[str]:
    time_text = f"{result['seconds']:.1f} s"
    if result["status"] == "kept":
        time_text = "kept as it was"
    lines = [
        f"{result['output']}: {result['levels']} levels, {result['clusters']:,} clusters, "
        f"{result['gaussians']:,} gaussians ({result['asset_gaussians']:,} in the asset), "
        f"{_common.bytes_text(result['bytes'])}, {time_text}"
    ]
    if result["dropped"]:
        lines.append("left out: " + describe(result["dropped"]))
    if result["refined"] is not None:
        lines.append(_refined_text(result["refined"]))
    if result["estimated_seconds"] is not None:
        lines.append(_refine_advice(result))
    return lines
