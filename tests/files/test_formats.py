"""Files of other programs: what other people's tools wrote and read, and what a hostile
file can do to us.

Who wrote the fixtures, and how, is in fixtures/README.md.
What all readers share is in test_malformed.py.
"""

import gzip
import json
import os
import struct
import sys
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

import v3dg
from half_turns import half_turn
from test_ply import random_gaussians
from v3dg import Gaussians, read_asset, write_asset
from v3dg.cleaning import AssetWarning
from v3dg.formats import _reading, compressed_ply
from v3dg.io import open_asset, write_measured

FIXTURES = Path(__file__).parents[1] / "fixtures"
SH_C0 = 0.28209479177387814

# If three components of a unit quaternion have the error e, these change by e. The
# fourth, which is at least a half, changes by at most 3 * e * sqrt(1/2) / (1/2).
QUAT = 3 * np.sqrt(2)


def spz_bounds(sh_bits_1=8, sh_bits_rest=8):
    return {
        "means": 0.5 * 2**-12,  # 12 bits after the binary point
        "log_scales": 0.5 / 16,  # multiples of 1/16
        # 9 bits and a sign for values up to sqrt(1/2)
        "quats": QUAT * 0.5 * np.sqrt(0.5) / 511 * 1.01,
        "opacities": 0.5 / 255,
        "color": 0.5 / 255 / 0.15,  # a byte for 1 / 0.15
        # A byte for -1 to 1. Its lower bits may be dropped: rounded to the nearest
        # value or, at the end of the range, to the last one below.
        "band 1": (0.5 * 2.0 ** (8 - sh_bits_1) + 1) / 128,
        "higher": (0.5 * 2.0 ** (8 - sh_bits_rest) + 1) / 128,
    }


def compressed_ply_bounds(reference):
    extent = np.ptp(reference.means, axis=0).max()
    color = np.ptp(reference.sh[:, 0], axis=0).max()
    return {
        # 10 bits for y and 11 for x and z, over the extent of a chunk
        "means": extent * 0.5 / 1023,
        "log_scales": np.ptp(np.log(reference.scales)) * 0.5 / 1023,
        "quats": QUAT * np.sqrt(2) * 0.5 / 1023 * 1.01,  # 10 bits for -sqrt(1/2) to sqrt(1/2)
        "opacities": 0.5 / 255,
        "color": color * 0.5 / 255,
        "band 1": 0.5 * 8 / 256,  # a byte for -4 to 4
        "higher": 0.5 * 8 / 256,
    }


def sog_bounds(reference):
    logs = np.log1p(np.abs(reference.means))
    # The 256 values are closer to each other where there are more values. No error
    # exceeds two steps of equal length.
    step = 2 / 256
    return {
        # 16 bits, truncated, of sign(x) ln(1 + |x|), whose derivative is at least 1 /
        # (1 + |x|).
        "means": np.ptp(np.sign(reference.means) * logs, axis=0).max()
        / 65535
        * (1 + np.abs(reference.means).max()),
        "log_scales": np.ptp(np.log(reference.scales)) * step,
        "quats": QUAT * np.sqrt(2) / 255 * 1.02,  # a byte, truncated, for -sqrt(1/2) to sqrt(1/2)
        "opacities": 1.001 / 255,  # truncated
        "color": np.ptp(reference.sh[:, 0]) * step,
        "band 1": np.ptp(reference.sh[:, 1:]) * step if reference.sh_degree else 0,
        "higher": np.ptp(reference.sh[:, 1:]) * step if reference.sh_degree else 0,
    }


SPLAT_BOUNDS = {
    "means": 0,
    "log_scales": 1e-6,  # the writer computes exp in float32
    "quats": QUAT / 128,  # a byte, truncated, for -1 to 1
    "opacities": 1.001 / 255,  # truncated
    "color": 1.001 / 255 / SH_C0,  # truncated, of colours between black and white
}

KSPLAT_HALF = {
    "means": 2.5 / 32767 * 0.51,  # 16 bits for a bucket with side 5
    "log_scales": 2**-10,  # half precision
    "quats": 2**-11,
    "opacities": SPLAT_BOUNDS["opacities"],
    "color": SPLAT_BOUNDS["color"],
    "band 1": 0.4 * 2**-10,
    "higher": 0.4 * 2**-10,
}

# Formats that v3dg writes. Bytes of SOG are then rounded to the nearest.
WRITTEN = {
    ".compressed.ply": compressed_ply_bounds,
    ".spz": lambda _: spz_bounds(),
    ".sog": lambda reference: (
        sog_bounds(reference) | {"opacities": 0.5 / 255, "quats": QUAT / np.sqrt(2) / 255 * 1.01}
    ),
    ".glb": lambda _: {},
}

# A file, the asset from which it was made, and its bounds; fixtures/README.md names the
# writers.
FOREIGN = {
    "sh0.compressed.ply": compressed_ply_bounds,
    "sh3.compressed.ply": compressed_ply_bounds,
    "sh0.sog": sog_bounds,
    "sh3.sog": sog_bounds,
    "sog_folder/meta.json": sog_bounds,
    "sh0_v3.spz": lambda _: spz_bounds(),
    "sh3_v3.spz": lambda _: spz_bounds(5, 4),
    "sh0_gaussforge.spz": lambda _: spz_bounds(),
    "sh0_v4.spz": lambda _: spz_bounds(),
    "sh3_v4.spz": lambda _: spz_bounds(5, 4),
    "sh3_gsply_v4.spz": lambda _: spz_bounds(),
    "sh3_adobe_v3.spz": lambda _: spz_bounds(),
    "sh3_adobe_v4.spz": lambda _: spz_bounds(),
    "sh0_gaussforge.splat": lambda _: SPLAT_BOUNDS,
    "sh3_mkkellogg_0.ksplat": lambda _: SPLAT_BOUNDS,
    "sh3_mkkellogg_1.ksplat": lambda _: KSPLAT_HALF,
    "sh3_mkkellogg_2.ksplat": lambda _: (
        KSPLAT_HALF | {"band 1": 1.001 * 3 / 255, "higher": 1.001 * 3 / 255}
    ),
    "sh0_mkkellogg_1.ksplat": lambda _: KSPLAT_HALF,
}


def reference_of(name):
    return read_asset(FIXTURES / ("sh3.ply" if "sh3" in name else "sh0.ply"))


def in_order_of(reference, gaussians):
    """Return for each gaussian of the reference the nearest gaussian, in the order of
    the reference."""
    squared = np.square(reference.means[:, None].astype(float) - gaussians.means).sum(axis=2)
    nearest = squared.argmin(axis=1)
    assert len(set(nearest)) == len(reference) == len(gaussians)
    return gaussians.subset(nearest)


def unit(quats):
    return quats / np.linalg.norm(quats.astype(float), axis=1, keepdims=True)


def largest_errors(gaussians, reference):
    found, wanted = gaussians, reference
    turned = [np.abs(unit(found.quats) - sign * unit(wanted.quats)).max(axis=1) for sign in (1, -1)]
    parts = {"color": slice(0, 1), "band 1": slice(1, 4), "higher": slice(4, 16)}
    return {
        "means": np.abs(found.means - wanted.means.astype(float)).max(initial=0),
        "log_scales": np.abs(np.log(found.scales) - np.log(wanted.scales.astype(float))).max(
            initial=0
        ),
        "quats": np.minimum(*turned).max(initial=0),
        "opacities": np.abs(found.opacities - wanted.opacities.astype(float)).max(initial=0),
        **{
            name: np.abs(found.sh[:, rows] - wanted.sh[:, rows].astype(float)).max(initial=0)
            for name, rows in parts.items()
        },
    }


def assert_within(gaussians, reference, bounds):
    assert gaussians.sh_degree == reference.sh_degree
    for name, error in largest_errors(gaussians, reference).items():
        # To this is added the rounding of float32 for values up to 8.
        assert error <= bounds.get(name, 0) + 1e-6, name


@pytest.mark.parametrize("name", FOREIGN)
def test_what_other_tools_write_is_read(name):
    reference = reference_of(name)
    # The library of the format rotates a `.ply` asset. The other programs do not, and
    # record no axes.
    if name.endswith(".spz") and "adobe" not in name:
        reference = half_turn(reference, "x")
    gaussians = in_order_of(reference, read_asset(FIXTURES / name))
    if name.endswith("splat"):
        sh = np.ascontiguousarray(reference.sh[:, : gaussians.sh.shape[1]])
        sh[:, 0] = np.clip(sh[:, 0], -0.5 / SH_C0, 0.5 / SH_C0)  # between black and white
        reference = Gaussians(
            reference.means, reference.quats, reference.scales, reference.opacities, sh
        )
    assert_within(gaussians, reference, FOREIGN[name](reference))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("suffix", WRITTEN)
def test_what_is_written_reads_back(tmp_path, suffix, degree):
    reference = read_asset(FIXTURES / "sh3.ply")
    sh = np.ascontiguousarray(reference.sh[:, : (degree + 1) ** 2])
    reference = Gaussians(
        reference.means, reference.quats, reference.scales, reference.opacities, sh
    )
    path = tmp_path / f"a{suffix}"
    write_asset(path, reference)
    assert_within(in_order_of(reference, read_asset(path)), reference, WRITTEN[suffix](reference))
    numbers = 4 * (11 + 3 * sh.shape[1]) if suffix == ".glb" else 20 + 3 * sh.shape[1]
    assert path.stat().st_size < 64 * numbers + 17_000  # tables of SOG


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("version", [2, 3, 4])
def test_every_version_of_spz_reads_back(tmp_path, version, degree):
    reference = read_asset(FIXTURES / f"sh{degree}.ply")
    write_asset(tmp_path / "a.spz", reference, version=version)
    start = (tmp_path / "a.spz").read_bytes()
    assert (gzip.decompress(start) if version < 4 else start)[4] == version
    bounds = spz_bounds() | ({"quats": 0.1} if version == 2 else {})  # where w is nearly 0
    assert_within(read_asset(tmp_path / "a.spz"), reference, bounds)
    for wrong, path in ((5, "a.spz"), (3, "a.sog")):
        with pytest.raises(ValueError, match=rf"version: expected .*, got {wrong}"):
            write_asset(tmp_path / path, reference, version=wrong)


def test_gsply_reads_version_2_of_spz(tmp_path):
    reference = read_asset(FIXTURES / "sh3.ply")
    write_asset(tmp_path / "a.spz", reference, version=2)
    theirs = gsply.read_spz(str(tmp_path / "a.spz"))
    reference = half_turn(reference, "x")  # gsply does not rotate this back
    np.testing.assert_allclose(theirs.means, reference.means, atol=2**-12)
    dot = np.abs((unit(theirs.quats) * unit(reference.quats)).sum(axis=1))
    assert dot.min() > 1 - 0.1**2 / 2  # the bound for quaternions of version 2


def test_degree_4_of_spz_is_read_up_to_degree_3(tmp_path):
    """The library of the format knows degree 4: 24 coefficients after the first."""
    content = bytearray(gzip.decompress((FIXTURES / "sh3_v3.spz").read_bytes()))
    count = int.from_bytes(content[8:12], "little")
    content[12] = 4
    first = 16 + 20 * count
    lower = np.frombuffer(content, "u1", 45 * count, first).reshape(count, 45)
    higher = np.full((count, 27), 200, "u1")
    whole = bytes(content[:first]) + np.hstack([lower, higher]).tobytes()
    (tmp_path / "a.spz").write_bytes(gzip.compress(whole))
    with pytest.warns(AssetWarning, match="above SH degree 3 were ignored"):
        found = read_asset(tmp_path / "a.spz")
    wanted = read_asset(FIXTURES / "sh3_v3.spz")
    for name, values in vars(wanted).items():
        np.testing.assert_array_equal(getattr(found, name), values, err_msg=name)


def test_rotations_of_spz_version_2_are_as_close_as_their_bytes_allow(tmp_path):
    """A search of all bytes within 3 of the components, 343 for each of 65,536 random
    rotations, leaves 6.4 degrees at most and 0.70 on average; rounding leaves 11.7 and
    1.1. What the command says is measured from the file."""
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(5000, 4))
    asset = Gaussians(
        rng.normal(size=(5000, 3)).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        np.full((5000, 3), 0.1, np.float32),
        np.full(5000, 0.5, np.float32),
        np.zeros((5000, 1, 3), np.float32),
    )
    losses = write_measured(tmp_path / "a.spz", asset, version=2)
    found = read_asset(tmp_path / "a.spz")
    cosines = np.abs((unit(found.quats) * unit(asset.quats)).sum(axis=1))
    degrees = np.degrees(2 * np.arccos(np.minimum(1, cosines)))
    assert degrees.max() < 6.6
    assert degrees.mean() < 0.76
    assert losses.rotation_error == pytest.approx(degrees.max(), rel=1e-3)
    assert f"rotations {degrees.max():.2g}°" in losses.lines[-1]
    # From another axis, rotations are read with half turns about their own axes.
    newer = write_measured(tmp_path / "b.spz", asset, up="z")
    assert newer.rotation_error < 0.25


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz"])
def test_gsply_reads_what_we_write(tmp_path, suffix, degree):
    reference = read_asset(FIXTURES / f"sh{degree}.ply")
    path = tmp_path / f"a{suffix}"
    write_asset(path, reference)
    if suffix == ".spz":
        theirs = gsply.read_spz(str(path))
        reference = half_turn(reference, "x")  # gsply does not rotate this back
    else:
        theirs = gsply.plyread(str(path))
    num = len(reference)
    sh = (
        theirs.sh0[:, None]
        if not degree
        else np.concatenate([theirs.sh0[:, None], theirs.shN], axis=1)
    )
    values = {
        "means": theirs.means,
        "quats": theirs.quats,
        "scales": np.exp(theirs.scales),
        "opacities": 1 / (1 + np.exp(-theirs.opacities.reshape(num).astype(float))),
        "sh": sh,
    }
    found = Gaussians(
        **{name: np.ascontiguousarray(array, np.float32) for name, array in values.items()}
    )
    bounds = WRITTEN[suffix](reference)
    # It changes opacities of 0 and 1 by 1e-6.
    assert_within(
        in_order_of(reference, found), reference, bounds | {"opacities": bounds["opacities"] + 1e-6}
    )


@pytest.mark.parametrize("suffix", WRITTEN)
def test_no_gaussians_and_extreme_ones_are_written(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_asset(path, random_gaussians(0, 1))
    assert len(read_asset(path)) == 0
    one = random_gaussians(1, 0)
    one.scales[:] = 0, 1e-30, 1e30
    one.opacities[:] = 1
    one.quats[:] = -1e-20, 0, 0, 0
    write_asset(path, one)
    back = read_asset(path)
    np.testing.assert_array_equal(back.opacities, one.opacities)
    np.testing.assert_allclose(np.abs(back.quats), [[1, 0, 0, 0]], atol=4e-3)
    assert np.isfinite(back.scales).all()


def test_small_and_large_assets_keep_their_shape_in_spz(tmp_path):
    for size in (1e-4, 1.0, 1e3, 4e6):
        asset = random_gaussians(100, 0)
        means = (asset.means / np.abs(asset.means).max() * size).astype(np.float32)
        write_asset(
            tmp_path / "a.spz",
            Gaussians(means, asset.quats, asset.scales, asset.opacities, asset.sh),
        )
        assert np.abs(read_asset(tmp_path / "a.spz").means - means).max() <= max(
            size * 2**-17, 2**-22
        )
    with pytest.raises(
        ValueError, match=r"means: expected coordinates within ±8388607 for \.spz, got 1e\+07"
    ):
        write_asset(
            tmp_path / "b.spz",
            Gaussians(
                means * np.float32(2.5), asset.quats, asset.scales, asset.opacities, asset.sh
            ),
        )
    assert not (tmp_path / "b.spz").exists()


@pytest.mark.parametrize("suffix", sorted(WRITTEN.keys() - {".glb"}))
def test_what_no_pixel_shows_is_not_rounded_up_to_what_one_does(tmp_path, suffix):
    asset = random_gaussians(4, 0)
    asset.opacities[:] = 0.0, 0.9 / 255, 1 / 255, 1.4 / 255
    write_asset(tmp_path / f"a{suffix}", asset)
    found = in_order_of(asset, read_asset(tmp_path / f"a{suffix}")).opacities
    np.testing.assert_allclose(found, np.array([0, 0, 1, 1]) / 255, rtol=1e-6)


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize(
    ("name", "row", "value", "message"),
    [
        ("means", (3, 1), np.nan, r"means\[3\]: expected finite values"),
        ("sh", (3, 0, 1), np.inf, r"sh\[3\]: expected finite values"),
        ("quats", 3, 0, r"quats\[3\]: expected a length above 0, got \[0\.0, 0\.0, 0\.0, 0\.0\]"),
        ("scales", (3, 1), -1, r"scales\[3\]: expected values >= 0"),
        ("opacities", 3, 1.5, r"opacities\[3\]: expected values in \[0, 1\], got 1\.5"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, suffix, name, row, value, message):
    asset = random_gaussians(10, 0)
    getattr(asset, name)[row] = value
    with pytest.raises(ValueError, match=message):
        write_asset(tmp_path / f"a{suffix}", asset)
    assert list(tmp_path.iterdir()) == []


def test_an_encoding_is_for_ply_only(tmp_path):
    with pytest.raises(
        ValueError,
        match=r"encoding: expected the default for .*a\.spz, which is not a \.ply, got 'ascii'",
    ):
        write_asset(tmp_path / "a.spz", random_gaussians(1, 0), encoding="ascii")


def test_a_compressed_ply_is_told_by_its_content(tmp_path):
    (tmp_path / "a.ply").write_bytes((FIXTURES / "sh0.compressed.ply").read_bytes())
    np.testing.assert_array_equal(
        read_asset(tmp_path / "a.ply").means, read_asset(FIXTURES / "sh0.compressed.ply").means
    )
    write_asset(tmp_path / "b.ply", random_gaussians(3, 0))
    (tmp_path / "b.ply").rename(tmp_path / "b.compressed.ply")
    assert len(read_asset(tmp_path / "b.compressed.ply")) == 3


@pytest.mark.parametrize("num_far", [0, 1, 300, 3000])
def test_a_far_background_costs_a_compressed_ply_nothing(tmp_path, num_far):
    """A chunk's range has 1,024 or 2,048 steps, so a chunk does not mix near and far
    gaussians, except for fewer than 256 of the least visible ones."""
    near = random_gaussians(3000, 1)
    near.means[:] = np.random.default_rng(1).uniform(-1, 1, near.means.shape)
    far = random_gaussians(num_far, 1)
    far.means[:] *= 1000
    far.scales[:] *= 1000
    asset = v3dg.Gaussians.concatenate([near, far])
    write_asset(tmp_path / "a.compressed.ply", asset)
    found = read_asset(tmp_path / "a.compressed.ply")
    order = compressed_ply.chunk_order(asset)
    assert sorted(order) == list(range(len(asset)))
    assert (order[:3000] < 3000).all()
    num_whole = len(near) // 256 * 256
    errors = np.abs(found.means - asset.means[order])
    assert errors[:num_whole].max() < np.ptp(near.means, axis=0).max() / 1000
    factors = found.scales[:num_whole] / asset.scales[order[:num_whole]]
    assert factors.min() > 0.97
    assert factors.max() < 1.03
    if num_far:
        area = np.prod(np.sort(near.scales.astype(float), axis=1)[:, 1:], axis=1)
        visibility = near.opacities * area
        least = visibility[order[:num_whole]].min()
        assert visibility[order[num_whole:3000]].max() <= least


def errors_of_positions(folder, asset):
    """Return the distances (N,) between positions in a compressed .ply file and those
    of the asset."""
    write_asset(folder / "a.compressed.ply", asset)
    found = read_asset(folder / "a.compressed.ply")
    order = compressed_ply.chunk_order(asset)
    return np.linalg.norm(found.means - asset.means[order].astype(np.float64), axis=1)


def test_chunks_of_a_wide_flat_scene_are_small(tmp_path):
    """Each chunk is about as wide as it is long, and no split halves the thin axis."""
    asset = random_gaussians(20_000, 0)
    rng = np.random.default_rng(1)
    asset.means[:] = rng.uniform(0, 1, asset.means.shape) * (1000, 2, 600)
    errors = errors_of_positions(tmp_path, asset)
    # The side of a chunk of 256 gaussians, divided by twice the 2,047 steps, in x and
    # in z.
    expected = np.sqrt(256 / 20_000 * 1000 * 600) / 2 / 2047
    assert np.quantile(errors, 0.98) < 2 * expected


def test_a_stray_gaussian_costs_no_more_than_a_chunk(tmp_path):
    asset = random_gaussians(20_000, 0)
    rng = np.random.default_rng(1)
    asset.means[:] = rng.uniform(-1, 1, asset.means.shape)
    asset.means[7] = (1e4, -1e4, 1e4)
    errors = errors_of_positions(tmp_path, asset)
    assert (errors > 3e-4).sum() < 256
    assert errors.max() < 1e4 / 100


def test_the_innermost_of_the_next_shell_fill_a_chunk(tmp_path):
    """The range of the chunk is then no wider than necessary."""
    near = random_gaussians(3000, 0)
    near.means[:] = np.random.default_rng(1).uniform(-1, 1, near.means.shape)
    far = random_gaussians(400, 0)
    far.means[:] = 0
    far.means[:, 0] = np.linspace(1000, 1500, 400)[::-1]
    order = compressed_ply.chunk_order(v3dg.Gaussians.concatenate([near, far]))
    shared = np.sort(order[2816:3072])
    assert set(shared[shared < 3000]) == set(range(3000)) - set(order[:2816])
    np.testing.assert_array_equal(shared[shared >= 3000], np.arange(3400 - 72, 3400))


@pytest.mark.parametrize("count", [0, 1, 300])
def test_equal_positions_are_written(tmp_path, count):
    asset = random_gaussians(count, 0)
    asset.means[:] = 1
    write_asset(tmp_path / "a.compressed.ply", asset)
    np.testing.assert_array_equal(read_asset(tmp_path / "a.compressed.ply").means, asset.means)


def test_chunks_without_colours_mean_black_to_white(tmp_path):
    """Such files were written before the ranges of colours were added."""
    content = (FIXTURES / "sh0.compressed.ply").read_bytes()
    head, body = content.split(b"end_header\n", 1)
    lines = [
        line
        for line in head.splitlines()
        if line.split()[-1] not in (b"min_r", b"min_g", b"min_b", b"max_r", b"max_g", b"max_b")
    ]
    chunks = np.frombuffer(body, "<f4", 2 * 18).reshape(2, 18)[:, :12]
    old = tmp_path / "old.compressed.ply"
    old.write_bytes(b"\n".join(lines) + b"\nend_header\n" + chunks.tobytes() + body[2 * 72 :])
    words = np.frombuffer(body, "<u4", 4 * 300, 2 * 72).reshape(300, 4)[:, 3]
    red = (words >> 24) / 255
    np.testing.assert_allclose(read_asset(old).sh[:, 0, 0], (red - 0.5) / SH_C0, atol=1e-6)


def spz_of_version(version, asset, fraction_bits=12):
    """Return a file of a version that no tool writes any more, by Niantic's
    description."""
    num = len(asset)
    positions = (
        asset.means.astype("<f2").tobytes()
        if version == 1
        else np.rint(asset.means * 2**fraction_bits)
        .astype("<i4")
        .view("u1")
        .reshape(-1, 4)[:, :3]
        .tobytes()
    )
    quats = unit(asset.quats) * np.where(asset.quats[:, :1] < 0, -1, 1)
    sections = (
        asset.opacities * 255,
        (asset.sh[:, 0] * 0.15 + 0.5) * 255,
        (np.log(asset.scales) + 10) * 16,
        (quats[:, 1:] + 1) * 127.5,
        asset.sh[:, 1:] * 128 + 128,
    )
    packed = b"".join(
        np.clip(np.rint(section), 0, 255).astype("u1").tobytes() for section in sections
    )
    header = struct.pack("<IIIBBBB", 0x5053474E, version, num, asset.sh_degree, fraction_bits, 0, 0)
    return header + positions + packed


@pytest.mark.parametrize("version", [1, 2])
def test_old_versions_of_spz_are_read(tmp_path, version):
    reference = read_asset(FIXTURES / "sh3.ply")
    (tmp_path / "a.spz").write_bytes(gzip.compress(spz_of_version(version, reference)))
    # If w is nearly 0, its error is the square root of the errors of x, y and z.
    bounds = spz_bounds() | {"quats": 0.1}
    if version == 1:
        bounds["means"] = np.abs(reference.means).max() * 2**-11  # half precision
    assert_within(read_asset(tmp_path / "a.spz"), half_turn(reference, "x"), bounds)


def spz(**changes):
    header = {
        "magic": 0x5053474E,
        "version": 3,
        "count": 2,
        "degree": 0,
        "bits": 12,
        "flags": 0,
        "reserved": 0,
    }
    return struct.pack("<IIIBBBB", *(header | changes).values()) + bytes(40)


HOSTILE_SPZ = {
    "magic": (spz(magic=1), "expected .spz, which begins with NGSP, got 01 00 00 00"),
    "version": (spz(version=5), "expected .spz of version 1 to 4, got 5"),
    "version 0": (spz(version=0), "expected .spz of version 1 to 4, got 0"),
    "version 4 in gzip": (spz(version=4), "expected version 1 to 3 in gzip, got 4"),
    "degree": (spz(degree=5), "expected SH degree 0 to 4, got 5"),
    "fraction bits": (spz(bits=25), "expected at most 24 fraction bits, got 25"),
    "too short": (
        spz()[:-1],
        "expected a gzip stream that ends after 40 bytes of gaussians, got another",
    ),
    "header only": (
        spz()[:16],
        "expected a gzip stream that ends after 40 bytes of gaussians, got another",
    ),
    "no header": (spz()[:15], "expected a header of 16 bytes, got 15"),
    "huge count": (
        spz(count=2**32 - 1),
        "at least one byte per gaussian after the first 262144, got 4294967295",
    ),
    "a long trailer": (
        spz() + bytes(2 << 20),
        "that ends after 40 bytes of gaussians, got another",
    ),
}


@pytest.mark.parametrize("case", HOSTILE_SPZ)
def test_hostile_spz_is_refused(tmp_path, case):
    content, message = HOSTILE_SPZ[case]
    (tmp_path / "a.spz").write_bytes(gzip.compress(content))
    assert_refused_cheaply(tmp_path / "a.spz", message)


def assert_refused_cheaply(path, message):
    # Modules that are imported late are imported here.
    with pytest.raises(ValueError, match=f"^{path}: "):
        read_asset(path)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=f"^{path}: ") as error:
            read_asset(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert message in str(error.value)
    assert str(error.value).isprintable()
    assert peak < 8 << 20


@pytest.mark.parametrize("content", [b"extension" * 100, struct.pack("<II8x", 0xADBE0002, 8)])
def test_extensions_after_the_gaussians_of_spz_are_told(tmp_path, content):
    (tmp_path / "a.spz").write_bytes(gzip.compress(spz(flags=2) + content))
    number = int.from_bytes(content[:4], "little")
    with pytest.warns(AssetWarning, match=rf"a\.spz: Its extension {number:#010x}, of \d+ bytes"):
        assert len(read_asset(tmp_path / "a.spz")) == 2


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (15, 5, "expected a table of 6 streams after the header, got one of 5 at offset 32"),
        (16, 31, "expected a table of 6 streams after the header, got one of 6 at offset 31"),
        (19, 255, "expected a table of 6 streams after the header, got one of 6 at offset 42"),
        (8, 65, "expected 585 bytes in stream 0, got 576"),
        (
            11,
            255,
            "at least one byte per gaussian after the first 262144, got 4278190144 gaussians",
        ),
        (32 + 7, 255, "expected 576 bytes in stream 0, got 576 (compressed"),
        (4, 3, "expected version 4 without gzip, got version 3"),
        (128, 0, "expected a zstd stream that is not damaged, got zstd decompress error"),
    ],
)
def test_hostile_spz_of_version_4_is_refused(tmp_path, place, value, message):
    content = bytearray((FIXTURES / "sh3_v4.spz").read_bytes())
    content[place] = value
    (tmp_path / "a.spz").write_bytes(content)
    assert_refused_cheaply(tmp_path / "a.spz", message)


def sog_with(tmp_path, edit=None, files=None, compression=zipfile.ZIP_STORED):
    """Return the fixture with `edit` applied to the text of its meta.json, and with
    other contents of some files."""
    path = tmp_path / "a.sog"
    with (
        zipfile.ZipFile(FIXTURES / "sh0.sog") as source,
        zipfile.ZipFile(path, "w", compression) as target,
    ):
        for name in source.namelist():
            content = source.read(name)
            if name == "meta.json" and edit:
                content = edit(content.decode()).encode()
            content = (files or {}).get(name, content)
            if content is not None:
                target.writestr(name, content)
    return path


def replaced(old, new):
    def edit(text):
        assert old in text
        return text.replace(old, new, 1)

    return edit


HOSTILE_SOG = {
    "version": (replaced('"version":2', '"version":3'), "version: expected SOG version 2, got 3"),
    "no version": (
        replaced('"version":2,', ""),
        "expected SOG version 2, got an older file; convert the file with",
    ),
    "count": (
        replaced('"count":300', '"count":-1'),
        "count: expected a number of gaussians, got -1",
    ),
    "more than the pictures hold": (
        replaced('"count":300', '"count":400'),
        "expected 400 pixels in 'means_l.webp'",
    ),
    "huge count": (
        replaced('"count":300', '"count":99999999999'),
        "count: expected a number of gaussians, got 99999999999",
    ),
    "path": (
        replaced('"means_l.webp"', '"../means_l.webp"'),
        "expected the name of a file beside meta.json",
    ),
    "parent": (replaced('"means_l.webp"', '".."'), "expected the name of a file beside meta.json"),
    "absolute path": (
        replaced('"means_l.webp"', '"/etc/passwd"'),
        "expected the name of a file beside meta.json",
    ),
    "missing file": (
        replaced('"means_l.webp"', '"other.webp"'),
        "expected 'other.webp' in the zip, got none",
    ),
    "no codebook": (
        replaced('"codebook":[', '"codebook":[[],'),
        "scales.codebook: expected 1 to 256 numbers",
    ),
    "no JSON": (lambda text: text[:-1], "expected JSON in meta.json, got Expecting"),
}


@pytest.mark.parametrize("case", HOSTILE_SOG)
def test_hostile_sog_is_refused(tmp_path, case):
    edit, message = HOSTILE_SOG[case]
    assert_refused_cheaply(sog_with(tmp_path, edit), message)


def picture(width, height, kind="WEBP", lossless=True):
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGBA", (width, height), (1, 2, 3, 252)).save(
        stream, kind, **({"lossless": lossless} if kind == "WEBP" else {})
    )
    return stream.getvalue()


def test_other_pictures_are_refused(tmp_path):
    assert_refused_cheaply(
        sog_with(tmp_path, files={"quats.webp": b"no picture"}),
        "expected a WebP picture in 'quats.webp'",
    )
    for kind in ("PNG", "TIFF"):
        path = sog_with(tmp_path, files={"quats.webp": picture(20, 20, kind)})
        assert_refused_cheaply(path, "a.sog: expected a WebP picture in 'quats.webp'")
    whole = zipfile.ZipFile(FIXTURES / "sh0.sog").read("quats.webp")
    for damaged in (whole[:-40], whole[:40], whole[:60] + bytes(200) + whole[260:]):
        path = sog_with(tmp_path, files={"quats.webp": damaged})
        assert_refused_cheaply(path, "a.sog: expected a WebP picture in 'quats.webp'")
    for lossless in (True, False):
        path = sog_with(tmp_path, files={"quats.webp": picture(20, 20, lossless=lossless)})
        assert len(read_asset(path)) == 300
    small = picture(4, 4)
    assert_refused_cheaply(
        sog_with(tmp_path, files={"quats.webp": small}), "expected 300 pixels in 'quats.webp'"
    )


def test_a_first_value_that_is_null_continues_its_codebook(tmp_path):
    """Some versions of splat-transform wrote it like this."""
    import json
    import re

    codebook = json.loads(zipfile.ZipFile(FIXTURES / "sh0.sog").read("meta.json"))["scales"][
        "codebook"
    ]
    path = sog_with(
        tmp_path, lambda text: re.sub(r'("scales":\{"codebook":\[)[^,]+', r"\1null", text, count=1)
    )
    first = codebook[1] + (codebook[1] - codebook[255]) / 255
    assert np.isclose(np.log(read_asset(path).scales.min()), first, rtol=1e-5)


def test_splat_of_another_length_is_refused(tmp_path):
    (tmp_path / "a.splat").write_bytes((FIXTURES / "sh0_gaussforge.splat").read_bytes()[:-1])
    assert_refused_cheaply(
        tmp_path / "a.splat", "expected a multiple of 32 bytes, got 9599; is the file complete?"
    )


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, 1, "expected .ksplat version 0.1 or later and compression 0 to 2, got version 1.1 and"),
        (
            20,
            3,
            "expected .ksplat version 0.1 or later and compression 0 to 2, got version 0.1 and",
        ),
        (16, 0, "expected 256 gaussians in the sections, got 300"),
        (4, 255, "expected a file with headers of 255 sections, got one of 14496 bytes"),
        (4096 + 7, 255, "expected section 0 to end within 14496 bytes"),
        (4096 + 3, 255, "expected 300 gaussians in the sections, got 4278190380"),
        (4096 + 40, 3, "expected SH degree 0 to 2, got 3"),
        (4096 + 15, 255, "expected section 0 to end within 14496 bytes"),
        (4096 + 20, 11, "buckets in section 0"),
        (4096 + 34, 255, "buckets in section 0"),
        (4096 + 3 * 1024, 99, "expected buckets for all 100 gaussians of section 0, got too few"),
    ],
)
def test_hostile_ksplat_is_refused(tmp_path, place, value, message):
    content = bytearray((FIXTURES / "sh0_mkkellogg_1.ksplat").read_bytes())
    content[place] = value
    (tmp_path / "a.ksplat").write_bytes(content)
    assert_refused_cheaply(tmp_path / "a.ksplat", message)


HOSTILE_COMPRESSED_PLY = {
    "too few chunks": (
        b"element chunk 2",
        b"element chunk 1",
        "expected 2 chunks for 300 gaussians, got 1",
    ),
    "too many rows": (
        b"element vertex 300",
        b"element vertex 301",
        "expected 301 rows of element 'vertex' with 16",
    ),
    "too few rows": (
        b"element vertex 300",
        b"element vertex 299",
        "expected a file that ends after",
    ),
    "huge count": (
        b"element vertex 300",
        b"element vertex 999999999999",
        "expected 999999999999 rows of element",
    ),
    "another type": (
        b"uint packed_rotation",
        b"float packed_rotation",
        "expected 'property uint packed_rotation'",
    ),
    "no such property": (
        b"packed_rotation",
        b"packed_rotatiom",
        "expected 'property uint packed_rotation'",
    ),
    "a property twice": (
        b"packed_rotation",
        b"packed_scale",
        "expected properties of element 'vertex' with distinct names",
    ),
    "a list": (
        b"property uint packed_r",
        b"property list uint uint packed_r",
        "expected 'property float|uint|uchar",
    ),
    "ascii": (
        b"binary_little_endian",
        b"ascii",
        "expected 'format binary_little_endian 1.0' in a compressed .ply",
    ),
}


@pytest.mark.parametrize("case", HOSTILE_COMPRESSED_PLY)
def test_hostile_compressed_ply_is_refused(tmp_path, case):
    old, new, message = HOSTILE_COMPRESSED_PLY[case]
    content = (FIXTURES / "sh0.compressed.ply").read_bytes()
    assert old in content
    if case == "too few chunks":
        content = content.replace(b"end_header\n", b"end_header\n", 1)[:-72]
    (tmp_path / "a.ply").write_bytes(content.replace(old, new, 1))
    assert_refused_cheaply(tmp_path / "a.ply", message)


def test_glb_of_splat_transform_has_the_numbers_of_its_ply():
    """It rotates assets to the axes of glTF by half a turn about z, and also the
    gaussians' own axes."""
    reference = read_asset(FIXTURES / "sh3.ply")
    own_axes_turned = np.ascontiguousarray(reference.quats[:, [3, 2, 1, 0]]) * np.float32(
        [-1, 1, -1, 1]
    )
    wanted = Gaussians(
        reference.means, own_axes_turned, reference.scales, reference.opacities, reference.sh
    )
    assert_within(read_asset(FIXTURES / "sh3.glb"), wanted, {})


def test_a_glb_says_that_its_views_are_of_vertices(tmp_path):
    """glTF-Validator requires it."""
    write_asset(tmp_path / "a.glb", read_asset(FIXTURES / "sh3.ply"))
    content = (tmp_path / "a.glb").read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert {view["target"] for view in document["bufferViews"]} == {34962}


def glb(change):
    """Return the fixture after a function changed its JSON, or another its bytes."""
    content = (FIXTURES / "sh3.glb").read_bytes()
    size = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + content[20 + size :]
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def attribute(document, name):
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    return document["accessors"][attributes[name]]


HOSTILE_GLB = {
    "no extension": (
        lambda d: d["meshes"][0]["primitives"][0].pop("extensions"),
        "expected a primitive with KHR_gaussian_splatting, got none; surfaces cannot be read",
    ),
    "no attribute": (
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("KHR_gaussian_splatting:SCALE"),
        "expected the field KHR_gaussian_splatting:SCALE",
    ),
    "a partial degree": (
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(
            "KHR_gaussian_splatting:SH_DEGREE_3_COEF_6"
        ),
        "expected the field KHR_gaussian_splatting:SH_DEGREE_3_COEF_6",
    ),
    "an accessor that is not there": (
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].update({"POSITION": 99}),
        "POSITION: expected 0 to 20, got 99",
    ),
    "another type": (
        lambda d: attribute(d, "POSITION").update(type="VEC4"),
        "type: expected VEC3, got",
    ),
    "another number": (
        lambda d: attribute(d, "KHR_gaussian_splatting:SCALE").update(count=65),
        "count: expected 64, as POSITION has, got 65",
    ),
    "too many": (
        lambda d: [accessor.update(count=1 << 40) for accessor in d["accessors"]],
        "at least one byte per gaussian after the first 262144",
    ),
    "beyond its view": (
        lambda d: [accessor.update(count=65) for accessor in d["accessors"]],
        "expected 65 elements in its buffer view, got one of 768 bytes",
    ),
    "beyond the file": (
        lambda d: d["bufferViews"][0].update(byteOffset=1 << 20),
        "bufferViews[0].byteOffset: expected 0 to",
    ),
    "logs": (
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(
            {
                "KHR_gaussian_splatting:SCALE": d["meshes"][0]["primitives"][0]["attributes"][
                    "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"
                ]
            }
        ),
        "expected scales of at least 0, got negative ones; drafts of the extension stored log",
    ),
}


@pytest.mark.parametrize("case", HOSTILE_GLB)
def test_hostile_glb_is_refused(tmp_path, case):
    change, message = HOSTILE_GLB[case]
    (tmp_path / "a.glb").write_bytes(glb(change))
    assert_refused_cheaply(tmp_path / "a.glb", message)


def test_a_glb_that_is_cut_off_is_refused(tmp_path):
    content = (FIXTURES / "sh3.glb").read_bytes()
    for size in (0, 3, 19, 400, len(content) - 1):
        (tmp_path / "a.glb").write_bytes(content[:size])
        assert_refused_cheaply(tmp_path / "a.glb", "expected a complete .glb file of glTF 2.0, got")


def hier_of(asset, half, inner=7):
    """Return a `.hier` file as its program writes it: some inner gaussians, then
    leaves, two per node."""
    kind, count = ("<f2" if half else "<f4"), inner + len(asset)

    def column(values, of=kind):
        filled = np.concatenate([np.full((inner, *values.shape[1:]), 9.0), values])
        return filled.astype(of).tobytes()

    columns = [
        column(asset.means, "<f4"),
        column(asset.quats),
        column(np.log(asset.scales)),
        column(asset.opacities),
        column(asset.sh.reshape(len(asset), 48)),
    ]
    # The first gaussian, the number of leaves, and the number of merged gaussians.
    nodes = [(i, 0, 1) for i in range(inner)]
    nodes += [(inner + i, min(2, len(asset) - i), 0) for i in range(0, len(asset), 2)]
    if half:
        records = b"".join(struct.pack("<iiihhhh", -1, s, 0, 0, 0, n, m) for s, n, m in nodes)
    else:
        records = b"".join(struct.pack("<7i", 0, -1, s, n, m, 0, 0) for s, n, m in nodes)
    boxes = bytes(len(nodes) * (16 if half else 32))
    head = struct.pack("<i", -count if half else count)
    return head + b"".join(columns) + struct.pack("<i", len(nodes)) + records + boxes


@pytest.mark.parametrize("half", [False, True])
def test_leaves_of_h3dg_are_read(tmp_path, half):
    reference = read_asset(FIXTURES / "sh3.ply")
    (tmp_path / "a.hier").write_bytes(hier_of(reference, half))
    bounds = dict.fromkeys(("log_scales", "quats", "opacities", "color", "band 1", "higher"), 0.003)
    assert_within(read_asset(tmp_path / "a.hier"), reference, bounds if half else {})
    file = v3dg.io.open_asset(tmp_path / "a.hier")
    np.testing.assert_array_equal(file.read(10, 20).means, reference.means[10:20])
    assert len(file.read(5, 5)) == 0


HOSTILE_HIER = {
    "nothing": (lambda _: b"", "expected a file of at least 4 bytes, got 0"),
    "many gaussians": (
        lambda c: struct.pack("<i", 2**31 - 1) + c[4:],
        "bytes for 2147483647 gaussians, got",
    ),
    "cut off": (lambda c: c[:1000], "bytes for 71 gaussians, got a file of 1000 bytes"),
    "many nodes": (
        lambda c: c[: 4 + 71 * 236] + struct.pack("<i", 2**31 - 1) + c[8 + 71 * 236 :],
        "71 gaussians and 2147483647 nodes, got",
    ),
    "leaves elsewhere": (
        lambda c: c[: 8 + 71 * 236 + 8] + struct.pack("<ii", 71, 1) + c[8 + 71 * 236 + 16 :],
        "expected nodes whose leaves are among the 71 gaussians, got others",
    ),
}


@pytest.mark.parametrize("case", HOSTILE_HIER)
def test_hostile_hier_is_refused(tmp_path, case):
    change, message = HOSTILE_HIER[case]
    (tmp_path / "a.hier").write_bytes(change(hier_of(read_asset(FIXTURES / "sh3.ply"), half=False)))
    assert_refused_cheaply(tmp_path / "a.hier", message)


@settings(max_examples=300)
# This file name in a zip is not UTF-8.
@example(name="sh3.sog", edits=[(230, 128)], in_header=True)
@pytest.mark.filterwarnings("ignore::v3dg.cleaning.AssetWarning")
@given(
    name=st.sampled_from(
        [
            "sh0.compressed.ply",
            "sh3.compressed.ply",
            "sh3.sog",
            "sh3_v3.spz",
            "sh3_v4.spz",
            "sh3_mkkellogg_2.ksplat",
            "sh3.glb",
        ]
    ),
    edits=st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), min_size=1, max_size=4),
    in_header=st.booleans(),
)
def test_changed_bytes_never_do_worse_than_an_error(tmp_path_factory, name, edits, in_header):
    content = bytearray((FIXTURES / name).read_bytes())
    unpacked = gzip.decompress(content) if name.endswith("v3.spz") else content
    content = bytearray(unpacked)
    for place, value in edits:
        content[place % (200 if in_header else len(content))] = value
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(
        gzip.compress(content) if unpacked is not content and name.endswith("v3.spz") else content
    )
    try:
        assert len(read_asset(path)) <= (1 << 18) + len(content)
    except ValueError as error:
        assert str(error).startswith(f"{path}")  # noqa: PT017 (either outcome is right)


def read_quietly(path):
    """Return all gaussians, without warnings."""
    file = open_asset(path)
    return file.read(0, file.num_gaussians)


def gsplat_tensors(asset):
    """Return the tensors of an asset under the names of gsplat's trainer."""
    tensors = asset.torch()
    return {
        "means": tensors.means,
        "scales": tensors.scales.log(),
        "quats": tensors.quats * 3,
        "opacities": tensors.opacities.logit(),
        "sh0": tensors.sh[:, :1],
        "shN": tensors.sh[:, 1:],
    }


def assert_same(gaussians, asset):
    for name in ("means", "sh"):
        np.testing.assert_array_equal(getattr(gaussians, name), getattr(asset, name))
    # The bound is that of the logarithm in float32.
    np.testing.assert_allclose(gaussians.scales, asset.scales, rtol=8e-7)
    np.testing.assert_allclose(gaussians.opacities, asset.opacities, atol=1e-6)
    np.testing.assert_allclose(gaussians.quats, unit(asset.quats), atol=2e-7)


@pytest.mark.parametrize("degree", [0, 3])
def test_checkpoints_of_gsplat_are_read(tmp_path, degree):
    asset = random_gaussians(50, degree)
    splats = torch.nn.ParameterDict(gsplat_tensors(asset)).state_dict()
    torch.save({"step": 29999, "splats": splats}, tmp_path / "ckpt_29999_rank0.pt")
    assert_same(read_asset(tmp_path / "ckpt_29999_rank0.pt"), asset)


@pytest.mark.parametrize("degree", [0, 3])
def test_checkpoints_of_nerfstudio_are_read(tmp_path, degree):
    asset = random_gaussians(50, degree)
    names = {"sh0": "features_dc", "shN": "features_rest"}
    tensors = {names.get(name, name): tensor for name, tensor in gsplat_tensors(asset).items()}
    tensors["features_dc"] = tensors["features_dc"][:, 0]
    tensors["opacities"] = tensors["opacities"][:, None]
    parameters = torch.nn.ParameterList([tensors["means"]])
    optimizer = torch.optim.Adam(parameters)
    parameters[0].grad = torch.ones_like(parameters[0])
    optimizer.step()
    pipeline = {f"_model.gauss_params.{name}": tensor for name, tensor in tensors.items()}
    content = {
        "step": 29999,
        "pipeline": {"_model.camera_optimizer.pose_adjustment": torch.zeros(3, 6), **pipeline},
        "optimizers": {"means": optimizer.state_dict()},
        "scalers": {},
    }
    asset = replace(asset, means=tensors["means"].numpy())
    if degree == 0:  # the model of splatfacto then stores logits of colours, see its `shs_0`
        colors = 1 / (1 + np.exp(-asset.sh.astype(np.float64)))
        asset = replace(asset, sh=((colors - 0.5) / SH_C0).astype(np.float32))
    torch.save(content, tmp_path / "step-000029999.ckpt")
    assert_same(read_quietly(tmp_path / "step-000029999.ckpt"), asset)
    notes = open_asset(tmp_path / "step-000029999.ckpt").declared.notes
    wanted = ["Training moved the cameras (camera_optimizer), so those of the data set do not"]
    if degree == 0:
        wanted.append("Colours are stored as logits without view dependence, and were read as")
    assert [note[: len(text)] for note, text in zip(notes, wanted, strict=True)] == wanted


def test_checkpoints_of_older_splatfacto_are_read(tmp_path):
    asset = random_gaussians(20, 2)
    names = {"sh0": "features_dc", "shN": "features_rest"}
    tensors = {names.get(name, name): tensor for name, tensor in gsplat_tensors(asset).items()}
    pipeline = {f"_model.{name}": tensor for name, tensor in tensors.items()}
    grids = {"_model.bil_grids.grids": torch.zeros(2), "_model.new_net.weight": torch.zeros(2)}
    torch.save({"pipeline": pipeline | grids}, tmp_path / "a.ckpt")
    assert_same(read_quietly(tmp_path / "a.ckpt"), asset)
    first, second = open_asset(tmp_path / "a.ckpt").declared.notes
    assert first.startswith("The bilateral grids of single photographs are ignored")
    assert second == "Parts of the checkpoint were ignored: 'new_net'."


def test_colours_of_a_gsplat_with_appearance_are_those_without_it(tmp_path):
    asset = random_gaussians(20, 0)
    tensors = gsplat_tensors(asset)
    logits = torch.randn(20, 3)
    splats = {name: tensors[name] for name in ("means", "scales", "quats", "opacities")}
    splats |= {"features": torch.zeros(20, 32), "colors": logits, "motion": torch.zeros(20)}
    torch.save({"splats": splats, "app_module": {"color_head": torch.zeros(3)}}, tmp_path / "a.pt")
    colors = torch.sigmoid(logits.double()).numpy()[:, None]
    wanted = replace(asset, sh=((colors - 0.5) / SH_C0).astype(np.float32))
    assert_same(read_quietly(tmp_path / "a.pt"), wanted)
    file = open_asset(tmp_path / "a.pt")
    assert file.sh_degree == 0
    appearance, tensors_left_out, as_logits = file.declared.notes
    assert appearance.startswith(
        "The appearance model of single photographs (app_module) is ignored"
    )
    assert tensors_left_out == "Tensors of splats were ignored: 'motion'."
    assert as_logits.startswith("Colours are stored as logits")


class Captured(torch.nn.Module):
    """What the code of the 3DGS paper saves; 2DGS stores two scales."""

    def __init__(self, asset, num_scales):
        super().__init__()
        tensors = gsplat_tensors(asset)
        self.parameters_of = [
            torch.nn.Parameter(
                tensors[name][..., :num_scales] if name == "scales" else tensors[name]
            )
            for name in ("means", "sh0", "shN", "scales", "quats", "opacities")
        ]

    def content(self):
        optimizer = torch.optim.Adam(self.parameters_of)
        self.parameters_of[0].grad = torch.ones_like(self.parameters_of[0])
        optimizer.step()
        statistics = [torch.zeros(2)] * 3
        extent = np.float64(3.5)
        captured = (3, *self.parameters_of, *statistics, optimizer.state_dict(), extent)
        return captured, 30000


@pytest.mark.parametrize("num_scales", [2, 3])
def test_checkpoints_of_the_papers_code_are_read(tmp_path, num_scales):
    asset = random_gaussians(20, 3)
    captured = Captured(asset, num_scales)
    torch.save(captured.content(), tmp_path / "chkpnt30000.pth")
    asset = replace(asset, means=captured.parameters_of[0].detach().numpy())
    notes = open_asset(tmp_path / "chkpnt30000.pth").declared.notes
    if num_scales == 2:
        asset.scales[:, 2] = 0
        assert notes == (
            "The gaussians are those of 2DGS; they were read as ellipsoids of no thickness.",
        )
    assert_same(read_quietly(tmp_path / "chkpnt30000.pth"), asset)
    assert (notes == ()) == (num_scales == 3)


SETTINGS = {
    "gsplat": ("cfg.yml", "antialiased: {flag}\npacked: false\n", "a.pt"),
    "nerfstudio": (
        "config.yml",
        "pipeline: !!python/object:x.Y\n  model: !!python/object:x.Z\n"
        "    rasterize_mode: {mode}\n    antialiased: maybe\n",
        "a.ckpt",
    ),
}


@pytest.mark.parametrize("place", ["", "ckpts"])
@pytest.mark.parametrize("trainer", SETTINGS)
@pytest.mark.parametrize("antialiased", [True, False])
def test_the_settings_of_a_run_say_whether_it_is_antialiased(tmp_path, trainer, antialiased, place):
    name, text, checkpoint = SETTINGS[trainer]
    mode = "antialiased" if antialiased else "classic"
    (tmp_path / name).write_text(text.format(flag=str(antialiased).lower(), mode=mode))
    (tmp_path / "ckpts").mkdir()
    file = tmp_path / place / checkpoint
    torch.save({"splats": gsplat_tensors(random_gaussians(2, 0))}, file)
    assert open_asset(file).declared.antialiased is antialiased
    (tmp_path / name).unlink()
    assert open_asset(file).declared.antialiased is None


def test_settings_are_only_read_as_far_as_they_are_plain(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"splats": gsplat_tensors(random_gaussians(2, 0))}, tmp_path / "a.pt")
    text = "a: !!python/object/apply:os.system ['touch harm']\nantialiased: true\n"
    settings = tmp_path / "cfg.yml"
    settings.write_text(text)
    assert open_asset("a.pt").declared.antialiased is True
    assert not Path("harm").exists()
    settings.write_bytes(b"antialiased: true\n" + b"#" * (1 << 20))
    declared = open_asset("a.pt").declared
    assert declared.antialiased is None
    assert declared.notes == ("cfg.yml is too large for the settings of a run and was ignored.",)
    settings.write_bytes(b"\xff\xfe\0antialiased: [true\nstrategy:\n  antialiased: true\n")
    assert open_asset("a.pt").declared.antialiased is None


def test_gaussians_of_2dgs_trained_by_gsplat_are_flat(tmp_path):
    asset = random_gaussians(20, 1)
    torch.save({"splats": gsplat_tensors(asset)}, tmp_path / "a.pt")
    (tmp_path / "cfg.yml").write_text("model_type: 2dgs\nwith_eval3d: true\n")
    asset.scales[:, 2] = 0
    assert_same(read_quietly(tmp_path / "a.pt"), asset)
    along_rays, flat = open_asset(tmp_path / "a.pt").declared.notes
    assert along_rays.startswith("Gaussians were trained to be evaluated along rays")
    assert flat.startswith("The gaussians are those of 2DGS")


class Harmful:
    def __reduce__(self):
        return (Path.touch, (Path("harm"),))


def test_a_checkpoint_executes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"splats": gsplat_tensors(random_gaussians(2, 0)), "extra": Harmful()}, "a.pt")
    assert_refused_cheaply(
        Path("a.pt"),
        "expected a checkpoint of tensors and plain values, got one that refers to",
    )
    assert not Path("harm").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"means": None},
            "expected means in the checkpoint to be a tensor of floats, got NoneType",
        ),
        (
            {"means": torch.zeros(2, 3, dtype=torch.int32)},
            "expected means in the checkpoint to be a tensor of floats",
        ),
        ({"quats": torch.zeros(2, 3)}, "expected quats of shape (2, 4), got (2, 3)"),
        ({"scales": torch.zeros(3, 3)}, "expected scales of shape (2, 3), got (3, 3)"),
        ({"shN": torch.zeros(2, 5, 3)}, "expected SH degree 0 to 3, got shN of shape (2, 5, 3)"),
    ],
)
def test_checkpoints_that_do_not_fit_are_refused(tmp_path, change, message):
    torch.save({"splats": gsplat_tensors(random_gaussians(2, 1)) | change}, tmp_path / "a.pt")
    assert_refused_cheaply(tmp_path / "a.pt", message)
    torch.save({"model": 3}, tmp_path / "a.pt")
    assert_refused_cheaply(
        tmp_path / "a.pt", "expected 'splats' (gsplat), 'pipeline' (nerfstudio) or a tuple"
    )


def test_changed_bytes_of_a_checkpoint_never_do_worse_than_an_error(tmp_path):
    """Only bytes of the zip's tables are changed, because torch may raise any error for
    the rest."""
    torch.save({"splats": gsplat_tensors(random_gaussians(2, 0))}, tmp_path / "whole.pt")
    content = (tmp_path / "whole.pt").read_bytes()
    path = tmp_path / "a.pt"
    for place in range(len(content) - 600, len(content)):
        for value in (0, 255):
            path.write_bytes(content[:place] + bytes([value]) + content[place + 1 :])
            try:
                read_asset(path)
            except ValueError as error:
                assert str(error).startswith(f"{path}: ")  # noqa: PT017 (either outcome is right)


def test_a_checkpoint_needs_no_torch(tmp_path, monkeypatch):
    torch.save({"splats": gsplat_tensors(random_gaussians(2, 0))}, tmp_path / "a.pt")
    monkeypatch.setitem(sys.modules, "torch", None)
    assert len(read_asset(tmp_path / "a.pt")) == 2


def members_of(path):
    with zipfile.ZipFile(path) as source:
        return {name: source.read(name) for name in source.namelist()}


def write_zip(path, members, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as target:
        for name, content in members.items():
            target.writestr(name, content)


@pytest.fixture
def saved(tmp_path):
    asset = random_gaussians(20, 1)
    torch.save({"splats": gsplat_tensors(asset)}, tmp_path / "a.pt")
    return tmp_path / "a.pt", asset


def test_a_checkpoint_that_was_packed_again_is_the_same(saved):
    path, asset = saved
    write_zip(path, members_of(path), zipfile.ZIP_DEFLATED)
    assert_same(read_asset(path), asset)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_checkpoints_of_other_floats_are_read(tmp_path, dtype):
    tensors = {
        name: tensor.to(dtype) for name, tensor in gsplat_tensors(random_gaussians(20, 1)).items()
    }
    torch.save({"splats": tensors}, tmp_path / "a.pt")
    found = read_asset(tmp_path / "a.pt")
    np.testing.assert_array_equal(found.means, tensors["means"].float().numpy())
    np.testing.assert_array_equal(found.sh[:, 1:], tensors["shN"].float().numpy())


def test_views_of_a_checkpoint_are_read(tmp_path):
    asset = random_gaussians(20, 1)
    tensors = gsplat_tensors(asset)
    tensors["means"] = torch.nn.Parameter(tensors["means"].T.contiguous().T)
    both = torch.cat([torch.zeros(5, 4), tensors["quats"]])
    tensors["quats"] = both[5:]
    torch.save({"splats": tensors}, tmp_path / "a.pt")
    assert_same(read_asset(tmp_path / "a.pt"), asset)


def test_a_checkpoint_without_checksums_is_read(tmp_path):
    torch.serialization.set_crc32_options(False)
    try:
        torch.save({"splats": gsplat_tensors(random_gaussians(20, 1))}, tmp_path / "a.pt")
    finally:
        torch.serialization.set_crc32_options(True)
    assert len(read_asset(tmp_path / "a.pt")) == 20


@pytest.mark.parametrize("change", ["cut", "longer", "gone", "big-endian", "a bit"])
def test_a_checkpoint_whose_numbers_are_others_is_refused(saved, change):
    path, _ = saved
    members = members_of(path)
    name = next(name for name in members if name.endswith("data/0"))
    order = name.replace("data/0", "byteorder")
    if change == "a bit":
        content = bytearray(path.read_bytes())
        content[content.index(members[name])] ^= 1
        path.write_bytes(content)
        assert_refused_cheaply(path, "expected a zip that is not damaged, got Bad CRC-32 for file")
        return
    messages = {
        "cut": "expected 240 bytes of means, got 236",
        "longer": "expected 240 bytes of means, got 244",
        "gone": f"expected {name!a} in the zip, got none",
        "big-endian": "expected little-endian numbers, got a checkpoint of another byte order",
    }
    changed = {
        "cut": members[name][:-4],
        "longer": members[name] + bytes(4),
        "gone": b"",
        "big-endian": b"big",
    }
    members[order if change == "big-endian" else name] = changed[change]
    if change == "gone":
        del members[name]
    write_zip(path, members)
    assert_refused_cheaply(path, messages[change])


@pytest.mark.parametrize("suffix", [".pt", ".sog"])
def test_a_file_that_shrinks_while_it_is_read_is_refused(tmp_path, monkeypatch, suffix):
    """The parts of these formats are read one by one. None is mapped, because that
    would end the process."""
    path, asset = tmp_path / f"a{suffix}", random_gaussians(5000, 0)
    if suffix == ".sog":
        write_asset(path, asset)
    else:
        torch.save({"splats": gsplat_tensors(asset)}, path)
    read_member = _reading.Archive.read

    def read_and_cut(archive, name):
        content = read_member(archive, name)
        os.truncate(path, 700)
        return content

    monkeypatch.setattr(_reading.Archive, "read", read_and_cut)
    with pytest.raises(ValueError, match=f"^{path}: expected a zip that is not damaged, got "):
        read_asset(path)


@pytest.mark.parametrize("bands", ["[1]", "{}", '"1"', "1.0", "true", "null", "0", "4"])
def test_bands_of_another_kind_are_refused(tmp_path, bands):
    path = sog_with(
        tmp_path,
        replaced(
            '"version":2', f'"shN":{{"bands":{bands},"count":1,"files":["a","b"]}},"version":2'
        ),
        files={},
    )
    with zipfile.ZipFile(path, "a") as target:
        target.writestr("a", b"")
        target.writestr("b", b"")
    assert_refused_cheaply(path, "shN.bands: expected 1 to 3, got ")


@pytest.mark.parametrize("gone", ["min_r", "max_b", "min_r min_g min_b", "max_r max_g max_b"])
def test_half_of_the_ranges_of_colour_is_refused(tmp_path, gone):
    content = (FIXTURES / "sh0.compressed.ply").read_bytes()
    for name in gone.split():
        content = content.replace(
            f"property float {name}\n".encode(), f"property float x{name}\n".encode()
        )
    (tmp_path / "a.ply").write_bytes(content)
    assert_refused_cheaply(
        tmp_path / "a.ply", f"expected 'property float {gone.split()[0]}' in element chunk"
    )


def test_small_sog_keeps_the_harmonics_of_every_gaussian(tmp_path):
    """Palettes with a quarter as many entries as gaussians lost 5 to 30 dB for small
    assets."""
    rng = np.random.default_rng(0)
    gaussians = random_gaussians(4000, 3)
    sh = gaussians.sh.copy()
    sh[:, 1:] = rng.normal(0, 0.1, sh[:, 1:].shape)
    asset = replace(gaussians, sh=sh)
    write_asset(tmp_path / "a.sog", asset)
    back = read_asset(tmp_path / "a.sog")
    order = np.argsort(back.means @ (1.0, 1e3, 1e6))
    expected = sh[np.argsort(asset.means @ (1.0, 1e3, 1e6)), 1:]
    errors = back.sh[order, 1:] - expected
    # Rounding of the means exchanges the places of a few neighbours.
    assert np.median(np.abs(errors)) < 2e-3
