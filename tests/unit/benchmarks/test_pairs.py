"""Tests the study of levels at equal counts and sizes, with small assets."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from benchmarks.studies import tolerances
from benchmarks.studies.pairs import measure as pairs
from benchmarks.studies.pairs import report as pairs_report
from benchmarks.studies.pairs import subject as pairs_subject
from benchmarks.worlds.procedural import make_person
from v3dg._judges import Judges
from v3dg.metrics import has_flip

pytestmark = pytest.mark.slow  # each test builds levels and compares them


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An object with levels of another tool and of its makers, and the same asset as a
    scene."""
    folder = tmp_path_factory.mktemp("pairs")
    asset = make_person(2000, seed=3)
    v3dg.write_asset(folder / "thing.ply", asset)
    v3dg.write_asset(folder / "half.ply", asset.subset(np.arange(0, 2000, 2)))
    (folder / "peers" / "thing").mkdir(parents=True)
    pairs_subject.pack_level(
        folder / "peers" / "thing" / "d_12.5.npz", asset.subset(np.arange(0, 2000, 8))
    )
    (folder / "peers" / "place").mkdir()
    pairs_subject.pack_level(
        folder / "peers" / "place" / "d_12.5.npz", asset.subset(np.arange(3, 2000, 8))
    )
    camera = v3dg.Camera.look_at(
        (3, 0, 1), asset.means.mean(axis=0), fov_x=0.5, width=120, height=60
    )
    v3dg.write_cameras(folder / "cameras.json", {"near": camera, "other": camera})
    about = {
        "thing": {
            "file": "thing.ply",
            "up": [0, 0, 1],
            "published": {"1": {"file": "half.ply", "gaussians": 1000}},
        },
        "place": {"file": "thing.ply", "cameras": "cameras.json", "views": ["near"]},
    }
    (folder / "assets.json").write_text(json.dumps(about))
    return folder


def subject(folder, name):
    about = json.loads((folder / "assets.json").read_text())
    return pairs_subject.Subject(folder, name, about[name], views=2)


def test_pictures_too_small_to_see_are_left_out(folder):
    config = pairs.Measure(folder, percents=(0.7,), factors=(0.25,), methods=("all",), device="cpu")
    assert list(pairs.Study(config)._drawn(subject(folder, "place"))) == []


def test_packed_level_is_what_was_packed(folder, tmp_path):
    asset = v3dg.read_asset(folder / "thing.ply")
    pairs_subject.pack_level(tmp_path / "packed_1.npz", asset)
    read = pairs_subject.read_level(tmp_path / "packed_1.npz")
    np.testing.assert_allclose(read.means, asset.means, rtol=2.0**-16)
    np.testing.assert_allclose(read.scales, asset.scales, rtol=5e-3)
    np.testing.assert_allclose(read.opacities, asset.opacities, atol=1e-5)
    np.testing.assert_allclose(read.sh, asset.sh, atol=np.abs(asset.sh[:, 1:]).max() / 120)
    assert np.abs((read.quats * asset.quats).sum(1)).min() > 1 - 1e-6


def test_level_is_at_home_at_two_px2_of_the_ball_a_gaussian(folder):
    thing = subject(folder, "thing")
    for factor in (1, 4):
        for size in thing.sizes(300, factor, widest=1 << 20):
            # The ball touches the borders of the picture. Its footprint is therefore
            # the inscribed disc, enlarged because the ball is near.
            half = size.camera.width / 2
            angle = math.atan(half / size.camera.fx)
            footprint = 2 * math.pi * (1 - math.cos(angle)) * size.camera.fx**2
            assert footprint == pytest.approx(2 * 300 * factor**2, rel=0.1 / factor)
            assert size.window is size.camera


def test_scene_is_drawn_at_two_px2_of_the_picture_a_gaussian(folder):
    place = subject(folder, "place")
    (size,) = place.sizes(400, 2, widest=1 << 20)
    camera = v3dg.read_cameras(folder / "cameras.json")["near"]
    in_picture = 400 * pairs_subject.places(place.asset.means, camera)[1].mean()
    assert 0 < in_picture <= 400
    assert size.camera.width * size.camera.height == pytest.approx(2 * in_picture * 4, rel=0.1)


def test_window_shows_a_part_of_the_picture(folder):
    thing = subject(folder, "thing")
    for size in thing.sizes(300, 8, widest=40):
        whole, part = (
            v3dg.rasterize(thing.asset, camera).color for camera in (size.camera, size.window)
        )
        x, y = (size.camera.K - size.window.K)[:2, 2].astype(int)
        assert part.shape[:2] == (40, 40)
        assert part.max() > 0
        np.testing.assert_allclose(part, whole[y : y + 40, x : x + 40], atol=2e-3)


@pytest.fixture(scope="module")
def merged(folder):
    return v3dg.build_bundle(
        v3dg.read_asset(folder / "thing.ply"), config=v3dg.BuildConfig(steps=0)
    )


@pytest.mark.parametrize("count", [1900, 300, 40, 6])
def test_cuts_are_around_the_count(folder, merged, count):
    (size, *_) = subject(folder, "thing").sizes(count, 1, widest=1 << 20)
    within, *finer = pairs.cuts_of("merged", merged, size.camera, count)
    assert within.gaussians <= count
    image = v3dg.render(merged, size.camera, **within.cut)
    assert image.stats.gaussians_selected == within.gaussians
    if within.gaussians < 0.97 * count:
        (finer,) = finer
        assert finer.gaussians > count
        mean = within.weight * math.log(within.gaussians) + finer.weight * math.log(finer.gaussians)
        assert mean == pytest.approx(math.log(count))


def test_budget_is_met_from_inside_of_the_asset(folder, merged):
    eye = merged.level_gaussians(0).means.mean(axis=0)
    camera = v3dg.Camera.look_at(eye, eye * [2, 1, 1] + 1, fov_x=1, width=64, height=64)
    within, *_ = pairs.cuts_of("merged", merged, camera, 20)
    assert within.cut["min_level"] > 0
    assert within.gaussians <= 20


@pytest.mark.skipif(not has_flip(), reason="FLIP is not installed")
def test_study_compares_at_equal_counts(folder, tmp_path):
    config = pairs.Measure(
        folder, tmp_path / "all", percents=(12.5,), factors=(1, 2), widest=48, views=2, device="cpu"
    )
    pairs.measure(config)
    result = json.loads((tmp_path / "all" / "pairs.json").read_text())
    rows = {(r["asset"], r["method"], r["level"], r["factor"]): r for r in result["rows"]}
    # The object has two other counts and the scene has one, with two picture sizes
    # each.
    assert len(rows) == 2 * (2 * 4 + 4)
    for (asset, method, level, factor), row in rows.items():
        assert 0 < row["flip"] < 1
        assert 0 < row["ssim"] <= 1
        assert method in ("all", "d", "published") or row["gaussians"] <= row["count"] + 1
        if method == "ours":
            assert row["psnr"] >= rows[asset, "merged", level, factor]["psnr"] - 1
    best = pairs_report.best_others(result["rows"])
    expected = {(12.5, "d"), ("published 1", "published"), ("12.5 %, d", "d")}
    assert {(r["level"], r["best"]) for r in best} == expected
    for row in best:
        others = rows[row["asset"], row["best"], row["level"], row["factor"]]
        assert row["ratio"] == row["ours_flip"] / others["flip"]
    # For the scene, only the level's gaussians inside the picture count.
    place = subject(folder, "place")
    for _, _, level in place.peers((12.5,)):
        in_picture = place.counts(level)[0]
        assert 0 < in_picture < len(level)
        for factor in (1, 2):
            assert rows["place", "d", "12.5 %, d", factor]["gaussians"] == in_picture
            assert rows["place", "ours", "12.5 %, d", factor]["gaussians"] <= in_picture
    best = [row for row in best if row["asset"] == "thing"]
    # The second run measures one method again, and one new method. All other results
    # are those of the first run.
    known = (tmp_path / "all" / "pairs.json",)
    methods = ("refined", "merged")
    again = pairs.Measure(
        folder, tmp_path / "again", methods=methods, known=known, only=("thing",), refine=2
    )
    with pytest.raises(SystemExit, match="expected results of"):
        pairs.measure(again)
    for name in ("percents", "factors", "widest", "views", "device"):
        setattr(again, name, getattr(config, name))
    pairs.measure(again)
    second = json.loads((tmp_path / "again" / "pairs.json").read_text())
    refined = [row for row in second["rows"] if row["method"] == "refined"]
    assert {(row["level"], row["factor"]) for row in refined} == {
        (row["level"], row["factor"]) for row in result["rows"] if row["asset"] == "thing"
    }
    others = [row for row in second["rows"] if row["method"] != "refined"]
    assert second["changes"] == {"refine": 2}
    assert sorted(map(str, others)) == sorted(map(str, result["rows"]))
    assert second["builds"]["thing"].keys() == {"ours_seconds", "merged_seconds", "refined_seconds"}
    pairs_report.report(
        pairs_report.Report(tmp_path / "again" / "pairs.json", tmp_path / "pairs.md")
    )
    text = (tmp_path / "pairs.md").read_text()
    of_refined = pairs_report.best_others(second["rows"], "refined")
    assert len(of_refined) == len(best)
    third = replace(again, output=tmp_path / "third", methods=("merged",), refine=0)
    third.known = (tmp_path / "again" / "pairs.json",)
    pairs.measure(third)
    assert json.loads((tmp_path / "third" / "pairs.json").read_text())["changes"] == {"refine": 2}
    with pytest.raises(SystemExit, match="expected levels of"):
        pairs.measure(replace(third, refine=3))
    for row in (best[0], of_refined[0]):
        assert f"{row['ours_flip']:.4f} / {row['best_flip']:.4f} = {row['ratio']:.2f}" in text
    assert "Refined in 2 steps" in text


@pytest.mark.skipif(not has_flip(), reason="FLIP is not installed")
def test_build_settings_reach_our_levels_and_the_record(folder, tmp_path):
    build = v3dg.BuildConfig(steps=2, num_views=2, px2_per_gaussian=1.0)
    pairs.measure(
        pairs.Measure(
            folder,
            output=tmp_path,
            only=("thing",),
            methods=("ours",),
            percents=(25.0,),
            factors=(2.0,),
            views=1,
            device="cpu",
            build=build,
        )
    )
    found = json.loads((tmp_path / "pairs.json").read_text())
    assert found["changes"] == {"steps": 2, "num_views": 2, "px2_per_gaussian": 1.0}


def test_tolerances_compare_a_cut_with_all_gaussians():
    def row(asset, tolerance, flip, psnr):
        return {
            "asset": asset,
            "width": 64,
            "tolerance": tolerance,
            "flip": flip,
            "psnr": psnr,
            "share": 0.5,
        }

    rows = [row("a", 0.0, 0.1, 30.0), row("a", 3.0, 0.05, 31.0)]
    rows += [row("b", 0.0, 0.1, 30.0), row("b", 3.0, 0.2, 28.0)]
    line = tolerances.summary(rows).splitlines()[-1]
    assert [cell.strip() for cell in line.strip("|").split("|")] == [
        *("3", "1.000", "50%", "2.00", "b, 64 px", "-0.50", "0.1250", "50%")
    ]


@pytest.mark.skipif(not has_flip(), reason="FLIP is not installed")
def test_tolerance_zero_is_every_gaussian(folder):
    config = tolerances.Config(folder, tolerances=(1e9,), widths=(32,), views=1, device="cpu")
    judges = Judges()
    try:
        whole, coarsest = tolerances.measure(config, subject(folder, "thing"), judges)
    finally:
        judges.close()
    assert (whole["tolerance"], whole["share"]) == (0.0, 1.0)
    assert coarsest["share"] < 0.1
