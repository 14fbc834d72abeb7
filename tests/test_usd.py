"""OpenUSD, in and out, checked with its own validators and its own choice of levels."""

import math
import os
import sys

import numpy as np
import pytest

import v3dg
from command_line import fails, run
from random_bundle import random_bundle, random_gaussians
from v3dg.export import write_usd

pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom, UsdLod, UsdValidation


def assert_same(found, wanted, rtol=0.0):
    for name, values in vars(found).items():
        np.testing.assert_allclose(values, getattr(wanted, name), rtol=rtol, atol=1e-6, err_msg=name)


def assert_valid(path):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(os.fspath(path)))
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in errors] == []


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", ["usd", "usda", "usdc"])
def test_an_asset_reads_back(tmp_path, suffix, degree):
    asset = random_gaussians(np.random.default_rng(degree), 50, degree)
    v3dg.write_asset(tmp_path / f"a.{suffix}", asset)
    assert_same(v3dg.read_asset(tmp_path / f"a.{suffix}"), asset)
    assert_valid(tmp_path / f"a.{suffix}")
    assert (tmp_path / "a.usda").exists() == (suffix == "usda")
    assert os.listdir(tmp_path) == [f"a.{suffix}"]
    if suffix == "usda":
        assert (tmp_path / "a.usda").read_text().startswith("#usda 1.0")


def test_no_gaussians_are_written(tmp_path):
    v3dg.write_asset(tmp_path / "a.usdc", random_gaussians(np.random.default_rng(0), 0, 1))
    assert len(v3dg.read_asset(tmp_path / "a.usdc")) == 0


def test_prims_stand_where_their_transforms_put_them(tmp_path):
    asset = random_gaussians(np.random.default_rng(0), 50, 2)
    v3dg.write_asset(tmp_path / "a.usda", asset)
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usda"))
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/gaussians"))
    prim.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    prim.AddOrientOp().Set(Gf.Quatf(0.5, 0.5, -0.5, 0.5))
    scale = prim.AddScaleOp()
    scale.Set(Gf.Vec3f(2, 2, 2))
    stage.GetRootLayer().Save()
    wanted = asset.transform((0.5, 0.5, -0.5, 0.5), (1, 2, 3), 2.0)
    found = v3dg.read_asset(tmp_path / "a.usda")
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-5)
    scale.Set(Gf.Vec3f(2, 2, 1))
    stage.GetRootLayer().Save()
    with pytest.raises(ValueError, match="a transform of /gaussians that is no rotation"):
        v3dg.read_asset(tmp_path / "a.usda")


@pytest.mark.parametrize("seed", range(4))
def test_a_bundle_has_its_levels(tmp_path, seed):
    bundle = random_bundle(seed, num_levels=1 + seed, sh_degree=seed)
    write_usd(bundle, tmp_path / "a.usdc", up="z")
    assert_valid(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usdc"))
    levels = stage.GetPrimAtPath("/world/bundle").GetChildren()
    for level, prim in enumerate(levels):
        wanted = bundle.level_gaussians(level)
        np.testing.assert_array_equal(np.array(prim.GetAttribute("positions").Get()), wanted.means)
    assert len(levels) == bundle.num_levels
    assert_same(v3dg.read_asset(tmp_path / "a.usdc"), bundle.level_gaussians(0))


def test_usd_chooses_the_level_that_selection_has(tmp_path):
    """Level 1 begins where half of its groups are enough, for a picture of 1920 x 1080."""
    bundle = random_bundle(3, num_levels=4)
    write_usd(bundle, tmp_path / "a.usdc", up="z")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usdc"))
    root = stage.GetPrimAtPath("/world/bundle")
    (target,) = UsdLod.RootAPI(root).GetLodHeuristicsRel().GetTargets()
    heuristic = UsdLod.ScreenSizeHeuristic(stage.GetPrimAtPath(target))
    low, high = heuristic.GetExtentAttr().Get()
    detail = v3dg.export._common.detail_of(bundle)
    focal = 900.0
    for level in range(1, bundle.num_levels):
        start = focal * detail["reach"] / math.sqrt(3) * detail["ratio"] ** (level - 1)
        for distance, wanted in ((start * 0.98, level - 1), (start * 1.02, level)):
            frustum = Gf.Frustum()
            frustum.SetPerspective(2 * math.degrees(math.atan(540 / focal)), 1920 / 1080, 1e-3, 1e9)
            frustum.SetPosition(Gf.Vec3d((low + high) / 2) + Gf.Vec3d(0, 0, distance))
            query = heuristic.CreateScreenSizeHeuristicQuery()
            assert query.ComputeLOD(frustum, Gf.Matrix4d(1)) == wanted


def test_a_scene_is_a_point_instancer(tmp_path):
    bundles = [random_bundle(seed, num_levels=3) for seed in (1, 2)]
    scene = v3dg.Scene()
    turns = [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [1, 0, 0, 1]]
    scene.add([bundles[0], bundles[1], bundles[0]], np.eye(3) * 9, turns, [1, 2, 0.5])
    write_usd(scene, tmp_path / "a.usdc", up="y")
    assert_valid(tmp_path / "a.usdc")
    stage = Usd.Stage.Open(os.fspath(tmp_path / "a.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    instancer = UsdGeom.PointInstancer(stage.GetPrimAtPath("/world/instances"))
    assert list(instancer.GetProtoIndicesAttr().Get()) == scene.instance_bundle.tolist()
    matrices = np.array(instancer.ComputeInstanceTransformsAtTime(0, 0))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/world")))
    np.testing.assert_allclose([0, 1, 0, 0] @ world, [0, 0, 1, 0], atol=1e-6)  # y becomes z
    for i, matrix in enumerate(matrices):
        # USD has vectors as rows; instances are before the prototypes' own transforms, which have none.
        np.testing.assert_allclose(matrix[:3, :3].T, scene.scales[i] * scene.rotations[i], atol=1e-3)
        np.testing.assert_allclose(matrix[3, :3], scene.positions[i], atol=1e-5)
    with pytest.raises(ValueError, match="without instances, got instances in /world/instances"):
        v3dg.read_asset(tmp_path / "a.usdc")


def test_the_command_writes_a_file(tmp_path):
    random_bundle(3).write(tmp_path / "3 a.v3dg")
    done = run("export", "3 a.v3dg", "-o", "b.usdc", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("b.usdc: ")
    assert len(v3dg.read_asset(tmp_path / "b.usdc")) == len(random_bundle(3).level_gaussians(0))
    fails(1, "no/b.usdc: No such file or directory", "export", "3 a.v3dg", "-o", "no/b.usdc", cwd=tmp_path)


def test_bad_files_are_refused(tmp_path):
    (tmp_path / "a.usda").write_text("#usda 1.0\n(\n")
    (tmp_path / "b.usdc").write_bytes(b"PXR-USDC" + bytes(100))
    (tmp_path / "c.usda").write_text('#usda 1.0\ndef Xform "world" {}\n')
    for name in ("a.usda", "b.usdc", "c.usda"):
        with pytest.raises(ValueError, match=f"{name}: expected OpenUSD with gaussians"):
            v3dg.read_asset(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        v3dg.read_asset(tmp_path / "none.usda")
    with pytest.raises(ValueError, match=r"path: expected '\.usd' or"):
        write_usd(random_bundle(3), tmp_path / "a.usdz")
    with pytest.raises(ValueError, match="scene: expected instances to export, got none"):
        write_usd(v3dg.Scene(), tmp_path / "none.usda")


def test_without_usd_core_the_error_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    v3dg.formats.usd.pxr.cache_clear()
    with pytest.raises(ImportError, match=r"OpenUSD: expected .*pip install 'usd-core>=26.11'"):
        v3dg.write_asset(tmp_path / "a.usdc", random_gaussians(np.random.default_rng(0), 3))
    assert os.listdir(tmp_path) == []
