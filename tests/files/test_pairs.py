"""A figure stays upright through every pair of formats, and through exports of bundles
with any up axis."""

import json

import numpy as np
import pytest

import v3dg
from benchmarks.studies.round_trips import (
    READ_ONLY,
    WRITTEN,
    Errors,
    errors_of,
    make_figure,
    place_of,
    write,
)
from v3dg.bundle import Bundle
from v3dg.cameras import AXES
from v3dg.export import write_site, write_streamed_sog, write_tiles, write_usd
from v3dg.formats import _axes
from v3dg.gaussians import Gaussians

# The largest errors of one round trip. For a pair of formats, the two errors add up at
# most.
EXACT = Errors(position=0.0, shape=2e-6, color=0.0, harmonics=0.0)
LARGEST = {
    ".ply": Errors(position=0.0, shape=2e-6, color=0.0, harmonics=0.0),
    ".glb": EXACT,
    ".usdc": EXACT,
    ".spz": Errors(position=5e-6, shape=0.1, color=0.004, harmonics=0.0042),
    ".compressed.ply": Errors(position=6e-4, shape=0.05, color=0.003, harmonics=0.016),
    ".sog": Errors(position=2e-5, shape=0.1, color=0.004, harmonics=0.01),
    ".splat": Errors(position=0.0, shape=0.1, color=0.002, harmonics=0.0),
    "lod-meta.json": Errors(position=2e-5, shape=0.1, color=0.004, harmonics=0.01),
}


@pytest.fixture(scope="module")
def figure():
    return make_figure()


@pytest.fixture(scope="module")
def read_from(figure, tmp_path_factory):
    """Return the figure as it is read from a file of the format with this suffix."""
    if any(ending.startswith(".usd") for ending in WRITTEN):
        pytest.importorskip("pxr")
    folder = tmp_path_factory.mktemp("sources")
    figures = {}
    for ending in (*WRITTEN, *READ_ONLY):
        path = place_of(folder, ending)
        write(path, figure)
        figures[ending] = v3dg.read_asset(path)
    return figures


@pytest.mark.parametrize("target", WRITTEN)
@pytest.mark.parametrize("source", [*WRITTEN, *READ_ONLY])
def test_every_pair_of_formats_keeps_the_figure_upright(
    tmp_path, figure, read_from, source, target
):
    path = place_of(tmp_path, target)
    v3dg.write_asset(path, read_from[source])
    found = v3dg.read_asset(path)
    assert len(found) == len(figure)
    errors = errors_of(found, figure)
    for name, error in errors._asdict().items():
        bound = getattr(LARGEST[source], name) + getattr(LARGEST[target], name)
        assert error <= bound + 1e-7, name


@pytest.fixture(scope="module", params=AXES)
def tilted(request, figure):
    """Return a bundle of the figure with another up axis, which the bundle records."""
    asset = _axes.turned(figure, _axes.MEMORY, _axes.axes_of_up(request.param))
    bundle = v3dg.build_bundle(asset, config=v3dg.BuildConfig(steps=0), progress=False)
    config = {**bundle.config, "up": request.param}
    return Bundle(bundle.clusters, bundle.groups, bundle.gaussians, config, bundle.codec)


def assert_stands(found, figure, largest):
    assert len(found) == len(figure)
    for name, error in errors_of(found, figure)._asdict().items():
        assert error <= getattr(largest, name) + 1e-6, name


def test_a_page_of_any_up_has_what_viewers_take_for_up(tmp_path, figure, tilted):
    write_site(tilted, tmp_path / "site")
    found = v3dg.read_asset(tmp_path / "site" / "lod-meta.json")
    assert_stands(found, figure, LARGEST[".sog"])
    write_streamed_sog(tilted, tmp_path / "levels")
    found = v3dg.read_asset(tmp_path / "levels" / "lod-meta.json")
    assert_stands(found, figure, LARGEST[".sog"])


def test_a_stage_of_any_up_has_z_up(tmp_path, figure, tilted):
    pytest.importorskip("pxr")
    write_usd(tilted, tmp_path / "a.usdc")
    assert_stands(v3dg.read_asset(tmp_path / "a.usdc"), figure, EXACT)


def test_tiles_of_any_up_have_z_up(tmp_path, figure, tilted):
    write_tiles(tilted, tmp_path / "tiles")
    parts = [v3dg.read_asset(file) for file in (tmp_path / "tiles").rglob("0_*.glb")]
    content = _axes.turned(Gaussians.concatenate(parts), _axes.MEMORY, _axes.GLTF)
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    transform = np.reshape(root["transform"], (4, 4)).T[:3, :3]
    # rotation of glTF content in 3D Tiles
    y_up_to_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    means = content.means @ y_up_to_z_up.T @ transform.T
    wanted = _axes.turned(figure, _axes.MEMORY, _axes.Z_UP)
    nearest = np.square(wanted.means[:, None] - means).sum(axis=2).argmin(axis=1)
    np.testing.assert_allclose(means[nearest], wanted.means, atol=1e-4)


@pytest.mark.parametrize("target", [".glb", ".spz", ".usdc"])
def test_a_bundle_of_any_up_stands_in_files_that_have_axes(tmp_path, figure, tilted, target):
    if target == ".usdc":
        pytest.importorskip("pxr")
    path = place_of(tmp_path, target)
    v3dg.write_asset(path, tilted.level_gaussians(0), up=tilted.config["up"])
    assert_stands(v3dg.read_asset(path), figure, LARGEST[target])
