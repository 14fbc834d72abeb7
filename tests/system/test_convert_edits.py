"""`v3dg convert` with edits: what is written, and what is reported about it."""

import json

import numpy as np
import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from command_line import fails, run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an asset of SH degree 1 with an outlier, and a bundle of the
    rest."""
    folder = tmp_path_factory.mktemp("edits")
    asset = make_asset(2000)
    far = asset.subset([0]).transform(position=(500, 0, 0))
    v3dg.write_asset(folder / "tuft.ply", v3dg.join([asset, far]))
    config = v3dg.BuildConfig(cluster_size=64, steps=0)
    v3dg.build_bundle(asset, config=config, progress=False).write(folder / "tuft.v3dg")
    return folder


def converted(folder, *arguments):
    done = run("convert", *arguments, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), v3dg.read_asset(folder / arguments[1])


def test_edits_are_those_of_python_in_the_stated_order(folder):
    result, gaussians = converted(
        folder, "tuft.ply", "a.ply",
        "--drop-outliers", "--crop", "box:-1,-inf,-1,0.5,inf,1",
        "--delete", "sphere:0,0,0.5,0.2", "--min-opacity", "0.3", "--degree", "0",
    )  # fmt: skip
    whole = v3dg.read_asset(folder / "tuft.ply")
    near = v3dg.drop_outliers(whole)
    boxed = v3dg.crop_box(near, (-1, -np.inf, -1), (0.5, np.inf, 1))
    hollow = v3dg.crop_sphere(boxed, (0, 0, 0.5), 0.2, keep="outside")
    opaque = v3dg.drop_transparent(hollow, 0.3)
    np.testing.assert_array_equal(gaussians.means, opaque.means)
    assert gaussians.sh_degree == 0
    counts = [len(part) for part in (whole, near, boxed, hollow, opaque)]
    assert list(result["left_out"].values()) == (-np.diff(counts)).tolist()
    assert min(result["left_out"].values()) > 0


def test_the_text_says_how_many_were_left_out_and_why(folder):
    done = run("convert", "tuft.ply", "a.ply", "--drop-outliers", "--degree", "0", cwd=folder)
    assert "left out 1 of 2,001 gaussians: 1 outliers" in done.stdout
    assert "SH reduced from degree 1 to 0" in done.stdout
    done = run("convert", "tuft.ply", "b.ply", "--degree", "3", cwd=folder)
    assert "SH extended from degree 1 to 3 with zeros" in done.stdout
    extended = v3dg.read_asset(folder / "b.ply").sh
    np.testing.assert_array_equal(extended[:, :4], v3dg.read_asset(folder / "tuft.ply").sh)
    assert extended.shape[1] == 16
    assert not extended[:, 4:].any()


def test_files_are_placed_and_joined(folder):
    result, gaussians = converted(
        folder, "tuft.v3dg", "a.ply",
        "--add", "tuft.v3dg@10,0,0", "--add", "tuft.v3dg@0,20,0,0.5,0,0,90",
        "--add", "tuft.v3dg", "--degree", "1",
    )  # fmt: skip
    assert result["added"] == 3
    first = v3dg.Bundle.open(folder / "tuft.v3dg").level_gaussians(0)
    num = len(first)
    second = gaussians.subset(slice(num, 2 * num))
    third = gaussians.subset(slice(2 * num, 3 * num))
    fourth = gaussians.subset(slice(3 * num, None))
    np.testing.assert_allclose(second.means, first.means + np.array([10, 0, 0]), atol=1e-5)
    x, y, z = first.means.T
    turned = np.stack([-y / 2, x / 2 + 20, z / 2], axis=1)
    np.testing.assert_allclose(third.means, turned, atol=1e-5)
    np.testing.assert_array_equal(fourth.means, first.means)


def test_a_file_with_an_at_sign_in_its_name_is_added_as_it_is(folder):
    (folder / "b@1,2,3.ply").write_bytes((folder / "tuft.ply").read_bytes())
    result, gaussians = converted(folder, "tuft.ply", "a.ply", "--add", "b@1,2,3.ply")
    np.testing.assert_array_equal(gaussians.means[2001:], gaussians.means[:2001])
    assert result["gaussians"] == 4002


def test_a_crop_applies_after_the_placement(folder):
    _, gaussians = converted(
        folder, "tuft.v3dg", "a.ply", "--add", "tuft.v3dg@10,0,0", "--crop", "sphere:10,0,0,4"
    )
    first = v3dg.Bundle.open(folder / "tuft.v3dg").level_gaussians(0)
    np.testing.assert_allclose(gaussians.means, first.means + np.array([10, 0, 0]), atol=1e-5)


def test_edits_apply_to_a_level_and_to_a_cut(folder):
    _, level = converted(folder, "tuft.v3dg", "a.ply", "--level", 2, "--crop", "sphere:0,0,0,0.5")
    bundle = v3dg.Bundle.open(folder / "tuft.v3dg")
    wanted = v3dg.crop_sphere(bundle.level_gaussians(2), (0, 0, 0), 0.5)
    np.testing.assert_array_equal(level.means, wanted.means)
    _, cut = converted(folder, "tuft.v3dg", "a.ply", "--budget", 500)
    _, sparse = converted(folder, "tuft.v3dg", "a.ply", "--budget", 500, "--min-opacity", "0.5")
    assert len(sparse) == (cut.opacities >= 0.5).sum() < len(cut)


@pytest.mark.parametrize(
    ("code", "message", "options"),
    [
        (2, "--crop: expected box:X0,Y0,Z0,X1,Y1,Z1 or sphere", ["--crop", "1,2,3"]),
        (2, "--crop: expected box:", ["--crop", "box:1,2,3,4,5"]),
        (2, "--crop: expected box:", ["--crop", "box:0,0,nan,1,1,1"]),
        (2, "--crop: expected the smaller value of each", ["--crop", "box:1,0,0,0,1,1"]),
        (2, "--delete: expected a finite centre", ["--delete", "sphere:0,0,0,-1"]),
        (2, "--min-opacity: expected a number from 0 to 1, got 2", ["--min-opacity", "2"]),
        (2, "--degree: expected one of 0, 1, 2, 3", ["--degree", "4"]),
        (2, "--add: expected FILE@X,Y,Z", ["--add", "tuft.ply@1,2"]),
        (2, "--add: expected a finite position and a positive", ["--add", "tuft.ply@1,2,3,0"]),
        (1, "no.ply: expected a file", ["--add", "no.ply@1,2,3"]),
        (1, "--crop: nothing remains of 2,001 gaussians", ["--crop", "sphere:0,0,99,1"]),
    ],
)
def test_wrong_edits_are_named_and_nothing_is_written(folder, code, message, options):
    fails(code, message, "convert", "tuft.ply", "wrong.ply", *options, cwd=folder)
    assert not (folder / "wrong.ply").exists()


def test_a_bundle_is_not_edited_and_no_input_is_overwritten(folder):
    fails(
        2, "without options that select or change a part",
        "convert", "tuft.v3dg", "x.v3dg", "--degree", "0", cwd=folder,
    )  # fmt: skip
    fails(
        2, "expected an output that is not the input tuft.ply",
        "convert", "tuft.v3dg", "tuft.ply", "--add", "tuft.ply@1,2,3", cwd=folder,
    )  # fmt: skip
