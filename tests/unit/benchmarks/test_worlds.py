import json

import numpy as np
import pytest

import v3dg
from benchmarks import worlds
from benchmarks.__main__ import PROGRAM
from v3dg.levels import build_file
from v3dg.rotations import rotation_from_quaternion


@pytest.fixture(scope="module")
def sea():
    return worlds.donut_sea(200, 2000, seed=2)


def all_of(world, name):
    return np.concatenate([getattr(placement, name) for placement in world.placements.values()])


def small(name, **options):
    return getattr(worlds, name)(24, 8000, **options)


@pytest.mark.parametrize("name", ["forest", "temples", "crowd"])
def test_full_worlds_have_the_papers_counts(name):
    world = getattr(worlds, name)()
    assert world.num_instances == {"forest": 400, "temples": 100, "crowd": 400}[name]
    assert 1.2e8 < world.num_gaussians < 1.4e8
    assert len(world.assets) == {"forest": 8, "temples": 1, "crowd": 16}[name]


def test_a_full_donut_sea_would_have_the_papers_count():
    sea = worlds.donut_sea(instances=16)
    assert sea.num_gaussians * 2048 // 16 == 93_437_952


@pytest.mark.parametrize("name", ["donut_sea", "forest", "temples", "crowd"])
def test_same_seed_same_world(name):
    first, again, other = small(name, seed=1), small(name, seed=1), small(name, seed=2)
    for row in ("positions", "quaternions", "scales"):
        assert np.array_equal(all_of(first, row), all_of(again, row))
    if name == "crowd":
        assert any(
            not np.array_equal(first.placements[k].positions, other.placements[k].positions)
            for k in first.placements
        )
    else:
        assert not np.array_equal(all_of(first, "positions"), all_of(other, "positions"))


@pytest.mark.parametrize("name", ["forest", "temples", "crowd"])
def test_assets_have_as_many_gaussians_as_they_say(name):
    world = small(name)
    asset = next(iter(world.assets.values()))
    assert len(asset.make()) == asset.num_gaussians


@pytest.mark.parametrize(("name", "radius"), [("forest", 1.0), ("temples", 12.0)])
def test_scattered_instances_keep_apart_and_stand_upright(name, radius):
    world = getattr(worlds, name)(60, 8000)
    positions, scales = all_of(world, "positions"), all_of(world, "scales")
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    np.fill_diagonal(distance, np.inf)
    assert (distance > radius * (scales[:, None] + scales)).all()
    assert (positions[:, 2] == 0).all()
    up = rotation_from_quaternion(all_of(world, "quaternions"))[:, :, 2]
    assert np.allclose(up, [0, 0, 1])
    assert scales.min() < 0.95 < 1.05 < scales.max()


def test_temples_do_not_overlap():
    """No corner of a floor, which is a rectangle of 16 x 28, lies in another floor."""
    world = worlds.temples(40, 8000)
    placement = world.placements["temple"]
    corners = np.array([[x, y, 0] for x in (-8, 0, 8) for y in (-14, -7, 0, 7, 14)], float)
    rotations = rotation_from_quaternion(placement.quaternions)
    for i in range(40):
        world_corners = placement.positions[i] + placement.scales[i] * corners @ rotations[i].T
        for j in set(range(40)) - {i}:
            local = (world_corners - placement.positions[j]) @ rotations[j] / placement.scales[j]
            assert not ((np.abs(local[:, 0]) < 8) & (np.abs(local[:, 1]) < 14)).any()


def test_crowd_stands_in_a_grid_and_looks_one_way():
    world = worlds.crowd(25, 8000, persons=4)
    positions = all_of(world, "positions")
    xs, ys = (np.unique(positions[:, k].round(9)) for k in (0, 1))
    assert len(xs) == len(ys) == 5
    assert np.allclose(np.diff(xs), np.diff(xs)[0])
    assert len(np.unique(positions, axis=0)) == 25
    assert np.allclose(positions[:, :2].mean(axis=0), 0)
    assert (all_of(world, "quaternions") == [1, 0, 0, 0]).all()
    counts = [len(placement) for placement in world.placements.values()]
    assert max(counts) - min(counts) <= 1


def test_every_camera_sees_some_of_the_crowd():
    world = worlds.crowd(16, 2000, persons=1)
    config = v3dg.BuildConfig(steps=0)
    bundle = v3dg.build_bundle(
        world.assets["person_00"].make(), config=config, progress=False, device="cpu"
    )
    scene = worlds.scene_of(world, {"person_00": bundle})
    for name, camera in world.cameras(width=64, height=36).items():
        assert v3dg.render(scene, camera, device="cpu").color.any(), name


def test_a_crowd_of_fewer_than_there_are_persons():
    world = worlds.crowd(3, 8000)
    assert world.num_instances == 3
    assert set(world.assets) == set(world.placements)


def test_donuts_lie_still_on_the_ground_and_on_each_other(sea):
    heights = sea.placements["donut"].positions[:, 2]
    assert heights.min() > 0.7 * 0.75 * 0.04
    assert heights.max() < 0.5
    assert np.percentile(heights, 80) > 0.08, "a pile, not a carpet"
    assert (np.abs(sea.placements["donut"].scales - 0.875) <= 0.125).all()


def test_donuts_hardly_overlap(sea):
    placement = sea.placements["donut"]
    pile = worlds.Pile(
        placement.positions,
        placement.quaternions,
        placement.scales,
        ring=worlds.RING,
        tube=worlds.TUBE,
    )
    assert pile.deepest_overlap() < 0.25


def test_donuts_hang_free_before_they_fall():
    assert worlds.donut_shower(300).deepest_overlap() == 0


def test_cameras_of_a_world_see_it(sea):
    cameras = sea.cameras(width=64, height=36)
    far = cameras["059_camera_19"]
    points = sea.placements["donut"].positions @ far.viewmat[:3, :3].T + far.viewmat[:3, 3]
    assert (points[:, 2] > 0).all()
    pixels = points @ far.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert ((pixels > 0) & (pixels < [64, 36])).all(axis=1).mean() > 0.9


def test_scene_of_a_world_draws():
    world = worlds.forest(6, 2000)
    config = v3dg.BuildConfig(steps=0)
    bundles = {
        name: v3dg.build_bundle(asset.make(), config=config, progress=False)
        for name, asset in world.assets.items()
    }
    scene = worlds.scene_of(world, bundles)
    assert len(scene) == 6
    camera = world.cameras(width=64, height=36)["099_camera_19"]
    assert v3dg.render(scene, camera, device="cpu").alpha.max() > 0.5


def test_a_written_world_is_read_and_drawn(tmp_path):
    world = worlds.crowd(5, 2000, persons=2, seed=1)
    path = worlds.write_world(
        world, tmp_path / "new", config=v3dg.BuildConfig(steps=0), progress=False
    )
    assert path == tmp_path / "new" / "crowd.json"
    assert sorted(p.name for p in path.parent.iterdir()) == [
        *("crowd.json", "person_00.ply", "person_00.v3dg", "person_01.ply", "person_01.v3dg"),
    ]
    scene, cameras = v3dg.read_scene(path)
    assert len(scene) == 5
    assert len(cameras) == 400
    assert np.array_equal(scene.positions, all_of(world, "positions"))
    assert len(v3dg.read_asset(path.parent / "person_00.ply")) == 2000
    assert (
        v3dg.render(
            scene, world.cameras(width=64, height=36)["059_camera_19"], device="cpu"
        ).alpha.max()
        > 0.5
    )


def test_an_interrupted_world_goes_on(tmp_path, monkeypatch):
    world = worlds.crowd(5, 2000, persons=3, seed=1)
    options = {"config": v3dg.BuildConfig(steps=1, num_views=4, image_size=16), "progress": False}
    whole = worlds.write_world(world, tmp_path / "whole", **options).parent
    built = []

    def build(*paths, **rest):
        if len(built) == 1:
            raise KeyboardInterrupt
        built.append(paths)
        return build_file(*paths, **rest)

    monkeypatch.setattr(worlds, "build_file", build)
    with pytest.raises(KeyboardInterrupt):
        worlds.write_world(world, tmp_path / "cut", **options)
    first = (tmp_path / "cut" / "person_00.v3dg").stat().st_mtime_ns
    monkeypatch.setattr(worlds, "build_file", build_file)
    path = worlds.write_world(world, tmp_path / "cut", resume=True, **options)
    assert (path.parent / "person_00.v3dg").stat().st_mtime_ns == first
    names = sorted(p.name for p in whole.iterdir())
    assert sorted(p.name for p in path.parent.iterdir()) == names
    for name in names:
        assert (whole / name).read_bytes() == (path.parent / name).read_bytes()
    # Without the record of the build, or with other settings, everything is built
    # again.
    worlds.write_world(world, tmp_path / "cut", **options)
    again = (path.parent / "person_00.v3dg").stat().st_mtime_ns
    assert again > first
    other = options | {"config": v3dg.BuildConfig(steps=0)}
    worlds.write_world(world, tmp_path / "cut", resume=True, **other)
    assert (path.parent / "person_00.v3dg").stat().st_mtime_ns > again


def test_command_line_writes_a_world(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(
        worlds.SMALL, "crowd", {"instances": 2, "num_gaussians": 2000, "persons": 1}
    )
    folder = tmp_path / "people"
    arguments = [
        "world",
        "crowd",
        "-o",
        str(folder),
        "--seed",
        "3",
        "--device",
        "cpu",
        "--quiet",
        "--json",
    ]
    assert PROGRAM.main(arguments) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["output"] == str(folder / "crowd.json")
    assert (result["instances"], result["gaussians"]) == (2, 4000)
    assert np.array_equal(
        v3dg.read_asset(folder / "person_00.ply").means,
        worlds.crowd(2, 2000, persons=1, seed=3).assets["person_00"].make().means,
    )


@pytest.mark.parametrize("name", worlds.WORLDS)
def test_small_worlds_are_small(name):
    world = worlds.WORLDS[name](**worlds.SMALL[name])
    assert sum(asset.num_gaussians for asset in world.assets.values()) <= 200_000
    assert world.num_gaussians > 500_000


def test_a_missing_bundle_is_named():
    world = small("temples")
    with pytest.raises(
        ValueError, match="bundles: expected one for each asset of temples, got none for temple"
    ):
        worlds.scene_of(world, {})


@pytest.mark.parametrize("name", ["donut_sea", "forest", "temples", "crowd"])
def test_worlds_without_instances_are_refused(name):
    with pytest.raises(ValueError, match="instances: expected at least 1, got 0"):
        getattr(worlds, name)(0)
