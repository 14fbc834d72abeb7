"""Frames and gradients of v3dg in comparison with other rasterizers, in one run: times,
memory and errors.

    python -m benchmarks.studies.peers --layout donutsea.json --asset donut.ply \\
        --captured ASSETS --names Fungi --modules PEERS -o peers.json

The study measures the renderers that can be imported: gsplat 1.5, the inference
renderer of gsplat's main branch ("HiGS"), Faster-GS and FlashGS. PEERS has a folder for
each renderer, which is put at the front of Python's path. The folders are named
`gsplat` and `higs` and, for renderers whose filter is a compile-time constant,
`fastergs_0`, `fastergs_0.3`, `flashgs_0` and `flashgs_0.3`. A separate process measures
each renderer, so that a failure does not affect other renderers. The result records
failures with their messages.

ASSETS is a folder as for `pairs`. Instances are drawn without a filter. Assets and
random gaussians are drawn with 0.3 px², as in training, and at the first size also
without a filter. Times are taken with CUDA events around single calls, from idle device
to idle device, so Python's overhead is included. Errors are relative to float64, in
eight windows of each picture. Memory is the memory of the process on the device while
it draws, without inputs that the renderer has copied. A training step starts from
logarithms of scales and logits of opacities, as optimisers store them. Its loss is a
weighted sum of the picture's colours. Gradients for few gaussians are compared with
gradients in float64.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import statistics
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from benchmarks.evaluation import gpu, record
from benchmarks.evaluation.measure import times_ms
from benchmarks.studies.peers import scenes
from benchmarks.studies.peers.draw import INPUTS, ROWS, Draw, Job, Peer, Raw, jobs
from benchmarks.studies.peers.scenes import TRAINED_PX2, Subject
from v3dg.cameras import Camera

Row = dict[str, Any]

_WARM_UPS = 3
_LEAST_REPEATS, _MOST_REPEATS = 7, 51
# Gaussians, width and height for the comparison of gradients with float64.
_SMALL = 20_000, 320, 180
_TRUTHS = "truths"
_OURS = "v3dg"


@dataclass
class Config:
    asset: Path | None = None
    """Trained asset, a .ply file; by default the generated asset."""
    layout: Path | None = None
    """Layout of instances of that asset; by default no layout is measured."""
    cameras: tuple[int, ...] = (45, 50, 55, 59)
    """Indices of cameras of the layout."""
    captured: Path | None = None
    """Folder with assets.json; by default no captured asset is measured."""
    names: tuple[str, ...] = ()
    """Names of assets in that folder."""
    counts: tuple[int, ...] = (1_000_000, 4_000_000, 20_000_000)
    """Numbers of random gaussians."""
    sh_degree: int = 3
    """SH degree of the random gaussians."""
    widths: tuple[int, ...] = (1920, 3840)
    """Widths of pictures in px; pictures have an aspect ratio of 16:9."""
    train_at_most: int = 4_000_000
    """Maximum number of gaussians in a scene for which training steps are measured."""
    modules: Path | None = None
    """Folder that contains a folder for each of the other renderers."""
    jobs: tuple[str, ...] = ()
    """Names of the jobs to run; by default all."""
    seconds: float = 0.4
    """Time in seconds to spend on a row; there are always 7 to 51 repeats."""
    patience: float = 180.0
    """Seconds without a result after which a process is terminated."""
    window: int = 128
    """Width and height of the compared windows in px."""
    device: Literal["cpu", "cuda"] = "cuda"
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None


def subjects(config: Config) -> Iterator[tuple[str, Callable[[], Subject]]]:
    """Yield the name of each scene and a function that creates it. The largest scene
    comes last, because memory pools never shrink."""
    device = config.device
    for name in config.names:
        yield name, partial(scenes.captured, config.captured or Path(), name, device)
    for count in sorted(config.counts):
        yield f"random {count}", partial(scenes.random, count, config.sh_degree, device)
    if config.layout is not None:
        make = partial(scenes.instances, config.layout, config.asset, config.cameras, device)
        yield config.layout.stem, make


def views(config: Config, subject: Subject, filter_px2: float) -> Iterator[tuple[Row, Camera]]:
    """Yield the description and the camera of each picture with a filter."""
    widths = config.widths if filter_px2 == subject.filters_px2[0] else config.widths[:1]
    for width in widths:
        for name, camera in subject.cameras.items():
            height = width * 9 // 16
            about = {"scene": subject.name, "view": name, "width": width, "height": height}
            yield {**about, "filter_px2": filter_px2}, scenes.at_size(camera, width, height)


class Book:
    """Writes each row as a line of JSON as soon as it is measured, so that the results
    of a crashed process remain."""

    def __init__(self, folder: Path, job: str) -> None:
        self._path, self._folder, self._job = folder / f"{job}.jsonl", folder, job

    def write(self, kind: str, row: Row) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps({"kind": kind, "job": self._job, **row}) + "\n")
        print(self._job, kind, {k: v for k, v in row.items() if k != "trace"}, flush=True)

    def rows(self) -> list[Row]:
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        return [json.loads(line) for line in lines]

    def failure(self, about: Row, error: BaseException) -> None:
        said = f"{type(error).__name__}: {error}"
        self.write(
            "failure", {**about, "error": said[-600:], "trace": traceback.format_exc()[-1500:]}
        )

    def truth_path(self, about: Row) -> Path:
        parts = (str(about[name]) for name in ("scene", "view", "width", "filter_px2"))
        return self._folder / ("_".join(parts).replace(" ", "-") + ".npz")


def work(config: Config, name: str, folder: Path) -> None:
    """Run a job; this is the main function of its process."""
    book = Book(folder, name)
    job = next((job for job in jobs() if job.name == name), None)
    if config.modules is not None:
        sys.path.insert(0, str(config.modules / name))
    try:
        if job is not None:
            importlib.import_module(job.module)
    except Exception as error:
        book.failure({}, error)
        return
    if config.device == "cuda":
        with gpu.PeakMemory():  # records the memory of an idle process
            pass
    for scene, make in subjects(config):
        try:
            subject = make()
            if job is None:
                write_truths(config, subject, book)
            else:
                measure(config, job, subject, book)
            del subject
        except Exception as error:
            book.failure({"scene": scene}, error)
    if job is not None:
        compare_gradients(config, job, book)


def write_truths(config: Config, subject: Subject, book: Book) -> None:
    for filter_px2 in subject.filters_px2:
        for about, camera in views(config, subject, filter_px2):
            pictures = scenes.truths(subject, camera, filter_px2, config.window)
            np.savez(book.truth_path(about), *pictures)


def measure(config: Config, job: Job, subject: Subject, book: Book) -> None:
    """Measure frames of every view, and training steps of the first view."""
    filters = [px2 for px2 in subject.filters_px2 if job.filter_px2 in (None, px2)]
    few = len(subject.gaussians) <= config.train_at_most
    for peer in job.peers:
        if subject.gaussians.sh_degree not in peer.sh_degrees:
            continue
        for filter_px2 in filters:
            parts: list[Callable[..., None]] = [frames]
            if peer.train and few and filter_px2 == TRAINED_PX2:
                parts.append(training)
            for part in parts:
                try:
                    part(config, peer, subject, filter_px2, book)
                except Exception as error:
                    about = {"scene": subject.name, "renderer": peer.name, "filter_px2": filter_px2}
                    book.failure({**about, "part": part.__name__}, error)


def frames(config: Config, peer: Peer, subject: Subject, filter_px2: float, book: Book) -> None:
    import torch

    with torch.no_grad():
        of = peer.prepare(subject, filter_px2)
        copied = set(INPUTS) - set(peer.keeps(subject, filter_px2))
        spare = sum(getattr(subject.gaussians, name).nbytes for name in copied) / 1e9
        for view, camera in views(config, subject, filter_px2):
            about = {**view, "renderer": peer.name, "gaussians": len(subject.gaussians)}
            try:
                row, shown = measured(config, of(camera), spare)
                errors = errors_of(
                    peer.picture(shown), camera, book.truth_path(view), config.window
                )
                book.write("frame", {**about, **row, **errors})
            except Exception as error:
                book.failure(about, error)


def training(config: Config, peer: Peer, subject: Subject, filter_px2: float, book: Book) -> None:
    """Measure a training step of the first view."""
    import torch

    assert peer.train is not None
    view, camera = next(views(config, subject, filter_px2))
    generator = torch.Generator(config.device).manual_seed(1)
    shape = (camera.height, camera.width, 3)
    weights = torch.randn(*shape, generator=generator, device=config.device)
    trained = peer.train(Raw.of(subject.gaussians), camera, filter_px2, weights)
    forward, _ = measured(config, trained.forward)
    both, _ = measured(config, trained.step)
    about = {**view, "renderer": peer.name, "gaussians": len(subject.gaussians)}
    book.write("training", {**about, "forward_ms": forward["ms"], **both})


def measured(config: Config, draw: Draw, spare: float = 0.0) -> tuple[Row, Any]:
    """Measure a call that draws a frame.

    Args:
        spare: Gigabytes in use that the call does not need.

    Returns:
        Times and device memory, and the frame.
    """
    gigabytes = None
    if config.device == "cuda":
        with gpu.PeakMemory() as memory:
            for _ in range(_WARM_UPS):
                draw()
            times_ms(draw, config.device, 1)  # waits until the device is idle
        gigabytes = round(memory.gigabytes - spare, 2)
    first = statistics.median(times_ms(draw, config.device, 3))
    repeats = int(min(max(1e3 * config.seconds / max(first, 1e-3), _LEAST_REPEATS), _MOST_REPEATS))
    times = times_ms(draw, config.device, repeats)
    row = {
        "ms": statistics.median(times),
        "p95_ms": float(np.quantile(times, 0.95)),
        "least_ms": min(times),
    }
    return {
        **{k: round(v, 3) for k, v in row.items()},
        "repeats": repeats,
        "gigabytes": gigabytes,
    }, draw()


def errors_of(picture: Any, camera: Camera, path: Path, side: int) -> Row:
    """Return the error of the windows of a picture against the reference windows in the
    file `path`, with colours clipped to [0, 1]."""
    if not path.exists():
        return {}
    picture = picture.cpu().numpy() if hasattr(picture, "cpu") else np.asarray(picture)
    scale = 255 if picture.dtype == np.uint8 else 1
    with np.load(path) as stored:
        truths = [stored[name] for name in stored.files]
    differences = [
        np.clip(picture[y0:y1, x0:x1].astype(np.float64) / scale, 0, 1) - np.clip(truth, 0, 1)
        for (x0, y0, x1, y1), truth in zip(scenes.windows(camera, side), truths, strict=True)
    ]
    error = np.abs(np.concatenate([d.reshape(-1, 3) for d in differences]))
    return {
        "psnr": round(float(-10 * np.log10(max(np.square(error).mean(), 1e-20))), 2),
        "mean_error": float(f"{error.mean():.3e}"),
        "largest_error": float(f"{error.max():.3e}"),
        "share_over_1_255": float(f"{(error.max(axis=1) > 1 / 255).mean():.3e}"),
    }


def compare_gradients(config: Config, job: Job, book: Book) -> None:
    """Record the relative L2 distance of gradients to float64 gradients, for few
    gaussians in a small picture."""
    trainable = [peer for peer in job.peers if peer.train and job.filter_px2 in (None, TRAINED_PX2)]
    if not trainable:
        return
    import torch

    count, width, height = _SMALL
    subject = scenes.random(count, config.sh_degree, config.device)
    camera = scenes.at_size(subject.cameras["front"], width, height)
    weights = torch.from_numpy(np.random.default_rng(1).standard_normal((height, width, 3)))
    # Keeps the sizes of gaussians in px.
    wide = subject.gaussians.scales * scenes.TRAINED_WIDTH / width
    raw = Raw.of(replace(subject.gaussians, scales=wide))
    doubles = Raw(*(getattr(raw, name).double().cpu() for name in ROWS))
    ours = next(peer.train for peer in jobs()[0].peers if peer.train)
    exact = ours(doubles, camera, TRAINED_PX2, weights)
    truth = exact.named(exact.step())
    for peer in trainable:
        try:
            assert peer.train is not None
            trained = peer.train(raw, camera, TRAINED_PX2, weights.float().to(config.device))
            found = {name: g.double().cpu() for name, g in trained.named(trained.step()).items()}
            book.write("gradients", {"renderer": peer.name, "relative_l2": distances(found, truth)})
        except Exception as error:
            book.failure({"renderer": peer.name, "part": "gradients"}, error)


def distances(values: dict[str, Any], truths: dict[str, Any]) -> dict[str, float]:
    """Return the L2 distance of each array, relative to the norm of the reference."""
    found = {
        name: float((values[name] - truths[name]).norm() / truths[name].norm()) for name in ROWS
    }
    return {name: float(f"{distance:.2e}") for name, distance in found.items()}


def run(config: Config, name: str, folder: Path) -> list[Row]:
    """Run a job in a process; return its rows and, if it failed, a row with the
    message."""
    book = Book(folder, name)
    process = multiprocessing.get_context("spawn").Process(target=work, args=(config, name, folder))
    process.start()
    process.join(config.patience)
    if process.is_alive():
        process.terminate()
        process.join()
        book.write("failure", {"error": f"ended after {config.patience:g} s"})
    elif process.exitcode:
        book.write("failure", {"error": f"the process ended with {process.exitcode}"})
    return book.rows()


def main(config: Config) -> None:
    known = [job.name for job in jobs()]
    unknown = set(config.jobs) - set(known)
    if unknown:
        sys.exit(f"jobs: expected some of {', '.join(known)}, got {', '.join(sorted(unknown))}")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in [_TRUTHS, *(name for name in known if not config.jobs or name in config.jobs)]:
            rows += run(config, name, Path(folder))
            record.write(config.output, result(config, rows), config.device)
    print_table([row for row in rows if row["kind"] == "frame"])


def result(config: Config, rows: list[Row]) -> Row:
    kinds = {
        kind: [{k: v for k, v in row.items() if k != "kind"} for row in rows if row["kind"] == kind]
        for kind in ("frame", "training", "gradients", "failure")
    }
    differs = {peer.name: peer.differs for job in jobs() for peer in job.peers if peer.differs}
    versions = {job.name: version for job in jobs() if (version := version_of(config, job.name))}
    return {"window": config.window, "differs": differs, "versions": versions, **kinds}


def version_of(config: Config, job: str) -> str | None:
    """Return the text of the file VERSION in a renderer's folder; None without one."""
    path = (config.modules or Path()) / job / "VERSION"
    return path.read_text().strip() if config.modules and path.exists() else None


def print_table(rows: list[Row]) -> None:
    """Print for each picture our time relative to the fastest other renderer, and for
    each renderer the time, the PSNR to float64 and the memory."""
    pictures: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = tuple(row[name] for name in ("scene", "view", "width", "filter_px2"))
        pictures.setdefault(key, []).append(row)
    for key, found in pictures.items():
        ours = [
            row["ms"]
            for row in found
            if row["job"] == _OURS and not row["renderer"].endswith("1e-4")
        ]
        peers = [row["ms"] for row in found if not row["job"].startswith(_OURS)]
        ratio = f"ours / fastest peer {min(ours) / min(peers):.2f}" if ours and peers else ""
        print("{}, {}, {} px, filter {}: ".format(*key) + ratio)
        for row in found:
            name = row["renderer"] + (" again" if row["job"].endswith("again") else "")
            psnr = f"{row['psnr']:.1f} dB" if "psnr" in row else ""
            memory = f"{row['gigabytes']} GB" if row["gigabytes"] is not None else ""
            print(
                f"    {name:24} {row['ms']:9.3f} ms, p95 {row['p95_ms']:9.3f}  {psnr:>9}  {memory}"
            )
