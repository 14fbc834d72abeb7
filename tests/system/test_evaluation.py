"""The evaluation: its baselines, its measures, a small run, and the web page of its
results."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from benchmarks import evaluation
from benchmarks.__main__ import PROGRAM
from benchmarks.evaluation import measure, report, steadiness
from benchmarks.evaluation.assets import hair_lines, like_trained, many_copies, sky_dome
from benchmarks.evaluation.hierarchy import HierarchyScene, build_hierarchy
from benchmarks.evaluation.parts import motion
from benchmarks.studies.fades import scenes as fades_scenes
from benchmarks.studies.fades.measure import Stays
from benchmarks.worlds.procedural import make_asset
from reference.project import project
from v3dg.cameras import Camera
from v3dg.levels import BuildConfig, build_bundle

TINY = replace(
    evaluation.PRESETS["small"],
    asset_gaussians=1500,
    instances=7,
    worlds={"forest": (3, 4000)},
    world_steps=2,
    size=(64, 36),
    distances=2,
    sweep_distances=2,
    repeats=1,
    composed_repeats=1,
    steps=(0, 2),
    tree_steps=2,
    large_copies=2,
    large_steps=2,
    motion_frames=3,
    hierarchy_instances=3,
    hard_gaussians=2000,
    counts=(2000,),
    close_views=1,
    close_px=48,
    panel=32,
)


def eye_camera(distance: float) -> Camera:
    return Camera.look_at((0, -distance, 0.6 * distance), (0, 0, 0), width=96, height=64)


@pytest.fixture(scope="module")
def asset():
    return make_asset(1500)


@pytest.fixture(scope="module")
def scene(asset):
    scene = v3dg.Scene()
    rng = np.random.default_rng(3)
    quaternions = rng.normal(size=(5, 4))
    bundle = build_bundle(asset, config=BuildConfig(steps=0), progress=False, device="cpu")
    scene.add(bundle, rng.uniform(-4, 4, (5, 3)), quaternions, rng.uniform(0.5, 2, 5))
    return scene


@pytest.mark.parametrize("target_px", [0.0, 3.0, 20.0, 1e9])
def test_cut_of_the_hierarchy_has_one_node_above_every_leaf(asset, scene, target_px):
    hierarchy = build_hierarchy(asset)
    instance, node, way = HierarchyScene(hierarchy, scene, "cpu").cut(eye_camera(12), target_px)
    chosen = np.zeros((len(scene), len(hierarchy.parent)), int)
    np.add.at(chosen, (instance, node), 1)
    leaves = np.arange(len(hierarchy.parent) - hierarchy.num_leaves, len(hierarchy.parent))
    above, at = np.zeros((len(scene), len(leaves)), int), leaves
    while True:
        above += chosen[:, at]
        if (at == 0).all():
            break
        # The root counts only once, although many paths end at it.
        above[:, at == 0] -= chosen[:, [0]]
        at = hierarchy.parent[at]
    assert (above == 1).all()
    assert ((way >= 0) & (way <= 1)).all()


def test_hierarchy_at_size_zero_draws_the_asset(asset, scene):
    theirs = HierarchyScene(build_hierarchy(asset), scene, "cpu")
    found = theirs.gaussians(theirs.cut(eye_camera(12), 0.0))
    expected = v3dg.select(scene, eye_camera(12), tolerance=0, cull=False, device="cpu").gaussians(
        device="cpu"
    )
    order = [np.lexsort(g.means.T) for g in (found, expected)]
    np.testing.assert_allclose(found.means[order[0]], expected.means[order[1]], atol=1e-5)
    np.testing.assert_allclose(found.opacities[order[0]], expected.opacities[order[1]], atol=1e-6)


def test_hierarchy_keeps_moments_and_shares_axes(asset):
    hierarchy = build_hierarchy(asset)
    nodes, parent = hierarchy.gaussians, hierarchy.parent
    first = len(parent) // 3  # the cut changes at a node in the middle
    siblings = np.flatnonzero(parent == parent[first])
    assert len(siblings) == hierarchy.num_siblings[first] == 2
    low, high = nodes.means[siblings].min(axis=0), nodes.means[siblings].max(axis=0)
    mean = nodes.means[parent[first]]
    assert ((mean >= low - 1e-6) & (mean <= high + 1e-6)).all()
    np.testing.assert_array_less(hierarchy.box[parent, 0], hierarchy.box[:, 0] + 1e-6)
    np.testing.assert_array_less(hierarchy.box[:, 1], hierarchy.box[parent, 1] + 1e-6)
    # The order of the axes is chosen so that rotations are small: none exceeds 63
    # degrees, the largest distance from all 24 rotations that map axes to axes.
    turn = np.abs((nodes.quats * nodes.quats[parent]).sum(axis=1)) / np.linalg.norm(
        nodes.quats[parent], axis=1
    )
    assert turn.min() > np.cos(np.radians(63 / 2))


def test_siblings_on_the_verge_of_their_parent_cover_as_it_does(asset, scene):
    hierarchy = build_hierarchy(asset)
    theirs = HierarchyScene(hierarchy, scene, "cpu")
    pair = np.flatnonzero(hierarchy.parent == 5)
    zero, one = np.zeros(2, np.int32), np.ones(2, np.float32)
    found = theirs.gaussians((zero, pair, one))
    above = theirs.gaussians((zero[:1], np.array([5]), np.zeros(1, np.float32)))
    np.testing.assert_allclose(found.means, np.repeat(above.means, 2, 0), atol=1e-6)
    covered = 1 - np.prod(1 - found.opacities)
    assert covered == pytest.approx(min(above.opacities[0], 0.999), abs=1e-4)


def test_screen_radii_follow_the_projection(asset):
    camera = eye_camera(3)
    expected = project(asset, camera, filter_px2=0.0)
    sigmas = np.clip(np.sqrt(2 * np.log(np.maximum(asset.opacities * 255, 1))), 0, 3.33)
    variance = np.maximum(expected.covariance_px2[:, 0, 0], expected.covariance_px2[:, 1, 1])
    radii = measure.screen_radii(asset, camera)
    inside = radii > 0
    assert inside.mean() > 0.5
    np.testing.assert_allclose(radii[inside], (sigmas * np.sqrt(variance))[inside], rtol=1e-3)


def test_clip_leaves_at_most_as_many_as_wanted(asset):
    radii = measure.screen_radii(asset, eye_camera(3))
    clip = measure.clip_radius_for(radii, 400)
    assert 390 <= (radii > clip).sum() <= 400


def test_tolerance_for_a_count_is_the_smallest_that_fits(scene):
    camera = eye_camera(12)
    tolerance = measure.tolerance_for(scene, camera, 3000)
    assert v3dg.select(scene, camera, tolerance=tolerance, device="cpu").num_gaussians <= 3000
    assert v3dg.select(scene, camera, tolerance=0.99 * tolerance, device="cpu").num_gaussians > 3000


def test_tolerance_for_a_count_that_cannot_be_is_the_coarsest(scene):
    assert measure.tolerance_for(scene, eye_camera(12), 1) == measure.COARSEST


def test_judge_keeps_the_order_and_knows_equal_pictures():
    judge = measure.Judge()
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    try:
        same, other = judge.errors([(truth, truth), (truth, 255 - truth)])
    finally:
        judge.close()
    assert same == {"flip": 0.0, "psnr": None}
    assert other["flip"] > 0.1
    assert other["psnr"] < 20


def test_popping_is_what_a_frame_changes_beyond_the_truth():
    row = motion.steps_row("ours", [0.3, 0.5], [0.1, 0.2], [0.2, 0.2])
    assert row["above_truth"] == pytest.approx(0.25)
    assert row["worst_above_truth"] == pytest.approx(0.3)
    assert row["above_full"] == pytest.approx(0.2)


def frames_of(*changes):
    """Return grey pictures of 40 x 36 px, in which a tile at the right is brighter by
    this number of 255ths."""
    pictures = []
    for change in changes:
        picture = np.full((36, 40, 3), 0.5, np.float32)
        if change:
            picture[16:32, 32:] += change / 255
        pictures.append(picture)
    return pictures


def test_worst_tile_is_what_its_error_changes_by():
    found, truth = steadiness.Steadiness(), np.full((36, 40, 3), 0.5, np.float32)
    for picture in frames_of(0, 0, 8, 8, 7):
        found.add(picture, truth)
    row = found.row()
    assert row["tile_worst"] == pytest.approx(8, abs=1e-3)
    assert row["tile_mean"] == pytest.approx((8 + 1) / 4, abs=1e-3)
    assert row["tile_median"] == pytest.approx(0.5, abs=1e-3)
    assert row["rms"] == pytest.approx((8 + 1) / 4 * math.sqrt(8 / 40 * 16 / 36), abs=1e-3)
    moving = steadiness.Steadiness()
    for picture in frames_of(0, 0, 8, 8, 7):  # the reference has the same motion
        moving.add(picture, picture - np.float32(0.125))
    assert moving.row()["tile_worst"] < 1e-3
    assert moving.row()["psnr"] == pytest.approx(-20 * math.log10(0.125), abs=1e-3)


def test_paths_go_where_they_say():
    first = eye_camera(3)
    paths = {path.name: path for path in steadiness.paths_from(first, np.zeros(3), 5)}
    for path in paths.values():
        assert len(path.cameras) == 5
        assert path.is_drift == (path.name in ("drift in", "drift out", "moved instances"))
        np.testing.assert_allclose(path.cameras[0].viewmat, first.viewmat, atol=1e-12)
        np.testing.assert_allclose(path.cameras[0].K, first.K)
    far = {name: [np.linalg.norm(c.position) for c in path.cameras] for name, path in paths.items()}
    start = far["drift in"][0]
    np.testing.assert_allclose(far["drift in"], start * 0.9995 ** np.arange(5))
    np.testing.assert_allclose(far["zoom"], start * 0.995 ** np.arange(5))
    np.testing.assert_allclose(far["orbit"], start)
    for camera in paths["turn in place"].cameras:
        np.testing.assert_allclose(camera.position, first.position, atol=1e-12)
    ahead = np.array([camera.viewmat[2, :3] for camera in paths["walk"].cameras])
    np.testing.assert_allclose(ahead, ahead[:1].repeat(5, 0), atol=1e-12)
    steps = np.diff([camera.position for camera in paths["walk"].cameras], axis=0)
    np.testing.assert_allclose(steps @ ahead[0], 0.005 * start)
    moved = paths["moved instances"]
    np.testing.assert_allclose(
        [np.linalg.norm(moved.seen_from(k).position) for k in range(5)], far["drift in"]
    )


def test_paths_keep_a_part_of_a_picture_in_sight():
    whole = eye_camera(3)
    K = whole.K.copy()
    K[:2, 2] -= 40, -9
    part = replace(whole, K=K, width=16, height=12)
    ray = np.array([(8 - part.cx) / part.fx, (6 - part.cy) / part.fy, 1.0])
    place = whole.position + 2.5 * ray @ whole.viewmat[:3, :3]
    for path in steadiness.paths_from(part, place, 5):
        np.testing.assert_allclose(path.cameras[0].viewmat, part.viewmat, atol=1e-12)
        for camera in path.cameras:
            assert (camera.width, camera.height) == (16, 12)
            np.testing.assert_array_equal(camera.K, K)
            if path.name in ("drift in", "drift out", "zoom"):
                x, y, z = camera.viewmat[:3, :3] @ place + camera.viewmat[:3, 3]
                np.testing.assert_allclose([x / z, y / z], ray[:2], atol=1e-12)


def test_pops_are_what_cuts_differ_by_from_one_place(scene):
    path = next(
        p for p in steadiness.paths_from(eye_camera(6), np.zeros(3), 12) if p.name == "zoom"
    )
    cuts = {
        "all": {"tolerance": 0.0},
        "hard": {"tolerance": 3.0},
        "fade": {"tolerance": 3.0, "fade": 1.5},
        "stays": Stays(path.cameras[0], 3.0),
    }
    found = {
        row["cut"]: row for row in steadiness.compare(scene, path, cuts, "cpu", along_motion=False)
    }
    assert found["all"]["pop_worst"] == found["stays"]["pop_worst"] == 0
    assert found["hard"]["most_changed_items"] > 0
    assert 0 < found["fade"]["pop_worst"] < 0.5 * found["hard"]["pop_worst"]
    assert "warped_worst" not in found["hard"]


def test_crowds_stand_upright_and_windows_look_at_what_is_in_them(tmp_path, scene):
    scene.bundles[0].write(tmp_path / "a.v3dg")
    config = fades_scenes.Config((), picture=(96, 54), window=(32, 18), side=3)
    crowd = fades_scenes.subject_of(f"{tmp_path}/a.v3dg:-y,{tmp_path}/a.v3dg:x@above", config)
    assert list(crowd.cameras) == ["above"]
    first, second = (crowd.scene.rotations[crowd.scene.instance_bundle == b] for b in (0, 1))
    np.testing.assert_allclose(first @ [0, -1, 0], [[0, 0, 1]] * 5, atol=1e-6)
    np.testing.assert_allclose(second @ [1, 0, 0], [[0, 0, 1]] * 4, atol=1e-6)
    found = list(fades_scenes.windows_of(crowd.scene, crowd.cameras["above"], config))
    assert 0 < len(found) <= 9
    for name, camera, place in found:
        left, top = map(int, name.split(","))
        x, y, z = camera.viewmat[:3, :3] @ place + camera.viewmat[:3, 3]
        seen = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        np.testing.assert_allclose(seen, [16, 9], atol=1e-6)
        np.testing.assert_allclose([camera.cx + left, camera.cy + top], [48, 27])


class Seen:
    """The data of a picture of a wall besides its colours."""

    def __init__(self, depth, alpha=1.0):
        self.depth, self.alpha = np.full((32, 48), depth), np.full((32, 48), alpha)


def test_errors_are_followed_to_where_they_are_seen_next():
    """The wall is at depth 8. The cameras are three of its pixels apart, or the wall
    moves in front of one camera."""
    first = Camera(np.eye(4), np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32)
    aside = np.eye(4)
    aside[0, 3] = 3 * 8 / 40
    still = steadiness.Path("", [first, replace(first, viewmat=aside)], True, np.zeros((2, 3)))
    moved = steadiness.Path("", [first] * 2, True, np.array([[0, 0, 0], aside[:3, 3]]))
    error = np.random.default_rng(0).uniform(0.2, 0.8, (32, 48, 3)).astype(np.float32)
    for path in (still, moved):
        warp = steadiness.Warp(path.seen_from(0), path.seen_from(1), (Seen(8.0), Seen(8.0)))
        np.testing.assert_array_equal(warp.is_valid, np.arange(48)[None] >= np.full((32, 1), 3))
        np.testing.assert_allclose(warp(error)[:, 3:], error[:, :-3], atol=1e-5)
        found = steadiness.Steadiness()
        found.add(error, np.zeros_like(error))
        found.add(np.roll(error, 3, axis=1), np.zeros_like(error), warp)
        assert found.row()["warped_worst"] < 0.01 < 50 < found.row()["tile_worst"]
    for before, after in (
        (Seen(8.0), Seen(7.0)),
        (Seen(8.0, 0.5), Seen(8.0)),
        (Seen(8.0), Seen(8.0, 0.5)),
    ):
        assert not steadiness.Warp(first, first, (before, after)).is_valid.any()


def test_changed_items_are_those_of_another_weight_and_those_of_one_cut(scene):
    cut = v3dg.select(scene, eye_camera(12), fade=4.0, device="cpu")
    fewer = replace(
        cut,
        instance_ids=cut.instance_ids[2:],
        cluster_ids=cut.cluster_ids[2:],
        given_weights=cut.weights[2:],
    )
    other = replace(
        cut, given_weights=np.where(np.arange(len(cut)) < 3, 0.125, cut.weights).astype("f4")
    )
    assert steadiness.changed_items(cut, cut) == 0
    assert steadiness.changed_items(cut, fewer) == steadiness.changed_items(fewer, cut) == 2
    assert steadiness.changed_items(cut, other) == 3


def test_made_assets_are_as_many_as_asked_for_and_repeat():
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=64, height=36)
    for made in (
        lambda: hair_lines(333),
        lambda: sky_dome(333),
        lambda: like_trained(333, camera, "cpu", sh_degree=1),
        lambda: many_copies(make_asset(1000), 3).subset(slice(333)),
    ):
        first, again = made(), made()
        assert len(first) == 333
        for name in ("means", "quats", "scales", "opacities", "sh"):
            np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
            assert np.isfinite(getattr(first, name)).all()


def test_a_picture_that_changes_between_runs_is_refused(tmp_path, scene, monkeypatch):
    made = evaluation.Evaluation(TINY, "cpu", tmp_path)
    view = evaluation.evaluation.orbit_view(0, 45, 12, (64, 36))
    real, drawn = evaluation.evaluation.render, []

    def flickering(*arguments, **options):
        drawn.append(1)
        return real(*arguments, **options, background=(len(drawn) / 10, 0.0, 0.0))

    monkeypatch.setattr(evaluation.evaluation, "render", flickering)
    with pytest.raises(RuntimeError, match="same bytes in every run"):
        made.shoot(scene, view)


def test_a_folder_called_v3dg_is_not_mistaken_for_the_package(tmp_path, monkeypatch):
    (tmp_path / "v3dg").mkdir()
    (tmp_path / "v3dg" / "__init__.py").write_text("raise ImportError('the wrong one')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    rows = evaluation.part("alone").threads_rows(evaluation.Evaluation(TINY, "cpu", tmp_path))
    assert rows[0]["threads"] == 1
    assert all(row["frame_ms"] > 0 for row in rows)


def test_unknown_part_is_refused(capsys, tmp_path):
    assert PROGRAM.main(["evaluate", "-o", str(tmp_path), "--parts", "tolerances"]) == 1
    assert "expected some of tolerance, composed" in capsys.readouterr().err


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The results of all parts of the evaluation, which are as small as possible."""
    folder = tmp_path_factory.mktemp("evaluation")
    made = evaluation.Evaluation(TINY, "cpu", folder)
    return folder, evaluation.run(made, "tiny", evaluation.NAMES, quiet=True)


@pytest.mark.slow
def test_every_part_writes_what_it_measured(results):
    folder, measured = results
    assert set(measured) == set(evaluation.NAMES)
    for name, result in measured.items():
        written = json.loads((folder / f"{name}.json").read_text())
        assert {"commit", "command", "processor", "seed", "seconds"} <= set(written)
        assert written["part"] == name
        for picture in result["pictures"]:
            assert (folder / picture).stat().st_size > 0
        assert "|" in evaluation.part(name).tables(result)


@pytest.mark.slow
def test_clipping_is_compared_at_equal_counts(results):
    for row in results[1]["clipping"]["rows"]:
        assert row["clipped_in_frustum"] <= row["ours_in_frustum"]
        assert row["clipped_in_frustum"] > 0.9 * row["ours_in_frustum"]


@pytest.mark.slow
def test_page_begins_with_a_table_and_lists_wins_and_losses(results):
    folder, _ = results
    text = report.page([folder], folder / "results.md", folder / "notes" / "evaluation.md")
    assert text.splitlines()[2].startswith("| scene | ")
    assert "## Where we win\n\n- " in text
    assert "## Where we do not\n" in text
    assert "](notes/evaluation.md)" in text


def test_what_is_written_by_hand_stays_behind_a_new_page(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "page", lambda *_: "# Results\n\nnew\n")
    monkeypatch.setattr(report, "tables_page", lambda *_: "tables\n")
    output = tmp_path / "results.md"
    output.write_text(f"# Results\n\nold\n\n{report.BY_HAND}\n\n## By hand\n", encoding="utf-8")
    options = report.Report((tmp_path,), output, tmp_path / "tables.md", no_plots=True)
    for _ in range(2):  # the second run gives the same results
        report.run(options)
        text = output.read_text(encoding="utf-8")
        assert text == f"# Results\n\nnew\n\n{report.BY_HAND}\n\n## By hand\n"


@pytest.mark.slow
def test_page_of_tables_has_every_part(results):
    folder, _ = results
    text = report.tables_page([folder], folder / "notes" / "evaluation.md")
    for name in evaluation.NAMES:
        assert f"### {evaluation.part(name).TITLE}" in text
    assert "](../clipping.jpg)" in text


@pytest.mark.slow
def test_plots_are_drawn(results):
    pytest.importorskip("matplotlib")
    folder, _ = results
    report.draw_plots(folder)
    assert (folder / "tolerance.png").stat().st_size > 1000


def test_page_names_all_commits_that_were_measured():
    parts = [
        {"gpu": "a GPU", "commit": commit, "python": "3.12", "torch": "2.11"}
        for commit in ("aa", "bb", "aa")
    ]
    assert report.machine(parts) == "a GPU, commits aa, bb, Python 3.12, torch 2.11"
    assert report.machine(parts[:1]) == "a GPU, commit aa, Python 3.12, torch 2.11"


def test_report_of_an_empty_folder_says_what_to_run(tmp_path):
    with pytest.raises(ValueError, match="run `python -m benchmarks evaluate` first"):
        report.read_results(tmp_path)


@pytest.mark.parametrize("degrees", [-1e-5, 0.0, 1e-5])
def test_views_of_rounded_cameras_are_from_one_direction(degrees):
    camera = evaluation.evaluation.orbit_view(degrees, 45, 3, (64, 36)).camera
    assert evaluation.evaluation.views_of([camera])[0].azimuth == 0


@pytest.mark.gpu
@pytest.mark.slow
def test_parts_run_on_cuda(tmp_path):
    made = evaluation.Evaluation(TINY, "cuda", tmp_path)
    measured = evaluation.run(
        made, "tiny", ("tolerance", "clipping", "hierarchy", "motion"), quiet=True
    )
    for row in measured["clipping"]["rows"]:
        assert 0.9 * row["ours_in_frustum"] < row["clipped_in_frustum"] <= row["ours_in_frustum"]
    for row in measured["hierarchy"]["rows"]:
        assert (
            row["ours_selected"] <= row["theirs_selected"] or row["tolerance"] == measure.COARSEST
        )
