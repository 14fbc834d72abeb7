"""Axes, counts and largest errors of a figure after a conversion through each pair of
formats.

    python -m benchmarks.studies.round_trips

The figure has a different length along each axis and a different colour from each side,
so that the errors show any rotation, reflection or mistake in the harmonics. The study
prints the tables of docs/formats.md.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import v3dg
from v3dg import _core
from v3dg.export import write_streamed_sog
from v3dg.gaussians import Gaussians
from v3dg.io import open_asset, turned_up
from v3dg.rotations import normalised, rotation_from_quaternion

WRITTEN = (".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".usdc")
READ_ONLY = (".splat", "lod-meta.json")
_COUNT = 600
_DEGREE = 3


class Errors(NamedTuple):
    """The largest errors of a figure.

    Attributes:
        position: Error of a coordinate, relative to the height of the figure.
        shape: Error of a covariance, relative to the largest variance of its gaussian.
        color: Error of a colour of degree 0; 1 is the difference between black and
            white.
        harmonics: Error of an SH coefficient above degree 0.
    """

    position: float
    shape: float
    color: float
    harmonics: float


def make_figure() -> Gaussians:
    """Return a post with a foot, a long arm to the right and a short arm forward; -y is
    up."""
    rng = np.random.default_rng(0)
    along = np.linspace(0, 1, _COUNT // 4)
    none = np.zeros_like(along)
    post = np.stack([none, -2 * along, none], axis=1)
    right_arm = np.stack([along, none - 1.5, none], axis=1)
    front_arm = np.stack([none, none - 1.0, 0.5 * along], axis=1)
    foot = np.stack([0.4 * np.cos(6.28 * along), none, 0.4 * np.sin(6.28 * along)], axis=1)
    means = np.concatenate([post, right_arm, front_arm, foot]) + rng.normal(0, 0.02, (_COUNT, 3))
    quats = rng.normal(size=(_COUNT, 4))
    sh = rng.uniform(-0.6, 0.6, (_COUNT, (_DEGREE + 1) ** 2, 3))
    # The figure is red from the right, green from above, and blue from the front.
    sh[:, 1:4] = (
        0.1 * sh[:, 1:4]
        + np.diag([0.0, 0.5, 0.0])
        + np.array([[0, 0, 0], [0, 0, -0.5], [-0.5, 0, 0]])
    )
    return Gaussians(
        means=means.astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.uniform(-4.5, -3, (_COUNT, 3))).astype(np.float32),
        opacities=rng.uniform(0.5, 1, _COUNT).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def write(path: Path, figure: Gaussians) -> None:
    """Write a figure whose up axis is -y, also in formats that v3dg does not write
    otherwise."""
    if path.name == "lod-meta.json":
        config = v3dg.BuildConfig(steps=0)
        bundle = v3dg.build_bundle(figure, config=config, progress=False, device="cpu")
        write_streamed_sog(bundle, path.parent, up="-y")
        return
    if path.suffix == ".splat":
        path.write_bytes(_splat(figure))
        return
    v3dg.write_asset(path, figure)


def _splat(figure: Gaussians) -> bytes:
    """Return the bytes of a `.splat` file, which has no harmonics."""
    color = figure.sh[:, 0] * _core.sh_base0 + 0.5
    rgba = np.concatenate([color, figure.opacities[:, None]], axis=1)
    columns = [
        np.ascontiguousarray(figure.means).view(np.uint8).reshape(len(figure), 12),
        np.ascontiguousarray(figure.scales).view(np.uint8).reshape(len(figure), 12),
        np.rint(rgba.clip(0, 1) * 255).astype(np.uint8),
        np.rint(figure.quats * 127 + 128).astype(np.uint8),
    ]
    return np.concatenate(columns, axis=1).tobytes()


def place_of(folder: Path, ending: str) -> Path:
    """Return a path for a file of a format, in a separate folder."""
    own = folder / ending.strip(".").replace(".", "_")
    own.mkdir(exist_ok=True)
    if ending.startswith("."):
        return own / f"figure{ending}"
    return own / ending


def errors_of(found: Gaussians, figure: Gaussians) -> Errors:
    """Return the largest errors between each gaussian of the figure and the nearest
    gaussian that was read."""
    distances = np.square(figure.means[:, None].astype(np.float64) - found.means).sum(axis=2)
    nearest = distances.argmin(axis=1)
    same = found.subset(nearest)
    height = float(np.ptp(figure.means[:, 1]))
    num_common = min(found.sh.shape[1], figure.sh.shape[1])
    differences = np.abs(same.sh[:, :num_common] - figure.sh[:, :num_common])
    shapes = _covariances(figure)
    sizes = np.abs(shapes).max(axis=(1, 2))
    return Errors(
        position=float(np.abs(same.means - figure.means).max()) / height,
        shape=float((np.abs(_covariances(same) - shapes).max(axis=(1, 2)) / sizes).max()),
        color=float(differences[:, 0].max()) * _core.sh_base0,
        harmonics=float(differences[:, 1:].max(initial=0.0)),
    )


def _covariances(gaussians: Gaussians) -> npt.NDArray[np.float64]:
    """Return the covariances (N, 3, 3) of gaussians, which do not depend on the order
    and signs of their axes."""
    half = rotation_from_quaternion(normalised(gaussians.quats)) * gaussians.scales[:, None]
    return np.asarray(half @ half.transpose(0, 2, 1))


def main() -> None:
    figure = make_figure()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = {}
        print("| format | written | read | up in the file | why -y is up in memory | errors |")
        print("| --- | --- | --- | --- | --- | --- |")
        for ending in (*WRITTEN, *READ_ONLY):
            path = place_of(folder, ending)
            write(path, figure)
            file = open_asset(path)
            sources[ending] = v3dg.read_asset(path)
            up = "none"
            if ending in WRITTEN:
                up = turned_up(path) or "none"
            reason = file.declared.up_reason or "coordinates are those of the file"
            count = len(sources[ending])
            errors = _text(errors_of(sources[ending], figure))
            print(f"| `{ending}` | {len(figure)} | {count} | {up} | {reason} | {errors} |")
        print()
        heads = "".join(f" to `{ending}` |" for ending in WRITTEN)
        print(f"| |{heads}")
        print("| --- |" + " --- |" * len(WRITTEN))
        for source, gaussians in sources.items():
            cells = []
            for target in WRITTEN:
                path = place_of(folder, f".second{target}")
                v3dg.write_asset(path, gaussians)
                cells.append(_text(errors_of(v3dg.read_asset(path), figure)))
            print(f"| from `{source}` | " + " | ".join(cells) + " |")


def _text(errors: Errors) -> str:
    """Return the errors as text with one digit each. Errors below 1e-6, which rounding
    to float32 causes, become 0."""
    return ", ".join(map(_digit, errors))


def _digit(error: float) -> str:
    if error < 1e-6:
        return "0"
    return f"{error:.0e}".replace("e-0", "e-")


if __name__ == "__main__":
    main()
