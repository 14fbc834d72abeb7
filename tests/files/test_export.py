"""`v3dg export` writes bundles as streamed SOG, which is read back here.
docs/formats.md describes how they look in a viewer."""

import json
import os
import shutil
import subprocess
from itertools import permutations, product

import numpy as np
import pytest

import v3dg
from command_line import run
from random_bundle import random_bundle
from v3dg.export import write_streamed_sog
from v3dg.export._record import RECORD
from v3dg.export.chunk_errors import ChunkErrors
from v3dg.io import asset_bytes
from v3dg.metrics import psnr


def leaves_of(node):
    """Return the leaves of the tree, after checking that inner nodes contain their
    children."""
    if "lods" in node:
        return [node]
    assert len(node["children"]) > 1
    for child in node["children"]:
        assert (np.array(child["bound"]["min"]) >= node["bound"]["min"]).all()
        assert (np.array(child["bound"]["max"]) <= node["bound"]["max"]).all()
    return [leaf for child in node["children"] for leaf in leaves_of(child)]


def level_of_chunks(bundle, leaves):
    """Return the level at which every chunk is a single group."""
    num_groups = np.bincount(bundle.groups.level, minlength=bundle.num_levels)
    return int(np.flatnonzero(num_groups == len(leaves))[0])


def assert_holds(folder, bundle, chunk):
    """Assert that every leaf has gaussians at all levels, that the leaves together have
    each gaussian of the bundle's levels once, and halves above those levels, and that
    the files have nothing else."""
    index = json.loads((folder / "lod-meta.json").read_text())
    leaves = leaves_of(index["tree"])
    files = [v3dg.read_asset(folder / name) for name in index["filenames"]]
    used = [np.zeros(len(file), int) for file in files]
    top = level_of_chunks(bundle, leaves)
    for level in range(index["lodLevels"]):
        parts = []
        for leaf in leaves:
            lod = leaf["lods"][str(level)]
            rows = slice(lod["offset"], lod["offset"] + lod["count"])
            used[lod["file"]][rows] += 1
            part = files[lod["file"]].subset(rows)
            assert 0 < len(part) == lod["count"] <= chunk
            if level <= top:
                assert (part.means >= np.array(leaf["bound"]["min"]) - 1e-3).all()
                assert (part.means <= np.array(leaf["bound"]["max"]) + 1e-3).all()
            else:
                assert len(part) == (leaf["lods"][str(level - 1)]["count"] + 1) // 2
            parts.append(part)
        assert index["counts"][level] == sum(map(len, parts))
        if level <= top:
            assert_same(v3dg.Gaussians.concatenate(parts), bundle.level_gaussians(level))
    assert all((count == 1).all() for count in used)
    assert index["count"] == sum(index["counts"])
    return index, leaves


def assert_same(found, wanted):
    """Assert that the gaussians are the same in any order, up to the rounding of
    SOG."""
    order = np.lexsort(wanted.means.T)
    wanted = wanted.subset(order)
    squared = np.square(found.means[:, None].astype(float) - wanted.means).sum(axis=2)
    nearest = squared.argmin(axis=0)
    assert len(set(nearest)) == len(wanted) == len(found)
    found = found.subset(nearest)
    np.testing.assert_allclose(found.means, wanted.means, atol=5e-4)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.003)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=0.06)


@pytest.fixture(scope="module")
def bundle():
    from benchmarks.worlds.procedural import make_asset

    config = v3dg.BuildConfig(cluster_size=32, steps=0)
    return v3dg.build_bundle(make_asset(1500), config=config, progress=False)


def test_every_leaf_says_how_far_its_levels_are_from_the_finest(tmp_path, bundle):
    write_streamed_sog(bundle, tmp_path / "web", chunk=250)
    index = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    assert index["lodErrors"] is True
    for leaf in leaves_of(index["tree"]):
        errors = np.array(leaf["errors"])
        assert errors.shape == (index["lodLevels"],)
        assert errors[0] == 0
        assert (np.diff(errors) >= 0).all()
        assert 0 < errors[1] < errors[-1] < 10


def test_errors_of_a_chunk_are_those_of_its_pictures(bundle):
    """The errors of a chunk of any size are those of its pictures. The finest level has
    no error, and a missing level has the error of the last level."""
    finest, nothing = bundle.level_gaussians(0), bundle.level_gaussians(0).subset(slice(0, 0))
    half = finest.subset(slice(0, None, 2))
    errors = ChunkErrors()
    for chunk, scale in ((0, 1.0), (1, 1000.0)):
        for level in (finest, finest, bundle.level_gaussians(1), half, nothing):
            errors.add(chunk, level.transform(scale=scale))
    first, second = errors.of_chunk[0], errors.of_chunk[1]
    assert first[0] == 0
    assert first[1] < 1e-6  # pictures are rounded when they are stored
    # Dropping every second gaussian causes a larger error than a level with as many
    # gaussians.
    assert 0 < 2 * first[2] < first[3] == first[4]
    np.testing.assert_allclose(first, second, rtol=1e-3)


@pytest.mark.parametrize("chunk", [70, 250, 500, 10**9])
def test_every_gaussian_is_in_one_chunk_of_its_level(tmp_path, bundle, chunk):
    done = write_streamed_sog(bundle, tmp_path / "web", chunk=chunk)
    index, leaves = assert_holds(tmp_path / "web", bundle, chunk)
    assert (done.counts, done.chunks, done.files) == (
        index["counts"],
        len(leaves),
        len(index["filenames"]),
    )
    written = [file for file in (tmp_path / "web").rglob("*.*") if file.name != RECORD]
    assert done.bytes == sum(file.stat().st_size for file in written)
    # A viewer can then reduce each chunk to one gaussian.
    assert index["counts"][-1] == len(leaves)
    if chunk == 10**9:
        assert len(leaves) == 1
    # either half of the chunk would suffice for this, or the tree should have been
    # divided higher up
    else:
        assert max(leaf["lods"]["0"]["count"] for leaf in leaves) > chunk / 2 - 1


def test_the_finest_level_of_an_export_loads(tmp_path, bundle):
    write_streamed_sog(bundle, tmp_path / "web", chunk=250)
    loaded, wanted = v3dg.read_asset(tmp_path / "web" / "lod-meta.json"), bundle.level_gaussians(0)
    np.testing.assert_allclose(
        np.sort(loaded.means, axis=0), np.sort(wanted.means, axis=0), atol=5e-4
    )


def test_the_folder_of_an_export_is_an_asset(tmp_path, bundle):
    """The folder is accepted in the same places as its index, in Python and in
    commands. The commands name their outputs after the folder."""
    write_streamed_sog(bundle, tmp_path / "web", chunk=250)
    loaded = v3dg.read_asset(tmp_path / "web")
    wanted = v3dg.read_asset(tmp_path / "web" / "lod-meta.json")
    np.testing.assert_array_equal(loaded.means, wanted.means)
    assert asset_bytes(tmp_path / "web") == asset_bytes(tmp_path / "web" / "lod-meta.json")
    done = run("render", "web", "--size", "16", "16", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "web.png").is_file()
    done = run("build", "web", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "web.v3dg").is_file()
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="expected a file name that ends in"):
        v3dg.read_asset(tmp_path / "empty")


def edited(tmp_path, bundle, **changes):
    """Return the index of an export with other values at the top, or in the finest
    level of its first leaf."""
    write_streamed_sog(bundle, tmp_path / "web", chunk=10**9)
    path = tmp_path / "web" / "lod-meta.json"
    index = json.loads(path.read_text())
    for name, value in changes.items():
        (index if name in index or name == "environment" else index["tree"]["lods"]["0"])[name] = (
            value
        )
    path.write_text(json.dumps(index))
    return path


def test_an_environment_is_loaded_with_the_rest(tmp_path, bundle):
    path = edited(tmp_path, bundle, environment="3_0/meta.json")
    assert len(v3dg.read_asset(path)) == len(bundle.level_gaussians(0)) + len(
        bundle.level_gaussians(3)
    )


def test_an_environment_that_is_null_is_none(tmp_path, bundle):
    path = edited(tmp_path, bundle, environment=None)
    assert len(v3dg.read_asset(path)) == len(bundle.level_gaussians(0))


def test_a_leaf_without_its_finest_level_has_the_next(tmp_path, bundle):
    path = edited(tmp_path, bundle)
    index = json.loads(path.read_text())
    index["tree"]["lods"]["0"]["count"] = 0
    path.write_text(json.dumps(index))
    assert len(v3dg.read_asset(path)) == len(bundle.level_gaussians(1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version: expected streamed SOG version 1, got 2"),
        (
            {"filenames": ["/etc/passwd"] * 9},
            "filenames[0]: expected a path inside the folder of lod-meta.json",
        ),
        (
            {"filenames": ["../a/meta.json"] * 9},
            "filenames[0]: expected a path inside the folder of lod-meta.json",
        ),
        ({"filenames": []}, "tree.lods.0.file: expected 0 to -1, got 0"),
        (
            {"environment": "../meta.json"},
            "environment: expected a path inside the folder of lod-meta.json",
        ),
        ({"offset": 1}, "gaussians from '0_0/meta.json', got more"),
        ({"offset": -1}, "tree.lods.0.offset: expected a whole number, 0 or more, got -1"),
        ({"offset": 10**30}, "tree.lods.0.offset: expected a whole number"),
        ({"tree": {}}, "expected at least one gaussian in the tree, got none"),
        ({"tree": {"lods": {"x": {}}}}, "tree.lods: expected levels with integers as names"),
        ({"tree": {"children": [[]]}}, "tree.children[0]: expected an object, got []"),
    ],
)
def test_hostile_indices_are_refused(tmp_path, bundle, changes, message):
    path = edited(tmp_path, bundle, **changes)
    with pytest.raises(ValueError, match=r"lod-meta\.json") as error:
        v3dg.read_asset(path)
    assert message in str(error.value)


@pytest.mark.parametrize(
    "changes",
    [{"environment": "../meta.json"}, {"environment": 5}, {"tree": {}}, {"file": 99}],
    ids=str,
)
def test_a_wrong_index_is_refused_before_a_chunk_is_decoded(tmp_path, bundle, changes, monkeypatch):
    path = edited(tmp_path, bundle, **changes)
    decoded = []
    monkeypatch.setattr(v3dg.formats.sog, "read", decoded.append)
    with pytest.raises(ValueError, match=r"lod-meta\.json"):
        v3dg.read_asset(path)
    assert decoded == []


@pytest.mark.parametrize("seed", range(6))
def test_bundles_of_any_shape_are_exported(tmp_path, seed):
    """There are groups of several clusters, clusters without gaussians, one level and
    four, and SH of every degree."""
    bundle = random_bundle(seed, num_levels=1 + seed % 4, sh_degree=seed % 4, max_cluster=9)
    write_streamed_sog(bundle, tmp_path / "web", chunk=100)
    index = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    leaves = leaves_of(index["tree"])
    for level, count in enumerate(index["counts"]):
        counts = [leaf["lods"][str(level)]["count"] for leaf in leaves]
        assert count == sum(counts)
        assert min(counts) > 0
    assert index["counts"][0] == len(bundle.level_gaussians(0))
    assert index["counts"][-1] == len(leaves)


def test_chunks_of_any_levels_are_one_picture_without_gaps(tmp_path, bundle):
    """This also holds above the level at which chunks are groups: every second chunk is
    one or two levels coarser than its neighbours."""
    write_streamed_sog(bundle, tmp_path / "web", chunk=250)
    index = json.loads((tmp_path / "web" / "lod-meta.json").read_text())
    leaves = leaves_of(index["tree"])
    files = [v3dg.read_asset(tmp_path / "web" / name) for name in index["filenames"]]

    def alpha(level_of_leaf):
        parts = []
        for leaf, level in zip(leaves, level_of_leaf, strict=True):
            lod = leaf["lods"][str(level)]
            rows = slice(lod["offset"], lod["offset"] + lod["count"])
            parts.append(files[lod["file"]].subset(rows))
        camera = v3dg.Camera.look_at((0, -6, 0.5), (0, 0, 0.5), fov_x=0.4, width=48, height=48)
        return v3dg.rasterize(v3dg.Gaussians.concatenate(parts), camera, filter_px2=0.3).alpha

    covered = alpha([0] * len(leaves)) > 0.9
    assert covered.sum() > 100
    top = level_of_chunks(bundle, leaves)
    for step in (1, 2):
        mixed = alpha([top + step * (number % 2) for number in range(len(leaves))])
        # The shares of groups with several chunks are 0.90 and 0.89 here.
        assert mixed[covered].mean() > 0.91


def test_many_chunks_share_a_folder_up_to_its_size(tmp_path, bundle, monkeypatch):
    monkeypatch.setattr(v3dg.export.streamed_sog, "_FOLDER_GAUSSIANS", 300)
    write_streamed_sog(bundle, tmp_path / "web", chunk=150)
    index, _ = assert_holds(tmp_path / "web", bundle, 150)
    of_level_0 = [name for name in index["filenames"] if name.startswith("0_")]
    assert of_level_0 == [f"0_{i}/meta.json" for i in range(len(of_level_0))]
    sizes = [len(v3dg.read_asset(tmp_path / "web" / name)) for name in of_level_0]
    assert all(300 <= size < 450 for size in sizes[:-1])


def test_an_earlier_export_is_replaced_and_kept_on_failure(tmp_path, bundle, monkeypatch):
    folder = tmp_path / "web"
    write_streamed_sog(bundle, folder, chunk=200)
    before = (folder / "lod-meta.json").read_text()
    with monkeypatch.context() as patch:

        def full_disk(gaussians):
            raise OSError(28, "No space left on device")

        patch.setattr(v3dg.export.streamed_sog.sog, "encode", full_disk)
        with pytest.raises(OSError, match="No space left on device"):
            write_streamed_sog(bundle, folder, chunk=10**9)
        with pytest.raises(OSError, match="No space left on device"):
            write_streamed_sog(bundle, tmp_path / "deep" / "er" / "web", chunk=10**9)
    assert (folder / "lod-meta.json").read_text() == before
    write_streamed_sog(bundle, folder, chunk=10**9)
    assert (folder / "lod-meta.json").read_text() != before
    assert os.listdir(tmp_path) == ["web"]


def test_a_viewer_starts_where_it_sees_the_asset(tmp_path, bundle):
    write_streamed_sog(bundle, tmp_path / "web")
    pose = json.loads((tmp_path / "web" / "settings.json").read_text())["cameras"][0]["initial"]
    turn = np.diag([-1.0, -1.0, 1.0])  # the rotation of the asset in the viewer
    position, target = (turn @ pose[name] for name in ("position", "target"))
    means = bundle.level_gaussians(0).means
    camera = v3dg.Camera.look_at(
        position, target, (0, -1, 0), fov_x=np.radians(pose["fov"]), width=100, height=100
    )
    points = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = points @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert (points[:, 2] > 0).all()
    assert ((pixels >= 0) & (pixels <= 100)).all(axis=1).mean() > 0.97
    assert np.ptp(pixels, axis=0).max() > 40


def rotation_between(points, turned):
    """Return the one of the 24 rotations of a cube that maps points to rotated points
    in any order."""
    signed = [
        np.diag(signs)[:, order]
        for signs in product((1, -1), repeat=3)
        for order in permutations(range(3))
    ]
    rotations = [matrix for matrix in signed if np.linalg.det(matrix) > 0]
    errors = [
        np.abs(np.sort(points @ r.T, axis=0) - np.sort(turned, axis=0)).max() for r in rotations
    ]
    assert sorted(errors)[0] < 1e-4 < sorted(errors)[1]
    return rotations[int(np.argmin(errors))]


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_what_is_up_becomes_what_viewers_take_to_be_up(tmp_path, up):
    """The asset looks the same from a camera that is rotated with it."""
    from benchmarks.worlds.procedural import make_donut

    asset = make_donut(1000)
    bundle = v3dg.build_bundle(asset, config=v3dg.BuildConfig(steps=0), progress=False)
    write_streamed_sog(bundle, tmp_path / "web", chunk=2000, up=up)
    turned = v3dg.read_asset(tmp_path / "web" / "0_0" / "meta.json")
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    side = np.eye(3)[("xyz".index(up[-1]) + 1) % 3]
    eye = 0.5 * side + 0.3 * axis

    asset = bundle.level_gaussians(0)
    rotation = rotation_between(asset.means, turned.means)
    np.testing.assert_array_equal(rotation @ axis, (0, -1, 0))
    pictures = []
    for gaussians, matrix in ((asset, np.eye(3)), (turned, rotation)):
        camera = v3dg.Camera.look_at(
            matrix @ eye, (0, 0, 0), matrix @ axis, fov_x=0.7, width=64, height=64
        )
        pictures.append(v3dg.rasterize(gaussians, camera).color)
    assert pictures[0].max() > 0.3
    assert psnr(*pictures) > 38


def test_other_folders_and_impossible_chunks_are_refused(tmp_path, bundle):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    (tmp_path / "file").touch()
    for name in ("mine", "file"):
        with pytest.raises(
            ValueError, match=f"{name}: expected a new folder or one with an earlier export"
        ):
            write_streamed_sog(bundle, tmp_path / name)
    with pytest.raises(
        ValueError,
        match=r"chunk: expected at least \d+ gaussians, the size of the largest group, got 9",
    ):
        write_streamed_sog(bundle, tmp_path / "web", chunk=9)
    with pytest.raises(
        ValueError, match="bundle: expected at least one gaussian to export, got none"
    ):
        write_streamed_sog(random_bundle(num_levels=0), tmp_path / "web")
    with pytest.raises(ValueError, match="chunk: expected at least"):
        write_streamed_sog(bundle, tmp_path / "absent" / "web", chunk=9)
    with pytest.raises(NotADirectoryError, match="web"):
        write_streamed_sog(bundle, tmp_path / "file" / "web")
    assert sorted(os.listdir(tmp_path)) == ["file", "mine"]


def test_info_of_an_export_has_the_size_of_all_its_files(tmp_path, bundle):
    """The size includes every level and the environment once each. The page's settings
    are not part of the asset."""
    path = edited(tmp_path, bundle, environment="3_0/meta.json")
    num_bytes = sum(file.stat().st_size for file in (tmp_path / "web").rglob("*.*"))
    num_bytes -= sum((tmp_path / "web" / name).stat().st_size for name in ("settings.json", RECORD))
    result = json.loads(run("info", path, "--json").stdout)
    assert result["bytes"] == num_bytes > 10 * path.stat().st_size
    shutil.rmtree(tmp_path / "web" / "2_0")  # a level that is not read may be missing
    assert asset_bytes(path) < num_bytes
    folder = tmp_path / "web" / "1_0"
    assert asset_bytes(folder / "meta.json") == sum(
        file.stat().st_size for file in folder.iterdir()
    )


@pytest.mark.witness
@pytest.mark.skipif(shutil.which("splat-transform") is None, reason="needs splat-transform")
def test_splat_transform_reads_an_export(tmp_path, bundle):
    write_streamed_sog(bundle, tmp_path / "web", chunk=500)
    for level in (0, 2):
        arguments = ["-g", "cpu", "-q", "-w", "-L", str(level), "web/lod-meta.json", "back.ply"]
        subprocess.run(["splat-transform", *arguments], cwd=tmp_path, check=True)
        back, wanted = v3dg.read_asset(tmp_path / "back.ply"), bundle.level_gaussians(level)
        assert len(back) == len(wanted)
        np.testing.assert_allclose(back.means.mean(axis=0), wanted.means.mean(axis=0), atol=1e-4)
