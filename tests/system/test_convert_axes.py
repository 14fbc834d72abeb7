"""`v3dg convert` rotates and moves assets, and reports what was rotated, lost and left
out."""

import json

import numpy as np
import pytest

import v3dg
from command_line import fails, run
from test_axes import outdoors, standing, write_without_record
from test_ply import random_gaussians
from v3dg.formats import _axes
from v3dg.upright import direction_of, up_of

UNFITTED = v3dg.BuildConfig(steps=0)


@pytest.fixture(scope="module")
def asset():
    """An asset with a ground, in which z is up."""
    return standing(outdoors(np.random.default_rng(3), 2000))


@pytest.fixture
def folder(tmp_path, asset):
    v3dg.write_asset(tmp_path / "town.ply", asset)
    return tmp_path


def convert(folder, *arguments):
    done = run("convert", *arguments, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert done.stderr.splitlines() == result["notes"]
    return result, v3dg.read_asset(folder / arguments[1])


def heights(asset, up):
    return asset.means @ np.array(direction_of(up))


@pytest.mark.parametrize("suffix", [".glb", ".spz"])
def test_an_asset_is_turned_from_what_its_plane_shows(folder, asset, suffix):
    result, found = convert(folder, "town.ply", f"town{suffix}")
    assert (result["up"], up_of(found)[0]) == ("z", "-y")
    np.testing.assert_allclose(heights(found, "-y"), heights(asset, "z"), atol=1e-3)
    assert result["notes"][0] == (
        "town.ply: z is up, guessed from the plane of its gaussians; "
        f"town{suffix} is rotated so that y is up; change it with --up"
    )


def test_a_file_without_axes_keeps_the_numbers_and_that_is_said(folder, asset):
    result, found = convert(folder, "town.ply", "same.ply")
    np.testing.assert_array_equal(found.means, asset.means)
    assert result["notes"] == [
        "town.ply: z is up, guessed from the plane of its gaussians; same.ply keeps it, "
        "while most viewers assume -y; --up z rotates it"
    ]


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_up_overrides_what_is_found(folder, asset, suffix):
    result, found = convert(folder, "town.ply", f"turned{suffix}", "--up", "x")
    assert result["up_reason"] == "rotated from x, as requested by --up"
    np.testing.assert_allclose(heights(found, "-y"), heights(asset, "x"), atol=1e-5)


@pytest.mark.parametrize("arguments", [(), ("--tolerance", 0, "--outside", "keep")])
def test_bundles_of_another_up_stand_upright_in_files_that_have_axes(folder, asset, arguments):
    v3dg.write_asset(folder / "tilted.ply", v3dg.read_asset(folder / "town.ply"))
    made = run("build", "tilted.ply", "--up", "x", "--device", "cpu", "--quiet", cwd=folder)
    assert made.returncode == 0, made.stderr
    result, found = convert(folder, "tilted.v3dg", "tilted.glb", *arguments)
    assert (result["up"], result["up_reason"]) == ("x", "as its file says")
    low, high = np.percentile(heights(found, "-y"), (5, 95))
    np.testing.assert_allclose((low, high), np.percentile(asset.means[:, 0], (5, 95)), atol=1.5)
    assert abs(found.means[:, 1]).max() > 8, "what was across is up now"


def test_spz_of_other_programs_says_what_it_was_taken_for(folder, asset):
    upright = _axes.turned(asset, "RFU", "RDF")
    write_without_record(folder / "theirs.spz", upright)
    result, found = convert(folder, "theirs.spz", "theirs.ply")
    np.testing.assert_allclose(found.means, upright.means, atol=1e-3)
    reason = "guessed from its ground, which shows that -y is up in the file"
    assert result["notes"] == [f"theirs.spz: -y is up, {reason}"]
    told = run("info", "theirs.spz", cwd=folder)
    assert told.stdout.splitlines()[1] == f"-y is up, {reason}"
    told = json.loads(run("info", "theirs.spz", "--json", cwd=folder).stdout)
    assert (told["up"], told["up_reason"], told["notes"]) == ("-y", reason, [])
    made = run("build", "theirs.spz", "--device", "cpu", "--quiet", "--json", cwd=folder)
    assert made.stderr == f"theirs.spz: -y is up, {reason}\n"
    assert json.loads(made.stdout)["notes"] == [f"theirs.spz: -y is up, {reason}"]
    assert v3dg.Bundle.open(folder / "theirs.v3dg").config["up"] == "-y"


def test_moves_are_those_of_transform(folder, asset):
    turn = (np.cos(np.radians(15)), 0, 0, np.sin(np.radians(15)))
    wanted = asset.transform(turn, (-1e-3, 2, -3), 2.5)
    moves = ("--scale", 2.5, "--rotate", "z:30", "--translate", "-1e-3", 2, -3)
    _, found = convert(folder, "town.ply", "moved.ply", *moves)
    for name, values in vars(found).items():
        np.testing.assert_allclose(values, getattr(wanted, name), 1e-5, 2e-5, err_msg=name)
    text = "quaternion:" + ",".join(map(str, turn))
    _, found = convert(folder, "town.ply", "moved.ply", "--rotate", text)
    np.testing.assert_allclose(found.means, asset.transform(turn).means, atol=1e-5)


def test_a_move_to_where_float32_is_coarse_is_told(folder):
    moved = run("convert", "town.ply", "far.ply", "--translate", "4e7", "0", "0", cwd=folder)
    assert "far.ply: Positions are rounded to steps of up to 4" in moved.stderr
    made = run("build", "far.ply", "--device", "cpu", "--json", cwd=folder)
    assert "far.v3dg: Positions are rounded to steps" in made.stderr


def test_who_turns_an_asset_is_not_turned_again(folder, asset):
    """The up axis of the written asset is examined again."""
    _, found = convert(folder, "town.ply", "up.glb", "--rotate", "x:90")
    np.testing.assert_allclose(heights(found, "-y"), heights(asset, "z"), atol=1e-4)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--rotate", "90", "--rotate: expected AXIS:DEGREES such as z:90"),
        ("--rotate", "w:90", "--rotate: expected AXIS:DEGREES"),
        ("--rotate", "quaternion:0,0,0,0", "--rotate: expected AXIS:DEGREES"),
        ("--scale", 0, "--scale: expected a number above 0, got 0"),
        (
            "--drop-bad",
            "--strict",
            "--strict: expected only one of --strict and --drop-bad, got both",
        ),
    ],
)
def test_wrong_moves_are_refused(folder, option, value, message):
    fails(2, message, "convert", "town.ply", "x.ply", option, value, cwd=folder)


def test_what_a_packed_format_cuts_and_rounds_is_said(folder):
    asset = random_gaussians(300, 3)
    v3dg.write_asset(folder / "wild.ply", asset)
    result, found = convert(folder, "wild.ply", "wild.spz", "--up", "-y")
    logs = np.log(asset.scales.astype(np.float64))
    assert result["cut"]["scales"] == int(((logs < -10) | (logs > -10 + 255 / 16)).sum())
    higher = asset.sh[:, 1:]
    assert result["cut"]["harmonics"] == int(((higher < -1) | (higher > 127.5 / 128)).sum())
    size = np.ptp(asset.means, axis=0).max()
    error = np.abs(found.means - asset.means).max()
    assert 0.3 * error / size < result["largest_errors"]["positions"] < 3 * error / size
    is_held = (logs >= -10) & (logs <= -10 + 255 / 16)
    factors = (found.scales / asset.scales)[is_held]
    largest = max(factors.max(), 1 / factors.min()) - 1
    assert result["largest_errors"]["scales"] == pytest.approx(largest, rel=1e-3)
    lines = result["notes"]
    assert lines[1].startswith("wild.spz: cut to what the format holds: ")
    assert f"{result['cut']['harmonics']:,} harmonics beyond -1.00 to 1.00" in lines[1]
    assert lines[2].startswith("wild.spz: largest errors of rounding: positions ")
    result, _ = convert(folder, "wild.ply", "wild.glb", "--up", "-y")
    assert "cut" not in result


def with_faults(asset):
    """A copy of the asset with an invalid position, rotation and scale."""
    faulty = v3dg.Gaussians(*(array.copy() for array in vars(asset).values()))
    faulty.means[3] = np.nan
    faulty.quats[7] = 0
    faulty.scales[9, 1] = np.inf
    return faulty


def test_wrong_values_are_left_out_refused_or_kept_and_that_is_said(folder, asset):
    v3dg.write_asset(folder / "bad.ply", with_faults(asset))
    text = (
        "3 of 2,000 gaussians have invalid values: 1 with a position that is not finite, "
        "1 with a scale that is not finite, 1 with a rotation of length zero"
    )
    result, found = convert(folder, "bad.ply", "good.sog", "--drop-bad")
    assert len(found) == 1997
    assert result["dropped"] == {"means_not_finite": 1, "scales_not_finite": 1, "quats_zero": 1}
    assert f"bad.ply: left out: {text}" in result["notes"]
    advice = "leave them out with --drop-bad"
    fails(
        1,
        f"bad.ply: {text}; {advice} instead of --strict",
        "convert",
        "bad.ply",
        "x.ply",
        "--strict",
        cwd=folder,
    )
    fails(
        1,
        f"bad.ply: {text}, which x.glb cannot store; {advice}",
        "convert",
        "bad.ply",
        "x.glb",
        cwd=folder,
    )
    assert not (folder / "x.glb").exists()
    result, found = convert(folder, "bad.ply", "kept.ply")
    assert len(found) == 2000
    assert f"bad.ply: {text}, which kept.ply keeps; {advice}" in result["notes"]
