"""Every format keeps the up axis: assets are rotated to the axes of the format and
back."""

import gzip
import itertools
import json
import os
import struct

import numpy as np
import pytest

import v3dg
from half_turns import half_turn
from reference.sh import basis
from test_ply import random_gaussians
from v3dg import Gaussians, read_asset, write_asset
from v3dg.cameras import AXES
from v3dg.donut import make_donut
from v3dg.formats import _axes
from v3dg.io import open_asset
from v3dg.rotations import normalised, rotation_from_quaternion
from v3dg.upright import direction_of, up_of

LETTERS = ("LR", "UD", "BF")
# Values of the extension SPZ_ADOBE_coordinate_system in version 4 of Niantic's library.
RECORDS = [
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
]
ALL_AXES = [
    "".join(letters)
    for order in itertools.permutations(LETTERS)
    for letters in itertools.product(*order)
]


@pytest.fixture
def asset():
    return random_gaussians(200, 3)


def covariances(gaussians):
    half = rotation_from_quaternion(normalised(gaussians.quats)) * gaussians.scales[:, None]
    return half @ half.transpose(0, 2, 1)


def colors(gaussians, directions):
    """Return (N, 3) the colour of each gaussian in its own direction, without clamping
    at 0."""
    return np.einsum("nk,nkc->nc", basis(directions, gaussians.sh_degree), gaussians.sh)


@pytest.mark.parametrize("axes", ALL_AXES)
def test_all_axes_are_turned_to_and_mirrored(asset, axes):
    found = _axes.turned(asset, _axes.MEMORY, axes)
    matrix = _axes.turn(_axes.MEMORY, axes)
    np.testing.assert_allclose(found.means, asset.means @ matrix.T, atol=1e-5)
    wanted = matrix @ covariances(asset) @ matrix.T
    np.testing.assert_allclose(covariances(found), wanted, atol=1e-4 * np.abs(wanted).max())
    directions = np.random.default_rng(0).normal(size=(len(asset), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(
        colors(found, directions @ matrix.T), colors(asset, directions), atol=1e-5
    )
    back = _axes.turned(found, axes, _axes.MEMORY)
    np.testing.assert_allclose(back.sh, asset.sh, atol=1e-5)


# Half a turn, a reflection, and a quarter of a turn.
@pytest.mark.parametrize("axes", ["RUB", "LDF", "RFU"])
@pytest.mark.parametrize("antialiased", [True, False, None])
def test_turns_keep_antialiasing(asset, axes, antialiased):
    marked = asset.trained(antialiased=antialiased)
    assert _axes.turned(marked, _axes.MEMORY, axes).antialiased is antialiased


@pytest.mark.parametrize("axis", "xyz")
def test_half_turns_are_exact_and_those_of_the_core(asset, axis):
    axes = {"x": "RUB", "y": "LDB", "z": "LUF"}[axis]
    found = _axes.turned(asset, _axes.MEMORY, axes)
    wanted = half_turn(asset, axis)
    for name, values in vars(found).items():
        np.testing.assert_array_equal(np.abs(values), np.abs(getattr(asset, name)))
        np.testing.assert_allclose(values, getattr(wanted, name), atol=1e-6)


@pytest.mark.parametrize("up", AXES)
def test_what_is_up_is_up_in_axes_of_that_name(up):
    axes = _axes.axes_of_up(up)
    assert _axes.up_of_axes(axes) == up
    matrix = _axes.turn(axes, _axes.MEMORY)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_array_equal(matrix @ direction_of(up), direction_of("-y"))


@pytest.mark.parametrize("up", AXES)
@pytest.mark.parametrize("suffix", [".glb", ".spz", ".usda"])
def test_what_is_up_stands_up_in_files_that_have_axes(tmp_path, asset, suffix, up):
    """In the stored positions, +y is up, whatever was up before."""
    if suffix == ".usda":
        pytest.importorskip("pxr")
    path = tmp_path / f"a{suffix}"
    write_asset(path, asset, up=up)
    heights = stored_means(path)[:, 1]
    np.testing.assert_allclose(heights, asset.means @ direction_of(up), atol=2e-3)
    found = read_asset(path)
    assert up_of(found)[0] == "-y"
    np.testing.assert_allclose(-found.means[:, 1], heights, atol=2e-3)


@pytest.mark.parametrize("up", ["-y", "z"])
@pytest.mark.parametrize("suffix", [".ply", ".sog", ".compressed.ply"])
def test_files_without_axes_keep_the_numbers(tmp_path, asset, suffix, up):
    write_asset(tmp_path / f"a{suffix}", asset, up=up)
    found = read_asset(tmp_path / f"a{suffix}")
    for axis in range(3):
        np.testing.assert_allclose(
            np.sort(found.means[:, axis]), np.sort(asset.means[:, axis]), atol=0.05
        )


def test_another_name_for_up_is_refused(tmp_path, asset):
    with pytest.raises(ValueError, match=r"up: expected .*'-z', got 'up'"):
        write_asset(tmp_path / "a.ply", asset, up="up")


def stored_means(path):
    """Return the positions as they are stored in a file, before any axes are
    changed."""
    if path.suffix == ".usda":
        from pxr import Usd

        stage = Usd.Stage.Open(os.fspath(path))
        return np.array(stage.GetPrimAtPath("/gaussians").GetAttribute("positions").Get())
    content = path.read_bytes()
    if path.suffix == ".glb":
        size = int.from_bytes(content[12:16], "little")
        document = json.loads(content[20 : 20 + size])
        count = document["accessors"][0]["count"]
        return np.frombuffer(content, "<f4", 3 * count, 28 + size).reshape(-1, 3)
    content = gzip.decompress(content)
    count, bits = int.from_bytes(content[8:12], "little"), content[13]
    three = np.frombuffer(content, "u1", 9 * count, 16).reshape(-1, 3).astype(np.int32)
    fixed = three[:, 0] | three[:, 1] << 8 | three[:, 2] << 16
    return (((fixed ^ 0x800000) - 0x800000) / 2.0**bits).reshape(-1, 3)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_spz_records_its_axes(tmp_path, asset, version):
    write_asset(tmp_path / "a.spz", asset, version=version)
    content = (tmp_path / "a.spz").read_bytes()
    if version < 4:
        content = gzip.decompress(content)
    assert content[14] == 2
    assert struct.pack("<III", 0xADBE0003, 4, 4) in content
    declared = open_asset(tmp_path / "a.spz").declared
    assert (declared.up, declared.up_reason) == ("-y", "as its record of axes says (RUB)")


@pytest.mark.parametrize(("number", "axes"), list(enumerate(RECORDS, 1)))
def test_spz_is_turned_from_the_axes_of_its_record(tmp_path, asset, number, axes):
    write_asset(tmp_path / "a.spz", asset)
    as_stored = half_turn(read_asset(tmp_path / "a.spz"), "x")
    content = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    content[-4:] = struct.pack("<I", number)
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(content)))
    found = read_asset(tmp_path / "b.spz")
    up = as_stored.means @ direction_of(_axes.up_of_axes(axes))
    np.testing.assert_allclose(-found.means[:, 1], up, atol=1e-6)
    assert open_asset(tmp_path / "b.spz").declared.up_reason.endswith(f"({axes})")


def test_spz_with_an_unknown_number_of_axes_is_refused(tmp_path, asset):
    write_asset(tmp_path / "a.spz", asset)
    content = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    content[-4:] = struct.pack("<I", 17)
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(content)))
    with pytest.raises(ValueError, match=r"a\.spz: expected an axes record .*, got 11 00 00 00"):
        open_asset(tmp_path / "a.spz")


def outdoors(rng, count=3000, ground=0.4):
    """Return the means (N, 3) of a wide ground at height 0 with things above it; z is
    up."""
    num_ground = int(ground * count)
    plane = rng.uniform(-10, 10, (num_ground, 2))
    things = rng.normal(0, 3, (count - num_ground, 2))
    heights = np.concatenate(
        [rng.normal(0, 0.03, num_ground), rng.exponential(1.5, count - num_ground)]
    )
    return np.concatenate([np.concatenate([plane, things]), heights[:, None]], axis=1)


def standing(means):
    """Return an asset at these positions."""
    blobs = random_gaussians(len(means), 1)
    return Gaussians(
        np.ascontiguousarray(means, np.float32),
        blobs.quats,
        blobs.scales,
        blobs.opacities,
        blobs.sh,
    )


def write_without_record(path, asset):
    """Write a `.spz` file like most programs: positions as they are in memory, without
    a record of the axes."""
    write_asset(path, half_turn(asset, "x"))
    content = bytearray(gzip.decompress(path.read_bytes()))[:-12]
    content[14] = 0
    path.write_bytes(gzip.compress(bytes(content)))


@pytest.mark.parametrize(
    ("columns", "signs", "stored", "how"),
    [
        ([0, 2, 1], (1, 1, -1), "RUB", "which shows that y is up in the file"),
        ([0, 2, 1], (1, -1, 1), "RDF", "which shows that -y is up in the file"),
        ([0, 1, 2], (1, 1, 1), "RFU", "which shows that z is up in the file"),
    ],
)
def test_a_ground_shows_the_axes_of_spz_without_a_record(tmp_path, columns, signs, stored, how):
    asset = standing(outdoors(np.random.default_rng(0))[:, columns] * signs)
    write_without_record(tmp_path / "a.spz", asset)
    declared = open_asset(tmp_path / "a.spz").declared
    assert declared.up == "-y"
    assert declared.up_reason == f"guessed from its ground, {how}"
    wanted = _axes.turned(asset, stored, _axes.MEMORY)
    np.testing.assert_allclose(read_asset(tmp_path / "a.spz").means, wanted.means, atol=1e-3)
    heights = -wanted.means[:, 1]
    assert heights.min() > -0.2, "the ground is below"
    assert heights.max() > 2


def test_spz_without_a_ground_has_the_axes_of_its_specification(tmp_path, asset):
    write_without_record(tmp_path / "a.spz", asset)
    assert open_asset(tmp_path / "a.spz").declared.up_reason == "as specified for .spz, with y up"
    np.testing.assert_allclose(
        read_asset(tmp_path / "a.spz").means, half_turn(asset, "x").means, atol=1e-3
    )


@pytest.mark.parametrize("seed", range(6))
def test_no_ground_is_seen_where_there_is_none(seed):
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(2000, 3))
    donut = make_donut(3000, seed=seed).means
    for points in (ball, ball * (3, 2, 0.4), ball * (3, 0.4, 2), donut, donut[:, [0, 2, 1]]):
        assert _axes.up_of_ground(points) is None
    assert _axes.up_of_ground(np.full((1000, 3), np.nan)) is None
    assert _axes.up_of_ground(np.zeros((1000, 3))) is None


def test_usd_is_turned_from_the_axis_of_its_stage(tmp_path, asset):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    write_asset(tmp_path / "a.usda", asset)
    raw = stored_means(tmp_path / "a.usda")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usda"))
    for letter, columns, signs in (("Y", [0, 1, 2], (1, -1, -1)), ("Z", [0, 2, 1], (1, -1, 1))):
        UsdGeom.SetStageUpAxis(stage, letter)
        stage.GetRootLayer().Save()
        found = read_asset(tmp_path / "a.usda")
        np.testing.assert_allclose(found.means, raw[:, columns] * signs, atol=1e-6)
        reason = f"as its stage says ({letter} is up in the file)"
        assert up_of(found) == ("-y", reason)
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "b.usda").write_text(text.replace('upAxis = "Z"', ""))
    assert up_of(read_asset(tmp_path / "b.usda"))[1] == "as in OpenUSD (Y is up in the file)"
    (tmp_path / "b.usda").write_text(text.replace('upAxis = "Z"', 'upAxis = "X"'))
    with pytest.raises(
        ValueError, match=r"b\.usda: .* got the up axis 'X'; only Y and Z can be read"
    ):
        read_asset(tmp_path / "b.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.GetRootLayer().Save()
    with pytest.warns(v3dg.cleaning.AssetWarning, match=r"a\.usda: Its unit is 0\.01 m"):
        read_asset(tmp_path / "a.usda")


@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
def test_ply_of_nerfstudio_says_what_is_up(tmp_path, asset, ending):
    write_asset(tmp_path / "a.ply", asset)
    content = (tmp_path / "a.ply").read_bytes()
    head, _, rows = content.partition(b"end_header\n")
    lines = head.split(b"\n")
    lines.insert(2, b"comment Vertical Axis: z")
    (tmp_path / "a.ply").write_bytes(ending.join(lines) + b"end_header" + ending + rows)
    found = read_asset(tmp_path / "a.ply")
    assert up_of(found) == ("z", "as its header says")
    np.testing.assert_array_equal(found.means, asset.means)
    lines[2] = b"comment Vertical Axis: w"
    (tmp_path / "a.ply").write_bytes(b"\n".join(lines) + b"end_header\n" + rows)
    with pytest.warns(v3dg.cleaning.AssetWarning, match="unknown vertical axis, 'w'"):
        read_asset(tmp_path / "a.ply")
