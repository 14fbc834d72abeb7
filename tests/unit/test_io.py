"""Tests file formats by their names, folders of trainers, and sizes of assets on disk.
tests/files has tests of each format."""

from pathlib import Path

import numpy as np
import pytest

from random_bundle import random_gaussians
from v3dg import io, read_asset, write_asset

ASSET = random_gaussians(np.random.default_rng(0), 9)


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


@pytest.mark.parametrize("suffix", io.WRITE_SUFFIXES)
def test_what_is_written_can_be_read(suffix, tmp_path):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    path = tmp_path / f"a{suffix}"
    write_asset(path, ASSET)
    assert len(read_asset(path)) == len(ASSET)
    assert io.asset_bytes(path) == path.stat().st_size


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz"])
def test_capitals_in_a_name_change_nothing(suffix, tmp_path):
    for name in (f"A{suffix.upper()}", f"a{suffix}"):
        write_asset(tmp_path / name, ASSET)
    capitals, small = sorted(tmp_path.iterdir())
    assert capitals.read_bytes() == small.read_bytes()
    np.testing.assert_array_equal(read_asset(capitals).means, read_asset(small).means)


def test_the_longer_ending_is_the_format(tmp_path):
    write_asset(tmp_path / "a.compressed.ply", ASSET)
    write_asset(tmp_path / "a.ply", ASSET)
    compressed, plain = sorted(tmp_path.iterdir())
    assert b"property uint packed_position" in compressed.read_bytes()
    assert b"property uint packed_position" not in plain.read_bytes()


@pytest.mark.parametrize("name", ["a.txt", "a", "ply", "a.ply.gz", "a.json"])
def test_other_names_are_refused_before_anything_is_opened(name, tmp_path):
    for action in (io.open_asset, lambda path: write_asset(path, ASSET)):
        with pytest.raises(ValueError, match=r"expected a file name that ends in .*\.ply"):
            action(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_versions_and_encodings_belong_to_their_formats(tmp_path):
    with pytest.raises(ValueError, match=r"version: expected None for .*a\.ply, .* got 3"):
        write_asset(tmp_path / "a.ply", ASSET, version=3)
    with pytest.raises(
        ValueError, match=r"encoding: expected the default for .*a\.spz, .* got 'ascii'"
    ):
        write_asset(tmp_path / "a.spz", ASSET, encoding="ascii")
    with pytest.raises(ValueError, match=r"encoding: expected .*got 'text'"):
        write_asset(tmp_path / "a.ply", ASSET, encoding="text")
    assert list(tmp_path.iterdir()) == []


def test_a_file_stands_for_its_asset(tmp_path):
    write_asset(tmp_path / "a.ply", ASSET)
    assert io.loaded(ASSET) is ASSET
    np.testing.assert_array_equal(io.loaded(tmp_path / "a.ply").means, ASSET.means)
    write_asset(tmp_path / "b.ply", str(tmp_path / "a.ply"))
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


def test_parts_of_an_open_asset_are_those_of_the_whole(tmp_path):
    write_asset(tmp_path / "a.ply", ASSET)
    file = io.open_asset(tmp_path / "a.ply")
    assert file.num_gaussians == len(ASSET)
    np.testing.assert_array_equal(file.read(2, 5).means, ASSET.means[2:5])
    assert len(file.read(4, 4)) == 0


@pytest.mark.parametrize(
    ("names", "last"),
    [
        ([], []),
        (["ckpts/other.pt", "point_cloud/point_cloud.ply"], []),
        (["ckpts/ckpt_99.pt", "ckpts/ckpt_100.pt"], ["ckpts/ckpt_100.pt"]),
        (
            ["ckpts/ckpt_7_rank1.pt", "ckpts/ckpt_7_rank0.pt", "ckpts/ckpt_6_rank0.pt"],
            ["ckpts/ckpt_7_rank0.pt", "ckpts/ckpt_7_rank1.pt"],
        ),
        (
            ["nerfstudio_models/step-000009.ckpt", "nerfstudio_models/step-000010.ckpt"],
            ["nerfstudio_models/step-000010.ckpt"],
        ),
        (
            [
                "point_cloud/iteration_7000/point_cloud.ply",
                "point_cloud/iteration_30000/point_cloud.ply",
            ],
            ["point_cloud/iteration_30000/point_cloud.ply"],
        ),
    ],
)
def test_a_run_is_what_it_came_to_last(names, last, tmp_path):
    touch(tmp_path, *names)
    assert io.run_files(tmp_path) == [tmp_path / Path(name) for name in last]
