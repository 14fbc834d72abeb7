"""Tests builds in parts: plans from counts, subtrees that are built alone and in any
order, and files that receive finished parts."""

from dataclasses import asdict, fields, replace
from functools import partial

import numpy as np
import pytest

import scenes
import v3dg
from benchmarks.worlds.procedural import make_asset
from v3dg import BuildConfig, Gaussians, _core, build_bundle
from v3dg.bundle.codec import CODECS, codec_of
from v3dg.bundle.file import BundlePlan, write_pages
from v3dg.bundle.format import HASH_BYTES
from v3dg.bundle.pages import PageLayout
from v3dg.levels import build_file, levels_path
from v3dg.levels.assemble import assemble
from v3dg.levels.fit import fit_config
from v3dg.levels.leaves import MemoryLeaves
from v3dg.levels.plan import Plan
from v3dg.levels.simplify import Level, LevelBuilder, LevelTables

SMALL = BuildConfig(cluster_size=32, steps=4, num_views=4, supersample=2)
CONFIGS = {
    "ours": SMALL,
    "paper": BuildConfig.paper(cluster_size=32, steps=3, image_size=24),
    "prune": replace(SMALL, init="prune"),
    "previous": replace(SMALL, targets="previous"),
    "fresh_views": replace(SMALL, num_views=0),
    "groups_of_4": replace(SMALL, group_size=4, asset_filter_px2=0.3),
    "groups_of_8": replace(SMALL, group_size=8, loss_dssim=0.2),
}
SEED = 11


@pytest.fixture(scope="module")
def asset():
    return make_asset(num_gaussians=1100, seed=2)


def in_split_order(asset, config):
    leaves = MemoryLeaves(asset, config, "refuse")
    return leaves.read(0, leaves.num_gaussians)


def arrays_of(level):
    """Return all arrays of a level by name."""
    rows = {name: getattr(level.gaussians, name) for name in scenes.NAMES}
    return rows | {field.name: getattr(level.tables, field.name) for field in fields(LevelTables)}


def part_of(level, plan, part):
    """Return the part of a level that belongs to some of its groups."""
    groups = slice(part.first_group, part.first_group + part.num_groups)
    made = plan.num_clusters // plan.num_groups
    clusters = slice(groups.start * made, groups.stop * made)
    tables = level.tables
    return Level(
        level.gaussians.subset(slice(plan.offset[clusters.start], plan.offset[clusters.stop])),
        LevelTables(
            tables.box[clusters], tables.ball[groups], tables.fit_ball[groups], tables.error[groups]
        ),
    )


def build_subtree(leaves, plan, config, codec, level, first_group, last_group):
    """Return the levels above the leaves under a run of groups, and their plan. They
    are built from these leaves alone."""
    part = plan.subtree(level, first_group, last_group)
    bottom = part.levels[0].first_group
    rows = plan.levels[0].offset[[bottom, bottom + part.levels[0].num_groups]]
    own = Gaussians(*(np.array(getattr(leaves, name)[slice(*rows)]) for name in scenes.NAMES))
    return list(LevelBuilder(part, config, SEED, codec).levels(own)), part


def joined(levels):
    """Return one level that consists of these parts, in order."""
    tables = (
        np.concatenate([getattr(level.tables, field.name) for level in levels])
        for field in fields(LevelTables)
    )
    return Level(Gaussians.concatenate([level.gaussians for level in levels]), LevelTables(*tables))


# ---- plans


@pytest.mark.parametrize("num_gaussians", [1, 2, 3, 7, 33, 1000, 1023, 1025])
@pytest.mark.parametrize("group_size", [2, 8])
def test_plan_has_the_shape_of_the_bundle(asset, num_gaussians, group_size):
    config = BuildConfig(
        cluster_size=16, steps=0, num_views=1, group_size=group_size, min_gaussians=1
    )
    bundle = build_bundle(
        asset.subset(slice(num_gaussians)),
        config=config,
        progress=False,
        device="cpu",
        unusable="refuse",
    )
    plan = Plan.of(num_gaussians, config)
    assert len(plan.levels) == bundle.num_levels
    for number, level in enumerate(plan.levels):
        clusters = bundle.level_range(number)
        offset = bundle.clusters.offset[clusters.start : clusters.stop + 1]
        np.testing.assert_array_equal(level.offset, offset - offset[0])
        if number > 0:
            np.testing.assert_array_equal(
                level.weight, bundle.groups.weight[bundle.groups.level == number]
            )
    pages = PageLayout.of(bundle.clusters)
    np.testing.assert_array_equal(plan.layout.first_cluster, pages.first_cluster)
    np.testing.assert_array_equal(plan.layout.first_gaussian, pages.first_gaussian)
    assert plan.first_page[-1] == bundle.num_pages


def test_plan_of_a_subtree_is_a_part_of_the_plan():
    plan = Plan.of(1_000_003, BuildConfig(group_size=4))
    level, first, last = 5, 3, 7
    part = plan.subtree(level, first, last)
    assert len(part.levels) == level + 1
    for here, whole in zip(part.levels, plan.levels, strict=False):
        assert here.first_group * plan.levels[level].num_groups == first * whole.num_groups
        groups = slice(here.first_group, here.first_group + here.num_groups)
        np.testing.assert_array_equal(here.weight, whole.weight[groups])
        np.testing.assert_array_equal(np.diff(here.leaf_offset), np.diff(whole.leaf_offset)[groups])
        assert here.leaf_offset[-1] == part.levels[0].num_gaussians


# ---- subtrees


@pytest.mark.parametrize(
    ("name", "codec"), [*((name, "float32") for name in CONFIGS), ("ours", "quantized")]
)
def test_a_subtree_alone_is_that_of_the_whole(asset, name, codec):
    """The subtree is the same whatever is built next to it, below any level, and in any
    order."""
    config = CONFIGS[name]
    leaves, plan = in_split_order(asset, config), Plan.of(len(asset), config)
    codec = codec_of(codec, asset.sh_degree)
    whole = list(LevelBuilder(plan, config, SEED, codec).levels(leaves))
    num_compared = 0
    for level in (3, 1, 2):
        num_groups = plan.levels[level].num_groups
        for group in np.random.default_rng(level).permutation(num_groups)[:3]:
            levels, part = build_subtree(leaves, plan, config, codec, level, group, group + 1)
            for built, of_whole, here, there in zip(
                levels, whole, part.levels, plan.levels, strict=False
            ):
                expected = arrays_of(part_of(of_whole, there, here))
                for key, array in arrays_of(built).items():
                    assert array.tobytes() == expected[key].tobytes(), (level, group, key)
                num_compared += here.num_groups
    assert num_compared > 20


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", ["ours", "groups_of_4"])
def test_subtrees_in_any_order_make_the_same_file(asset, name, codec, tmp_path):
    """The pages of a subtree are written when it is finished. The levels above are
    built from the decoded pages."""
    config = CONFIGS[name]
    options = {"config": config, "seed": SEED, "progress": False, "device": "cpu", "codec": codec}
    build_bundle(asset, **options).write(tmp_path / "whole.v3dg")
    made_with = v3dg.Bundle.open(tmp_path / "whole.v3dg").config
    leaves, plan = in_split_order(asset, config), Plan.of(len(asset), config)
    level = 2
    num_groups = plan.levels[level].num_groups
    subtrees = {}
    codec, first_page = codec_of(codec, asset.sh_degree), plan.first_page
    file = BundlePlan(plan.layout, codec, made_with)
    hashes = np.zeros((first_page[-1], HASH_BYTES), np.uint8)
    with open(tmp_path / "parts.v3dg", "wb") as output:

        def write(first, last, gaussians):
            hashes[first:last] = write_pages(
                output.name, output.fileno(), file.run(first, last), codec, gaussians
            )

        for group in np.random.default_rng(0).permutation(num_groups):
            levels, part = build_subtree(leaves, plan, config, codec, level, group, group + 1)
            for number, above in enumerate(part.levels[1:]):
                page = first_page[number] + above.first_group
                write(page, page + above.num_groups, levels[number].gaussians)
            subtrees[group] = levels
        in_order = zip(*(subtrees[group] for group in range(num_groups)), strict=True)
        finished = [joined(levels) for levels in in_order][1:]
        whole = list(LevelBuilder(plan, config, SEED, codec).levels(leaves, finished))
        for number in range(level, len(whole)):
            write(first_page[number], first_page[number + 1], whole[number].gaussians)
        tables = assemble(plan, [level.tables for level in whole], config)
        file.write_tables(output.fileno(), *tables, hashes)
        file.write_header(output.fileno())
    assert (tmp_path / "parts.v3dg").read_bytes() == (tmp_path / "whole.v3dg").read_bytes()


# ---- units


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", ["ours", "previous", "groups_of_4"])
def test_units_are_the_same_on_any_number_of_threads(asset, name, codec, monkeypatch, tmp_path):
    """An interrupted build continues to the same bytes, whichever units were
    finished."""
    config = CONFIGS[name]
    monkeypatch.setattr("v3dg.levels.whole.UNIT_LEAVES", 160)
    whole = build_bundle(asset, config=config, seed=SEED, progress=False, device="cpu", codec=codec)
    whole.write(tmp_path / "one.v3dg")
    monkeypatch.setattr("v3dg._device.all_like", lambda device: [device] * 3)
    three = {"config": config, "seed": SEED, "progress": False, "codec": codec}
    monkeypatch.setattr("v3dg._device.missing_for_cuda", lambda: "none wanted")
    build_bundle(asset, **three).write(tmp_path / "three.v3dg")
    assert (tmp_path / "three.v3dg").read_bytes() == (tmp_path / "one.v3dg").read_bytes()

    fits = []

    def some(*arguments):
        fits.append(arguments)
        if len(fits) > 9:
            raise KeyboardInterrupt
        return simplify(*arguments)

    simplify = v3dg.levels.simplify.LevelBuilder._simplify
    with monkeypatch.context() as patch:
        patch.setattr("v3dg.levels.simplify.LevelBuilder._simplify", some)
        with pytest.raises(KeyboardInterrupt):
            build_bundle(asset, resume_path=tmp_path / "levels", **three)
    build_bundle(asset, resume_path=tmp_path / "levels", **three).write(tmp_path / "resumed.v3dg")
    assert (tmp_path / "resumed.v3dg").read_bytes() == (tmp_path / "one.v3dg").read_bytes()


def test_units_hold_all_leaves_and_no_more_than_asked():
    for count in (1, 2, 255, 1000, 1_000_003):
        for most in (300, 10_000, 1 << 20):
            plan = Plan.of(count, BuildConfig())
            units = plan.units(most)
            sizes = [part.levels[0].num_gaussians for part in units]
            assert sum(sizes) == count
            assert max(sizes) <= max(most, 2 * 256)  # no two units share a page
            assert len({len(part.levels) for part in units}) == 1


# ---- files


@pytest.mark.parametrize("codec", CODECS)
def test_a_file_is_built_as_a_bundle_is(asset, codec, tmp_path):
    v3dg.write_asset(tmp_path / "asset.ply", asset)
    options = {"config": SMALL, "seed": SEED, "progress": False, "device": "cpu", "codec": codec}
    bundle, is_built = build_file(tmp_path / "asset.ply", tmp_path / "out.v3dg", **options)
    assert is_built
    assert bundle.path == str(tmp_path / "out.v3dg")
    build_bundle(v3dg.read_asset(tmp_path / "asset.ply"), **options).write(tmp_path / "memory.v3dg")
    assert (tmp_path / "out.v3dg").read_bytes() == (tmp_path / "memory.v3dg").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"asset.ply", "out.v3dg", "memory.v3dg"}
    again = build_file(tmp_path / "asset.ply", tmp_path / "out.v3dg", resume=True, **options)
    assert not again[1]
    opened = v3dg.Bundle.open(tmp_path / "out.v3dg")
    other = next(iter(CODECS.keys() - {codec}))
    parts = (opened.clusters, opened.groups, opened.gaussians, opened.config)
    v3dg.Bundle(*parts, other).write(tmp_path / "out.v3dg")
    again = build_file(tmp_path / "asset.ply", tmp_path / "out.v3dg", resume=True, **options)
    assert again[1]  # later conversions are not the result of a build
    assert (tmp_path / "out.v3dg").read_bytes() == (tmp_path / "memory.v3dg").read_bytes()


def test_what_a_killed_build_left_of_a_file_is_written_over(asset, tmp_path):
    """If the build does not continue, the file is overwritten. Remains of another file
    are kept."""
    v3dg.write_asset(tmp_path / "asset.ply", asset)
    left = [levels_path(tmp_path / f"{name}.v3dg") for name in "ab"]
    for path in left:
        path.write_bytes(bytes(8) + b"unfinished v3dg 1\n" + bytes(10_000_000))
    options = {"config": SMALL, "progress": False, "device": "cpu"}
    bundle, _ = build_file(tmp_path / "asset.ply", tmp_path / "a.v3dg", **options)
    assert bundle.info()["bytes"] == (tmp_path / "a.v3dg").stat().st_size
    assert {path.name for path in tmp_path.iterdir()} == {"asset.ply", "a.v3dg", left[1].name}


@pytest.mark.parametrize("mode", [None, 0o640])
def test_a_built_file_has_the_permissions_of_a_written_one(asset, tmp_path, mode):
    """This also holds behind a link, which stays a link. Before the build ends, only
    the owner can read the file."""
    v3dg.write_asset(tmp_path / "asset.ply", asset)
    (tmp_path / "folder").mkdir()
    (tmp_path / "out.v3dg").symlink_to(tmp_path / "folder" / "target.v3dg")
    assert levels_path(tmp_path / "out.v3dg") == tmp_path / "folder" / "target.v3dg.partial"
    if mode is not None:
        (tmp_path / "folder" / "target.v3dg").touch()
        (tmp_path / "folder" / "target.v3dg").chmod(mode)
    options = {"config": SMALL, "progress": False, "device": "cpu"}
    build_file(tmp_path / "asset.ply", tmp_path / "out.v3dg", **options)
    assert (tmp_path / "out.v3dg").is_symlink()
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["target.v3dg"]
    (tmp_path / "like_this").touch()
    expected = (tmp_path / "like_this").stat().st_mode & 0o777 if mode is None else mode
    assert (tmp_path / "out.v3dg").stat().st_mode & 0o777 == expected


def test_an_interrupted_file_leaves_its_levels_alone(asset, tmp_path, monkeypatch):
    v3dg.write_asset(tmp_path / "asset.ply", asset)
    # A part alone would measure again whether the asset is smooth, with fits that
    # differ from those of its levels.
    options = {"config": replace(SMALL, smooth="no"), "progress": False, "device": "cpu"}

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("v3dg.levels.whole.assemble", interrupt)
        with pytest.raises(KeyboardInterrupt):
            build_file(tmp_path / "asset.ply", tmp_path / "out.v3dg", **options)
    assert {p.name for p in tmp_path.iterdir()} == {"asset.ply", levels_path("out.v3dg").name}
    monkeypatch.setattr("v3dg.levels.simplify.LevelBuilder._simplify", interrupt)
    bundle, is_built = build_file(
        tmp_path / "asset.ply", tmp_path / "out.v3dg", resume=True, **options
    )
    assert is_built
    assert bundle.num_levels == len(Plan.of(len(asset), SMALL).levels)


# ---- settings


# These are the settings of the build itself.
OF_THE_BUILD = {
    *(
        "cluster_size",
        "group_size",
        "min_clusters",
        "min_gaussians",
        "init",
        "prune_growth",
        "targets",
    ),
    *("asset_filter_px2", "asset_antialiased", "first_steps", "smooth"),
}


def test_every_setting_of_the_fit_reaches_it(monkeypatch):
    config = BuildConfig.paper(num_views=7, px2_per_gaussian=1.5)
    monkeypatch.setattr(_core, "FitConfig", dict)
    expected = {name: value for name, value in asdict(config).items() if name not in OF_THE_BUILD}
    assert fit_config(config, 3, 2) == expected | {"antialiased": True, "seed": 3}


def test_a_forgotten_setting_of_the_fit_is_an_error(monkeypatch):
    monkeypatch.setattr(_core, "FitConfig", partial(_core.FitConfig, unknown=1))
    with pytest.raises(TypeError):
        fit_config(BuildConfig(), 0, 0)
    with pytest.raises(TypeError):
        _core.FitConfig(steps=1)
